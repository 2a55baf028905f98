"""Pictures for viewers and renders: relevancy and overlay."""

import numpy as np
import pytest
import torch
from painted_scene import painted_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.answer import Display, pictures
from lang3dxl_ns.query.heat_maps import overlay


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
    display = Display(threshold=0.6, opacity=0.5, color_map="viridis", highest=0.9)
    found = pictures(rendering, question, display)
    best = torch.maximum(found["relevancy_0"], found["relevancy_1"])[..., 0]
    expected = overlay(rendering.rgb, best, 0.6, 0.5, "viridis", highest=0.9)
    torch.testing.assert_close(found["overlay"], expected, rtol=0, atol=0)
    changed = (found["overlay"] != rendering.rgb).any(-1)
    assert changed.any() and not changed[best < 0.6].any()


def test_without_a_question_the_overlay_is_the_image(scene):
    rendering = scene.draw(scene.camera("all/0003.jpg"))
    assert pictures(rendering, None)["overlay"] is rendering.rgb


def test_a_color_map_that_does_not_exist_is_named(scene):
    question, rendering = drawn(scene, "dome")
    with pytest.raises(UserError, match="no color map"):
        pictures(rendering, question, Display(color_map="rainbows"))
