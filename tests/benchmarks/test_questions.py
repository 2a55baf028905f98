"""Generated questions and true things: every relation, exact answers, and false things that count."""

import numpy as np
import pytest
from made_things import thing
from painted_scene import painted_scene

from lab.benchmarks.questions import Known, ask_all, in_words, questions
from lab.benchmarks.things import Score, pooled_f1
from lab.landmark.instances import true_things
from lab.landmark.landmark import Landmark
from lang3dxl_ns.things.find import Things, up_of
from lang3dxl_ns.things.grammar import parse, table
from lang3dxl_ns.things.thing import Thing


@pytest.mark.parametrize(("family", "seed"), [("cathedral", 600), ("mosque", 602), ("hall", 604)])
def test_true_things_hold_each_solid_once(family, seed):
    landmark = Landmark.from_seed(seed, family)
    things, numbers = true_things(landmark)
    held = np.concatenate(numbers)
    assert set(held.tolist()) == set(range(len(things)))
    for shape, own in zip(landmark.shapes, numbers, strict=True):
        corners = shape.corners
        for number in own.tolist():
            center = things[number].center
            margin = things[number].size.max()
            assert (center > corners.min(0) - margin).all() and (center < corners.max(0) + margin).all()


def test_generated_questions_are_right_where_all_is_found_and_tell_what_is_missed():
    scene = painted_scene()
    rng = np.random.default_rng(0)
    true = [thing(i, "window", rng.uniform(0, 9, 3), rng.uniform(0.5, 2, 3)) for i in range(5)]
    true += [thing(9, "portal", (4.5, 0, 0), (2, 1, 4))]

    def outcomes(missed: int):
        known = {}
        for word in ("window", "portal"):
            own = [one for one in true if one.word == word]
            found = [one for one in own if one.id != missed]
            candidates = [one for one in own if one not in found]
            known[word] = Known(Things(word, found, candidates), own, {one: one for one in found})
        return ask_all(scene, known)

    every = outcomes(missed=-1)
    assert len(every) > 50
    assert all(one.right and one.right_if_found for one in every)
    doubted = (*SIZES, "how many", "window ")  # sizes are rough, and lists of windows may lack one
    assert not any(one.cautious for one in every if not one.question.startswith(doubted))
    some = outcomes(missed=2)
    assert all(one.right_if_found for one in some if not one.question.startswith("how many"))
    assert 0 < sum(one.right for one in some) < len(some)
    # Where the one that was missed is a candidate, no answer that it would change comes without a caution.
    assert all(one.cautious for one in some if not one.right)
    assert sum(one.cautious for one in some if one.right) < sum(one.right for one in some) / 2


def test_generated_questions_use_every_relation_and_ask_for_what_is_not_there():
    asked = [parse(text) for text in questions(["window", "portal", "tower"])]
    assert {one.relation for one in asked} == {None, *table()["relations"].values()}
    assert any(one.without for one in asked) and any(len(one.others) == 2 for one in asked)
    true, spire = (
        [thing(i, "window", (i, 0, 5), views=9) for i in range(3)],
        thing(8, "spire", (9, 0, 9), views=9),
    )

    def absent(*spires: Thing):
        known = {
            "window": Known(Things("window", true), true, {one: one for one in true}),
            "spire": Known(Things("spire", list(spires)), [], {}),
        }
        outcomes = ask_all(painted_scene(), known)
        assert "0 questions" not in in_words(outcomes)
        return [one for one in outcomes if one.absent], in_words(outcomes)

    right, told = absent()
    assert len(right) > 3 and all(one.right for one in right)
    assert f"not there: {len(right)} questions: 100% right" in told
    wrong, told = absent(spire)
    assert not any(one.right or one.cautious for one in wrong)
    assert f"not there: {len(wrong)} questions: 0% right, 100% wrong without a caution" in told


def test_false_things_count_where_a_word_has_no_true_one():
    counted = (9, 9, 9), ()
    rows = [Score("mosque", "minarets", 9, 9, 0, *counted), Score("hall", "minarets", 0, 0, 4, *counted)]
    assert pooled_f1(rows) == pytest.approx(18 / 22)
    assert pooled_f1(rows[:1]) == 1 and pooled_f1(rows[1:]) == 0 and pooled_f1([]) is None


SIZES = ("tallest", "shortest", "largest", "biggest", "smallest", "widest", "narrowest")


def test_a_relation_that_its_things_places_leave_open_counts_either_way():
    scene, portal = painted_scene(), thing(9, "portal", (0, 0, 0), (2, 1, 4))
    up = up_of(scene)
    for height, open_ in ((2.1, True), (9.0, False)):
        true = thing(1, "window", height * up)
        found = thing(1, "window", 1.9 * up)  # its center is below the portal's top
        known = {
            "window": Known(Things("window", [found]), [true], {found: true}),
            "portal": Known(Things("portal", [portal]), [portal], {portal: portal}),
        }
        outcomes = {one.question: one for one in ask_all(scene, known)}
        assert outcomes["window above the portal"].right is open_
