"""Trust in answers."""

import pytest
import torch

from lang3dxl_ns.query.trust import ANCHORS, CLEARLY, FAINT, FAR, alike, judged, known_world, least_peak


@pytest.mark.parametrize(
    ("doubt", "peak", "foreign", "level"),
    [
        (1.0, 0.01, None, "doubtful"),
        (0.5, 0.99, None, "doubtful"),
        (0.01, FAINT - 0.01, None, "doubtful"),
        (0.01, CLEARLY - 0.01, None, "uncertain"),
        (0.01, CLEARLY, FAR - 0.01, "sure"),
        (0.01, CLEARLY, FAR + 0.2, "uncertain"),
        (0.01, 0.94, 2.1, "sure"),
        (0.01, 0.94, 2.77, "uncertain"),  # windows and doors that light up a museum's columns
        (0.01, least_peak(FAR), FAR, "sure"),
        (0.01, 1.0, 5.0, "sure"),
    ],
)
def test_an_answer_is_trusted_by_its_peak_its_doubt_and_its_world(doubt, peak, foreign, level):
    trust = judged("minarets", doubt, peak, foreign=foreign)
    assert trust.level == level and bool(trust.remedy) == (level != "sure")


def test_a_foreign_world_is_told_under_sure_answers_too():
    assert "2.0 times as far" in judged("windows", 0.01, 1.0, foreign=2.0).reason
    assert "larger CLIP" in judged("windows", 0.01, 0.6, foreign=2.0).remedy


def test_two_words_that_select_the_same_are_named_to_each_other_but_not_synonyms():
    anchors = torch.zeros(len(ANCHORS), 100, dtype=torch.bool)
    anchors[ANCHORS.index("window"), :20] = anchors[ANCHORS.index("door"), 50:60] = True
    windows, doors = anchors[ANCHORS.index("window")], anchors[ANCHORS.index("door")]
    assert alike("rose window", [], windows, anchors) == ["window"]
    assert alike("windows", [], windows, anchors) == alike("glass windows", [], windows, anchors) == []
    assert alike("portals", [], doors, anchors) == []
    assert alike("minarets", [], doors, anchors) == ["door"]
    assert alike("minarets", [], torch.zeros(100, dtype=torch.bool), anchors) == []
    trust = judged("minarets", 0.01, 1.0, alike=["door"])
    assert trust.level == "uncertain" and trust.alike == ("door",)


def test_a_misspelled_word_is_suggested_where_the_answer_is_not_sure():
    assert "did you mean windows?" in judged("windwos", 1.0, 0.0, meant="windows").remedy


def test_statistics_are_of_the_built_in_clip_alone():
    assert known_world("another") is None
    mean, precision = known_world("0b8ac2020660d725")
    assert mean.shape == (96,) and torch.linalg.eigvalsh(precision.double()).min() > 0
