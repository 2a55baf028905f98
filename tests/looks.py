"""Renderings of a model in a look of choice, where the model itself follows its rule."""

from __future__ import annotations

from nerfstudio.cameras.cameras import Cameras

from lang3dxl_ns.components.appearance import Look, render_in_look
from lang3dxl_ns.plugin.cameras import photo_camera
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering import Rendering


def in_look(model: Lang3DXLModel, camera: Cameras, look: Look | None) -> Rendering:
    """Render the present Gaussians from a camera in a look (None: by the model's rule)."""
    if look is None:
        return model.seen(camera)
    background = model._get_background_color()
    view = photo_camera(camera).camera()
    return render_in_look(model.run.splats(), view, look, background=background)
