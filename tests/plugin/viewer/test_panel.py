"""The viewer's panel without a browser: prompts, outputs, flights."""

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

from lang3dxl_ns.plugin.cameras import view_of
from lang3dxl_ns.plugin.pipeline import QUERY_VARIABLE
from lang3dxl_ns.plugin.viewer import panel as panel_module
from lang3dxl_ns.plugin.viewer.fly_to import stand_of
from lang3dxl_ns.plugin.viewer.frame_size import least_size
from lang3dxl_ns.plugin.viewer.panel import INVITATION, OWN_LOOK, PER_SCENE


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
    """The viewer as ns-viewer starts it."""
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
    """The panel's message after a text is processed."""
    panel._negatives.value, panel._foreground.value, panel._question.value = negatives, foreground, text
    panel._asker.submit(panel._guarded(panel._ask))
    time.sleep(0.05)  # setting a box tells the panel in a thread of viser's
    assert panel._asker.wait() and panel._finder.wait()
    return panel._message.content


def frame(viewer, photo: str | None = None) -> dict[str, torch.Tensor]:
    """What a frame of the viewer consists of, rendered as its threads do it; of the first photo's camera."""
    panel, model = viewer.pipeline.panel, viewer.get_model()
    chosen = next(p for p in panel._photos if photo in (None, p.name))
    camera = view_of(chosen.camera)
    with viewer.train_lock, torch.no_grad():
        training = model.training
        model.eval()
        outputs = model.get_outputs_for_camera(camera, obb_box=None)
        model.train(training)
    return outputs


class Client:
    """A connected client."""

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
    assert said and all("1 of" in place for place in said)


def test_a_new_question_waits_until_the_places_of_the_last_are_listed(panel, monkeypatch):
    askers, add_button = [], panel._gui.add_button

    def interrupt(label, **options):
        panel._question.value = ""
        askers.append(threading.Thread(target=panel._guarded(panel._ask)))
        askers[-1].start()
        askers[-1].join(1.0)
        return add_button(label, **options)

    monkeypatch.setattr(panel._gui, "add_button", interrupt)
    type_in(panel, "dome; portal")
    assert askers and [asker.join(10) for asker in askers]
    assert panel._finder.wait() and panel._message.content == INVITATION
    assert panel._results is None and not panel._tours


def test_outputs_are_in_the_order_in_which_they_are_wanted(panel, viewer):
    type_in(panel, "dome; rose window")
    outputs = frame(viewer)
    first = ["rgb", "overlay", "relevancy_0", "relevancy_1"]
    assert list(outputs)[:4] == first and {"depth", "accumulation", "bottleneck"} < set(outputs)
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
        ('not "dome"', "only negatives"),
        ("x" * 2000, "beginning of a long text"),
        ("🙂🏰", "🙂🏰"),
        ("окно; 窗户; نافذة", "窗户"),
        ("# <script>alert(1)</script>", "script"),
        ("xyzzy\x00\ud83d", "xyzzy"),
    ],
)
def test_any_text_is_answered(panel, viewer, text, says):
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
    for name, value in (("opacity", 0.2), ("color_map", "magma"), ("stretch", PER_SCENE)):
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


def test_the_status_says_how_long_it_took(panel, viewer):
    type_in(panel, "dome")
    frame(viewer)
    assert "ms per frame" in panel._status.content and "ms per text" in panel._status.content


def test_the_picture_of_the_codes_is_made_when_someone_looks(panel, viewer, monkeypatch):
    assert frame(viewer)["bottleneck"].std() < 1e-6
    monkeypatch.setattr(panel.conversation, "_shown", lambda: {"bottleneck"})
    assert frame(viewer)["bottleneck"].std() > 0.01


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
    goal = stand_of(viewpoint.camera, client.camera.aspect, tour.found.box.center)
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


def test_the_panel_says_who_can_open_the_page(panel):
    guard = panel._guard
    assert "--viewer.websocket-host 0.0.0.0" in guard.who_may_look
    guard.host = "0.0.0.0"
    assert "Others can open" in guard.who_may_look
    assert f"?token={guard.token}" in guard.who_may_look
    guard.host = "127.0.0.1"


def test_renders_answer_the_query_of_the_environment_and_nothing_without(trainer, monkeypatch):
    def outputs():
        _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="inference")
        with torch.no_grad():
            return pipeline.model.get_outputs_for_camera(view_of(pipeline.scene_file.photos[0].camera))

    assert "overlay" not in outputs()
    monkeypatch.setenv(QUERY_VARIABLE, "rose window; dome")
    assert {"relevancy_0", "relevancy_1", "overlay", "bottleneck"} <= set(outputs())


def test_while_the_model_learns_its_words_are_gathered_when_they_are_asked_for(
    trainer, tiny_clip, tiny_dense
):
    """The model in training, with its trainer's lock and state."""
    model, learned = trainer.pipeline.model.train(), []
    conversation = panel_module.Conversation(
        model,
        trainer.pipeline.scene_file,
        trainer.base_dir,
        trainer.train_lock,
        learning=lambda: True,
        learn=lambda: learned.append(model.step),
        shown=lambda: {"rgb"},
        watch=lambda _: None,
    )
    conversation.ask("dome")
    before = conversation._scene
    assert learned == [model.step] and "still learns" in conversation.status()
    conversation.display = conversation.display.__class__(threshold=0.0)
    assert conversation.find()[0].viewpoints
    conversation.ask("dome")
    assert len(learned) == 1  # of the same model
    model.step += 10
    conversation.ask("dome")
    assert len(learned) == 2
    assert conversation._scene is not before and conversation._scene._cache_dir is None
    assert model.training
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
    assert "still learns" not in panel._status.content
    viewer.viser_server.stop()


def test_a_view_is_rendered_once_whatever_is_asked_about_it(viewer, panel, monkeypatch):
    model, renderings = viewer.get_model(), []
    render = type(model).render

    def counted(self, *arguments, **options):
        renderings.append(1)
        return render(self, *arguments, **options)

    monkeypatch.setattr(type(model), "render", counted)
    type_in(panel, "dome")
    model._kept = None
    first = frame(viewer)
    panel._threshold.value = 0.9
    panel._take_settings()
    assert not torch.equal(frame(viewer)["overlay"], first["overlay"])
    type_in(panel, "door")
    again = frame(viewer)
    made = len(renderings)
    assert made == 1
    model._kept = None
    afresh = frame(viewer)
    torch.testing.assert_close(again["relevancy_0"], afresh["relevancy_0"], atol=1e-5, rtol=0)
    frame(viewer, panel._photos[1].name)
    model.look = model.appearance.names[0]
    frame(viewer, panel._photos[1].name)
    with torch.no_grad():
        model.means.add_(0.0)  # as a step of training changes it
    frame(viewer, panel._photos[1].name)
    model.look = None
    assert len(renderings) == made + 4


@pytest.mark.parametrize(("aspect", "size"), [(16 / 9, (180, 320)), (1.0, (320, 320)), (3.0, (180, 540))])
def test_frames_while_moving_are_recognizable(aspect, size):
    assert least_size(30, int(30 * aspect), aspect, most=1024) == size
    assert least_size(400, 700, 1.75, most=1024) == (400, 700)
    assert max(least_size(30, 50, aspect, most=100)) <= 100
