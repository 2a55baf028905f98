"""Distances on the page: between two clicks on the painted wall, in meters by the scene's georeference."""

import re
from dataclasses import replace

from painted_scene import painted_file, painted_scene
from test_web_page import DESK, browser, opened, served  # noqa: F401

from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.web.write_page import Page, write_page

CLICK = """async ([x, y]) => {
  const [column, row] = lang3dxl.view.pixel([x, y, 0]);
  lang3dxl.view.dispatchEvent(new CustomEvent("click", { detail: { x: column, y: row } }));
  await new Promise((go) => setTimeout(go, 300));
  return document.getElementById("status").textContent;
}"""


def test_two_clicks_tell_a_distance_in_meters_and_its_height(browser, tmp_path):  # noqa: F811
    meters = Georeference(20.0, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), 0.03, 5)
    for name, known in (("gps", meters), ("none", None)):
        write_page(Page(painted_scene(file=replace(painted_file(), georeference=known))), tmp_path / name)
        with served(tmp_path / name) as address:
            tab = opened(browser, address, DESK)
            tab.evaluate("document.getElementById('measuring').click()")
            assert tab.evaluate(CLICK, [-0.6, -0.4]) == "Click the other end."
            told = tab.evaluate(CLICK, [0.6, 0.5])
            tab.close()
        apart, rise = map(float, re.match(r"([\d.]+) \S+ apart, ([\d.]+) ", told).groups())
        scale = 20 if known else 1
        assert abs(apart - 1.5 * scale) < 0.15 * scale and abs(rise - 0.9 * scale) < 0.15 * scale
        assert ("± 3 %" in told) == (known is not None) == ("units" not in told)
