"""Words taught by example: marks in photos, the words learned from them, and files of both."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image, ImageDraw
from torch import Tensor

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import expanded, read_json, write_atomically

Point = tuple[float, float]
Box = tuple[float, float, float, float]
MASK_SIDE = 1024
"""Longer side in pixels of a mask that is kept."""
_OUTLINE, _BOX = 100, 30
"""Number of clicks that an outline and a box are worth."""
_MOST_WEIGHT = 100.0
"""Largest weight of a word's text; those that are learned are at most 1.5."""
MOST_LETTERS = 200
"""Most letters of a word's name."""
_MOST_PIXELS = 1 << 30
"""Most pixels of all masks in one file of words: a thousand of the largest."""
_VERSION = 1


@dataclass(frozen=True, eq=False)
class Example:
    """Marks in one photo: an outline or a box around everything that is the word, clicks on some of it, or
    clicks on what it is not alone, beside examples of what it is. Coordinates are pixels of the photo's file,
    with the origin at its top-left corner."""

    photo: str
    """Name of the marked photo."""
    mask: Bool[Array, "h w"] | None = None
    """Pixels that are the word, at any size in the photo's proportions (at most 1,024 pixels a side are
    kept). All other pixels of the photo are not the word."""
    box: Box | None = None
    """Left, top, right, bottom. Nothing outside is the word, and most of the inside is."""
    points: tuple[Point, ...] = ()
    """Columns and rows of pixels that are the word."""
    not_points: tuple[Point, ...] = ()
    """Columns and rows of pixels that are not the word."""
    size: tuple[int, int] | None = None
    """Width and height of the photo's file; `Scene.teach` sets it."""

    def __post_init__(self) -> None:
        """Raise UserError unless something is marked, with finite coordinates."""
        remedy = "give two numbers for a point, and four for a box"
        with readable(f"the marks in {self.photo} have a coordinate that is not a number", remedy):
            points, others = (tuple(_finite(p, 2) for p in some) for some in (self.points, self.not_points))
            box = None if self.box is None else _finite(self.box, 4)
        vars(self).update(points=points, not_points=others, box=box)
        if not self.shows_word and not self.not_points:
            raise UserError(f"nothing is marked in {self.photo}: give a mask, a box or a point on the word")
        if self.mask is not None and self.box is not None:
            raise UserError(f"{self.photo} has a mask and a box: give one of them")
        if self.mask is not None:
            if np.ndim(self.mask) != 2 or not np.asarray(self.mask).any():
                raise UserError(f"the mask of {self.photo} is empty or not [h, w]: mark the word in white")
            object.__setattr__(self, "mask", _kept(np.asarray(self.mask, bool)))

    @property
    def evidence(self) -> int:
        """Number of clicks that the marks are worth."""
        points = len(self.points) + len(self.not_points)
        return points + (_OUTLINE if self.mask is not None else _BOX if self.box is not None else 0)

    @property
    def shows_word(self) -> bool:
        """Whether anything is marked as the word."""
        return self.complete or bool(self.points)

    @property
    def complete(self) -> bool:
        """Whether everything in the photo that is the word lies inside the marks."""
        return self.mask is not None or self.box is not None

    def has(self, other: Example) -> bool:
        """Return whether all marks of another example are marked here too, in the same photo."""
        alike = self.photo == other.photo and self.box == other.box
        points = {*other.points} <= {*self.points} and {*other.not_points} <= {*self.not_points}
        return alike and points and np.array_equal(self.mask, other.mask)  # type: ignore[arg-type]

    def to_json(self) -> dict[str, Any]:
        """Convert the example to JSON, with masks as run lengths."""
        described: dict[str, Any] = {"photo": self.photo}
        described |= {"points": self.points, "not_points": self.not_points, "size": self.size}
        if self.mask is not None:
            described["mask"] = {"size": self.mask.shape, "counts": run_lengths(self.mask)}
        return described if self.box is None else described | {"box": self.box}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Example:
        """Build the example; raises ValueError, LookupError, TypeError or UserError for anything else."""
        mask, size = None, content.get("size")
        size = None if size is None else (int(size[0]), int(size[1]))
        if "mask" in content:
            height, width = map(int, content["mask"]["size"])
            expect(min(height, width) > 0 and max(height, width) <= MASK_SIDE, "a mask is too large")
            mask = mask_of(content["mask"]["counts"], (height, width))
        elif size is not None and "outlines" in content:  # of a page
            mask = mask_within(content["outlines"], size)
        box, points, others = content.get("box"), content["points"], content["not_points"]
        return cls(str(content["photo"]), mask, box, points, others, size)


def _finite(values: Sequence[Any], count: int) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)  # NumPy's too, which JSON has none of
    expect(len(numbers) == count and all(map(math.isfinite, numbers)), f"{numbers}")
    return numbers


def run_lengths(mask: Bool[Array, "h w"]) -> list[int]:
    """Return a mask's alternating runs, column by column, outside first, as in COCO's uncompressed RLE."""
    flat = mask.ravel(order="F")
    ends = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], ends, [flat.size]])).tolist()
    return [0, *lengths] if flat.size and flat[0] else lengths


def mask_of(lengths: Sequence[int], size: tuple[int, int]) -> Bool[Array, "h w"]:
    """Build the mask (height, width) with these `run_lengths`. Raises ValueError if the sizes differ."""
    whole = size[0] * size[1]
    counts = [int(length) for length in lengths]  # Python's sum of them can't overflow
    expect(len(counts) <= whole + 1 and min(counts, default=0) >= 0, "a mask has more runs than pixels")
    expect(sum(counts) == whole, "run lengths don't fit the size of their mask")
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(size, order="F")


def mask_within(outlines: Sequence[Any], size: tuple[int, int]) -> Bool[Array, "h w"]:
    """Draw what outlines (pixels of a file of this width and height) hold. Raises ValueError for others."""
    zoom = MASK_SIDE / max(size)
    picture = Image.new("1", (max(round(size[0] * zoom), 1), max(round(size[1] * zoom), 1)))
    for outline in outlines:
        places = zoom * np.array(outline, float)
        near = places.shape[1:] == (2,) and abs(places).max() <= 2 * MASK_SIDE  # not if one is NaN
        expect(near, "an outline leaves its photo")
        ImageDraw.Draw(picture).polygon(places.ravel().tolist(), fill=1)
    return np.asarray(picture)


def _kept(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Shrink a mask to the size that is kept. A single marked pixel stays marked."""
    longer = max(mask.shape)
    if longer <= MASK_SIDE:
        return mask
    size = [max(round(side * MASK_SIDE / longer), 1) for side in mask.shape]
    share = F.interpolate(torch.from_numpy(mask)[None, None].float(), size, mode="area")[0, 0]
    return (share >= min(0.5, float(share.max()))).numpy()


@dataclass(frozen=True, eq=False)
class TaughtWord:
    """A word learned from examples, in the space of a CLIP. A unit feature f has the margin `vector` · f +
    `bias` + `text` · (margin of the word's text). The relevancy is sigmoid(temperature · margin), which is
    above 0.5 where the word is."""

    name: str
    vector: Float[Tensor, " c"]
    """Direction of the word in CLIP's space, of any length."""
    bias: float
    text: float
    """Weight of the text's own margin, at least 0."""
    doubt: float
    """Probability that a place that is not the word outscores one that is, in the marked photos."""
    precision: Mapping[str, float] = field(default_factory=dict)
    """Average precision in each marked photo, by name; each of several is scored by what the others teach."""
    examples: tuple[Example, ...] = ()
    clip: str | None = None
    """Fingerprint of the CLIP whose features the word scores."""
    scene: str = ""
    """Name of the scene in which the word was taught."""

    def __repr__(self) -> str:
        photos = len({example.photo for example in self.examples})
        return f"TaughtWord({self.name!r}, {photos} photos of {self.scene}, doubt {self.doubt:.2f})"

    def margins(self, features: Float[Tensor, "m c"], text: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Compute the margins of unit features, given the margins of the word's text for them."""
        return features @ self.vector.to(features) + self.bias + self.text * text

    def lacks_examples_of(self, other: TaughtWord) -> bool:
        """Return whether another word has examples that this one doesn't have."""
        own = [example.to_json() for example in self.examples]
        return any(example.to_json() not in own for example in other.examples)

    def to_json(self) -> dict[str, Any]:
        """Convert the word to JSON."""
        kept = {name: getattr(self, name) for name in ("name", "bias", "text", "doubt", "clip", "scene")}
        examples = [example.to_json() for example in self.examples]
        vector = self.vector.cpu().tolist()
        return kept | {"vector": vector, "precision": dict(self.precision), "examples": examples}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> TaughtWord:
        """Build the word; raises ValueError, LookupError, TypeError or UserError for anything else."""
        bias, text, doubt = (float(content[name]) for name in ("bias", "text", "doubt"))
        vector = torch.tensor([float(x) for x in content["vector"]])
        finite = all(map(math.isfinite, (bias, text, doubt))) and bool(vector.isfinite().all())
        expect(finite and len(vector) > 0, "a word has a value that is not a number")
        expect(0 <= text <= _MOST_WEIGHT and 0 <= doubt <= 1, "a word has a value that no examples teach")
        name, scene, clip = content["name"], content["scene"], content["clip"]
        named = isinstance(name, str) and known_word(name) != ""
        expect(named and isinstance(scene, str) and isinstance(clip, str | None), "a word has no name")
        precision = {str(photo): float(value) for photo, value in content["precision"].items()}
        expect(all(0 <= value <= 1 for value in precision.values()), "a word has a precision beyond 0…1")
        examples = tuple(map(Example.from_json, content["examples"]))
        return cls(name, vector, bias, text, doubt, precision, examples, clip, scene)


def known_word(text: str) -> str:
    """Return the form in which words are compared: lower case, single spaces, accents in letters."""
    return " ".join(normalize("NFC", text).lower().split())


def words_from_json(content: Sequence[Any]) -> list[TaughtWord]:
    """Build all words of a file; raises as `TaughtWord.from_json`, also for masks that are too many."""
    examples = [example for word in content for example in word["examples"]]
    pixels = sum("outlines" in example for example in examples) * MASK_SIDE**2
    pixels += sum(math.prod(map(int, one["mask"]["size"])) for one in examples if "mask" in one)
    expect(pixels <= _MOST_PIXELS, "its masks are too large")
    return list(map(TaughtWord.from_json, content))


def save_words(path: Path, words: Sequence[TaughtWord]) -> None:
    """Write words as JSON, atomically. `load_words` reads the file. Raises UserError for a file that holds
    something else, or that a newer version wrote."""
    if (path := expanded(path)).is_file() and path.stat().st_size:
        with readable(f"{path} is another file than one of taught words", "choose another name"):
            expect(read_json(path)["version"] == _VERSION and "words" in read_json(path), "it has no words")
    content = {"version": _VERSION, "words": [word.to_json() for word in words]}
    write_atomically(path, json.dumps(content, ensure_ascii=False) + "\n")


def load_words(path: Path) -> list[TaughtWord]:
    """Load words from a file. Raises UserError if it is missing or damaged, or a newer version wrote it."""
    with readable(f"{path} is not a file of taught words", "save it again"):
        content = read_json(expanded(path))
        if content["version"] != _VERSION:
            raise UserError(f"{path} has format {content['version']!s:.20}: update lang3dxl-ns to read it")
        words = words_from_json(content["words"])
        expect(all(len(word.name) <= MOST_LETTERS for word in words), "a word has too many letters")
        return words
