"""nerfstudio's commands on our method, as in the README.

A shell starts `ns-train`; the others import what it does, and find the method as it does.
"""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image
from processes import output as command
from processes import run as attempt
from scenes import write_ply, write_scene, write_transforms

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]
FEW = (
    *("--pipeline.model.decoder.compression.steps", 40),
    *("--pipeline.model.decoder.compression.batch", 512),
    *("--pipeline.model.semantic-field.code-dim", 3),
)
"""Learning codes from photos takes 15 seconds otherwise, whatever the number of iterations."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("commands")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Ten photos of mixed sizes, of which two are held out."""
    return write_scene(tmp_path_factory.mktemp("scene"), photos=10, points=100, mixed=True)


@pytest.fixture(scope="module")
def run(scene, tiny_clip, tiny_dense, folder) -> Path:
    """A run folder made by ns-train."""
    command(
        *("ns-train", "lang3dxl", "--data", scene, "--max-num-iterations", 8, "--vis", "tensorboard"),
        *("--pipeline.datamanager.clip", tiny_clip, "--pipeline.datamanager.dense", tiny_dense, *FEW),
        *("--output-dir", folder / "outputs", "--timestamp", "first"),
        cwd=folder,
        shell=True,
    )
    return folder / "outputs" / scene.name / "lang3dxl" / "first"


def test_eval(run, folder):
    words = ("ns-eval", "--load-config", run / "config.yml", "--output-path", folder / "eval.json")
    command(*words, cwd=folder)
    results = json.loads((folder / "eval.json").read_text())["results"]
    assert {"psnr", "ssim", "clip_l1", "clip_psnr", "clip_cosine", "psnr_std"} <= set(results)


@pytest.fixture
def camera_path(folder) -> Path:
    """As the viewer saves it."""
    pose = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1]
    frames = [{"camera_to_world": pose, "fov": 60.0, "aspect": 1.5}] * 2
    path = {"camera_type": "perspective", "render_width": 48, "render_height": 32, "seconds": 0.1}
    (folder / "path.json").write_text(json.dumps({**path, "camera_path": frames, "crop": None}))
    return folder / "path.json"


@pytest.mark.parametrize("views", ["interpolate", "dataset", "camera-path"])
def test_render_shows_what_is_asked_for(run, folder, camera_path, monkeypatch, views):
    monkeypatch.setenv("LANG3DXL_QUERY", "rose window; dome")
    target = folder / f"rendered-{views}"
    words = {
        "interpolate": ("--interpolation-steps", 2, "--output-format", "images"),
        "dataset": ("--split", "test"),
        "camera-path": ("--camera-path-filename", camera_path, "--output-format", "images"),
    }[views]
    command(
        *("ns-render", views, "--load-config", run / "config.yml", "--output-path", target, *words),
        *("--rendered-output-names", "rgb", "relevancy_0", "relevancy_1", "overlay", "bottleneck", "things"),
        cwd=folder,
    )
    pictures = sorted(path.relative_to(target) for path in target.rglob("*.jpg"))
    if views == "dataset":  # a folder per output
        outputs = {"rgb", "relevancy_0", "relevancy_1", "overlay", "bottleneck", "things"}
        assert {path.parts[1] for path in pictures} == outputs
    else:  # the outputs side by side
        with Image.open(target / pictures[0]) as picture:
            assert picture.width % 6 == 0 and picture.width > picture.height
    if views == "camera-path":
        assert len(pictures) == 2 and picture.size == (6 * 48, 32)


def test_export_splat(run, folder):
    words = ("ns-export", "gaussian-splat", "--load-config", run / "config.yml", "--output-dir")
    command(*words, folder / "ply", cwd=folder)
    header = (folder / "ply" / "splat.ply").read_bytes()[:2000]
    assert header.startswith(b"ply")
    assert b"f_dc_0" in header


@pytest.mark.parametrize(("points", "said"), [(True, "crop sides"), (False, "no 3D points")])
def test_transforms_json_scenes_train_too(train, tmp_path, capsys, points, said):
    """As LERF-OVS and DL3DV scenes come, without tracks: sizes come from the seed points, or are relative."""
    data = write_scene(tmp_path / "scene", photos=5, points=100)
    model = write_transforms(data, **({"ply_file_path": "points.ply"} if points else {}))
    write_ply(data / "points.ply", "ascii", ["f4"] * 3, model.points.tolist())
    shutil.rmtree(data / "sparse")
    train(data, 3, pipeline__model__random_init=not points, pipeline__model__num_random=200)
    assert said in " ".join(capsys.readouterr().out.split())


def test_a_mistake_is_one_sentence_without_traceback(folder):
    options = ("--vis", "tensorboard", "--output-dir", folder / "outputs")
    options += ("--pipeline.datamanager.clip", "none")
    done = attempt("ns-train", "lang3dxl", "--data", "nowhere", *options, cwd=folder)
    assert done.returncode == 1
    assert "nowhere is not a folder" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
