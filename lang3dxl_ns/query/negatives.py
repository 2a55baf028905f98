"""Negatives that prompts compete with: phrases that fit anything, and other contents of building photos."""

from __future__ import annotations

from collections.abc import Sequence

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
"""Each phrase with synonyms: prompts that use one of them don't compete with the phrase."""
NEGATIVES = (*CANONICAL, *_SURROUNDINGS)
"""The default."""


def competitors(phrases: Sequence[str], words: Sequence[str]) -> list[int]:
    """Indices of the phrases that a prompt competes with: those not named by it or its synonyms.

    words: the prompt and its synonyms. A phrase is named by any of its words or their synonyms, in singular
    or plural. If that leaves none, all phrases compete.
    """
    named = {form for text in words for word in text.lower().split() for form in _singulars(word)}
    chosen = [i for i, phrase in enumerate(phrases) if not named & _meanings(phrase)]
    return chosen or list(range(len(phrases)))


def _meanings(phrase: str) -> set[str]:
    own = [form for word in phrase.lower().split() for form in _singulars(word)]
    return {*own, *(word for form in own for word in _SURROUNDINGS.get(form, ()))}


def _singulars(word: str) -> list[str]:
    """A word, and what it may be the plural of."""
    endings = (("s", ""), ("es", ""), ("ies", "y"), ("ves", "f"))
    word = word.strip(".,;:!?'\"()")
    return [word, *(word.removesuffix(plural) + one for plural, one in endings if word.endswith(plural))]
