"""Viewer of `lang3dxl view`: the browser draws a finished run's Gaussians, so moving needs no server.

The page gets the Gaussians once; a new prompt, threshold or look sends them again with other colors. The
server renders only stills in full quality, in the same way as for scores.
"""

from __future__ import annotations

import contextlib
import io
import math
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch
import viser
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from PIL import Image

from lang3dxl_ns.plugin.cameras import view_of
from lang3dxl_ns.plugin.light import in_light
from lang3dxl_ns.plugin.viewer.splats import sent, splats, with_heat, withdrawn
from lang3dxl_ns.plugin.viewer.worker import Worker
from lang3dxl_ns.query.overview import overview
from lang3dxl_ns.scene.camera import Camera

if TYPE_CHECKING:
    from pathlib import Path

    from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline

NODE = "/gaussians"
STILL_HEIGHT = 1080


class BrowserViewer:
    """The interface of nerfstudio's viewer that the panel needs, for a page that draws the Gaussians itself.

    Args:
        pipeline: of a finished run.
        config: address to serve at.
        folder: of the run.
    """

    train_lock = None
    trainer = None

    def __init__(self, pipeline: Lang3DXLPipeline, config: ViewerConfig, folder: Path) -> None:
        self.config, self.log_filename = config, folder / "viewer.log"
        self._pipeline, self._panel, self._model = pipeline, pipeline.panel, pipeline.model
        self._scale: float = VISER_NERFSTUDIO_SCALE_RATIO
        self._light: tuple[str | None, Any] | None = None
        self._node: viser.GaussianSplatHandle | None = None
        self._turn = 0
        self._drawer, self._stills = Worker("draw"), Worker("still")
        port = config.websocket_port or config.websocket_port_default
        self.viser_server = viser.ViserServer(host=config.websocket_host, port=port)
        gui = self.viser_server.gui
        # nerfstudio's viewer chooses among outputs; here there is only one.
        self.control_panel = SimpleNamespace(
            output_render="overlay", split=False, _output_render=SimpleNamespace(value="overlay")
        )
        self.pause_train = SimpleNamespace(visible=False)
        self._panel._setup(self)  # type: ignore[arg-type]
        still = gui.add_button("Still in full quality", hint="Rendered by the server, and downloaded")
        still.on_click(lambda event: self._stills.submit(self._panel._guarded(lambda: self._still(event))))
        self._trigger_rerender()

    def serve(self) -> None:
        """Serve until Ctrl-C."""
        if self.config.make_share_url:
            self.viser_server.request_share_url()
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600)
        self.viser_server.stop()

    # ── interface of nerfstudio's viewer ────────────────────────────────────────────────────────────────

    @property
    def hide_images(self) -> Any:
        """Button that hides the photos' cameras; made when the panel first asks for it."""
        return self._buttons[0]

    @property
    def show_images(self) -> Any:
        """Button that shows them."""
        return self._buttons[1]

    @property
    def _buttons(self) -> tuple[Any, Any]:
        if not hasattr(self, "_made_buttons"):
            gui = self.viser_server.gui
            hide = gui.add_button("Hide the photos' cameras")
            show = gui.add_button("Show the photos' cameras", visible=False)
            for button in (hide, show):
                button.on_click(lambda _: self.toggle_cameravis_button())
            self._made_buttons = hide, show
        return self._made_buttons

    def toggle_cameravis_button(self) -> None:
        """Make one of the two visible."""
        for button in self._buttons:
            button.visible = not button.visible

    def _trigger_rerender(self) -> None:
        """Called when something displayed has changed."""
        self._drawer.submit(self._panel._guarded(self._draw))

    # ── drawing ─────────────────────────────────────────────────────────────────────────────────────────

    def _draw(self) -> None:
        """Send the Gaussians with their present colors."""
        start = time.perf_counter()
        gaussians, colors = self._in_light(self._model.look)
        if self._model.semantic_field is not None:
            conversation = self._panel.conversation
            found = conversation.of_gaussians()
            if found is not None:
                colors = with_heat(colors, found[0], found[1], conversation.display, conversation.highest())
        what = splats(gaussians, colors, self._scale)
        # A new name each time: a page ignores what comes for one that it shows, or still showed a moment ago.
        self._turn += 1
        before, self._node = self._node, sent(self.viser_server.scene, f"{NODE}_{self._turn}", what)
        if before is not None:
            withdrawn(self.viser_server, before)
        seconds = time.perf_counter() - start
        if self._model.semantic_field is not None:
            self._panel._status.content = (
                f"{len(what.centers):,} Gaussians ({what.megabytes:.1f} MB), drawn by this browser · "
                f"{seconds * 1e3:.0f} ms to color them"
            )

    def _in_light(self, look: str | None) -> Any:
        if self._light is None or self._light[0] != look:
            middle = tuple(self._model.means.detach().median(0).values.tolist())
            camera = overview(self._panel._photos, middle).camera
            self._light = look, in_light(self._model, camera, look)
        return self._light[1]

    # ── stills ──────────────────────────────────────────────────────────────────────────────────────────

    def _still(self, event: Any) -> None:
        client: viser.ClientHandle | None = event.client
        if client is None:
            return
        self._panel._say("Rendering a still…")
        client.send_file_download("still.png", self.still(camera_of(client.camera, self._scale)))
        self._panel._say("The still is in your downloads.")

    @torch.no_grad()
    def still(self, camera: Camera) -> bytes:
        """PNG of a view with per-pixel relevancy, as in `ns-render`."""
        outputs = self._model.get_outputs_for_camera(view_of(camera).to(self._model.device))
        picture = outputs["overlay"] if "overlay" in outputs else outputs["rgb"]
        file = io.BytesIO()
        Image.fromarray((picture.clamp(0, 1) * 255).round().byte().cpu().numpy()).save(file, "png")
        return file.getvalue()


def camera_of(camera: viser.CameraHandle, scale: float, height: int = STILL_HEIGHT) -> Camera:
    """A page's camera with this height in pixels. scale: the viewer's units per unit of the model."""
    rotation = viser.transforms.SO3(camera.wxyz).as_matrix()  # camera → world; x right, y down, z ahead
    view = torch.eye(4)
    view[:3, :3] = torch.tensor(rotation.T)
    view[:3, 3] = torch.tensor(-rotation.T @ (camera.position / scale))
    width, focal = round(height * camera.aspect), height / 2 / math.tan(camera.fov / 2)
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(view, intrinsics, width, height)
