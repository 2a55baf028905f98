"""The viewer's panel without a browser: prompts, outputs, flights."""

import threading
import time
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from idle_worker import idle
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.viewer import Viewer
from runs import make_trainer, train_run
from scenes import view_of, write_scene

from lang3dxl_ns.plugin.panel import INVITATION, stand_of
from lang3dxl_ns.plugin.pipeline import QUERY_VARIABLE
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.scene.record import overview
from lang3dxl_ns.things.find import Things
from lang3dxl_ns.things.thing import Sighting, Thing
from lang3dxl_ns.training import snapshot as session
from lang3dxl_ns.training.conversation import Conversation


@pytest.fixture(scope="module")
def trainer(tmp_path_factory, tiny_clip, tiny_dense):
    """A run whose photos are gone."""
    root = tmp_path_factory.mktemp("run")
    data = write_scene(root / "scene", photos=6, points=200, mixed=True)
    trainer = train_run(
        data, tiny_clip, tiny_dense, root / "outputs", 30, pipeline__model__appearance__use="on"
    )
    (data / "images").rename(data / "renamed")
    return trainer


@pytest.fixture(scope="module")
def viewer(trainer):
    """The viewer as ns-viewer starts it."""
    config, pipeline, _, step = eval_setup(trainer.base_dir / "config.yml", test_mode="test")
    # With CLIP's random weights nothing is sure to be found.
    patch = pytest.MonkeyPatch()
    patch.setattr(session, "QueryConfig", partial(QueryConfig, threshold=0.0))
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
    patch.undo()


@pytest.fixture
def panel(viewer):
    yield viewer.pipeline.panel
    type_in(viewer.pipeline.panel, "")


def type_in(panel, text: str) -> str:
    """The panel's message after a text is processed."""
    panel._question.value = text
    panel._asker.submit(panel._ask)
    time.sleep(0.05)  # setting a box tells the panel in a thread of viser's
    assert idle(panel._asker) and idle(panel._finder)
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
    assert viewer.control_panel.output_render == "rgb" and not panel._fly.visible
    outputs = frame(viewer)
    assert torch.equal(outputs["overlay"], outputs["rgb"]) and "relevancy_0" not in outputs


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (" ; ", "prompt is empty"),
        ('not "dome"', "only negatives"),
        ("x" * 2000, "xxxx"),
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


def test_the_status_says_how_long_it_took(panel, viewer):
    type_in(panel, "dome")
    frame(viewer)
    assert "ms per frame" in panel._status.content


def test_the_picture_of_the_codes_is_made_when_someone_looks(panel, viewer, monkeypatch):
    assert frame(viewer)["bottleneck"].std() < 1e-6
    monkeypatch.setattr(panel.conversation, "shown", lambda: {"bottleneck"})
    assert frame(viewer)["bottleneck"].std() > 0.01


def test_flying_leads_through_the_best_views_of_all_prompts(panel):
    type_in(panel, "dome; door")
    client, seen = Client(), []
    for number in range(3):
        panel._fly_on(client)
        found, view = panel._views[number]
        seen.append((found.prompt.text, view))
        goal = stand_of(found.views[view].camera, client.camera.aspect, found.box.center)
        np.testing.assert_allclose(client.camera.position, goal[0] * 10)
        np.testing.assert_allclose(client.camera.look_at, goal[1] * 10)
        assert found.views[view].name.split(".")[0] in panel._message.content.replace("\\", "")
    assert seen == [("dome", 0), ("door", 0), ("dome", 1)]


def test_single_things_are_counted_and_each_can_be_flown_to(panel, monkeypatch):
    type_in(panel, "dome")
    photo = panel._photos[1]
    seen = [Sighting(photo.name, (0, 0, 4, 4))]
    things = [Thing(n, "dome", 1.0, 9, np.full(3, n), np.eye(3), np.ones(3), np.array([n]), seen)
              for n in range(2)]  # fmt: skip
    monkeypatch.setattr(panel.conversation, "things", lambda: [Things("dome", things, things[:1])])
    assert panel._count.visible and not panel._listed.visible
    panel._finder.submit(panel._list)
    assert idle(panel._finder)
    assert "2, perhaps 2 to 3 found" in panel._message.content
    assert panel._listed.visible and list(panel._listed.options)[1:] == ["dome 1", "dome 2"]
    client = Client()
    panel._listed.value = "dome 2"
    panel._fly_to(client)
    goal = stand_of(panel._pipeline.scene_file.photo(photo.name).camera, client.camera.aspect, (1.0,) * 3)
    np.testing.assert_allclose(client.camera.look_at, goal[1] * 10)
    type_in(panel, "door")
    assert not panel._listed.visible
    panel._fly_to(client)  # the list of the question before is gone


def test_the_conversation_finds_the_things_of_its_question(panel):
    type_in(panel, "dome; door")
    assert [one.word for one in panel.conversation.things()] == ["dome", "door"]


def test_a_page_opens_at_the_overview_and_no_photo_is_in_its_way(panel, viewer):
    client = Client()
    panel._welcome(client)
    middle = tuple(viewer.get_model().means.detach().median(0).values.tolist())
    goal = stand_of(overview(panel._photos, middle).camera, 1.5, middle)
    np.testing.assert_allclose(client.camera.position, goal[0] * 10)
    assert viewer.config.max_num_display_images == 0


def test_renders_answer_the_query_of_the_environment_and_nothing_without(trainer, monkeypatch):
    def outputs():
        _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml", test_mode="inference")
        with torch.no_grad():
            return pipeline.model.get_outputs_for_camera(view_of(pipeline.scene_file.photos[0].camera))

    assert "overlay" not in outputs()
    monkeypatch.setenv(QUERY_VARIABLE, "rose window; dome")
    assert {"relevancy_0", "relevancy_1", "overlay", "bottleneck"} <= set(outputs())


def test_while_the_model_learns_its_words_are_gathered_when_they_are_asked_for(trainer, viewer):
    """The model in training, with its trainer's lock and state."""
    model, learned = trainer.pipeline.model.train(), []
    codes = model.gauss_params["codes"]

    def learn():
        learned.append(model.run.step)
        model.gauss_params["codes"] = codes

    snapshots = session.Snapshots(
        model.run,
        trainer.pipeline.scene_file,
        trainer.base_dir,
        trainer.train_lock,
        learning=lambda: True,
        learn=learn,
        watch=lambda _: None,
    )
    conversation = Conversation(snapshots, lambda: {"rgb"})
    conversation.ask("dome")
    before = snapshots.latest().scene
    assert learned == [model.run.step] and "still learns" in conversation.status()
    assert conversation.find()[0].views
    conversation.ask("dome")
    assert len(learned) == 1  # of the same model
    model.run.step += 10
    conversation.ask("dome")
    assert len(learned) == 2
    assert snapshots.latest().scene is not before and snapshots.latest().scene.cache is None
    assert model.training
    assert trainer.train_lock.acquire(blocking=False)
    trainer.train_lock.release()


def test_a_scene_can_be_asked_while_it_is_trained(scene, viewer, tiny_clip, tiny_dense, tmp_path):
    changes = {"vis": "viewer", "viewer__quit_on_train_completion": True}
    trainer = make_trainer(scene, tiny_clip, tiny_dense, tmp_path, 40, **changes)
    trainer.setup()
    viewer, panel = trainer.viewer_state, trainer.pipeline.panel
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


def test_questions_leave_no_messages_behind(panel, viewer):
    """viser keeps the latest of each kind for pages that open later."""
    kept = viewer.viser_server._websock_server._broadcast_buffer.message_from_id
    counts = []
    for i in range(4):
        type_in(panel, f"dome {i}")
        frame(viewer)
        counts.append(len(kept))
    assert counts[1] == counts[-1]
