"""Distances on the page: between two clicks on the painted wall, in meters by the scene's georeference."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pages import DESK, opened, served, until_linked, until_told
from painted_scene import painted_file, painted_scene

from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.things.find import heights_of, up_of
from lang3dxl_ns.web.write_page import Page, write_page

CLICK = """async ([x, y]) => {
  const [column, row] = lang3dxl.view.pixel([x, y, 0]), status = document.getElementById("status");
  status.textContent = "";
  lang3dxl.view.dispatchEvent(new CustomEvent("click", { detail: { x: column, y: row } }));
  while (!status.textContent) await new Promise((go) => setTimeout(go, 50));
  return status.textContent;
}"""


HERE = """async ([x, y]) => {
  const [column, row] = lang3dxl.view.pixel([x, y, 0]), here = document.getElementById("here");
  here.hidden = true;
  lang3dxl.view.dispatchEvent(new CustomEvent("click", { detail: { x: column, y: row } }));
  while (here.hidden) await new Promise((go) => setTimeout(go, 50));
  return here.textContent;
}"""


@pytest.fixture(scope="module", params=[20.0, None], ids=["meters", "no meters"])
def wall(request, browser, tmp_path_factory):
    """The painted wall, how many meters a unit of it has, if it is known, and its page."""
    known = request.param and Georeference(request.param, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), 0.03, 5)
    scene = painted_scene(file=replace(painted_file(), georeference=known))
    folder = tmp_path_factory.mktemp("wall")
    write_page(Page(scene), folder)
    with served(folder) as address:
        tab = opened(browser, address, DESK)
        yield scene, request.param, tab
        tab.close()


def test_a_click_tells_its_height_above_the_ground(wall):
    scene, meters, tab = wall
    (ground, top), up = heights_of(scene), up_of(scene)
    unit = meters or 100 / (top - ground)
    for height in (0.5, 1.5):
        told = tab.evaluate(HERE, [0.6, height])
        number = float(re.search(r"It is ([\d.]+) (m|%) above the ground", told)[1])
        assert abs(number - unit * (up @ [0.6, height, 0] - ground)) < 0.1 * unit
    low = (ground + 0.01 - 0.6 * up[0]) / up[1]
    assert "It is on the ground" in tab.evaluate(HERE, [0.6, low])


def test_two_clicks_tell_a_distance_in_meters_and_its_height(wall):
    scene, meters, tab = wall
    tab.evaluate("document.getElementById('measuring').click()")
    assert tab.evaluate(CLICK, [-0.6, -0.4]) == "Click the other end."
    told = tab.evaluate(CLICK, [0.6, 0.5])
    apart, rise = map(float, re.match(r"([\d.]+) \S+ apart, one ([\d.]+) ", told).groups())
    scale = meters or 100 / np.ptp(heights_of(scene))
    assert abs(apart - 1.5 * scale) < 0.15 * scale and abs(rise - 0.9 * scale) < 0.15 * scale
    assert ("± 3 %" in told) == (meters is not None) == ("landmark's height" not in told)


SCALE = """() => {
  const { camera, controls } = lang3dxl.view, bar = document.getElementById("bar");
  const across = camera.position.clone().setFromMatrixColumn(camera.matrixWorld, 0);
  const place = (unit) => controls.target.clone().addScaledVector(across, unit).toArray();
  const pixels = (unit) => lang3dxl.view.pixel(place(unit))[0];
  const { width } = bar.getBoundingClientRect(), angle = document.getElementById("north").style.transform;
  const { hidden } = document.getElementById("scale"), unit = pixels(1) - pixels(0);
  return { hidden, told: bar.textContent, width, unit,
    arrow: document.getElementById("north").hidden ? null : parseFloat(angle.slice(7)) };
}"""

FRAMES = """async () => {
  do await new Promise((go) => setTimeout(go, 50));
  while (!lang3dxl.view.resting);
}"""


def test_a_typed_length_sets_the_scale_and_travels_in_the_link(browser, tmp_path):
    write_page(Page(painted_scene()), tmp_path)
    with served(tmp_path) as address:
        tab = opened(browser, address, DESK)
        assert tab.evaluate(SCALE)["hidden"]
        tab.evaluate("document.getElementById('more').open = true")
        tab.evaluate("document.getElementById('measuring').click()")
        tab.evaluate(CLICK, [-0.6, -0.4])
        shares = float(tab.evaluate(CLICK, [0.6, 0.5]).split()[0])
        units = shares / 100 * np.ptp(heights_of(painted_scene()))
        tab.fill("#length", "30,0")
        tab.press("#length", "Enter")
        until_told(tab, "#status", "30 m apart")
        until_linked(tab, "unit=")
        link = tab.evaluate("location.href")
        tab.close()
        tab = opened(browser, link, DESK)
        found = tab.evaluate(SCALE)
        tab.close()
    meters = float(found["told"].removesuffix(" m"))
    assert found["arrow"] is None and 40 < found["width"] <= 121
    assert abs(found["width"] / found["unit"] * 30 / units / meters - 1) < 0.02


def test_the_arrow_points_north(browser, tmp_path):
    meters = Georeference(20.0, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), 0.03, 5)
    write_page(Page(painted_scene(file=replace(painted_file(), georeference=meters))), tmp_path)
    angles = []
    with served(tmp_path) as address:
        tab = opened(browser, address, DESK)
        for eye in (
            "-4,0,0",
            "4,1,0",
            "0,-1,4",
            "0,0,-4",
        ):  # looking north, south, east, west
            tab.evaluate(f"lang3dxl.view.mover.goTo('{eye},0,0,0,60')")
            tab.evaluate(FRAMES)
            angles.append(tab.evaluate(SCALE)["arrow"])
        tab.close()
    turns = np.exp(1j * np.array(angles))
    np.testing.assert_allclose(turns, [1, -1, -1j, 1j], atol=1e-3)
