"""Loading a scene from a run's folder alone."""

import re
import shutil
from dataclasses import replace
from math import isqrt
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from runs import train_run
from scenes import view_of, write_scene
from tiny_models import make_tiny_clip

import lang3dxl_ns
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.scores import open_scorer
from lang3dxl_ns.files.scene_file import describe_scene_file, keep_words, read_scene
from lang3dxl_ns.plugin.trainer_config import open_run
from lang3dxl_ns.query.answer import relevancy_maps
from lang3dxl_ns.query.relevancy import TEMPERATURE
from lang3dxl_ns.rendering import Gaussians, rasterize, spherical_harmonics
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.words.taught_words import Example

WHOLE_SKY = {"pipeline__model__sky_gaussians": 2_000}
"""Through gaps in a smaller one faint Gaussians show, which rounding draws or leaves out."""


@pytest.fixture(scope="module")
def trainer(tmp_path_factory, tiny_clip, tiny_dense):
    """A run whose photos are gone."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=6, points=200, mixed=True)
    (data / "masks").mkdir()
    Image.new("L", (8, 6), 255).save(data / "masks" / "photo_001.png")
    trainer = train_run(data, tiny_clip, tiny_dense, root / "outputs", 30, **WHOLE_SKY)
    data.rename(root / "moved")
    return trainer


@pytest.fixture(scope="module")
def scene_photos(tmp_path_factory):
    """A folder of photos."""
    return write_scene(tmp_path_factory.mktemp("photos"), photos=6, points=200)


@pytest.fixture
def config(trainer):
    return trainer.base_dir / "config.yml"


@pytest.fixture(scope="module")
def scene(trainer):
    return lang3dxl_ns.load_scene(trainer.base_dir / "config.yml")


def test_it_answers_without_its_photos(scene):
    match = scene.query('rose window; dome not "tower"', "photo_002.jpg")[1]
    photo = scene.file.photo("photo_002")
    assert match.relevancy.shape == photo.size[::-1]
    assert match.relevancy.min() >= 0 and match.relevancy.max() <= 1
    assert len(scene.relevancy("dome")) == len(scene.splats)
    assert scene.find("dome").relevancy.shape == (len(scene.splats),)


def test_a_clip_named_for_a_run_is_the_one_that_reads_its_texts(config, tiny_clip, tmp_path):
    moved = shutil.copytree(tiny_clip, tmp_path / "moved")
    assert lang3dxl_ns.load_scene(config, clip=str(moved)).query("dome", "photo_002.jpg").relevancy.any()
    other = make_tiny_clip(tmp_path / "other", seed=1)
    with pytest.raises(UserError, match="other is not the one"):
        lang3dxl_ns.load_scene(config, clip=str(other)).query("dome", "photo_002.jpg")


def test_the_loaded_model_renders_as_the_trained_one(scene, trainer):
    model = trainer.pipeline.model.eval()
    camera = scene.camera("photo_001.jpg")
    outputs = model.get_outputs_for_camera(view_of(camera))
    off = (scene.draw(camera).rgb - outputs["rgb"]).abs()
    assert off.max() < 1 / 255  # the rasterizer leaves it out: rounded poses move its edge
    assert (off > 1e-5).float().mean() < 1e-3
    torch.testing.assert_close(scene.codes, model.gauss_params["codes"].data, equal_nan=True)


def test_training_leaves_a_scene_file_that_answers_like_the_run(scene, trainer):
    (path,) = trainer.base_dir.glob("*.scene")
    found = lang3dxl_ns.load_scene(trainer.base_dir)
    assert describe_scene_file(path)["provenance"].made_how.startswith("lang3dxl")
    # Relevancy is steeper for encoders whose cosines lie close together, as random ones do.
    atol = 1e-3 * max(1.0, scene.engine.temperature / TEMPERATURE)
    for word in ("dome", "rose window"):
        np.testing.assert_allclose(found.relevancy(word), scene.relevancy(word), atol=atol)
    for photo in ("photo_000", "photo_003"):
        here, there = (s.render(photo).pixels.astype(float) / 255 for s in (scene, found))
        assert 10 * np.log10(1 / max(np.square(here - there).mean(), 1e-9)) > 40
    # The mask's file has moved with the data, but the scene holds it.
    assert found.file.photo("photo_001").foreground() is not None


def test_a_resumed_run_keeps_the_words_that_were_taught(train, scene_photos):
    first = train(scene_photos, iterations=2)
    (path,) = first.base_dir.glob("*.scene")
    keep_words(path, taught_in(path).words)
    again = train(scene_photos, iterations=3, load_dir=first.checkpoint_dir)
    assert again.base_dir != first.base_dir
    assert len(lang3dxl_ns.load_scene(again.base_dir).words["gizmo"].examples) == 1
    shutil.rmtree(first.checkpoint_dir)  # as somebody may who needs the space while it trains
    (written,) = again.base_dir.glob("*.scene")
    written.unlink()
    again.write_scene()
    assert lang3dxl_ns.load_scene(written).words


def taught_in(path: Path):
    """A scene that was taught a word."""
    scene = lang3dxl_ns.load_scene(path)
    photo = scene.photos[0]
    width, height = photo.lens.width, photo.lens.height
    return scene.teach("gizmo", Example(photo.name, box=(width / 4, height / 4, width / 2, height / 2)))


def test_cameras_are_those_that_were_trained_with(scene, trainer):
    datamanager = trainer.pipeline.datamanager
    for dataset in (datamanager.train_dataset, datamanager.eval_dataset):
        for i, photo in enumerate(dataset.photos):
            expected, camera = dataset.cameras[i], view_of(scene.camera(photo.name))
            torch.testing.assert_close(camera.camera_to_worlds[0], expected.camera_to_worlds)
            torch.testing.assert_close(
                camera.get_intrinsics_matrices()[0], expected.get_intrinsics_matrices()
            )
            assert (int(camera.width), int(camera.height)) == (int(expected.width), int(expected.height))


def test_the_files_frame_leads_back_to_colmaps(scene, trainer):
    """scale · (transform · COLMAP's camera center) is the camera's center in the model."""
    reconstruction = trainer.pipeline.datamanager.data.capture.reconstruction
    transform = torch.tensor(scene.file.transform, dtype=torch.float64)
    for photo in scene.file.photos:
        pose = torch.from_numpy(reconstruction.photos[photo.name].camera_from_world)
        center = -pose[:, :3].T @ pose[:, 3]
        here = scene.file.scale * (transform[:, :3] @ center + transform[:, 3])
        expected = torch.tensor(photo.camera_to_world, dtype=torch.float64)[:, 3]
        torch.testing.assert_close(here, expected, atol=1e-5, rtol=1e-5)


def test_a_query_is_what_evaluation_scores(scene, trainer, tiny_clip):
    """The same words, vectors and formula as ns-eval's average precision, at the size of training."""
    scorer = open_scorer(SimpleNamespace(categories=["dome", "door"]), str(tiny_clip), "cpu")
    side = min(max(photo.camera.width, photo.camera.height) for photo in scene.photos)
    model, camera = trainer.pipeline.model, scene.camera("photo_003.jpg", size=side)
    maps = relevancy_maps(snapshot(model.run, scene.file), camera, scorer.queries)
    for match, expected in zip(scene.query("dome; door", camera), maps, strict=True):
        seen = match.view.alpha >= scene.config.min_alpha
        np.testing.assert_allclose(match.relevancy[seen], expected.numpy()[seen], rtol=1e-5, atol=1e-6)


def test_a_folder_that_moved_can_be_asked(trainer, tmp_path):
    shutil.copytree(trainer.base_dir, tmp_path / "elsewhere")
    scene = lang3dxl_ns.load_scene(str(tmp_path / "elsewhere" / "config.yml"))
    scene.find("dome")
    assert (tmp_path / "elsewhere" / "lang3dxl_visible.safetensors").exists()


def test_a_model_in_training_can_be_asked(trainer):
    model = trainer.pipeline.model.eval()
    scene = snapshot(model.run, SceneRecord.read(trainer.base_dir / SCENE_FILE))
    before = scene.query("dome", "photo_000").relevancy
    assert np.isfinite(before).all()
    means = model.means.detach().clone()
    model.means.data += 1  # a snapshot: what training does later leaves it as it is
    np.testing.assert_array_equal(scene.query("dome", "photo_000").relevancy, before)
    model.means.data.copy_(means)


def test_mistakes_are_reported(config, tmp_path):
    with pytest.raises(UserError, match="is not a file or folder"):
        lang3dxl_ns.load_scene(tmp_path / "config.yml")
    (tmp_path / "config.yml").write_text("a: 1")
    with pytest.raises(UserError, match=r"not the config.yml of a nerfstudio run"):
        lang3dxl_ns.load_scene(tmp_path / "config.yml")
    shutil.copy(config, tmp_path)
    with pytest.raises(UserError, match=SCENE_FILE):
        lang3dxl_ns.load_scene(tmp_path / "config.yml")
    shutil.copy(config.parent / SCENE_FILE, tmp_path)
    with pytest.raises(UserError, match="holds no checkpoint"):
        lang3dxl_ns.load_scene(tmp_path / "config.yml")


def test_a_run_without_semantics_is_refused(trainer):
    file = SceneRecord.read(trainer.base_dir / SCENE_FILE)
    with pytest.raises(UserError, match="only colors"):
        snapshot(trainer.pipeline.model.run, replace(file, clip=None)).query("dome")


def test_another_clip_is_refused(trainer):
    file = SceneRecord.read(trainer.base_dir / SCENE_FILE)
    with pytest.raises(UserError, match="not the one that this scene was made with"):
        snapshot(trainer.pipeline.model.run, replace(file, clip_identity="another")).query("dome")


def test_a_run_remembers_its_foreground_masks(trainer, scene):
    photos = trainer.pipeline.datamanager.data.photos
    assert {photo.name for photo in scene.file.photos if photo.mask} == {"photo_001.jpg"}
    photo = scene.file.photo("photo_001")
    assert photo.mask == str(photos["photo_001.jpg"].mask_path)
    assert photo.foreground() is None  # its file has moved with the data


@pytest.mark.parametrize("look", ["on", "off"])
def test_an_exported_ply_has_the_colors_of_the_rendering(train, scene_photos, tmp_path, look):
    """The file, drawn by the rules of splat viewers, is the rendering."""
    changes = {"pipeline__model__appearance__use": look, "pipeline__model__view_dependence": "on"}
    trainer = train(scene_photos, 30, **changes, **WHOLE_SKY)
    scene = lang3dxl_ns.load_scene(trainer.base_dir / "config.yml")
    assert scene.export(tmp_path / "all.ply", "dome", everything=True) == len(scene.splats)
    rows = PlyData.read(tmp_path / "all.ply")["vertex"]
    columns = {name: torch.tensor(rows[name].copy()) for name in rows.data.dtype.names}
    camera = scene.overview.camera

    def stack(stem, count):
        return torch.stack([columns[f"{stem}_{i}"] for i in range(count)], 1)

    means = torch.stack([columns[axis] for axis in "xyz"], 1)
    count = sum(name.startswith("f_rest") for name in columns) // 3
    rest = (
        stack("f_rest", 3 * count).view(-1, 3, count).transpose(1, 2)
        if count
        else means.new_zeros(len(means), 0, 3)
    )
    coefficients = torch.cat((stack("f_dc", 3)[:, None], rest), 1)
    position = -camera.view_matrix[:3, :3].T @ camera.view_matrix[:3, 3]
    colors = (spherical_harmonics(isqrt(count + 1) - 1, means - position, coefficients) + 0.5).clamp_min(0)
    shapes = Gaussians(means, stack("rot", 4), stack("scale", 3).exp(), columns["opacity"].sigmoid())
    drawn = rasterize(shapes, camera, colors)
    view = scene.draw(camera)  # over black, like viewers
    assert view.alpha.mean() > 0.3 and (look == "on") == (count == 0)
    torch.testing.assert_close(drawn.image.clamp(0, 1), view.rgb, atol=2e-3, rtol=0)
    np.testing.assert_allclose(columns["relevancy"].numpy(), scene.relevancy("dome"))


def test_a_view_has_the_size_of_the_photos_file(train, scene_photos):
    trainer = train(scene_photos, 2, pipeline__datamanager__camera_res_scale_factor=0.5)
    scene = lang3dxl_ns.load_scene(trainer.base_dir)
    photo = scene.photos[0]
    with Image.open(scene_photos / "images" / photo.name) as file:
        assert photo.size == file.size == (2 * photo.lens.width, 2 * photo.lens.height)
        assert scene.render(photo.name).pixels.shape[:2] == file.size[::-1]
    assert max(scene.render(photo.name, size=20).pixels.shape[:2]) == 20


def test_a_run_of_a_version_without_some_settings_can_be_asked(trainer, tmp_path):
    shutil.copytree(trainer.base_dir, tmp_path / "run")
    config = tmp_path / "run" / "config.yml"
    lines = config.read_text().splitlines(keepends=True)
    config.write_text(
        "".join(line for line in lines if not line.strip().startswith(("code_rate:", "unseen:")))
    )
    assert lang3dxl_ns.load_scene(config).query("dome").relevancy.any()


def test_a_run_of_a_version_with_a_setting_that_has_gone_can_be_asked(trainer, tmp_path):
    shutil.copytree(trainer.base_dir, tmp_path / "run")
    config = tmp_path / "run" / "config.yml"
    text = config.read_text()
    gone = "    camera_optimizer: !!python/object:lang3dxl_ns.training.settings.CameraRefinementConfig\n"
    gone += "      mode: 'off'\n      rot_l2_penalty: 0.001\n      trans_l2_penalty: 0.01\n"
    text, count = re.subn(
        r"^    camera_optimizer: .*?\n(?=    \S)", gone, text, flags=re.MULTILINE | re.DOTALL
    )
    assert count == 1
    config.write_text(text)
    assert lang3dxl_ns.load_scene(config).query("dome").relevancy.any()


def test_a_run_of_a_version_whose_settings_were_in_other_modules_can_be_asked(trainer, tmp_path):
    shutil.copytree(trainer.base_dir, tmp_path / "run")
    config = tmp_path / "run" / "config.yml"
    text = config.read_text()
    for module, name in (("semantic_field", "SemanticFieldConfig"), ("compression", "CompressionConfig")):
        text, count = re.subn(rf"components\.field_settings\.{name}", f"components.{module}.{name}", text)
        assert count
    config.write_text(text)
    assert lang3dxl_ns.load_scene(config).query("dome").relevancy.any()


def test_a_run_that_trains_on_all_photos_leaves_a_scene_that_opens_and_opens_without_them(train, tmp_path):
    """The same photos are held out, then; the file lists each once."""
    data = write_scene(tmp_path / "photos", photos=4, points=60)
    run = train(data, 2, tmp_path / "out", pipeline__datamanager__dataparser__eval_mode="all").base_dir
    photos = read_scene(run / "photos.scene").photos
    assert len(photos) == 4 and {photo.split for photo in photos} == {"train"}
    shutil.rmtree(data)
    assert open_run(run)[1].datamanager.train_dataset.photos
