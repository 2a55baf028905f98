"""`RenderedScene`: a scene that can be rendered from any place."""

from __future__ import annotations

import time
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import TypeAlias

import torch
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.appearance import AppearanceField, Look, render_in_look
from lang3dxl_ns.query.match import View
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.rendering import Rendering, Splats
from lang3dxl_ns.scene.camera import Camera, posed, resized, with_field_of_view, with_longer_side
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord, overview

Place: TypeAlias = Camera | str | Float[Tensor, "rows 4"] | Float[Array, "rows 4"]
"""A camera, a photo's name, or a pose (camera → world in the model's frame, nerfstudio's axes)."""
LARGEST = 1920
"""Longer side of pictures in pixels if no size is requested."""


@dataclass(eq=False, repr=False)
class RenderedScene:
    """Gaussians, the photos they were made from, and those photos' lighting."""

    splats: Splats
    """The Gaussians, in the model's frame."""
    file: SceneRecord
    """Photos, cameras, and the CLIP that the features come from."""
    _: KW_ONLY
    looks: AppearanceField | None = None
    """Lighting of the photos; None if all share one."""
    background: Float[Tensor, "3"] | None = None
    """Color behind the scene, 0…1; None for black."""
    config: QueryConfig = field(default_factory=QueryConfig)
    """Defaults of queries, sizes of pictures, and of the views that `visible` measures."""

    @property
    def device(self) -> torch.device:
        """Device that holds the Gaussians."""
        return self.splats.means.device

    @property
    def photos(self) -> list[ScenePhoto]:
        """Training photos, then held-out ones, each with its name, camera and pose."""
        return self.file.photos

    @cached_property
    def overview(self) -> ScenePhoto:
        """The photo that shows the scene as a whole."""
        return overview(self.photos, tuple(self.splats.means.median(0).values.tolist()))

    def camera(self, place: Place, size: int | None = None, fov: float | None = None) -> Camera:
        """Build a camera of the scene.

        Args:
            place: a camera; a photo by name; or a pose, which gets the first photo's lens.
            size: longer side in pixels; by default a camera keeps its size, and a photo has its file's, at
                most 1920.
            fov: vertical field of view in degrees; by default the lens's.

        Raises:
            UserError: no photo has this name, or the size or field of view is impossible.
        """
        size = self.config.size if size is None else size
        if isinstance(place, Camera):
            camera = place if size is None else with_longer_side(place, size)
        else:
            photo = self.file.photo(place) if isinstance(place, str) else self.photos[0]
            camera = photo.full_camera
            if not isinstance(place, str):
                camera = posed(_pose(place), camera)
            camera = resized(camera, LARGEST) if size is None else with_longer_side(camera, size)
        return camera if fov is None else with_field_of_view(camera, fov)

    def render(
        self, place: Place, size: int | None = None, fov: float | None = None, look: str | None = None
    ) -> View:
        """Render the scene from a photo's viewpoint, a camera or a pose; see `camera`. look: training photo
        whose lighting is used; by default the scene's rule chooses for this view. Raises UserError as
        `camera` does, and if there is no look of this photo."""
        return self.view(place, self.camera(place, size, fov), look)

    def draw(
        self, camera: Camera, channels: Float[Tensor, "n d"] | None = None, look: Look | None = None
    ) -> Rendering:
        """Render a camera, and further values of the Gaussians, as tensors on the scene's device. Without a
        look, the scene's rule chooses the lighting for this view."""
        if look is None and self.looks is not None:
            look = self.looks.of_view(camera)
        return render_in_look(self.splats, camera, look, channels, background=self.background)

    def view(
        self,
        place: Place,
        camera: Camera,
        look: str | None = None,
        channels: Float[Tensor, "n d"] | None = None,
    ) -> View:
        """Render the camera of a place, with a training photo's look and further values of the Gaussians."""
        start = time.perf_counter()
        rendering = self.draw(camera, channels, self._look(look))
        name = self.file.photo(place).name if isinstance(place, str) else None
        return View(rendering, name, time.perf_counter() - start)

    def _look(self, photo: str | None) -> Look | None:
        if photo is None:
            return None
        if self.looks is None:
            raise UserError("all photos of this scene share one lighting: there is no look to choose")
        return self.looks.of_photo(self.file.photo(photo).name)

    def baked(self, look: str | None = None) -> Splats:
        """Return the Gaussians with the look of a training photo (default: the overview photo) in their
        colors, for viewers that know no looks. Raises UserError if there is no look of this photo."""
        chosen = self._look(look)
        if self.looks is None:
            return self.splats
        camera = self.overview.camera
        return (chosen or self.looks.of_view(camera)).apply(self.splats, camera)


def _pose(place: Place) -> Float[Tensor, "rows 4"]:
    try:
        return torch.as_tensor(place, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"a place is a photo's name, a camera or a pose, not {place!r:.40}") from error
