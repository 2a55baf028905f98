"""Words taught by example: marks in photos, weights on Gaussians, and a direction in CLIP's space.

A word is a linear score of unit CLIP features, fitted by logistic regression to the Gaussians that the marked
pixels show. It joins the text's own relevancy in proportion to how well that separates the marked from the
rest: docs/teach.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import expanded, read_json, write_atomically
from lang3dxl_ns.query.coco import mask_of, run_lengths
from lang3dxl_ns.query.relevancy import TEMPERATURE
from lang3dxl_ns.query.run_file import ScenePhoto

Point = tuple[float, float]
Box = tuple[float, float, float, float]
MARK_SIDE = 320
"""Longer side in pixels of the views that marks are gathered in."""
_REACH = 0.01
"""Radius of a click, in longer sides of the photo."""
_STORED_SIDE = 1024
"""Longer side of a kept mask in pixels."""
_ROWS = 20_000
"""Gaussians that a word is fitted to, at most; more are sampled by their weight."""
_AXES = 64
"""Principal components of the scene's features that a word is fitted in."""
_OUTLINE, _BOX = 100, 30
"""Clicks that an outline and a box are worth."""
_RIDGE = 0.3
"""Penalty of the squared coefficients, per standardized coordinate, after one click."""
_LEAST_RIDGE = 0.01
_UP = 0.6
"""Part of the way from the mean score of a clicked photo to that of the clicks where the word begins."""
_GAIN = 1.5
"""Weight of a text whose average precision is 1."""
_TRUST = 3
"""Clicks that the belief in a word's text is worth before anything is marked."""
_LEAST_SPREAD = 1e-3
"""Spread of a coordinate that takes part, relative to the largest."""
_TYPICAL = 4096
"""Gaussians, evenly spaced, that the components are taken from."""
_STEPS = 20
_VERSION = 1


# ── examples ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Example:
    """Marks in one photo: an outline or a box around all that is the word, or clicks on some of it.

    Coordinates are pixels of the photo's file, with the origin at its top-left corner.
    """

    photo: str
    """Name of the photo."""
    mask: Bool[Array, "h w"] | None = None
    """What is the word, at any size in the photo's proportions; everything else in the photo is not."""
    box: Box | None = None
    """Left, top, right, bottom: nothing outside is the word, and most of the inside is."""
    points: tuple[Point, ...] = ()
    """Columns and rows of pixels that are the word."""
    not_points: tuple[Point, ...] = ()
    """Columns and rows of pixels that are not."""

    def __post_init__(self) -> None:
        """Raises UserError unless something is marked, with numbers."""
        numbers = [*(self.box or ()), *(x for point in (*self.points, *self.not_points) for x in point)]
        if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers):
            raise UserError(f"the marks in {self.photo} have a coordinate that is not a number")
        if self.mask is None and self.box is None and not self.points:
            raise UserError(f"nothing is marked in {self.photo}: give a mask, a box or a point on the word")
        if self.mask is not None and self.box is not None:
            raise UserError(f"{self.photo} has a mask and a box: give one of them")
        if self.mask is not None and (np.ndim(self.mask) != 2 or not np.any(self.mask)):
            raise UserError(f"the mask of {self.photo} is empty: mark the word in white")

    @property
    def evidence(self) -> int:
        """How many clicks the marks are worth."""
        points = len(self.points) + len(self.not_points)
        return points + (_OUTLINE if self.mask is not None else _BOX if self.box is not None else 0)

    @property
    def complete(self) -> bool:
        """Whether everything that is the word in the photo lies inside the marks."""
        return self.mask is not None or self.box is not None

    def to_json(self) -> dict[str, Any]:
        """The example as JSON; masks as run lengths."""
        told: dict[str, Any] = {"photo": self.photo}
        if self.mask is not None:
            told["mask"] = {"size": list(self.mask.shape), "counts": run_lengths(np.asarray(self.mask, bool))}
        if self.box is not None:
            told["box"] = list(self.box)
        return told | {"points": [*map(list, self.points)], "not_points": [*map(list, self.not_points)]}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> Example:
        """The example; raises ValueError, LookupError, TypeError or UserError for anything else."""
        mask = box = None
        if "mask" in told:
            height, width = map(int, told["mask"]["size"])
            if not 0 < max(height, width) <= _STORED_SIDE:
                raise ValueError("a mask is too large")
            mask = mask_of(told["mask"]["counts"], (height, width))
        if "box" in told:
            left, top, right, bottom = map(float, told["box"])
            box = (left, top, right, bottom)
        points, others = (
            tuple((float(x), float(y)) for x, y in told[name]) for name in ("points", "not_points")
        )
        return cls(str(told["photo"]), mask, box, points, others)


def marks(example: Example, photo: ScenePhoto, size: tuple[int, int]) -> Float[Tensor, "2 h w"]:
    """Shares of the pixels of a view (height, width) that are marked as the word, and as not the word.

    Marks are drawn on the file, and views are undistorted.

    Raises:
        UserError: marks lie outside the photo, or have other proportions.
    """
    width, height = photo.size or (photo.lens.width, photo.lens.height)
    labels = _drawn(example, width, height)
    labels = photo.photo().undistort_labels(labels)
    chosen = torch.stack([labels == 1, labels == 2]).float()
    return F.interpolate(chosen[None], size, mode="area")[0]


def _drawn(example: Example, width: int, height: int) -> Int[Tensor, "h w"]:
    """1 on the word, 2 on what is not, 0 elsewhere, at most `_STORED_SIDE` pixels wide and high."""
    if example.mask is not None:
        mask = stored_mask(example.mask)
        rows, columns = mask.shape
        if abs(columns * height - rows * width) > 0.01 * rows * width + max(width, height):
            raise UserError(
                f"the mask of {example.photo} has {columns} × {rows} pixels, the photo {width} × {height}: "
                "draw it on the whole photo"
            )
        labels = torch.from_numpy(mask.astype(np.int32))
    else:
        zoom = min(_STORED_SIDE / max(width, height), 1.0)
        labels = torch.zeros(max(round(height * zoom), 1), max(round(width * zoom), 1), dtype=torch.int32)
    if example.box is not None:
        _draw_box(labels, example.box, width, height, example.photo)
    for points, label in ((example.points, 1), (example.not_points, 2)):
        for point in points:
            _draw_point(labels, point, label, width, height, example.photo)
    return labels


def stored_mask(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """A mask at the size that is kept; one marked pixel stays one."""
    stored = torch.from_numpy(np.asarray(mask, bool))
    longer = max(stored.shape)
    if longer > _STORED_SIDE:
        size = [max(round(side * _STORED_SIDE / longer), 1) for side in stored.shape]
        share = F.interpolate(stored[None, None].float(), size, mode="area")[0, 0]
        stored = share >= min(0.5, float(share.max()))
    return stored.numpy()


def _draw_box(labels: Int[Tensor, "h w"], box: Box, width: int, height: int, photo: str) -> None:
    left, top, right, bottom = box
    if not (left < right and top < bottom and left < width and top < height and right > 0 and bottom > 0):
        raise UserError(
            f"the box {_told(box)} marks nothing in {photo} of {width} × {height} pixels: give left, top, "
            "right and bottom"
        )
    x, y = labels.shape[1] / width, labels.shape[0] / height
    columns = slice(int(max(left, 0) * x), max(math.ceil(right * x), int(left * x) + 1))
    labels[int(max(top, 0) * y) : max(math.ceil(bottom * y), int(top * y) + 1), columns] = 1


def _draw_point(
    labels: Int[Tensor, "h w"], point: Point, label: int, width: int, height: int, photo: str
) -> None:
    if not (0 <= point[0] <= width and 0 <= point[1] <= height):
        raise UserError(f"the point {_told(point)} lies outside {photo} of {width} × {height} pixels")
    rows, columns = torch.meshgrid(*(torch.arange(side) + 0.5 for side in labels.shape), indexing="ij")
    x, y = (point[0] + 0.5) * labels.shape[1] / width, (point[1] + 0.5) * labels.shape[0] / height
    reach = max(_REACH * max(labels.shape), 0.8)
    labels[(columns - x) ** 2 + (rows - y) ** 2 <= reach**2] = label


def _told(numbers: Sequence[float]) -> str:
    return ", ".join(f"{x:g}" for x in numbers)


# ── weights ─────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Weights:
    """Pixels of an example's photo that each Gaussian fills."""

    word: Float[Tensor, " n"]
    """Of those marked as the word."""
    other: Float[Tensor, " n"]
    """Of those marked as something else."""
    seen: Float[Tensor, " n"]
    """Of all."""

    def check(self, photo: str, word: str) -> None:
        """Raises UserError where the marks show nothing, or everything."""
        marked, everything = float(self.word.sum()), float(self.seen.sum())
        if marked <= 1e-6 * max(everything, 1.0):
            raise UserError(f"the marks of {word!r} in {photo} lie where the scene shows nothing")
        if marked >= 0.98 * everything:
            raise UserError(f"{word!r} is everything that {photo} shows: mark the word alone")


# ── the word ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class TaughtWord:
    """A word learned from examples, in the space of a CLIP.

    A unit feature f has the margin `vector` · f + `bias` + `text` · (margin of the word's text). The
    relevancy is sigmoid(temperature · margin), above 0.5 where the word is.
    """

    name: str
    vector: Float[Tensor, " c"]
    """Of any length."""
    bias: float
    text: float
    """Weight of the text, from 0."""
    doubt: float
    """Share of what is not the word that scores above what is, in the marked photos: 0.5 by chance."""
    precision: Mapping[str, float] = field(default_factory=dict)
    """Average precision in each marked photo, by name; learned from the others where there are several."""
    examples: tuple[Example, ...] = ()
    clip: str | None = None
    """Fingerprint of the CLIP whose features it scores."""
    scene: str = ""
    """Name of the scene that it was taught in."""

    def __repr__(self) -> str:
        photos = len({example.photo for example in self.examples})
        return f"TaughtWord({self.name!r}, {photos} photos of {self.scene}, doubt {self.doubt:.2f})"

    def margins(self, features: Float[Tensor, "m c"], text: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Margins of unit features, for which the word's text has margins too."""
        return features @ self.vector.to(features) + self.bias + self.text * text

    def to_json(self) -> dict[str, Any]:
        """The word as JSON."""
        kept = {name: getattr(self, name) for name in ("name", "bias", "text", "doubt", "clip", "scene")}
        examples = [example.to_json() for example in self.examples]
        vector = self.vector.cpu().tolist()
        return kept | {"vector": vector, "precision": dict(self.precision), "examples": examples}

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> TaughtWord:
        """The word; raises ValueError, LookupError, TypeError or UserError for anything else."""
        bias, text, doubt = numbers = [float(told[name]) for name in ("bias", "text", "doubt")]
        vector = torch.tensor([float(x) for x in told["vector"]])
        if not np.isfinite(numbers).all() or not vector.isfinite().all() or not len(vector):
            raise ValueError("a word has a value that is not a number")
        name, scene, clip = told["name"], told["scene"], told["clip"]
        if not isinstance(name, str) or not isinstance(scene, str) or not isinstance(clip, str | None):
            raise ValueError("a word has no name")
        precision = {str(photo): float(value) for photo, value in told["precision"].items()}
        examples = tuple(map(Example.from_json, told["examples"]))
        return cls(name, vector, bias, text, doubt, precision, examples, clip, scene)


def known_word(text: str) -> str:
    """The form in which words are compared: lower case, single spaces."""
    return " ".join(text.lower().split())


def save_words(path: Path, words: Sequence[TaughtWord]) -> None:
    """Write words as JSON, atomically; `load_words` reads it."""
    told = {"version": _VERSION, "words": [word.to_json() for word in words]}
    write_atomically(path, json.dumps(told, ensure_ascii=False) + "\n")


def load_words(path: Path) -> list[TaughtWord]:
    """Words from a file. Raises UserError if it is missing or damaged, or a newer version wrote it."""
    try:
        told = read_json(expanded(path))
        if told["version"] != _VERSION:
            raise UserError(f"{path} has format {told['version']}: update lang3dxl-ns to read it")
        return words_from_json(told["words"])
    except DAMAGE as error:
        raise UserError(f"{path} is not a file of taught words ({error}): save it again") from error


def words_from_json(told: Sequence[Mapping[str, Any]]) -> list[TaughtWord]:
    """Words; raises as `TaughtWord.from_json`."""
    return [TaughtWord.from_json(word) for word in told]


# ── learning ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class _Photo:
    """Weights of the sampled Gaussians in one marked photo."""

    name: str
    word: Float[Tensor, " m"]
    """Of what is the word; sums to about 1."""
    rest: Float[Tensor, " m"]
    """Of what is not; sums to about 1."""
    share: float
    """Of the photo that is marked as the word."""
    evidence: int
    complete: bool


def learn(
    name: str,
    examples: Sequence[Example],
    weights: Sequence[Weights],
    features: Callable[[Int[Tensor, " m"]], Float[Tensor, "m c"]],
    margin: Callable[[Float[Tensor, "m c"]], Float[Tensor, " m"]],
    head: Float[Tensor, "k c"] | None = None,
    temperature: float = TEMPERATURE,
) -> TaughtWord:
    """The word that examples teach; their order doesn't matter.

    Args:
        name: the word.
        examples: the marks, for the record.
        weights: what they show, one per example.
        features: unit CLIP features of some Gaussians, by their indices; 0 where unknown.
        margin: of the word's text, for unit features: cosine minus that of the best competitor.
        head: vectors that all features are combinations of, if they are few.
        temperature: of the scene's relevancies.

    Raises:
        UserError: there is no example, or the marks show nothing, or everything.
    """
    if not examples:
        raise UserError(f"there is no example of {name!r}: mark it in a photo")
    for example, one in zip(examples, weights, strict=True):
        one.check(example.photo, name)
    rows, photos = _sampled(examples, weights)
    sample = features(rows).double()
    text = margin(sample.float()).double()
    everywhere = features(torch.linspace(0, len(weights[0].seen) - 1, _TYPICAL).long().to(rows.device))
    axes = _Axes.of(everywhere.double(), head)
    fit = partial(_fitted, name, sample, text, axes, temperature)
    word = fit(photos)
    # Each photo is judged by what the others teach.
    judges = [fit(photos[:i] + photos[i + 1 :]) for i in range(len(photos))] if len(photos) > 1 else [word]
    precision: dict[str, float] = {}
    for photo, taught in zip(photos, judges, strict=True):
        precision[photo.name] = _precision(taught.margins(sample, text), photo)
    missed = [1 - _separation(word.margins(sample, text), photo.word, photo.rest) for photo in photos]
    doubt = sum(missed) / len(missed)
    return replace(word, doubt=doubt, precision=precision, examples=tuple(examples))


def _sampled(
    examples: Sequence[Example], weights: Sequence[Weights]
) -> tuple[Int[Tensor, " m"], list[_Photo]]:
    """Gaussians to fit, and their weights in every photo: evenly spaced ones of those that are the word, then
    of those that are not (a Gaussian at an edge may be both)."""
    words = [one.word.double() / one.word.double().sum() for one in weights]
    rests = [_rest(one) for one in weights]
    first, second = (_spaced(sum(parts, torch.zeros_like(parts[0]))) for parts in (words, rests))
    photos = []
    for example, one, word, rest in zip(examples, weights, words, rests, strict=True):
        share = float(one.word.sum() / one.seen.sum())
        word = torch.cat([word[first], torch.zeros_like(word[second])])
        rest = torch.cat([torch.zeros_like(rest[first]), rest[second]])
        kind = (share, example.evidence, example.complete)
        photos.append(_Photo(example.photo, word / word.sum(), rest / rest.sum(), *kind))
    return torch.cat([first, second]), photos


def _rest(example: Weights) -> Float[Tensor, " n"]:
    """Weights of what is not the word. Pixels marked so weigh as much as the rest of their photo."""
    rest = (example.seen - example.word).clamp_min(0).double()
    rest, marked = rest / rest.sum().clamp_min(1e-12), example.other.double()
    return rest if float(marked.sum()) <= 0 else 0.5 * (rest + marked / marked.sum())


def _spaced(weight: Float[Tensor, " n"]) -> Int[Tensor, " m"]:
    rows = (weight > 1e-5 * weight.max()).nonzero().squeeze(1)
    return rows[:: math.ceil(len(rows) / _ROWS)]


@dataclass(frozen=True)
class _Axes:
    """Standardized coordinates of features."""

    middle: Float[Tensor, " c"]
    matrix: Float[Tensor, "c k"]

    @classmethod
    def of(cls, features: Float[Tensor, "n c"], head: Float[Tensor, "k c"] | None) -> _Axes:
        """From features of a scene, and the rows that all of them are made of; None: principal components."""
        known = features[features.abs().sum(1) > 0]
        middle = known.mean(0)
        if head is None:
            axes = torch.linalg.eigh((known - middle).T @ (known - middle)).eigenvectors[:, -_AXES:]
        else:
            axes = torch.linalg.pinv(head.to(known))
        spread = ((known - middle) @ axes).square().mean(0).sqrt()
        return cls(middle, axes * torch.where(spread > _LEAST_SPREAD * spread.max(), 1 / spread, 0.0))

    def places(self, features: Float[Tensor, "m c"]) -> Float[Tensor, "m k"]:
        """Coordinates of features."""
        return (features - self.middle) @ self.matrix


def _fitted(
    name: str,
    sample: Float[Tensor, "m c"],
    text: Float[Tensor, " m"],
    axes: _Axes,
    temperature: float,
    photos: Sequence[_Photo],
) -> TaughtWord:
    word = sum((photo.word for photo in photos), torch.zeros_like(text)) / len(photos)
    rest = sum((photo.rest for photo in photos), torch.zeros_like(text)) / len(photos)
    evidence = sum(photo.evidence for photo in photos)
    slope, bias = _logistic(axes.places(sample), word, rest, max(_RIDGE / evidence, _LEAST_RIDGE))
    vector = axes.matrix @ slope / temperature
    bias = bias / temperature - float(axes.middle @ vector)
    known = (evidence * _trust(text, photos) + _TRUST) / (evidence + _TRUST)
    taught = TaughtWord(name, vector.float(), bias, known, 0.5)
    return replace(taught, bias=bias - _level(taught.margins(sample, text), photos))


def _trust(text: Float[Tensor, " m"], photos: Sequence[_Photo]) -> float:
    """Weight of a text, by how well it tells the word from the rest: its average precision in photos where
    all of the word is marked, or how far it ranks clicks above the rest."""
    complete = [_precision(text, photo) for photo in photos if photo.complete]
    if complete:
        return _GAIN * sum(complete) / len(complete)
    separated = [2 * _separation(text, photo.word, photo.rest) - 1 for photo in photos]
    return max(sum(separated) / len(separated), 0.0)


def _logistic(
    places: Float[Tensor, "m k"], word: Float[Tensor, " m"], rest: Float[Tensor, " m"], ridge: float
) -> tuple[Float[Tensor, " k"], float]:
    """Slope and bias of a logistic regression with both classes weighing the same, by Newton's method:
    minimizes ½ Σ word · softplus(−s) + ½ Σ rest · softplus(s) + ½ ridge |slope|²."""
    inputs = F.pad(places, (0, 1), value=1.0)
    word, rest = word / 2, rest / 2
    penalty = torch.full_like(inputs[0], ridge)
    penalty[-1] = 1e-9
    solution = torch.zeros_like(penalty)

    def loss(solution: Float[Tensor, " k"]) -> float:
        score = inputs @ solution
        fit = word @ F.softplus(-score) + rest @ F.softplus(score)
        return float(fit + 0.5 * penalty @ solution.square())

    least = loss(solution)
    for _ in range(_STEPS):
        chance = (inputs @ solution).sigmoid()
        slope = inputs.T @ ((word + rest) * chance - word) + penalty * solution
        curvature = (inputs * ((word + rest) * chance * (1 - chance))[:, None]).T @ inputs
        step = torch.linalg.solve(curvature + penalty.diag(), slope)
        size = 1.0
        while size > 1e-3 and loss(solution - size * step) > least:
            size /= 2
        solution = solution - size * step
        before, least = least, loss(solution)
        if before - least < 1e-7:
            break
    return solution[:-1], float(solution[-1])


# ── judging ─────────────────────────────────────────────────────────────────────────────────────────────


def _separation(score: Float[Tensor, " m"], word: Float[Tensor, " m"], rest: Float[Tensor, " m"]) -> float:
    """Chance that the word scores above the rest (the area under the ROC curve); equal scores share."""
    values, place = score.unique(return_inverse=True)
    word, rest = (torch.zeros_like(values).index_add_(0, place, part) for part in (word, rest))
    return float(word @ (rest.cumsum(0) - rest / 2) / (word.sum() * rest.sum()))


def _precision(score: Float[Tensor, " m"], photo: _Photo) -> float:
    """Average precision of a score in a photo, of Gaussians weighted by the pixels that they fill."""
    order = score.argsort(descending=True, stable=True)
    found = photo.share * photo.word[order].cumsum(0)
    wrong = (1 - photo.share) * photo.rest[order].cumsum(0)
    return float(photo.word[order] @ (found / (found + wrong).clamp_min(1e-12)))


def _level(score: Float[Tensor, " m"], photos: Sequence[_Photo]) -> float:
    """The score above which the word is: where intersection over union is best in photos whose marks are
    complete; without any, part of the way from what is not clicked to what is."""
    complete = [photo for photo in photos if photo.complete]
    if not complete:
        on, off = (
            torch.stack([getattr(photo, side) for photo in photos]).mean(0) for side in ("word", "rest")
        )
        return float(_UP * on @ score + (1 - _UP) * off @ score)
    order = score.argsort(descending=True, stable=True)
    overlap = torch.zeros_like(score)
    for photo in complete:
        found = photo.share * photo.word[order].cumsum(0)
        overlap += found / (photo.share + (1 - photo.share) * photo.rest[order].cumsum(0))
    falls = -score[order].diff()
    overlap[:-1][falls <= 1e-4 * falls.sum()] = 0.0  # equal scores can't be told apart
    best = min(int(overlap.argmax()), len(order) - 2)
    return 0.5 * float(score[order[best]] + score[order[best + 1]])
