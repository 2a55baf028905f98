"""The limit: exact labels lifted to the Gaussians and rendered back."""

import numpy as np
import pytest
import torch
from fake_gpu import fake_gpu

from lang3dxl_ns.evaluation.label_limit import label_limit
from lang3dxl_ns.evaluation.layouts import Truth
from lang3dxl_ns.evaluation.scores import average_precision, bounds
from lang3dxl_ns.rendering import Splats, gathering
from lang3dxl_ns.scene.camera import Camera

SIZE = 24


def wall(opacity=0.99):
    """A wall of opaque Gaussians in front of the camera, a fifth of a pixel wide, four per pixel."""
    steps = (torch.arange(2 * SIZE) + 0.5) / 2 - SIZE / 2
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((4 * SIZE**2,), float(SIZE))], dim=1)
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    scales, opacities = torch.full((count, 3), 0.2), torch.full((count,), opacity)
    return Splats(means, quats, scales, opacities, torch.zeros(count, 1, 3))


def camera():
    middle = SIZE / 2
    intrinsics = torch.tensor([[SIZE, 0.0, middle], [0, SIZE, middle], [0, 0, 1]])
    return Camera(torch.eye(4), intrinsics, SIZE, SIZE)


@pytest.fixture
def label():
    mask = np.zeros((SIZE, SIZE), bool)
    mask[4:11, 6:18] = True
    return mask


def score(dome, label):
    return bounds({"dome": dome}, {"dome": Truth(label)})


def test_the_limit_of_a_perfect_scene_is_1(label):
    found = score(label_limit(wall(), [(camera(), {"dome": label})], ["dome"])(camera())[0], label)
    assert found["limit_ap_dome"] == pytest.approx(1, abs=1e-6)


def test_views_that_disagree_lower_it(label):
    other = np.roll(label, 6, axis=1)
    limit = label_limit(wall(), [(camera(), {"dome": label}), (camera(), {"dome": other})], ["dome"])
    assert score(limit(camera())[0], label)["limit_ap_dome"] < 0.9


def test_a_view_without_a_label_is_ignored(label):
    views = [(camera(), {"dome": label}), (camera(), {"window": ~label}), (camera(), {"window": ~label})]
    maps = label_limit(wall(), views, ["dome", "window"])(camera())
    alone = label_limit(wall(), views[:1], ["dome"])(camera())
    torch.testing.assert_close(maps[0], alone[0])
    assert score(maps[0], label)["limit_ap_dome"] == pytest.approx(1, abs=1e-6)


def test_labels_are_lifted_from_larger_ones_than_the_rendering(label):
    large = np.kron(label, np.ones((2, 2))).astype(bool)
    maps = label_limit(wall(), [(camera(), {"dome": large})], ["dome"])(camera())
    torch.testing.assert_close(maps, label_limit(wall(), [(camera(), {"dome": label})], ["dome"])(camera()))


def test_chance_is_the_share_of_positives(label):
    found = score(torch.zeros(SIZE, SIZE), label)
    assert found["chance_ap_dome"] == pytest.approx(label.mean())
    assert average_precision(np.full(label.shape, 0.3), label) == pytest.approx(found["chance_ap_dome"])
    assert score(torch.zeros(SIZE, SIZE), np.zeros_like(label)) == {}


def test_lifted_labels_are_where_the_scene_is_however_many(label, monkeypatch):
    """Large results are gathered on the CPU."""
    monkeypatch.setattr(gathering, "MEMORY", 4 * len(wall()) * 3)
    with fake_gpu():
        splats, view = wall().to("cuda"), camera()
        assert label_limit(splats, [(view, {"dome": label})], ["dome"])(view).shape == (1, SIZE, SIZE)
