"""Words: synonyms, and what a scene can be searched for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.errors import readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.presets import load_preset
from lang3dxl_ns.query.doubt import UNRELATED
from lang3dxl_ns.query.language import meaning
from lang3dxl_ns.query.negatives import NEGATIVES, alternatives, singulars
from lang3dxl_ns.query.relevancy import CANONICAL
from lang3dxl_ns.words.taught_words import known_word


def same_thing(word: str, texts: Sequence[str]) -> bool:
    """Return whether one of the texts is this word, singular or plural, or a synonym of it."""
    meant, known = [searched(text).lower() for text in texts], {word, *alternatives(word)}
    alike = [all(known & {*singulars(part)} for part in text.split()) for text in meant]  # glass windows
    return any(alike) or any(known & {*singulars(text)} for text in meant) or word in synonyms_of(texts[0])


@cache
def synonym_table() -> dict[str, list[str]]:
    """Load the built-in table of architectural terms: common synonyms of each, most common first."""
    return load_preset("synonyms/architecture")


def synonyms_of(text: str) -> list[str]:
    """Return synonyms of a term in singular or plural, with or without an article; none for other texts."""
    words, table = re.sub(r"^(an?|the)\s+", "", known_word(text.replace("-", " "))), synonym_table()
    return next((table[form] for form in singulars(words) if form in table), [])


_COMMON = (
    "wall", "window", "door", "roof", "tower", "dome", "sky", "tree", "grass", "street", "people", "car",
    "fence", "sign", "lamp", "bench", "flag", "water", "mountain", "flower",
)  # fmt: skip
"""Things around buildings that the table of architectural terms doesn't list."""
_WHOLE = re.compile(r"(?P<end>[a-z]{3,})</w>|[▁Ġ](?P<start>[a-z]{3,})")
"""Pattern of tokens that are whole words: CLIP's tables mark their end, others mark their start."""


def searched(text: str) -> str:
    """Return what a prompt searches for: *windows on the left tower* searches for *windows*."""
    return meaning(text).target


@cache
def shipped_vocabulary() -> tuple[str, ...]:
    """Return words and terms of architecture and its surroundings, in the singular, without repetition."""
    terms = synonym_table()
    listed = [*_COMMON, *terms, *(word for words in terms.values() for word in words)]
    return tuple(dict.fromkeys(listed))


def common_words() -> tuple[str, ...]:
    """Return the words that a scene file can search for without its CLIP: the shipped vocabulary, also as it
    is searched for, its single words in the plural too, and the phrases that every query needs."""
    words = shipped_vocabulary()
    # A word whose singular is listed as well is a plural itself.
    alone = [word for word in words if " " not in word and len({*singulars(word)} & {*words}) == 1]
    plurals = [_plural(word) for word in alone]
    needed = [*NEGATIVES, *CANONICAL, *UNRELATED]
    return tuple(dict.fromkeys([*needed, *words, *map(searched, words), *plurals]))


def closest_word(text: str, words: Sequence[str]) -> str | None:
    """Return the word that a misspelled text most likely means; None for a text that is among the words."""
    target = searched(text).lower()
    if target in words or any(form in words for form in singulars(target)):
        return None
    return next(iter(get_close_matches(target, words, 1, 0.75)), None)


def _plural(word: str) -> str:
    if word.endswith(("s", "x", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2] not in "aeiou" else f"{word}s"


@cache
def _plurals() -> dict[str, str]:
    return {_plural(word): word for word in shipped_vocabulary()}


def singular(text: str) -> str:
    """Return the common word that a text searches for in the plural; any other text as it is."""
    return _plurals().get(searched(text).lower(), text)


def whole_words(clip: str | Path) -> tuple[str, ...]:
    """List the lower-case words of three letters or more that a CLIP's tokenizer has as single tokens. Raises
    UserError if there is no CLIP of this name or folder on this machine."""
    from lang3dxl_ns.preparation.encoders import CLIP_OPTION, find_model

    folder, tokens = find_model(clip, CLIP_OPTION).folder, list[Any]()
    with readable(f"the tokenizer in {folder} can't be read", "download the model again"):
        if (folder / "tokenizer.json").is_file():
            tokens = read_json(folder / "tokenizer.json")["model"]["vocab"]
        elif (folder / "vocab.json").is_file():
            tokens = read_json(folder / "vocab.json")
        # Unigram models list pairs of token and score; byte-pair ones map tokens to numbers.
        words = [_WHOLE.fullmatch(token if isinstance(token, str) else token[0]) for token in tokens]
    return tuple(sorted({found["end"] or found["start"] for found in words if found}))
