"""Shading: a linear picture from ray hits, with sun, sky and haze."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int16, UInt8
from numpy import ndarray as Array

from lab.landmark.materials import Material, fractal_noise
from lab.landmark.raycast import Camera, SunCamera, cast
from lab.landmark.shapes import Shape, floats
from lab.landmark.weathering import own_place, stains, tint

SHADOW_MAP = 256
"""Pixels per side of the shadow map, about 0.3 m each on a landmark of 40 m radius."""


@dataclass(frozen=True)
class Weather:
    """Sun, sky and air at one moment. Colors are linear."""

    sun_azimuth: float
    """Direction of the sun, radians; 0 is in front of the façade."""
    sun_elevation: float
    sun_color: tuple[float, float, float]
    sky_light: tuple[float, float, float]
    """Light from the whole sky on an upward-facing surface."""
    horizon: tuple[float, float, float]
    zenith: tuple[float, float, float]
    clouds: float
    """Cloud cover, from 0 (clear) to 1 (overcast)."""
    cloud_seed: int
    haze: float
    """Distance in meters at which 63 % of the color is haze."""

    @property
    def to_sun(self) -> Float[Array, "3"]:
        azimuth, flat = self.sun_azimuth, np.cos(self.sun_elevation)
        return floats([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(self.sun_elevation)])


@dataclass(frozen=True)
class Grain:
    """Stains and grain of a weathered landmark in one photo."""

    pixels: int
    """Longer side of the photo."""
    seed: int


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """Distance that the sun's rays travel before they hit something."""

    sun: SunCamera
    depth: Float[Array, "n n"]

    @classmethod
    def of(
        cls, shapes: Sequence[Shape], weather: Weather, center: Float[Array, "3"], radius: float
    ) -> ShadowMap:
        """Compute shadows within `radius` meters of the center, and a little beyond."""
        rotation = Camera.looking_at(center + weather.to_sun, center, 1.0).rotation
        sun = SunCamera(center, rotation, 2.6 * radius)
        casting = [shape for shape in shapes if shape.casts_shadow]
        return cls(sun, cast(casting, sun, SHADOW_MAP, SHADOW_MAP)[0])

    def sunlit(self, at: Float[Array, "n 3"], normal: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Compute the share of sunlight at points: the mean of four neighbors in the map, 1 outside it."""
        n, texel = SHADOW_MAP, self.sun.extent / SHADOW_MAP
        lit = np.ones(len(at), np.float32)
        x, y, z = self.sun.project(at + normal * texel, n, n).T
        inside = np.flatnonzero((x >= 1) & (y >= 1) & (x < n - 1) & (y < n - 1))
        column, row = (v[inside].astype(np.int32) for v in (x - 0.5, y - 0.5))
        fx, fy = x[inside] - 0.5 - column, y[inside] - 0.5 - row
        limit = z[inside] - 0.8 * texel
        free = [self.depth[row + j, column + i] >= limit for j in (0, 1) for i in (0, 1)]
        upper, lower = free[0] * (1 - fx) + free[1] * fx, free[2] * (1 - fx) + free[3] * fx
        lit[inside] = upper * (1 - fy) + lower * fy
        return lit


@dataclass(frozen=True, eq=False)
class Traced:
    """Hits of a camera's rays: the ground truth of every pixel, and the inputs of the lighting. Fields of [n]
    cover the pixels that hit something, ordered by shape."""

    depth: Float[Array, "h w"]
    """Meters along the camera's axis; MISS in the sky."""
    pixel: Int[Array, " n"]
    """Index into the flattened picture."""
    part: UInt8[Array, " n"]
    element: UInt8[Array, " n"]
    material: Int16[Array, " n"]
    normal: Float[Array, "n 3"]
    texture: Float[Array, "2 n"]
    shade: Float[Array, " n"]
    sunlit: Float[Array, " n"]

    def spread(self, values: UInt8[Array, " n"]) -> UInt8[Array, "h w"]:
        """Spread values of the hit pixels over a picture that is 0 in the sky."""
        picture = np.zeros(self.depth.size, dtype=np.uint8)
        picture[self.pixel] = values
        return picture.reshape(self.depth.shape)


def trace(
    shapes: Sequence[Shape],
    camera: Camera,
    weather: Weather,
    width: int,
    height: int,
    weathered: bool = False,
) -> Traced:
    """Cast a ray through every pixel's center. The sun decides which recesses are lit. Weathered copies of
    walls and windows have textures of their own."""
    depth, index = cast(shapes, camera, width, height)
    order = np.argsort(index.ravel(), kind="stable")  # radix sort for int16
    pixel = order[np.searchsorted(index.ravel()[order], 0) :]
    shape, n = index.ravel()[pixel], len(pixel)
    traced = Traced(
        depth=depth, pixel=pixel, part=np.empty(n, np.uint8), element=np.empty(n, np.uint8),
        material=np.empty(n, np.int16), normal=np.empty((n, 3), np.float32),
        texture=np.empty((2, n), np.float32), shade=np.empty(n, np.float32), sunlit=np.empty(n, np.float32),
    )  # fmt: skip
    rays, position = _flat(camera, width, height)[pixel].T, camera.position.astype(np.float32)
    to_sun = tuple(weather.to_sun.tolist())
    starts = np.flatnonzero(np.diff(shape, prepend=-1)).tolist()
    for start, end in zip(starts, [*starts[1:], n], strict=True):
        it, run = shapes[shape[start]], slice(start, end)
        ray = rays[:, run]
        at = ray * depth.ravel()[pixel[run]] + position[:, None]
        surface = it.surface(it.point_to_local(tuple(at)), it.to_local(tuple(ray)), it.to_local(to_sun))
        traced.normal[run, 0], traced.normal[run, 1], traced.normal[run, 2] = it.to_world(surface.normal)
        traced.texture[0, run], traced.texture[1, run] = surface.s, surface.t
        if weathered:
            copy = np.broadcast_to(surface.copy, end - start)
            traced.texture[:, run] += own_place(copy, int(shape[start]))
        traced.shade[run], traced.sunlit[run] = surface.shade, surface.sunlit
        traced.part[run] = it.part
        traced.element[run] = np.where(surface.element, it.element, 0)
        traced.material[run] = np.where(surface.trim, it.trim, it.material)
        if weathered:
            window = ~np.asarray(surface.trim) & (it.trim != it.material)
            traced.shade[run] *= tint(copy, int(shape[start]), window)
    return traced


def light(
    traced: Traced,
    materials: Sequence[Material],
    camera: Camera,
    weather: Weather,
    shadows: ShadowMap,
    grain: Grain | None = None,
) -> Float[Array, "h w 3"]:
    """Compute the linear colors of all pixels: lit hits, and sky elsewhere."""
    height, width = traced.depth.shape
    rays, sky = _flat(camera, width, height), np.ones(height * width, bool)
    sky[traced.pixel] = False
    color = np.empty((height * width, 3), np.float32)
    color[sky] = _sky(rays[sky], weather)
    color[traced.pixel] = _lit(traced, materials, camera, weather, rays[traced.pixel], shadows, grain)
    return color.reshape(height, width, 3)


def _flat(camera: Camera, width: int, height: int) -> Float[Array, "n 3"]:
    _, direction = camera.rays(width, height)
    return np.stack(direction, axis=-1).reshape(-1, 3)


def _lit(
    hits: Traced,
    materials,
    camera: Camera,
    weather: Weather,
    ray: Float[Array, "n 3"],
    shadows: ShadowMap,
    grain: Grain | None,
) -> Float[Array, "n 3"]:
    distance = hits.depth.ravel()[hits.pixel]
    length = np.sqrt((ray * ray).sum(axis=1))
    facing = -(ray * hits.normal).sum(axis=1) / length
    at = ray * distance[:, None] + camera.position.astype(np.float32)
    pixels = 640 if grain is None else grain.pixels  # texture detail as in a medium-sized photo
    pixel_size = distance / (camera.focal * pixels)
    footprint = pixel_size / np.maximum(facing, 0.15)

    color = np.empty((len(ray), 3), np.float32)
    gloss = np.zeros(len(ray), np.float32)
    for i in np.flatnonzero(np.bincount(hits.material)):
        own = np.flatnonzero(hits.material == i)
        color[own] = materials[i].reflectance(*hits.texture[:, own], footprint[own])
        gloss[own] = materials[i].gloss
    if grain is not None:
        color *= stains(at, footprint, grain.seed)[:, None]

    to_sun = weather.to_sun
    sunlight = np.clip(hits.normal @ to_sun, 0, 1) * hits.sunlit
    sunny = np.flatnonzero(sunlight)
    sunlight[sunny] *= shadows.sunlit(at[sunny], hits.normal[sunny])
    up, height = hits.normal[:, 2], at[:, 2]
    skylight = (0.62 + 0.38 * up + 0.12 * hits.normal[:, 1]) * (1 - 0.25 * np.exp(-np.maximum(height, 0) / 2))
    light = sunlight[:, None] * floats(weather.sun_color) + skylight[:, None] * floats(weather.sky_light)
    color *= light * hits.shade[:, None]
    shiny = np.flatnonzero(gloss)
    if len(shiny):
        view = ray[shiny] / length[shiny, None]
        normal, matte = hits.normal[shiny], color[shiny]
        color[shiny] += _glint(view, normal, gloss[shiny], matte, sunlight[shiny], weather)
    clear = np.exp(-distance * length / weather.haze)[:, None]
    return color * clear + floats(weather.horizon) * (1 - clear)


def _glint(view, normal, gloss, color, sunlight, weather: Weather):
    """Compute the highlight of the sun and the reflection of the sky on glossy materials."""
    facing = (view * normal).sum(axis=1, keepdims=True)
    mirror = view - 2 * facing * normal
    highlight = np.clip(mirror @ weather.to_sun, 0, 1) ** 24 * (sunlight > 0)
    grazing = (1 - np.clip(-facing[:, 0], 0, 1)) ** 3
    sky = floats(weather.zenith) * (np.clip(mirror[:, 2], 0, 1) * (0.1 + 0.5 * grazing))[:, None]
    own = color * (1.2 * np.clip(mirror[:, 2], 0, 1))[:, None]  # metals reflect in their own color
    return gloss[:, None] * (
        0.6 * highlight[:, None] * floats(weather.sun_color) * (0.3 + color) + 0.5 * sky + own * 0.4
    )


def _sky(rays, weather: Weather) -> Float[Array, "n 3"]:
    up = rays[:, 2] / np.sqrt((rays * rays).sum(axis=1))
    share = np.sqrt(np.clip(up, 0, 1))[:, None]
    color = floats(weather.horizon) * (1 - share) + floats(weather.zenith) * share
    above = np.flatnonzero(up > 0.02)
    if weather.clouds > 0 and len(above):
        # Clouds lie on a plane overhead, so they shrink towards the horizon.
        height = rays[above, 2] + 0.15 * np.hypot(rays[above, 0], rays[above, 1])
        x, y = (rays[above, i] / height for i in (0, 1))
        noise = fractal_noise(x * 1.5, y * 1.5, weather.cloud_seed, 5)
        cover = np.clip((noise - 0.75 + 0.45 * weather.clouds) * 4, 0, 1)[:, None]
        bright = floats(weather.horizon).max() * (1.05 - 0.25 * cover * weather.clouds)
        color[above] = color[above] * (1 - cover) + bright * cover
    return color
