"""Judging of typed prompts on a scene with known answers."""

import numpy as np
import pytest
from painted_scene import painted_scene
from PIL import Image

from lab.benchmarks import typed_words
from lab.benchmarks.typed_words import PROMPTS, judged
from lang3dxl_ns.evaluation.ground_truth import GroundTruth

PROMPTS_HERE = {"windows": ("windows", "window", "the left window"), "spires": ("spires",), "": ("nothing",)}


@pytest.fixture
def verdicts(tmp_path, monkeypatch):
    """Labels are the scene's own masks."""
    monkeypatch.setattr(typed_words, "PROMPTS", PROMPTS_HERE)

    def ask(mask=lambda found: found):
        scene = painted_scene()
        folder = tmp_path / "ground_truth" / "windows"
        folder.mkdir(parents=True, exist_ok=True)
        found = mask(scene.query("windows", "all/0003.jpg").mask)
        Image.fromarray(found.astype(np.uint8) * 255).save(folder / "0003.png")
        return judged(scene, GroundTruth(folder.parent, "plain"))

    return ask


def test_what_is_found_where_the_labels_are_is_useful(verdicts):
    found = verdicts()
    assert [found[text][0] for text in PROMPTS_HERE["windows"]] == ["useful"] * 3
    assert float(found["windows"][1]) > 0.95


def test_elsewhere_it_is_wrong_but_for_those_with_a_caution(verdicts):
    found = verdicts(lambda mask: ~mask)
    assert found["windows"][0] == found["window"][0] == "wrong"
    assert found["the left window"][0] == "doubtful"


def test_what_has_no_labels_ought_to_be_doubted(verdicts):
    assert {verdicts()[text][0] for text in ("spires", "nothing")} <= {"doubtful", "wrong"}


def test_there_are_fifty_prompts_none_twice():
    texts = [text for group in PROMPTS.values() for text in group]
    assert len(texts) == len(set(texts)) == 50
