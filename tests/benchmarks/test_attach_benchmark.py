"""The attach benchmark: what it attaches, and what it refuses."""

from dataclasses import replace

import pytest
from painted_scene import painted_file, painted_scene, painted_splats

from lang3dxl_ns.benchmarks import attach as benchmark
from lang3dxl_ns.benchmarks.attach import AttachBenchmark, attached
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.read_splats import read_splats
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.scene_file import write_scene


def test_a_scenes_splat_is_attached_with_photos_and_without_once(tmp_path, monkeypatch):
    scene, made = painted_scene(), []

    def attach(splat, photos, out, config):
        assert len(read_splats(splat)) == len(scene.splats) and config.preparation.clip == scene.file.clip
        made.append((out.name, photos))
        out.touch()

    monkeypatch.setattr(benchmark, "attach", attach)
    wanted = [tmp_path / "with-photos.scene", tmp_path / "without-photos.scene"]
    assert attached(scene, tmp_path / "photos", tmp_path) == wanted
    assert made == [("with-photos.scene", tmp_path / "photos"), ("without-photos.scene", None)]
    wanted[1].unlink()
    attached(scene, tmp_path / "photos", tmp_path)
    assert made[2:] == [("without-photos.scene", None)]


def test_a_scene_without_words_is_refused(tmp_path):
    colors = Scene(painted_splats(), replace(painted_file(), clip=None))
    write_scene(tmp_path / "a.scene", colors)
    with pytest.raises(UserError, match="colors alone"):
        AttachBenchmark([tmp_path / "a.scene"], tmp_path, tmp_path / "out").main()
    assert not (tmp_path / "out").exists()
