"""The panel "Ask the scene" in nerfstudio's viewer, while training and with `ns-viewer`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import viser
import viser.theme
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.viewer.fly_to import Stand, Tour, box_lines, flight, stand_of
from lang3dxl_ns.plugin.viewer.frame_size import keep_frames_recognizable
from lang3dxl_ns.plugin.viewer.frustums import draw_frustums
from lang3dxl_ns.plugin.viewer.guard import Guard, guard_viewers
from lang3dxl_ns.plugin.viewer.session import Conversation, plain, shortened
from lang3dxl_ns.plugin.viewer.worker import Worker
from lang3dxl_ns.query.match import Found
from lang3dxl_ns.query.overview import overview
from lang3dxl_ns.query.run_file import ScenePhoto
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.scene.camera import Camera

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer

    from lang3dxl_ns.plugin.model import Lang3DXLModel
    from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline

STEPS = {"Previous": -1, "Next": 1}
COLOR_MAPS = ("turbo", "viridis", "magma", "plasma", "inferno", "cividis")
PER_VIEW, PER_SCENE = "to this view", "to the whole scene"
OWN_LOOK = "of the nearest photo"
INVITATION = 'Type what to look for: `rose window`, several as `dome; towers`, or `"windows" not "doors"`.'
LONG_TEXT = 300
"""Characters that fit CLIP's 77 tokens, about."""
BRAND = (255, 211, 105)
_TYPING = 0.5
"""Seconds after the last keystroke until the text takes effect."""
_FLIGHT_SECONDS, _FLIGHT_STEPS = 1.2, 30


class AskPanel(ViewerControl):
    """A text box, heat maps over the view, and flights to matches.

    nerfstudio's viewer finds it as an attribute of the pipeline, and sets it up on start.
    """

    def __init__(self, pipeline: Lang3DXLPipeline) -> None:
        guard_viewers()  # before nerfstudio starts a server
        keep_frames_recognizable()
        self._pipeline = pipeline
        self._listing = threading.Lock()
        self._results: viser.GuiFolderHandle | None = None
        self._tours: list[Tour] = []
        self._drawn: list[Any] = []
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._flights = 0
        self._first_frame = True

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        self._gui, self._scene = self.viser_server.gui, self.viser_server.scene
        self._guard: Guard = self.viser_server._websock_server.guard  # type: ignore[attr-defined]
        self._guard.share = viewer.config.make_share_url
        self._leave_out_logo()
        model = self._pipeline.model
        with self._gui.add_folder("Ask the scene", order=-1) as self._folder:
            if model.semantic_field is None:
                self._gui.add_markdown("This run has no semantics (it was trained with clip none).")
            else:
                self._add_question()
                self._add_settings()
                self._status = self._gui.add_markdown("")
            with self._gui.add_folder("Who can open this page", expand_by_default=False):
                self._gui.add_markdown(self._guard.who_may_look)
        CONSOLE.print(self._guard.who_may_look.replace("`", ""), soft_wrap=True, highlight=False)
        self._photos = [photo for photo in self._pipeline.scene_file.photos if photo.split == "train"]
        self.viser_server.on_client_connect(self._welcome)
        if viewer.trainer is None:
            self._draw_cameras()
        if model.semantic_field is not None:
            self._start(model)

    def _start(self, model: Lang3DXLModel) -> None:
        viewer = self.viewer
        self.conversation = Conversation(
            model,
            self._pipeline.scene_file,
            viewer.log_filename.parent,
            viewer.train_lock or nullcontext(),
            learning=lambda: viewer.trainer is not None and viewer.trainer.training_state != "completed",
            learn=self._pipeline.learn_words,
            shown=self._outputs_shown,
            watch=self._say,
        )
        self._asker, self._finder = Worker("ask"), Worker("find")
        model.answers = _Answers(self)
        if self._pipeline.query:
            self._question.value = self._pipeline.query

    # ── what the page holds ─────────────────────────────────────────────────────────────────────────

    def _add_question(self) -> None:
        gui = self._gui
        self._question = gui.add_text("Look for", "", hint="Several prompts are separated by ;")
        self._negatives = gui.add_text("But not", "", hint="Negatives for all prompts: arcades, doors")
        self._foreground = gui.add_text("Only on", "", hint="Matches must lie on: building")
        button = gui.add_button("Ask", icon=viser.Icon.SEARCH)
        for box in (self._question, self._negatives, self._foreground):
            box.on_update(lambda _: self._asker.submit(self._guarded(self._ask), _TYPING))
        button.on_click(lambda _: self._asker.submit(self._guarded(self._ask)))
        self._message = gui.add_markdown(INVITATION)

    def _add_settings(self) -> None:
        gui, appearance = self._gui, self._pipeline.model.appearance
        looks = (OWN_LOOK, *(() if appearance is None else appearance.names))
        with gui.add_folder("How it is shown"):
            self._automatic = gui.add_checkbox("Automatic", True, hint="What stands out matches")
            self._threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.01, 0.5, hint="Relevancy that matches")
            self._opacity = gui.add_slider("Opacity", 0.0, 1.0, 0.05, 0.7, hint="Of the heat map")
            self._color_map = gui.add_dropdown("Colors", COLOR_MAPS)
            self._stretch = gui.add_dropdown("Stretch", (PER_VIEW, PER_SCENE), hint="To highest relevancy")
            self._boxes = gui.add_checkbox("3D box", True, hint="Around each prompt's strongest match")
            light = "Render with the look of a photo"
            self._look = gui.add_dropdown("Light", looks, visible=len(looks) > 1, hint=light)
        shown: tuple[Any, ...] = (self._opacity, self._color_map, self._stretch, self._look)
        for setting in shown:
            setting.on_update(lambda _: self._take_settings())
        self._automatic.on_update(lambda _: self._take_settings(find=True))
        self._threshold.on_update(lambda _: self._take_threshold())
        self._boxes.on_update(lambda _: self._draw_boxes())

    def _leave_out_logo(self) -> None:
        """nerfstudio's title bar without its logo, which is loaded from the Internet."""
        button = viser.theme.TitlebarButton(
            text="nerfstudio", icon="Description", href="https://docs.nerf.studio"
        )
        self._gui.configure_theme(
            titlebar_content=viser.theme.TitlebarConfig(buttons=(button,), image=None),
            control_layout="collapsible",
            dark_mode=True,
            show_share_button=self._guard.share,
            brand_color=BRAND,
        )

    def _draw_cameras(self) -> None:
        """With ns-viewer: cameras without photos; nerfstudio would first read all photos."""
        viewer = self.viewer
        viewer.pause_train.visible = False  # there is nothing to pause
        viewer.config.max_num_display_images = 0
        size = viewer.config.camera_frustum_scale
        self._frustums = draw_frustums(self._scene, self._photos, _scale(), size, self._fly_to_photo)
        viewer.hide_images.on_click(lambda _: self._show_frustums(False))
        viewer.show_images.on_click(lambda _: self._show_frustums(True))
        self._hide_cameras()

    def _show_frustums(self, visible: bool) -> None:
        for frustum in self._frustums:
            frustum.visible = visible

    def _hide_cameras(self) -> None:
        """As if by the button: a viewer at a photo's position would be inside its frustum."""
        viewer = self.viewer
        if viewer.hide_images.visible:
            self._show_frustums(False)
            for frustum in getattr(viewer, "camera_handles", {}).values():  # none before training begins
                frustum.visible = False
            viewer.toggle_cameravis_button()

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def _guarded(self, job: Callable[[], None]) -> Callable[[], None]:
        """The same job, with errors shown in the panel: in a thread they would go unseen."""

        def guarded() -> None:
            try:
                job()
            except UserError as error:
                self._say(plain(str(error)))
            except Exception as error:
                self._say(plain(f"Something went wrong, see the terminal: {error!r}"))
                CONSOLE.print_exception()

        return guarded

    def _ask(self) -> None:
        text = self._question.value.strip()
        with self._listing:
            self._clear_results()
        if not text:
            self.conversation.forget()
            self._show_output("rgb")
            self._say(INVITATION)
            return
        self._say("…")
        self.conversation.ask(text, self._negatives.value, self._foreground.value)
        self._show_output("overlay")
        self._finder.submit(self._guarded(self._find))

    def _find(self) -> None:
        if self.conversation.question is None:
            self._say(INVITATION)
            return
        self._say("Looking for the best viewpoints…")
        found = self.conversation.find()
        with self._listing:
            if found is not self.conversation.found:
                return  # there is a newer question
            self._show_results(found)
        self._say("  \n".join(filter(None, (self._summary(found), self.conversation.advice()))))
        self._rerender()

    def _summary(self, found: list[Found]) -> str:
        lines = []
        for one in found:
            count, best = len(one.views), max((v.score for v in one.views), default=0.0)
            where = f"{count} good views, best {best:.2f}" if count else "nowhere"
            lines.append(f"**{plain(shortened(one.prompt.text))}**: {where}")
        if max(len(one.prompt.text) for one in found) > LONG_TEXT:
            lines.append("Only the beginning of a long text is used: CLIP reads about 60 words.")
        return "  \n".join(lines)

    def _take_threshold(self) -> None:
        if self._automatic.value:
            self._automatic.value = False  # takes the settings
        else:
            self._take_settings(find=True)

    def _take_settings(self, find: bool = False) -> None:
        c = self.conversation
        c.display = replace(
            c.display,
            threshold=None if self._automatic.value else self._threshold.value,
            opacity=self._opacity.value,
            color_map=self._color_map.value,
        )
        c.per_scene = self._stretch.value == PER_SCENE
        look = self._look.value
        c.look = None if look == OWN_LOOK else look
        self._rerender()
        if find and c.question is not None:
            self._finder.submit(self._guarded(self._find), _TYPING)

    # ── showing ─────────────────────────────────────────────────────────────────────────────────────

    def answer(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        """Called by the render thread, which holds the lock."""
        found = self.conversation.outputs(rendering, seconds)
        self._status.content = self.conversation.status()
        if self._first_frame:
            self._first_frame = False
            self._finder.submit(self._guarded(self._find), 1.0)
        return found

    def _say(self, message: str) -> None:
        self._message.content = message

    def _outputs_shown(self) -> set[str]:
        panel = self.viewer.control_panel
        return {panel.output_render, panel.split_output_render if panel.split else panel.output_render}

    def _show_output(self, name: str) -> None:
        """Select an output as if by hand; nerfstudio has no public way."""
        chosen = self.viewer.control_panel._output_render
        if chosen.value != name:
            chosen.value = name
        self._rerender()

    def _rerender(self) -> None:
        self.viewer._trigger_rerender()

    def _clear_results(self) -> None:
        if self._results is not None:
            self._results.remove()
        self._results, self._tours = None, []
        self._draw_boxes()

    def _show_results(self, found: list[Found]) -> None:
        self._clear_results()
        self._tours = [Tour(one) for one in found if one.views]
        if not self._tours:
            return
        self._tour = self._tours[0]
        with self._folder, self._gui.add_folder("Fly to", order=self._message.order + 0.5) as self._results:
            # Assigned before the buttons are shown: one may be pressed immediately.
            self._place = self._gui.add_markdown("", order=1e9)
            for tour in self._tours:
                button = self._gui.add_button(shortened(tour.found.prompt.text), icon=viser.Icon.PLANE)
                button.on_click(partial(self._fly_to_best, tour))
            steps = self._gui.add_button_group("View", tuple(STEPS))
            steps.on_click(lambda event: self._fly(self._tour, STEPS[event.target.value], event.client))
        self._draw_boxes()

    def _draw_boxes(self) -> None:
        for handle in self._drawn:
            handle.remove()
        self._drawn = []
        scale = _scale()
        for i, tour in enumerate(self._tours):
            box = tour.found.box
            if box is None or not self._boxes.value:
                continue
            low, high = (tuple(scale * x for x in corner) for corner in (box.low, box.high))
            lines = self._scene.add_spline_catmull_rom(
                f"/ask/box_{i}",
                box_lines(low, high),
                "catmullrom",
                tension=0.0,  # straight from point to point
                line_width=2.5,
                color=BRAND,
                segments=15,
            )
            top = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2])
            label = self._scene.add_label(f"/ask/label_{i}", shortened(tour.found.prompt.text), position=top)
            self._drawn += [lines, label]

    # ── flying ──────────────────────────────────────────────────────────────────────────────────────

    def _welcome(self, client: viser.ClientHandle) -> None:
        """New clients start at an overview photo."""
        middle = tuple(self._pipeline.model.means.detach().median(0).values.tolist())
        camera = overview(self._photos, middle).camera
        _place_camera(client, stand_of(camera, client.camera.aspect, middle))

    def _fly_to_best(self, tour: Tour, event) -> None:
        self._fly(tour, 0, event.client)

    def _fly(self, tour: Tour, step: int, client: viser.ClientHandle | None) -> None:
        """To the best viewpoint (`step` 0), or `step` viewpoints further on."""
        self._tour = tour
        viewpoint = tour.best() if step == 0 else tour.move(step)
        self._place.content = plain(str(tour))
        target = None if tour.found.box is None else tour.found.box.center
        for one in [client] if client is not None else self.viser_server.get_clients().values():
            self._fly_camera(one, viewpoint.camera, target)

    def _fly_to_photo(self, photo: ScenePhoto, client: viser.ClientHandle) -> None:
        self._fly_camera(client, photo.camera, None)

    def _fly_camera(
        self, client: viser.ClientHandle, camera: Camera, target: tuple[float, ...] | None
    ) -> None:
        """In a separate thread: this one may be receiving the page's messages."""
        self._hide_cameras()
        self._flights += 1
        mine = self._flights
        start = Stand(client.camera.position / _scale(), client.camera.look_at / _scale(), client.camera.fov)
        end = stand_of(camera, client.camera.aspect, target)

        def fly() -> None:
            for stand in flight(start, end, _FLIGHT_STEPS):
                if mine != self._flights:
                    return  # another flight has begun
                _place_camera(client, stand)
                client.flush()
                time.sleep(_FLIGHT_SECONDS / _FLIGHT_STEPS)

        threading.Thread(target=fly, daemon=True).start()


def _place_camera(client: viser.ClientHandle, stand: Stand) -> None:
    with client.atomic():
        client.camera.position, client.camera.look_at = stand.position * _scale(), stand.look_at * _scale()
        client.camera.fov = stand.fov


def _scale() -> float:
    """The viewer's units per unit of the model."""
    from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO  # imports the models

    return VISER_NERFSTUDIO_SCALE_RATIO


class _Answers:
    """The panel's answers to renderings."""

    def __init__(self, panel: AskPanel) -> None:
        self._panel = panel

    @property
    def shows_bottleneck(self) -> bool:
        return self._panel.conversation.shows_bottleneck

    @property
    def look(self) -> str | None:
        return self._panel.conversation.look

    def channels(self) -> Tensor | None:
        return self._panel.conversation.channels()

    def outputs(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        return self._panel.answer(rendering, seconds)
