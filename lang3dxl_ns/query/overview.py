"""Choice of the photo that shows a scene as a whole."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lang3dxl_ns.query.run_file import ScenePhoto


def overview(photos: Sequence[ScenePhoto], middle: tuple[float, ...]) -> ScenePhoto:
    """Choose the farthest photo that sees the scene's center near its own, or else the first photo."""
    best, farthest = photos[0], 0.0
    for photo in photos:
        camera, lens = photo.camera, photo.lens
        x, y, z = camera.view_matrix[:3, :3] @ torch.tensor(middle) + camera.view_matrix[:3, 3]
        wide, high = abs(x) * lens.fx / lens.width, abs(y) * lens.fy / lens.height
        if z > farthest and max(wide, high) < z / 4:
            best, farthest = photo, float(z)
    return best
