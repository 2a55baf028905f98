"""Viewer camera flights: end poses and paths."""

import math
from itertools import pairwise

import numpy as np
import pytest
from painted_scene import photo

from lang3dxl_ns.plugin.viewer.fly_to import Stand, Tour, box_lines, flight, stand_of
from lang3dxl_ns.query.match import Found, Viewpoint
from lang3dxl_ns.query.overview import overview
from lang3dxl_ns.query.text import Prompt


def test_a_stand_is_where_the_photo_was_taken():
    camera = photo("a.jpg", 1.0, 2.0).camera
    stand = stand_of(camera, aspect=1.0, target=(0.0, 0.0, 0.0))
    view = camera.view_matrix.numpy()
    np.testing.assert_allclose(view[:3, :3] @ stand.position + view[:3, 3], 0, atol=1e-6)
    # The painted wall is 5 in front: there, on the photo's axis, is the orbit's center.
    np.testing.assert_allclose(view[:3, :3] @ stand.look_at + view[:3, 3], [0, 0, 5], atol=1e-6)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_the_whole_photo_is_in_view(aspect):
    camera = photo("a.jpg", 0, 0, focal=96, size=96).camera
    half = math.tan(stand_of(camera, aspect).fov / 2)
    assert half >= 0.5 - 1e-9 and half * aspect >= 0.5 - 1e-9
    assert min(half, half * aspect) == pytest.approx(0.5)


def test_matches_behind_the_camera_are_not_orbited():
    stand = stand_of(photo("a.jpg", 0, 0).camera, 1.0, target=(0.0, 0.0, -99.0))
    assert (stand.look_at - stand.position) @ [0, 0, 1] > 0


def test_a_flight_goes_around_and_ends_where_it_should():
    start = Stand(np.array([4.0, 0.0, 1.0]), np.zeros(3), 1.0)
    end = Stand(np.array([-8.0, -0.1, 2.0]), np.array([0.0, 0.0, 0.5]), 0.5)
    way = list(flight(start, end, 20))
    assert len(way) == 20 and way[-1] is end
    distances = [np.linalg.norm(stand.position - stand.look_at) for stand in way]
    assert min(distances) > 4 and np.all(np.diff(distances) > 0)
    assert max(np.linalg.norm(b.position - a.position) for a, b in pairwise(way)) < 2.0
    assert all(0 < stand.position[2] < 3 for stand in way)


def test_a_flight_takes_the_shorter_way_round():
    start = Stand(np.array([-1.0, 0.1, 0.0]), np.zeros(3), 1.0)
    end = Stand(np.array([-1.0, -0.1, 0.0]), np.zeros(3), 1.0)
    assert all(stand.position[0] < -0.9 for stand in flight(start, end, 10))


def tour(count: int = 3) -> Tour:
    viewpoints = [Viewpoint(f"{i}.jpg", photo(f"{i}.jpg", i, 0).camera, 0.25, 0.9, 0.1) for i in range(count)]
    return Tour(Found(Prompt("dome"), viewpoints, None, 0.0, 0.5))


def test_a_tour_goes_round():
    t = tour()
    assert [t.move(1).name for _ in range(4)] == ["0.jpg", "1.jpg", "2.jpg", "0.jpg"]
    assert t.move(-1).name == "2.jpg" and t.best().name == "0.jpg"
    assert str(t) == "1 of 3: 0.jpg, 25% of it matches"
    assert tour().move(-1).name == "2.jpg"


def test_an_overview_sees_the_middle_from_far():
    near, far, aside = photo("near", 0, 0), photo("far", 0.2, 0), photo("aside", 3, 0)
    middle = (0.0, 0.0, 0.0)
    assert overview([aside, near], middle).name == "near"
    assert overview([aside], middle).name == "aside"
    moved = [row[:] for row in far.camera_to_world]
    moved[2][3] *= 2
    assert overview([near, type(far)(**{**vars(far), "camera_to_world": moved})], middle).name == "far"


def test_a_box_is_drawn_edge_by_edge():
    points = box_lines((0, 0, 0), (1, 2, 3))
    edges = {frozenset((tuple(a), tuple(b))) for a, b in pairwise(points)}
    assert len(edges) == 12
    assert all(np.count_nonzero(np.subtract(*edge)) == 1 for edge in map(tuple, edges))
