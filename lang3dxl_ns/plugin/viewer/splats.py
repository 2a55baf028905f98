"""Gaussians for the browser's splat renderer: shapes, colors under a photo's look, a prompt's heat map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import viser
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.query.answer import Display
from lang3dxl_ns.query.heat_maps import overlay
from lang3dxl_ns.rendering.gaussians import Gaussians

FAINTEST = 1 / 255
"""Gaussians with less opacity than 8 bits can show are not sent."""
WIDEST = 60_000.0
"""Largest standard deviation, the viewer's units: shapes travel as 16-bit floats."""


@dataclass(frozen=True)
class Splats:
    """Gaussians as viser sends them to a page, in the viewer's units."""

    centers: Float[Array, "m 3"]
    covariances: Float[Array, "m 3 3"]
    colors: Float[Array, "m 3"]
    """0…1."""
    opacities: Float[Array, "m 1"]

    @property
    def megabytes(self) -> float:
        """Download size of a page: 32 bytes per Gaussian."""
        return 32 * len(self.centers) / 1e6


def splats(gaussians: Gaussians, colors: Float[Tensor, "n 3"], scale: float) -> Splats:
    """Gaussians with these colors for the page. Broken and invisible ones are left out.

    scale: the viewer's units per unit of the model.
    """
    g = gaussians
    values = torch.cat([g.means, g.quats, g.scales, colors], dim=1)
    seen = (g.opacities >= FAINTEST) & values.isfinite().all(1)
    axes = rotations(g.quats[seen].double()) * (g.scales[seen] * scale).clamp_max(WIDEST).double()[:, None]
    return Splats(
        (g.means[seen] * scale).cpu().numpy(),
        (axes @ axes.mT).cpu().numpy(),
        colors[seen].clamp(0, 1).cpu().numpy(),
        g.opacities[seen, None].cpu().numpy(),
    )


def rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length; zero length means no rotation."""
    identity = quats.new_tensor([1.0, 0, 0, 0])
    quats = torch.where(quats.norm(dim=1, keepdim=True) > 0, quats, identity)
    w, x, y, z = torch.nn.functional.normalize(quats).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def with_heat(
    colors: Float[Tensor, "n 3"],
    relevancy: Float[Tensor, " n"],
    threshold: float,
    display: Display,
    highest: float | None = None,
) -> Float[Tensor, "n 3"]:
    """Colors with the heat map mixed into matching Gaussians, as `overlay` does for pixels."""
    picture = colors.clamp(0, 1)[None], relevancy[None]
    return overlay(*picture, threshold, display.opacity, display.color_map, highest)[0]


def sent(scene: viser.SceneApi, name: str, what: Splats) -> viser.GaussianSplatHandle:
    """Draw Gaussians in a viser scene. Pages ignore them where they show others of this name."""
    return scene._add_gaussian_splats(  # viser 0.2.7's only way to
        name,
        centers=np.ascontiguousarray(what.centers, np.float32),
        covariances=what.covariances,
        rgbs=what.colors,
        opacities=what.opacities,
    )


def withdrawn(server: viser.ViserServer, node: viser.GaussianSplatHandle) -> None:
    """Remove drawn Gaussians from all pages, and from what the server keeps for new ones.

    viser 0.2.7 alone keeps every removed node's message in memory.
    """
    name, buffer = node._impl.name, server._websock_server._broadcast_buffer
    with buffer.buffer_lock:
        for number, message in list(buffer.message_from_id.items()):
            if getattr(message, "name", None) == name:
                del buffer.message_from_id[number], buffer.id_from_redundancy_key[message.redundancy_key()]
    node.remove()  # pages that show it are told
    server.scene._handle_from_node_name.pop(name, None)
