"""Prompts and text vectors: parsing, negatives, synonyms for specialist words."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.doubt import UNRELATED
from lang3dxl_ns.query.language import meaning, phrases_of, straight, tidy
from lang3dxl_ns.query.negatives import NEGATIVES, competitors
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.vocabulary import searched, synonyms_of
from lang3dxl_ns.scene.record import SceneRecord, same_clip
from lang3dxl_ns.words.taught_words import MOST_LETTERS, TaughtWord, known_word

EncodeTexts = Callable[[list[str]], Float[Tensor, "n c"]]
"""Function that encodes texts, such as `ImageTextEncoder.encode_texts`."""
NO_SEMANTICS = "this scene has only colors (it was trained with clip none): it can't be queried"
NOT_FINISHED = (
    "this scene has no words yet: they are learned when training ends; resume it (lang3dxl train: the same "
    "command again)"
)

_SAME = 0.95
"""Cosine from which a vector and a phrase are taken to mean the same."""
_QUOTED = r'"[^"]*"'


@dataclass(frozen=True)
class Prompt:
    """A text to search for."""

    text: str
    negatives: tuple[str, ...] = ()
    """Phrases that this prompt competes with, in addition to the configured ones."""
    vector: Float[Tensor, " c"] | None = field(default=None, compare=False, repr=False)
    """Vector in CLIP's space that is searched for in place of the text's own."""
    taught: TaughtWord | None = field(default=None, compare=False, repr=False)
    """Word taught to the scene by example that has this text."""

    def __post_init__(self) -> None:
        """Raise TypeError if a text is not a string."""
        texts_of((self.text, *self.negatives), "a prompt")

    @property
    def name(self) -> str:
        """The prompt in words, such as *windows not arches, doors*: other negatives make it another."""
        return f"{self.text} not {', '.join(self.negatives)}" if self.negatives else self.text


def texts_of(texts: Any, what: str) -> list[str]:
    """Return one text or several as a list, without unpaired UTF-16 surrogates (from a broken paste), which
    tokenizers reject. Raises TypeError, which names `what`, for anything else."""
    listed = [texts] if isinstance(texts, str) else list(texts) if isinstance(texts, Iterable) else [texts]
    if wrong := [text for text in listed if not isinstance(text, str)]:
        raise TypeError(f"{what} is a text, not {type(wrong[0]).__name__}: {wrong[0]!r:.40}")
    return [text.encode("utf-8", "ignore").decode() for text in listed]


def taught_prompt(word: str) -> Prompt:
    """Return the prompt of a word that is to be taught. Raises UserError if no prompt means this word."""
    if not re.search(r"\w", word):
        raise UserError("the prompt is empty: type what to look for, such as rose window")
    if len(word) > MOST_LETTERS:
        raise UserError(f"a word of {len(word):,} letters: choose one of {MOST_LETTERS} at most")
    prompt, *more = parse_prompts(word if '"' in word else f'"{word}"')
    if more or known_word(prompt.text) != known_word(word):
        raise UserError(f"no prompt means {word!r}: name the word without quotes and semicolons")
    return prompt


def parse_prompts(typed: str, names: Iterable[str] = ()) -> list[Prompt]:
    """Parse prompts as people type them: `windows and doors`, `windows, doors; dome`, `windows not doors`.
    Quotes protect a phrase, and `names` are never split. The grammar is in `query/language.py`. Raises
    UserError if there is no prompt."""
    (clean,) = texts_of([typed], "a prompt")
    found = phrases_of(clean, names)
    if not found:
        raise UserError("the prompt is empty: type what to look for, such as rose window")
    if alone := [negatives for text, negatives in found if not text]:
        raise UserError(f"{alone[0][0]!r} has only negatives: put what to find first")
    return [Prompt(text, tuple(negatives)) for text, negatives in found]


def listed_phrases(texts: Iterable[str]) -> list[str]:
    """Return the phrases of texts that may list several, separated by `;` or commas, quoted or not."""
    parts = (re.findall(rf"{_QUOTED}|[^;,]+", straight(text)) for text in texts)
    return [phrase for found in parts for part in found if (phrase := tidy(part))]


# ── what CLIP can't tell ────────────────────────────────────────────────────────────────────────────────

_MOST_WORDS = 50
"""Number of words that fit CLIP's 77 tokens."""
_NO_NAME = re.compile(r"an?|the|and|or|of|in|on|at|to|it|is|are|this|that|these|those|what|where|\d+")


def caution(text: str, counted: bool = False) -> str | None:
    """Return a warning about a prompt that names nothing, such as *the* or *42*, or that has words which CLIP
    can't tell (places, sizes, colors, *how many* unless that is `counted`); None for others."""
    if all(_NO_NAME.fullmatch(word) for word in re.findall(r"\w+", text.casefold())):
        return f"{text} does not name a visible object: the results are arbitrary"
    if len(text.split()) > _MOST_WORDS:
        return f"CLIP reads about {_MOST_WORDS} words: the rest of this prompt is ignored"
    meant = meaning(text)
    unused = tuple(one for one in meant.unused if not (counted and one[0] == "count"))
    return "; ".join(replace(meant, unused=unused).advice) or None


# ── settings ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class TextConfig:
    """Settings of how prompts become vectors."""

    synonyms: Literal["off", "table"] = "table"
    """Source of common words for specialist terms: the shipped `table` of architectural terms, or `off`."""
    combine: Literal["fallback", "joined"] = "fallback"
    """How a prompt and its synonyms are combined. `fallback`: the prompt alone unless the scene doubts it,
    then the best of all at each place. `joined`: one string with commas, as in the paper."""
    negatives: tuple[str, ...] = NEGATIVES
    """Phrases that compete with every prompt: generic ones, and other contents of building photos. A prompt
    matches where it beats all of them. Phrases named by a prompt or its synonyms don't compete with it."""

    def __post_init__(self) -> None:
        """Raise UserError if there are no negatives, since every prompt would then match everywhere."""
        if not any(phrase.strip() for phrase in self.negatives):
            raise UserError("--negatives is empty: give at least one phrase, such as object")


# ── vectors ─────────────────────────────────────────────────────────────────────────────────────────────


class TextEncoder:
    """Encoder of prompts to `Queries`, which encodes every string once, except for `known` unit vectors."""

    def __init__(
        self,
        encode: EncodeTexts,
        config: TextConfig | None = None,
        known: Mapping[str, Float[Tensor, " c"]] | None = None,
    ) -> None:
        self.config = config or TextConfig()
        self._encode = encode
        self._known = known or {}
        self._vectors = dict(self._known)
        self._lock = threading.Lock()

    def synonyms(self, text: str) -> list[str]:
        """Return common words for a prompt, most common first; none if it is common itself."""
        found = [] if self.config.synonyms == "off" else synonyms_of(searched(text))
        return [word for word in found if word.lower() != text.lower()]

    def queries(self, prompts: Sequence[Prompt], known: Collection[str] = ()) -> Queries:
        """Encode prompts, with synonyms (but for `known` texts) combined as configured, and competitors."""
        negatives, positive, against = self.vectors(self.config.negatives), [], []
        for prompt in prompts:
            if prompt.vector is not None:
                vector = prompt.vector.to(negatives)
                other = negatives @ F.normalize(vector, dim=0) < _SAME  # phrases with another meaning
                positive.append(vector[None])
                against.append(other.nonzero().flatten().tolist() or list(range(len(negatives))))
                continue
            words = [] if prompt.text in known else self.synonyms(prompt.text)
            words.append(searched(prompt.text) if prompt.taught is None else prompt.text)
            joined = self.config.combine == "joined"
            positive.append(self.vectors([", ".join(words)] if joined else words))
            against.append(self._against(prompt.text))
        own = [self.vectors(prompt.negatives) for prompt in prompts]
        queries = Queries.of(positive, negatives, own, against)
        return queries.taught([prompt.taught for prompt in prompts])

    def plain_queries(self, texts: Sequence[str]) -> Queries:
        """Encode texts without synonyms, and the configured negatives."""
        return Queries.of(
            self.vectors(texts)[:, None].unbind(),
            self.vectors(self.config.negatives),
            against=[self._against(text) for text in texts],
        )

    @cached_property
    def yardstick(self) -> Queries:
        """Fixed set of words by which an encoder's cosines are measured, independent of the settings."""
        words = self.vectors((*NEGATIVES, *UNRELATED))
        return Queries(words, (), ())

    def _against(self, text: str) -> list[int]:
        return competitors(self.config.negatives, [searched(text), *self.synonyms(text)])

    def vectors(self, texts: Sequence[str]) -> Float[Tensor, "n c"]:
        """Encode texts as unit vectors."""
        texts = texts_of(texts, "what is encoded")
        # So a capital letter needs no CLIP.
        texts = [text.lower() if text.lower() in self._known else text for text in texts]
        with self._lock:  # two threads can't use a tokenizer at once
            new = [text for text in dict.fromkeys(texts) if text not in self._vectors]
            if new:
                self._vectors |= zip(new, F.normalize(self._encode(new), dim=-1), strict=True)
        if not texts:
            return self.vectors(NEGATIVES[:1])[:0]
        return torch.stack([self._vectors[text] for text in texts])


def why_no_words(file: SceneRecord) -> str:
    """Say why a scene without words can't be queried: it has only colors, or its training has not ended."""
    return NO_SEMANTICS if file.clip is None else NOT_FINISHED


def text_encoder(file: SceneRecord, device: torch.device | str) -> EncodeTexts:
    """Load the CLIP that a scene's features come from. Raises UserError if it is missing or has changed."""
    if file.clip is None:
        raise UserError(NO_SEMANTICS)
    from lang3dxl_ns.preparation.encoders import load_image_text_encoder

    encoder = load_image_text_encoder(file.clip, device)
    if not same_clip(encoder.identity, file.clip_identity):
        raise UserError(
            f"the CLIP in {file.clip} is not the one that this scene was made with: restore it, or train anew"
        )
    return encoder.encode_texts
