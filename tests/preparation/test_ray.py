"""Workers on a Ray cluster; one cluster serves all tests, since it takes half a minute to start."""

import os
import shutil
from pathlib import Path

import pytest
import torch
from scenes import speckled, write_scene
from tiny_models import make_tiny_clip
from worker_tasks import Squares, prepare, write_photo

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.parallel import _connect, run
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """Connected to, as by `--engine ray` without an address."""
    ray = pytest.importorskip("ray")
    patch = pytest.MonkeyPatch()
    # The cluster's processes have to find the tests.
    tests = str(Path(__file__).parents[1])
    patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (tests, os.environ.get("PYTHONPATH", "")))))
    try:
        _connect(ray, PreparationConfig(workers=2, engine="ray"))
    except UserError as error:
        pytest.skip(f"this machine is too busy to start a cluster: {error}")
    yield ray
    ray.shutdown()
    patch.undo()


def test_a_worker_that_is_killed_is_replaced_and_the_job_ends_complete(tmp_path):
    found = dict(
        run(PreparationConfig(workers=2, engine="ray"), Squares(tmp_path, deadly=5).start, range(12), "cpu")
    )
    assert found == {item: item**2 for item in range(12)}
    assert (tmp_path / "sprung").exists()


def test_workers_of_a_cluster_make_the_targets_that_one_process_makes(cluster, tmp_path):
    clip = str(make_tiny_clip(tmp_path / "clip", dim=16, image_size=16))
    for i in range(4):
        write_photo(tmp_path, f"{i}.png", i)
    one = prepare(tmp_path, clip, 1, "local")
    shutil.rmtree(tmp_path / "store")
    several = prepare(tmp_path, clip, 2, "ray")
    torch.testing.assert_close(one, several)
    assert cluster.is_initialized()  # it was there before: it is left running


def test_workers_of_a_cluster_find_the_features_and_matches_of_photos(cluster, tmp_path):
    write_scene(tmp_path / "data", photos=7, size=(240, 180), paint=speckled)
    shutil.rmtree(tmp_path / "data" / "sparse")
    settings = ReconstructionSettings(features="sift", engine="ray", workers=2)
    _, model = reconstruct_scene(tmp_path / "data", None, settings)
    assert len(read_reconstruction(model).photos) == 7
