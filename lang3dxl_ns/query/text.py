"""What people type: prompts with negatives, synonyms for specialist words, and their vectors."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.presets import load_preset
from lang3dxl_ns.query.chat_synonyms import ChatSettings, ChatSynonyms
from lang3dxl_ns.query.relevancy import CANONICAL, Queries

EncodeTexts = Callable[[list[str]], Float[Tensor, "n c"]]
"""`ImageTextEncoder.encode_texts`."""

_QUOTED = r'"[^"]*"'
_NEGATIVES = re.compile(rf"\s*\bnot\s+({_QUOTED}(?:\s*,\s*{_QUOTED})*)", re.IGNORECASE)
_CURLY_QUOTES = str.maketrans("“”„«»", '"""""')


@dataclass(frozen=True)
class Prompt:
    """Something to look for."""

    text: str
    negatives: tuple[str, ...] = ()
    """What it is to be told apart from, beside the canonical phrases."""


def parse_prompts(typed: str) -> list[Prompt]:
    """Prompts separated by `;`, each perhaps with negatives: `"windows" not "decorative opening"; dome`.

    `not` counts only before a quoted phrase (several: `not "a", "b"`), so that phrases may contain the word;
    a `;` in quotes doesn't separate. Raises UserError where nothing is asked for.
    """
    # Half of a UTF-16 pair, as a broken paste leaves it, is no text: tokenizers refuse it.
    clean = typed.encode("utf-8", "ignore").decode().translate(_CURLY_QUOTES)
    parts = re.findall(rf"(?:{_QUOTED}|[^;])+", clean)
    prompts = [_parse_prompt(part) for part in parts if part.strip(' "\t\r\n\0')]
    if not prompts:
        raise UserError("the prompt is empty: type what to look for, such as rose window")
    return prompts


def _parse_prompt(part: str) -> Prompt:
    negatives = [_tidy(phrase) for found in _NEGATIVES.findall(part) for phrase in found.split('"')[1::2]]
    text = _tidy(_NEGATIVES.sub(" ", part))
    if not text:
        raise UserError(f"{part.strip()!r} says what not to find, but not what to find: put that first")
    return Prompt(text, tuple(negative for negative in negatives if negative))


def _tidy(text: str) -> str:
    return " ".join(text.replace('"', " ").replace("\0", " ").split())


# ── synonyms ────────────────────────────────────────────────────────────────────────────────────────────


@dataclass
class TextConfig:
    """How words become vectors."""

    synonyms: Literal["off", "table", "chat"] = "table"
    """Where common words for specialist ones come from: nowhere; the list of architectural terms that ships
    with this package; or a chat model behind any OpenAI-compatible endpoint, named by the environment
    (LANG3DXL_CHAT_URL, LANG3DXL_CHAT_KEY, LANG3DXL_CHAT_MODEL), and the list where that fails."""
    combine: Literal["joined", "mean", "max"] = "joined"
    """A prompt and its synonyms as one string with commas (the paper's way), as the mean of their vectors, or
    each on its own, the best at each pixel counting."""
    canonical: tuple[str, ...] = CANONICAL
    """Phrases that fit anything: a prompt is found where it fits better than all of these."""


class SynonymTable:
    """The list that ships: configs/synonyms/architecture.yaml."""

    @cached_property
    def terms(self) -> dict[str, list[str]]:
        """Common synonyms of every term, most common first."""
        return load_preset("synonyms/architecture")

    def __call__(self, text: str) -> list[str]:
        """Synonyms of a term in singular or plural, with or without an article; none for other texts."""
        words = re.sub(r"^(an?|the)\s+", "", " ".join(text.lower().split()))
        return next((self.terms[form] for form in _singulars(words) if form in self.terms), [])


def _singulars(words: str) -> list[str]:
    """The words as they are, and what they may be the plural of."""
    endings = (("", ""), ("s", ""), ("es", ""), ("ies", "y"), ("es", "is"), ("ia", "ion"), ("a", "um"))
    irregular = {"oculi": "oculus", "abaci": "abacus"}
    forms = [words.removesuffix(plural) + single for plural, single in endings if words.endswith(plural)]
    return [*forms, irregular.get(words, words)]


# ── vectors ─────────────────────────────────────────────────────────────────────────────────────────────


class TextEncoder:
    """Prompts to `Queries`; every string is encoded once.

    Args:
        encode: the CLIP that made the targets, `ImageTextEncoder.encode_texts`.
    """

    def __init__(self, encode: EncodeTexts, config: TextConfig | None = None) -> None:
        self.config = config or TextConfig()
        self._encode = encode
        self._vectors: dict[str, Float[Tensor, " c"]] = {}
        self._synonyms: dict[str, list[str]] = {}
        self._table = SynonymTable()

    @cached_property
    def _chat(self) -> ChatSynonyms:
        return ChatSynonyms(ChatSettings.from_environment(), fallback=self._table)

    def synonyms(self, text: str) -> list[str]:
        """Common words for a prompt, most common first; none where it is common itself."""
        if self.config.synonyms == "off":
            return []
        if text not in self._synonyms:
            found = self._table(text) if self.config.synonyms == "table" else self._chat(text)
            self._synonyms[text] = [word for word in found if word.lower() != text.lower()]
        return self._synonyms[text]

    def queries(self, prompts: Sequence[Prompt]) -> Queries:
        """Vectors of prompts, their synonyms combined as configured, and of what they compete with."""
        return Queries.of(
            [self._positive(prompt.text) for prompt in prompts],
            self.vectors(self.config.canonical),
            [self.vectors(prompt.negatives) for prompt in prompts],
        )

    def plain_queries(self, texts: Sequence[str]) -> Queries:
        """Vectors of texts as they are, without synonyms, against the canonical phrases."""
        return Queries.of(self.vectors(texts)[:, None].unbind(), self.vectors(self.config.canonical))

    def _positive(self, text: str) -> Float[Tensor, "s c"]:
        words = [*self.synonyms(text), text]
        if self.config.combine == "joined":
            return self.vectors([", ".join(words)])
        vectors = self.vectors(words)
        return vectors.mean(0, keepdim=True) if self.config.combine == "mean" else vectors

    def vectors(self, texts: Sequence[str]) -> Float[Tensor, "n c"]:
        """Unit vectors of texts."""
        new = [text for text in dict.fromkeys(texts) if text not in self._vectors]
        if new:
            self._vectors |= zip(new, F.normalize(self._encode(new), dim=-1), strict=True)
        if texts:
            return torch.stack([self._vectors[text] for text in texts])
        return next(iter(self._vectors.values()))[None][:0]
