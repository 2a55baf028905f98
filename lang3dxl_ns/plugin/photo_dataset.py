"""Datasets of photos, read upright, undistorted and resized on demand."""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.training.batches import read_data


class PhotoDataset(InputDataset):
    """nerfstudio's dataset over `Photo`s: upright, undistorted and resized on demand, with pinhole cameras.
    `scale` is that of the pictures relative to the photos, which `working` reads at their size."""

    def __init__(self, outputs: DataparserOutputs, scale: float, working: WorkingPhotos):
        super().__init__(outputs)
        self.scale, self.working = scale, working
        self.photos: list[Photo] = outputs.metadata["photos"]
        lenses = [photo.lens.scaled(scale) for photo in self.photos]
        self.cameras = to_nerfstudio(lenses, outputs.cameras.camera_to_worlds)

    def read(self, index: int) -> dict[str, Tensor]:
        """Read a photo: `image` [h, w, 3] uint8 and, if the photo has one, `mask` [h, w, 1] bool."""
        return read_data(self.photos[index], self.working, self.scale, None)

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict:
        try:
            data = self.read(image_idx)
        except UserError as reason:  # ns-render draws what the camera sees, with or without its photo
            CONSOLE.log(escape(f"{self.photos[image_idx].name} is shown black: {reason}"))
            lens = self.photos[image_idx].lens.scaled(self.scale)
            data = {"image": torch.zeros(lens.height, lens.width, 3, dtype=torch.uint8)}
        if image_type == "float32":
            data["image"] = data["image"].float() / 255
        return {"image_idx": image_idx, **data}

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w 3"]:
        return self.read(image_idx)["image"].float() / 255
