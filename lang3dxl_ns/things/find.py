"""`things_of`: the things of a scene that words name, how many there are, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.doubt import peaks
from lang3dxl_ns.query.negatives import singulars
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.query.text import Prompt, caution
from lang3dxl_ns.query.trust import FAR
from lang3dxl_ns.query.vocabulary import searched, shipped_vocabulary, singular
from lang3dxl_ns.rendering import composite, harmonics_of
from lang3dxl_ns.scene.camera import projected
from lang3dxl_ns.things.join import VIEWS, Joined, grown, join, parted, placed, without_crumbs
from lang3dxl_ns.things.pieces import FILLED, LEVELS, Piece, Shown, pieces_of
from lang3dxl_ns.things.thing import Box, Sighting, Thing, upright_box

COLORED = 20
"""Number of Gaussians within and around the matches below which colors tell nothing."""
SAMPLED = 50_000
"""Number of Gaussians, each of matches and of others, from which only every second one tells colors."""
PAIRED, NEIGHBORS = 1_000, 3.0
"""Number of Gaussians, about, whose directions from each other tell where walls run, and their largest
distance, relative to the gap between groups."""
APART = 1.5
"""Space around a part of a thing, relative to the gap between groups, from which it is a thing of its own."""
HEIGHTS = 0.01, 0.9995
"""Shares of a landmark's Gaussians that lie below the ground, and below its top."""
UPRIGHT = 0.5
"""Length of the mean of the cameras' vectors to the top of their pictures below which that is no up."""
SURE = 0.6
"""Number of views, relative to the typical thing's, above which a thing is sure."""
MISSED = 1.4
"""Likely number of things for each one found, at most: what few photos show is missed. So ranges of windows
hold on six of eight validation landmarks."""
PRESENT = 0.9
"""Relevancy that a thing's best Gaussian reaches; one that stays below it is a candidate. On eight validation
landmarks 8 of 511 true things stay below (all windows), and 25 of 74 false ones."""
CLEARLY = math.log(PRESENT / (1 - PRESENT))
"""Margin, at the relevancy's temperature, at which a word has that relevancy against another one."""
TOLD = 1_000
"""Number of a thing's Gaussians, about, that tell which word fits it best."""


@dataclass(frozen=True, eq=False)
class Things:
    """The things that one word finds."""

    word: str
    things: list[Thing]
    """The heaviest first; its place in this list is a thing's number."""
    candidates: list[Thing] = field(default_factory=list)
    """Further things, perhaps: those that a single photo shows, and small ones."""
    caution: str | None = None
    """Why the answer is doubtful, or counts are; None if neither is."""

    @property
    def sure(self) -> list[Thing]:
        """Those of the things that three or more photos show, and over .6 as many as show the typical one."""
        often = max(VIEWS, SURE * float(np.median([thing.views for thing in self.things] or [0])))
        return [thing for thing in self.things if thing.views > often]

    @property
    def least(self) -> int:
        """Lowest number of things that is likely."""
        return len(self.sure)

    @property
    def most(self) -> int:
        """Highest number of things that is likely."""
        return max(len(self.things) + len(self.candidates), int(MISSED * len(self.things)))

    @property
    def count(self) -> str:
        """How many there are, such as "34, perhaps 31 to 37"."""
        sure = f"{len(self.things)}"
        return sure if self.least == self.most else f"{sure}, perhaps {self.least} to {self.most}"


def things_of(scene: Answering, question: Question) -> list[Things]:
    """Find the single things that each prompt of a question to the scene names.

    Every training view's heat map falls into pieces (`pieces_of`), and pieces of several views are one thing
    where they share Gaussians (`join`). Where a prompt's colors (in the page's light) differ from the others,
    they separate neighbors: the wall between two windows that CLIP sees as one.
    """
    question = _in_singular(scene, question)
    colors = harmonics_of(scene.baked().colors(scene.overview.camera.position).clamp(0, 1))[:, 0]
    colors = colors.nan_to_num()  # of Gaussians that lie nowhere
    sharp = [_sharpened(scene, relevancy, colors.cpu().numpy()) for relevancy in question.relevancy]
    peak = peaks(question.relevancy).tolist()  # a word below the lowest level names nothing here
    pieces: list[list[Piece]] = [[] for _ in sharp]
    shown = dict[str, Int[Array, " m"]]()
    for views in _views(scene, torch.stack(sharp, 1)):
        for found, view, best in zip(pieces, views, peak, strict=True):
            shown[view.photo] = view.rows
            found += pieces_of(view) if best > LEVELS[0] else []
    axes = axes_of(scene)
    return [_answer(scene, question, row, own, shown, axes) for row, own in enumerate(pieces)]


def _answer(
    scene: Answering,
    question: Question,
    row: int,
    pieces: Sequence[Piece],
    shown: Mapping[str, Int[Array, " m"]],
    axes: Float[Array, "3 3"],
) -> Things:
    """Find the things of the question's prompt in a row. `shown`: the Gaussians that each photo shows;
    `axes`: directions of all boxes' edges."""
    prompt, values = question.prompts[row], question.relevancy[row].double().cpu().numpy()
    mass, means = scene.mass.double().cpu().numpy(), scene.splats.means.double().cpu().numpy()
    weight = np.sqrt(mass) * values

    def box(one: Joined) -> Box:
        return upright_box(means[one.rows], weight[one.rows], axes)

    whole = grown(join(pieces, weight, box, shown), len(weight))
    parts = parted(whole, means @ axes[:2].T, weight, APART * scene.gap)
    joined = sorted(placed(parts, [box(part) for part in parts]), key=lambda one: -one.weight)
    seen = [one for one in without_crumbs(joined) if one.views >= VIEWS]
    sure = [one for one in seen if prompt.taught or values[one.rows].max() >= PRESENT]
    better = {} if prompt.taught else better_words(scene, prompt, sure, (weight * values) ** 2)
    sure = [one for one in sure if one not in better]
    rest = [one for one in joined if one not in sure]
    things, candidates = (
        [_thing(prompt.name, one, box(one), mass, values) for one in some] for some in (sure, rest)
    )
    instead = next(iter(better.values()), None) if not things else None
    return Things(prompt.name, things, candidates, _caution(scene, question, row, instead))


def _caution(scene: Answering, question: Question, row: int, instead: str | None) -> str | None:
    """Say why the answer to a prompt is doubtful, or counts are, what helps, and what is not used of the
    prompt; None if nothing is to say. `instead`: the word that all that was found fits better; None if some
    of it fits the prompt."""
    prompt, trust = question.prompts[row], question.trusts[row]
    shown_in = sum(len(view.rows) > 0 for view in scene.visible.values())
    far = (scene.foreignness or 0) >= FAR and prompt.taught is None
    told: list[str | None] = [trust.reason, trust.remedy] if far or trust.level != "sure" else []
    if instead is not None:
        told = [f"what was found fits {instead!r} better"]
    if shown_in < VIEWS:
        shows = "one training photo shows" if shown_in else "no training photo shows"
        told = [f"{shows} the scene, and a thing is what two show"]
    told += [] if prompt.taught else [caution(prompt.text, counted=True)]
    return "; ".join(filter(None, told)) or None


def _in_singular(scene: Answering, question: Question) -> Question:
    """Return the question with relevancies to nouns in the singular, since each thing is one: *towers* also
    fits what is a part of some. So *tower* and *towers* find the same."""
    prompts = [
        prompt if prompt.taught or prompt.vector is not None else replace(prompt, text=singular(prompt.text))
        for prompt in question.prompts
    ]
    if prompts == [*question.prompts]:
        return question
    own = scene.engine.of_gaussians(scene.queries(prompts))
    return replace(question, everywhere=torch.cat([own, question.everywhere[len(prompts) :]]))


def better_words(
    scene: Answering, prompt: Prompt, things: Sequence[Joined], weight: Float[Array, " n"]
) -> dict[Joined, str]:
    """Return the common word for each thing that its mean feature fits clearly better than it fits the prompt
    and the common words in that (*dark windows* has *window*); none for the others. Few phrases compete in
    heat maps, and a word that the scene doubts is found by its synonyms: so *minarets* finds a cathedral's
    towers. `weight`: of each Gaussian, 0 and above."""
    text, words, better = searched(prompt.text), shipped_vocabulary(), dict[Joined, str]()
    if not things:
        return better  # before a CLIP encodes the words
    forms = {form for word in text.lower().split() for form in singulars(word)}
    named = [i for i, word in enumerate(words) if forms >= {*word.split()}]
    own = scene.text.vectors([text]) if prompt.vector is None else prompt.vector[None]
    common = scene.text.vectors(words).to(own)
    vectors = torch.cat([common, own, common[named]]).to(scene.device)
    for one in things:
        rows = torch.from_numpy(one.rows[:: 1 + len(one.rows) // TOLD])
        features = scene.engine.features(rows.to(scene.device)).to(vectors)
        mean = F.normalize(torch.from_numpy(weight[rows]).to(features) @ features, dim=0)
        fits, mine = (scene.engine.temperature * (vectors @ mean)).split([len(words), 1 + len(named)])
        close = fits > fits.max() - CLEARLY
        if fits.max() - mine.max() > CLEARLY:
            better[one] = words[int(close.int().argmax())]  # the most common: *tower*, not *campanile*
    return better


def up_of(scene: Answering) -> Float[Array, "3"]:
    """Return the unit vector that points up: where photos tell it, theirs; otherwise the cameras' mean."""
    told = scene.file.georeference
    up = np.array([photo.camera_to_world for photo in scene.photos])[:, :, 1].mean(0)
    up = up if told is None else np.asarray(told.up, dtype=np.float64)
    return up / max(np.linalg.norm(up), 1e-9)


def is_upright(scene: Answering) -> bool:
    """Return whether the cameras agree on up: where they look down from all sides, theirs cancel."""
    mean = np.array([photo.camera_to_world for photo in scene.photos]).mean(0)
    return bool(np.linalg.norm(mean[:, 1]) >= UPRIGHT)


def heights_of(scene: Answering) -> Float[Array, "2"]:
    """Measure how high the ground and the landmark's top lie along `up_of`, world units, by what photos show
    within twice the distance from the middle that three quarters of it have."""
    places = scene.splats.means[scene.splats.sound() & (scene.mass > 0)].double().cpu().numpy()
    if not len(places):
        return np.array([0.0, 1.0])
    apart = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return np.quantile(places[apart <= 2 * np.quantile(apart, 0.75)] @ up_of(scene), HEIGHTS)


def axes_of(scene: Answering) -> Float[Array, "3 3"]:
    """Return the directions of all boxes' edges, one a row: along the walls, across them, and up. Walls
    seen from above are lines, a quarter turn apart: Gaussians on one lie in its direction from each other."""
    up = up_of(scene)
    plane = np.linalg.svd(up[None])[2][1:]
    heavy = (scene.mass > scene.mass.median() / 2).nonzero()[:, 0]
    points = scene.splats.means[heavy[:: 1 + len(heavy) // PAIRED]].double().cpu().numpy()
    apart = (points[:, None] - points).reshape(-1, 3)
    way = apart[np.linalg.norm(apart, axis=1) < NEIGHBORS * scene.gap] @ plane.T @ (1, 1j)
    turn = np.angle((way**4 / np.maximum(abs(way), 1e-9) ** 3).sum()) / 4  # the same for a quarter turn
    along = (np.cos(turn), np.sin(turn)) @ plane
    return np.stack([along, np.cross(up, along), up])


def _sharpened(scene: Answering, relevancy: Float[Tensor, " n"], colors: Array) -> Float[Tensor, " n"]:
    """Multiply relevancies by how much a Gaussian's color is that of the matches, not of what is around."""
    from scipy.spatial import KDTree
    from sklearn.linear_model import LogisticRegression  # imported here, since the import takes a second

    means, values, mass = scene.splats.means.cpu().numpy(), relevancy.cpu().numpy(), scene.mass.cpu().numpy()
    sides = (np.flatnonzero(side & (mass > 0)) for side in (values > 0.9, values < 0.5))
    match, around = (rows[:: 1 + len(rows) // SAMPLED] for rows in sides)
    if len(match) < COLORED:
        return relevancy
    distance, _ = KDTree(means[match]).query(means[around], distance_upper_bound=scene.gap)
    around = around[np.isfinite(distance)]
    if len(around) < COLORED:
        return relevancy
    rows = np.concatenate([match, around])
    weight = np.sqrt(mass[rows]) * len(rows) / 2
    weight[: len(match)] /= np.sqrt(mass[match]).sum()
    weight[len(match) :] /= np.sqrt(mass[around]).sum()
    matches = np.arange(len(rows)) < len(match)
    model = LogisticRegression(C=10).fit(colors[rows], matches, sample_weight=weight)
    return relevancy * torch.from_numpy(model.predict_proba(colors)[:, 1]).to(relevancy)


@torch.no_grad()
def _views(scene: Answering, heat: Float[Tensor, "n q"]) -> Iterator[list[Shown]]:
    """Render each training view's heat maps at the size that it was trained at."""
    for name, view in scene.visible.items():
        photo = scene.file.photo(name)
        camera = photo.camera
        points = projected(camera, scene.splats.means)
        lit = torch.cat([heat.to(points), torch.ones_like(points[:, 2:])], 1)
        drawn = composite(scene.splats, camera, torch.cat([lit, lit * points[:, 2:]], 1))
        maps, depths = np.split(np.moveaxis(drawn.cpu().numpy(), 2, 0), 2)
        inside = photo.foreground((camera.height, camera.width))
        keep = 1.0 if inside is None else inside.numpy()
        rows = view.rows[view.pixels >= FILLED].long()
        shown, numbers, focal = points[rows].cpu().numpy(), rows.cpu().numpy(), float(camera.intrinsics[0, 0])
        *matched, surface = depths / np.maximum(maps, 1e-4)
        yield [
            Shown(name, one, surface, depth, numbers, shown, focal)
            for one, depth in zip(maps[:-1] * keep, matched, strict=True)
        ]


def _thing(
    word: str, one: Joined, box: Box, mass: Float[Array, " n"], relevancy: Float[Array, " n"]
) -> Thing:
    rows, best = one.rows, dict[str, Piece]()
    for piece in sorted(one.votes, key=lambda piece: (piece.cut, -piece.area)):
        best.setdefault(piece.photo, piece)
    score = float(np.average(relevancy[rows], weights=np.maximum(mass[rows], 1e-9)))
    sightings = [Sighting(name, piece.box) for name, piece in best.items()]
    shown = np.bincount(np.concatenate([piece.rows for piece in one.votes]), minlength=len(mass))
    strongest = (mass * shown * relevancy**2)[rows].argmax()
    return Thing(int(rows[strongest]), word, score, one.views, *box, rows, sightings)
