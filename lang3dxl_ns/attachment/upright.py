"""Up direction of a splat without photos: axes of its walls, judged by what a CLIP sees in views of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.preparation.encoders import ImageTextEncoder, load_image_text_encoder
from lang3dxl_ns.preparation.model_files import BUILTIN
from lang3dxl_ns.query.vocabulary import shipped_vocabulary
from lang3dxl_ns.rendering import Splats, render
from lang3dxl_ns.scene.camera import Lens, level, looking

BACKGROUND = (0.75, 0.8, 0.85)
"""Color behind the splat, a pale sky."""
CERTAIN = 0.3
"""Margin over the next direction from which up is certain. Of 36 validation landmarks, four were below it."""
_POINTS, _NEIGHBORS, _GAUSSIANS = 8_000, 16, 100_000
_NEAR = 2.5
"""Distance from the middle, in radii of the scene, within which matter counts."""
_STARTS, _ROUNDS = 24, 12
"""Random rotations from which the axes are sought, and steps of each."""
_AZIMUTHS, _DISTANCE, _ELEVATION = 6, 2.2, 0.15
"""Views around the scene: their number, distance in radii, and height as an angle in radians."""
_LENS = Lens(128, 128, 115.0, 115.0, 64.0, 64.0)
_WALLS, _CERTAINTY = 1.0, 10.0
"""Weights of the share of walls, and of how well words fit, beside those of the sky and of doors."""


@dataclass(frozen=True)
class Upright:
    """Up direction that was found, and how certain it is."""

    direction: Float[Tensor, "3"]
    margin: float
    """Lead of its score over that of the next direction. Below `CERTAIN` it is doubtful."""
    second: Float[Tensor, "3"]
    """Next direction."""


def find_up(solid: Splats, center: Float[Tensor, "3"], radius: float) -> Upright:
    """Find the up direction of a scene from its opaque Gaussians, three quarters of which lie within `radius`
    of its `center`.

    The three dominant directions of its surfaces are candidates, upwards and downwards. A vertical axis has
    walls all around. In views with the right one up, the sky is above, doors are below, and crops look like
    what words name; the built-in CLIP judges that.
    """
    solid = solid.select((solid.means - center).norm(dim=1) < _NEAR * radius).thinned(_GAUSSIANS)
    judge = _Judge(load_image_text_encoder(BUILTIN, solid.means.device))
    found = list[tuple[float, Float[Tensor, "3"]]]()
    for axis, walls in tracked(_axes(solid.means.double().cpu().numpy()), "finding which way is up"):
        for direction in (axis, -axis):
            up = torch.from_numpy(direction).to(center)
            found.append((_WALLS * walls + judge.score(solid, center, radius, up), up))
    (best, up), (next_, second), *_ = sorted(found, key=lambda pair: -pair[0])
    return Upright(up, best - next_, second)


def name_of_axis(direction: Float[Tensor, "3"]) -> str:
    """Return the option that names the axis nearest to a direction: x, -x, y …"""
    nearest = int(direction.abs().argmax())
    return "-" * (float(direction[nearest]) < 0) + "xyz"[nearest]


def _axes(points: Float[Array, "n 3"]) -> list[tuple[Float[Array, "3"], float]]:
    """Find three directions to which most surfaces are perpendicular, and for each the share of all
    surfaces that are parallel to it, as walls are to the vertical."""
    points = np.random.default_rng(0).permutation(points)[:_POINTS]
    normals, weights = _normals(points)
    starts = [_settled(normals, weights, turn) for turn in Rotation.random(_STARTS, 0).as_matrix()]
    axes = max(starts, key=lambda axes: float(weights[np.abs(normals @ axes.T).max(1) > 0.95].sum()))
    return [_refined(normals, weights, axis) for axis in axes]


def _normals(points: Float[Array, "n 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Return the normal of the surface at each point, and how flat its surroundings are, 0…1."""
    rows = KDTree(points).query(points, k=min(_NEIGHBORS, len(points)))[1]
    near = points[rows] - points[rows].mean(1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    flat = np.clip(1 - spread[:, 0] / np.maximum(spread[:, 1], 1e-12), 0, 1)
    return axes[:, :, 0], flat**2


def _settled(
    normals: Float[Array, "n 3"], weights: Float[Array, " n"], axes: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """Turn three perpendicular axes towards the normals that are near them."""
    for _ in range(_ROUNDS):
        along = normals @ axes.T
        nearest = np.abs(along).argmax(1)
        cosine = along[np.arange(len(along)), nearest]
        pull = normals * (weights * cosine * (np.abs(cosine) > 0.8))[:, None]
        sums = np.stack([pull[nearest == i].sum(0) for i in range(3)])
        left, _, right = np.linalg.svd(sums)
        axes = left @ right
    return axes


def _refined(
    normals: Float[Array, "n 3"], weights: Float[Array, " n"], axis: Float[Array, "3"]
) -> tuple[Float[Array, "3"], float]:
    """Turn an axis away from the normals of walls along it, and towards those of floors. Returns the axis and
    its share of walls."""
    for _ in range(5):
        along = np.abs(normals @ axis)
        signs = weights * ((along < 0.25) * 1.0 - (along > 0.95))
        axes = np.linalg.eigh((normals * signs[:, None]).T @ normals)[1]
        axis = axes[:, 0] * (1 if axes[:, 0] @ axis >= 0 else -1)
    along = np.abs(normals @ axis)
    return axis, float(weights[along < 0.15].sum() / max(weights.sum(), 1e-12))


class _Judge:
    """The built-in CLIP as a judge of which views are upright."""

    def __init__(self, encoder: ImageTextEncoder) -> None:
        self._encoder = encoder
        words = ["sky", "door", *shipped_vocabulary()]
        self._texts = F.normalize(encoder.encode_texts(words), dim=1)

    def score(
        self, splats: Splats, center: Float[Tensor, "3"], radius: float, up: Float[Tensor, "3"]
    ) -> float:
        """Return how much more sky is above than below, how much more doors are below than above, and how
        well words fit, in views around a scene."""
        crops = torch.cat([_crops(splats, center, radius, up, i / _AZIMUTHS) for i in range(_AZIMUTHS)])
        features = F.normalize(self._encoder.encode_images(crops), dim=1)
        cosines = (features @ self._texts.T).reshape(_AZIMUTHS, 3, 3, -1)
        difference = (cosines[:, 0] - cosines[:, 2]).mean((0, 1))
        certainty = cosines[..., 2:].amax(-1).mean()
        return float(difference[0] - difference[1] + _CERTAINTY * certainty)


def _crops(
    splats: Splats, center: Float[Tensor, "3"], radius: float, up: Float[Tensor, "3"], turn: float
) -> Float[Tensor, "9 3 s s"]:
    """Render a view from a fraction of a full turn, and cut it into three rows of three overlapping crops."""
    away = math.cos(_ELEVATION) * level(up, turn) + math.sin(_ELEVATION) * up
    view = looking((center + _DISTANCE * radius * away).cpu(), center.cpu(), up.cpu())
    picture = render(splats, _LENS.camera(view), background=splats.means.new_tensor(BACKGROUND)).rgb
    quarter = _LENS.width // 4
    windows = picture.permute(2, 0, 1).unfold(1, 2 * quarter, quarter).unfold(2, 2 * quarter, quarter)
    return windows.permute(1, 2, 0, 3, 4).flatten(0, 1)
