"""The panel "Ask the scene" in nerfstudio's viewer, during training and with `ns-viewer`."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import TYPE_CHECKING, Protocol

import numpy as np
import viser
import viser.theme
from jaxtyping import Float
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl
from numpy import ndarray as Array

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.worker import Worker
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.plugin.viewer_guard import guard_viewers
from lang3dxl_ns.query.match import Found
from lang3dxl_ns.query.text import NO_SEMANTICS
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.scene.record import SceneRecord, overview
from lang3dxl_ns.things.thing import Thing
from lang3dxl_ns.training.conversation import Conversation, plain
from lang3dxl_ns.training.snapshot import Snapshots

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import Trainer
    from nerfstudio.viewer.viewer import Viewer

INVITATION = (
    'Type what to look for: `rose window`, several as `dome; towers`, or `"windows" not "doors"`. '
    "A finished run has a richer page: `lang3dxl view`."
)
_NOWHERE = "…"
_TYPING = 0.5
"""Seconds after the last keystroke until the text takes effect."""


class Asked(Protocol):
    """What the panel asks of a pipeline, whose module imports this one."""

    @property
    def model(self) -> Lang3DXLModel: ...

    @property
    def scene_file(self) -> SceneRecord: ...

    @property
    def query(self) -> str: ...

    def learn_words(self) -> None: ...


class AskPanel(ViewerControl):
    """A text box, heat maps over the view, and the views that show a match best. nerfstudio's viewer finds
    the panel as an attribute of the pipeline, and sets it up on start."""

    def __init__(self, pipeline: Asked) -> None:
        guard_viewers()  # must precede the server that nerfstudio starts
        self._pipeline, self._model = pipeline, pipeline.model
        self._views: list[tuple[Found, int]] = []
        """Views to fly to: pairs of a match and its view's number, all best views before all second ones."""
        self._things: dict[str, Thing] = {}
        """Single things of the question, by their names in the list."""
        self._place = -1
        self._first_frame = True

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        if viewer.config.max_num_display_images == ViewerConfig().max_num_display_images:
            # A viewer at a photo's position would see only that photo's frame, and ns-viewer would read all
            # photos.
            viewer.config.max_num_display_images = 0
        if viewer.trainer is None:
            viewer.pause_train.visible = False  # nothing can be paused
        self._leave_out_logo()
        gui, model = self.viser_server.gui, self._model
        with gui.add_folder("Ask the scene", order=-1):
            if model.semantic_field is None:
                gui.add_markdown(NO_SEMANTICS)
            else:
                self._add_question()
        self._photos = [photo for photo in self._pipeline.scene_file.photos if photo.split == "train"]
        self.viser_server.on_client_connect(self._welcome)
        if model.semantic_field is not None:
            self._start(viewer)

    def _add_question(self) -> None:
        gui = self.viser_server.gui
        self._question = gui.add_text("Look for", "", hint="Several prompts are separated by ;")
        self._message = gui.add_markdown(INVITATION)
        self._fly = gui.add_button("Fly to the next view", icon=viser.Icon.PLANE, visible=False)
        self._count = gui.add_button("Count single things", icon=viser.Icon.LIST_NUMBERS, visible=False)
        self._listed = gui.add_dropdown("Fly to", (_NOWHERE,), visible=False)
        self._status = gui.add_markdown("")
        self._question.on_update(lambda _: self._asker.submit(self._ask, _TYPING))
        self._fly.on_click(lambda event: self._fly_on(event.client))
        self._count.on_click(lambda _: self._finder.submit(self._list))
        self._listed.on_update(lambda event: self._fly_to(event.client))

    def _start(self, viewer: Viewer) -> None:
        snapshots = Snapshots(
            self._model.run,
            self._pipeline.scene_file,
            viewer.log_filename.parent,
            viewer.train_lock or nullcontext(),
            learning=lambda: _changes(viewer.trainer),
            learn=self._pipeline.learn_words,
            watch=self._say,
        )
        self.conversation = Conversation(snapshots, self._outputs_shown, self._drawn)
        self._asker, self._finder = Worker("ask", self._failed), Worker("find", self._failed)
        self._model.answers = self.conversation
        if self._pipeline.query:
            self._question.value = self._pipeline.query

    def _leave_out_logo(self) -> None:
        """Show nerfstudio's title bar without its logo, which would be loaded from the Internet."""
        address = "https://docs.nerf.studio"
        button = viser.theme.TitlebarButton(text="nerfstudio", icon="Description", href=address)
        self.viser_server.gui.configure_theme(
            titlebar_content=viser.theme.TitlebarConfig(buttons=(button,), image=None),
            control_layout="collapsible",
            dark_mode=True,
            show_share_button=False,
        )

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def _failed(self, error: Exception) -> None:
        """Show a job's error in the panel; in a thread it would go unseen."""
        if isinstance(error, UserError):
            return self._say(plain(str(error)))
        self._say(plain(f"Something went wrong, see the terminal: {error!r}"))
        CONSOLE.print_exception()

    def _ask(self) -> None:
        text = self._question.value.strip()
        self._offer_views([])
        if not text:
            self.conversation.forget()
            self._say(INVITATION)
            return self._show_output("rgb")
        self._say("…")
        self.conversation.ask(text)
        self._show_output("overlay")
        self._finder.submit(self._find)

    def _find(self) -> None:
        if self.conversation.question is None:
            return
        self._say("Looking for the best views…")
        found = self.conversation.find()
        if found is self.conversation.found:  # otherwise a newer question has replaced this one
            self._offer_views(found)
            self._say(self.conversation.summary())
            self.viewer._trigger_rerender()

    def _offer_views(self, found: list[Found]) -> None:
        most = max((len(one.views) for one in found), default=0)
        self._views = [(one, i) for i in range(most) for one in found if i < len(one.views)]
        self._place, self._fly.visible = -1, bool(self._views)
        self._things, self._count.visible, self._listed.visible = {}, bool(self._views), False

    def _list(self) -> None:
        """List the question's single things, to fly to each."""
        question = self.conversation.question
        if question is None:
            return
        self._say("Looking for single things…")
        answers = self.conversation.things()
        if question is self.conversation.question:
            self._things = {
                f"{one.word} {n}": thing for one in answers for n, thing in enumerate(one.things, 1)
            }
            self._listed.options, self._listed.visible = (_NOWHERE, *self._things), bool(self._things)
            self._say("  \n".join(f"**{plain(one.word)}**: {one.count} found" for one in answers))

    # ── showing ─────────────────────────────────────────────────────────────────────────────────────

    def _drawn(self) -> None:
        """Tell how a frame went. The render thread calls this, and holds the lock."""
        self._status.content = self.conversation.status()
        if self._first_frame:
            self._first_frame = False
            self._finder.submit(self._find, 1.0)

    def _say(self, message: str) -> None:
        self._message.content = message

    def _outputs_shown(self) -> set[str]:
        panel = self.viewer.control_panel
        return {panel.output_render} | ({panel.split_output_render} if panel.split else set())

    def _show_output(self, name: str) -> None:
        """Select an output as the user would; nerfstudio has no public way to do so."""
        chosen = self.viewer.control_panel._output_render
        if chosen.value != name:
            chosen.value = name
        self.viewer._trigger_rerender()

    # ── flying ──────────────────────────────────────────────────────────────────────────────────────

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Place a new client's camera at the overview photo."""
        middle = tuple(self._model.means.detach().median(0).values.tolist())
        _place_camera(client, overview(self._photos, middle).camera, middle)

    def _fly_on(self, client: viser.ClientHandle | None) -> None:
        """Fly to the next view of the matches: the best one of each prompt, then the second ones."""
        views = self._views
        if client is None or not views:
            return
        self._place = (self._place + 1) % len(views)
        found, number = views[self._place]
        view, text = found.views[number], plain(found.prompt.text[:40])
        self._say(
            f"{text}, {number + 1} of {len(found.views)}: {plain(view.name)}, {view.area:.0%} of it matches"
        )
        _place_camera(client, view.camera, None if found.box is None else found.box.center)

    def _fly_to(self, client: viser.ClientHandle | None) -> None:
        """Fly to the thing that is chosen in the list, where the photo that shows it best was taken."""
        thing = self._things.get(self._listed.value)
        if client is not None and thing is not None:
            camera = self._pipeline.scene_file.photo(thing.sightings[0].photo).camera
            _place_camera(client, camera, tuple(thing.center.tolist()))


def _place_camera(client: viser.ClientHandle, camera: Camera, target: tuple[float, ...] | None) -> None:
    from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO as SCALE  # imports the models

    position, look_at, fov = stand_of(camera, client.camera.aspect, target)
    with client.atomic():
        client.camera.position, client.camera.look_at = position * SCALE, look_at * SCALE
        client.camera.fov = fov


def stand_of(
    camera: Camera, aspect: float, target: tuple[float, ...] | None = None
) -> tuple[Float[Array, "3"], Float[Array, "3"], float]:
    """Compute the viewer's position, orbit center (both in the model's axes) and vertical field of view
    (radians) that show all of a photo in a window of this aspect ratio (width ÷ height), without roll, which
    the viewer's controls lack. The orbit center is `target`, moved onto the photo's axis at its distance;
    None puts it a unit away."""
    view = camera.view_matrix.double().cpu().numpy()
    forward, position = view[2, :3], -view[:3, :3].T @ view[:3, 3]
    ahead = 1.0 if target is None else float((np.asarray(target) - position) @ forward)
    k = camera.intrinsics.double().cpu().numpy()
    half_height = max(k[1, 2], camera.height - k[1, 2]) / k[1, 1]
    half_width = max(k[0, 2], camera.width - k[0, 2]) / k[0, 0]
    fov = 2 * math.atan(max(half_height, half_width / aspect))
    return position, position + max(ahead, 0.05) * forward, fov


def _changes(trainer: Trainer | None) -> bool:
    """Return whether training still changes its model; None: there is no training."""
    over = trainer is None or trainer.training_state == "completed"
    return not (over or getattr(trainer, "has_final_words", False))
