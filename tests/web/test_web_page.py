"""The page of a scene in Chromium: it answers as Python does, without a server and without Internet."""

import io
import json
import re
import shutil
import threading
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from painted_scene import (
    encode_texts,
    painted_codes,
    painted_file,
    painted_looks,
    painted_scene,
    painted_splats,
)
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import read_names
from lang3dxl_ns.components.compression import CompressedField
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.files.scene_file import Provenance
from lang3dxl_ns.query.doubt import LEAST_PEAK, peaks
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import NO_SEMANTICS
from lang3dxl_ns.query.vocabulary import common_words, shipped_vocabulary, whole_words
from lang3dxl_ns.web.write_page import _DATA, Page, write_page
from lang3dxl_ns.words.taught_words import Example, TaughtWord

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = [
    *("--headless", "--no-sandbox", "--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]
"""WebGL in software, as on a machine without a GPU."""
SIDE = 384
DESK = {"width": SIDE + 340, "height": SIDE}
PHONE = {"width": 390, "height": 844}
HOSTILE = "<img src=x onerror=alert(1)>\"'&;</script>окно"
WORDS = ("belfry", "zebra crossing", "Ωmega")
THINK = """async ([job, input]) => {
  window.worker ??= await (async () => {
    const worker = new Worker("worker.js", { type: "module" });
    const description = await (await fetch("scene.json")).json();
    window.think = (job, input) => new Promise((resolve, reject) => {
      worker.onmessage = ({ data }) => {
        if (data.error) reject(data.error);
        else if (data.output) resolve(data.output);
      };
      worker.postMessage({ id: 1, job, input });
    });
    const splats = await fetch(description.files?.["splats.bin"] ?? "splats.bin");
    await think("load", { description, splats: await splats.arrayBuffer() });
    return worker;
  })();
  const output = await think(job, input);
  return output.relevancy ? { ...output, relevancy: [...output.relevancy] } : output;
}"""
"""A job for the page's worker, without anything drawn."""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """No lines for requests."""


def field_scene(code_dim: int, layers: int = 1):
    """The painted wall with random codes, read by a field of this many dimensions."""
    generator = torch.Generator().manual_seed(code_dim)
    config = SemanticFieldConfig(preset="short", code_dim=code_dim, hidden_layers=layers, hidden_width=12)
    decoder = CompressedField(config, 16)
    decoder.name = "gathered"
    for parameter in decoder.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)
    decoder.grid.table.data *= 0.1
    places = torch.rand(len(painted_codes()), code_dim, generator=generator)
    codes = (1 + (places * 65534).round()).sub(1).div(65534).clamp(1e-9, 1 - 1e-9).logit()  # as in a file
    codes[::50] = torch.nan
    return painted_scene(decoder=decoder.requires_grad_(False), codes=codes)


def tilted_scene():
    """The painted wall of turned needles, and a wide Gaussian beside the camera that no rasterizer shows."""
    splats, generator = painted_splats(), torch.Generator().manual_seed(0)
    count = len(splats)
    means, scales = splats.means.clone(), torch.rand(count, 3, generator=generator) * 0.08 + 0.01
    means[0], scales[0] = torch.tensor([2.0, 0.0, -4.9]), 0.3
    quats = F.normalize(torch.randn(count, 4, generator=generator), dim=1)
    codes = painted_codes()
    codes[0] = F.normalize(encode_texts(["window"]), dim=1)
    return painted_scene(splats=replace(splats, means=means, scales=scales, quats=quats), codes=codes)


def taught(scene):
    """The scene with a word taught by example."""
    vector = 0.2 * torch.randn(16, generator=torch.Generator().manual_seed(1))
    return scene.with_words([TaughtWord("Lych gate", vector, -0.05, 0.7, 0.04)])


def camera_of_page(place, center):
    """A camera as the page's worker takes it, with the splats' origin at the center."""
    pose = torch.tensor(place["pose"], dtype=torch.float64)
    pose[:3, 3] -= torch.tensor(center, dtype=torch.float64)
    view = torch.linalg.inv(pose).T.flatten().tolist()
    return {"view": view, "focal": place["fx"], "width": place["width"], "height": place["height"]}


SCENES = {
    "painted": painted_scene,
    "painted, within a foreground": lambda: painted_scene(config=QueryConfig(foreground="dome; windows")),
    "tilted": tilted_scene,
    "field of 2": partial(field_scene, 2),
    "field of 3": partial(field_scene, 3),
    "field of 6, two layers": partial(field_scene, 6, 2),
}


@contextmanager
def served(folder):
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="install the [test] extra for playwright")
    if CHROMIUM is None:
        pytest.skip("there is no chromium: apt install chromium")
    with sync_api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield browser
        browser.close()


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


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


@pytest.fixture(scope="module")
def address(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(Page(scene, more=WORDS, provenance=Provenance(HOSTILE, "Painted by nobody", "CC0")), folder)
    with served(folder) as address:
        yield address


def opened(browser, address, viewport):
    """A page that is ready, with what it complained about or fetched from elsewhere."""
    page = browser.new_page(viewport=viewport)
    page.set_default_timeout(240_000)
    page.complaints = []
    page.on("console", lambda m: page.complaints.append(m.text) if m.type != "log" else None)
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    local = (address.partition("#")[0], "data:", "blob:")
    page.on("request", lambda r: None if r.url.startswith(local) else page.complaints.append(r.url))
    page.goto(address)
    page.evaluate("lang3dxl.ready.then(() => true)")
    return page


@pytest.fixture(scope="module")
def desk(browser, address):
    page = opened(browser, address, DESK)
    yield page
    assert page.complaints == []


@pytest.fixture
def page(desk):
    """The page, without prompts and at the overview."""
    for _ in range(4):  # whatever is open
        desk.locator("#frame").press("Escape")
    desk.evaluate("lang3dxl.clear()")
    desk.evaluate("Object.assign(lang3dxl.view.mover, { free: false, shift: false })")
    for box in ("boxed", "free"):
        desk.evaluate(f"document.getElementById('{box}').checked = false")
    desk.emulate_media(reduced_motion="reduce")  # no second of flight
    desk.get_by_role("button", name="Overview").click()
    rest(desk)
    desk.emulate_media(reduced_motion="no-preference")
    return desk


PRESS = """((key, held = {}) => document.getElementById("frame").dispatchEvent(
  new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...held })))"""
"""A key pressed on the picture; false if the page took it."""


def prompts_of(page) -> list[str]:
    return page.locator("#prompts strong").all_inner_texts()


def until(page, question, answer=True) -> None:
    """Wait until the page, or a function, says so: a slow machine does what a key starts much later."""
    for _ in range(600):
        if (found := question() if callable(question) else page.evaluate(question)) == answer:
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"{question} is {found!r}, not {answer!r}")


def until_linked(page, part: str, linked: bool = True) -> None:
    """Wait until a part is in the page's address, or no longer."""
    until(page, f"location.hash.includes({json.dumps(part)})", linked)


def until_told(page, where: str, part: str) -> None:
    """Wait until an element says so."""
    until(page, f"document.querySelector({json.dumps(where)}).textContent.includes({json.dumps(part)})")


def rest(page) -> None:
    """Wait until nothing is left to draw. The page's policy forbids playwright's own way to wait."""
    for _ in range(1000):
        page.wait_for_timeout(300)
        if page.evaluate("lang3dxl.view.resting"):
            return
    raise AssertionError("the page never rests")


def picture(page) -> np.ndarray:
    """The canvas once two pictures in a row are equal."""
    before = None
    for _ in range(60):
        rest(page)
        page.evaluate("document.getElementById('tools').style.opacity = 0")
        shot = page.locator("#frame canvas").screenshot()
        page.evaluate("document.getElementById('tools').style.opacity = 1")
        now = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)
        if before is not None and now.any() and np.array_equal(now, before):
            return now
        before = now
    raise AssertionError("the page never stops changing")


def cells(mask: np.ndarray) -> np.ndarray:
    """Where a mask fills at least a quarter of cells of 8 × 8 pixels: between Gaussians there are gaps."""
    return mask.reshape(SIDE // 8, 8, SIDE // 8, 8).mean((1, 3)) > 0.25


# ── the same answers as Python's ────────────────────────────────────────────────────────────────────────


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
    assert "Lych gate" in think("offered", typed="lych")


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


def test_views_and_boxes_are_those_of_python(scene, answering):
    own, think = answering
    if own.decoder.name != "painted" or own.config.foreground or float(own.splats.quats[0, 0]) != 1:
        pytest.skip("for the painted wall as it is")
    for word in ("windows", "dome"):
        expected, found = scene.find(word), think("ask", text=word, negatives=[], threshold=None)
        places = think("find", relevancy=found["relevancy"], threshold=found["threshold"])
        shown = [view["name"] for view in places["views"] if view["shown"]]
        assert shown == [view.name for view in expected.views]
        assert places["views"][0]["rank"] == pytest.approx(expected.views[0].rank, abs=0.03)
    box = places["box"]  # of the dome: which of the two windows wins is open
    np.testing.assert_allclose([box["low"], box["high"]], [expected.box.low, expected.box.high], atol=0.1)


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


# ── in the browser ──────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.slow
def test_a_typed_word_lights_up_where_it_is(page, scene):
    before = picture(page)
    camera = scene.overview.full_camera
    assert np.abs(before - scene.render(camera, size=SIDE).pixels.astype(int)).mean() < 6
    page.get_by_role("combobox", name="Look for").fill("dome")
    page.keyboard.press("Enter")
    page.locator("#prompts strong", has_text="dome").wait_for()
    changed = cells(np.abs(picture(page) - before).max(2) > 40)
    question = scene.ask("dome")  # a page composites at its own size
    drawn = scene.draw(scene.camera(camera, SIDE), question.channels)
    there = cells(question.maps(drawn)[1][0].numpy())
    assert there.sum() >= 20 and (changed & there).sum() > 0.9 * (changed | there).sum()
    page.get_by_role("button", name="Remove dome").click()
    assert np.abs(picture(page) - before).max() <= 2


@pytest.mark.slow
def test_flying_leads_to_the_best_view_and_its_link_back_to_it(page, scene, browser, address):
    page.evaluate("lang3dxl.ask('windows')")
    page.get_by_role("button", name="Fly to").click()
    there = picture(page)
    until_linked(page, "ask=")
    until_linked(page, "view=")
    link = page.url
    page.evaluate("lang3dxl.clear()")
    best = scene.render(scene.find("windows").views[0].name, size=SIDE).pixels.astype(int)
    assert np.abs(picture(page) - best).mean() < 6
    other = opened(browser, link, DESK)  # two pages at once
    until(other, "lang3dxl.prompts.map(({ text }) => text).join()", "windows")
    assert np.abs(picture(other) - there).mean() < 3
    assert other.complaints == []
    other.close()


@pytest.mark.slow
def test_a_click_tells_what_is_there(page, scene):
    camera = scene.overview.full_camera
    matrix, size = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy(), camera.width
    x, y, z = matrix @ [1.5, 1.5, 0, 1]
    x, y = SIDE * x / z / size, SIDE * y / z / size
    found = page.evaluate("([x, y]) => lang3dxl.whatIs(x, y)", [x, y])
    expected = scene.what_is(camera, x, y, size=SIDE)
    assert found[0][0] == expected[0][0] and found[0][1] == pytest.approx(expected[0][1], abs=0.01)
    corner = page.locator("#frame canvas").bounding_box()
    page.mouse.click(corner["x"] + x, corner["y"] + y)
    page.locator("#here").get_by_role("button", name=expected[0][0], exact=False).first.click()
    page.locator("#prompts strong").wait_for()
    page.mouse.click(corner["x"] + x, corner["y"] + y)
    page.get_by_role("button", name="Like this").click()
    name = page.get_by_role("textbox", name="Name")
    name.wait_for()
    name.fill("my dome~")
    name.press("Enter")
    until_linked(page, "like=my+dome")
    page.get_by_role("button", name="Not this").click()
    window = matrix @ [-0.8, -0.8, 0, 1]
    at = corner["x"] + SIDE * window[0] / window[2] / size, corner["y"] + SIDE * window[1] / window[2] / size
    page.mouse.click(*at)
    page.get_by_text("2 examples").wait_for()
    until_linked(page, "%7E-")
    page.get_by_role("button", name="Undo").click()
    page.get_by_text("1 example").wait_for()
    until_linked(page, "%7E-", False)
    page.get_by_role("button", name="Redo").click()
    page.get_by_text("2 examples").wait_for()


@pytest.mark.slow
def test_a_named_word_is_kept_offered_and_forgotten(page, scene, browser, address):
    rows = ".".join(map(str, scene.ask("dome").gaussians[0].nonzero()[:3, 0].tolist()))
    page.evaluate(f"location.hash = 'like=cupola+of+mine~{rows}'")
    name = page.get_by_role("textbox", name="Name")
    name.fill("my cupola")
    name.press("Enter")
    until(page, "lang3dxl.prompts.map(({ text }) => text).join()", "my cupola")
    page.evaluate("lang3dxl.clear()")
    box = page.get_by_role("combobox", name="Look for")
    box.fill("my cu")
    option = page.locator("#offered option[value='my cupola']")
    option.wait_for(state="attached")
    page.evaluate("lang3dxl.ask('my cupola')")
    found = page.evaluate("lang3dxl.ask('My Cupola')")
    assert page.locator("#prompts li").count() == 1
    assert found["known"] and found["matching"] == int(scene.ask("dome").gaussians[0].sum())
    page.get_by_role("button", name="Add").click()
    page.get_by_role("button", name="Forget").click()
    until(page, "lang3dxl.prompts.length", 0)
    assert page.evaluate("lang3dxl.ask('my cupola')")["known"] is False
    assert page.locator("#prompts li").count() == 0


@pytest.mark.slow
def test_cameras_are_drawn_and_doubtful_ones_apart_with_their_reason(browser, tmp_path):
    file = painted_file()
    photos = [
        replace(photo, doubtful="it looks away" if k == 1 else None) for k, photo in enumerate(file.photos)
    ]
    write_page(Page(painted_scene(file=replace(file, photos=photos))), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        page.evaluate("lang3dxl.view.mover.free = true")
        for _ in range(12):
            page.locator("#frame").press("s")  # until the cameras stand before the eye
        page.get_by_role("button", name="Cameras").click()
        drawn = (
            "(kind) => document.querySelector(`#pyramids .${kind}`).getAttribute('d').split('M').length - 1"
        )
        rest(page)
        assert [page.evaluate(drawn, kind) for kind in ("sure", "doubtful")] == [8, 4]  # edges
        page.get_by_role("button", name="Next view").click()
        page.get_by_role("button", name="Next view").click()
        until_told(page, "#status", "doubtful: it looks away")
        page.close()


@pytest.mark.slow
def test_a_scene_suggests_its_own_words_and_taught_ones_first_and_splits_none_of_them(browser, tmp_path):
    scene = painted_scene().teach("Lords and ladies", Example("all/0003.jpg", points=((69, 69),)))
    write_page(Page(scene), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        offered = page.locator("#try button")
        offered.first.wait_for()
        words = offered.all_inner_texts()
        assert words[0] == "Lords and ladies" and "windows" in words and "minarets" not in words
        page.get_by_role("combobox", name="Look for").focus()
        page.locator("#offered option").first.wait_for(state="attached")
        listed = page.evaluate("[...document.querySelectorAll('#offered option')].map(({ value }) => value)")
        assert listed[: len(words)] == words
        page.evaluate("lang3dxl.ask('windows and lords and ladies')")
        assert [text.lower() for text in prompts_of(page)] == ["windows", "lords and ladies"]
        assert page.complaints == []
        page.close()


@pytest.mark.slow
def test_a_slow_machine_draws_drafts_until_nothing_changes(page):
    picture(page)
    width = page.evaluate("document.querySelector('#frame canvas').width")
    draft = page.evaluate("""async () => {
      lang3dxl.view.cost = 8e3;  // a draft for two seconds
      lang3dxl.view.wake();
      await new Promise(requestAnimationFrame);
      await new Promise(requestAnimationFrame);
      return document.querySelector("#frame canvas").width;
    }""")
    assert draft == pytest.approx(0.3 * width, abs=1)
    rest(page)
    assert page.evaluate("document.querySelector('#frame canvas').width") == width == SIDE


@pytest.mark.slow
def test_ask_answers_and_hostile_texts_stay_texts(page):
    answer = page.evaluate("lang3dxl.ask('dome')")
    assert answer["known"] and answer["matching"] > 100 and 0 < answer["threshold"] < answer["peak"] <= 1
    for text in (HOSTILE, "", ";;;", 'not "dome"', "x" * 5000, "__proto__", "constructor"):
        assert page.evaluate("(text) => lang3dxl.ask(text)", text)["known"] is False
    assert page.locator("h1").inner_text() == HOSTILE and page.title() == HOSTILE
    assert page.locator("img:not(#photo)").count() == 0
    page.evaluate("location.hash = 'view=nan,1,2&ask=%22%3Cimg%20src=x%3E&like=~x~-1.9e9~&not=%00'")
    page.wait_for_timeout(500)
    assert page.locator("img:not(#photo)").count() == 0


@pytest.mark.slow
@pytest.mark.parametrize("text", ["window%3B", "ask=window&ask=", "a" + "%20" * 32_000 + "b", "%22a", "not+"])
def test_a_link_of_any_length_opens_at_once_with_at_most_twenty_prompts(page, text):
    page.evaluate(f"location.hash = 'ask=' + {text!r}.repeat({text!r}.length > 99 ? 1 : 10000)")
    until(page, "document.querySelectorAll('#prompts > *').length < 21")
    assert page.evaluate("lang3dxl.ask('dome')")["known"]  # the page answers again
    assert len(prompts_of(page)) <= 21


@pytest.mark.slow
def test_at_the_width_of_a_phone_everything_is_in_reach(browser, address):
    page = opened(browser, address, PHONE)
    page.evaluate("lang3dxl.ask('dome; windows')")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    shape = page.locator("#frame canvas").bounding_box()
    assert shape["width"] == PHONE["width"] and shape["height"] >= 0.45 * PHONE["height"]
    for name in ("Ask", "Overview", "Still picture", "Copy link"):
        button = page.get_by_role("button", name=name, exact=True)
        button.scroll_into_view_if_needed()
        assert button.bounding_box()["height"] >= 40
    assert picture(page).std() > 5 and page.complaints == []
    page.close()


@pytest.mark.slow
def test_a_phone_opens_at_the_search_box_and_scrolls_to_what_is_asked(browser, address):
    page = opened(browser, address + "#ask=dome&ask=windows&ask=wall", PHONE)
    page.locator("#prompts strong", has_text="wall").wait_for()
    scrolled = "document.getElementById('panel').scrollTop"
    assert page.evaluate(scrolled) == 0
    page.evaluate("lang3dxl.ask('wall')")
    until(page, f"{scrolled} > 0")
    page.close()


@pytest.mark.slow
def test_escape_closes_and_deletes_nothing(page):
    page.evaluate("lang3dxl.ask('dome; windows')")
    page.get_by_role("button", name="Teach a word").click()
    page.get_by_text("Click on it in the view").wait_for()
    box = page.get_by_role("combobox", name="Look for")
    box.fill("wal")
    for where in ("#word", "#frame", "#frame", "#overview", "#frame"):
        page.locator(where).press("Escape")
    page.get_by_text("Click on it in the view").wait_for(state="detached")
    assert prompts_of(page) == ["dome", "windows"] and box.input_value() == "wal"
    box.fill("")
    page.evaluate(
        "Promise.all([lang3dxl.ask('wall'), lang3dxl.clear()])"
    )  # the running answer is dropped too
    until_linked(page, "ask=", False)
    assert prompts_of(page) == []


@pytest.mark.slow
def test_every_step_is_undone_and_redone_by_buttons_keys_and_the_browser(page):
    page.evaluate("lang3dxl.ask('dome')")
    page.evaluate("lang3dxl.ask('windows')")
    slider = page.get_by_label("Threshold of dome")
    slider.evaluate("""(slider) => { slider.value = 0.8;
      for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true })); }""")
    page.get_by_role("button", name="Remove windows").click()
    told = "lang3dxl.prompts.map(({ text, threshold }) => text + threshold.toFixed(1)).join()"
    until(page, told, "dome0.8")
    until_linked(page, "at=0.8")
    before = ["dome0.8,windows0.3", "dome0.3,windows0.3", "dome0.3", ""]
    low = page.evaluate("lang3dxl.ask('dome').then(({ threshold }) => threshold.toFixed(1))")
    assert low == "0.8"  # asked again, a prompt keeps its threshold
    page.get_by_role("button", name="Undo").click()
    until(page, told, before[0])
    page.locator("#frame").press("Control+z")
    until(page, told, before[1])
    page.go_back()
    until(page, told, before[2])
    page.go_back()
    until(page, told, before[3])
    for shown in before[-2::-1]:
        page.locator("#frame").press("Control+Shift+z")
        until(page, told, shown)
    page.get_by_role("button", name="Redo").click()
    until(page, told, "dome0.8")


@pytest.mark.slow
def test_a_dragged_threshold_is_followed_at_once(page):
    page.evaluate("lang3dxl.ask('dome')")
    milliseconds = page.evaluate("""() => {
      const slider = document.querySelector("#prompts input[type=range]"), start = performance.now();
      slider.value = 0.99;
      slider.dispatchEvent(new Event("input", { bubbles: true }));
      window.told = document.querySelector(".count").textContent;
      return performance.now() - start;
    }""")
    count = int(page.evaluate("told").split()[0].replace(",", ""))
    relevancy = page.evaluate("[...lang3dxl.prompts[0].relevancy]")
    assert count == sum(value > 0.99 for value in relevancy) and milliseconds < 5000  # in the same turn


@pytest.mark.slow
def test_a_link_carries_thresholds_colors_moving_and_boxes(page, browser, address):
    page.evaluate("lang3dxl.ask('dome; windows')")
    page.evaluate("""() => {
      const slider = document.querySelector("#prompts li:last-child input[type=range]");
      slider.value = 0.77;
      for (const kind of ["input", "change"]) slider.dispatchEvent(new Event(kind, { bubbles: true }));
      document.getElementById("more").open = true;
    }""")
    page.get_by_label("Boxes around").check()
    page.get_by_role("button", name="Walk").click()
    page.get_by_role("button", name="Remove dome").click()
    until(page, "lang3dxl.prompts.length", 1)
    told = """[lang3dxl.prompts.map(({ text, threshold, color }) => [text, threshold, color]),
      lang3dxl.view.mover.walking, document.getElementById("boxed").checked, lang3dxl.view.mover.address]"""
    shown = page.evaluate(told)
    for part in ("at=0.77", "walk=1", "boxes=1"):
        until_linked(page, part)
    until_linked(page, "dome", False)
    other = opened(browser, page.url, DESK)
    until(other, told, shown)
    assert shown[0][0][1] == 0.77
    other.close()
    page.get_by_label("Boxes around").uncheck()
    page.get_by_role("button", name="Walk").click()


# ── moving ──


@pytest.mark.slow
def test_one_walks_looks_and_orbits_by_keys(page):
    stand = """() => { const { position, target } = lang3dxl.view.mover.stand;
      return [position.toArray(), target.toArray()]; }"""
    page.evaluate("lang3dxl.view.mover.free = true")

    def after(key):
        before = np.array(page.evaluate(stand))
        page.locator("#frame").press(key)
        return before, np.array(page.evaluate(stand))

    before, now = after("ArrowLeft")  # around the target
    assert np.allclose(before[1], now[1]) and not np.allclose(before[0], now[0])
    up = np.array(page.evaluate("lang3dxl.view.camera.up.toArray()"))
    for key, axis in (
        ("w", "ahead"),
        ("s", "back"),
        ("a", "left"),
        ("d", "right"),
        ("e", "up"),
        ("q", "down"),
    ):
        before, now = after(key)
        way, ahead = now[0] - before[0], before[1] - before[0]
        assert np.allclose(now[1] - now[0], ahead, atol=1e-4)  # the view stays
        level = ahead - up * (ahead @ up)
        right = np.cross(level, up)
        aim = {"ahead": level, "back": -level, "left": -right, "right": right, "up": up, "down": -up}[axis]
        assert way @ aim > 0.99 * np.linalg.norm(way) * np.linalg.norm(aim) > 0
    before, now = after("ArrowRight")  # walking, arrows look
    assert np.allclose(before[0], now[0]) and not np.allclose(before[1], now[1])
    page.evaluate("lang3dxl.view.mover.free = false")
    page.locator("button[aria-pressed=true]", has_text="Walk").wait_for()


@pytest.mark.slow
def test_the_eye_stays_before_the_wall_unless_shift_is_held(page):
    for _ in range(100):
        page.wait_for_timeout(100)
        if page.evaluate("Boolean(lang3dxl.view.mover.space)"):
            break
    depth = "lang3dxl.view.mover.camera.position.z"  # the wall is z = 0
    for _ in range(40):
        page.locator("#frame").press("w")
    near = page.evaluate(depth)
    assert -2.5 < near < 0
    until_told(page, "#status", "hold Shift")
    for _ in range(40):
        page.locator("#frame").press("Shift+W")
    assert page.evaluate(depth) > 0.5
    page.get_by_role("button", name="Overview").click()
    page.locator("button[aria-pressed=false]", has_text="Walk").wait_for()


@pytest.mark.slow
def test_a_double_click_turns_around_what_is_there(page, scene):
    camera = scene.overview.full_camera
    x, y, z = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [1.5, 1.5, 0, 1]
    corner = page.locator("#frame canvas").bounding_box()
    page.emulate_media(reduced_motion="reduce")
    page.mouse.dblclick(corner["x"] + SIDE * x / z / camera.width, corner["y"] + SIDE * y / z / camera.width)
    for _ in range(50):
        page.wait_for_timeout(100)
        target = page.evaluate("lang3dxl.view.mover.stand.target.toArray()")
        if abs(target[0] - 1.5) < 0.15:
            break
    np.testing.assert_allclose(target, [1.5, 1.5, 0], atol=0.15)


@pytest.mark.slow
def test_with_two_fingers_one_walks_and_with_one_one_looks(browser, address):
    page = opened(browser, address, PHONE)
    page.get_by_role("button", name="Walk").click()
    drag = """(fingers) => {
      const canvas = document.querySelector("#frame canvas"), before = lang3dxl.view.mover.stand;
      const send = (kind, id, x, y) => canvas.dispatchEvent(new PointerEvent(kind,
        { pointerId: id, pointerType: "touch", isPrimary: id === 1, clientX: x, clientY: y, bubbles: true }));
      canvas.setPointerCapture = () => {};
      for (let id = 1; id <= fingers; id++) send("pointerdown", id, 100 + 50 * id, 200);
      for (let id = 1; id <= fingers; id++) send("pointermove", id, 100 + 50 * id, 240);
      for (let id = 1; id <= fingers; id++) send("pointerup", id, 100 + 50 * id, 240);
      const now = lang3dxl.view.mover.stand;
      return [now.position.distanceTo(before.position), now.target.clone().sub(now.position)
        .angleTo(before.target.clone().sub(before.position))];
    }"""
    page.evaluate("lang3dxl.view.mover.free = true")
    moved, turned = page.evaluate(drag, 1)
    assert moved < 1e-6 and turned > 0.05
    moved, turned = page.evaluate(drag, 2)
    assert moved > 1e-3 and turned < 1e-4
    page.close()


@pytest.mark.slow
def test_shortcuts_of_the_browser_do_not_steer(page):
    steered = f"""[{{ ctrlKey: true }}, {{ metaKey: true }}, {{ altKey: true }}, {{}}].map((held) =>
      !{PRESS}("-", held) || !{PRESS}("ArrowLeft", held))"""
    assert page.evaluate(steered) == [False, False, False, True]


@pytest.mark.slow
def test_the_same_prompt_asked_twice_at_once_has_one_card(page):
    page.evaluate("Promise.all(['dome', 'dome', 'windows'].map((text) => lang3dxl.ask(text)))")
    assert prompts_of(page) == ["dome", "windows"]
    colors = (
        "[...document.querySelectorAll('#prompts li')].map((card) => card.style.getPropertyValue('--color'))"
    )
    assert len(set(page.evaluate(colors))) == 2


@pytest.mark.slow
def test_of_two_addresses_the_later_one_is_shown(page):
    page.evaluate("location.hash = 'ask=windows&ask=wall&ask=belfry&not=sky'")
    page.evaluate("location.hash = 'ask=dome'")
    until_linked(page, "ask=%22dome%22")  # the page's own spelling: it has answered
    page.wait_for_timeout(1500)
    assert prompts_of(page) == ["dome"] and "ask=%22dome%22" in page.url and "wall" not in page.url


@pytest.mark.slow
def test_an_unknown_word_in_but_not_is_replaced_by_the_one_chosen(page):
    page.evaluate("lang3dxl.ask('windows')")
    page.evaluate("document.getElementById('more').open = true")
    common = page.get_by_role("textbox", name="But not")
    common.fill("sky, belfrey")
    page.locator("#near button").first.wait_for()
    page.evaluate("lang3dxl.ask('dome')")
    assert prompts_of(page) == ["windows"]
    page.locator("#near").get_by_role("button", name="belfry", exact=True).click()
    page.locator("#prompts strong", has_text="dome").wait_for()
    until(page, "document.getElementById('near').textContent", "")
    assert common.input_value() == "sky, belfry"
    page.evaluate("document.getElementById('not').value = ''")
    page.evaluate("""lang3dxl.ask('"dome" not "belfrey"')""")
    page.locator("#near").get_by_role("button", name="belfry", exact=True).click()
    page.get_by_text("dome not belfry").wait_for()


@pytest.mark.slow
def test_a_new_example_takes_a_number_that_is_free(page, scene):
    camera = scene.overview.full_camera
    x, y, z = camera.intrinsics.numpy() @ camera.view_matrix[:3].numpy() @ [1.5, 1.5, 0, 1]
    corner = page.locator("#frame canvas").bounding_box()
    names = page.get_by_role("textbox", name="Name")

    def like_the_dome():
        page.mouse.click(corner["x"] + SIDE * x / z / camera.width, corner["y"] + SIDE * y / z / camera.width)
        page.get_by_role("button", name="Like this", exact=True).click()
        page.get_by_text("1 example:").wait_for()
        page.get_by_role("button", name="Done").click()
        page.get_by_role("button", name="Done").wait_for(state="detached")
        return [one.input_value() for one in names.all()]

    assert like_the_dome() == ["like this 1"] and like_the_dome() == ["like this 1", "like this 2"]
    page.get_by_role("button", name="Remove like this 1").click()
    until(page, "lang3dxl.prompts.length", 1)
    assert like_the_dome() == ["like this 2", "like this 3"]


@pytest.mark.slow
def test_the_legend_of_a_still_picture_is_light_on_dark(page):
    page.evaluate("lang3dxl.ask('dome')")
    rest(page)
    with page.expect_download() as saved:
        page.get_by_role("button", name="Still picture").click()
    still = np.asarray(Image.open(saved.value.path()))
    legend = still[SIDE:]
    assert still.shape[2] == 3 or (still[..., 3] == 255).all()
    assert len(legend) > 10 and (legend[-1, :, :3] < 64).all() and legend[..., :3].max() > 200


@pytest.mark.slow
def test_a_lost_picture_comes_back(page):
    page.evaluate("lang3dxl.ask('dome')")
    before = picture(page)
    page.evaluate("""async () => {
      window.loss = lang3dxl.view.renderer.getContext().getExtension("WEBGL_lose_context");
      lang3dxl.view.wake();
      await new Promise(requestAnimationFrame);
      loss.loseContext();
      lang3dxl.view.wake();
    }""")
    page.wait_for_timeout(500)
    page.evaluate("loss.restoreContext()")
    assert np.abs(picture(page) - before).max() <= 2


@pytest.mark.slow
def test_without_webgl_it_says_what_helps(browser, address):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(address)
    page.evaluate("lang3dxl.ready.catch(() => true)")
    until_told(page, "#status", "hardware acceleration")
    page.close()


@pytest.mark.slow
def test_colors_alone_cant_be_typed_to(browser, tmp_path):
    write_page(Page(painted_scene(decoder=None, codes=None)), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address + "#ask=dome&like=it~1", DESK)
        assert page.get_by_role("combobox", name="Look for").is_disabled()
        assert page.get_by_role("button", name="Ask").is_disabled() and prompts_of(page) == []
        until_told(page, "#status", "colors alone")
        assert page.complaints == []
        page.close()


@pytest.mark.slow
def test_an_over_long_phrase_is_cut_before_it_is_sent(browser, address):
    page = browser.new_page()
    page.goto(address + "LICENSES.txt")
    sent = page.evaluate("""async () => {
      const { Vocabulary } = await import("/vocabulary.js"), sent = [];
      const described = { words: [], negatives: [], taught: {}, special: {} };
      window.fetch = async (address) => (sent.push(address), { ok: true, json: async () => ({}) });
      await new Vocabulary(described, new ArrayBuffer(0), 3, true).phrase("𝒙".repeat(5000));
      return decodeURIComponent(sent[0]);
    }""")
    assert sent == "api/encode?text=" + 2000 * "𝒙"
    page.close()


def test_a_page_of_other_people_is_not_replaced(scene, tmp_path):
    for name in ("index.html", "scene.json", "page.css", "views.bin", "vocabulary.json", "photo.JPG"):
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        (folder / name).write_text("mine")
        with pytest.raises(UserError, match=rf"holds {name}, which is not a scene's page"):
            write_page(Page(scene), folder)
        assert [path.read_text() for path in folder.iterdir()] == ["mine"]
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "CNAME").write_text("mine")
    (own := tmp_path / "own" / "model.bin").parent.mkdir(exist_ok=True)
    write_page(Page(scene), own.parent)
    before = set(json.loads((own.parent / "scene.json").read_text())["files"].values())
    own.write_text("mine")
    write_page(Page(scene, more=["zoo"]), own.parent)  # without what is left of the page before
    after = set(json.loads((own.parent / "scene.json").read_text())["files"].values())
    left = {path.name for path in own.parent.iterdir()}
    assert before - after and not (before - after) & left and after <= left
    assert all(_DATA.fullmatch(name) for name in before)  # or it would stay for ever
    assert {"CNAME", "model.bin"} <= left


def test_a_page_whose_writing_was_stopped_is_written_again(scene, tmp_path, monkeypatch):
    written = []

    def stop(path, content):
        written.append(path)
        if len(written) == 2:
            raise KeyboardInterrupt
        path.write_bytes(content)

    with monkeypatch.context() as patched:
        patched.setattr("lang3dxl_ns.web.write_page.replace_file", stop)
        with pytest.raises(KeyboardInterrupt):
            write_page(Page(scene), tmp_path)
    assert write_page(Page(scene), tmp_path) == sum(path.stat().st_size for path in tmp_path.iterdir())


@pytest.mark.slow
def test_from_a_folder_it_says_what_it_needs(browser, scene, tmp_path):
    write_page(Page(scene), tmp_path)
    page = browser.new_page()
    page.goto(f"file://{tmp_path}/index.html")
    until_told(page, "#status", "http.server")
    page.close()


# ── files ───────────────────────────────────────────────────────────────────────────────────────────────


def test_a_page_is_complete_and_small(scene):
    files = Page(scene, ["dome; window"]).files()
    own = {name for name in files if name.endswith((".html", ".css", ".js", ".txt", "spark.bin"))}
    assert {
        "index.html",
        "page.css",
        "page.js",
        "worker.js",
        "library.js",
        "spark.bin",
        "LICENSES.txt",
    } <= own
    assert sum(len(files[name]) for name in own) < 1.4e6
    licenses = files["LICENSES.txt"].decode()
    assert all(name in licenses for name in ("three 0", "spark 2", "fflate 0", "MIT License"))
    assert json.loads(files["scene.json"])["prompts"] == [["dome"], ["window"]]


def test_all_views_are_in_a_page_and_what_is_left_out_is_told(monkeypatch, scene):
    page = Page(scene)
    files = page.files()
    names = [view["name"] for view in json.loads(files["scene.json"])["views"]]
    assert names == list(scene.visible) and page.left_out == []
    monkeypatch.setattr("lang3dxl_ns.web.write_page._MOST_BYTES", len(files["views.bin"]) - 1)
    smaller = page.files()
    about = json.loads(smaller["scene.json"])
    assert 0 < len(about["views"]) < len(names) and len(smaller["views.bin"]) < len(files["views.bin"])
    assert about["left_out"] == page.left_out == ["1 of 3 views are left out, to load quickly"]


def test_lightings_are_files_of_a_page_or_answers_of_a_server(monkeypatch):
    scene = painted_scene(looks=painted_looks())
    static, live = Page(scene), Page(scene, live=True)
    files = static.files()
    offered = json.loads(files["scene.json"])["looks"]
    assert list(offered) == scene.looks.names
    for name, file in offered.items():
        assert files[file] == live.colors(name) and len(files[file]) == 4 * len(scene.splats)
    assert len(set(map(files.get, offered.values()))) > 1
    assert json.loads(live.files()["scene.json"])["looks"]["all/0003.jpg"] == "api/look?photo=all/0003.jpg"
    monkeypatch.setattr("lang3dxl_ns.web.write_page._MOST_BYTES", 4 * len(scene.splats))
    assert len(json.loads(static.files()["scene.json"])["looks"]) == 1
    assert any("lightings are left out" in told for told in static.left_out)


TWO_LIGHTINGS = """async () => {
  const look = document.getElementById("look"), names = [...look.options].map((one) => one.value);
  const { fetch } = window, wait = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
  const delays = [0.5, 0];
  let shown = 0;
  window.fetch = async (file) => (await wait(delays.shift()), fetch(file));
  lang3dxl.view.light = () => shown++;
  for (const name of names.filter(Boolean).slice(0, 2)) {
    look.value = name;
    look.dispatchEvent(new Event("change"));
  }
  while (delays.length || !shown) await wait(0.1);
  await wait(1.5);
  return shown;
}"""


@pytest.mark.slow
def test_of_two_lightings_the_one_chosen_last_is_shown(browser, tmp_path):
    write_page(Page(painted_scene(looks=painted_looks())), tmp_path)
    with served(tmp_path) as address:
        page = opened(browser, address, DESK)
        assert page.evaluate(TWO_LIGHTINGS) == 1
        page.close()


def test_a_field_takes_eight_bytes_a_gaussian():
    scene = field_scene(3)
    files = Page(scene).files()
    assert len(files["codes.bin"]) == 8 * len(scene.splats) and "rows.bin" not in files
    assert len(files["splats.bin"]) == 16 * len(scene.splats)


def test_a_decoder_too_wide_for_a_page_is_refused_in_a_sentence(monkeypatch, scene):
    monkeypatch.setattr("lang3dxl_ns.web.pack._MOST_ROW_BYTES", 1000)
    with pytest.raises(UserError, match="preset `short`"):
        Page(scene)


def test_colors_alone_make_a_page_that_cant_be_asked(scene):
    bare = painted_scene(decoder=None, codes=None)
    assert json.loads(Page(bare).files()["scene.json"])["words"] is None
    with pytest.raises(UserError, match=re.escape(NO_SEMANTICS)):
        Page(bare, ["dome"])


def test_broken_gaussians_keep_their_rows(scene):
    splats = painted_splats()
    means = splats.means.clone()
    means[7] = torch.nan
    broken = painted_scene(splats=replace(splats, means=means))
    packed = np.frombuffer(Page(broken).files()["splats.bin"], np.uint8).reshape(-1, 16)
    whole = np.frombuffer(Page(scene).files()["splats.bin"], np.uint8).reshape(-1, 16)
    assert packed[7, 3] == 0 and len(packed) == len(whole)


# ── vocabulary ──────────────────────────────────────────────────────────────────────────────────────────


def test_the_words_of_a_tokenizer_are_whole_and_plain(tmp_path):
    words = whole_words("builtin")
    assert len(words) > 200 and {"window", "windows"} & set(words)
    assert all(word.isalpha() and word.islower() and len(word) >= 3 for word in words)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").write_bytes(b"")
    unigram = [["▁tower", -1.0], ["tower", -2.0], ["▁to", -3.0], ["▁Tow", -1.0]]
    (tmp_path / "tokenizer.json").write_text(json.dumps({"model": {"vocab": unigram}}))
    assert whole_words(tmp_path) == ("tower",)


def test_plurals_have_no_plural():
    words = {*common_words()}
    assert {"windows", "arches", "columns", "domes", "buses"} <= words
    assert not {"windowses", "archeses", "columnses", "pillarses"} & words


def test_a_vocabulary_of_ones_own_is_offered_and_named(tmp_path):
    (tmp_path / "words.txt").write_text("belfry\n\n  zebra crossing \nbelfry\n")
    assert read_names(tmp_path / "words.txt", "words") == ("belfry", "zebra crossing")
    with pytest.raises(UserError, match="list of words"):
        read_names(tmp_path / "missing.txt", "words")
    described = json.loads(
        Page(painted_scene(), words=["lych gate"], more=["porch", "zoo"]).files()["vocabulary.json"]
    )
    assert described["words"][: described["naming"]] == [*shipped_vocabulary(), "lych gate"]


def test_a_scene_that_is_wider_than_half_precision_is_refused_and_a_stray_gaussian_is_not():
    splats = painted_splats()
    means = splats.means.clone()
    means[0, 0] = 1e6
    stray = Page(painted_scene(splats=replace(splats, means=means))).files()["splats.bin"]
    packed = np.frombuffer(stray, np.uint8).reshape(-1, 16)
    assert np.isfinite(packed[:, 4:10].copy().view("<f2")).all()
    wide = replace(splats, means=1e5 * splats.means, scales=1e5 * splats.scales)
    with pytest.raises(UserError, match="make the splat smaller"):
        Page(painted_scene(splats=wide)).files()
