"""The panel "Ask the scene" in nerfstudio's viewer, while training and with `ns-viewer`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import viser
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.query.scene import Found, Viewpoint
from lang3dxl_ns.viewer.conversation import Conversation, shortened
from lang3dxl_ns.viewer.flight import Stand, Tour, box_lines, flight, stand_of
from lang3dxl_ns.viewer.worker import Worker

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer

    from lang3dxl_ns.pipeline import Lang3DXLPipeline

COLOUR_MAPS = ("turbo", "viridis", "magma", "plasma", "inferno", "cividis")
PER_VIEW, PER_SCENE = "to this view", "to the whole scene"
OWN_LOOK = "of the nearest photo"
INVITATION = 'Type what to look for: `rose window`, several as `dome; towers`, or `"windows" not "doors"`.'
LONG_TEXT = 300
"""Characters that a CLIP's 77 tokens hold, about."""
_TYPING = 0.5
"""Seconds without a keystroke after which the text is taken up."""
_FLIGHT_SECONDS, _FLIGHT_STEPS = 1.2, 30


class AskPanel(ViewerControl):
    """A text box, heat maps over the view, and flights to where things are found.

    nerfstudio's viewer finds it as an attribute of the pipeline, and sets it up when it starts.
    """

    def __init__(self, pipeline: Lang3DXLPipeline) -> None:
        self._pipeline = pipeline
        self._tours: list[Tour] = []
        self._drawn: list[Any] = []
        self._flights = 0

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        self._gui, self._scene = self.viser_server.gui, self.viser_server.scene
        model = self._pipeline.model
        with self._gui.add_folder("Ask the scene", order=-1):
            if model.semantic_field is None:
                self._gui.add_markdown("This run has no semantics (it was trained with clip none).")
                return
            self._add_question()
            self._add_settings()
            self._status = self._gui.add_markdown("")
            self._gui.add_markdown(self._who_may_look())
        CONSOLE.print(self._who_may_look().replace("`", ""), soft_wrap=True, highlight=False)
        self.conversation = Conversation(
            model,
            self._pipeline.scene_file,
            viewer.log_filename.parent,
            viewer.train_lock or nullcontext(),
            learning=lambda: viewer.trainer is not None and viewer.trainer.training_state != "completed",
            shown=self._outputs_shown,
            watch=self._say,
        )
        self._asker, self._finder = Worker("ask"), Worker("find")
        self._first_frame = True
        model.answers = self._answers
        if self._pipeline.query:
            self._question.value = self._pipeline.query

    # ── what the panel holds ────────────────────────────────────────────────────────────────────────

    def _add_question(self) -> None:
        self._question = self._gui.add_text("Look for", "", hint="Several prompts are separated by ;")
        self._negatives = self._gui.add_text(
            "But not", "", hint="What it is not to be confused with: arcades, doors"
        )
        button = self._gui.add_button("Ask", icon=viser.Icon.SEARCH)
        for box in (self._question, self._negatives):
            box.on_update(lambda _: self._asker.submit(self._guarded(self._ask), _TYPING))
        button.on_click(lambda _: self._asker.submit(self._guarded(self._ask)))
        self._message = self._gui.add_markdown(INVITATION)
        self._results = self._gui.add_folder("Fly to", visible=False)
        with self._results:
            self._steps = self._gui.add_button_group("", ("Previous", "Next"))
            self._place = self._gui.add_markdown("")
        self._steps.on_click(
            lambda event: self._fly(self._tour, -1 if event.target.value == "Previous" else 1, event.client)
        )
        self._buttons: list[Any] = []

    def _add_settings(self) -> None:
        gui = self._gui
        with gui.add_folder("How it is shown"):
            self._threshold = gui.add_slider(
                "Threshold", 0.3, 0.95, 0.01, 0.5, hint="Relevancy that counts as found"
            )
            self._opacity = gui.add_slider(
                "Opacity", 0.0, 1.0, 0.05, 0.7, hint="Of the heat map over the view"
            )
            self._colour_map = gui.add_dropdown("Colours", COLOUR_MAPS)
            self._stretch = gui.add_dropdown(
                "Stretch", (PER_VIEW, PER_SCENE), hint="What gets the last colour"
            )
            self._boxes = gui.add_checkbox("3D box", True, hint="Around the strongest match of each prompt")
            self._exact = gui.add_checkbox(
                "Exact", False, hint="Decode every pixel instead of reading the table"
            )
            appearance = self._pipeline.model.appearance
            names = () if appearance is None else tuple(appearance.names)
            self._look = gui.add_dropdown("Light", (OWN_LOOK, *names), visible=bool(names),
                                          hint="Show the scene in the light of a photo")  # fmt: skip
        for setting in (self._opacity, self._colour_map, self._stretch, self._look):
            setting.on_update(lambda _: self._take_settings())
        for setting in (self._threshold, self._exact):
            setting.on_update(lambda _: self._take_settings(find=True))
        self._boxes.on_update(lambda _: self._draw_boxes())

    def _who_may_look(self) -> str:
        host = self.viewer.config.websocket_host
        if host in ("127.0.0.1", "localhost", "::1"):
            return "Only this machine can open this viewer; `--viewer.websocket-host 0.0.0.0` lets the network in."
        return (
            f"This viewer is open to the network ({host}); `--viewer.websocket-host 127.0.0.1` keeps it here."
        )

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def _guarded(self, job: Callable[[], None]) -> Callable[[], None]:
        """The same, with what goes wrong said in the panel: a thread's end would go unseen."""

        def guarded() -> None:
            try:
                job()
            except UserError as error:
                self._say(str(error))
            except Exception as error:
                self._say(f"That went wrong, the terminal says where: {error!r}")
                CONSOLE.print_exception()

        return guarded

    def _ask(self) -> None:
        text = self._question.value.strip()
        self._clear_results()
        if not text:
            self.conversation.forget()
            self._show_output("rgb")
            self._say(INVITATION)
            return
        self._say("…")
        self.conversation.ask(text, self._negatives.value)
        self._show_output("overlay")
        self._finder.submit(self._guarded(self._find))

    def _find(self) -> None:
        if not self.conversation.question.prompts:
            self.conversation.prepare()
            self._say(INVITATION)
            return
        self._say("Looking for the best viewpoints…")
        found = self.conversation.find()
        if found is not self.conversation.found:
            return  # something else was asked meanwhile
        self._show_results(found)
        cut = (
            " Only its beginning was read: CLIP takes about 60 words."
            if len(self._question.value) > LONG_TEXT
            else ""
        )
        self._say((self.conversation.advice() or self._summary(found)) + cut)
        self._rerender()

    def _summary(self, found: list[Found]) -> str:
        lines = []
        for one in found:
            count, best = len(one.viewpoints), max((v.score for v in one.viewpoints), default=0.0)
            where = f"{count} good views, best {best:.2f}" if count else "nowhere"
            lines.append(f"**{shortened(one.prompt.text)}**: {where}")
        return "  \n".join(lines)

    def _take_settings(self, find: bool = False) -> None:
        c = self.conversation
        c.display = replace(c.display, threshold=self._threshold.value, opacity=self._opacity.value,
                            colour_map=self._colour_map.value)  # fmt: skip
        c.per_scene, c.exact = self._stretch.value == PER_SCENE, self._exact.value
        look = self._look.value
        self._pipeline.model.look = None if look == OWN_LOOK else look
        self._rerender()
        if find and c.question.prompts:
            self._finder.submit(self._guarded(self._find), _TYPING)

    # ── showing ─────────────────────────────────────────────────────────────────────────────────────

    def _answers(self, outputs, codes, seconds: float):
        """Called by the thread that renders, which holds the lock."""
        found = self.conversation.outputs(outputs, codes, seconds)
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
        """Choose an output as if by hand; nerfstudio has no public way to."""
        chosen = self.viewer.control_panel._output_render
        if chosen.value != name:
            chosen.value = name
        self._rerender()

    def _rerender(self) -> None:
        self.viewer._trigger_rerender()

    def _clear_results(self) -> None:
        for handle in (*self._buttons, *self._drawn):
            handle.remove()
        self._buttons, self._drawn, self._tours = [], [], []
        self._results.visible = False

    def _show_results(self, found: list[Found]) -> None:
        self._clear_results()
        self._tours = [Tour(one) for one in found if one.viewpoints]
        if not self._tours:
            return
        self._tour = self._tours[0]
        with self._results:
            for place, tour in enumerate(self._tours):
                button = self._gui.add_button(
                    shortened(tour.found.prompt.text), icon=viser.Icon.PLANE, order=place - 100.0
                )
                button.on_click(lambda event, tour=tour: self._fly(tour, 0, event.client))
                self._buttons.append(button)
        self._place.content = ""
        self._results.visible = True
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
            # Without tension this curve is straight between its points.
            lines = self._scene.add_spline_catmull_rom(
                f"/ask/box_{i}", box_lines(low, high), "catmullrom", tension=0.0, line_width=2.5,
                color=(255, 211, 105), segments=15,
            )  # fmt: skip
            top = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, high[2])
            label = self._scene.add_label(f"/ask/label_{i}", shortened(tour.found.prompt.text), position=top)
            self._drawn += [lines, label]

    # ── flying ──────────────────────────────────────────────────────────────────────────────────────

    def _fly(self, tour: Tour, step: int, client: viser.ClientHandle | None) -> None:
        """To the best viewpoint (`step` 0), or that many further on."""
        self._tour = tour
        if step == 0:
            tour.place = -1
        viewpoint = tour.move(step or 1)
        self._place.content = str(tour)
        for one in [client] if client is not None else self.viser_server.get_clients().values():
            threading.Thread(target=self._fly_camera, args=(one, viewpoint, tour.found), daemon=True).start()

    def _fly_camera(self, client: viser.ClientHandle, viewpoint: Viewpoint, found: Found) -> None:
        self._flights += 1
        mine, camera, scale = self._flights, client.camera, _scale()
        target = None if found.box is None else found.box.centre
        start = Stand(camera.position / scale, camera.look_at / scale, camera.fov)
        for stand in flight(start, stand_of(viewpoint.camera, camera.aspect, target), _FLIGHT_STEPS):
            if mine != self._flights:
                return  # another flight has begun
            with client.atomic():
                camera.position, camera.look_at = stand.position * scale, stand.look_at * scale
                camera.fov = stand.fov
            client.flush()
            time.sleep(_FLIGHT_SECONDS / _FLIGHT_STEPS)


def _scale() -> float:
    """The viewer's units per unit of the model."""
    from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO  # which needs the models

    return VISER_NERFSTUDIO_SCALE_RATIO
