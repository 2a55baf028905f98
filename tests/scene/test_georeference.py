"""Meters, up and north from GPS positions of photos."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.georeference import georeference, gps_position, local_meters
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord

BERN = (46.947, 7.444, 540.0)


def degrees_at(east: float, north: float) -> tuple[float, float, float]:
    """Position in degrees of a place some meters from Bern's center, by the radii of curvature there."""
    sine = math.sin(math.radians(BERN[0]))
    root = math.sqrt(1 - 6.694379990141e-3 * sine**2)
    along = 6_378_137.0 * (1 - 6.694379990141e-3) / root**3
    across = 6_378_137.0 / root * math.cos(math.radians(BERN[0]))
    return BERN[0] + math.degrees(north / along), BERN[1] + math.degrees(east / across), BERN[2]


def walk(count: int = 12, seed: int = 0) -> np.ndarray:
    """Places of photographers around a building, in meters east and north."""
    angles = np.linspace(0, 1.5 * np.pi, count)
    radius = 30 + np.random.default_rng(seed).uniform(-5, 5, count)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def in_frame(places: np.ndarray, turn: np.ndarray, scale: float) -> np.ndarray:
    """Places in a frame whose unit is `scale` meters, turned from east, north, up."""
    flat = np.concatenate([places, np.full((len(places), 1), 1.6)], axis=1)
    return flat @ turn.T / scale + [3.0, -2.0, 7.0]


@pytest.mark.parametrize("seed", range(4))
def test_scale_up_and_north_of_any_frame_are_found(seed):
    places, turn, scale = walk(seed=seed), rotation(seed), 10.0 ** (seed - 1)
    found = georeference(in_frame(places, turn, scale), 5 * turn[:, 2], [degrees_at(*p) for p in places])
    assert found is not None
    assert found.meters == pytest.approx(scale, rel=1e-3)
    np.testing.assert_allclose(found.north, turn[:, 1], atol=1e-3)
    np.testing.assert_allclose(found.up, turn[:, 2], atol=1e-9)
    assert found.photos == len(places)


def test_wrong_positions_change_nothing():
    places, turn = walk(), rotation(1)
    positions = [degrees_at(*p) for p in places]
    positions[2], positions[7] = degrees_at(900, 40), (0.5, 0.5, 0.0)
    positions[4] = None
    found = georeference(in_frame(places, turn, 2.0), turn[:, 2], positions)
    assert found is not None
    assert found.photos == len(places) - 3
    assert found.meters == pytest.approx(2.0, rel=1e-3)


def test_the_error_of_gps_is_within_what_is_told():
    errors = []
    for seed in range(40):
        places, turn = walk(24, seed), rotation(seed)
        noisy = places + np.random.default_rng(seed).normal(0, 4 / math.sqrt(2), places.shape)
        found = georeference(in_frame(places, turn, 2.0), turn[:, 2], [degrees_at(*p) for p in noisy])
        assert found is not None
        errors.append((found.meters / 2.0 - 1) / found.uncertainty)
    assert 0.5 < np.std(errors) < 1.5


@pytest.mark.parametrize(
    "positions",
    [
        [None] * 12,
        [degrees_at(0, 0)] * 2 + [None] * 10,
        [degrees_at(0, 0)] * 12,  # one position for all, as a photographer without reception gets
        [degrees_at(*(p / 20)) for p in walk()],  # within a room: smaller than the error of GPS
        [degrees_at(*p) for p in np.random.default_rng(0).uniform(-5000, 5000, (12, 2))],
    ],
    ids=["none", "two", "one place", "a room", "chance"],
)
def test_where_gps_tells_nothing_there_are_no_meters(positions):
    turn = rotation(0)
    assert georeference(in_frame(walk(), turn, 2.0), turn[:, 2], positions) is None


def test_a_record_keeps_meters_and_forgets_places(tmp_path):
    places, turn = walk(), rotation(2)
    centers, photos, described = in_frame(places, turn, 2.0), [], []
    lens = Lens(8, 6, 8.0, 8.0, 4.0, 3.0)
    for i, (center, place) in enumerate(zip(centers, places, strict=True)):
        latitude, longitude, _ = degrees_at(*place)
        path = tmp_path / f"{i}.jpg"
        with_gps(path, {1: "N", 2: (latitude, 0.0, 0.0), 3: "E", 4: (longitude, 0.0, 0.0)})
        photos.append(Photo(path.name, path, None, lens))
        east = turn[:, 0]
        pose = np.column_stack([east, turn[:, 2], np.cross(east, turn[:, 2]), center]).tolist()
        described.append(ScenePhoto.of(photos[-1], "train", pose, 1.0))
    identity = np.eye(4)[:3].tolist()
    record = SceneRecord(described, None, None, 1.0, identity, str(tmp_path)).located(photos)
    assert record.georeference is not None
    assert record.georeference.meters == pytest.approx(2.0, rel=1e-3)
    record.write(tmp_path / "scene.json")
    text = (tmp_path / "scene.json").read_text()
    assert "46.9" not in text
    assert SceneRecord.read(tmp_path / "scene.json") == record
    for wrong in ('"meters": ', '"meters": -'), ('"up": [', '"up": [7.0, '):
        (tmp_path / "scene.json").write_text(text.replace(*wrong))
        with pytest.raises(UserError, match="can't be read"):
            SceneRecord.read(tmp_path / "scene.json")
    content = json.loads(text)
    content["georeference"]["north"] = content["georeference"]["up"]
    (tmp_path / "scene.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="its north points up"):
        SceneRecord.read(tmp_path / "scene.json")


def test_meters_hold_across_the_date_line():
    apart = local_meters([(10.0, 179.9999, 0.0), (10.0, -179.9999, 0.0), (10.0, 179.9999, 0.0)])
    assert np.linalg.norm(apart[0] - apart[1]) == pytest.approx(
        0.0002 * 111_320 * math.cos(math.radians(10)), rel=5e-3
    )


def with_gps(path, gps: dict) -> None:
    image, exif = Image.new("RGB", (8, 6)), Image.Exif()
    exif.get_ifd(0x8825).update(gps)
    image.save(path, exif=exif)


def test_positions_of_photos_are_read(tmp_path):
    path = tmp_path / "a.jpg"
    with_gps(path, {1: "S", 2: (46.0, 56.0, 49.2), 3: "W", 4: (7.0, 26.0, 38.4), 5: b"\1", 6: 12.5})
    assert gps_position(path) == pytest.approx((-46.947, -7.444, -12.5))


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)},
        {1: "N", 2: (146.0, 0.0, 0.0), 3: "E", 4: (7.0, 0.0, 0.0)},
        {1: "N", 2: (46.0,), 3: "E", 4: (7.0, 0.0, 0.0)},
        {2: (46.0, 0.0, 0.0)},
    ],
    ids=["none", "zeros", "impossible", "short", "half"],
)
def test_photos_without_a_position_have_none(tmp_path, gps):
    path = tmp_path / "a.jpg"
    with_gps(path, gps)
    assert gps_position(path) is None
