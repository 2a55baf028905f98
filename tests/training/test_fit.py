"""`fit`: the same bytes as `ns-train`, also after a stop; what a run leaves in its folder."""

import io
import os
import re
import signal
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from scenes import write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.training import fit as fitting
from lang3dxl_ns.training.checkpoint import CHECKPOINT
from lang3dxl_ns.training.fit import Run, Settings, begin, fit

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

    def full(self, step):
        if step == 2:
            raise RuntimeError("CUDA out of memory")
        iterate(self, step)

    monkeypatch.setattr(Run, "iterate", full)
    monkeypatch.setattr("sys.argv", ["lang3dxl"])
    said = (
        r"at iteration 1 .* --max-gaussians \d+, --photo-scale 0.5, .*training.ckpt is kept: the same command"
    )
    with pytest.raises(UserError, match=said):
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

    def full(*_, **__):
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(torch, "load", full)
    with pytest.raises(RuntimeError, match="allocate"):
        begin(capture, settings(2), tmp_path, cache, "cpu")
