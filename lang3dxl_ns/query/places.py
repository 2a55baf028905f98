"""Places in 3D: back-projection of matching pixels, and boxes around them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lang3dxl_ns.scene.camera import Camera

_OUTLIERS = 0.02
"""Share of a match's points that its box excludes at either end of each axis."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the model's frame."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    share: float
    """Share of the total match weight that is connected to it, 0…1."""

    @property
    def center(self) -> tuple[float, ...]:
        """The box's center."""
        return tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))


def world_points(
    camera: Camera, depth: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "n 3"]:
    """World positions of the masked pixels' centers, from depth along the camera's axis."""
    rows, columns = mask.nonzero().T
    view, k = camera.view_matrix.to(depth), camera.intrinsics.to(depth)
    z = depth[rows, columns]
    x = (columns + 0.5 - k[0, 2]) / k[0, 0] * z
    y = (rows + 0.5 - k[1, 2]) / k[1, 1] * z
    return (torch.stack([x, y, z], dim=1) - view[:3, 3]) @ view[:3, :3]


def strongest_match(points: Float[Tensor, "n 3"], weights: Float[Tensor, " n"], gap: float) -> Box:
    """Box of the connected points with the largest total weight; gaps of about `gap` (world units) divide."""
    cells, cell_of = (points / gap).floor().long().unique(dim=0, return_inverse=True)
    group = _connected(cells)[cell_of.cpu()].to(points.device)
    totals = torch.zeros(int(group.max()) + 1, dtype=weights.dtype, device=points.device)
    totals.index_add_(0, group, weights)
    chosen = points[group == totals.argmax()].double()
    low, high = (_quantile(chosen, q) for q in (_OUTLIERS, 1 - _OUTLIERS))
    return Box(tuple(low.tolist()), tuple(high.tolist()), float(totals.max() / totals.sum()))  # type: ignore[arg-type]


def _quantile(points: Float[Tensor, "n 3"], q: float) -> Float[Tensor, "3"]:
    """Quantile along each axis; torch.quantile takes at most 16 million values."""
    return points.sort(dim=0).values[round(q * (len(points) - 1))]


def _connected(cells: Int[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Group of every cell; cells that touch, even at a corner, are in one group."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    cells = cells.cpu() - cells.amin(0).cpu() + 1
    strides = torch.tensor([1, 0, 0])
    strides[1] = cells[:, 0].max() + 2
    strides[2] = strides[1] * (cells[:, 1].max() + 2)
    keys, order = (cells * strides).sum(1).sort()
    sources, targets = [], []
    for step in list(product((-1, 0, 1), repeat=3))[14:]:  # half of the neighbors: the rest is symmetric
        wanted = keys + (torch.tensor(step) * strides).sum()
        place = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
        touching = keys[place] == wanted
        sources.append(order[touching])
        targets.append(order[place[touching]])
    rows, columns = torch.cat(sources).numpy(), torch.cat(targets).numpy()
    graph = coo_matrix(([1] * len(rows), (rows, columns)), shape=(len(cells),) * 2)
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long()
