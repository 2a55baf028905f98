"""Gives a trained model of colours the features of its photos, without optimising."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import Parameter

from lang3dxl_ns.baselines.lifting import lift, pixel_features
from lang3dxl_ns.model import Lang3DXLModel


def lift_features(model: Lang3DXLModel, photos: Iterable[tuple[Cameras, dict]]) -> None:
    """Every Gaussian's code becomes the mean of the target features of the pixels that it contributes to.

    model: in training mode, so that it sees its photos as in training. photos: cameras and batches, with
    targets.
    """

    def composite(camera: Cameras, carried: Parameter) -> Float[Tensor, "h w d"]:
        model.gauss_params["codes"] = carried
        return model.get_outputs(camera)["codes"]

    def views():
        for camera, batch in photos:
            height, width = batch["image"].shape[:2]
            mask = batch["mask"][..., 0] if "mask" in batch else None
            pixels = pixel_features(batch["clip_target"], batch.get("dense_target"), mask, (height, width))
            yield partial(composite, camera), pixels

    channels = len(model.clip_mean) + len(model.dense_mean) + 1
    codes = lift(model.num_points, views(), channels, model.means.detach())
    model.gauss_params["codes"] = Parameter(codes, requires_grad=False)
