"""Photos of a landmark: wild, as if by many strangers, or calm, as if by one careful photographer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from lab.landmark.labels import PART, building_mask
from lab.landmark.landmark import Landmark
from lab.landmark.materials import MATERIALS, Material
from lab.landmark.raycast import Camera, cast
from lab.landmark.shading import Grain, ShadowMap, Weather, light, trace
from lab.landmark.shapes import MISS, Shape, floats
from lab.landmark.surroundings import passers_by

SMALLEST_SHARE = 0.18
"""Least share of a picture that the building must fill. Photos with less are not taken."""
NARROWEST = 0.38
"""Least width that a picture must show, in radii of the landmark."""


@dataclass(frozen=True)
class Lens:
    """Settings of the camera and of the development."""

    exposure: float
    white_balance: tuple[float, float, float]
    gamma: float
    noise: float
    """Standard deviation of the noise, for values from 0 to 1."""
    noise_seed: int


@dataclass(frozen=True, eq=False)
class View:
    """A photo to take: camera, weather, lens, and passers-by."""

    camera: Camera
    weather: Weather
    lens: Lens
    passers_by: tuple[Shape, ...]
    """People and cars that appear in no other photo."""
    passers_by_materials: tuple[Material, ...]
    """Materials of the passers-by, numbered after the landmark's."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Photo with its exact ground truth per pixel."""

    image: UInt8[Array, "h w 3"]
    parts: UInt8[Array, "h w"]
    """Index into labels.PARTS."""
    elements: UInt8[Array, "h w"]
    """Index into labels.ELEMENTS."""
    depth: Float[Array, "h w"]
    """Meters along the camera's axis at the pixel's center; infinite in the sky."""
    materials: UInt8[Array, "h w"]
    """Index into MATERIALS."""


def random_view(landmark: Landmark, rng: np.random.Generator, wild: bool = True) -> View:
    """Choose a view that shows a good part of the building.

    In wild views, distances vary 6× and focal lengths 4×, with any weather and exposure, and with passers-by.
    Calm views have one focal length, one weather, one exposure, no people, and a smaller range of distances.
    """
    camera = random_camera(landmark, rng, wild)
    if not wild:
        return plain_view(camera)
    people = int(rng.integers(0, 10) * (rng.random() < 0.8))
    cars = int(rng.integers(0, 4) * (rng.random() < 0.5))
    crowd = passers_by(rng, lambda: _spot_in_front(landmark, camera, rng), people, cars)
    return View(camera, _random_weather(rng), _random_lens(rng), tuple(crowd.shapes), tuple(crowd.materials))


def plain_view(camera: Camera) -> View:
    """Return a camera's view in plain daylight without people."""
    return View(camera, _CALM_WEATHER, _CALM_LENS, (), ())


def take_photo(landmark: Landmark, view: View, width: int, height: int, oversampling: int = 1) -> Shot:
    """Take the photo and its labels at the given size in pixels. Colors are means of oversampling² rays per
    pixel; labels and depth are those of the pixel's central ray."""
    first = len(landmark.materials)
    crowd = tuple(replace(shape, material=shape.material + first) for shape in view.passers_by)
    shapes = landmark.shapes + crowd
    materials = landmark.materials + view.passers_by_materials
    reach = max(landmark.radius, landmark.height / 2) * 1.15
    shadows = ShadowMap.of(shapes, view.weather, landmark.center, reach)
    truth = fine = trace(shapes, view.camera, view.weather, width, height, landmark.weathered)
    n = oversampling
    if n > 1:
        fine = trace(shapes, view.camera, view.weather, width * n, height * n, landmark.weathered)
    grain = Grain(max(width, height), landmark.seed) if landmark.weathered else None
    color = light(fine, materials, view.camera, view.weather, shadows, grain)
    kinds = np.array([MATERIALS.index(material.name) for material in materials], dtype=np.uint8)
    return Shot(
        image=_develop(color.reshape(height, n, width, n, 3).mean(axis=(1, 3)), view.lens),
        parts=truth.spread(truth.part),
        elements=truth.spread(truth.element),
        depth=np.where(truth.depth < MISS, truth.depth, np.float32(np.inf)),
        materials=truth.spread(kinds[truth.material]),
    )


def random_photo_size(rng: np.random.Generator, width: int, height: int) -> tuple[int, int]:
    """Choose width and height of a wild photo: varied in size and aspect ratio, and sometimes portrait."""
    shape = float(rng.choice([width / height, 4 / 3, 3 / 2, 16 / 9, 1.0], p=[0.4, 0.2, 0.2, 0.1, 0.1]))
    area = width * height * float(rng.choice([1.0, 0.8, 0.64]))
    long, short = round(math.sqrt(area * shape) / 2) * 2, round(math.sqrt(area / shape) / 2) * 2
    return (short, long) if rng.random() < 0.3 else (long, short)


_CALM_WEATHER = Weather(
    sun_azimuth=0.7, sun_elevation=0.85, sun_color=(1.0, 0.94, 0.84), sky_light=(0.44, 0.48, 0.56),
    horizon=(0.74, 0.80, 0.88), zenith=(0.25, 0.42, 0.72), clouds=0.0, cloud_seed=0, haze=3000.0,
)  # fmt: skip
_CALM_LENS = Lens(exposure=1.4, white_balance=(1.0, 1.0, 1.0), gamma=1.0, noise=0.0, noise_seed=0)


def random_camera(landmark: Landmark, rng: np.random.Generator, wild: bool) -> Camera:
    """Choose a camera that is not inside an obstacle and has enough of the building in view."""
    seen: list[tuple[float, Camera]] = []
    for _ in range(60):
        camera = _propose_camera(landmark, rng, wild)
        if camera is not None:
            seen.append((_building_share(landmark, camera), camera))
            if seen[-1][0] >= SMALLEST_SHARE:
                return camera
    return max(seen, key=lambda shown: shown[0])[1]


def _propose_camera(landmark: Landmark, rng: np.random.Generator, wild: bool) -> Camera | None:
    # Most people stand in front of the façade; some walk around.
    azimuth = rng.normal(0, 0.8) if rng.random() < 0.6 else rng.uniform(-math.pi, math.pi)
    if wild:
        distance = landmark.radius * math.exp(rng.uniform(math.log(0.8), math.log(5.6)))
        focal = math.exp(rng.uniform(math.log(0.65), math.log(2.7)))
    else:
        distance, focal = landmark.radius * rng.uniform(1.4, 2.4), 0.9
    eye = rng.uniform(1.5, 2.2)
    if rng.random() < 0.35:
        eye = landmark.height * rng.uniform(0.1, 1.1)  # balconies, hills, drones
        distance = max(distance, landmark.radius * 1.2)
    if distance - 0.6 * landmark.radius < NARROWEST * landmark.radius * focal:  # about to its walls
        return None
    x, y, _ = landmark.center
    position = np.array([x + math.cos(azimuth) * distance, y + math.sin(azimuth) * distance, eye])
    if not landmark.is_free(position, 2.0):
        return None
    aside = rng.normal(0, 0.28) * landmark.radius
    target = np.array([x + math.sin(azimuth) * aside, y - math.cos(azimuth) * aside, 0.0])
    target[2] = landmark.height * rng.uniform(0.1, 0.75)
    if abs(target[2] - eye) > 1.2 * distance:
        return None
    return Camera.looking_at(position, target, focal, rng.normal(0, 0.02) if wild else 0.0)


def _building_share(landmark: Landmark, camera: Camera) -> float:
    """Estimate the share of the picture that the building fills, from a thumbnail."""
    solids = [shape for shape in landmark.shapes if shape.casts_shadow]  # windows lie on these
    _, index = cast(solids, camera, 32, 24)
    parts = np.array([*(shape.part for shape in solids), PART["sky"]], dtype=np.uint8)[index]
    return float(building_mask(parts).mean())


def _spot_in_front(landmark: Landmark, camera: Camera, rng: np.random.Generator):
    """Find a free place on the ground within the view."""
    for _ in range(8):
        away = math.exp(rng.uniform(math.log(9.0), math.log(60.0)))
        aside = rng.uniform(-0.5, 0.5) / camera.focal * away
        right, _, forward = camera.rotation
        flat = forward[:2] / np.linalg.norm(forward[:2])
        x, y = camera.position[:2] + flat * away + right[:2] * aside
        if landmark.is_free((x, y, 0.5), 0.8):
            return float(x), float(y), 0.0
    return None


def _random_weather(rng: np.random.Generator) -> Weather:
    def varied(*color: float, spread: float = 0.12) -> tuple[float, float, float]:
        factor = rng.uniform(1 - spread, 1 + spread)
        r, g, b = (np.array(color) * factor * rng.uniform(0.97, 1.03, 3)).tolist()
        return r, g, b

    mood = rng.choice(["sunny", "cloudy", "overcast", "evening"], p=[0.4, 0.25, 0.2, 0.15])
    elevation = rng.uniform(0.4, 1.15)
    sun, light = varied(1.1, 1.0, 0.86), varied(0.42, 0.47, 0.56)
    horizon, zenith, clouds = varied(0.72, 0.79, 0.88), varied(0.20, 0.37, 0.70, spread=0.25), 0.0
    if mood == "cloudy":
        clouds = rng.uniform(0.3, 0.8)
    elif mood == "overcast":
        sun, light = varied(0.16, 0.16, 0.16), varied(0.72, 0.74, 0.78)
        horizon, zenith, clouds = varied(0.74, 0.76, 0.79), varied(0.56, 0.59, 0.64), rng.uniform(0.0, 0.6)
    elif mood == "evening":
        elevation = rng.uniform(0.12, 0.4)
        sun, light = varied(1.25, 0.82, 0.5), varied(0.36, 0.38, 0.48)
        horizon, zenith, clouds = varied(0.95, 0.72, 0.52), varied(0.32, 0.40, 0.60), rng.uniform(0, 0.5)
    return Weather(
        sun_azimuth=rng.uniform(-1.9, 1.9), sun_elevation=elevation, sun_color=sun, sky_light=light,
        horizon=horizon, zenith=zenith, clouds=clouds, cloud_seed=int(rng.integers(1000)),
        haze=math.exp(rng.uniform(math.log(400), math.log(4000))),
    )  # fmt: skip


def _random_lens(rng: np.random.Generator) -> Lens:
    r, g, b = np.exp(rng.normal(0, 0.045, 3)).tolist()
    return Lens(
        exposure=1.4 * math.exp(rng.normal(0, 0.18)),
        white_balance=(r, g, b),
        gamma=rng.uniform(0.9, 1.12),
        noise=rng.uniform(0.002, 0.015),
        noise_seed=int(rng.integers(2**31)),
    )


_TONE = np.linspace(0, 1, 4096, dtype=np.float32)


def _develop(color: Float[Array, "h w 3"], lens: Lens) -> UInt8[Array, "h w 3"]:
    """Apply exposure, white balance, a film-like shoulder, gamma and noise."""
    linear = color * (lens.exposure * floats(lens.white_balance))
    shoulder = np.minimum(_TONE * 2.0, 1.6)
    curve = (shoulder * (1 + shoulder / 2.56) / (1 + shoulder)) ** (1 / 2.1 * lens.gamma)
    image = curve[np.clip(linear * (4095 / 2.0), 0, 4095).astype(np.int32)]
    if lens.noise > 0:
        rng = np.random.default_rng(lens.noise_seed)
        image = image + lens.noise * rng.standard_normal(image.shape, dtype=np.float32)
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
