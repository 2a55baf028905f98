"""Runs whose photos change, vanish or are damaged between their parts."""

import shutil
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from runs import make_trainer
from scenes import write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import describe_scene_file, read_scene
from lang3dxl_ns.files.scene_file import write_scene as write_scene_file
from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer
from lang3dxl_ns.plugin.trainer_config import open_run, read_config
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.words.taught_words import TaughtWord

PARSER = "pipeline__datamanager__dataparser__"


def held_out(folder, *names):
    path = folder / f"held_out_{names[0]}.txt"
    path.write_text("\n".join(names))
    return {f"{PARSER}held_out": path}


def test_a_frame_that_is_meters_away_on_a_map_is_another_one():
    """Its shift is small beside coordinates of millions of meters."""
    pose = [[1.0, 0, 0, -5e5], [0, 1.0, 0, -5.4e6], [0, 0, 1.0, 0]]
    moved = [[1.0, 0, 0, -5e5], [0, 1.0, 0, -5.4e6 - 100], [0, 0, 1.0, 0]]
    file = SceneRecord([], None, None, 0.01, pose, "data")
    same, other = (Frame(np.array(transform), 0.01) for transform in (pose, moved))
    assert file.has_frame(same) and not file.has_frame(other)


def test_photos_that_change_sides_are_told_on_resume(train, tmp_path, capsys):
    data = write_scene(tmp_path / "scene", photos=6, points=60)
    first = train(data, 2, semantics=False, **held_out(tmp_path, "photo_000"))
    capsys.readouterr()
    train(data, 3, semantics=False, load_dir=first.checkpoint_dir, **held_out(tmp_path, "photo_005"))
    said = " ".join(capsys.readouterr().out.split())
    assert "2 photos moved between the training and held-out sets" in said
    assert "photo_000.jpg, photo_005.jpg" in said


def test_corrections_of_cameras_are_not_given_to_other_photos(train, tmp_path):
    data = write_scene(tmp_path / "scene", photos=6, points=60)
    refined = {"pipeline__model__camera_optimization": "on"}
    first = train(data, 2, semantics=False, **refined, **held_out(tmp_path, "photo_000"))
    with pytest.raises(UserError, match="corrections of other training photos' cameras"):
        train(
            data, 3, semantics=False, load_dir=first.checkpoint_dir, **refined,
            **held_out(tmp_path, "photo_005"),
        )  # fmt: skip


def test_features_are_gathered_at_the_cameras_that_training_refined(train, tmp_path):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    pipeline = train(data, 2, semantics=False, pipeline__model__camera_optimization="on").pipeline
    model = pipeline.model.train()
    data = pipeline.datamanager
    camera, _ = next(data.read(data.data.capture.split.train))
    places = model.means.detach()

    def drawn(model):
        view = photo_camera(camera)
        return composite(model.run.splats(), view.camera(model.run.pose(view)), places)

    before = drawn(model)
    with torch.no_grad():
        model.camera_optimizer.pose_adjustment[camera.metadata["cam_idx"], :3] = 0.5
    refined = drawn(model)
    assert not torch.allclose(refined, before, atol=0.05)
    # An evaluation of photos that training saw looks through the same cameras, and so do scene files.
    assert torch.equal(drawn(model.eval()), refined)


def test_scenes_and_runs_record_the_cameras_that_training_refined(train, tmp_path):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    trainer = train(data, 2, semantics=False, pipeline__model__camera_optimization="on")
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    photos = manager.read(manager.data.capture.split.train)
    with torch.no_grad():
        model.camera_optimizer.pose_adjustment[:] = 0.1 * torch.rand(3, 6)
    trainer.write_scene()
    recorded = [
        SceneRecord.read(trainer.base_dir / SCENE_FILE),
        read_scene(trainer.base_dir / "scene.scene").file,
    ]
    for camera, batch in photos:
        pose = model.run.pose(photo_camera(camera))
        assert not torch.allclose(pose, camera.camera_to_worlds[0], atol=1e-3)
        for file in recorded:
            known = torch.tensor(file.photo(batch["name"]).camera_to_world)
            torch.testing.assert_close(known, pose, atol=1e-5, rtol=0)
    (held_out,) = (photo for photo in recorded[0].photos if photo.split == "eval")
    unrefined = trainer.pipeline.datamanager.eval_dataset.cameras.camera_to_worlds[0]
    torch.testing.assert_close(torch.tensor(held_out.camera_to_world), unrefined)


def test_words_stay_if_the_data_folder_is_renamed(train, tmp_path):
    data = write_scene(tmp_path / "castle", photos=4, points=60)
    first = train(data, 2, tmp_path / "out")
    path = first.base_dir / "castle.scene"
    scene = read_scene(path)
    word = TaughtWord(
        "gizmo", torch.ones(scene.decoder.clip_dim), 0.0, 0.0, 0.1, clip=scene.file.clip_identity
    )
    write_scene_file(path, scene.with_words([word]))
    data = data.rename(tmp_path / "schloss")
    second = train(data, 4, tmp_path / "out", load_dir=first.checkpoint_dir)
    resumed = second.base_dir / "schloss.scene"
    assert list(read_scene(resumed).words) == ["gizmo"]
    assert "4 iterations" in describe_scene_file(resumed)["provenance"].made_how


def test_a_held_out_photo_that_is_gone_does_not_end_the_training(train, tmp_path, monkeypatch, capsys):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    begin = Lang3DXLTrainer.train

    def without_it(self):
        for photo in self.pipeline.datamanager.eval_dataset.photos:
            photo.path.unlink()
        begin(self)

    monkeypatch.setattr(Lang3DXLTrainer, "train", without_it)
    trainer = train(data, 6, semantics=False, steps_per_eval_image=3)
    assert trainer.step == 5
    assert "not evaluated at iteration 3" in " ".join(capsys.readouterr().out.split())


def test_a_run_without_held_out_photos_opens_when_its_photos_are_gone(train, tmp_path):
    data = write_scene(tmp_path / "photos", photos=4, points=60)
    run = train(data, 2, tmp_path / "out", semantics=False, **{f"{PARSER}eval_mode": "all"}).base_dir
    shutil.rmtree(data)
    assert open_run(run)[1].datamanager.train_dataset.photos


def test_a_training_photo_that_is_the_only_one_and_damaged_is_told(train, tmp_path):
    data = write_scene(tmp_path / "scene", photos=2, points=80, size=(192, 144))
    path = data / "images" / "photo_001.jpg"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match="none of the training photos can be used"):
        train(data, 2)


def test_a_target_that_vanishes_does_not_end_the_learning_of_words(train, tmp_path, monkeypatch):
    data = write_scene(tmp_path / "scene", photos=5, points=60)
    begin = Lang3DXLTrainer.train

    def without_one(self):
        targets = self.pipeline.datamanager.data.targets
        name = self.pipeline.datamanager.train_dataset.photos[0].name
        targets._store.path("dense", name).unlink()
        begin(self)

    monkeypatch.setattr(Lang3DXLTrainer, "train", without_one)
    assert train(data, 2).words_are_learned


def test_a_relative_cache_is_found_from_any_folder(train, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    run = train(
        data, 1, semantics=False, pipeline__datamanager__cache_dir=tmp_path.relative_to(tmp_path) / "c"
    )
    assert read_config(run.base_dir / "config.yml").pipeline.datamanager.cache_dir == tmp_path / "c"


@pytest.fixture
def settled(tmp_path, monkeypatch):
    """What config.yml says of a run with these encoders that begins beside its photos, in `tmp_path`."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "scene", photos=2, points=20)

    def begin(clip, dense):
        here = {f"{PARSER}data": Path("scene")}
        trainer = make_trainer(Path("scene"), clip, dense, Path("out"), 1, **here)
        return read_config(trainer.base_dir / "config.yml").pipeline.datamanager

    return begin


def test_relative_encoders_and_photos_are_found_from_any_folder(settled, tiny_clip, tiny_dense, tmp_path):
    for name, folder in (("clip", tiny_clip), ("dense", tiny_dense)):
        (tmp_path / name).symlink_to(folder)
    found = settled("clip", "dense")
    assert (found.clip, found.dense) == (str(tmp_path / "clip"), str(tmp_path / "dense"))
    assert found.data == found.dataparser.data == tmp_path / "scene"


def test_a_folder_named_like_the_builtin_encoders_or_none_is_not_meant(settled, tmp_path):
    for name in ("builtin", "none"):
        (tmp_path / name).mkdir()
    found = settled("builtin", "none")
    assert (found.clip, found.dense) == ("builtin", "none")


def test_a_checkpoint_has_no_rendering_in_it(train, tmp_path):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    (path,) = train(data, 1, semantics=False).checkpoint_dir.glob("*.ckpt")
    assert "rendered" not in torch.load(path, weights_only=True)["run"]["strategy"]


@pytest.mark.parametrize("name", ["until", "start", "end"])
def test_schedules_out_of_range_are_told(train, tmp_path, name):
    data = write_scene(tmp_path / "scene", photos=4, points=60)
    config = deepcopy(lang3dxl.config)
    config.data, config.output_dir = data, tmp_path
    setattr(config.optimizers["means"]["scheduler"], name, 0.0)
    with pytest.raises(UserError, match=rf"--optimizers\.means\.scheduler\.{name} is 0"):
        config.set_timestamp()
