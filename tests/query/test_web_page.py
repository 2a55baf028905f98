"""The page of `lang3dxl export --web` in Chromium: complete without Internet, heat where the word is."""

import io
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from painted_scene import painted_scene
from PIL import Image

from lang3dxl_ns.query.overview import overview
from lang3dxl_ns.query.web.write_page import write_page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SIDE = 384
SWITCHES = [
    *("--headless", "--no-sandbox", "--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]
"""WebGL in software, as on a machine without a GPU."""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """No lines for requests."""


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(scene, folder, ["dome; window"], title="A wall", credit="Painted by nobody, CC0")
    return folder


@pytest.fixture(scope="module")
def page(folder):
    """The page, loaded; with the messages and foreign requests since."""
    sync_api = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no chromium: apt install chromium")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        page = browser.new_page(viewport={"width": SIDE, "height": SIDE})
        page.complaints = []
        page.on("console", lambda m: page.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        here = f"http://127.0.0.1:{server.server_port}/"
        local = (here, "data:", "blob:")
        page.on("request", lambda r: None if r.url.startswith(local) else page.complaints.append(r.url))
        page.goto(here)
        page.wait_for_function("window.ready", timeout=120_000)
        yield page
        browser.close()
    server.shutdown()


def picture(page) -> np.ndarray:
    """The canvas once two pictures in a row are equal, [SIDE, SIDE, 3]."""
    before = None
    for _ in range(60):
        page.wait_for_timeout(500)
        shot = page.locator("canvas").screenshot(style="#panel, #credit { display: none }")
        now = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)
        if before is not None and now.any() and np.array_equal(now, before):
            return now
        before = now
    raise AssertionError("the page never stops changing")


def cells(mask: np.ndarray) -> np.ndarray:
    """Where a mask fills at least a quarter of cells of 8 × 8 pixels: between Gaussians there are gaps."""
    return mask.reshape(SIDE // 8, 8, SIDE // 8, 8).mean((1, 3)) > 0.25


def test_a_word_lights_up_where_it_is(page, scene):
    plain = picture(page)
    page.get_by_role("button", name="dome").click()
    page.wait_for_function("window.shownWord === 'dome'")
    changed = cells(np.abs(picture(page) - plain).max(2) > 40)
    middle = tuple(scene.gaussians["means"].median(0).values.tolist())
    camera = overview(scene.photos, middle).camera
    there = cells(scene.query("dome", camera, size=SIDE)[0].mask.numpy())
    assert there.sum() >= 20 and (changed & there).sum() > 0.9 * (changed | there).sum()
    page.get_by_role("button", name="dome").click()  # once more: off
    page.wait_for_function("window.shownWord === null")
    assert np.abs(picture(page) - plain).max() <= 2


def test_the_picture_is_the_rendering(page, scene):
    middle = tuple(scene.gaussians["means"].median(0).values.tolist())
    expected = scene.render(overview(scene.photos, middle).camera, size=SIDE).pixels.astype(int)
    assert np.abs(picture(page) - expected).mean() < 6


def test_flying_leads_to_the_best_view(page, scene):
    page.get_by_role("button", name="Fly to").nth(1).click()
    page.wait_for_timeout(2500)
    expected = scene.render(scene.best_views("window")[0], size=SIDE).pixels.astype(int)
    assert np.abs(picture(page) - expected).mean() < 6
    page.get_by_role("button", name="Overview").click()
    page.wait_for_timeout(2500)


def test_nothing_failed_and_nothing_was_fetched_from_elsewhere(page):
    picture(page)
    assert page.complaints == []
    assert page.locator("#credit").inner_text() == "Painted by nobody, CC0"


def test_the_page_is_complete_and_small(folder):
    files = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert {"index.html", "page.js", "splats.js", "LICENSES.txt", "scene.json"} <= set(files)
    assert sum(files.values()) < 5e6
    licenses = (folder / "LICENSES.txt").read_text()
    assert all(name in licenses for name in ("three 0", "spark 2", "fflate 0", "MIT License"))
