"""A scene's test views in a run: placed, prepared and scored like its photos."""

import json
import shutil

import numpy as np
import pytest
import torch
from label_sets import write_plain
from PIL import Image
from runs import fitted

from lab.landmark.demo_scene import FOLDER
from lab.landmark.novel_views import read_novel_views
from lab.landmark.novel_views_of_runs import evaluate_novel_views, novel_data
from lab.landmark.scene_writer import write_novel_cameras
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.score_run import Evaluation, EvaluationSettings
from lang3dxl_ns.scene.colmap import read_reconstruction

HELD_OUT = ("photo_000.jpg", "photo_008.jpg")


@pytest.fixture(scope="module")
def data(scene, tmp_path_factory):
    """The scene, with the held-out photos as its test views too: every figure must be the same."""
    folder = tmp_path_factory.mktemp("with_views") / "scene"
    shutil.copytree(scene, folder, ignore=shutil.ignore_patterns("lang3dxl_cache"))
    photos = read_reconstruction(folder / "sparse" / "0").photos
    (folder / FOLDER / "images").mkdir(parents=True)
    for name in HELD_OUT:
        shutil.copy(folder / "images" / name, folder / FOLDER / "images" / name)
        width, height = Image.open(folder / "images" / name).size
        mask = np.zeros((height, width), bool)
        mask[:, : width // 2] = True
        for truth in (folder / "ground_truth", folder / FOLDER / "ground_truth"):
            write_plain(truth, "dome", name.removesuffix(".jpg"), mask)
    write_novel_cameras(folder, [photos[name] for name in HELD_OUT], same_light=True)
    return folder


@pytest.fixture(scope="module")
def run(data, tiny_clip, tiny_dense, tmp_path_factory):
    """A finished run of two steps, to evaluate."""
    return fitted(data, tiny_clip, tiny_dense, tmp_path_factory.mktemp("run"))


def test_a_photo_as_a_test_view_is_placed_and_scored_as_the_photo(run, data):
    views = novel_data(run.data, read_novel_views(data)).views
    for name in HELD_OUT:
        own, photo = views[f"{FOLDER}/{name}"], run.data.views[name]
        torch.testing.assert_close(own.pose, photo.pose, atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(own.intrinsics, photo.intrinsics, atol=1e-4, rtol=1e-5)
        assert (own.width, own.height) == (photo.width, photo.height)
    results = Evaluation(run.state, run.data, EvaluationSettings()).scored(get_std=True)
    beside = {view.name: view.metrics for view in evaluate_novel_views(run.state, run.data)}
    assert set(beside) == {f"{FOLDER}/{name}" for name in HELD_OUT}
    for name, photo in results["photos"].items():
        view = beside[f"{FOLDER}/{name}"]
        same = [key for key in photo if key != "fps" and not key.endswith("_seconds")]
        assert {"psnr", "ap_dome", "teacher_ap_dome", "limit_ap_dome", "chance_ap_dome", "clip_l1"} <= set(
            same
        )
        assert {key: view[key] for key in same} == pytest.approx({key: photo[key] for key in same}, abs=1e-3)
    assert results["protocol"]["split"] == "held-out"
    assert results["limit_map"] > results["chance_map"] == pytest.approx(0.5, abs=0.02)


def test_in_another_light_colors_are_compared_once_matched(run, data):
    path = data / FOLDER / "cameras.json"
    content = path.read_text()
    path.write_text(json.dumps(json.loads(content) | {"same_light": False}))
    try:
        metrics = next(iter(evaluate_novel_views(run.state, run.data))).metrics
    finally:
        path.write_text(content)
    assert "cc_psnr" in metrics and not {"psnr", "ssim"} & set(metrics)


def test_a_scene_without_test_views_says_so(run, data):
    (data / FOLDER).rename(data / "away")
    try:
        with pytest.raises(UserError, match=r"has no test views: `lang3dxl demo-scene` makes"):
            list(evaluate_novel_views(run.state, run.data))
    finally:
        (data / "away").rename(data / FOLDER)
