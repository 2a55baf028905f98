"""Words: negatives that prompts compete with, synonyms, and what a scene can be searched for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.common.presets import load_preset
from lang3dxl_ns.preparation.encoders import CLIP_OPTION, find_model
from lang3dxl_ns.query.doubt import UNRELATED
from lang3dxl_ns.query.language import meaning
from lang3dxl_ns.query.relevancy import CANONICAL
from lang3dxl_ns.words.taught_words import known_word

_SURROUNDINGS: dict[str, tuple[str, ...]] = {
    "sky": ("cloud",),
    "ground": ("floor", "pavement", "paving", "square", "earth"),
    "wall": ("facade", "masonry"),
    "roof": ("roofing", "tile"),
    "tree": ("plant", "bush", "forest", "foliage", "leaf", "leaves"),
    "person": ("people", "man", "men", "woman", "women", "crowd", "tourist", "visitor", "pedestrian"),
    "car": ("vehicle", "bus", "truck", "van", "traffic"),
    "house": ("building", "home"),
    "street": ("road", "path"),
    "grass": ("lawn", "meadow", "garden"),
    "water": ("river", "lake", "sea", "pond", "canal", "fountain"),
    "road": ("street", "path"),
    "fence": ("railing", "gate"),
    "bridge": ("viaduct", "aqueduct"),
}  # fmt: skip
"""Phrases with synonyms. A prompt that uses a synonym does not compete with the phrase."""
_PARTS: dict[str, tuple[str, ...]] = {
    "window": ("glass", "pane", "oculus", "lancet", "dormer", "tracery"),
    "door": ("portal", "doorway", "entrance", "entry", "gate", "gateway", "archway"),
    "tower": (
        "belfry", "steeple", "campanile", "minaret", "turret",
        "window", "pane", "oculus", "lancet",
        "door", "portal", "doorway", "entrance", "entry", "gate", "gateway",
    ),
    "spire": ("steeple", "fleche", "pinnacle", "finial"),
    "dome": ("cupola",),
}  # fmt: skip
"""Parts of buildings with synonyms. A part does not compete with its whole either: prompts for windows and
doors do not compete with "tower"."""
_NAMED = {
    phrase: frozenset((*_SURROUNDINGS.get(phrase, ()), *_PARTS.get(phrase, ())))
    for phrase in (*_SURROUNDINGS, *_PARTS)
}
NEGATIVES = (*CANONICAL, *_NAMED)
"""Default negatives of a scene."""
NOTHING = ("sky", *CANONICAL)
"""Phrases that match best at places with nothing to name."""
CLEAR = 0.6
"""Relevancy above which a word still names a place where one of `NOTHING` is the closest negative."""


def competitors(phrases: Sequence[str], words: Sequence[str]) -> list[int]:
    """Return the indices of the phrases that a prompt competes with: those that neither it nor its synonyms
    (`words`) name, by any of their words or the synonyms of these, singular or plural. If all phrases are
    named, all compete."""
    named = {form for text in words for word in _words(text) for form in singulars(word)}
    chosen = [i for i, phrase in enumerate(phrases) if not named & _meanings(phrase)]
    return chosen or list(range(len(phrases)))


def same_thing(word: str, texts: Sequence[str]) -> bool:
    """Return whether one of the texts is this word, singular or plural, or a synonym of it."""
    forms = {form for text in texts for form in singulars(searched(text).lower())}
    return word in forms or bool(forms & _NAMED.get(word, frozenset())) or word in synonyms_of(texts[0])


def _meanings(phrase: str) -> set[str]:
    own = [form for word in _words(phrase) for form in singulars(word)]
    return {*own, *(word for form in own for word in _NAMED.get(form, ()))}


def _words(text: str) -> list[str]:
    return re.split(r"[\s/-]+", text.lower())


def singulars(words: str) -> list[str]:
    """Return a word or term without punctuation, and those that it may be the plural of."""
    endings = (("s", ""), ("es", ""), ("ies", "y"), ("ves", "f"), ("es", "is"), ("ia", "ion"), ("a", "um"))
    irregular = {"oculi": "oculus", "abaci": "abacus"}
    words = words.strip(".,;:!?'\"()")
    forms = [words.removesuffix(plural) + one for plural, one in endings if words.endswith(plural)]
    return [words, *forms, irregular.get(words, words)]


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


def whole_words(clip: str | Path) -> tuple[str, ...]:
    """List the lower-case words of three letters or more that a CLIP's tokenizer has as single tokens. Raises
    UserError if there is no CLIP of this name or folder on this machine."""
    folder, tokens = find_model(clip, CLIP_OPTION).folder, list[Any]()
    if (folder / "tokenizer.json").is_file():
        tokens = read_json(folder / "tokenizer.json")["model"]["vocab"]
    elif (folder / "vocab.json").is_file():
        tokens = read_json(folder / "vocab.json")
    # Unigram models list pairs of token and score; byte-pair ones map tokens to numbers.
    names = [token if isinstance(token, str) else token[0] for token in tokens]
    words = (_WHOLE.fullmatch(name) for name in names)
    return tuple(sorted({found["end"] or found["start"] for found in words if found}))
