"""The panel in nerfstudio's viewer, without a browser: what is typed, what is shown, where it flies."""

import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import make_trainer
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.viewer import Viewer
from scenes import write_scene

from lang3dxl_ns.pipeline import QUERY_VARIABLE
from lang3dxl_ns.scene_loading import as_nerfstudio
from lang3dxl_ns.viewer import panel as panel_module
from lang3dxl_ns.viewer.flight import stand_of
from lang3dxl_ns.viewer.panel import INVITATION, OWN_LOOK, PER_SCENE


@pytest.fixture(scope="module")
def trainer(tmp_path_factory, tiny_clip, tiny_dense):
    """A run whose photos are gone."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=6, points=200, mixed=True)
    trainer = make_trainer(
        data, tiny_clip, tiny_dense, root / "outputs", 30, pipeline__model__appearance__use="on"
    )
    trainer.setup()
    trainer.train()
    (data / "images").rename(data / "renamed")
    return trainer


@pytest.fixture(scope="module")
def viewer(trainer):
    """What ns-viewer starts."""
    config, pipeline, _, step = eval_setup(trainer.base_dir / "config.yml", test_mode="test")
    viewer = Viewer(
        ViewerConfig(websocket_host="127.0.0.1"),
        log_filename=config.get_base_dir() / "viewer.log",
        datapath=pipeline.datamanager.get_datapath(),
        pipeline=pipeline,
        train_lock=trainer.train_lock,
    )
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed", pipeline.datamanager.eval_dataset)
    viewer.update_scene(step=step)
    yield viewer
    viewer.viser_server.stop()


@pytest.fixture
def panel(viewer):
    panel = viewer.pipeline.panel
    panel._threshold.value = 0.0  # with CLIP's random weights nothing is sure to be found
    panel._take_settings()
    yield panel
    type_in(panel, "")


def type_in(panel, text: str, negatives: str = "", foreground: str = "") -> str:
    """The panel's message once a text is dealt with."""
    panel._negatives.value, panel._foreground.value, panel._question.value = negatives, foreground, text
    panel._asker.submit(panel._guarded(panel._ask))
    time.sleep(0.05)  # setting a box tells the panel in a thread of viser's
    assert panel._asker.wait() and panel._finder.wait()
    return panel._message.content


def frame(viewer, photo: str | None = None) -> dict[str, torch.Tensor]:
    """What a frame of the viewer consists of, rendered as its threads do it; of the first photo's camera."""
    panel, model = viewer.pipeline.panel, viewer.get_model()
    chosen = next(p for p in panel._photos if photo in (None, p.name))
    camera = as_nerfstudio(chosen.camera)
    with viewer.train_lock, torch.no_grad():
        training = model.training
        model.eval()
        outputs = model.get_outputs_for_camera(camera, obb_box=None)
        model.train(training)
    return outputs


class Client:
    """A page that is open somewhere."""

    def __init__(self) -> None:
        self.camera = SimpleNamespace(
            position=np.array([30.0, 0, 0]), look_at=np.zeros(3), fov=1.0, aspect=1.5
        )
        self.atomic, self.flush = nullcontext, lambda: None


def test_a_run_opens_without_its_photos(viewer, trainer):
    trained, opened = trainer.pipeline.datamanager.train_dataset, viewer.pipeline.datamanager.train_dataset
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height"):
        torch.testing.assert_close(getattr(opened.cameras, name), getattr(trained.cameras, name))
    assert [photo.name for photo in opened.photos] == [photo.name for photo in trained.photos]


def test_a_button_may_be_pressed_as_soon_as_it_is_there(panel, monkeypatch):
    said, add_button = [], panel._gui.add_button

    def press(label, **options):
        (tour,) = panel._tours
        panel._fly_to_best(tour, SimpleNamespace(client=Client()))
        said.append(panel._place.content)
        return add_button(label, **options)

    monkeypatch.setattr(panel._gui, "add_button", press)
    monkeypatch.setattr(panel, "_place", None, raising=False)
    assert "good views" in type_in(panel, "dome")
    assert len(said) == 1 and "1 of" in said[0]


def test_outputs_are_in_the_order_in_which_they_are_wanted(panel, viewer):
    type_in(panel, "dome; rose window")
    outputs = frame(viewer)
    first = ["rgb", "overlay", "relevancy_0", "relevancy_1", "clip_pca", "bottleneck"]
    assert list(outputs)[:6] == first and {"depth", "accumulation"} < set(outputs)
    assert all(outputs[name].min() >= 0 and outputs[name].max() <= 1 for name in first)


def test_a_text_brings_up_the_overlay_and_an_empty_box_takes_it_away(panel, viewer):
    assert "dome" in type_in(panel, "dome")
    assert viewer.control_panel.output_render == "overlay"
    outputs = frame(viewer)
    assert not torch.equal(outputs["overlay"], outputs["rgb"])
    assert type_in(panel, "  ") == INVITATION
    assert viewer.control_panel.output_render == "rgb" and panel._results is None
    outputs = frame(viewer)
    assert torch.equal(outputs["overlay"], outputs["rgb"]) and "relevancy_0" not in outputs


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (" ; ", "prompt is empty"),
        ('not "dome"', "not what to find"),
        ("x" * 2000, "beginning of a long text"),
        ("🙂🏰", "🙂🏰"),
        ("окно; 窗户; نافذة", "窗户"),
        ("# <script>alert(1)</script>", "script"),
        ("xyzzy\x00\ud83d", "xyzzy"),
    ],
)
def test_whatever_is_typed_is_answered(panel, viewer, text, says):
    assert says in type_in(panel, text)
    assert "went wrong" not in panel._message.content
    assert frame(viewer)["rgb"].isfinite().all()


def test_where_nothing_matches_the_panel_says_what_to_do(panel):
    panel._threshold.value = 1.0
    panel._take_settings()
    assert "Lower it, or try other words" in type_in(panel, "xyzzy")
    assert panel._results is None


def test_nothing_is_found_outside_the_foreground(panel, viewer):
    type_in(panel, "dome; tower")
    alone = frame(viewer)
    type_in(panel, "dome", foreground="tower; arch")
    confined = frame(viewer)
    assert "relevancy_1" not in confined
    type_in(panel, "tower; arch")
    parts = frame(viewer)
    inside = torch.maximum(parts["relevancy_0"], parts["relevancy_1"]) > 0.5
    torch.testing.assert_close(confined["relevancy_0"], alone["relevancy_0"] * inside)
    type_in(panel, "dome", foreground="dome")
    itself = frame(viewer)["relevancy_0"]
    torch.testing.assert_close(itself, alone["relevancy_0"] * (alone["relevancy_0"] > 0.5))


def test_negatives_count_for_every_prompt(panel):
    type_in(panel, 'dome; towers not "roof"', negatives="door,  blind  arcade ;")
    found = [prompt.negatives for prompt in panel.conversation.question.prompts]
    assert found == [("door", "blind arcade"), ("roof", "door", "blind arcade")]


def test_settings_change_what_is_shown(panel, viewer):
    type_in(panel, "dome")
    # Where something else than the scene's highest relevancy is the view's own.
    least = min(panel.conversation.found[0].viewpoints, key=lambda v: v.score).name
    before = frame(viewer, least)["overlay"]
    for name, value in (("opacity", 0.2), ("colour_map", "magma"), ("stretch", PER_SCENE)):
        setting = getattr(panel, f"_{name}")
        kept, setting.value = setting.value, value
        panel._take_settings()
        assert not torch.equal(frame(viewer, least)["overlay"], before), name
        setting.value = kept
    panel._take_settings()
    torch.testing.assert_close(frame(viewer, least)["overlay"], before)


def test_the_look_of_a_photo_can_be_chosen(panel, viewer):
    model = viewer.get_model()
    panel._look.value = model.appearance.names[-1]
    panel._take_settings()
    assert model.look == model.appearance.names[-1]
    panel._look.value = OWN_LOOK
    panel._take_settings()
    assert model.look is None


def test_exact_and_fast_answers_agree_and_the_status_says_which_it_is(panel, viewer):
    type_in(panel, "dome")
    fast, status = frame(viewer)["relevancy_0"], panel._status.content
    assert (
        "fast: read from the lookup table" in status and "ms per frame" in status and "ms per text" in status
    )
    panel._exact.value = True
    panel._take_settings()
    exact = frame(viewer)["relevancy_0"]
    assert "every pixel is decoded" in panel._status.content
    panel._exact.value = False
    panel._take_settings()
    assert not torch.equal(fast, exact)
    torch.testing.assert_close(fast, exact, atol=0.05, rtol=0)


def test_flying_ends_at_the_best_viewpoint_and_next_goes_on(panel, monkeypatch):
    monkeypatch.setattr(panel_module, "_FLIGHT_SECONDS", 0.0)
    type_in(panel, "dome")
    (tour,), client = panel._tours, Client()
    panel._fly_to_best(tour, SimpleNamespace(client=client))
    assert panel._place.content.startswith("1 of ")
    wait_until_at(client, tour.found.viewpoints[0], tour)
    panel._fly(tour, 1, client)
    assert panel._place.content.startswith("2 of ")
    wait_until_at(client, tour.found.viewpoints[1], tour)


def wait_until_at(client, viewpoint, tour):
    goal = stand_of(viewpoint.camera, client.camera.aspect, tour.found.box.centre)
    for _ in range(100):
        if np.allclose(client.camera.position, goal.position * 10):
            break
        time.sleep(0.02)
    np.testing.assert_allclose(client.camera.position, goal.position * 10)
    np.testing.assert_allclose(client.camera.look_at, goal.look_at * 10)
    assert client.camera.fov == goal.fov


def test_boxes_are_drawn_for_what_is_found_and_can_be_left_out(panel):
    type_in(panel, "dome; door")
    assert len(panel._drawn) == 4  # lines and a label each
    panel._boxes.value = False
    panel._draw_boxes()
    assert panel._drawn == []
    panel._boxes.value = True


def test_it_says_who_can_open_the_page(panel, viewer):
    assert "--viewer.websocket-host 0.0.0.0" in panel._who_may_look()
    viewer.config.websocket_host = "0.0.0.0"
    assert "Others can open" in panel._who_may_look()
    viewer.config.websocket_host = "127.0.0.1"


def test_renders_answer_the_query_of_the_environment_and_nothing_without(trainer, monkeypatch):
    def outputs():
        _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="inference")
        with torch.no_grad():
            return pipeline.model.get_outputs_for_camera(as_nerfstudio(pipeline.scene_file.photos[0].camera))

    assert "overlay" not in outputs()
    monkeypatch.setenv(QUERY_VARIABLE, "rose window; dome")
    assert {"relevancy_0", "relevancy_1", "overlay", "clip_pca", "bottleneck"} <= set(outputs())


def test_while_the_model_learns_every_answer_is_exact_and_about_the_model_of_now(
    trainer, tiny_clip, tiny_dense
):
    """The very model that is in training, with the lock and the state that its trainer has."""
    conversation = panel_module.Conversation(
        trainer.pipeline.model.train(),
        trainer.pipeline.scene_file,
        trainer.base_dir,
        trainer.train_lock,
        learning=lambda: True,
        shown=lambda: {"rgb"},
        watch=lambda _: None,
    )
    conversation.ask("dome")
    before = conversation._scene
    assert not conversation.prepare() and "still learns" in conversation.status()
    conversation.display = conversation.display.__class__(threshold=0.0)
    assert conversation.find()[0].viewpoints
    conversation.ask("dome")
    assert conversation._scene is not before and conversation._scene._cache_dir is None
    assert trainer.pipeline.model.training
    assert trainer.train_lock.acquire(blocking=False)
    trainer.train_lock.release()


def test_a_scene_can_be_asked_while_it_is_trained(scene, tiny_clip, tiny_dense, tmp_path):
    changes = {"vis": "viewer", "viewer__quit_on_train_completion": True}
    trainer = make_trainer(scene, tiny_clip, tiny_dense, tmp_path, 40, **changes)
    trainer.setup()
    viewer, panel = trainer.viewer_state, trainer.pipeline.panel
    panel._threshold.value = 0.0
    panel._take_settings()
    seen, shown = [], []

    def person():
        while trainer.training_state == "training":
            seen.append(type_in(panel, "dome"))
            outputs, status = frame(viewer), panel._status.content
            if trainer.training_state == "training":  # still
                shown.append("relevancy_0" in outputs and "still learns" in status)

    person_at_the_page = threading.Thread(target=person)
    person_at_the_page.start()
    trainer.train()
    person_at_the_page.join(60)
    assert not person_at_the_page.is_alive()
    assert seen and all("dome" in message and "good views" in message for message in seen)
    assert shown and all(shown)
    type_in(panel, "dome")
    frame(viewer)
    assert "fast" in panel._status.content
    viewer.viser_server.stop()
