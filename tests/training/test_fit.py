"""`fit`: the same bytes as `ns-train`, also after a stop; what a run leaves in its folder."""

import errno
import io
import os
import re
import shutil
import signal
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from scenes import write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import locked
from lang3dxl_ns.common.stages import Stages
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.files.scene_file import keep_words, read_scene
from lang3dxl_ns.preparation.store import PhotosGoneError
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.training import fit as fitting
from lang3dxl_ns.training.checkpoint import CHECKPOINT, alone_in
from lang3dxl_ns.training.fit import Run, Settings, begin, fit
from lang3dxl_ns.words.taught_words import TaughtWord

STEPS = 20
GROWING = {"densify_grad_thresh": 1e-7, "densify_every": 0.2, "densify_until": 0.75}
"""Gaussians double several times, with random splits."""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene", photos=6, points=100)


@pytest.fixture(scope="module")
def settings(tiny_clip, tiny_dense):
    def make(steps: int = STEPS, **changes) -> Settings:
        made = Settings.of("lang3dxl", steps)
        made.targets.clip, made.targets.dense = str(tiny_clip), str(tiny_dense)
        made.scene.sky_gaussians, made.scene.semantic_field = 400, SemanticFieldConfig(code_dim=3)
        made.scene.decoder.compression.steps, made.scene.decoder.compression.batch = 20, 512
        for name, value in (GROWING | changes).items():
            assert hasattr(made.scene, name)
            setattr(made.scene, name, value)
        return made

    return make


def trained(data: Path, out: Path, settings: Settings) -> dict:
    fit(open_capture(data), settings, out, data / "lang3dxl_cache", "cpu")
    return torch.load(out / CHECKPOINT, weights_only=True)["tensors"]


@pytest.fixture(scope="module")
def whole(data, settings, tmp_path_factory) -> dict:
    """The checkpoint of a run without interruption."""
    return trained(data, tmp_path_factory.mktemp("whole"), settings())


@pytest.fixture(scope="module")
def short(data, settings, tmp_path_factory) -> SimpleNamespace:
    """Folder, checkpoint and output of a finished run of four iterations."""
    out = tmp_path_factory.mktemp("short")
    with redirect_stdout(io.StringIO()) as said:
        tensors = trained(data, out, settings(4))
    return SimpleNamespace(out=out, tensors=tensors, said=said.getvalue())


def differing(first: dict, second: dict) -> list[str]:
    assert first.keys() == second.keys()
    return [
        name
        for name, value in first.items()
        if isinstance(value, torch.Tensor)
        and not (
            value.shape == second[name].shape and torch.equal(value.nan_to_num(), second[name].nan_to_num())
        )
    ]


def test_nerfstudio_trains_the_same_bytes(data, whole, train):
    changes = {f"pipeline__model__{name}": value for name, value in GROWING.items()}
    theirs = train(data, STEPS, steps_per_eval_image=0, **changes).pipeline.model.state_dict()
    theirs.pop("device_indicator_param")
    assert len(whole["gauss_params.means"]) > 600 and "gauss_params.codes" in whole
    assert differing(whole, dict(theirs)) == []


def test_a_run_that_was_stopped_ends_with_the_same_bytes(data, settings, whole, tmp_path, monkeypatch):
    """By Ctrl-C within an iteration, and by being killed between two checkpoints."""
    iterate = Run.iterate

    def interrupted(self, step):
        iterate(self, step)
        if step == 7:
            os.kill(os.getpid(), signal.SIGINT)
        if step == 13:
            raise SystemError

    monkeypatch.setattr(Run, "iterate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        trained(data, tmp_path / "again", settings())
    assert read_scene(tmp_path / "again" / "scene.scene").splats is not None  # the state so far
    with pytest.raises(SystemError):
        trained(data, tmp_path / "again", settings())
    monkeypatch.setattr(Run, "iterate", iterate)
    assert differing(whole, trained(data, tmp_path / "again", settings())) == []


def test_words_that_are_stopped_are_said_and_made_by_the_next_command(
    data, settings, short, tmp_path, monkeypatch, capsys
):
    learn = fitting.learn_words

    def stopped(*arguments):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(fitting, "learn_words", stopped)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs without it
    with pytest.raises(KeyboardInterrupt):
        trained(data, tmp_path / "again", settings(4))
    assert "Stopped while words were learned; all iterations are kept" in capsys.readouterr().out
    monkeypatch.setattr(fitting, "learn_words", learn)
    assert differing(short.tensors, trained(data, tmp_path / "again", settings(4))) == []


def test_a_full_memory_names_settings_that_help_and_the_checkpoint(data, settings, tmp_path, monkeypatch):
    iterate = Run.iterate

    def full(*_):
        raise RuntimeError("CUDA out of memory")

    monkeypatch.setattr(Run, "iterate", lambda self, step: full() if step == 2 else iterate(self, step))
    monkeypatch.setattr("sys.argv", ["lang3dxl"])
    said = (
        r"at iteration 2 .* --max-gaussians \d+, --photo-scale 0.5, .*training.ckpt is kept: the same command"
    )
    with pytest.raises(UserError, match=said):
        trained(data, tmp_path, settings(4))
    monkeypatch.setattr(Run, "iterate", lambda *_: None)
    monkeypatch.setattr(fitting, "learn_words", full)
    with pytest.raises(UserError, match="while learning words"):
        trained(data, tmp_path, settings(4))


def test_the_time_is_estimated_before_and_the_number_of_gaussians_is_no_noise(short):
    time = r"training: about \d+ seconds for 4 iterations, then about .* to learn words"
    assert re.search(time, short.said) and "→" not in short.said


def test_a_scene_of_a_resumed_run_has_all_its_colors(data, settings, tmp_path):
    """Colors by direction come with the iterations, also in a run that is only opened."""
    made = settings(20, view_dependence="on")
    capture, cache = open_capture(data), data / "lang3dxl_cache"
    whole = fit(capture, made, tmp_path, cache, "cpu")
    again = begin(capture, settings(20, view_dependence="on"), tmp_path, cache, "cpu").scene()
    assert whole.splats.degree == again.splats.degree == 3
    assert torch.equal(whole.splats.harmonics, again.splats.harmonics)


def test_a_finished_run_is_not_trained_again_and_another_one_is_refused(data, settings, short, monkeypatch):
    monkeypatch.setattr(fitting, "render", lambda *_: pytest.fail("trained again"))
    monkeypatch.setattr(fitting, "learn_words", lambda *_: pytest.fail("learned again"))
    trained(data, short.out, settings(4))
    with pytest.raises(UserError, match=r"holds another run \(steps 4\)"):
        trained(data, short.out, settings(5))
    other = settings(4, sky_gaussians=300)
    other.seed, other.photo_scale = 7, 0.5
    with pytest.raises(
        UserError, match=r"another run \(sky-gaussians 400, seed 42, photo-scale 1\.0\): give its options"
    ):
        trained(data, short.out, other)


def test_a_run_goes_on_where_other_settings_make_no_other_scene(data, settings, short):
    other = settings(4)
    other.save_every, other.targets.workers = 3, 2
    assert differing(short.tensors, trained(data, short.out, other)) == []


def test_mixed_precision_without_such_a_gpu_is_refused_before_anything_is_prepared(data, settings, tmp_path):
    made = settings()
    made.mixed_precision = True
    with pytest.raises(UserError, match="--mixed-precision needs a GPU"):
        begin(open_capture(data), made, tmp_path / "run", tmp_path / "cache", "cpu")
    assert not list(tmp_path.iterdir())


def colors(settings, steps=8, **changes) -> Settings:
    """Settings of a run without words."""
    made = settings(steps, **changes)
    made.targets.clip = "none"
    return made


def test_vanished_photos_and_a_full_disk_lose_no_iterations(data, settings, tmp_path, monkeypatch, capsys):
    """A checkpoint comes every other iteration."""
    iterate, save, full = Run.iterate, torch.save, [OSError(errno.ENOSPC, "No space left on device")]

    def gone(self, step):
        if step == 5:
            raise PhotosGoneError("the photos have vanished")
        iterate(self, step)

    def saved(*arguments):
        if full:
            raise full.pop()
        save(*arguments)

    monkeypatch.setattr(Run, "iterate", gone)
    monkeypatch.setattr(torch, "save", saved)
    with pytest.raises(UserError, match=r"the photos have vanished\. To resume: the same command"):
        trained(data, tmp_path, colors(settings))
    assert torch.load(tmp_path / CHECKPOINT, weights_only=True)["step"] == 4
    assert "No space left on device" in (said := capsys.readouterr().out) and "Training continues." in said


def test_a_folder_that_can_not_be_written_to_is_told_before_the_work(data, settings, tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "replace", refused)
    monkeypatch.setattr(fitting, "Run", lambda *_: pytest.fail("begun"))
    with pytest.raises(PermissionError, match=str(tmp_path)):
        trained(data, tmp_path, colors(settings))


def test_two_commands_do_not_train_in_one_folder_but_one_may_teach(data, settings, tmp_path):
    with alone_in(tmp_path), pytest.raises(UserError, match="another command trains in"):
        trained(data, tmp_path, colors(settings))
    with alone_in(tmp_path), locked(tmp_path, busy="busy"):
        pass


def test_a_restart_forgets_the_earlier_run_once_nothing_is_in_its_way(data, settings, tmp_path, monkeypatch):
    again = partial(begin, open_capture(data), colors(settings), tmp_path, data / "lang3dxl_cache", "cpu")
    again().save(0)

    def refused(*_):
        raise UserError("too large")

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "plan", refused)
        with pytest.raises(UserError, match="too large"):
            again(restart=True)
    assert again().done == 1
    run = again(restart=True)
    assert run.done == 0 and not (tmp_path / CHECKPOINT).exists()
    assert run.again == "the same command without --restart"


def test_a_run_goes_on_with_more_photos_but_corrects_no_others_cameras(data, settings, tmp_path, capsys):
    def run_without(*held_out, look="off", **changes) -> Run:
        (tmp_path / "list.txt").write_text("\n".join(f"photo_{i:03d}" for i in held_out))
        made = colors(settings, **changes)
        made.capture.held_out, made.scene.appearance.use = tmp_path / "list.txt", look
        capture = open_capture(data, made.capture)
        return begin(capture, made, tmp_path / look, data / "lang3dxl_cache", "cpu")

    run = run_without(0, 1, look="on")
    run.iterate(0)
    run.save(0)
    capsys.readouterr()
    run = run_without(1, look="on")
    assert "1 photos moved between the training and held-out sets" in capsys.readouterr().out
    ((parameter, state),) = run.optimizers["appearance_vectors"].state.items()
    assert len(parameter) == len(state["exp_avg"]) == 5
    run_without(0, 1, camera_optimization="on").save(0)
    with pytest.raises(UserError, match="corrections of other training photos' cameras"):
        run_without(0, 2, camera_optimization="on")


def test_a_taught_word_outlives_a_training_over_its_scene(data, settings, short, tmp_path):
    shutil.copytree(short.out, tmp_path, dirs_exist_ok=True)
    path, seen = tmp_path / "scene.scene", list[list[str]]()
    scene = read_scene(path)
    vector, clip = torch.ones(scene.decoder.clip_dim), scene.file.clip_identity
    keep_words(path, {"gizmo": TaughtWord("gizmo", vector, 0.0, 0.0, 0.1, clip=clip)})
    run = begin(open_capture(data), settings(4), tmp_path, data / "lang3dxl_cache", "cpu", restart=True)
    save = run.save

    def seen_after(step):
        saved = save(step)
        seen.append([*read_scene(path).words])
        return saved

    run.save = seen_after
    stages = Stages({"train": 0.5, "words": 0.5})
    assert run.complete(stages).words.keys() == {"gizmo"} and seen == [["gizmo"]] * 5
    again = begin(open_capture(data), settings(4), tmp_path, data / "lang3dxl_cache", "cpu")
    assert again.complete(stages).words.keys() == {"gizmo"} and len(seen) == 5
    path.write_bytes(path.read_bytes()[:1000])
    assert len(again.complete(stages).splats) == len(read_scene(path).splats)


def without(*places: str):
    """A change to a checkpoint's content that drops what a path of names leads to."""

    def change(content: dict) -> None:
        for name in places[:-1]:
            content = content[name]
        del content[places[-1]]

    return change


DAMAGES = {
    "no step": without("step"),
    "no positions": without("tensors", "gauss_params.means"),
    "no moments": without("optimizers", "means", "state"),
    "no generator": without("run", "random"),
    "larger than stored": lambda content: content["tensors"].update(
        {"gauss_params.means": torch.zeros(1, 1).expand(9, 3)}
    ),
    "no description": lambda content: content.update(about=None),
}


def test_a_damaged_checkpoint_is_named_with_what_helps_and_a_full_memory_is_no_damage(
    data, settings, tmp_path, monkeypatch
):
    cache, capture = data / "lang3dxl_cache", open_capture(data)
    fit(capture, settings(2), tmp_path, cache, "cpu")
    whole = (tmp_path / CHECKPOINT).read_bytes()
    for kind, damage in DAMAGES.items():
        (tmp_path / CHECKPOINT).write_bytes(whole)
        content = torch.load(tmp_path / CHECKPOINT, weights_only=True)
        damage(content)
        torch.save(content, tmp_path / CHECKPOINT)
        with pytest.raises(UserError) as error:
            begin(capture, settings(2), tmp_path, cache, "cpu")
        told = r"training\.ckpt can't be read .*: restore it, or delete it"
        assert re.search(told, str(error.value)), f"{kind}: {error.value}"
    means = torch.load(io.BytesIO(whole), weights_only=True)["tensors"]["gauss_params.means"]
    (tmp_path / CHECKPOINT).write_bytes(whole.replace(means.numpy().tobytes(), bytes(means.nbytes)))
    with pytest.raises(UserError, match=r"training\.ckpt can't be read \(.* checksum\): restore it"):
        begin(capture, settings(2), tmp_path, cache, "cpu")

    (tmp_path / CHECKPOINT).write_bytes(whole)

    def full(*_, **__):
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(torch, "load", full)
    with pytest.raises(RuntimeError, match="allocate"):
        begin(capture, settings(2), tmp_path, cache, "cpu")
