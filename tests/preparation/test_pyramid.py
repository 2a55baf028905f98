import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from lang3dxl_ns.preparation.pyramid import build_clip_target, crop_centers, iterate_crops, valid_fractions


def cut_crops(photo, side, size, steps=2):
    """All crops of one scale, and the fraction of each that lies inside the photo."""
    valid = valid_fractions(*photo.shape[:2], side, steps)
    return next(iterate_crops(photo, side, size, valid.numel(), steps)), valid


def mean_color(crops):
    return crops.mean(dim=(2, 3))


def random_photo(height, width, seed=0):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("side", "count"), [(32, 62), (100, 20), (1000, 2)])
def test_grid_counts_are_the_published_ones(side, count):
    assert len(crop_centers(1000, side)) == count


@pytest.mark.parametrize("steps", [2, 4])
@pytest.mark.parametrize("length", [5, 31, 97, 532, 708, 1000])
@pytest.mark.parametrize("side", [2, 3, 32, 33, 64, 101, 700])
def test_centers_are_the_middles_of_equal_cells_a_part_of_a_crop_apart(length, side, steps):
    centers = crop_centers(length, side, steps)
    cells = (torch.arange(len(centers)) + 0.5) * length / len(centers)
    assert (centers - cells).abs().max() <= 0.5
    step = max(2 * (side // 2) // steps, 1)
    if length >= step:
        assert step <= length / len(centers) < 2 * step


def test_a_side_below_two_pixels_is_refused():
    with pytest.raises(ValueError, match="at least 2 pixels"):
        crop_centers(100, 1)


@pytest.mark.parametrize("side", [32, 45])
def test_the_middle_of_a_crop_is_its_center(side):
    photo, half = random_photo(83, 120), side // 2
    crops, valid = cut_crops(photo, side, 2 * half)
    ys, xs = crop_centers(83, side), crop_centers(120, side)
    assert valid.shape == (len(ys), len(xs))
    for crop, y, x in zip(crops, ys.repeat_interleave(len(xs)), xs.repeat(len(ys)), strict=True):
        assert torch.equal(crop[:, half, half], photo[y, x])


@pytest.mark.parametrize(("height", "width", "side"), [(83, 120, 32), (60, 200, 130), (10, 300, 64)])
def test_crops_are_black_outside_and_the_valid_fraction_is_what_is_not(height, width, side):
    white = torch.ones(height, width, 3)
    crops, valid = cut_crops(white, side, 2 * (side // 2))
    assert set(crops.unique().tolist()) <= {0.0, 1.0}
    assert torch.allclose(mean_color(crops)[:, 0].view_as(valid), valid)
    assert torch.equal(valid_fractions(height, width, side), valid)
    assert valid.min() < 1


@pytest.mark.parametrize("batch_size", [1, 7, 1000])
def test_batches_are_bounded_and_hold_the_same_crops_in_the_same_order(batch_size):
    photo = random_photo(83, 120)
    batches = list(iterate_crops(photo, 40, 24, batch_size))
    assert max(len(batch) for batch in batches) <= batch_size
    assert torch.allclose(torch.cat(batches), cut_crops(photo, 40, 24)[0], atol=1e-6)


def test_resized_crops_match_pillows_bicubic():
    photo = (64 + random_photo(128, 128) * 127).round() / 255  # Pillow clips between its axes: no overshoot
    for side, size in ((96, 32), (32, 64)):
        crops, valid = cut_crops(photo, side, size)
        index = int(valid.flatten().argmax())
        rows, columns = crop_centers(128, side), crop_centers(128, side)
        y, x, half = int(rows[index // len(columns)]), int(columns[index % len(columns)]), side // 2
        pixels = F.pad(photo, (0, 0, half, half, half, half))[y : y + side, x : x + side]
        image = Image.fromarray((pixels * 255).round().byte().numpy()).resize(
            (size, size), Image.Resampling.BICUBIC
        )
        difference = crops[index].permute(1, 2, 0) * 255 - torch.from_numpy(np.array(image)).float()
        assert difference.abs().max() < 1.6  # Pillow rounds to 8 bits after each axis


def test_crops_stay_in_the_photos_range_and_type():
    photo = (random_photo(90, 90) > 0.5).double()
    crops, _ = cut_crops(photo, 32, 77)
    assert crops.dtype == torch.float64
    assert 0 <= crops.min() <= crops.max() <= 1


def slow_target(photo, sides, encode, size):
    """Crop by crop and cell by cell."""
    height, width = photo.shape[:2]
    grids = []
    for side in sides:
        half = side // 2
        ys, xs = crop_centers(height, side).tolist(), crop_centers(width, side).tolist()
        grid = np.zeros((len(ys), len(xs), 4))
        for i, y in enumerate(ys):
            for j, x in enumerate(xs):
                canvas, inside = torch.zeros(2 * half, 2 * half, 3), torch.zeros(2 * half, 2 * half)
                y0, y1, x0, x1 = (
                    max(0, y - half),
                    min(height, y + half),
                    max(0, x - half),
                    min(width, x + half),
                )
                window = slice(y0 - y + half, y1 - y + half), slice(x0 - x + half, x1 - x + half)
                canvas[window], inside[window] = photo[y0:y1, x0:x1], 1
                crop = F.interpolate(
                    canvas.permute(2, 0, 1)[None], (size, size), mode="bicubic", antialias=True
                )
                grid[i, j] = [*encode(crop.clamp(0, 1))[0].tolist(), inside.mean()]
        grids.append(grid)
    rows, columns = grids[int(np.argmin(sides))].shape[:2]
    target = np.zeros((rows, columns, 4))
    for i in range(rows):
        for j in range(columns):
            for grid in grids:
                y = np.clip((i + 0.5) / rows * grid.shape[0] - 0.5, 0, grid.shape[0] - 1)
                x = np.clip((j + 0.5) / columns * grid.shape[1] - 0.5, 0, grid.shape[1] - 1)
                y0, x0 = int(y), int(x)
                y1, x1 = min(y0 + 1, grid.shape[0] - 1), min(x0 + 1, grid.shape[1] - 1)
                top = grid[y0, x0] * (1 - x + x0) + grid[y0, x1] * (x - x0)
                bottom = grid[y1, x0] * (1 - x + x0) + grid[y1, x1] * (x - x0)
                target[i, j] += (top * (1 - y + y0) + bottom * (y - y0)) / len(grids)
    return torch.from_numpy(target).float()


@pytest.mark.parametrize("sides", [[32, 60, 110], [110, 33]])
def test_the_target_equals_the_slow_loop(sides):
    photo = random_photo(70, 110)
    target = build_clip_target(photo, sides, mean_color, 24, batch_size=5)
    expected = slow_target(photo, sides, mean_color, 24)
    assert target.features.dtype == torch.float32
    assert torch.allclose(target.features, expected[..., :3], atol=1e-5)
    assert torch.allclose(target.valid, expected[..., 3], atol=1e-6)


def test_a_finer_grid_has_the_coarse_ones_crops_between_its_own():
    """The same picture of a ramp, four times as many cells, each at its place."""
    height, width = 128, 192
    ramp = ((torch.arange(width) + 0.5) / width).expand(height, width)[..., None].expand(-1, -1, 3)
    target = build_clip_target(ramp, [32], mean_color, 32, batch_size=64, steps=4)
    rows, columns = target.features.shape[:2]
    assert (rows, columns) == (16, 24)
    expected = (torch.arange(columns) + 0.5) / columns
    assert torch.allclose(target.features[rows // 2, 2:-2, 0], expected[2:-2], atol=3e-3)


def test_the_encoder_never_sees_more_than_a_batch_and_needs_no_gradient():
    seen = []

    def encode(crops):
        seen.append(len(crops))
        return mean_color(crops)

    photo = random_photo(100, 100).requires_grad_()
    target = build_clip_target(photo, [32, 50], encode, 16, batch_size=9)
    assert max(seen) == 9
    assert not target.features.requires_grad


def test_a_crop_that_is_shrunk_a_hundredfold_is_averaged_and_not_refused():
    """CUDA's resize refuses it."""
    photo = torch.linspace(0.1, 0.9, 1440)[:, None, None].expand(1440, 1440, 3)
    (crops,), centers = iterate_crops(photo, 480, 4, 99), crop_centers(1440, 480)
    k, middle = len(centers) // 2, int(centers[len(centers) // 2])
    seen = photo[middle - 240 : middle + 240, :480].permute(2, 0, 1)
    expected = F.interpolate(seen[None], (4, 4), mode="area")[0]
    torch.testing.assert_close(crops[k * len(centers) + k], expected, atol=0.02, rtol=0)
