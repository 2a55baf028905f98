"""A photo's viewpoint in nerfstudio's viewer."""

import math

import numpy as np
import pytest
from painted_scene import photo

from lang3dxl_ns.plugin.panel import stand_of


def test_a_stand_is_where_the_photo_was_taken():
    camera = photo("a.jpg", 1.0, 2.0).camera
    position, look_at, _ = stand_of(camera, aspect=1.0, target=(0.0, 0.0, 0.0))
    view = camera.view_matrix.numpy()
    np.testing.assert_allclose(view[:3, :3] @ position + view[:3, 3], 0, atol=1e-6)
    # The painted wall is 5 in front: there, on the photo's axis, is the orbit's center.
    np.testing.assert_allclose(view[:3, :3] @ look_at + view[:3, 3], [0, 0, 5], atol=1e-6)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_the_whole_photo_is_in_view(aspect):
    camera = photo("a.jpg", 0, 0, focal=96, size=96).camera
    half = math.tan(stand_of(camera, aspect)[2] / 2)
    assert half >= 0.5 - 1e-9 and half * aspect >= 0.5 - 1e-9
    assert min(half, half * aspect) == pytest.approx(0.5)


def test_matches_behind_the_camera_are_not_orbited():
    position, look_at, _ = stand_of(photo("a.jpg", 0, 0).camera, 1.0, target=(0.0, 0.0, -99.0))
    assert (look_at - position) @ [0, 0, 1] > 0
