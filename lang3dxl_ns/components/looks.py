"""Looks: a scene's colors under the lighting of its photos. A scene with one lighting has none."""

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
    """Lighting of one photo."""

    field: AppearanceField
    """Trained field, whose weights no longer change."""
    vector: Float[Tensor, " v"]
    """Appearance code of the photo."""

    @torch.no_grad()
    def apply(self, splats: Splats, camera: Camera, everywhere: bool = True) -> Splats:
        """Return the Gaussians under this lighting, in the colors that one camera sees.

        Args:
            splats: the Gaussians in the field's world frame.
            camera: the view. Its position matters only if colors depend on it, because the change of lighting
                depends on the visible color.
            everywhere: whether to relight all Gaussians, or only those that the camera may see.
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
    """Looks of a scene's training photos."""

    field: AppearanceField
    """Trained field, whose weights no longer change."""

    @property
    def names(self) -> list[str]:
        """Names of the photos that have a look."""
        return self.field.names

    def of_photo(self, name: str) -> Look:
        """Return the look of a training photo. Raises UserError if none has this name."""
        return Look(self.field, self.field.vector(name).detach())

    def of_view(self, camera: Camera) -> Look:
        """Choose a look for a view that is not a training photo, by the rule `AppearanceConfig.unseen`."""
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
    """Render Gaussians under a photo's lighting.

    Coverage, depth and further channels belong to the scene, not to a photo. If a look changes opacities,
    they are rendered separately, with the opacities of the scene.

    Args:
        splats: the Gaussians, world frame.
        camera: the view.
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
