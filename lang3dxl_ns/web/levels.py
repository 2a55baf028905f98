"""Levels of detail of a large scene: a tree of chunks, each Gaussian standing for four of the level below.

All levels have one order: rows 4 j … 4 j + 3 of a level merge into row j of the level above, and each level
is cut into chunks of as many rows. The children of chunk k are therefore 4 k + 1 … 4 k + 4, and each of them
shows a quarter of its rows in more detail. Chunk 0 is the whole scene, coarsely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch import Tensor

from lang3dxl_ns.common.checks import FARTHEST
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.rendering.projection import rotations
from lang3dxl_ns.rendering.splats import harmonics_of

SMALL = 100_000
"""Most Gaussians of a scene that a page shows without levels of detail."""
MOST_ROWS = 65_536
"""Most Gaussians of a chunk."""
_FAN, _ALIGNED, _PROJECTIONS = 4, 64, 16
"""Children of a chunk and of a Gaussian; what rows of a chunk are a multiple of; numbers of a meaning."""


@dataclass(frozen=True, eq=False)
class Levels:
    """A scene's levels of detail."""

    scenes: Sequence[Scene]
    """The scene at each level, coarsest first. The finest level holds the Gaussians themselves, in the tree's
    order, and some that are invisible and fill the last chunk."""
    rows: int
    """Gaussians of each chunk."""

    @property
    def chunks(self) -> int:
        """Number of chunks of all levels."""
        return sum(_FAN**level for level in range(len(self.scenes)))

    def chunk(self, number: int) -> tuple[Scene, slice]:
        """Return the level that a chunk belongs to, and its rows there."""
        level = 0
        while number >= _FAN**level:
            number, level = number - _FAN**level, level + 1
        return self.scenes[level], slice(number * self.rows, (number + 1) * self.rows)

    def bounds(self, number: int) -> list[float]:
        """Measure a chunk: the middle of its Gaussians, the radius around it that holds nearly all of them,
        and their median standard deviation, in world units."""
        scene, rows = self.chunk(number)
        if not bool((shown := scene.splats.opacities[rows] > 0).any()):
            return [0.0] * 5
        means, scales = scene.splats.means[rows][shown], scene.splats.scales[rows][shown]
        middle = means.median(0).values
        radius = (means - middle).norm(dim=1).quantile(0.98)
        return [*middle.tolist(), float(radius), float(scales.amax(1).median())]


def levels_of(scene: Scene, most: int = MOST_ROWS) -> Levels:
    """Merge a scene's Gaussians, four at a time, until at most this many are left. Each level is a scene that
    answers like any other: it has merged codes, views and floaters."""
    count, depth = len(scene.splats), 0
    while count > most * _FAN**depth:
        depth += 1
    rows = -(-count // (_FAN**depth * _ALIGNED)) * _ALIGNED
    splats = scene.splats
    near = (splats.means.abs() < FARTHEST).all(1) & (splats.scales < FARTHEST).all(1)  # squares stay finite
    sound = splats.sound() & near
    if scene.looks is None:  # looks change harmonics
        splats = replace(splats, harmonics=harmonics_of(splats.colors(scene.overview.camera.position)))
    filled = torch.arange(rows * _FAN**depth, device=splats.means.device).clamp_max(count - 1)
    splats = splats.mapped(lambda values: values.nan_to_num(0, 0, 0)[filled])
    visible = sound[filled] & (torch.arange(len(filled), device=filled.device) < count)
    means = torch.where(visible[:, None], splats.means, splats.means[visible].median(0).values)
    quats = torch.where(visible[:, None], splats.quats, splats.quats.new_tensor([1.0, 0, 0, 0]))
    scales, opacities = splats.scales * visible[:, None], splats.opacities * visible
    splats = replace(splats, means=means, quats=quats, scales=scales, opacities=opacities)
    order = tree_order(splats, _meaning(scene)[filled])
    splats, origin = splats.select(order), filled[order]
    codes = None if scene.codes is None else torch.where(visible[order, None], scene.codes[origin], torch.nan)
    floats, place = scene.floating[origin], order.argsort()[:count]
    found = []
    for level in range(depth + 1):
        if level:
            splats, codes, floats = merged(splats, codes, floats)
        coarse = replace(scene, splats=splats, codes=codes, cache=None)
        found.append(_level(coarse, scene, floats, place // _FAN**level))
    return Levels(found[::-1], rows)


def _level(level: Scene, scene: Scene, floats: Float[Tensor, " n"], place: Int[Tensor, " m"]) -> Scene:
    """Give a level the views and floaters of the scene. place: its row for each of the scene's Gaussians."""
    views = {}
    for name, view in scene.visible.items():
        shares = view.shares.new_zeros(len(floats)).index_add_(0, place[view.rows.long()], view.shares)
        views[name] = VisibleGaussians.of(view.camera, shares * view.size)
    level.__dict__.update(visible=views, floating=floats)  # in place of the cached properties
    return level


def tree_order(splats: Splats, meaning: Float[Tensor, "n d"]) -> Int[Tensor, " n"]:
    """Order Gaussians, a multiple of 64, so that each four, sixteen and so on lie together and mean alike.

    A k-d tree halves the longest side down to 64 Gaussians, whose extent counts as much as one unit of
    `meaning`. These are paired by what merging adds to the variance (Ward's criterion), and so are the pairs.
    Gaussians weigh by the root of opacity times area, lest what is faint vanish in what is heavy.
    """
    means, meant, found = splats.means.double().cpu().numpy(), meaning.cpu().numpy(), []
    weights = (splats.opacities * _area(splats.scales)).sqrt().clamp_min(1e-12).double().cpu().numpy()
    for node in _halved(means, np.arange(len(means))):
        away = means[node] - means[node].mean(0)
        radius = max(np.sqrt(np.square(away).sum(1).mean()), 1e-12)
        points = np.hstack([away / radius, meant[node]])
        found.append(node[_tied(points, weights[node])])
    return torch.from_numpy(np.concatenate(found)).to(splats.means.device)


def _halved(means: Float[Array, "n 3"], node: Int[Array, " s"]) -> list[Int[Array, " 64"]]:
    if len(node) <= _ALIGNED:
        return [node]
    half, axis = _ALIGNED * (len(node) // (2 * _ALIGNED)), np.ptp(means[node], axis=0).argmax()
    order = node[np.argpartition(means[node, axis], half)]
    return [*_halved(means, order[:half]), *_halved(means, order[half:])]


def _tied(points: Float[Array, "s d"], weights: Float[Array, " s"]) -> Int[Array, " s"]:
    """Order points so that successive ones are pairs, then pairs of pairs, and so on."""
    order = np.arange(len(points))[:, None]
    while len(order) > 1:
        pairs = _pairs(cdist(points, points, "sqeuclidean") / (1 / weights[:, None] + 1 / weights))
        points, shares, order = points[pairs], weights[pairs], order[pairs].reshape(len(pairs), -1)
        weights = shares.sum(1)
        points = (points * shares[..., None]).sum(1) / weights[:, None]
    return order[0]


def _pairs(costs: Float[Array, "s s"]) -> Int[Array, "p 2"]:
    """Pair rows: the best between two halves, and again after some have changed sides."""
    pairs = np.arange(len(costs)).reshape(-1, 2)
    for turn in range(2):
        one, other = np.where(np.arange(len(pairs))[:, None] >> turn & 1, pairs[:, ::-1], pairs).T
        pairs = np.stack([one, other[linear_sum_assignment(costs[np.ix_(one, other)])[1]]], 1)
    return pairs


def _meaning(scene: Scene) -> Float[Tensor, "n d"]:
    """Describe what each Gaussian means by a few random projections, with deviation 1 in all."""
    if scene.codes is None:
        return scene.splats.means[:, :0]
    decode = scene.engine.features
    parts = torch.arange(len(scene.codes), device=scene.device).split(MOST_ROWS)
    axes = torch.randn(decode(slice(1)).shape[1], _PROJECTIONS, generator=torch.Generator().manual_seed(0))
    meaning = torch.cat([decode(part).float() @ axes.to(scene.device) for part in parts]).nan_to_num(0)
    return meaning / meaning.var(0).sum().sqrt().clamp_min(1e-12)


def merged(
    splats: Splats, codes: Float[Tensor, "n d"] | None, floats: Float[Tensor, " n"]
) -> tuple[Splats, Float[Tensor, "m d"] | None, Float[Tensor, " m"]]:
    """Merge each four successive Gaussians into one with their mean, covariance, color and total opacity
    times area.

    The four weigh by opacity times area. The merged Gaussian means what the heaviest of them means: a code
    between two codes may mean a third thing.
    """

    def fours(values: Tensor) -> Tensor:
        return values.unflatten(0, (-1, _FAN))

    def mean(values: Tensor) -> Tensor:
        return (weights.reshape(*weights.shape, *[1] * (values.dim() - 2)) * values).sum(1)

    mass = fours(splats.opacities * _area(splats.scales))
    total = mass.sum(1)
    weights = torch.where(total[:, None] > 0, mass / total[:, None].clamp_min(1e-30), 1 / _FAN)
    means = mean(fours(splats.means))
    roots = rotations(splats.quats) * splats.scales[:, None]
    away = fours(splats.means) - means[:, None]
    covariance = mean(fours(roots @ roots.mT) + away[..., :, None] * away[..., None, :])
    variances, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes)[:, None, None]  # a rotation, no reflection
    scales = variances.clamp_min(1e-14).sqrt()
    opacities = (total / _area(scales).clamp_min(1e-30)).clamp_max(1.0)
    turns = Rotation.from_matrix(axes.cpu().double().numpy()).as_quat()[:, [3, 0, 1, 2]]
    quats, colors = torch.from_numpy(turns).to(means), mean(fours(splats.harmonics))
    whole = Splats(means, quats, scales, opacities, colors, splats.antialiased)
    if codes is not None:
        known = codes.isfinite().all(1)
        heaviest = torch.where(fours(known), mass, -1.0).argmax(1)
        codes = fours(codes)[torch.arange(len(means), device=means.device), heaviest]
    return whole, codes, mean(fours(floats))


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Compute a Gaussian's mean projected area, but for a factor."""
    a, b, c = scales.unbind(1)
    return a * b + b * c + a * c
