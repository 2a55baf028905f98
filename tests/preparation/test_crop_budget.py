"""Laws of the crop budget: bounded numbers, no crop that an encoder can't use, small photos as ever."""

import math

import pytest

from lang3dxl_ns.preparation.model_files import BUILTIN, CLIP_OPTION, find_model, read_config
from lang3dxl_ns.preparation.physical_scale import crop_sides, fine_crops
from lang3dxl_ns.preparation.pyramid import HALF, MOST_CROPS, THIRD, choose_crops, crop_centers

PACKAGED_CLIP = find_model(BUILTIN, CLIP_OPTION)
SCALES = [0.05, 0.07, 0.1, 0.14, 0.2]  # of a photo's width


def chosen(size, is_fine=True, input_pixels=224, quality="normal", scales=SCALES):
    return choose_crops(scales, 1 / size[0], size, is_fine, input_pixels, quality)


def counted(crops, size):
    """Number of crops, counted one by one."""
    steps = [crops.steps, *[HALF] * (len(crops.sides) - 1)]
    return sum(
        math.prod(len(crop_centers(length, side, step)) for length in size)
        for side, step in zip(crops.sides, steps, strict=True)
    )


@pytest.mark.parametrize("size", [(1600, 1200), (1200, 1600), (1600, 300), (480, 360), (300, 1600)])
@pytest.mark.parametrize("is_fine", [True, False])
@pytest.mark.parametrize("input_pixels", [48, 224, 336])
def test_a_quality_bounds_the_pixels_that_an_encoder_sees(size, is_fine, input_pixels):
    counts = []
    for quality in ("fast", "normal", "fine"):
        for scales in (SCALES, [1e-4, 2e-4]):
            crops = chosen(size, is_fine, input_pixels, quality, scales)
            most = MOST_CROPS[quality] * (224 / input_pixels) ** 2
            assert crops.count(size[1], size[0]) == counted(crops, size) <= most
            if quality != "fine":
                assert crops.sides[0] >= min(input_pixels / 4, 0.7 * size[0] - 1)
        counts.append(chosen(size, is_fine, input_pixels, quality).count(size[1], size[0]))
    assert counts == sorted(counts)


@pytest.mark.parametrize("size", [(480, 360), (360, 480), (320, 240), (200, 150)])
@pytest.mark.parametrize("scale", [0.02, 0.05, 0.067, 0.1])
def test_the_small_encoder_sees_the_demos_photos_as_without_a_budget(size, scale):
    side = read_config(PACKAGED_CLIP).vision_config.image_size
    fine = chosen(size, True, side, "normal", [scale, 2 * scale])
    sides = crop_sides([scale, 2 * scale], 1 / size[0], size[0])
    assert fine.sides == fine_crops(sides[0]) and fine.steps == THIRD
    pyramid = chosen(size, False, side, "normal", [scale, 2 * scale])
    assert pyramid.sides == sides
