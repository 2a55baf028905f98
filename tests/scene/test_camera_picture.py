"""The picture of cameras: upright in any world, doubtful photos red and named, nothing lost far away."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lang3dxl_ns.scene.camera_picture import camera_picture


def ring(count=12):
    """Cameras on a circle of radius 4 that look at the origin, in COLMAP's axes, and a tower's points."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        forward = -np.array([np.cos(angle), 0, np.sin(angle)])
        down = np.array([0.0, 1, 0])
        center = -4 * forward
        poses.append(np.column_stack([np.cross(down, forward), down, forward, center]))
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.5, -3, -0.5], [0.5, 0, 0.5], (3000, 3))
    return np.array(poses), [f"photo {i}.jpg" for i in range(count)], points


def place(picture, color):
    """Rows and columns of the pixels of a color."""
    return np.nonzero((np.asarray(picture) == color).all(axis=2))


def spread(places):
    """Extent of nearly all places: smoothed letters of the titles are gray too."""
    return np.ptp(np.percentile(places, [5, 95]))


GRAY, BLUE, RED = (165, 165, 165), (20, 90, 200), (210, 20, 20)


@pytest.mark.parametrize("seed", range(3))
def test_a_tower_stands_over_its_cameras_however_the_world_is_turned_and_scaled(seed):
    poses, names, points = ring()
    turn = Rotation.random(random_state=seed).as_matrix()
    poses = turn @ poses
    poses[:, :, 3] *= 70
    picture = camera_picture(poses, names, (), 70 * points @ turn.T)
    rows, columns = place(picture, GRAY)
    side, above = columns >= picture.width // 2, columns < picture.width // 2
    assert spread(columns[side]) < 0.7 * spread(rows[side])  # higher than wide
    assert spread(rows[above]) < 0.4 * picture.height
    camera_rows, camera_columns = place(picture, BLUE)
    seen_from_side = camera_columns >= picture.width // 2
    assert np.median(camera_rows[seen_from_side]) > np.median(rows[side])  # lower in the picture
    across = np.ptp(camera_rows[~seen_from_side]), np.ptp(camera_columns[~seen_from_side])
    assert min(across) > 0.9 * max(across)  # a circle from above


def test_doubtful_photos_alone_are_red_in_both_views():
    poses, names, points = ring()
    width = camera_picture(poses, names, (), points).width
    assert not len(place(camera_picture(poses, names, (), points), RED)[0])
    columns = place(camera_picture(poses, names, {names[3]}, points), RED)[1]
    assert columns.min() < width // 2 <= columns.max()


def test_what_lies_far_away_does_not_shrink_the_rest():
    poses, names, points = ring(40)
    near = place(camera_picture(poses, names, (), points), GRAY)
    poses[0, :, 3] = 1e6
    far = place(camera_picture(poses, names, {names[0]}, np.concatenate([points, [[1e7, 0, 0]]])), GRAY)
    assert spread(far[0]) > 0.8 * spread(near[0])


def test_one_camera_without_points_is_drawn():
    poses, names, _ = ring()
    assert len(place(camera_picture(poses[:1], names[:1], (), np.zeros((0, 3))), BLUE)[0])
