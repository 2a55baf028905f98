"""Learning of a word from marks: a direction in CLIP's space, from the Gaussians that the marks show.

A word is a linear score of unit CLIP features, fitted by logistic regression to the Gaussians that the marked
pixels show. The text's own relevancy joins it, with a weight for how well that separates the marked from the
rest; see docs/teach.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.rendering import Splats, composite
from lang3dxl_ns.rendering.gathering import filled_parts
from lang3dxl_ns.scene.camera import resized
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.words.taught_words import MASK_SIDE, Example, TaughtWord

MARK_SIDE = 320
"""Longer side in pixels of the views in which marks are gathered."""
_REACH = 0.01
"""Radius of a click, as a fraction of the photo's longer side."""
_ROWS = 20_000
"""Most Gaussians of the word, and of the rest, that are fitted; of more, every k-th one is used."""
_AXES = 64
"""Number of principal components of the scene's features in which a word is fitted."""
_TYPICAL = 4096
"""Number of evenly spaced known Gaussians from which the components are computed."""
_LEAST_SPREAD = 1e-3
"""Smallest spread of a coordinate that takes part, relative to the largest spread."""
_RIDGE, _LEAST_RIDGE = 0.3, 0.01
"""Penalty of the squared coefficients, per standardized coordinate: after one click, and its lower bound."""
_UP = 0.6
"""Position of a word's threshold between the mean score of a clicked photo (0) and that of the clicks (1)."""
_GAIN = 1.5
"""Weight of a text whose average precision is 1."""
_TRUST = 3
"""Number of clicks that the prior trust in a word's text is worth."""


@dataclass(frozen=True)
class Weights:
    """Pixels that each Gaussian fills in an example's photo: of the word, of what is marked as other, all."""

    word: Float[Tensor, " n"]
    other: Float[Tensor, " n"]
    seen: Float[Tensor, " n"]

    @classmethod
    def of(cls, example: Example, photo: ScenePhoto, splats: Splats) -> Weights:
        """Measure what an example marks in its photo's foreground. Raises UserError for marks outside it."""
        camera = resized(photo.full_camera, MARK_SIDE)
        size = (camera.height, camera.width)
        foreground = photo.foreground(size)
        shown = torch.ones(size) if foreground is None else foreground.float()
        pixels = torch.cat([_marks(example, photo, size) * shown, shown[None]]).permute(1, 2, 0)
        drawn = partial(composite, splats, camera)
        parts = filled_parts(drawn, pixels.to(splats.means.device), len(splats))
        return cls(*parts.unbind(1))

    @property
    def rest(self) -> Float[Tensor, " n"]:
        """Shares of what is not the word. Pixels marked as something else weigh as much as all others, and
        count alone where nothing is marked as the word, which may be among the others."""
        rest = (self.seen - self.word).clamp_min(0).double()
        rest, marked = rest / rest.sum().clamp_min(1e-12), self.other.double()
        if float(self.word.sum()) <= 0:
            return marked / marked.sum()
        return rest if float(marked.sum()) <= 0 else 0.5 * (rest + marked / marked.sum())


def learn(
    name: str, examples: Sequence[Example], weights: Sequence[Weights], engine: QueryEngine, queries: Queries
) -> TaughtWord:
    """Learn a word from examples, whose order doesn't matter, from what the marks of each show, and from the
    query of the word's text, without synonyms. Raises UserError if there is no example, or the marks show
    nothing, or everything."""
    if not any(example.shows_word for example in examples):
        raise UserError(f"there is no example of {name!r}: mark it in a photo")
    for example, one in zip(examples, weights, strict=True):
        marks = one.word + one.other * (not example.shows_word)
        marked, everything = float(marks.sum()), float(one.seen.sum())
        if marked <= 1e-6 * max(everything, 1.0):
            trouble = "lie where the scene shows nothing, or cancel out"
            raise UserError(f"the marks of {name!r} in {example.photo} {trouble}")
        if example.shows_word and marked >= 0.98 * everything:
            raise UserError(f"the marks of {name!r} cover all of {example.photo}: mark only the object")
    rows, photos = _sampled(examples, weights)
    sample = engine.features(rows).double()
    # Margin of the text: the cosine minus the best competitor's.
    text = queries.relevancy_of_cosines(queries.cosines(sample.float()), 1.0)[0].logit().double()
    known = engine.known.nonzero().squeeze(1)
    if not len(known):
        raise UserError(f"{name!r} can't be learned: no photo gave a Gaussian of this scene a meaning")
    spaced = torch.linspace(0, len(known) - 1, _TYPICAL, dtype=torch.float64).long()
    axes = _axes(engine.features(known[spaced.to(known.device)]).double(), engine.head)
    fit = partial(_fitted, name, sample, text, axes, engine.temperature)
    word = fit(photos)
    # Each photo is judged by a word that the others teach.
    complete = {photo.name: photo for photo in photos if photo.complete}
    others = {name: [photo for photo in photos if photo.name != name] for name in complete}
    judges = {name: fit(some) if any(p.shows_word for p in some) else word for name, some in others.items()}
    precision = {  # where a click is all that is known, the rest of the thing would count as an error
        name: photo.precision(judges[name].margins(sample, text)) for name, photo in complete.items()
    }
    doubt = fmean(1 - p.separation(word.margins(sample, text)) for p in photos if p.shows_word)
    return replace(word, doubt=doubt, precision=precision, examples=tuple(examples))


@dataclass(frozen=True)
class _Photo:
    """Weights of the sampled Gaussians in one marked photo."""

    name: str
    word: Float[Tensor, " m"]
    """Weights of the word; they sum to 1."""
    rest: Float[Tensor, " m"]
    """Weights of the rest; they sum to 1."""
    share: float
    """Share of the photo that is marked as the word."""
    evidence: int
    complete: bool

    @property
    def shows_word(self) -> bool:
        return self.share > 0

    def precision(self, score: Float[Tensor, " m"]) -> float:
        """Compute a score's average precision, with Gaussians weighted by the pixels that they fill."""
        from sklearn.metrics import average_precision_score

        rest = (1 - self.share) * self.rest
        labels, scores, weights = _labeled(score, self.share * self.word, rest)
        return average_precision_score(labels, scores, sample_weight=weights)

    def separation(self, score: Float[Tensor, " m"]) -> float:
        """Compute the probability that the word scores above the rest; ties count half."""
        from sklearn.metrics import roc_auc_score

        labels, scores, weights = _labeled(score, self.word, self.rest)
        return roc_auc_score(labels, scores, sample_weight=weights)


def _labeled(
    values: Float[Tensor, "m ..."], word: Float[Tensor, " m"], rest: Float[Tensor, " m"]
) -> tuple[Float[Array, " k"], Float[Array, "k ..."], Float[Array, " k"]]:
    """Return labels, values and weights for scikit-learn: every Gaussian as word (1) and as rest (0)."""
    labels = torch.cat([torch.ones_like(word), torch.zeros_like(rest)])
    weights = torch.cat([word, rest])
    found = [part[weights > 0].cpu().numpy() for part in (labels, torch.cat([values, values]), weights)]
    return found[0], found[1], found[2]


def _sampled(
    examples: Sequence[Example], weights: Sequence[Weights]
) -> tuple[Int[Tensor, " m"], list[_Photo]]:
    """Choose Gaussians to fit, and their weights in every photo: evenly spaced ones of the word, then evenly
    spaced ones of the rest (a Gaussian at an edge may be in both)."""
    words = [one.word.double() / one.word.double().sum().clamp_min(1e-12) for one in weights]
    rests = [one.rest for one in weights]
    # Of each photo, since the few Gaussians of a click would be lost among those of an outline.
    most = _ROWS // len(weights)
    first, second = (torch.cat([_spaced(one, most) for one in parts]).unique() for parts in (words, rests))
    photos = []
    for example, one, word, rest in zip(examples, weights, words, rests, strict=True):
        word = F.pad(word[first], (0, len(second)))
        rest = F.pad(rest[second], (len(first), 0))
        kind = (float(one.word.sum() / one.seen.sum()), example.evidence, example.complete)
        photos.append(_Photo(example.photo, word / word.sum().clamp_min(1e-12), rest / rest.sum(), *kind))
    return torch.cat([first, second]), photos


def _spaced(weight: Float[Tensor, " n"], most: int) -> Int[Tensor, " m"]:
    rows = (weight > 1e-5 * weight.max()).nonzero().squeeze(1)
    return rows[:: math.ceil(len(rows) / most) or 1]


def _axes(
    features: Float[Tensor, "n c"], head: Float[Tensor, "k c"] | None
) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """Compute standardized coordinates of a scene's features, as an origin and a matrix, from the rows that
    span the features (None: principal components)."""
    known = features[features.abs().sum(1) > 0]
    middle = known.mean(0)
    if head is None:
        axes = torch.linalg.eigh((known - middle).T @ (known - middle)).eigenvectors[:, -_AXES:]
    else:
        axes = torch.linalg.pinv(head.to(known))
    spread = ((known - middle) @ axes).square().mean(0).sqrt()
    return middle, axes * torch.where(spread > _LEAST_SPREAD * spread.max(), 1 / spread, 0.0)


def _fitted(
    name: str,
    sample: Float[Tensor, "m c"],
    text: Float[Tensor, " m"],
    axes: tuple[Float[Tensor, " c"], Float[Tensor, "c k"]],
    temperature: float,
    photos: Sequence[_Photo],
) -> TaughtWord:
    word = torch.stack([photo.word for photo in photos if photo.shows_word]).mean(0)
    rest = torch.stack([photo.rest for photo in photos]).mean(0)
    evidence = sum(photo.evidence for photo in photos)
    middle, matrix = axes
    slope, bias = _logistic((sample - middle) @ matrix, word, rest, max(_RIDGE / evidence, _LEAST_RIDGE))
    vector = matrix @ slope / temperature
    bias = bias / temperature - float(middle @ vector)
    trust = (evidence * _trust(text, photos) + _TRUST) / (evidence + _TRUST)
    taught = TaughtWord(name, vector.float(), bias, trust, 0.5)
    return replace(taught, bias=bias - _level(taught.margins(sample, text), photos))


def _trust(text: Float[Tensor, " m"], photos: Sequence[_Photo]) -> float:
    """Compute the weight of a text from how well it separates the word from the rest: its average precision
    in photos where all of the word is marked, otherwise how far it ranks clicks above the rest."""
    complete = [photo.precision(text) for photo in photos if photo.complete]
    if complete:
        return _GAIN * fmean(complete)
    return max(fmean([2 * photo.separation(text) - 1 for photo in photos if photo.shows_word]), 0.0)


def _logistic(
    places: Float[Tensor, "m k"], word: Float[Tensor, " m"], rest: Float[Tensor, " m"], ridge: float
) -> tuple[Float[Tensor, " k"], float]:
    """Minimize ½ Σ word · softplus(−s) + ½ Σ rest · softplus(s) + ½ ridge |slope|², s = slope·x + bias."""
    from sklearn.linear_model import LogisticRegression

    labels, inputs, weights = _labeled(places, word / 2, rest / 2)
    model = LogisticRegression(C=1 / ridge, solver="newton-cholesky", tol=1e-6)
    model.fit(inputs, labels, weights)
    return torch.from_numpy(model.coef_[0]).to(places), float(model.intercept_[0])


def _level(score: Float[Tensor, " m"], photos: Sequence[_Photo]) -> float:
    """Choose the score above which the word begins: where intersection over union is best in photos whose
    marks are complete; without any, part of the way from what is not clicked to what is."""
    complete = [photo for photo in photos if photo.complete]
    if not complete:
        on = fmean([float(score @ photo.word) for photo in photos if photo.shows_word])
        return _UP * on + (1 - _UP) * fmean([float(score @ photo.rest) for photo in photos])
    order = score.argsort(descending=True, stable=True)
    overlap = torch.zeros_like(score)
    for photo in complete:
        found = photo.share * photo.word[order].cumsum(0)
        overlap += found / (photo.share + (1 - photo.share) * photo.rest[order].cumsum(0))
    falls = -score[order].diff()
    overlap[:-1][falls <= 1e-4 * falls.sum()] = 0.0  # no threshold separates equal scores
    best = min(int(overlap.argmax()), len(order) - 2)
    return 0.5 * float(score[order[best]] + score[order[best + 1]])


def _marks(example: Example, photo: ScenePhoto, size: tuple[int, int]) -> Float[Tensor, "2 h w"]:
    """Compute the share of each pixel of a view (height, width) marked as the word, and as not the word.
    Marks are drawn on the photo's file, while views are undistorted."""
    width, height = photo.file_size
    labels = photo.photo().undistort_labels(_drawn(example, width, height))
    chosen = torch.stack([labels == 1, labels == 2]).float()
    return F.interpolate(chosen[None], size, mode="area")[0]


def _drawn(example: Example, width: int, height: int) -> Int[Tensor, "h w"]:
    """Draw 1 on the word, 2 on what is not the word, 0 elsewhere, on at most `MASK_SIDE` pixels a side."""
    if example.mask is not None:
        rows, columns = example.mask.shape
        if abs(columns * height - rows * width) > 0.01 * rows * width + max(width, height):
            raise UserError(
                f"the mask of {example.photo} has {columns} × {rows} pixels, the photo {width} × {height}: "
                "draw it on the whole photo"
            )
        labels = torch.from_numpy(example.mask.astype(np.int32))
    else:
        zoom = min(MASK_SIDE / max(width, height), 1.0)
        labels = torch.zeros(max(round(height * zoom), 1), max(round(width * zoom), 1), dtype=torch.int32)
    place = f"{example.photo} of {width} × {height} pixels"
    x, y = labels.shape[1] / width, labels.shape[0] / height
    if example.box is not None:
        left, top = max(example.box[0], 0), max(example.box[1], 0)
        right, bottom = min(example.box[2], width), min(example.box[3], height)
        if not (left < right and top < bottom):
            numbers = ", ".join(f"{x:g}" for x in example.box)
            raise UserError(f"the box {numbers} marks nothing in {place}: give left, top, right and bottom")
        across = slice(int(left * x), max(math.ceil(right * x), int(left * x) + 1))
        labels[int(top * y) : max(math.ceil(bottom * y), int(top * y) + 1), across] = 1
    down, along = torch.meshgrid(*(torch.arange(side) + 0.5 for side in labels.shape), indexing="ij")
    radius = max(_REACH * max(labels.shape), 0.8)
    for points, label in ((example.points, 1), (example.not_points, 2)):
        for column, row in points:
            if not (0 <= column <= width and 0 <= row <= height):
                raise UserError(f"the point {column:g}, {row:g} lies outside {place}")
            distance = torch.hypot(along - (column + 0.5) * x, down - (row + 0.5) * y)
            labels[distance <= radius] = label
    return labels
