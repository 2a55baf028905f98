"""Things out of pieces: pieces of several views that share Gaussians are one thing."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from lang3dxl_ns.things.pieces import Piece
from lang3dxl_ns.things.thing import Box

AGREED = 0.6
"""Intersection over union, by weight and of what both photos show, from which two pieces show the same."""
PARTLY = 0.3
"""Share of a piece's weight that another photo must show to agree with it."""
SHARED = 0.35
"""Share of a piece's weight, or of a thing's, from which the two show the same."""
SPLINTER = 0.25
"""Share of a thing's weight below which a piece of it is too small to confirm it."""
VIEWS = 2
"""Number of views that must show a thing: what a single one shows may be a smear."""
CRUMB = 0.03
"""Weight, relative to the typical thing's (half of all weight is in heavier ones), below which a thing is a
crumb of another, unless many views show it."""
OFTEN = 5
"""Number of views that show a thing from which it is no crumb, however small: a pinnacle beside a spire."""
OVER = 0.4
"""Level distance of two things, relative to their summed widths, up to which one stands over the other."""
OVERLAP = 0.05
"""Intersection over union of two boxes from which they hold sides of one thing."""
SLIM = 4.0
"""Height, relative to its width, from which a thing is one with what stands on or below it."""
STRAIGHT = 1.5
"""Distance of the two from one plumb line, relative to the slim one's width, up to which they are one."""
LIGHT_PART = 0.1
"""Weight, relative to a thing's, below which what lies over or under it is its part: a tower's foot below a
tree."""
ROUND = 0.5
"""Depth, relative to its width, from which a thing is one with what crowns it: a dome with its lantern."""
CROWN = 0.5, 0.3
"""Width of what crowns a thing, and its distance from the middle, relative to the thing's width, at most."""


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


def agreement(
    pieces: Sequence[Piece], weight: Float[Array, " n"], shown: Mapping[str, Int[Array, " m"]]
) -> Callable[[int], bool]:
    """Return a function that tells of a piece, by its number, whether a piece of another photo shows the same
    as far as both photos show it. Heat that breaks in two in a single photo does not make two things.
    `weight`: of each Gaussian, 0 and above; `shown`: the Gaussians that each photo shows."""
    numbers = {name: i for i, name in enumerate(shown)}
    photo = np.array([numbers[piece.photo] for piece in pieces], int)
    showing = _table([*shown.values()], len(weight))
    holding = _table([piece.rows for piece in pieces], len(weight))

    def seen(number: int) -> Float[Array, " v"]:
        """Weigh what each photo shows of a piece."""
        rows = pieces[number].rows
        return showing[:, rows] @ weight[rows]

    def agrees(number: int) -> bool:
        rows = pieces[number].rows
        common, own = holding[:, rows] @ weight[rows], seen(number)[photo]
        likely = (own >= PARTLY * weight[rows].sum()) & (common >= AGREED * own) & (photo != photo[number])
        return any(
            common[i] >= AGREED * (own[i] + seen(i)[photo[number]] - common[i])
            for i in np.flatnonzero(likely).tolist()
        )

    return agrees


def _table(lists: Sequence[Int[Array, " m"]], count: int) -> csc_matrix:
    """Return a sparse matrix with a one for each Gaussian, of `count`, that each list holds."""
    ends, rows = np.cumsum([0, *map(len, lists)]), np.concatenate([*lists, []]).astype(int)
    return csr_matrix((np.ones(len(rows)), rows, ends), (len(lists), count)).tocsc()


def join(
    pieces: Sequence[Piece],
    weight: Float[Array, " n"],
    box: Callable[[Joined], Box],
    shown: Mapping[str, Int[Array, " m"]],
) -> list[Joined]:
    """Join the pieces of all views, from the finest resolution to the coarsest.

    A piece founds a thing if its Gaussians are mostly free and a piece of another photo shows the same. It
    confirms the thing that it shares most with, and says nothing if it covers several things, which finer
    views told apart, or if it is cut off and new. A thing is one with the heavier one that most photos cover
    together with it (two sides of a tower), unless a photo shows each alone, or shows both in two pieces and
    neither stands over the other (a spire and a pinnacle).

    Args:
        pieces: of all views, found by `pieces_of`.
        weight: of each Gaussian, 0 and above.
        box: function that finds a thing's box.
        shown: the Gaussians that each photo shows.
    """
    owner, things = np.full(len(weight), -1), list[Joined]()
    # Photos that show a thing, and those that show two in one piece.
    seen = defaultdict[tuple[int, ...], set[str]](set)
    agrees = agreement(pieces, weight, shown)
    for number, piece in sorted(enumerate(pieces), key=lambda one: (one[1].cut, -one[1].resolution)):
        owners, weights = owner[piece.rows], weight[piece.rows]
        owned, total = owners >= 0, weights.sum()
        if total <= 0:
            continue
        shared = np.bincount(owners[owned], weights[owned], minlength=len(things))
        shares = shared / np.array([thing.weight for thing in things])
        covered = np.flatnonzero(shares > SHARED).tolist()
        single, nearest = len(covered) < 2, int(shared.argmax()) if things else -1
        same = things and single and (shared[nearest] > SHARED * total or shares[nearest] > SHARED)
        confirms = same and (shares[nearest] > SHARED or (not piece.cut and shares[nearest] >= SPLINTER))
        free = single and not same and shared.sum() <= SHARED * total
        if confirms:
            things[nearest].votes.append(piece)
            covered = [nearest]
        elif free and not piece.cut and agrees(number):
            rows = piece.rows[~owned]
            owner[rows], covered = len(things), [len(things)]
            things.append(Joined(rows, float(weight[rows].sum()), [piece]))
        for some in (*combinations(covered, 1), *combinations(covered, 2)):
            seen[some].add(piece.photo)
    return [thing for thing in _united(things, seen, box) if len(thing.rows) > 1]


def _united(
    things: Sequence[Joined], seen: Mapping[tuple[int, ...], set[str]], box: Callable[[Joined], Box]
) -> list[Joined]:
    alone = [{piece.photo for piece in thing.votes} for thing in things]
    best: dict[int, tuple[int, int]] = {}
    # One partner each: crumbs between two towers would otherwise make one of them.
    for pair, photos in sorted(item for item in seen.items() if len(item[0]) == 2):
        heavy, light = sorted(pair, key=lambda i: (-things[i].weight, i))
        if not alone[heavy] & alone[light] and len(photos) > best.get(light, (0, 0))[0]:
            best[light] = len(photos), heavy
    pairs = [(light, heavy) for light, (_, heavy) in best.items()]
    never_apart = [(a, b) for a, b in pairs if seen[a,] & seen[b,] <= seen[min(a, b), max(a, b)]]
    group = _groups(len(things), never_apart)
    boxes = [box(one) for one in _grouped(things, group)]
    pairs = [(a, b) for a, b in pairs if _over(boxes[group[a]], boxes[group[b]])]
    return _grouped(things, _groups(len(things), pairs))


def _over(one: Box, other: Box) -> bool:
    (center, axes, size), (place, _, extent) = one, other
    return bool((abs(axes @ (center - place)) <= OVER * (size + extent))[:2].all())


def grown(things: Sequence[Joined], count: int) -> list[Joined]:
    """Give each of `count` Gaussians to the thing of which most pieces show it, at least two, where the one
    that founded a thing counts twice: other sides of a dome join the one that was seen first."""
    owner, most = np.full(count, -1), np.ones(count, int)
    for i, thing in enumerate(things):
        rows, times = np.unique(
            np.concatenate([thing.rows, *(p.rows for p in thing.votes)]), return_counts=True
        )
        rows, times = rows[times > most[rows]], times[times > most[rows]]
        owner[rows], most[rows] = i, times
    order = owner.argsort(kind="stable")
    ends = np.searchsorted(owner[order], np.arange(len(things) + 1))
    parts = zip(things, pairwise(ends), strict=True)
    return [replace(one, rows=order[a:b]) for one, (a, b) in parts if b > a + 1]


def parted(
    things: Sequence[Joined], level: Float[Array, "n 2"], weight: Float[Array, " n"], space: float
) -> list[Joined]:
    """Split off each part of a thing that an empty strip wider than `space` along a level axis separates from
    all else, and that is no wider itself: pinnacles whose heat touches in every photo. A piece shows the
    parts of which it shows enough. `level`: each Gaussian's place along two level axes, world units;
    `weight`: of each Gaussian, 0 and above."""
    found = list[Joined]()
    for thing in things:
        places = level[thing.rows]
        order = places.argsort(axis=0)
        steps = np.diff(np.take_along_axis(places, order, 0), axis=0, prepend=-np.inf) > space
        strips = np.take_along_axis(steps.cumsum(0), order.argsort(axis=0), 0)
        group = np.unique(strips, axis=0, return_inverse=True)[1].ravel()
        wide = [np.ptp(places[group == number], axis=0).max() > space for number in range(group.max() + 1)]
        group[np.array(wide)[group]] = -1  # wide parts stay together: sides of a dome
        if len(np.unique(group)) == 1:
            found.append(thing)
            continue
        for rows in (thing.rows[group == number] for number in np.unique(group)):
            total = float(weight[rows].sum())
            shown = [(piece, weight[piece.rows[np.isin(piece.rows, rows)]].sum()) for piece in thing.votes]
            votes = [piece for piece, share in shown if share > SHARED * total]
            found += [Joined(rows, total, votes)] if len(rows) > 1 and votes else []
    return found


def placed(things: Sequence[Joined], boxes: Sequence[Box]) -> list[Joined]:
    """Unite things whose boxes overlap, slim things with what stands on or below them (a minaret's shaft, its
    balcony and its tip), things with what is far lighter over or below them, and deep things with what crowns
    them. `boxes` are the things' upright boxes."""
    pairs, weights = list[tuple[int, int]](), np.array([one.weight for one in things])
    centers, extents = (np.array([box[part] for box in boxes]).reshape(-1, 3) for part in (0, 2))
    for a, (center, axes, size) in enumerate(boxes):
        wide, apart, high = size[:2].max(), abs((centers - center) @ axes.T), (centers - center) @ axes[2]
        common = np.minimum((size + extents) / 2 - apart, np.minimum(size, extents)).clip(0).prod(1)
        overlap = common > OVERLAP * (size.prod() + extents.prod(1) - common)
        near = apart[:, 2] - (size[2] + extents[:, 2]) / 2 < size[2]
        slim = (size[2] >= SLIM * wide) & (np.hypot(apart[:, 0], apart[:, 1]) < STRAIGHT * wide)
        part = (apart[:, :2] < size[:2] / 2).all(1) & (weights < LIGHT_PART * weights[a])
        small = (extents[:, :2].max(1) < CROWN[0] * wide) & (apart[:, :2].max(1) < CROWN[1] * wide)
        crown = small & (size[:2].min() > ROUND * wide) & (high > 0)
        found = np.flatnonzero(overlap | (near & (slim | part | crown))).tolist()
        pairs += [(a, b) for b in found if b != a]
    return _grouped(things, _groups(len(things), pairs))


def _groups(count: int, pairs: Sequence[tuple[int, int]]) -> Int[Array, " n"]:
    ends = np.array(pairs).reshape(-1, 2).T.astype(int)
    graph = coo_matrix((np.ones(ends.shape[1]), (ends[0], ends[1])), (count, count))
    return connected_components(graph, directed=False)[1] if count else np.zeros(0, int)


def _grouped(things: Sequence[Joined], group: Int[Array, " n"]) -> list[Joined]:
    parts = ([things[i] for i in np.flatnonzero(group == number)] for number in np.unique(group))
    return [Joined(np.concatenate([one.rows for one in of]), sum(one.weight for one in of),
                   [piece for one in of for piece in one.votes]) for of in parts]  # fmt: skip


def without_crumbs(things: Sequence[Joined]) -> list[Joined]:
    """Leave out the things that weigh far less than the typical one and that few views show."""
    weights = np.sort([thing.weight for thing in things])[::-1]
    if not len(weights):
        return []
    typical = weights[np.searchsorted(weights.cumsum(), weights.sum() / 2)]
    return [thing for thing in things if thing.weight >= CRUMB * typical or thing.views >= OFTEN]
