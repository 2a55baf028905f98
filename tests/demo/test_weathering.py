"""Weathering: copies of a wall or window look different, from everywhere alike; shapes and labels stay."""

import numpy as np
import pytest

from lab.landmark.landmark import Landmark
from lab.landmark.materials import make_material
from lab.landmark.openings import Openings
from lab.landmark.photography import plain_view, random_view, take_photo
from lab.landmark.raycast import Camera
from lab.landmark.shading import trace
from lab.landmark.shapes import Box
from lab.landmark.weathering import stains


def test_shapes_and_labels_stay():
    shots = []
    for weathered in (False, True):
        landmark = Landmark.from_seed(3, "hall", weathered)
        shots.append(take_photo(landmark, random_view(landmark, np.random.default_rng(3)), 96, 72))
    plain, weathered = shots
    for field in ("parts", "elements", "depth", "materials"):
        np.testing.assert_array_equal(getattr(plain, field), getattr(weathered, field))
    assert (plain.image != weathered.image).any()


@pytest.mark.parametrize("weathered", [False, True])
def test_windows_of_a_row_and_sides_of_a_box_are_copies_unless_weathered(weathered):
    rng = np.random.default_rng(0)
    materials = [make_material(name, rng) for name in ("limestone", "glass", "granite")]
    row = Openings(
        0, 1, (4.0, 0.0, 0.0), 0.0, 1, 2, (8.0, 3.0), 2, 1, 2.0, 2.6, "round", "plain", 0.2, 1, 0.1, 0.2
    )
    box = Box(0, 0, (0.0, 0.0, 0.0), 0.0, 0, (6.0, 6.0, 6.0))
    y = np.linspace(-3.9, -0.1, 50)
    there, here = (
        row.surface((0 * y, y + shift, 0 * y + 1.3), (-1.0, 0.0, 0.0), (0.5, 0.0, 0.8)) for shift in (0, 4)
    )
    np.testing.assert_allclose(there.s, here.s, atol=1e-9)
    assert set(there.copy) == {0} and set(here.copy) == {1}
    front, back = (colors([box], materials, (x, 0.0, 3.0), weathered) for x in (14.0, -14.0))
    assert (np.abs(front - back[:, ::-1]).max() < 1e-3) is not weathered


def colors(shapes, materials, position, weathered):
    """The textures that a camera sees which looks at the z axis."""
    camera = Camera.looking_at(position, (0.0, 0.0, position[2]), 1.2)
    weather = plain_view(camera).weather
    hits = trace(shapes, camera, weather, 80, 60, weathered)
    picture = np.zeros((4800, 3), np.float32)
    for i in np.unique(hits.material):
        own = hits.material == i
        shown = materials[i].reflectance(*hits.texture[:, own], np.full(own.sum(), 0.02, np.float32))
        picture[hits.pixel[own]] = shown * hits.shade[own, None]
    return picture.reshape(60, 80, 3)


def test_a_stain_belongs_to_its_place_and_fades_with_distance():
    at = np.random.default_rng(1).uniform(-30, 30, (4000, 3)).astype(np.float32)
    near, far = (stains(at, np.full(4000, size, np.float32), 5) for size in (0.005, 3.0))
    np.testing.assert_array_equal(near[::-1], stains(at[::-1], np.full(4000, 0.005, np.float32), 5))
    assert near.std() > 1.5 * far.std() > 0
    assert abs(near.mean() - 1) < 0.05
    assert (stains(at, np.full(4000, 0.005, np.float32), 6) != near).mean() > 0.9
