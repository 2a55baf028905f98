"""Looks: what the photos' lighting makes of a scene's colors. Absent where photos share one lighting."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.rendering.render import Rendering, render
from lang3dxl_ns.rendering.splats import Splats, harmonics_of
from lang3dxl_ns.scene.camera import Camera, in_view


@dataclass(frozen=True, eq=False)
class Look:
    """The lighting of one photo."""

    field: AppearanceField
    """A trained field, whose weights no longer change."""
    vector: Float[Tensor, " v"]
    """The photo's appearance code."""

    @torch.no_grad()
    def apply(self, splats: Splats, camera: Camera, everywhere: bool = True) -> Splats:
        """The Gaussians under this lighting, in colors as one camera sees them.

        Args:
            splats: the Gaussians in the field's world frame.
            camera: the view. Its position matters only where colors depend on it: the change of lighting
                depends on the color that is seen.
            everywhere: relight all Gaussians; False: only those that the camera may see.
        """
        camera = camera.to(splats.means.device)
        rows = torch.ones(len(splats), dtype=torch.bool, device=splats.means.device)
        if not everywhere:
            rows = in_view(camera, splats.means, splats.scales)
        seen = rows.nonzero().squeeze(1)
        colors, lit = self.field(splats.gaussians, splats.colors(camera.position), self.vector, seen)
        return replace(splats, opacities=lit.opacities, harmonics=harmonics_of(colors))


@dataclass(frozen=True, eq=False)
class Looks:
    """The looks of a scene's training photos."""

    field: AppearanceField
    """A trained field, whose weights no longer change."""

    @property
    def names(self) -> list[str]:
        """Photos that have a look."""
        return self.field.names

    def of_photo(self, name: str) -> Look:
        """The look of a training photo. Raises UserError if there is none of this name."""
        return Look(self.field, self.field.vector(name).detach())

    def of_view(self, camera: Camera) -> Look:
        """The look of a view that is no training photo, by the field's rule (`AppearanceConfig.unseen`)."""
        there = camera.to(self.field.vectors.device)
        return Look(self.field, self.field.vector_of_view(there.position, there.view_matrix[2, :3]).detach())


def render_in_look(
    splats: Splats,
    camera: Camera,
    look: Look | None,
    channels: Float[Tensor, "n d"] | None = None,
    *,
    background: Float[Tensor, "3"] | None = None,
    backend: Backend = "auto",
) -> Rendering:
    """`render` under a photo's lighting.

    Coverage, depth and further channels belong to the scene, not to a photo: where a look changes opacities,
    they are rendered separately, with the opacities of the scene.

    Args:
        splats: the Gaussians, world frame.
        camera: where to render them from.
        look: the lighting; None for the Gaussians' own colors.
        channels, background, backend: see `render`.
    """
    settings = {"background": background, "backend": backend}
    if look is None:
        return render(splats, camera, channels, **settings)  # type: ignore[arg-type]
    lit = look.apply(splats, camera, everywhere=False)
    if lit.opacities is splats.opacities:
        return render(lit, camera, channels, **settings)  # type: ignore[arg-type]
    photo = render(lit, camera, **settings)  # type: ignore[arg-type]
    return replace(render(splats, camera, channels, backend=backend), rgb=photo.rgb)
