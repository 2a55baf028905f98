"""Questions about a landmark whose answers the generator knows, and whether a scene answers them right."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.things.find import Things
from lang3dxl_ns.things.grammar import Request, Sight, answer, measure, parse, table, unsure
from lang3dxl_ns.things.sight import sight_of
from lang3dxl_ns.things.thing import Thing

MOST = 200
"""Questions per landmark."""
TIE = 0.1
"""Difference, relative to the true answer's size, up to which another thing is as high, large or far left."""
_RELATIONS = ("left of", "right of", "above", "below", "next to", "in front of", "behind")
_PLACES = ("first", "second", "third", "fourth")


@dataclass(frozen=True)
class Outcome:
    """How one question was answered."""

    question: str
    right: bool
    cautious: bool
    """Whether the answer came with a caution, a range that holds the truth, or a refusal."""
    right_if_found: bool
    """Whether it is right about the true things that were found: those that were missed don't count."""


@dataclass(frozen=True, eq=False)
class Known:
    """What a scene finds by a word, and what there is."""

    found: Things
    true: list[Thing]
    """The true things that the photos show."""
    matches: Mapping[Thing, Thing | None]
    """The true thing of each thing found, if any; None for one that the photos hardly show."""

    @property
    def truth(self) -> Things:
        return Things(self.found.word, self.true, len(self.true), len(self.true))

    @property
    def seen(self) -> Things:
        """The true things that were found."""
        true = [thing for thing in self.true if thing in self.matches.values()]
        return Things(self.found.word, true, len(true), len(true))


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


def ask_all(scene: Scene, known: Mapping[str, Known]) -> list[Outcome]:
    """Ask the questions that have a true answer, about words with true things. Left, right and front are
    those of the photo that shows most of the things found."""
    outcomes = []
    for text in questions([word for word, one in known.items() if one.true]):
        request = parse(text)
        view = sight_of(scene, known[request.word].found.things)
        truth = _answer(request, [one.truth for one in known.values()], view)
        if truth is not None and (truth or request.relation):
            outcomes.append(_outcome(text, request, view, known, truth))
    return outcomes


def _outcome(
    text: str, request: Request, view: Sight, known: Mapping[str, Known], truth: list[Thing]
) -> Outcome:
    asked = known[request.word]
    given = _answer(request, [one.found for one in known.values()], view)
    seen = _answer(request, [one.seen for one in known.values()], view)
    named = [known[word].found for word in request.words]
    caution = given is None or any(one.caution for one in named)
    if request.count:
        ranged = asked.found.least <= len(truth) <= asked.found.most
        count, least = len(given or []), len(seen or [])
        return Outcome(text, count == len(truth), caution or ranged, count == least)
    caution |= unsure(request, named) is not None
    right = [_is_right(request, view, asked, given, wanted) for wanted in (truth, seen)]
    return Outcome(text, right[0], caution, right[1])


def _answer(request: Request, things: list[Things], view: Sight) -> list[Thing] | None:
    try:
        return answer(request, things, lambda _: view)
    except UserError:
        return None


def _is_right(
    request: Request, view: Sight, asked: Known, given: list[Thing] | None, truth: list[Thing] | None
) -> bool:
    """Compare things: the same set, or for a single one, one that measures as much as the true one."""
    if given is None or truth is None:
        return given is truth
    if not all(thing in asked.matches for thing in given):
        return False
    matched = {asked.matches[thing] for thing in given} - {None}
    words = table()
    kinds = [words["superlatives"].get(request.superlative), words["from"].get(request.along)]
    kind = next((kind for kind in kinds if kind), None)
    if kind is None or not truth:
        return matched == set(truth)
    wanted, size = measure(truth[0], kind[0], view), truth[0].size
    scale = float(size.prod() if kind[0] == "volume" else size.max())
    return any(one and abs(measure(one, kind[0], view) - wanted) <= TIE * scale for one in matched)


def in_words(outcomes: Sequence[Outcome]) -> str:
    """Summarize the shares of right answers, and of wrong ones that came without a caution."""
    right, found = (np.mean([getattr(o, name) for o in outcomes]) for name in ("right", "right_if_found"))
    bold = np.mean([not o.right and not o.cautious for o in outcomes])
    timid = np.mean([o.cautious for o in outcomes if o.right] or [False])
    return (
        f"{len(outcomes)} questions: {right:.0%} right, {found:.0%} about the things that were found, "
        f"{bold:.0%} wrong without a caution, {timid:.0%} of the right ones with one"
    )
