"""Words that a scene can be searched for, or that name the thing seen at a place."""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

from lang3dxl_ns.preparation.encoders import CLIP_OPTION, find_model
from lang3dxl_ns.query.doubt import UNRELATED
from lang3dxl_ns.query.negatives import NEGATIVES
from lang3dxl_ns.query.relevancy import CANONICAL
from lang3dxl_ns.query.text import synonym_table

_COMMON = (
    "wall", "window", "door", "roof", "tower", "dome", "sky", "tree", "grass", "street", "people", "car",
    "fence", "sign", "lamp", "bench", "flag", "water", "mountain", "flower",
)  # fmt: skip
"""Things around buildings that the table of architectural terms doesn't list."""
_WHOLE = re.compile(r"(?P<end>[a-z]{3,})</w>|[▁Ġ](?P<start>[a-z]{3,})")
"""Pattern of tokens that are whole words: CLIP's tables mark their end, others mark their start."""


@lru_cache(maxsize=1)
def shipped_vocabulary() -> tuple[str, ...]:
    """Return words and terms of architecture and its surroundings, in the singular, without repetition."""
    terms = synonym_table()
    listed = [*_COMMON, *terms, *(word for words in terms.values() for word in words)]
    return tuple(dict.fromkeys(listed))


def common_words() -> tuple[str, ...]:
    """Return the words that a scene file can search for without its CLIP: the shipped vocabulary, its single
    words in the plural too, and the phrases that every query needs."""
    words = shipped_vocabulary()
    plurals = [_plural(word) for word in words if " " not in word]
    return tuple(dict.fromkeys([*NEGATIVES, *CANONICAL, *UNRELATED, *words, *plurals]))


def _plural(word: str) -> str:
    if word.endswith(("s", "x", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2] not in "aeiou" else f"{word}s"


def whole_words(clip: str | Path) -> tuple[str, ...]:
    """List the lower-case words of three letters or more that a CLIP's tokenizer has as single tokens. Raises
    UserError if there is no CLIP of this name or folder on this machine."""
    folder, tokens = find_model(clip, CLIP_OPTION).folder, list[Any]()
    if (folder / "tokenizer.json").is_file():
        tokens = json.loads((folder / "tokenizer.json").read_text(encoding="utf-8"))["model"]["vocab"]
    elif (folder / "vocab.json").is_file():
        tokens = json.loads((folder / "vocab.json").read_text(encoding="utf-8"))
    # Unigram models list pairs of token and score; byte-pair ones map tokens to numbers.
    names = [token if isinstance(token, str) else token[0] for token in tokens]
    words = (_WHOLE.fullmatch(name) for name in names)
    return tuple(sorted({found["end"] or found["start"] for found in words if found}))
