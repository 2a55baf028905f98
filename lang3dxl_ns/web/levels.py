"""Levels of detail of a large scene: a tree of chunks, each Gaussian standing for four of the level below.

All levels have one order: rows 4 j … 4 j + 3 of a level merge into row j of the level above, and each level
is cut into chunks of as many rows. The children of chunk k are therefore 4 k + 1 … 4 k + 4, and each of them
shows a quarter of its rows in more detail. Chunk 0 is the whole scene, coarsely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.rendering.projection import rotations
from lang3dxl_ns.rendering.splats import harmonics_of

SMALL = 100_000
"""Most Gaussians of a scene that a page shows without levels of detail."""
MOST_ROWS = 65_536
"""Most Gaussians of a chunk."""
_FAN, _ALIGNED = 4, 64
"""Children of a chunk, and rows of Gaussians; rows of a chunk are a multiple of the latter."""


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
        shown = scene.splats.opacities[rows] > 0
        if not bool(shown.any()):
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
    sound = scene.splats.sound()
    splats = scene.splats
    if scene.looks is None:  # looks change harmonics
        splats = replace(splats, harmonics=harmonics_of(splats.colors(scene.overview.camera.position)))
    filled = torch.arange(rows * _FAN**depth, device=splats.means.device).clamp_max(count - 1)
    splats = splats.mapped(lambda values: values.nan_to_num(0, 0, 0)[filled])
    visible = sound[filled] & (torch.arange(len(filled), device=filled.device) < count)
    means = torch.where(visible[:, None], splats.means, splats.means[visible].median(0).values)
    quats = torch.where(visible[:, None], splats.quats, splats.quats.new_tensor([1.0, 0, 0, 0]))
    splats = replace(splats, means=means, quats=quats, opacities=splats.opacities * visible)
    order = kd_order(splats.means)
    splats, origin = splats.select(order), filled[order]
    place = torch.empty(count, dtype=torch.long, device=order.device)
    real = order < count
    place[order[real]] = real.nonzero().squeeze(1)
    codes = None if scene.codes is None else torch.where(visible[order, None], scene.codes[origin], torch.nan)
    floats = scene.floating[origin]
    found = [_level(scene, splats, codes, floats, place)]
    for _ in range(depth):
        splats, codes, floats = merged(splats, codes, floats)
        place = place // _FAN
        found.append(_level(scene, splats, codes, floats, place))
    return Levels(found[::-1], rows)


def _level(
    scene: Scene,
    splats: Splats,
    codes: Float[Tensor, "n d"] | None,
    floats: Float[Tensor, " n"],
    place: Int[Tensor, " m"],
) -> Scene:
    """Make the scene of one level. place: its row for each of the scene's own Gaussians."""
    level = replace(scene, splats=splats, codes=codes, cache=None)
    views = {}
    for name, view in scene.visible.items():
        shares = view.shares.new_zeros(len(splats)).index_add_(0, place[view.rows.long()], view.shares)
        views[name] = VisibleGaussians.of(view.camera, shares * view.size)
    level.__dict__.update(visible=views, floating=floats)  # in place of the cached properties
    return level


def kd_order(means: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Order points, a multiple of four, so that each half, quarter and so on, down to groups of four, lies
    together: a k-d tree that halves the longest side."""
    start = torch.arange(len(means), device=means.device)
    return _split(means, start[None])[0]


def _split(means: Float[Tensor, "n 3"], nodes: Int[Tensor, "m s"]) -> Int[Tensor, "m s"]:
    """Order the points of each node. All nodes have as many."""
    count, size = nodes.shape
    if size <= _FAN:
        return nodes
    points = means[nodes]
    axis = (points.amax(1) - points.amin(1)).argmax(1)
    keys = points.gather(2, axis[:, None, None].expand(-1, size, 1))[..., 0]
    nodes = nodes.gather(1, keys.argsort(1))
    half = _FAN * (size // (2 * _FAN))
    if 2 * half == size:
        return _split(means, nodes.reshape(2 * count, half)).reshape(count, size)
    return torch.cat([_split(means, nodes[:, :half]), _split(means, nodes[:, half:])], 1)


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
    turns = rotations(splats.quats) * splats.scales[:, None]
    away = fours(splats.means) - means[:, None]
    covariance = mean(fours(turns @ turns.mT) + away[..., :, None] * away[..., None, :])
    variances, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes)[:, None, None]  # a rotation, no reflection
    scales = variances.clamp_min(1e-14).sqrt()
    opacities = (total / _area(scales).clamp_min(1e-30)).clamp_max(1.0)
    quats = Rotation.from_matrix(axes.cpu().double().numpy()).as_quat()[:, [3, 0, 1, 2]]
    whole = Splats(
        means,
        torch.from_numpy(quats).to(means),
        scales,
        opacities,
        mean(fours(splats.harmonics)),
        splats.antialiased,
    )
    if codes is not None:
        known = codes.isfinite().all(1)
        heaviest = torch.where(fours(known), mass, -1.0).argmax(1)
        codes = fours(codes)[torch.arange(len(means), device=means.device), heaviest]
    return whole, codes, mean(fours(floats))


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Compute a Gaussian's mean projected area, but for a factor."""
    a, b, c = scales.unbind(1)
    return a * b + b * c + a * c
