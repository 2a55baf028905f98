"""Maps of patch features: windows leave no trace, whatever the photo's shape."""

from __future__ import annotations

import itertools

import pytest
import torch
import torch.nn.functional as F
from tiny_models import make_tiny_clip
from tiny_teachers import random_picture

from lang3dxl_ns.preparation.dense_map import build_dense_map, map_grids, window_starts
from lang3dxl_ns.preparation.encoders import load_image_text_encoder

TOKENS, PATCH = 4, 8


def mean_colors(windows: torch.Tensor) -> torch.Tensor:
    """The simplest encoder: a patch's feature is its mean color, and a 1."""
    means = F.avg_pool2d(windows, PATCH).permute(0, 2, 3, 1)
    return F.pad(means, (0, 1), value=1.0)


@pytest.mark.parametrize("shape", [(64, 64), (60, 130), (300, 40), (33, 47)])
def test_windows_join_without_seams(shape):
    """The map of an encoder that looks at single patches is the map of one window as large as the photo."""
    photo = random_picture(*shape, 3)
    grids = map_grids(*shape, TOKENS, least=10)
    found = build_dense_map(photo, grids, mean_colors, TOKENS, PATCH, batch_size=3)
    expected = torch.zeros(())
    for grid in grids:
        size = [PATCH * n for n in grid]
        whole = F.interpolate(photo.permute(2, 0, 1)[None], size, mode="bicubic", antialias=True).clamp(0, 1)
        units = F.normalize(mean_colors(whole)[0], dim=-1).permute(2, 0, 1)[None]
        expected = expected + F.interpolate(units, grids[-1], mode="bilinear")[0].permute(1, 2, 0) / 2
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_the_number_of_windows_at_once_changes_nothing():
    photo, grids = random_picture(50, 90, 3), ((4, 7), (7, 13))
    one, many = (build_dense_map(photo, grids, mean_colors, TOKENS, PATCH, n) for n in (1, 100))
    torch.testing.assert_close(one, many)


def test_a_mirrored_photo_has_a_mirrored_map():
    photo, grids = random_picture(50, 90, 3), map_grids(50, 90, TOKENS, 10)
    found = build_dense_map(photo, grids, mean_colors, TOKENS, PATCH, 4)
    mirrored = build_dense_map(photo.flip(1), grids, mean_colors, TOKENS, PATCH, 4)
    torch.testing.assert_close(mirrored.flip(1), found, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("length", range(4, 40))
def test_windows_cover_everything_and_overlap(length):
    starts = window_starts(length, TOKENS).tolist()
    assert starts[0] == 0 and starts[-1] + TOKENS == length
    assert all(0 < after - before < TOKENS for before, after in itertools.pairwise(starts))


@pytest.mark.parametrize(("height", "width"), [(1000, 1500), (1500, 1000), (480, 480), (100, 3000)])
def test_the_coarse_size_is_one_window_high_and_the_fine_one_has_enough_patches(height, width):
    (rows, columns), fine = map_grids(height, width, tokens=32, least=64)
    assert min(rows, columns) == 32
    assert max(fine) >= 64 and fine[0] >= 1.7 * rows and fine[1] >= 1.7 * columns
    for grid in ((rows, columns), fine):
        assert grid[1] / grid[0] == pytest.approx(width / height, rel=0.03)


def test_a_square_photo_of_an_encoders_own_size_is_seen_whole(tmp_path):
    encoder = load_image_text_encoder(make_tiny_clip(tmp_path / "clip"), "cpu")
    photo = random_picture(32, 32, 3)
    grid = (TOKENS, TOKENS)
    found = build_dense_map(photo, [grid], encoder.encode_patches, TOKENS, encoder.patch_size, 1)
    expected = F.normalize(encoder.encode_patches(photo.permute(2, 0, 1)[None])[0], dim=-1)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
