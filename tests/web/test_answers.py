"""The page's worker answers as Python does, without anything drawn."""

import json
from functools import partial

import numpy as np
import pytest
import torch
from pages import THINK, WORDS, camera_of_page, field_scene, served, tilted_scene
from painted_scene import painted_scene

from lang3dxl_ns.query.doubt import LEAST_PEAK, peaks
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import TaughtWord


def taught(scene):
    """The scene with a word taught by example."""
    vector = 0.2 * torch.randn(16, generator=torch.Generator().manual_seed(1))
    return scene.with_words([TaughtWord("Lych gate", vector, -0.05, 0.7, 0.04)])


SCENES = {
    "painted": painted_scene,
    "painted, within a foreground": lambda: painted_scene(config=QueryConfig(foreground="dome; windows")),
    "tilted": tilted_scene,
    "field of 2": partial(field_scene, 2),
    "field of 3": partial(field_scene, 3),
    "field of 6, two layers": partial(field_scene, 6, 2),
}


@pytest.fixture(scope="module", params=SCENES)
def answering(request, browser, tmp_path_factory):
    """A scene, and its page's worker as a function."""
    scene, folder = taught(SCENES[request.param]()), tmp_path_factory.mktemp("page")
    write_page(Page(scene, more=WORDS), folder)
    with served(folder) as address:
        page = browser.new_page()
        page.goto(address + "LICENSES.txt")
        yield scene, lambda job, **given: page.evaluate(THINK, [job, given])
        page.close()


@pytest.mark.parametrize("text", ["dome", "windows", "wall", "belfry", "cupolas", "flying buttress"])
def test_a_word_is_answered_as_by_python(answering, text):
    scene, think = answering
    question = scene.ask(text)
    found = think("ask", text=text, negatives=[], threshold=None)
    expected = question.relevancy[0].numpy()
    # A quarter of a logit per unit of the cosine at the steepest: 1e-3 of the latter at temperature 10.
    np.testing.assert_allclose(found["relevancy"], expected, atol=2.5e-3)
    assert found["threshold"] == pytest.approx(question.thresholds[0], abs=2.5e-3)
    fit, unrelated = peaks(scene.engine.of_gaussians(question.queries))[0], scene.doubts.unrelated
    least, most = (
        61 if fit < LEAST_PEAK else 1 + int((unrelated >= fit * factor).sum()) for factor in (1.002, 0.997)
    )
    assert least <= 61 * found["doubt"] + 1e-6 and 61 * found["doubt"] - 1e-6 <= most
    sure = np.abs(expected - question.thresholds[0]) > 2.5e-3
    matching = np.array(found["relevancy"]) > found["threshold"]
    assert np.array_equal(matching[sure], question.gaussians[0].numpy()[sure])


def test_negatives_compete_as_in_python(answering):
    scene, think = answering
    question = scene.ask('"dome" not "windows", "belfry"')
    found = think("ask", text="dome", negatives=["windows", "belfry"], threshold=None)
    np.testing.assert_allclose(found["relevancy"], question.relevancy[0].numpy(), atol=2.5e-3)
    assert found["threshold"] == 0.5


def test_a_taught_word_is_answered_as_by_python(answering):
    scene, think = answering
    for typed, negatives in (("lych gate", []), ("Lych  Gate", ["dome"])):
        question = scene.ask("Lych gate", negatives=negatives)
        found = think("ask", text=typed, negatives=negatives, threshold=None)
        np.testing.assert_allclose(found["relevancy"], question.relevancy[0].numpy(), atol=2.5e-3)
        assert (found["taught"], found["threshold"], found["doubt"]) == (True, 0.5, 0.04)


def test_a_place_has_the_words_of_python(answering):
    scene, think = answering
    if scene.decoder.name != "painted":
        pytest.skip("random codes are nowhere")
    about, named = json.loads(Page(scene).files()["scene.json"]), 0
    for view in about["views"]:
        for x, y in ((11.5, 70.5), (40.5, 40.5), (48.5, 48.5), (60.5, 30.5), (30.5, 61.5), (90.5, 2.5)):
            camera = scene.file.photo(view["name"]).camera
            expected = scene.what_is(camera, x, y)
            job = {"camera": camera_of_page(view, about["center"]), "x": x, "y": y, "most": 5}
            found = think("whatIs", **job)["words"]
            assert dict(found) == pytest.approx(dict(expected), abs=0.03)
            named += len(expected) > 0
    assert named > 5


def test_views_are_those_of_python_and_turn_around_what_they_show(scene, answering):
    own, think = answering
    if own.decoder.name != "painted" or own.config.foreground or float(own.splats.quats[0, 0]) != 1:
        pytest.skip("for the painted wall as it is")
    for word in ("windows", "dome"):
        expected, found = scene.find(word), think("ask", text=word, negatives=[], threshold=None)
        views = think("find", relevancy=found["relevancy"], threshold=found["threshold"])
        shown = [view["name"] for view in views if view["shown"]]
        assert shown == [view.name for view in expected.views]
        assert views[0]["rank"] == pytest.approx(expected.views[0].rank, abs=0.03)
    middle = np.mean([expected.box.low, expected.box.high], axis=0)  # of the dome
    np.testing.assert_allclose(views[0]["target"], middle, atol=0.2)


def test_what_looks_like_a_place_is_found_by_example(scene, answering):
    own, think = answering
    if own.decoder.name != "painted" or float(own.splats.quats[0, 0]) != 1:
        pytest.skip("for the painted wall as it is")
    dome, windows = (scene.ask(word).gaussians[0].numpy() for word in ("dome", "windows"))
    some, other = np.flatnonzero(dome)[:3].tolist(), np.flatnonzero(windows)[:3].tolist()

    def like(*examples):
        listed = [{"rows": rows, "without": without} for rows, without in examples]
        return np.array(think("ask", text="", negatives=[], threshold=None, examples=listed)["relevancy"])

    assert np.array_equal(like((some, False)) > 0.5, dome)
    for negative in (some, other, np.flatnonzero(scene.ask("wall").gaussians[0].numpy())[:5].tolist()):
        fewer = like((some, False), (other, False), (negative, True))  # a counterexample never adds a match
        assert (fewer <= like((some, False), (other, False)) + 1e-6).all()
    assert like((some, False), (other, False))[other].min() > 0.5 > like((some, False))[other].max()
    assert np.array_equal(like((some, False), (other, True)) > 0.5, dome)


def test_an_unknown_phrase_is_told_with_the_closest_words(answering):
    _, think = answering
    found = think("ask", text="a purple belfrey", negatives=[], threshold=None)
    assert found["known"] is False and "belfry" in found["closest"]
