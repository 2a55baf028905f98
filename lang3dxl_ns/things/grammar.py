"""Questions about things: counts, superlatives, ordinals and relations, from one table (`grammar.json`). How
a question begins tells the table of what people type (`query/language.json`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.query.language import TABLE
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.things.find import MISSED, Things, up_of
from lang3dxl_ns.things.thing import Thing

BESIDE = 1.5
"""Distance, relative to the mean longest edge of two things, up to which they are next to each other."""
INSIDE = 0.7
"""Half-size of a box, relative to its own edges, within which a center is in or on it."""
CLOSE = 1.3
"""Ratio of two sizes below which either may be the larger one."""


@cache
def table() -> dict[str, Any]:
    """Load the grammar's words."""
    return read_json(Path(__file__).with_suffix(".json"))


@dataclass(frozen=True)
class Request:
    """What a question asks for."""

    word: str
    """Prompt of the things that it is about."""
    count: bool = False
    superlative: str | None = None
    nth: int | None = None
    """Place in the order `along`, from 1."""
    along: str | None = None
    """Side from which things are numbered."""
    relation: str | None = None
    others: tuple[Request, ...] = ()
    """What the relation refers to: *the portal*, *the highest tower*."""
    without: str | None = None
    """Prompt of things that are left out."""

    @property
    def parts(self) -> list[Request]:
        """The request and those that its relation refers to, all the way down."""
        return [self, *(part for other in self.others for part in other.parts)]

    @property
    def words(self) -> list[str]:
        """All prompts, each once."""
        return list(dict.fromkeys(w for part in self.parts for w in (part.word, part.without) if w))


@dataclass(frozen=True, eq=False)
class Sight:
    """Directions of whoever looks: unit vectors to the right, up and away from the viewer."""

    right: Float[Array, "3"]
    up: Float[Array, "3"]
    ahead: Float[Array, "3"]


def sight_of(scene: Scene, things: list[Thing], photo: str | None = None) -> Sight:
    """Return the directions of a photo's viewer; by default of the photo that shows most of the things."""
    names = [sighting.photo for thing in things for sighting in thing.sightings]
    if photo is None and names:
        photo = max(sorted(set(names)), key=names.count)
    shown = scene.overview if photo is None else scene.file.photo(photo)
    up = up_of(scene)
    ahead = -np.array(shown.camera_to_world)[:, 2]
    ahead = ahead - up * (ahead @ up)
    ahead /= max(np.linalg.norm(ahead), 1e-9)
    return Sight(np.cross(ahead, up), up, ahead)


Facing = Callable[[list[Thing]], Sight]
"""Returns the directions in which some things are seen."""


def parse(text: str) -> Request:
    """Parse a question. Raises UserError, which names the part, for what the grammar doesn't know."""
    words = table()
    rest = " ".join(text.lower().strip(" ?!.").split())
    count, rest = _taken(rest, TABLE["count"])
    _, rest = _taken(rest, TABLE["lead"])
    relation, tail = _any(words["relations"]), _any(words["tail"])
    idle = rf" (?:that |which )?(?:are|is)(?: there)?(?= (?:{relation}) )| (?:{tail})$"
    return replace(_request(re.sub(idle, "", rest)), count=count)


def _request(rest: str) -> Request:
    words = table()
    without, relation, others = None, None, tuple[Request, ...]()
    if found := re.fullmatch(r"(.+?) (?:but )?not (.+)", rest):
        rest, without = found[1], _plain(found[2])
    found = re.fullmatch(rf"(.+?) ({_any(words['relations'])}) (.+)", rest)
    if found and _plain(found[3]) not in words["from"]:  # *on the left* names no thing
        rest, relation = found[1], words["relations"][found[2]]
        others = tuple(_request(part) for part in re.split(r"\s+and\s+", found[3]))
        if len(others) > (2 if relation == "between" else 1):
            raise UserError(f"{found[2]} {found[3]}: name one thing, or two with between … and …")
    along, nth, superlative = None, None, None
    if found := re.fullmatch(rf"(.+?) (?:from|on) the ({_any(words['from'])})", rest):
        rest, along = found[1], found[2]
    rest = _plain(rest)
    first, _, noun = rest.partition(" ")
    if noun and first in words["superlatives"] and not noun.startswith("of "):
        superlative, rest = first, noun
    elif noun and (first in words["ordinals"] or re.fullmatch(r"\d+(st|nd|rd|th)", first)):
        nth, rest = words["ordinals"].get(first) or int(first[:-2]), noun
        if along is None or nth < 1:
            raise UserError(f"{first} {noun}: say from which side, such as the {first} {noun} from the left")
    if along is not None and nth is None:
        raise UserError(f"from the {along}: say which one, such as the second {rest} from the {along}")
    for name in (rest, *([] if without is None else [without])):
        _check_name(name)
    return Request(rest, False, superlative, nth, along, relation, others, without)


def _check_name(name: str) -> None:
    """Raise UserError for an empty name, or one with words of questions that the grammar can't use."""
    words = table()
    if not name:
        raise UserError("this names no thing: ask for one, such as how many windows")
    unused = [word for word in name.split() if word in words["unknown"] or word in words["ordinals"]]
    unused += [word for word in name.split() if word in words["superlatives"]]
    unused += re.findall(rf"\b(?:{_any(words['relations'])})\b", name)
    if unused:
        told = ", ".join(dict.fromkeys(unused))
        raise UserError(
            f"{name}: a question can't use {told} here; ask how many windows, for the highest tower, "
            "the third window from the left, or windows above the portal"
        )


def answer(request: Request, found: Sequence[Things], sight: Facing) -> list[Thing]:
    """Choose the things that a request asks for. `found` holds the things of `Request.words`; `sight` returns
    the directions in which some things are seen. Raises UserError if a thing that the relation refers to is
    not found, or if there are fewer things than the ordinal asks for."""
    things = {one.word: one.things for one in found}
    chosen = list(things[request.word])
    if request.without:
        gone = {thing.id for thing in things[request.without]}
        chosen = [thing for thing in chosen if thing.id not in gone]
    view = sight(chosen or [thing for listed in things.values() for thing in listed])
    if request.relation:
        others = [answer(other, found, sight) for other in request.others]
        if missing := [other.word for other, there in zip(request.others, others, strict=True) if not there]:
            raise UserError(f"no {missing[0]} found: a relation to it has no answer")
        chosen = [t for t in chosen if _related(t, request.relation, others, view)]
    if request.superlative:
        kind, sign = table()["superlatives"][request.superlative]
        return sorted(chosen, key=lambda thing: sign * measure(thing, kind, view))[:1]
    if request.nth and request.along:
        kind, sign = table()["from"][request.along]
        if len(chosen) < request.nth:
            raise UserError(f"only {len(chosen)} {request.word} found: there is no number {request.nth}")
        ordered = sorted(chosen, key=lambda thing: sign * measure(thing, kind, view))
        return ordered[request.nth - 1 : request.nth]
    return chosen


def unsure(request: Request, found: Sequence[Things], sight: Facing) -> str | None:
    """Tell what may make an answer wrong; None if nothing does. Arguments are those of `answer`.

    The answer has to be the same without the things that few photos show, and with all candidates. A list may
    lack what a count may (`MISSED`). Sizes are known roughly: where the next thing is nearly as large, either
    may be the largest.
    """
    listed = _told(replace(request, count=False), found, sight)
    wide = set[str]()
    if isinstance(listed, frozenset) and int(MISSED * len(listed)) > len(listed):
        wide.add(request.word)
    for one in (one for one in found if one.word in request.words):
        ways = (one.things, one.sure, [*one.things, *one.candidates])
        each = [[replace(other, things=some) if other is one else other for other in found] for some in ways]
        if len({_told(request, other, sight) for other in each}) > 1:
            wide.add(one.word)
    told = [f"{one.word}: {one.count}" for one in found if one.word in wide]
    close = (_close(part, found, sight) for part in request.parts)
    return ", ".join(told) or next(filter(None, close), None)


def _told(request: Request, found: Sequence[Things], sight: Facing) -> int | frozenset[int] | None:
    with suppress(UserError):
        chosen = answer(request, found, sight)
        return len(chosen) if request.count else frozenset(thing.id for thing in chosen)
    return None


def _close(request: Request, found: Sequence[Things], sight: Facing) -> str | None:
    kind, sign = table()["superlatives"].get(request.superlative, ("left", 1))
    if kind in ("left", "top") or _told(request, found, sight) is None:
        return None
    listed = answer(replace(request, superlative=None), found, sight)
    view = sight(listed)
    sizes = sorted((measure(thing, kind, view) for thing in listed), key=lambda size: sign * size)[:2]
    close = len(sizes) == 2 and max(sizes) < CLOSE * min(sizes)
    return f"another {request.word} measures nearly the same" if close else None


def measure(thing: Thing, kind: str, view: Sight) -> float:
    """Return what superlatives and ordinals compare (`kind`, of the table), in world units. How large a thing
    is tells the area that one sees of it: its depth is the least sure."""
    if kind == "left":
        return float(thing.center @ view.right)
    if kind == "top":
        return float(thing.center @ view.up + thing.size[2] / 2)
    seen = np.sqrt(np.sort(thing.size)[1:].prod())
    return float({"tall": thing.size[2], "wide": thing.size[:2].max()}.get(kind, seen))


def _related(thing: Thing, relation: str, others: list[list[Thing]], view: Sight) -> bool:
    if relation == "between":
        pairs = [(a, b) for a in others[0] for b in others[-1] if len({a.id, b.id, thing.id}) == 3]
        return any(_between(thing, a, b) for a, b in pairs)
    return any(holds(thing, relation, other, view) for other in others[0] if other.id != thing.id)


def holds(thing: Thing, relation: str, other: Thing, view: Sight) -> bool:
    """Return whether a thing stands in a relation (a value of the table's `relations`) to another one."""
    apart = thing.center - other.center
    sides = {"left": -view.right, "right": view.right, "front": -view.ahead, "behind": view.ahead}
    if relation in sides:
        return bool(apart @ sides[relation] > other.size[:2].max() / 2)
    if relation in ("above", "below"):
        return bool((apart @ view.up) * (1 if relation == "above" else -1) > other.size[2] / 2)
    if relation == "beside":
        return bool(np.linalg.norm(apart) < BESIDE * (thing.size.max() + other.size.max()) / 2)
    return bool((abs(other.axes @ apart) <= INSIDE * np.maximum(other.size, other.size.max() / 10)).all())


def _between(thing: Thing, a: Thing, b: Thing) -> bool:
    line = b.center - a.center
    share = float((thing.center - a.center) @ line / max(line @ line, 1e-12))
    aside = np.linalg.norm(thing.center - a.center - share * line)
    return 0 < share < 1 and bool(aside < max(a.size.max(), b.size.max()))


def _taken(text: str, phrases: list[str]) -> tuple[bool, str]:
    found = re.match(rf"({_any(phrases)})\s+", text)
    return found is not None, text[found.end() :] if found else text


def _plain(text: str) -> str:
    return re.sub(rf"^(?:(?:{_any(TABLE['articles'])})\s+)+", "", text.strip())


def _any(phrases: Iterable[str]) -> str:
    return "|".join(sorted(map(re.escape, phrases), key=len, reverse=True))
