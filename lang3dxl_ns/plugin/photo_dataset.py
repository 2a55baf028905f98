"""Dataset of photos: read, undistorted and resized on demand."""

from __future__ import annotations

from jaxtyping import Float
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.scene.photo import Photo


class PhotoDataset(InputDataset):
    """nerfstudio's dataset over `Photo`s: read, undistorted and resized on demand, pinhole cameras."""

    def __init__(self, outputs: DataparserOutputs, scale: float):
        super().__init__(outputs)
        self.scale = scale
        self.photos: list[Photo] = outputs.metadata["photos"]
        lenses = [photo.lens.scaled(scale) for photo in self.photos]
        self.cameras = to_nerfstudio(lenses, outputs.cameras.camera_to_worlds)

    def read(self, index: int) -> dict[str, Tensor]:
        """`image` [h, w, 3] uint8 and, if the photo has one, `mask` [h, w, 1] bool."""
        photo = self.photos[index]
        data = {"image": photo.read_uint8(self.scale)}
        mask = photo.read_mask(self.scale)
        if mask is not None:
            data["mask"] = mask[..., None]
        return data

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict:
        data = self.read(image_idx)
        if image_type == "float32":
            data["image"] = data["image"].float() / 255
        return {"image_idx": image_idx, **data}

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w 3"]:
        return self.photos[image_idx].read(self.scale)
