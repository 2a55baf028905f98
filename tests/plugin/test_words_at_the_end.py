"""Learning words after the last iteration loses nothing: it is saved before, stopped cleanly, and resumed."""

import signal
import sys

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline
from lang3dxl_ns.plugin.trainer import Lang3DXLTrainer

STEPS = 3


def saved(folder) -> dict:
    (path,) = folder.glob("*.ckpt")
    assert path.name == f"step-{STEPS - 1:09d}.ckpt"
    return torch.load(path, weights_only=True)


@pytest.fixture
def trained(train, scene, monkeypatch):
    """A run, and its folder of checkpoints, whatever ends it."""
    folders = []
    setup = Lang3DXLTrainer.setup

    def noting(self, *arguments):
        setup(self, *arguments)
        folders.append(self.checkpoint_dir)

    monkeypatch.setattr(Lang3DXLTrainer, "setup", noting)
    return lambda **changes: train(scene, iterations=STEPS, **changes), folders


def test_a_run_that_dies_while_it_learns_words_resumes_with_words_only(trained, monkeypatch):
    run, folders = trained
    learn = Lang3DXLPipeline.learn_words
    monkeypatch.setattr(Lang3DXLPipeline, "learn_words", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run()
    before = saved(folders[0])
    assert not before["words"] and "_model.gauss_params.codes" not in before["pipeline"]
    monkeypatch.setattr(Lang3DXLPipeline, "learn_words", learn)
    monkeypatch.setattr(Lang3DXLTrainer, "train_iteration", lambda *_: pytest.fail("trained again"))
    monkeypatch.delitem(sys.modules["nerfstudio.utils.writer"].GLOBAL_BUFFER, "step")  # as in a new process
    run(load_dir=folders[0])
    after = saved(folders[1])
    assert after["words"] and "_model.gauss_params.codes" in after["pipeline"]
    for name in ("means", "features_dc", "opacities"):
        key = f"_model.gauss_params.{name}"
        assert torch.equal(before["pipeline"][key], after["pipeline"][key])
    with pytest.raises(UserError, match="max-num-iterations"):
        run(load_dir=folders[1])


def test_a_run_of_fewer_iterations_than_its_checkpoint_is_refused(trained, train, scene, tmp_path):
    """And leaves no folder, which would pass for the newest run."""
    run, folders = trained
    run(semantics=False)
    with pytest.raises(UserError, match=f"already has {STEPS} iterations, and the run has {STEPS - 1}"):
        train(scene, STEPS - 1, tmp_path / "refused", load_dir=folders[0], semantics=False)
    assert not list((tmp_path / "refused").rglob("*.yml"))


def test_words_of_a_run_that_is_prolonged_are_learned_anew(trained, train, scene, monkeypatch):
    """Those of the checkpoint are out of date as soon as the Gaussians move."""
    run, folders = trained
    run()
    assert saved(folders[0])["words"]
    monkeypatch.setattr(Lang3DXLPipeline, "learn_words", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(scene, iterations=STEPS + 1, load_dir=folders[0])
    (path,) = folders[1].glob("*.ckpt")
    assert not torch.load(path, weights_only=True)["words"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_words_are_learned_ends_the_run_at_once(trained, monkeypatch, number, code):
    run, folders = trained
    monkeypatch.setattr("lang3dxl_ns.plugin.pipeline.learn_words", lambda *_: signal.raise_signal(number))
    with pytest.raises(SystemExit) as end:
        run()
    assert end.value.code == code
    assert not saved(folders[0])["words"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_while_training_saves_and_tells_the_shell(trained, monkeypatch, number, code):
    run, folders = trained
    step = Lang3DXLTrainer.train_iteration

    def signaled(self, index):
        if index == 1:
            signal.raise_signal(number)
        return step(self, index)

    monkeypatch.setattr(Lang3DXLTrainer, "train_iteration", signaled)
    with pytest.raises(SystemExit) as end:
        run()
    assert end.value.code == code
    assert [path.name for path in folders[0].glob("*")] == ["step-000000001.ckpt"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_viewer_of_a_finished_run_without_a_word(trained, monkeypatch, number):
    run, folders = trained
    told = []
    monkeypatch.setattr(
        Lang3DXLTrainer, "_train_complete_viewer", lambda _: (signal.raise_signal(number), told.append(1))
    )
    run(semantics=False, viewer__quit_on_train_completion=False)
    assert not told  # it would have gone on for ever
    assert list(folders[0].parent.glob("*.scene"))


def test_a_signal_while_a_finished_run_is_saved_leaves_its_scene(trained, monkeypatch):
    run, folders = trained
    save = Lang3DXLTrainer.save_checkpoint

    def signaled(self, step):
        if self.training_state == "completed":
            signal.raise_signal(signal.SIGINT)
        save(self, step)

    monkeypatch.setattr(Lang3DXLTrainer, "save_checkpoint", signaled)
    monkeypatch.setattr(Lang3DXLTrainer, "_train_complete_viewer", lambda _: pytest.fail("waits for another"))
    with pytest.raises(SystemExit) as end:
        run(semantics=False, viewer__quit_on_train_completion=False)
    assert end.value.code == 130
    assert list(folders[0].parent.glob("*.scene"))


def test_handlers_that_python_did_not_install_are_no_trouble(trained, monkeypatch):
    run, _ = trained
    monkeypatch.setattr(signal, "getsignal", lambda _: None)
    before = [signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        run(semantics=False)
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_words_are_learned_under_the_lock_that_the_viewer_takes(trained, monkeypatch):
    run, _ = trained
    locks, trainers = [], []
    train = Lang3DXLTrainer.train
    monkeypatch.setattr(Lang3DXLTrainer, "train", lambda self: trainers.append(self) or train(self))
    monkeypatch.setattr(
        Lang3DXLPipeline, "learn_words", lambda self: locks.append(trainers[0].train_lock.locked())
    )
    run()
    assert locks == [True]
    assert not trainers[0].train_lock.locked()


def test_the_time_announced_includes_the_words(trained, monkeypatch):
    run, _ = trained
    said: list[str] = []
    monkeypatch.setattr("lang3dxl_ns.plugin.trainer.CONSOLE.log", lambda text, **_: said.append(str(text)))
    monkeypatch.setattr("lang3dxl_ns.training.learn_codes.say", said.append)
    run()
    (line,) = (line for line in said if line.startswith("training: "))
    assert "to learn words" in line
    assert any("centered cosine" in line for line in said)


def test_words_are_the_same_from_photos_gathered_smaller(trained, scene, monkeypatch):
    """A crop covers far more than a pixel: halving the photos leaves the features where they are."""
    import torch.nn.functional as F

    from lang3dxl_ns.components.compression import CompressedField

    run, found = trained[0], []
    learn = CompressedField.learn_gaussians

    def noted(self, gathered, *rest):
        found.append((gathered.features, gathered.mass))
        return learn(self, gathered, *rest)

    monkeypatch.setattr(CompressedField, "learn_gaussians", noted)
    trainer = run()
    monkeypatch.setattr("lang3dxl_ns.training.learn_codes.LONGER_SIDE", 48)
    trainer.pipeline.learn_words()
    (whole, mass), (half, smaller) = found
    seen = (mass > 20) & (smaller > 5)
    assert 0.15 < float(smaller[seen].sum() / mass[seen].sum()) < 0.35
    mean = whole[seen].mean(0)
    assert F.cosine_similarity(whole[seen] - mean, half[seen] - mean, dim=1).mean() > 0.97
