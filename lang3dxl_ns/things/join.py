"""Things out of pieces: pieces of several views that share Gaussians are one thing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lang3dxl_ns.things.pieces import Piece
from lang3dxl_ns.things.thing import Box

SHARED = 0.35
"""Share of a piece's weight, or of a thing's, from which the two show the same."""
SPLINTER = 0.25
"""Share of a thing's weight below which a piece of it is too small to confirm it."""
VIEWS = 2
"""Number of views that must show a thing: what a single one shows may be a smear."""
CRUMB = 0.03
"""Weight, relative to the typical thing's (half of all weight is in heavier ones), below which a thing is a
crumb of another, unless many views show it."""
OFTEN = 8
"""Number of views that show a thing from which it is no crumb, however small: a pinnacle beside a spire."""
SLIM = 4.0
"""Height, relative to its width, from which a thing is one with what stands on or below it."""
STRAIGHT = 1.5
"""Distance of the two from one plumb line, relative to the slim one's width, up to which they are one."""
MOST_SHARED = 0.5
"""Share of a piece's weight that may belong to known things if it is to be a new one."""


@dataclass(eq=False)
class Joined:
    """A thing in the making."""

    rows: Int[Array, " m"]
    """Indices of its Gaussians."""
    weight: float
    votes: list[Piece] = field(default_factory=list)
    """Pieces that show it alone, finest first."""

    @property
    def views(self) -> int:
        """Number of views that show it."""
        return len({piece.photo for piece in self.votes})


def join(pieces: Sequence[Piece], weight: Float[Array, " n"]) -> list[Joined]:
    """Join the pieces of all views, from the finest resolution to the coarsest.

    A piece founds a thing if its Gaussians are mostly free, confirms the thing that it shares most with, and
    says nothing if it covers several things (a coarse view joins neighbors that a fine one tells apart), or
    if it is cut off and new. Things that some piece covers together, and no photo shows apart, are one: two
    sides of a tower. `weight` is each Gaussian's weight, 0 and above.
    """
    owner, things = np.full(len(weight), -1), list[Joined]()
    together = set[tuple[int, int]]()
    for piece in sorted(pieces, key=lambda piece: (piece.cut, -piece.resolution)):
        mine, total = owner[piece.rows], weight[piece.rows].sum()
        if total <= 0:
            continue
        shared = np.bincount(mine[mine >= 0], weight[piece.rows][mine >= 0], minlength=len(things))
        of_things = shared / np.array([thing.weight for thing in things]) if things else shared
        covered = np.flatnonzero(of_things > SHARED).tolist()
        if len(covered) > 1:
            together.update(combinations(covered, 2))
            continue
        best = int(shared.argmax()) if things else -1
        if things and (shared[best] > SHARED * total or of_things[best] > SHARED):
            if of_things[best] >= SPLINTER and not (piece.cut and of_things[best] <= SHARED):
                things[best].votes.append(piece)
        elif not piece.cut and shared.sum() <= MOST_SHARED * total:
            rows = piece.rows[mine < 0]
            owner[rows] = len(things)
            things.append(Joined(rows, float(weight[rows].sum()), [piece]))
    return [thing for thing in _united(things, together) if len(thing.rows) > 1]


def _united(things: Sequence[Joined], together: set[tuple[int, int]]) -> list[Joined]:
    photos = [{piece.photo for piece in thing.votes} for thing in things]
    return _grouped(things, [(a, b) for a, b in sorted(together) if not photos[a] & photos[b]])


def stacked(things: Sequence[Joined], boxes: Sequence[Box]) -> list[Joined]:
    """Unite slim things with what stands on or below them: a minaret's shaft, its balcony and its tip.
    `boxes` are the things' upright boxes."""
    pairs = []
    for a, (center, axes, size) in enumerate(boxes):
        if size[2] < SLIM * size[:2].max():
            continue
        for b, (other, _, extent) in enumerate(boxes):
            aside, high = np.linalg.norm(axes[:2] @ (other - center)), abs(axes[2] @ (other - center))
            if a != b and aside < STRAIGHT * size[:2].max() and high < 1.5 * size[2] + extent[2] / 2:
                pairs.append((a, b))
    return _grouped(things, pairs)


def _grouped(things: Sequence[Joined], pairs: Sequence[tuple[int, int]]) -> list[Joined]:
    ends = np.array(pairs).reshape(-1, 2).T.astype(int)
    graph = coo_matrix((np.ones(ends.shape[1]), (ends[0], ends[1])), (len(things), len(things)))
    count, group = connected_components(graph, directed=False) if things else (0, np.zeros(0))
    parts = ([things[i] for i in np.flatnonzero(group == number)] for number in range(count))
    return [Joined(np.concatenate([one.rows for one in of]), sum(one.weight for one in of),
                   [piece for one in of for piece in one.votes]) for of in parts]  # fmt: skip


def without_crumbs(things: Sequence[Joined]) -> list[Joined]:
    """Leave out the things that weigh far less than the typical one and that few views show."""
    weights = np.sort([thing.weight for thing in things])[::-1]
    if not len(weights):
        return []
    typical = weights[np.searchsorted(weights.cumsum(), weights.sum() / 2)]
    return [thing for thing in things if thing.weight >= CRUMB * typical or thing.views >= OFTEN]
