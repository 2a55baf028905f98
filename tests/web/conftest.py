"""Fixtures of the page's tests: in each process one browser, and one page for tests of the painted wall."""

import shutil

import pytest
from pages import DESK, HOSTILE, STAND, SWITCHES, WORDS, opened, rest, served
from painted_scene import painted_scene

from lang3dxl_ns.files.scene_file import Provenance
from lang3dxl_ns.web.write_page import Page, write_page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """Chromium with a profile of its own, which keeps compiled scripts and shaders: the second page opens in
    half the time. Where a test's context has to be empty, it makes another."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="install the [test] extra for playwright")
    if CHROMIUM is None:
        pytest.skip("there is no chromium: apt install chromium")
    with sync_api.sync_playwright() as p:
        profile = tmp_path_factory.mktemp("profile")
        context = p.chromium.launch_persistent_context(profile, executable_path=CHROMIUM, args=SWITCHES)
        yield context.browser
        context.close()


@pytest.fixture(scope="session")
def scene():
    return painted_scene()


@pytest.fixture(scope="session")
def address(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    write_page(Page(scene, more=WORDS, provenance=Provenance(HOSTILE, "Painted by nobody", "CC0")), folder)
    with served(folder) as address:
        yield address


@pytest.fixture(scope="session")
def desk(browser, address):
    return opened(browser, address, DESK)


@pytest.fixture
def page(desk):
    """The page, without prompts, where the overview's photo was taken."""
    for _ in range(4):  # whatever is open
        desk.locator("#frame").press("Escape")
    desk.evaluate("lang3dxl.clear()")
    desk.evaluate("Object.assign(lang3dxl.view.mover, { free: false, shift: false })")
    desk.evaluate("document.getElementById('free').checked = false")
    desk.emulate_media(reduced_motion="reduce")  # no second of flight
    desk.get_by_role("button", name="Overview").click()
    desk.evaluate(STAND)
    rest(desk)
    desk.emulate_media(reduced_motion="no-preference")
    yield desk
    assert desk.complaints == []
