"""Words that a scene can be searched for, or that name what is seen at a place."""

from __future__ import annotations

from functools import lru_cache

from lang3dxl_ns.common.presets import load_preset

_COMMON = (
    "wall", "window", "door", "roof", "tower", "dome", "sky", "tree", "grass", "street", "people", "car",
    "fence", "sign", "lamp", "bench", "flag", "water", "mountain", "flower",
)  # fmt: skip
"""Things around buildings that the table of architectural terms doesn't list."""


@lru_cache(maxsize=1)
def shipped_vocabulary() -> tuple[str, ...]:
    """Single words and terms of architecture and its surroundings, without repetition, as typed."""
    terms: dict[str, list[str]] = load_preset("synonyms/architecture")
    listed = [*_COMMON, *terms, *(word for words in terms.values() for word in words)]
    return tuple(dict.fromkeys(listed))
