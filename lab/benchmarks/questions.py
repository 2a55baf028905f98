"""Questions about a landmark whose answers the generator knows, and whether a scene answers them right."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.things.find import Things
from lang3dxl_ns.things.grammar import Request, Sight, answer, measure, parse, sight_of, table, unsure
from lang3dxl_ns.things.thing import Thing

MOST = 200
"""Questions per landmark."""
TIE = 0.1
"""Relative difference of two sizes up to which they are as large."""
NEAR = 0.3
"""Distance, relative to a thing's longest edge, within which its place decides nothing: half of what a thing
may be off and still count as found. Who is first within it is a tie; what holds on one side of it only may
be in a list or not."""
_RELATIONS = (
    "left of",
    "right of",
    "above",
    "below",
    "next to",
    "in front of",
    "behind",
    "in",
    "on",
    "between",
)
_PLACES = ("first", "second", "third", "fourth")


@dataclass(frozen=True)
class Outcome:
    """How one question was answered."""

    question: str
    right: bool
    cautious: bool
    """Whether the answer came with a caution, a range that holds the truth, or a refusal."""
    right_if_found: bool
    """Whether it is right about the true things that were found: neither those that were missed count nor
    false ones."""
    absent: bool = False
    """Whether it asks for something that is not there, so that none is the right answer."""


@dataclass(frozen=True, eq=False)
class Known:
    """What a scene finds by a word, and what there is."""

    found: Things
    true: list[Thing]
    """The true things that the photos show."""
    matches: Mapping[Thing, Thing | None]
    """The true thing of each thing found, if any; None for one that the photos hardly show."""

    @property
    def is_absent(self) -> bool:
        """Whether there is no such thing, nor one that the photos hardly show and that was found."""
        return not self.true and None not in self.matches.values()

    @property
    def truth(self) -> Things:
        return Things(self.found.word, self.true)

    @property
    def true_ones(self) -> Things:
        """The things found that are true ones."""
        return Things(self.found.word, [thing for thing in self.found.things if self.matches.get(thing)])

    @property
    def seen(self) -> Things:
        """The true things that were found."""
        true = [thing for thing in self.true if thing in self.matches.values()]
        return Things(self.found.word, true)


def questions(words: Sequence[str]) -> list[str]:
    """Return up to `MOST` questions about these words: all counts, and a fixed draw of the others."""
    counts, others = [f"how many {word}" for word in words], list(_others(words))
    order = np.random.default_rng(0).permutation(len(others))
    return counts + [others[i] for i in order[: MOST - len(counts)]]


def _others(words: Sequence[str]) -> Iterator[str]:
    for word in words:
        yield from (f"{superlative} {word}" for superlative in table()["superlatives"])
        yield from (f"{nth} {word} from the {side}" for side in table()["from"] for nth in _PLACES)
        yield from (f"{word} {relation} the {o}" for relation in _RELATIONS for o in words if o != word)
        yield from (f"how many {word} not {o}" for o in words if o != word)
        pairs = combinations([o for o in words if o != word], 2)
        yield from (f"{word} between the {a} and the {b}" for a, b in pairs)


def absent_questions(absent: Sequence[str], words: Sequence[str]) -> list[str]:
    """Return questions about things that are not there, alone and in relation to those that `words` name."""
    alone = [f"{ask} {word}" for word in absent for ask in ("how many", "highest", "largest", "leftmost")]
    return alone + [f"{word} above the {other}" for other in absent for word in words]


def ask_all(scene: Scene, known: Mapping[str, Known]) -> list[Outcome]:
    """Ask the questions that have a true answer, about words with true things, and questions about words
    without any. Left, right and front are those of the photo that shows most of the things found."""
    words = [word for word, one in known.items() if one.true]
    absent = absent_questions([word for word, one in known.items() if one.is_absent], words)
    outcomes = []
    for text in (*questions(words), *absent):
        request = parse(text)
        view = sight_of(scene, known[request.word].found.things)
        truth = _answer(request, [one.truth for one in known.values()], view)
        if text in absent:
            outcomes.append(replace(_outcome(text, request, view, known, truth or []), absent=True))
        elif truth is not None and (truth or request.relation):
            outcomes.append(_outcome(text, request, view, known, truth))
    return outcomes


def _outcome(
    text: str, request: Request, view: Sight, known: Mapping[str, Known], truth: list[Thing]
) -> Outcome:
    asked, found = known[request.word], [one.found for one in known.values()]
    given = _answer(request, found, view)
    caution = given is None or any(known[word].found.caution for word in request.words)
    doubt = unsure(request, found, view) is not None
    true = _answer(request, [one.true_ones for one in known.values()], view)
    if request.count:  # of one word, perhaps without those of another one: always answered
        least, most = asked.found.least, asked.found.most
        caution |= doubt if request.without else least < most and least <= len(truth) <= most
        return Outcome(text, len(given or []) == len(truth), caution, len(true or []) == len(truth))
    caution |= doubt
    right = _is_right(request, view, asked, given, [one.truth for one in known.values()])
    right_if_found = _is_right(request, view, asked, true, [one.seen for one in known.values()])
    return Outcome(text, right, caution, right_if_found)


def _answer(request: Request, things: list[Things], view: Sight) -> list[Thing] | None:
    try:
        return answer(request, things, view)
    except UserError:
        return None


def _is_right(
    request: Request, view: Sight, asked: Known, given: list[Thing] | None, things: list[Things]
) -> bool:
    """Compare things with the answer from the true `things`: the same list, or for a single one, one that
    measures as much."""
    truth = _answer(request, things, view)
    if given is None or truth is None:
        return given is truth
    if not all(thing in asked.matches for thing in given):
        return False
    matched = [one for one in (asked.matches[thing] for thing in given) if one]
    words = table()
    kinds = [words["superlatives"].get(request.superlative), words["from"].get(request.along)]
    kind = next((kind for kind in kinds if kind), None)
    if kind is None or not truth:
        always, ever = _borders(request, things, view)
        return always <= {one.id for one in matched} <= ever
    wanted = measure(truth[0], kind[0], view)
    tie = NEAR * truth[0].size.max() if kind[0] in ("left", "top") else TIE * wanted
    return any(abs(measure(one, kind[0], view) - wanted) <= tie for one in matched)


def _borders(request: Request, things: list[Things], view: Sight) -> tuple[set[int], set[int]]:
    """Return the ids that a relation holds for wherever things are within `NEAR`, and for some such place."""
    answers = [{thing.id for thing in _answer(request, things, view) or []}]
    for step in (sign * NEAR * axis for axis in (view.right, view.up, view.ahead) for sign in (-1, 1)):
        moved = [_moved(one, step if one.word == request.word else -step) for one in things]
        answers.append({thing.id for thing in _answer(request, moved, view) or []})
    return set.intersection(*answers), set.union(*answers)


def _moved(one: Things, step: Float[Array, "3"]) -> Things:
    moved = (replace(thing, center=thing.center + step * thing.size.max()) for thing in one.things)
    return Things(one.word, list(moved))


def in_words(outcomes: Sequence[Outcome]) -> str:
    """Summarize the shares of right answers, and of wrong ones that came without a caution, and apart those
    about what is not there."""
    there, absent = ([o for o in outcomes if o.absent is kind] for kind in (False, True))
    found = np.mean([o.right_if_found for o in there])
    told = f"{_shares(there, f'right, {found:.0%} about the things that were found')}"
    return f"{told}; about what is not there: {_shares(absent, 'right')}" if absent else told


def _shares(outcomes: Sequence[Outcome], name: str) -> str:
    bold = np.mean([not o.right and not o.cautious for o in outcomes])
    timid = np.mean([o.cautious for o in outcomes if o.right] or [False])
    return (
        f"{len(outcomes)} questions: {np.mean([o.right for o in outcomes]):.0%} {name}, "
        f"{bold:.0%} wrong without a caution, {timid:.0%} of the right ones with one"
    )
