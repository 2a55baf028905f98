"""What people type: one grammar, from a table that the page's JavaScript reads too (`language.json`).

`phrases_of` splits what was typed into prompts and their negatives; `meaning` says what a prompt searches for
and which of its parts are not used. The table's `cases` are tested in both languages.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unicodedata import normalize

TABLE: dict[str, Any] = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
HELD = "\ue000"
"""Surrounds the number of a part that is held."""
_CURLY_QUOTES = str.maketrans("“”„«»", '"""""')


@dataclass(frozen=True)
class Meaning:
    """What a prompt searches for."""

    target: str
    """The text that CLIP gets: without lead-ins, articles, places and sizes, in English where the table has
    the words."""
    unused: tuple[tuple[str, str], ...] = ()
    """Parts that the answer does not use, each as its kind, a key of the table's `unused`, and its text."""

    @property
    def advice(self) -> list[str]:
        """Sentences about the unused parts."""
        told = ((TABLE["unused"][kind], part) for kind, part in self.unused)
        return [text.replace("{target}", self.target).replace("{part}", part) for text, part in told]


def held(typed: str, names: Iterable[str] = ()) -> tuple[str, Callable[[str], str]]:
    """Put a placeholder, which is one word, in place of every part that quotes hold, and of `names`, such as
    *lords and ladies*. Return the text with single spaces and without *please*, and a function that puts
    the parts back, without quotes."""
    parts: list[str] = []

    def hold(found: re.Match[str]) -> str:
        parts.append(found[0])
        return f"{HELD}{len(parts) - 1}{HELD}"

    def restored(text: str) -> str:
        return tidy(re.sub(f"{HELD}(\\d+){HELD}", lambda found: parts[int(found[1])], text))

    text = straight(typed).replace("\0", " ").replace(HELD, " ")
    phrases = (*TABLE["one"], *filter(None, map(tidy, names)))
    whole = re.compile(rf'"[^"]*"|{_words(phrases).pattern}', re.IGNORECASE)
    # Single spaces, since runs of them would take patterns a time that grows with their square.
    polite = re.compile(rf"(?:^|,? )(?:{_any('polite')})(?![\w-]),?", re.IGNORECASE)
    return polite.sub("", whole.sub(hold, " ".join(text.split()))).strip(), restored


def tidy(text: str) -> str:
    """Return a phrase without quotes and extra spaces, with accents in letters."""
    return " ".join(normalize("NFC", text).replace('"', " ").replace("\0", " ").split())


def straight(text: str) -> str:
    """Return a text with straight double quotes in place of curly ones and of single ones in pairs, and with
    accents in their letters."""
    return re.sub(r"‘([^‘’]*)’", r'"\1"', normalize("NFC", text).translate(_CURLY_QUOTES))


def phrases_of(typed: str, names: Iterable[str] = ()) -> list[tuple[str, list[str]]]:
    """Split what was typed into prompts, each with its negatives. `;`, commas and *and* separate prompts,
    *not* begins negatives, and quotes and `names` are never split. An empty prompt has negatives alone."""
    text, restored = held(typed, names)
    shown = [
        (restored(prompt), [restored(phrase) for phrase in negatives])
        for part in text.split(";")
        for prompt, negatives in _split(part)
    ]
    return [(prompt, [n for n in negatives if n]) for prompt, negatives in shown if prompt or any(negatives)]


def _split(part: str) -> list[tuple[str, list[str]]]:
    wanted, *others = _pattern("not").split(part)
    prompts = _listed(wanted)
    negatives = [phrase for other in others for phrase in _listed(other)]
    if not prompts and not negatives:  # a separator alone, which is searched for as it stands
        prompts = [part]
    return [(prompt, negatives) for prompt in prompts or [""]]


def _listed(text: str) -> list[str]:
    parts = (part for piece in text.split(",") for part in _pattern("and").split(piece))
    return [part for part in parts if part.strip()]


@cache
def _pattern(kind: str) -> re.Pattern[str]:
    """Match any of the table's phrases of a kind as whole words."""
    return _words(TABLE[kind])


def _words(phrases: Iterable[str]) -> re.Pattern[str]:
    words = "|".join(re.escape(phrase) for phrase in sorted(phrases, key=len, reverse=True))
    return re.compile(rf"(?<!\w)(?:{words})(?!\w)", re.IGNORECASE)


@cache
def meaning(text: str) -> Meaning:
    """Find out what a prompt searches for. Names such as *Big Ben*, and texts of nothing but such words,
    stay as they are."""
    if re.match(r"(The )?[A-Z]\w* [A-Z]\w*", text) and _english(text) == text:
        return Meaning(text)
    unused: list[tuple[str, str]] = []
    text = " ".join(text.split())  # as in `held`
    target = text.strip(TABLE["ends"]) or text
    asks = re.compile(rf"^(?:(?:{_any('lead')})\s+)?((?:{_any('count')})\s+)?(?=\S)", re.IGNORECASE)
    if (found := asks.match(target)) is not None and found[0]:
        if found[1]:
            unused.append(("count", found[1].strip()))
        target = re.sub(r"(?:\s+there)?\s+(?:are|is)(?:\s+there)?$", "", target[found.end() :])
    if (found := re.match(rf"^(?:{_any('no')})\s+(?=\S)", target, re.IGNORECASE)) is not None:
        unused.append(("no", found[0].strip()))
        target = target[found.end() :]
    article = re.compile(rf"^(?:{_any('articles')})\s+(?=\S)", re.IGNORECASE)
    target = article.sub("", target)
    where = re.compile(
        rf"\s+(?:{_any('before_places')})\s+(?:the\s+)?(?:{_any('places')})(?!\w).*$"
        rf"|^(?:{_any('places')}|{_any('sizes')})\s+(?!of\b)(?=\S)|\s+(?:{_any('after')})$",
        re.IGNORECASE,
    )
    if parts := [found[0].strip() for found in where.finditer(target)]:
        unused.append(("place", " ".join(parts)))
        target = article.sub("", where.sub("", target).strip())
    target = _english(target.strip() or text)
    if (found := re.search(rf"(?<!\w)(?:{_any('colors')})(?=\s+\S)", target, re.IGNORECASE)) is not None:
        unused.append(("color", found[0]))
    return Meaning(target, tuple(unused))


def _any(kind: str) -> str:
    return _pattern(kind).pattern.removeprefix("(?<!\\w)(?:").removesuffix(")(?!\\w)")


def _english(text: str) -> str:
    """Translate a text of which the table has every word; others stay."""
    table: dict[str, str] = TABLE["german"]
    words = text.lower().split()
    return " ".join(table[word] for word in words) if words and all(word in table for word in words) else text
