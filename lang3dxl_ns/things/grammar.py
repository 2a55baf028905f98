"""Questions about things: counts, superlatives, ordinals and relations, from one table (`grammar.json`). How
a question begins tells the table of what people type (`query/language.json`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.common.console import some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.ask import ask
from lang3dxl_ns.query.language import HELD, TABLE, held
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.vocabulary import closest_word, common_words
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.things.find import MISSED, Things, is_upright, things_of, up_of
from lang3dxl_ns.things.outlines import shown
from lang3dxl_ns.things.thing import Thing

BESIDE = 1.5
"""Distance, relative to the mean longest edge of two things, up to which they are next to each other."""
INSIDE = 0.7
"""Half-size of a box, relative to its own edges, within which a center is in or on it."""
CLOSE = 1.3
"""Ratio of two sizes below which either may be the larger one."""
UPSIDE_DOWN = -0.5
"""Cosine between up and a picture's upper side below which it stands on its head."""


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
    """Place in the order of the superlative, or `along`, from 1."""
    along: str | None = None
    """Side from which things are numbered."""
    relation: str | None = None
    others: tuple[Request, ...] = ()
    """What the relation refers to: *the portal*, *the highest tower*."""
    among: Request | None = None
    """Things to which they must belong too: *and left of the dome*."""
    without: Request | None = None
    """Things that are left out: *not doors*, *not on the tower*."""

    @property
    def parts(self) -> list[Request]:
        """The request and those inside it, all the way down."""
        inner = filter(None, (self.without, self.among, *self.others))
        return [self, *(part for other in inner for part in other.parts)]

    @property
    def order(self) -> tuple[str, int]:
        """What its things are ordered by (see `measure`), and the sign of the order, 0 for none."""
        return table()["superlatives"].get(self.superlative) or table()["from"].get(self.along) or ("", 0)

    @property
    def words(self) -> list[str]:
        """All prompts, each once."""
        return list(dict.fromkeys(part.word for part in self.parts))


@dataclass(frozen=True, eq=False)
class Sight:
    """Directions of whoever looks: unit vectors to the right, up and away from the viewer."""

    right: Float[Array, "3"]
    up: Float[Array, "3"]
    ahead: Float[Array, "3"]
    shown: frozenset[int] | None = None
    """Ids of the things that one sees: the order from left to right is theirs; None: all."""
    upright: bool = True
    """Whether the photos tell which way is up."""
    photo: str = ""
    """Name of the photo that has these directions."""


def best_photo(scene: Answering, things: Sequence[Thing]) -> ScenePhoto:
    """Return the photo that shows most of the things; the overview if none shows any."""
    names = [sighting.photo for thing in things for sighting in thing.sightings]
    return scene.file.photo(max(sorted(set(names)), key=names.count)) if names else scene.overview


def sight_of(scene: Answering, things: list[Thing], photo: str | None = None) -> Sight:
    """Return the directions of a photo's viewer, and which of the things it shows; by default of the photo
    that shows most of them, as if it showed all."""
    taken = best_photo(scene, things) if photo is None else scene.file.photo(photo)
    up, (x, top, back, _) = up_of(scene), np.array(taken.camera_to_world).T
    x = -x if top @ up < UPSIDE_DOWN else x
    # The picture's right, which no look straight down mirrors; for a picture on its side, the viewer's.
    right = max((x - up * (x @ up), np.cross(up, back)), key=np.linalg.norm)
    right = right / max(np.linalg.norm(right), 1e-9)
    seen = None if photo is None else _shown(scene, taken, things)
    return Sight(right, up, np.cross(up, right), seen, is_upright(scene), taken.name)


def _shown(scene: Answering, photo: ScenePhoto, things: list[Thing]) -> frozenset[int]:
    """List the things that a photo shows, whether they were found in it or not."""
    words = {thing.word: [other for other in things if other.word == thing.word] for thing in things}
    seen = (shown(scene.splats, photo.camera, of_word) for of_word in words.values())
    return frozenset(thing.id for found in seen for _, thing, _ in found)


def facing(scene: Answering, request: Request, found: Sequence[Things], photo: str | None) -> Sight:
    """Return the directions in which a whole question is meant: those of a photo, which may show some of the
    things found, or of the one that shows most of those asked for."""
    every = [thing for one in found for thing in (*one.things, *one.candidates)]
    own = [thing for one in found for thing in one.things if one.word == request.word]
    return sight_of(scene, own if own and photo is None else every, photo)


def parse(text: str, names: Iterable[str] = ()) -> Request:
    """Parse a question. Quotes hold a phrase, and so do `names`, which were taught. Raises UserError, which
    names the part, for what the grammar doesn't know."""
    words = table()
    rest, restored = held(text, names)
    rest = " ".join(rest.lower().strip(TABLE["ends"]).split())
    if len(rest) > words["longest"]:
        raise UserError(
            f"this question has {len(rest):,} letters: ask for one thing, in {words['longest']} at most"
        )
    same = rf"(?<![\w-])(?:{_any(words['same'])})(?![\w-])"
    rest = re.sub(same, lambda found: words["same"][found[0]], rest)
    rest = re.sub(rf"(?<=st|nd|rd|th)-(?=(?:{_any(words['superlatives'])}) )", " ", rest)  # second-highest
    asked = _plain(re.sub(rf"^(?:{_any(TABLE['lead'])})\s+", "", rest))
    rest = re.sub(rf"^(?:{_any(TABLE['count'])})\s+", "", asked)
    relation, tail = _any(words["relations"]), _any(words["tail"])
    idle = rf"^(?:which|what) (?=.+ (?:are|is|{tail}) (?:{relation}) )|,? (?:{tail})$"
    idle += rf"| (?:(?:that |which )?(?:are|is)|{tail})(?= (?:not )?(?:{relation}) )"
    try:
        return replace(_request(re.sub(idle, "", rest), restored), count=rest != asked)
    except UserError as error:
        raise UserError(restored(str(error)).replace(" :", ":")) from None


def meant(name: str, names: Iterable[str] = ()) -> str | None:
    """Return the question that a prompt with a misspelled beginning most likely means, such as *highest
    tower*; None if there is none. `names` were taught."""
    first, _, noun = name.partition(" ")
    begin = [word for word in (*table()["superlatives"], *table()["ordinals"]) if word not in table()["from"]]
    word = closest_word(first, (*begin, *" ".join((*names, *common_words())).split()))
    return f"{word} {noun}" if noun and word in begin else None


def _request(rest: str, restored: Callable[[str], str]) -> Request:
    words = table()
    left_out, also, relation, others = None, None, None, tuple[Request, ...]()
    relations = _any(words["relations"])
    if found := re.fullmatch(rf"(.+?),? and ((?:not )?(?:{relations}) .+)", rest):
        rest, also = found[1], found[2]
    if found := re.fullmatch(r"(.+?),? (?:but |and )?not ((?!.* not ).+)", rest):
        rest, left_out = found[1], found[2]
    found = re.fullmatch(rf"(.+?) ({relations}) (.+)", rest)
    if found and _plain(found[3]) not in words["from"]:  # *on the left* names no thing
        rest, relation = found[1], words["relations"][found[2]]
        others = tuple(_request(part, restored) for part in re.split(r"\s+and\s+", found[3]))
        if len(others) > (2 if relation == "between" else 1):
            raise UserError(f"{found[2]} {found[3]}: name one thing, or two with between … and …")
    along, nth, superlative, whole = None, None, None, rest
    if found := re.fullmatch(rf"(.+?) (?:from|on) (?:the )?({_any(words['from'])})", rest):
        rest, along = found[1], found[2]
    rest = _plain(rest)
    first, _, noun = rest.partition(" ")
    if noun and (first in words["ordinals"] or re.fullmatch(r"[1-9]\d*(st|nd|rd|th)", first)):
        nth, rest = words["ordinals"].get(first) or int(first[:-2]), noun
    place, (first, _, noun) = first, rest.partition(" ")
    if noun and first in words["superlatives"] and not re.match(r"of\b", noun):
        superlative, rest = first, noun
    _check_name(restored(rest) and rest)  # quotes may hold nothing
    if nth and not (along or superlative):
        raise UserError(f"{place} {rest}: say from which side, such as the {place} {rest} from the left")
    if along and (superlative or not nth):
        raise UserError(f"{whole}: say which one, such as the second from the {along}")
    if left_out and re.match(rf"(?:{relations}) ", left_out):
        left_out = f"{rest} {left_out}"  # *windows not on the tower*: without windows on the tower
    among = _request(f"{rest} {also}", restored) if also else None
    without = _request(left_out, restored) if left_out else None
    return Request(restored(rest), False, superlative, nth, along, relation, others, among, without)


def _check_name(name: str) -> None:
    """Raise UserError for an empty name, or one with words of questions that the grammar can't use."""
    words = table()
    if not name:
        raise UserError("this names no thing: ask for one, such as how many windows")
    kinds = ("asks", "unknown", "ordinals", "superlatives", "from", "relations")
    unknown = _any(word for kind in kinds for word in words[kind])
    parts = rf"(?<![\w-])(?:{unknown}|\d\w*)(?![\w-])|[,;]|['’]s(?!\w)"
    if unused := re.findall(parts, re.sub(f"{HELD}.*?{HELD}", "", name)):
        told = f"{name}: a question can't use {', '.join(dict.fromkeys(unused))} here; ask how many windows, "
        told += "for the highest tower, the third window from the left, or windows above the portal; "
        raise UserError(told + "quotes hold a phrase")


def answer(request: Request, found: Sequence[Things], view: Sight) -> list[Thing]:
    """Choose the things that a request asks for. `found` holds the things of `Request.words`. Raises
    UserError if a thing that the relation refers to is not found, or if fewer things are found, or seen from
    there, than the ordinal asks for."""
    things = {one.word: one.things for one in found}
    chosen = list(things[request.word])
    if request.without:
        gone = {thing.id for thing in answer(request.without, found, view)}
        chosen = [thing for thing in chosen if thing.id not in gone]
    if request.among:
        both = {thing.id for thing in answer(request.among, found, view)}
        chosen = [thing for thing in chosen if thing.id in both]
    if request.relation:
        others = [answer(other, found, view) for other in request.others]
        if missing := [other.word for other, there in zip(request.others, others, strict=True) if not there]:
            raise UserError(
                f"no {missing[0]} found, to which a relation has an answer: leave it out, or teach the word"
            )
        if request.relation == "between" and len({thing.id for listed in others for thing in listed}) < 2:
            raise UserError(f"{request.others[0].word}: only one found, and between needs two")
        chosen = [t for t in chosen if _related(t, request.relation, others, view)]
    kind, sign = request.order
    if not sign:
        return chosen
    nth, where = request.nth or 1, ""
    if kind == "left" and view.shown is not None and chosen:
        chosen, where = [thing for thing in chosen if thing.id in view.shown], " in this view"
    if len(chosen) < nth and (request.nth or where):
        some = f"only {len(chosen)}" if chosen else "none"
        raise UserError(f"{request.word}: {some} found{where}, so there is no number {nth}")
    return sorted(chosen, key=lambda thing: sign * measure(thing, kind, view))[nth - 1 : nth]


def assumed(request: Request, found: Sequence[Things], view: Sight) -> str:
    """Tell which relations refer to any of several things, such as *the portal* where five are found.
    Arguments are those of `answer`, which answers the request."""
    several = list[str]()
    for part in request.parts:
        pair = part.relation == "between" and len(part.others) == 1
        counts = [(len(answer(other, found, view)), other.word) for other in part.others]
        several += [f"{word}: {n} found, any of them counts" for n, word in counts if n > 1 + pair]
    return "; ".join(several)


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer to a question about things. As a text it has all of it."""

    text: str
    """A number, or how many things were found, with their ids and a photo of each, and which photo tells left
    and right."""
    things: list[Thing]
    """The things that the question asks for."""
    caution: str | None
    """What may be wrong with the answer; None if nothing is known to be."""

    def __str__(self) -> str:
        return self.text + (f" ({self.caution})" if self.caution else "")


def answered(request: Request, found: Sequence[Things], view: Sight) -> Answer:
    """Answer a request. Arguments and errors are those of `answer`."""
    chosen = answer(request, found, view)
    counted = request == Request(request.word, count=True)
    told = found[0].count if counted else f"{len(chosen)}"  # a count's range tells how sure it is
    if not request.count:
        listed = some([f"id {one.id} in {one.best_photo}" for one in chosen])
        told = f"{told} found: {listed}" if chosen else "none found"
    sides = ("left", "right", "front", "behind")
    if view.photo and any(part.relation in sides or part.order[0] == "left" for part in request.parts):
        told += f"; as seen from {view.photo}"
    doubt = None if counted else unsure(request, found, view)
    notes = [assumed(request, found, view), doubt and f"unsure, since {doubt}"]
    notes += [f"{one.word}: {one.caution}" for one in found if one.caution]
    return Answer(told, chosen, "; ".join(filter(None, notes)) or None)


def answer_question(scene: Answering, text: str, photo: str | None = None) -> Answer:
    """Answer a question; see `Scene.answer`."""
    request = parse(text, scene.words)
    found = things_of(scene, ask(scene, [Prompt(word) for word in request.words]))
    return answered(request, found, facing(scene, request, found, photo))


def unsure(request: Request, found: Sequence[Things], view: Sight) -> str | None:
    """Tell what may make an answer wrong; None if nothing does. Arguments are those of `answer`.

    The answer has to be the same without the things that few photos show, and with all candidates. A list may
    lack what a count may (`MISSED`). Sizes are known roughly: where the next thing is nearly as large, either
    may be the largest.
    """
    listed = _told(replace(request, count=False), found, view)
    wide = set[str]()
    if isinstance(listed, frozenset) and int(MISSED * len(listed)) > len(listed):
        wide.add(request.word)
    for one in (one for one in found if one.word in request.words):
        ways = (one.things, one.sure, [*one.things, *one.candidates])
        each = [[replace(other, things=some) if other is one else other for other in found] for some in ways]
        if len({_told(request, other, view) for other in each}) > 1:
            wide.add(one.word)
    told = [f"{one.word}: {one.count}" for one in found if one.word in wide]
    if any(part.relation in ("above", "below") or part.order[0] in ("top", "tall") for part in request.parts):
        told += [] if view.upright else ["the photos don't tell which way is up"]
    close = (_close(part, found, view) for part in request.parts)
    return ", ".join(told) or next(filter(None, close), None)


def _told(request: Request, found: Sequence[Things], view: Sight) -> int | frozenset[int] | None:
    with suppress(UserError):
        chosen = answer(request, found, view)
        return len(chosen) if request.count else frozenset(thing.id for thing in chosen)
    return None


def _close(request: Request, found: Sequence[Things], view: Sight) -> str | None:
    kind, sign = request.order
    if kind in ("", "left", "top") or _told(request, found, view) is None:
        return None
    listed = answer(replace(request, superlative=None, nth=None), found, view)
    nth = request.nth or 1
    sizes = sorted((measure(thing, kind, view) for thing in listed), key=lambda size: sign * size)
    next_to = pairwise(sizes[max(nth - 2, 0) : nth + 1])
    close = any(max(pair) < CLOSE * min(pair) for pair in next_to)
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


def _plain(text: str) -> str:
    return re.sub(rf"^(?:(?:{_any(TABLE['articles'])})(?:\s+|$))+", "", text.strip())


def _any(phrases: Iterable[str]) -> str:
    return "|".join(sorted(map(re.escape, phrases), key=len, reverse=True))
