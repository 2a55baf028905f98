"""Questions to a model that changes meanwhile: each answer is of one snapshot and one question."""

from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pytest
import torch
from painted_scene import COUNT, encode_texts, painted_codes, painted_scene, painted_splats

from lang3dxl_ns.training import snapshot as module
from lang3dxl_ns.training.conversation import Conversation


@pytest.fixture
def model():
    """One whose snapshots have fewer Gaussians at every iteration."""
    found = SimpleNamespace(step=1, training=True, device="cpu", learns_words_at_the_end=False)
    found.settings = SimpleNamespace(total_steps=10)

    def snapshot(*_, **settings):
        keep = torch.arange(COUNT) < COUNT - 200 * found.step
        return painted_scene(splats=painted_splats().select(keep), codes=painted_codes()[keep])

    found.scene = snapshot
    return found


@pytest.fixture
def talk(model, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "text_encoder", lambda *_: encode_texts)
    monkeypatch.setattr(module, "snapshot", model.scene)
    monkeypatch.setattr(module, "forget_words", lambda _: None)
    nothing = {"learn": lambda: None, "watch": lambda _: None}
    learning = lambda: model.training  # noqa: E731
    return Conversation(module.Snapshots(model, None, tmp_path, nullcontext(), learning, **nothing), set)


def frame(talk, model, between=lambda: None):
    """The outputs of a frame; something happens while it is rendered."""
    scene, channels = model.scene(), talk.channels()
    between()
    return talk.outputs(scene.draw(scene.camera("0003", 48), channels), 0.0)


def test_a_question_asked_in_training_is_answered_by_its_snapshot_when_training_has_ended(talk, model):
    talk.ask("dome")
    expected = frame(talk, model)["relevancy_0"]
    model.step, model.training = 5, False
    assert talk.channels() is None
    assert torch.equal(frame(talk, model)["relevancy_0"], expected)
    talk.ask("dome")
    assert talk.channels().shape[0] == len(model.scene().splats)


def test_while_a_new_snapshot_is_asked_the_old_question_is_answered_by_its_own(talk, model, monkeypatch):
    talk.ask("dome")
    expected, found = frame(talk, model)["relevancy_0"], talk.find()[0].gaussians
    model.step = 5
    shown = []

    def meanwhile(scene, text):
        shown.extend((frame(talk, model)["relevancy_0"], talk.find()[0].gaussians))

    monkeypatch.setattr(module.Scene, "ask", meanwhile)
    talk.ask("window")
    assert torch.equal(shown[0], expected) and len(shown[1]) == len(found)


def test_a_question_that_comes_while_a_frame_is_rendered_waits_for_the_next(talk, model):
    model.training = False
    talk.ask("dome")
    expected = frame(talk, model)
    found = frame(talk, model, between=lambda: talk.ask("wall; window"))
    assert torch.equal(found["relevancy_0"], expected["relevancy_0"]) and "relevancy_1" not in found
    assert "relevancy_1" in frame(talk, model)
    found = frame(talk, model, between=talk.forget)
    assert "relevancy_1" in found and set(frame(talk, model)) == {"overlay"}


def test_a_question_that_waited_while_the_final_words_were_learned_keeps_them(talk, model, monkeypatch):
    """The words of the end are learned under the lock that the snapshot waits for: it must not learn its own
    over them, nor delete them afterwards."""
    told = []
    model.learns_words_at_the_end = True
    monkeypatch.setattr(module, "forget_words", lambda _: told.append("forgotten"))
    talk.snapshots.learn = lambda: told.append("learned")

    @contextmanager
    def training_ends():
        model.training = False
        yield

    talk.snapshots.lock = training_ends()
    talk.ask("dome")
    assert told == [] and talk.snapshots.latest().step is None
