"""Fixtures of the page's tests: in each process one browser, and one page for tests of the painted wall."""

import shutil
from dataclasses import replace

import pytest
import torch
from pages import DESK, HOSTILE, RESET, SWITCHES, WORDS, opened, rest, served
from painted_scene import CHANNELS, encode_texts, painted_file, painted_scene

from lab.baselines.lifting import LiftedFeatures
from lang3dxl_ns.files.scene_file import Provenance, write_scene
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
    desk.evaluate(RESET)
    rest(desk)
    yield desk
    assert desk.complaints == []


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A scene file, whose CLIP is the painted one."""
    monkeypatch.setattr("lang3dxl_ns.query.answering.text_encoder", lambda file, device: encode_texts)
    decoder, painted = LiftedFeatures(CHANNELS, 0), painted_scene()
    decoder.name = "lifting"
    codes = torch.cat([torch.nan_to_num(painted.codes), torch.ones(len(painted.codes), 1)], 1)
    told = replace(painted_file(), data="wall")
    write_scene(tmp_path / "wall.scene", painted_scene(decoder=decoder, codes=codes, file=told))
    return tmp_path / "wall.scene"
