"""Views from a splat alone: upright, outside of matter, of its surfaces."""

import numpy as np
import pytest
import torch
from box_splat import box_splat
from moved_splats import transformed, with_colors
from scenes import CENTER, HALF_SIZES
from scipy.spatial.transform import Rotation

from lang3dxl_ns.attachment import direction_of, views
from lang3dxl_ns.attachment.upright import Upright
from lang3dxl_ns.attachment.views import LENS, Extent, candidates, looking, rendered_views, solids
from lang3dxl_ns.common.errors import UserError

SPLATS = box_splat(0.1, ground=True)


def turned(matrix: np.ndarray):
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3, :3] = torch.from_numpy(matrix)
    return transformed(SPLATS, whole)


@pytest.mark.parametrize("axis", range(6))
def test_up_is_found_wherever_it_points(axis):
    """The 90-degree rotations that take z to each of the six axes, and a tilt of ten degrees."""
    up = np.eye(3)[axis % 3] * (1 if axis < 3 else -1)
    matrix = Rotation.align_vectors([up], [[0, 0, 1]])[0].as_matrix()
    matrix = Rotation.from_rotvec([0.1, -0.1, 0.1]).as_matrix() @ matrix
    found = Extent.of(turned(matrix), "auto").up.numpy()
    assert found @ (matrix @ [0, 0, 1]) > 0.99


def test_a_doubtful_up_is_told_with_the_flag_that_sets_the_other(monkeypatch, capsys):
    for margin, said in ((2.0, "up is about -y"), (0.1, "uncertain: -y (0.00,-1.00,0.10) leads z")):
        guess = Upright(torch.tensor([0.0, -1, 0.1]), margin, torch.tensor([0.0, 0, 1]))
        monkeypatch.setattr(views, "find_up", lambda *_, guess=guess: guess)
        Extent.of(SPLATS, "auto")
        assert said in (out := " ".join(capsys.readouterr().out.split()))
    assert "set --up=0.00,0.00,1.00" in out


def test_up_is_an_axis_or_three_numbers():
    assert direction_of("-y") == (0, -1, 0) and direction_of("0,3,-4") == (0, 0.6, -0.8)
    for wrong in ("up", "", "-", "1,2", "0,0,0", "nan,0,1", "xy"):
        with pytest.raises(UserError, match="--up is"):
            direction_of(wrong)


def test_a_camera_looks_at_its_target_upright():
    place, target = torch.tensor([3.0, -2.0, 1.5]), torch.tensor([0.2, 0.4, 0.5])
    up = torch.tensor([0.0, 0.0, 1.0])
    camera = LENS.camera(looking(place, target, up))
    at = camera.view_matrix[:3, :3] @ target + camera.view_matrix[:3, 3]
    torch.testing.assert_close(
        at, torch.tensor([0.0, 0.0, float((target - place).norm())]), atol=1e-5, rtol=0
    )
    above = camera.view_matrix[:3, :3] @ (target + up) + camera.view_matrix[:3, 3]
    assert float(above[0].abs()) < 1e-5
    assert float(above[1]) < 0  # y points down
    assert float(camera.view_matrix[:3, :3].det()) == pytest.approx(1, abs=1e-5)


def test_no_camera_stands_in_matter():
    extent = Extent.of(SPLATS, "z")
    free = views._FreeSpace(solids(SPLATS), extent)
    places = np.array([camera.pose[:3, 3] for camera in candidates(extent, free, 60)])
    assert len(places) == 60
    inside = (np.abs(places - CENTER) < HALF_SIZES).all(axis=1)
    assert not inside.any()
    assert places[:, 2].min() > 0
    assert torch.from_numpy(CENTER).float() not in free  # hollow, but under a roof
    assert torch.tensor([1.2, 0.0, 0.5]) not in free  # on a wall
    assert torch.tensor([2.0, -2.0, 0.5]) in free


def test_views_around_a_scene_leave_its_parts_their_surroundings():
    """They start at 1.6 radii and end at 5, looking at its inner half from above the ground."""
    extent, draw = Extent.of(SPLATS, "z"), torch.Generator().manual_seed(0)
    floor = extent.center + (extent.ground + 0.08 * extent.radius) * extent.up
    for _ in range(100):
        place, target = views._around(extent, draw)
        assert 1.6 - 1e-4 <= float((place - floor).norm()) / extent.radius <= 5 + 1e-4
        assert float((target - extent.center).abs().max()) <= 0.5 * extent.radius + 1e-5
        assert float((place - floor) @ extent.up) >= -1e-5


def test_a_room_is_seen_from_within():
    """The box without anything around it, from which most places have its top above them."""
    room = Extent(torch.from_numpy(CENTER).float(), 0.6, torch.tensor([0.0, 0, 1]), -0.5)
    assert torch.from_numpy(CENTER).float() in views._FreeSpace(solids(box_splat(0.1)), room)


def test_chosen_views_show_more_than_the_first_ones():
    shown = torch.zeros(4, 30)
    shown[0, :10], shown[1, :11], shown[2, 20:], shown[3, 10:20] = 5, 5, 5, 5
    assert views._cover(shown, 3) == [1, 2, 3]


def test_rendered_views_are_kept_and_their_points_lie_on_surfaces(tmp_path, monkeypatch):
    found = rendered_views(SPLATS, 6, "z", tmp_path / "views")
    assert len(found.photos) == 6
    points = found.reconstruction.points
    box = np.maximum(np.abs(points - CENTER) - HALF_SIZES, 0)
    to_box = np.where(
        box.any(axis=1), np.linalg.norm(box, axis=1), (HALF_SIZES - np.abs(points - CENTER)).min(1)
    )
    off = np.minimum(to_box, np.abs(points[:, 2]))
    assert np.quantile(off, 0.9) < 0.1
    tracked = found.reconstruction.photos["0000.png"]
    camera = np.column_stack([tracked.points, np.ones(len(tracked.points))]) @ tracked.camera_from_world.T
    pixels = camera[:, :2] / camera[:, 2:] * [LENS.fx, LENS.fy] + [LENS.cx, LENS.cy]
    np.testing.assert_allclose(pixels, tracked.pixels, atol=1e-2)

    def never(*_):
        raise AssertionError("chosen again")

    monkeypatch.setattr(views, "choose_views", never)
    again = rendered_views(SPLATS, 6, "z", tmp_path / "views")
    for name, photo in again.reconstruction.photos.items():
        wanted = found.reconstruction.photos[name].camera_from_world
        np.testing.assert_allclose(photo.camera_from_world, wanted, atol=1e-6)


def test_another_splat_gets_other_views(tmp_path, monkeypatch):
    chosen = []
    monkeypatch.setattr(views, "choose_views", lambda *args: chosen.append(args) or choose_first(args[1]))
    rendered_views(SPLATS, 2, "z", tmp_path / "views")
    rendered_views(SPLATS.select(torch.arange(len(SPLATS)) % 2 == 0), 2, "z", tmp_path / "views")
    assert len(chosen) == 2


def test_pictures_of_other_colors_or_of_an_interrupted_call_are_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "choose_views", lambda *args: choose_first(args[1]))
    bright = with_colors(SPLATS, torch.ones(len(SPLATS), 3))
    place = tmp_path / "views/images/0000.png"
    rendered_views(SPLATS, 2, "z", tmp_path / "views")
    before = place.read_bytes()
    monkeypatch.setattr(views, "_tracked", interrupt)
    with pytest.raises(KeyboardInterrupt):
        rendered_views(bright, 2, "z", tmp_path / "views")
    assert place.read_bytes() != before
    monkeypatch.undo()
    monkeypatch.setattr(views, "choose_views", lambda *args: choose_first(args[1]))
    rendered_views(SPLATS, 2, "z", tmp_path / "views")
    assert place.read_bytes() == before


def interrupt(*_):
    raise KeyboardInterrupt


def choose_first(extent):
    return list(candidates(extent, views._FreeSpace(solids(SPLATS), extent), 2))


def test_views_are_those_of_the_plain_greedy_choice():
    shown = 20 * torch.rand(30, 200, generator=torch.Generator().manual_seed(0)) ** 8
    total, chosen = torch.zeros(200), []
    for _ in range(8):
        gains = (shown / (views._ENOUGH + total)).log1p().sum(1)
        gains[chosen] = -1
        chosen.append(int(gains.argmax()))
        total = total + shown[chosen[-1]]
    assert views._cover(shown, 8) == sorted(chosen)
