"""Pictures for viewers and renders: relevancy and overlay."""

import numpy as np
import pytest
import torch
from painted_scene import painted_scene

from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.query.question import pictures


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


def drawn(scene, text):
    question = scene.ask(text)
    return question, scene.draw(scene.camera("all/0003.jpg"), question.channels)


def test_relevancies_are_those_that_the_scene_finds(scene):
    question, rendering = drawn(scene, "dome; window")
    found = pictures(rendering, question)
    for i, match in enumerate(scene.query("dome; window", "all/0003.jpg")):
        np.testing.assert_array_equal(found[f"relevancy_{i}"][..., 0].numpy(), match.relevancy)
    assert "relevancy_2" not in found


def test_the_overlay_shows_the_best_of_the_prompts(scene):
    question, rendering = drawn(scene, "dome; window")
    found = pictures(rendering, question)
    _, masks = question.maps(rendering)
    best = torch.maximum(found["relevancy_0"], found["relevancy_1"])[..., 0]
    expected = overlay(rendering.rgb, best, masks.any(0), min(question.thresholds))
    torch.testing.assert_close(found["overlay"], expected, rtol=0, atol=0)
    changed = (found["overlay"] != rendering.rgb).any(-1)
    assert changed.any() and not changed[~masks.any(0)].any()


def test_without_a_question_the_overlay_is_the_image(scene):
    rendering = scene.draw(scene.camera("all/0003.jpg"))
    assert pictures(rendering, None)["overlay"] is rendering.rgb
