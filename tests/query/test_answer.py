"""From rendered views to what viewers and renders show."""

import pytest
import torch
from painted_scene import painted_scene

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.query.answer import Asked, ClipColours, Display
from lang3dxl_ns.query.overlay import overlay


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


@pytest.fixture(scope="module")
def view(scene):
    return scene.render(scene.camera("all/0003.jpg"))


def outputs(scene, view, text=None, exact=False, **settings):
    queries = {} if text is None else {"queries": scene.queries(scene.prompts(text))}
    return Asked(scene.scorer(exact), **queries, **settings).outputs(view.image, view.codes, view.alpha)


@pytest.mark.parametrize("exact", [False, True])
def test_relevancies_are_those_that_the_scene_finds(scene, view, exact):
    colours = ClipColours.of(scene.decode, scene.rendered_codes())
    found = outputs(scene, view, "dome; window", exact, colours=colours)
    for i, match in enumerate(scene.match(scene.prompts("dome; window"), view, exact)):
        torch.testing.assert_close(found[f"relevancy_{i}"][..., 0], match.relevancy)
    assert "relevancy_2" not in found


def test_the_overlay_shows_the_best_of_the_prompts(scene, view):
    display = Display(threshold=0.6, opacity=0.5, colour_map="viridis")
    found = outputs(scene, view, "dome; window", display=display, highest=0.9)
    best = torch.maximum(found["relevancy_0"], found["relevancy_1"])[..., 0]
    torch.testing.assert_close(
        found["overlay"], overlay(view.image, best, 0.6, 0.5, "viridis", highest=0.9), rtol=0, atol=0
    )
    changed = (found["overlay"] != view.image).any(-1)
    assert changed.any() and not changed[best < 0.6].any()


def test_without_a_prompt_the_overlay_is_the_image(scene, view):
    assert outputs(scene, view)["overlay"] is view.image


def test_features_that_differ_have_colours_that_differ(scene, view):
    colours = ClipColours.of(scene.decode, scene.rendered_codes())
    picture = outputs(scene, view, colours=colours)["clip_pca"]
    assert picture.shape == view.image.shape and picture.min() >= 0 and picture.max() <= 1
    kinds = [picture[view.image[..., 0] == kind].mean(0) for kind in view.image[..., 0].unique()]
    assert all((a - b).norm() > 0.2 for i, a in enumerate(kinds) for b in kinds[:i])


def test_colours_want_something_to_look_at(scene):
    assert ClipColours.of(scene.decode, torch.zeros(3, 3)) is None


def test_where_nothing_is_seen_nothing_is_found(scene, view):
    empty = torch.zeros_like(view.alpha)
    found = Asked(scene.scorer(), scene.queries(scene.prompts("dome"))).outputs(view.image, view.codes, empty)
    assert not found["relevancy_0"].any() and torch.equal(found["overlay"], view.image)


def test_a_colour_map_that_does_not_exist_is_named(scene, view):
    with pytest.raises(UserError, match="no colour map"):
        outputs(scene, view, "dome", display=Display(colour_map="rainbows"))
