"""`ViewedScene`: what can be rendered of a scene without any words: Gaussians, photos and lighting."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import watched
from lang3dxl_ns.components.appearance import AppearanceField, Look, render_in_look
from lang3dxl_ns.query.match import View
from lang3dxl_ns.query.query_config import QueryConfig
from lang3dxl_ns.query.run_file import SceneFile, ScenePhoto, overview
from lang3dxl_ns.query.visibility import (
    VisibleGaussians,
    fingerprint,
    load_visible,
    save_visible,
    spread,
)
from lang3dxl_ns.rendering.gathering import filled_pixels
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.rendering.render import Rendering, composite
from lang3dxl_ns.rendering.splats import Splats
from lang3dxl_ns.scene.camera import Camera, posed, resized, with_field_of_view, with_longer_side

LARGEST = 1920
"""Longer side of pictures in pixels if no size is requested."""
Place: TypeAlias = Camera | str | Float[Tensor, "rows 4"] | Float[Array, "rows 4"]
"""A camera, a photo's name, or a pose (camera → world in the model's frame, nerfstudio's axes)."""


@dataclass(eq=False, repr=False)
class ViewedScene:
    """Gaussians and the photos they were made from.

    The scene never changes. What each photo shows is computed once. Any number of threads may use it.
    """

    splats: Splats
    """The Gaussians, in the model's frame."""
    file: SceneFile
    """Photos, cameras, and the CLIP that the features come from."""
    _: KW_ONLY
    looks: AppearanceField | None = None
    """Lighting of the photos; None if all share one."""
    background: Float[Tensor, "3"] | None = None
    """Color behind the scene, 0…1; None for black."""
    config: QueryConfig = field(default_factory=QueryConfig)
    """Defaults of queries, sizes of pictures, and of the views that `visible` measures."""
    cache: Path | None = None
    """File that keeps which Gaussians the photos show; if None, every process measures them."""
    backend: Backend = "auto"
    """The rasterizer, see `rasterize`."""
    watch: Callable[[str], None] | None = None
    """Called with a short description of slow work; if None, a progress bar is shown."""

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
        """Render the scene from a photo's viewpoint, a camera or a pose.

        Args:
            place, size, fov: see `camera`.
            look: training photo whose lighting is used; by default the scene's rule chooses for this view.

        Raises:
            UserError: see `camera`; or there is no look of this photo.
        """
        return self._view(self.camera(place, size, fov), self._name(place), look)

    def draw(
        self, camera: Camera, channels: Float[Tensor, "n d"] | None = None, look: Look | None = None
    ) -> Rendering:
        """Render a camera, and further values of the Gaussians, as tensors on the scene's device. Without a
        look, the scene's rule chooses the lighting for this view."""
        if look is None and self.looks is not None:
            look = self.looks.of_view(camera)
        return render_in_look(
            self.splats, camera, look, channels, background=self.background, backend=self.backend
        )

    def _view(
        self,
        camera: Camera,
        name: str | None,
        look: str | None = None,
        channels: Float[Tensor, "n d"] | None = None,
    ) -> View:
        start = time.perf_counter()
        rendering = self.draw(camera, channels, self._look(look))
        return View(rendering, name, time.perf_counter() - start)

    def _look(self, photo: str | None) -> Look | None:
        if photo is None:
            return None
        if self.looks is None:
            raise UserError("all photos of this scene share one lighting: there is no look to choose")
        return self.looks.of_photo(photo)

    def _name(self, place: Place) -> str | None:
        return self.file.photo(place).name if isinstance(place, str) else None

    def baked(self, look: str | None = None) -> Splats:
        """Return the Gaussians with a training photo's look in their colors, for viewers that know no looks.

        look: the photo; by default the overview photo. Raises UserError if there is no look of this photo.
        """
        chosen = self._look(look)
        if self.looks is None:
            return self.splats
        camera = self.overview.camera
        return (chosen or self.looks.of_view(camera)).apply(self.splats, camera)

    # ── what the photos show ────────────────────────────────────────────────────────────────────────

    @cached_property
    def visible(self) -> Mapping[str, VisibleGaussians]:
        """The Gaussians visible in each training view. They are measured once, with a progress bar."""
        count, side = self.config.views, self.config.view_side
        chosen = spread([photo for photo in self.photos if photo.split == "train"], count)
        cameras = {photo.name: resized(photo.camera, side) for photo in chosen}
        key = ""
        if self.cache is not None:
            key = fingerprint(vars(self.splats.gaussians), [asdict(self.file), count, side])
            if (kept := load_visible(self.cache, key, cameras, self.device)) is not None:
                return kept
        shown = watched(cameras.items(), "measuring which Gaussians the photos show, once", self.watch)
        views = {name: self._visible(name, camera) for name, camera in shown}
        if self.cache is not None:
            save_visible(self.cache, views, key)
        return views

    def _visible(self, name: str, camera: Camera) -> VisibleGaussians:
        mask = self.file.photo(name).foreground((camera.height, camera.width))
        weight = torch.ones(camera.height, camera.width) if mask is None else mask.float()
        return VisibleGaussians.of(camera, self._fill(camera, weight.to(self.device)))

    def _fill(self, camera: Camera, weight: Float[Tensor, "h w"]) -> Float[Tensor, " n"]:
        drawn = partial(composite, self.splats, camera, backend=self.backend)
        return filled_pixels(drawn, weight, len(self.splats))

    @cached_property
    def mass(self) -> Float[Tensor, " n"]:
        """Pixels that every Gaussian fills, summed over all views."""
        mass = self.splats.means.new_zeros(len(self.splats))
        for view in self.visible.values():
            mass[view.rows.long()] += view.pixels.float()
        return mass

    @cached_property
    def trained_side(self) -> int:
        """Median of the training photos' longer sides in pixels."""
        sides = sorted(max(p.camera.width, p.camera.height) for p in self.photos if p.split == "train")
        return sides[len(sides) // 2] if sides else LARGEST

    @cached_property
    def gap(self) -> float:
        """Distance in world units below which matches are connected: 3 % of the median distance at which the
        scene is seen, about eight pixels of a small view; 0 if no training photo shows anything."""
        distances = []
        for view in self.visible.values():
            pose, means = view.camera.view_matrix.to(self.splats.means), self.splats.means[view.rows]
            if len(means):
                distances.append(float((means @ pose[2, :3] + pose[2, 3]).median()))
        return 0.03 * float(torch.tensor(distances).nanmedian()) if distances else 0.0


def _pose(place: Any) -> Float[Tensor, "rows 4"]:
    try:
        return torch.as_tensor(place, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"a place is a photo's name, a camera or a pose, not {place!r:.40}") from error
