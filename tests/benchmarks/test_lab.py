"""Benchmarks of the laboratory: available in a checkout, and what they report. lab/tests has more."""

from pathlib import Path

import numpy as np
import pytest
from painted_scene import painted_scene

from lab.benchmarks import attach
from lab.benchmarks.published import HolyScenes, published_figures
from lang3dxl_ns import cli

OF_LAB = ["numerics", "demo-scene", *(f"benchmark {name}" for name in cli.BENCHMARKS)]


@pytest.mark.parametrize("name", OF_LAB)
def test_without_a_checkout_the_remedy_is_told(name, monkeypatch):
    monkeypatch.setattr(cli, "LAB", Path("/site-packages/lab"))
    with pytest.raises(SystemExit, match="this command comes with a checkout of the repository"):
        cli.main([*name.split(), "--help"])


def test_without_a_checkout_the_demo_writes_nothing_and_tells_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "LAB", Path("/site-packages/lab"))
    with pytest.raises(SystemExit, match="this command comes with a checkout of the repository"):
        cli.main(["demo", "--out", str(tmp_path / "demo")])
    assert not list(tmp_path.iterdir())


def test_a_scenes_splat_is_attached_with_photos_and_without_once(tmp_path, monkeypatch):
    made = []

    def attached(splat, photos, out, config):
        made.append((out.name, photos))
        out.touch()

    monkeypatch.setattr(attach, "attach", attached)
    wanted = [tmp_path / "with-photos.scene", tmp_path / "without-photos.scene"]
    assert attach.attached(painted_scene(), tmp_path / "photos", tmp_path) == wanted
    assert made == [("with-photos.scene", tmp_path / "photos"), ("without-photos.scene", None)]
    wanted[1].unlink()
    attach.attached(painted_scene(), tmp_path / "photos", tmp_path)
    assert made[2:] == [("without-photos.scene", None)]


def test_ours_stand_beside_the_published_figures_of_their_scene_and_category():
    def results(**photos):
        mean = float(np.mean(list(photos.values())))
        figures = {name: {"authors_ap_windows": ap, "ap_windows": ap} for name, ap in photos.items()}
        both = {"map": mean, "authors_map": mean, "ap_windows": mean, "authors_ap_windows": mean}
        return both | {"ap_windows_photos": len(photos), "photos": figures}

    scenes = {"milano": results(a=0.1, b=0.2, c=0.3), "St_Paul": results(a=0.9)}
    benchmark = HolyScenes(data=Path(), out=Path())
    _, by_scene, _, together = benchmark.tables(scenes, published_figures("holyscenes"))
    heads, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in by_scene.splitlines())
    rows = {(line[0], line[1]): dict(zip(heads, line, strict=True)) for line in lines}
    for scene, ours, theirs in (("milano", "0.200", "0.740"), ("St_Paul", "0.900", "0.720")):
        row = rows[scene, "windows"]
        assert row["AP as published"] == ours and row["Lang3D-XL, published"] == theirs
    assert "| photos pooled | windows | 4 | 0.375 |" in together
    assert "| mean of scenes | windows | " in together and "| 0.550 |" in together
