"""Test views of a scene as nerfstudio data, in the frame of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from torch import Tensor

from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.preparation.foreground import find_mask
from lang3dxl_ns.preparation.physical_scale import pixel_size
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.camera import camera_to_world
from lang3dxl_ns.scene.novel_views import NovelViews
from lang3dxl_ns.scene.photo import Photo


def novel_outputs(views: NovelViews, trained: DataparserOutputs, masked: bool) -> DataparserOutputs:
    """Build dataparser outputs of the test views. trained: outputs of the photos, whose transform and scale
    also apply to the views' cameras. masked: whether to include the views' foreground masks, if any."""
    photos = [
        Photo.from_model(
            view,
            views.image(view),
            find_mask(views.folder / "masks", views.image(view).name) if masked else None,
        )
        for view in views.cameras
    ]
    transform, scale = trained.dataparser_transform.double(), trained.dataparser_scale
    poses = [_pose(torch.from_numpy(g.camera_from_world), transform, scale) for g in views.cameras]
    cameras = to_nerfstudio([photo.lens for photo in photos], torch.stack(poses).float())
    files = [photo.path for photo in photos]
    metadata = {"photos": photos}
    return replace(trained, image_filenames=files, mask_filenames=None, cameras=cameras, metadata=metadata)


def novel_pixel_sizes(views: NovelViews, config: PreparationConfig) -> dict[str, float]:
    """Compute the world units per pixel of every test view, by the same rules as for photos."""
    sizes = {g.name: pixel_size(g, config.pixel_distance, config.pixel_angle) for g in views.cameras}
    median = float(np.median([size for size in sizes.values() if size is not None]))
    return {name: median if size is None else size for name, size in sizes.items()}


def _pose(
    camera_from_world: Float[Tensor, "3 4"], transform: Float[Tensor, "3 4"], scale: float
) -> Float[Tensor, "3 4"]:
    """Convert to camera → world in the run's frame, x ↦ scale · transform(x), with nerfstudio's axes."""
    bottom = camera_from_world.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    pose = camera_to_world(torch.cat([camera_from_world, bottom]))
    position = transform[:, :3] @ pose[:, 3:] + transform[:, 3:]
    return torch.cat([transform[:, :3] @ pose[:, :3], scale * position], dim=1)
