"""Marks on the page: a marked pixel's place is the point that the pixel shows."""

import json

import numpy as np
from pages import THINK, camera_of_page, served, tilted_scene

from lang3dxl_ns.web.write_page import Page, write_page


def test_a_mark_lies_in_its_photo_where_the_point_of_its_pixel_does(browser, tmp_path):
    write_page(Page(tilted_scene()), tmp_path)
    about = json.loads((tmp_path / "scene.json").read_text())
    camera, views = camera_of_page(about["start"], about["center"]), {v["name"]: v for v in about["views"]}
    compared = 0
    with served(tmp_path) as address:
        page = browser.new_page()
        page.goto(address + "LICENSES.txt")
        for share in np.random.default_rng(0).uniform(0.3, 0.7, (12, 2)):
            at = {"camera": camera, "x": share[0] * camera["width"], "y": share[1] * camera["height"]}
            pixel = [at["x"], at["y"]]
            mark = page.evaluate(THINK, ["mark", {"camera": camera, "pixels": [pixel], "prefer": []}])
            point = page.evaluate(THINK, ["point", at])
            if not mark["points"]:
                continue
            view = views[mark["photo"]]
            x, y, z, _ = np.linalg.inv(view["pose"]) @ [*point, 1]
            column, row = view["cx"] - view["fx"] * x / z, view["cy"] + view["fy"] * y / z
            expected = [column / view["width"], row / view["height"]]
            np.testing.assert_allclose(mark["points"][0], expected, atol=1e-4)
            compared += 1
        page.close()
    assert compared >= 6
