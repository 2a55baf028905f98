"""Camera paths that nerfstudio's viewer saves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from lang3dxl_ns.common.checks import expect
from lang3dxl_ns.common.errors import readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.scene.camera import Camera, Lens, check_pose, view_matrix


def read_camera_path(path: Path) -> Sequence[Camera]:
    """Read the cameras of a camera path saved by nerfstudio's viewer. Raises UserError for other files."""
    with readable(f"{path} is not a camera path", "save one in the viewer (Render tab, Save Path)"):
        content = read_json(path)
        width, height = int(content["render_width"]), int(content["render_height"])
        expect(content["camera_path"] != [], "it has no camera")
        return [path_camera(frame, width, height) for frame in content["camera_path"]]


def path_camera(frame: dict[str, Any], width: int, height: int) -> Camera:
    """Return the camera of a path's frame: `camera_to_world` [4, 4], and `fov`, upright and in degrees."""
    pose = torch.tensor(frame["camera_to_world"], dtype=torch.float32).reshape(4, 4)
    check_pose(pose.tolist())
    expect(0 < frame["fov"] < 180, f"a camera has a field of view of {frame['fov']} degrees")
    focal = height / 2 / math.tan(math.radians(frame["fov"]) / 2)
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    lens.check()
    return lens.camera(view_matrix(pose[:3]))
