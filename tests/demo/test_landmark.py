"""The procedural landmark: exact geometry, labels without gaps, families with their categories."""

import numpy as np
import pytest

from lab.landmark.labels import (
    BUILDING_PARTS,
    CATEGORIES,
    ELEMENT,
    ELEMENTS,
    PART,
    PARTS,
    building_mask,
    category_masks,
)
from lab.landmark.landmark import FAMILIES, Landmark
from lab.landmark.materials import MATERIALS
from lab.landmark.openings import Openings
from lab.landmark.photography import random_photo_size, random_view, take_photo
from lab.landmark.raycast import Camera, cast
from lab.landmark.shading import ShadowMap
from lab.landmark.shapes import MISS, Box, Ellipsoid, Frustum, Polytope, gable, prism
from lang3dxl_ns.common.errors import UserError

FOOT = (0.3, -0.2, 0.1)
SOLIDS = {
    "box": Box(0, 0, FOOT, 0.7, 0, (2.0, 1.0, 1.5)),
    "gable": Polytope(0, 0, FOOT, 0.7, 0, **gable(2.0, 3.0, 1.2)),
    "pyramid": Polytope(0, 0, FOOT, 0.7, 0, **prism(1.0, 2.0, 5, taper=1.0)),
    "cone": Frustum(0, 0, FOOT, 0.0, 0, 1.2, 0.0, 2.0),
    "frustum": Frustum(0, 0, FOOT, 0.0, 0, 0.6, 1.1, 1.0),
    "ellipsoid": Ellipsoid(0, 0, FOOT, 0.4, 0, (1.0, 0.7, 1.3), -10.0, 10.0),
}


def holds(solid, point):
    """Whether the solid contains local points, from its definition and not from its ray caster."""
    x, y, z = point
    if isinstance(solid, Box):
        w, d, h = solid.size
        return (np.abs(x) < w / 2) & (np.abs(y) < d / 2) & (z > 0) & (z < h)
    if isinstance(solid, Polytope):
        return (solid.normals @ np.stack([x, y, z]) < solid.offsets[:, None]).all(axis=0)
    if isinstance(solid, Frustum):
        radius = solid.bottom + (solid.top - solid.bottom) * z / solid.height
        return (np.hypot(x, y) < radius) & (z > 0) & (z < solid.height)
    return sum((v / r) ** 2 for v, r in zip(point, solid.radii, strict=True)) < 1


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_stop_where_they_enter_the_solid(name):
    solid, rng = SOLIDS[name], np.random.default_rng(0)
    steps = np.linspace(0, 8, 4001)
    hits = 0
    for _ in range(60):
        start = rng.normal(size=3)
        start *= 4 / np.linalg.norm(start)
        towards = rng.uniform(-0.6, 0.6, 3) + np.array([0.3, -0.2, 0.8]) - start
        towards /= np.linalg.norm(towards)
        origin = solid.point_to_local(tuple(start))
        direction = solid.to_local(tuple(towards))
        inside = holds(solid, tuple(o + steps * d for o, d in zip(origin, direction, strict=True)))
        with np.errstate(all="ignore"):
            t = solid.distance(origin, tuple(np.float32([[d]]) for d in direction)).item()
        if inside.sum() > 2:
            assert t == pytest.approx(steps[inside.argmax()], abs=0.01)
            hits += 1
        elif not inside.any():
            assert t == MISS or not holds(
                solid, tuple(o + (t + 0.02) * d for o, d in zip(origin, direction, strict=True))
            )
    assert hits > 20


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_point_out_of_the_solid_and_bounds_hold_it(name):
    solid = SOLIDS[name]
    camera = Camera.looking_at((4.0, -3.0, 3.0), (0.3, -0.2, 0.8), 1.0)
    depth, index = cast([solid], camera, 60, 60)
    rays = np.stack(camera.rays(60, 60)[1], axis=-1)[index == 0]
    points = camera.position + rays * depth[index == 0][:, None]
    low, high = solid.corners.min(axis=0), solid.corners.max(axis=0)
    assert len(points) > 100
    assert ((points > low - 1e-3) & (points < high + 1e-3)).all()
    local = solid.point_to_local(tuple(points.T))
    surface = solid.surface(local, solid.to_local(tuple(rays.T)), (0.0, 0.0, 1.0))
    normal = np.stack([np.broadcast_to(n, len(points)) for n in surface.normal])
    np.testing.assert_allclose((normal**2).sum(axis=0), 1, atol=1e-3)
    inner, outer = (holds(solid, tuple(np.stack(local) + step * normal)) for step in (-0.02, 0.02))
    assert inner.mean() > 0.97  # not all: edges
    assert not outer.any()


def test_projection_inverts_rays():
    camera = Camera.looking_at((9.0, 2.0, 3.0), (0.0, 0.0, 4.0), 0.8, roll=0.1)
    origin, direction = camera.rays(40, 30)
    points = np.stack(origin) + 7.0 * np.stack(direction, axis=-1)
    x, y, z = camera.project(points.reshape(-1, 3), 40, 30).T.reshape(3, 30, 40)
    np.testing.assert_allclose(x[3], np.arange(40) + 0.5, atol=1e-3)
    np.testing.assert_allclose(y[:, 5], np.arange(30) + 0.5, atol=1e-3)
    np.testing.assert_allclose(z, 7.0, rtol=1e-5)


def test_objects_between_a_point_and_the_sun_shade_it():
    box = Box(PART["wall"], 0, (0.0, 0.0, 0.0), 0.0, 0, (4.0, 4.0, 10.0))
    landmark = Landmark.from_seed(0, "hall")
    weather = random_view(landmark, np.random.default_rng(0), wild=False).weather
    shadows = ShadowMap.of([box], weather, np.array([0.0, 0.0, 3.0]), 20.0)
    flat = weather.to_sun[:2] / np.linalg.norm(weather.to_sun[:2])
    before, behind = np.append(4 * flat, 0), np.append(-4 * flat, 0)
    np.testing.assert_array_equal(
        shadows.sunlit(np.float32([before, behind]), np.float32([[0, 0, 1]] * 2)), [1, 0]
    )


def test_the_same_seed_gives_the_same_photo():
    first, second, other = (shot_of(seed) for seed in (3, 3, 4))
    for field in ("image", "parts", "elements", "depth", "materials"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    assert (first.image != other.image).any()


def shot_of(seed, family=None, wild=True, size=(96, 72)):
    landmark = Landmark.from_seed(seed, family)
    return take_photo(landmark, random_view(landmark, np.random.default_rng(seed), wild), *size)


@pytest.mark.parametrize("family", FAMILIES)
def test_labels_cover_every_pixel(family):
    shot = shot_of(5, family)
    sky = shot.parts == PART["sky"]
    assert shot.parts.max() < len(PARTS)
    assert shot.elements.max() < len(ELEMENTS)
    np.testing.assert_array_equal(sky, np.isinf(shot.depth))
    np.testing.assert_array_equal(sky, shot.materials == MATERIALS.index("sky"))
    assert building_mask(shot.parts)[shot.elements > 0].all(), "windows and portals are the building's own"
    assert building_mask(shot.parts).mean() > 0.1


def test_oversampling_changes_no_label():
    landmark = Landmark.from_seed(1)
    view = random_view(landmark, np.random.default_rng(1))
    coarse, fine = (take_photo(landmark, view, 96, 72, oversampling) for oversampling in (1, 2))
    np.testing.assert_array_equal(coarse.parts, fine.parts)
    np.testing.assert_array_equal(coarse.depth, fine.depth)
    assert (coarse.image != fine.image).any()
    difference = coarse.image.astype(float) - fine.image
    assert np.abs(difference).mean() < 12


EXPECTED = {
    "cathedral": {"windows", "portals", "domes", "towers", "spires"},
    "mosque": {"windows", "portals", "domes", "minarets"},
    "hall": {"windows", "portals", "domes", "towers", "spires"},
}
ALWAYS = {
    "cathedral": {"windows", "portals"},
    "mosque": {"windows", "portals", "domes", "minarets"},
    "hall": {"windows", "portals"},
}


@pytest.mark.parametrize("family", FAMILIES)
def test_family_has_its_categories(family):
    found = [categories_of(Landmark.from_seed(seed, family)) for seed in range(12)]
    assert set.union(*found) >= EXPECTED[family]
    assert all(categories >= ALWAYS[family] for categories in found)


def categories_of(landmark):
    parts = np.uint8([[shape.part for shape in landmark.shapes]])
    elements = np.uint8([[shape.element for shape in landmark.shapes]])
    return {category for category, mask in category_masks(parts, elements).items() if mask.any()}


def test_no_material_belongs_to_one_category():
    """Domes, spires, minarets and towers are each of several materials, and share most of them."""
    used = {part: set() for part in ("dome", "tower", "minaret", "spire", "wall")}
    for seed in range(60):
        landmark = Landmark.from_seed(seed)
        for shape in landmark.shapes:
            if PARTS[shape.part] in used and not isinstance(shape, Openings):
                used[PARTS[shape.part]].add(landmark.materials[shape.material].name)
    for part, names in used.items():
        others = set.union(*(used[other] for other in used if other != part))
        assert len(names) >= 4
        assert names <= others, part


def test_windows_have_many_outlines_and_sizes():
    sizes, outlines = [], set()
    for seed in range(30):
        for shape in Landmark.from_seed(seed).shapes:
            if isinstance(shape, Openings) and shape.element == ELEMENT["window"]:
                sizes.append(shape.height)
                outlines.add(shape.outline)
    assert outlines == {"round", "pointed", "rectangle", "circle", "segment"}
    assert max(sizes) > 5 * min(sizes)


def test_tower_truth_includes_its_windows():
    parts = np.full((1, 2), PART["tower"], np.uint8)
    elements = np.uint8([[ELEMENT["none"], ELEMENT["window"]]])
    masks = category_masks(parts, elements)
    assert tuple(masks) == CATEGORIES
    np.testing.assert_array_equal(masks["towers"], [[True, True]])
    np.testing.assert_array_equal(masks["windows"], [[False, True]])


def test_building_mask_is_the_buildings_parts():
    every = np.arange(len(PARTS), dtype=np.uint8)[None]
    assert {PARTS[i] for i in np.flatnonzero(building_mask(every)[0])} == set(BUILDING_PARTS)


def test_calm_views_differ_in_place_only():
    landmark = Landmark.from_seed(2)
    views = [random_view(landmark, np.random.default_rng(i), wild=False) for i in range(4)]
    assert len({view.lens for view in views}) == len({view.weather for view in views}) == 1
    assert len({view.camera.focal for view in views}) == 1
    assert not any(view.passers_by for view in views)
    assert len({tuple(view.camera.position) for view in views}) == 4


def test_wild_views_differ_in_everything():
    landmark = Landmark.from_seed(2)
    views = [random_view(landmark, np.random.default_rng(i)) for i in range(60)]
    focal = [view.camera.focal for view in views]
    distance = [np.linalg.norm(view.camera.position[:2] - landmark.center[:2]) for view in views]
    azimuth = [np.arctan2(*(view.camera.position - landmark.center)[1::-1]) for view in views]
    assert max(focal) > 3.5 * min(focal)
    assert max(distance) > 4 * min(distance)
    assert np.ptp(azimuth) > np.pi
    assert len({view.lens for view in views}) == len({view.weather for view in views}) == 60
    assert 0 < sum(bool(view.passers_by) for view in views) < 60
    assert all(landmark.is_free(view.camera.position, 1.0) for view in views)
    rng = np.random.default_rng(0)
    sizes = {random_photo_size(rng, 480, 360) for _ in range(40)}
    assert len(sizes) > 6
    assert {width > height for width, height in sizes} == {True, False}


def test_unknown_family_is_named():
    with pytest.raises(UserError, match=r"'pagoda'.*cathedral, mosque, hall"):
        Landmark.from_seed(0, "pagoda")
