"""The attach benchmark refuses a scene without words."""

from dataclasses import replace

import pytest
from painted_scene import painted_file, painted_splats

from lab.benchmarks.attach import AttachBenchmark
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import write_scene
from lang3dxl_ns.query.scene import Scene


def test_a_scene_without_words_is_refused(tmp_path):
    colors = Scene(painted_splats(), replace(painted_file(), clip=None))
    write_scene(tmp_path / "a.scene", colors)
    with pytest.raises(UserError, match="only colors"):
        AttachBenchmark([tmp_path / "a.scene"], tmp_path, tmp_path / "out").main()
    assert not (tmp_path / "out").exists()
