"""Conversion of lenses and poses between nerfstudio's cameras and this package's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.training.state import PhotoCamera


def to_nerfstudio(lenses: Sequence[Lens], camera_to_worlds: Float[Tensor, "n 3 4"]) -> Cameras:
    """Build pinhole cameras (photos are undistorted on reading) at nerfstudio's poses."""

    def column(name: str, kind: torch.dtype) -> Tensor:
        return torch.tensor([getattr(lens, name) for lens in lenses], dtype=kind)

    fx, fy, cx, cy = (column(name, torch.float32) for name in ("fx", "fy", "cx", "cy"))
    width, height = column("width", torch.int64), column("height", torch.int64)
    # `ns-export cameras` expects metadata.
    return Cameras(camera_to_worlds, fx, fy, cx, cy, width, height, metadata={})


def photo_camera(camera: Cameras) -> PhotoCamera:
    """Convert a nerfstudio camera for a training step, and for the rasterizer (`PhotoCamera.camera`)."""
    return PhotoCamera(
        camera.camera_to_worlds[0],
        camera.get_intrinsics_matrices()[0],
        int(camera.width.item()),
        int(camera.height.item()),
        (camera.metadata or {}).get("cam_idx"),
    )


def to_cameras(view: PhotoCamera) -> Cameras:
    """Convert a photo's camera to nerfstudio's, which a training step converts back (`photo_camera`). It
    stays on the CPU, since the host reads its size and would wait for a GPU."""
    k = view.intrinsics[None]
    lens = k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]
    camera = Cameras(view.pose[None], *lens, torch.tensor([view.width]), torch.tensor([view.height]))
    camera.metadata = {} if view.photo is None else {"cam_idx": view.photo}
    return camera
