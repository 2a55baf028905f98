"""Negatives: the phrases that a prompt competes with."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

from lang3dxl_ns.query.language import TABLE
from lang3dxl_ns.query.relevancy import CANONICAL

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


def alternatives(phrase: str) -> frozenset[str]:
    """Return the synonyms and parts of a phrase among the negatives."""
    return _NAMED.get(phrase, frozenset())


def competitors(phrases: Sequence[str], words: Sequence[str]) -> list[int]:
    """Return the indices of the phrases that a prompt competes with: those that neither it nor its synonyms
    (`words`) name, by any of their words or the synonyms of these, singular or plural. If all phrases are
    named, all compete."""
    named = {form for text in words for word in _words(text) for form in singulars(word)}
    chosen = [i for i, phrase in enumerate(phrases) if not named & _meanings(phrase)]
    return chosen or list(range(len(phrases)))


@lru_cache(1024)
def _meanings(phrase: str) -> frozenset[str]:
    own = [form for word in _words(phrase) for form in singulars(word)]
    return frozenset(own).union(*map(alternatives, own))


def _words(text: str) -> list[str]:
    return re.split(r"[\s/-]+", text.lower())


def singulars(words: str) -> list[str]:
    """Return a word or term without punctuation, and those that it may be the plural of."""
    words = words.strip(".,;:!?'\"()")
    endings = ((plural, one) for plural, one in TABLE["plurals"] if words.endswith(plural))
    return [words, *(words.removesuffix(plural) + one for plural, one in endings)]
