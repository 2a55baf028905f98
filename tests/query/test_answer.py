"""Outputs for viewers and renders: relevancy, overlay, CLIP colors."""

import pytest
import torch
from painted_scene import painted_scene, render

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.answer import Asked, Display
from lang3dxl_ns.query.heat_maps import overlay


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


@pytest.fixture(scope="module")
def view(scene):
    return render(scene.camera("all/0003.jpg"), torch.zeros(len(scene.gaussians["means"]), 1))


def outputs(scene, view, text=None, **settings):
    queries = {} if text is None else {"queries": scene.queries(scene.prompts(text))}
    asked = Asked(scene.engine, **queries, **settings)
    rendered = None if asked.carried is None else render(view.camera, asked.carried).carried
    return asked.outputs(view.image, rendered, view.alpha)


def test_relevancies_are_those_that_the_scene_finds(scene, view):
    found = outputs(scene, view, "dome; window")
    for i, match in enumerate(scene.match(scene.prompts("dome; window"), "all/0003.jpg")):
        torch.testing.assert_close(found[f"relevancy_{i}"][..., 0], match.relevancy)
    assert "relevancy_2" not in found


def test_the_overlay_shows_the_best_of_the_prompts(scene, view):
    display = Display(threshold=0.6, opacity=0.5, color_map="viridis")
    found = outputs(scene, view, "dome; window", display=display, highest=0.9)
    best = torch.maximum(found["relevancy_0"], found["relevancy_1"])[..., 0]
    torch.testing.assert_close(
        found["overlay"], overlay(view.image, best, 0.6, 0.5, "viridis", highest=0.9), rtol=0, atol=0
    )
    changed = (found["overlay"] != view.image).any(-1)
    assert changed.any() and not changed[best < 0.6].any()


def test_without_a_prompt_the_overlay_is_the_image(scene, view):
    assert outputs(scene, view)["overlay"] is view.image


def test_where_nothing_is_seen_nothing_is_found(scene, view):
    asked = Asked(scene.engine, scene.queries(scene.prompts("dome")))
    rendered = render(view.camera, asked.carried).carried
    found = asked.outputs(view.image, rendered, torch.zeros_like(view.alpha))
    assert not found["relevancy_0"].any() and torch.equal(found["overlay"], view.image)


def test_a_color_map_that_does_not_exist_is_named(scene, view):
    with pytest.raises(UserError, match="no color map"):
        outputs(scene, view, "dome", display=Display(color_map="rainbows"))
