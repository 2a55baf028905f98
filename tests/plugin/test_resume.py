"""Exact resume: a resumed run equals the uninterrupted one to the last bit."""

import shutil
import signal
from dataclasses import replace

import pytest
import torch
from runs import train_run

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.open_scene import load_scene
from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer
from lang3dxl_ns.scene.record import SCENE_FILE, SceneRecord
from lang3dxl_ns.training import batches, learn_codes
from lang3dxl_ns.training.state import Training

EVERYTHING = {
    "pipeline__model__decoder__name": "paper",
    "pipeline__model__decode_size": (24, 32),
    "pipeline__model__densify_grad_thresh": 1e-7,  # with random splits
    "pipeline__model__densify_every": 0.2,  # at every fourth step, where their number doubles
    "pipeline__model__densify_until": 0.75,
    "pipeline__model__appearance__use": "on",
    "pipeline__model__camera_optimization": "on",
    "pipeline__model__view_dependence": "on",
    "pipeline__model__background_color": "random",
    "steps_per_eval_image": 0,
}


def same(first, second, where="checkpoint") -> list[str]:
    """Names of the entries that differ between two checkpoints."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), where
        return [name for key in first for name in same(first[key], second[key], f"{where}.{key}")]
    if isinstance(first, list | tuple):
        assert len(first) == len(second), where
        pairs = enumerate(zip(first, second, strict=True))
        return [name for i, pair in pairs for name in same(*pair, f"{where}.{i}")]
    if isinstance(first, torch.Tensor):
        equal = first.shape == second.shape and bool(((first == second) | (first != first)).all())
    else:
        equal = first == second
    return [] if equal else [where]


def last_checkpoint(trainer) -> dict:
    return torch.load(max(trainer.checkpoint_dir.glob("*.ckpt")), weights_only=True)


@pytest.fixture(scope="module")
def whole(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """An uninterrupted run of 20 steps with a checkpoint every five."""
    folder = tmp_path_factory.mktemp("whole")
    changes = EVERYTHING | {"steps_per_save": 5, "save_only_latest_checkpoint": False}
    return train_run(scene, tiny_clip, tiny_dense, folder, 20, **changes)


def test_resumed_at_a_step_the_run_ends_as_if_it_had_never_stopped(train, scene, whole):
    """Densification follows the step, and its statistics are partly collected then. Codes from photos resume
    at another one, below."""
    middle = whole.checkpoint_dir / "step-000000005.ckpt"
    resumed = train(scene, iterations=20, load_checkpoint=middle, **EVERYTHING)
    assert resumed._start_step == 6
    before = len(torch.load(middle, weights_only=True)["pipeline"]["_model.gauss_params.means"])
    assert resumed.pipeline.model.num_points > before
    assert same(last_checkpoint(whole), last_checkpoint(resumed)) == []


def test_one_seed_twice_gives_equal_checkpoints(train, scene, whole, tmp_path):
    """Whether or not the targets already existed."""
    fresh = {"pipeline__datamanager__cache_dir": tmp_path / "targets"}
    again = train(scene, iterations=20, **EVERYTHING, **fresh)
    assert same(last_checkpoint(whole), last_checkpoint(again)) == []


def test_a_resume_from_a_folder_without_checkpoint_says_so(train, scene, tmp_path):
    with pytest.raises(UserError, match="there is no checkpoint"):
        train(scene, iterations=4, semantics=False, load_dir=tmp_path)


def test_a_run_of_another_scene_is_not_resumed(train, scene, whole, tmp_path):
    """Its Gaussians are in other coordinates."""
    (folder := tmp_path / "run" / "nerfstudio_models").mkdir(parents=True)
    shutil.copy(whole.checkpoint_dir / "step-000000010.ckpt", folder)
    told = SceneRecord.read(whole.base_dir / SCENE_FILE)
    replace(told, scale=1.1 * told.scale).write(folder.with_name(SCENE_FILE))
    with pytest.raises(UserError, match="belongs to other photos or another reconstruction of them"):
        train(scene, iterations=20, load_dir=folder, **EVERYTHING)


def test_a_damaged_photo_does_not_change_the_order_of_the_others(train, scene, whole, monkeypatch):
    """A resumed run meets it later, but continues with the same order of photos."""
    data, read = whole.pipeline.datamanager.data, batches.read_data
    broken = data.capture.split.train[2]

    def damaged(photo, *how):
        if photo.name == broken:
            raise UserError("cannot be read")
        return read(photo, *how)

    monkeypatch.setattr(batches, "read_data", damaged)
    monkeypatch.setattr(data._cache, "_kept", {})
    state = data.state()

    def names(count: int) -> list[str]:
        return [data.next()[1]["name"] for _ in range(count)]

    started = names(5)
    middle = data.state()
    whole_order = started + names(40)
    data._left_out.clear()
    data.restore(middle)
    assert started + names(40) == whole_order
    data._left_out.clear()
    data.restore(state)


FROM_PHOTOS = EVERYTHING | {"pipeline__model__codes_from": "photos", "pipeline__model__warm_up": 0.4}
"""Codes start at iteration 8 of 20."""


@pytest.fixture(scope="module")
def starts():
    """The runs that started codes from photos, in their order."""
    found: list[Training] = []
    learn = learn_codes.learn_words
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn_codes, "learn_words", lambda run, data: found.append(run) or learn(run, data))
        yield found


@pytest.fixture(scope="module")
def whole_from_photos(starts, scene, tiny_clip, tiny_dense, tmp_path_factory):
    """An uninterrupted run of 20 steps whose codes start from photos, with a checkpoint every five."""
    changes = FROM_PHOTOS | {"steps_per_save": 5, "save_only_latest_checkpoint": False}
    folder = tmp_path_factory.mktemp("from_photos")
    trainer = train_run(scene, tiny_clip, tiny_dense, folder, 20, **changes)
    assert starts == [trainer.pipeline.model.run]
    return trainer


@pytest.mark.parametrize("step", [5, 10])
def test_codes_start_from_photos_once_also_if_the_run_is_interrupted(
    train, scene, whole_from_photos, starts, step
):
    starts.clear()
    middle = whole_from_photos.checkpoint_dir / f"step-{step:09d}.ckpt"
    resumed = train(scene, iterations=20, load_checkpoint=middle, **FROM_PHOTOS)
    assert len(starts) == (1 if step < 8 else 0)
    assert same(last_checkpoint(whole_from_photos), last_checkpoint(resumed)) == []


def test_codes_that_were_trained_do_not_start_again_in_a_longer_run(train, scene, monkeypatch):
    settings = FROM_PHOTOS | {"pipeline__model__densify_until": 0.0}
    first = train(scene, iterations=6, **settings)
    monkeypatch.setattr(learn_codes, "learn_words", lambda *_: pytest.fail("started again"))
    train(scene, iterations=20, load_dir=first.checkpoint_dir, **settings)


# ── a finished run that learned words after its last step, and is prolonged ─────────────────────────────


@pytest.fixture(scope="module")
def finished(scene, tiny_clip, tiny_dense, tmp_path_factory):
    """A finished run of three steps whose checkpoint holds codes."""
    trainer = train_run(scene, tiny_clip, tiny_dense, tmp_path_factory.mktemp("finished"), 3)
    assert "_model.gauss_params.codes" in last_checkpoint(trainer)["pipeline"]
    return trainer


def test_a_finished_run_can_be_prolonged_while_gaussians_multiply(train, scene, finished, capsys):
    longer = train(scene, iterations=8, load_dir=finished.checkpoint_dir)
    assert "Resuming at iteration 3 of 8" in capsys.readouterr().out
    model = longer.pipeline.model
    assert longer._start_step == 3 and longer.words_are_learned
    assert [path.name for path in longer.checkpoint_dir.iterdir()] == ["step-000000007.ckpt"]
    assert len(model.gauss_params["codes"]) == model.num_points > finished.pipeline.model.num_points


def test_a_prolonged_run_that_is_stopped_keeps_no_codes_of_the_shorter_one(
    train, scene, finished, tmp_path, monkeypatch
):
    step = Lang3DXLTrainer.train_iteration

    def stopped(self, number):
        if number == 4:
            signal.raise_signal(signal.SIGINT)
        return step(self, number)

    monkeypatch.setattr(Lang3DXLTrainer, "train_iteration", stopped)
    with pytest.raises(SystemExit):
        train(scene, iterations=8, load_dir=finished.checkpoint_dir, pipeline__model__densify_until=0.0)
    (path,) = tmp_path.rglob("*.ckpt")
    assert "_model.gauss_params.codes" not in torch.load(path, weights_only=True)["pipeline"]
    with pytest.raises(UserError, match="learned when training ends; resume it"):
        load_scene(path.parents[1])
