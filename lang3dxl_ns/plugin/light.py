"""Colors of all Gaussians as seen from one camera, under a photo's look."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.rendering.gaussians import Gaussians
from lang3dxl_ns.scene.camera import Camera


@torch.no_grad()
def in_light(
    model: Lang3DXLModel, camera: Camera, look: str | None
) -> tuple[Gaussians, Float[Tensor, "n 3"]]:
    """All Gaussians and their colors as seen from a camera, under the look of a photo by name (None: the
    model's look for this view). A browser keeps them for other views: view-dependent colors are those
    towards this camera."""
    g = model.gauss_params
    gaussians = model.activated(g).detach()
    pose = camera.view_matrix.to(model.device)
    position, forward = -pose[:3, :3].T @ pose[:3, 3], pose[2, :3]
    colors = model.colors_from(g, position)
    if model.appearance is None:
        return gaussians, colors
    field = model.appearance
    vector = field.vector(look) if look is not None else field.vector_of_view(position, forward)
    everything = torch.arange(len(colors), device=colors.device)
    colors, lit = field(gaussians, colors, vector, everything, None)
    return lit, colors


def harmonics(model: Lang3DXLModel) -> Float[Tensor, "n k 3"] | None:
    """Spherical harmonics of the Gaussians' colors, if these are exact from every side: not where photos have
    looks, which change a color by more than its direction."""
    g = model.gauss_params
    if model.appearance is not None or model.config.sh_degree == 0:
        return None
    return torch.cat((g["features_dc"][:, None], g["features_rest"]), dim=1).detach()
