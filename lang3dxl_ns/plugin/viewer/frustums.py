"""Camera frustums in the viewer, drawn without the photos; a click flies to the camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import viser
import viser.transforms as tf

from lang3dxl_ns.query.run_file import ScenePhoto

MOST = 200
"""Most cameras drawn, evenly chosen: more would hide the scene."""


def draw_frustums(
    scene: viser.SceneApi,
    photos: Sequence[ScenePhoto],
    scale: float,
    size: float,
    pressed: Callable[[ScenePhoto, viser.ClientHandle], None],
) -> list[viser.CameraFrustumHandle]:
    """Draw the cameras of photos.

    scale: the viewer's units per unit of the model. size: of a frustum, in the viewer's units.
    """
    chosen = [photos[i * len(photos) // min(MOST, len(photos))] for i in range(min(MOST, len(photos)))]
    handles = []
    for photo in chosen:
        view = photo.camera.view_matrix.double().numpy()
        handle = scene.add_camera_frustum(
            f"/cameras/{photo.name}",
            fov=2 * math.atan(photo.lens.height / 2 / photo.lens.fy),
            aspect=photo.lens.width / photo.lens.height,
            scale=size,
            color=(150, 150, 150),
            wxyz=tf.SO3.from_matrix(view[:3, :3].T).wxyz,
            position=-view[:3, :3].T @ view[:3, 3] * scale,
        )
        handle.on_click(partial(_pass_on, photo, pressed))
        handles.append(handle)
    return handles


def _pass_on(photo: ScenePhoto, pressed: Callable[[ScenePhoto, viser.ClientHandle], None], event) -> None:
    pressed(photo, event.client)
