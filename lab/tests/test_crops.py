"""Soft labels of crops, and cutting that keeps picture and labels together."""

import numpy as np
import pytest
import torch

from lab.clip_training.captions import CLASS, CLASSES
from lab.clip_training.crops import (
    OUTSIDE,
    SAMPLES,
    Crops,
    augment,
    cut,
    draw_crops,
    draw_windows,
    main_materials,
    patch_labels,
    soft_labels,
)
from lab.clip_training.views import LandmarkViews
from lab.landmark.labels import ELEMENT, PART
from lab.landmark.materials import MATERIALS

TOWER, WALL, SKY, DOME = PART["tower"], PART["wall"], PART["sky"], PART["dome"]


def crops_of(parts, elements=None, materials=None):
    """Crops made from sample labels alone."""
    parts = np.asarray(parts, np.uint8)
    zeros = np.zeros_like(parts)
    images = torch.zeros(len(parts), 3, 48, 48, dtype=torch.uint8)
    return Crops(
        images,
        parts,
        zeros if elements is None else np.asarray(elements, np.uint8),
        zeros if materials is None else np.asarray(materials, np.uint8),
        np.zeros(len(parts), int),
    )


def filled(value, columns=slice(None), other=0):
    grid = np.full((1, SAMPLES, SAMPLES), other)
    grid[:, :, columns] = value
    return grid


@pytest.fixture(scope="module")
def view():
    """A view whose left half is a red dome and whose right half is a wall with a window."""
    planes = np.zeros((6, 360, 480), np.uint8)
    planes[0, :, :240], planes[1, :, 240:] = 200, 100
    planes[3, :, :240], planes[3, :, 240:] = DOME, WALL
    planes[4, 100:200, 300:400] = ELEMENT["window"]
    planes[5] = MATERIALS.index("marble")
    return planes


def test_shares_sum_to_one_whatever_a_crop_shows(view):
    landmark = LandmarkViews(0, 1, view[None])
    shares = soft_labels(draw_crops([landmark], 40, 4, 16, np.random.default_rng(0)))
    np.testing.assert_allclose(shares.sum(1), 1)
    assert (shares >= 0).all()


def test_a_crop_of_one_class_has_only_that_class():
    shares = soft_labels(crops_of(filled(DOME)))
    assert shares[0, CLASS["dome"]] == 1


def test_shares_follow_the_area():
    middle = SAMPLES // 2
    growing = [
        soft_labels(crops_of(filled(DOME, slice(0, middle + d), WALL)))[0, CLASS["dome"]] for d in (-4, 0, 4)
    ]
    assert growing == sorted(growing)
    assert growing[0] < growing[1] < growing[2]


def test_the_center_counts_more_than_the_border():
    central = filled(WALL)
    central[:, 6:18, 6:18] = DOME
    border = filled(DOME)
    border[:, 6:18, 6:18] = WALL
    assert soft_labels(crops_of(central))[0, CLASS["dome"]] > soft_labels(crops_of(border))[0, CLASS["dome"]]


def test_samples_outside_the_view_count_nothing():
    shares = soft_labels(crops_of(filled(OUTSIDE, slice(0, 10), DOME)))
    assert shares[0, CLASS["dome"]] == 1


def test_a_window_counts_for_its_tower_but_not_for_its_wall():
    window = filled(ELEMENT["window"])
    tower, wall = (soft_labels(crops_of(filled(part), window))[0] for part in (TOWER, WALL))
    assert tower[CLASS["window"]] > tower[CLASS["tower"]] > 0.01
    assert wall[CLASS["window"]] == 1


def test_sky_weighs_less_than_a_dome_of_the_same_area():
    shares = soft_labels(crops_of(filled(DOME, slice(0, SAMPLES // 2), SKY)))[0]
    assert shares[CLASS["dome"]] > 2 * shares[CLASS["sky"]]


def test_patches_have_plain_area_shares_in_reading_order():
    parts = filled(WALL)
    parts[:, : SAMPLES // 4, -SAMPLES // 4 :] = DOME
    parts[:, -SAMPLES // 4 :, : SAMPLES // 4] = OUTSIDE
    shares = patch_labels(crops_of(parts), 4)
    assert shares.shape == (1, 16, len(CLASSES))
    assert shares[0, 3, CLASS["dome"]] == 1
    assert shares[0, :, CLASS["dome"]].sum() == 1
    assert shares[0, 12].sum() == 0


def test_the_main_material_of_a_class_is_the_most_frequent_one():
    materials = filled(3, slice(0, 10), 5)
    found = main_materials(crops_of(filled(DOME), materials=materials))
    assert found[0, CLASS["dome"]] == 5
    assert found[0, CLASS["wall"]] == -1


@pytest.mark.parametrize("corner", [(10, 10), (-20, 100), (330, 440), (-10, -30)])
def test_a_crop_is_black_exactly_where_it_leaves_the_view(view, corner):
    image, (parts, _, _) = cut(np.maximum(view, 1), corner, 48, SAMPLES)
    outside = parts == OUTSIDE
    rows = corner[0] + 2 * np.arange(SAMPLES)[:, None] + 1
    columns = corner[1] + 2 * np.arange(SAMPLES) + 1
    np.testing.assert_array_equal(outside, (rows < 0) | (rows >= 360) | (columns < 0) | (columns >= 480))
    assert (image[:, torch.from_numpy(outside)].float().mean() < 5) or not outside.any()


def test_mirrored_crops_keep_their_labels(view):
    crops = draw_crops([LandmarkViews(0, 1, view[None])], 64, 4, SAMPLES, np.random.default_rng(2))
    red = crops.images[:, 0].numpy() > 150
    dome = (crops.parts == DOME) & crops.inside
    assert (red == dome).mean() > 0.95
    assert (crops.families == 1).all()


def test_windows_leave_the_view_in_part_and_see_every_class(view):
    windows = draw_windows(view, 400, np.random.default_rng(0))
    assert any(y < 0 or x < 0 for (y, x), _ in windows)
    assert min(side for _, side in windows) < 32
    assert max(side for _, side in windows) > 250
    centers = [(y + side // 2, x + side // 2) for (y, x), side in windows]
    assert (
        np.mean([100 <= y < 200 and 300 <= x < 400 for y, x in centers]) > 0.15
    )  # a window is 6 % of the view


def test_augmented_crops_differ_and_stay_black_outside():
    images = torch.randint(0, 256, (4, 3, 48, 48), dtype=torch.uint8)
    inside = torch.ones(4, SAMPLES, SAMPLES, dtype=torch.bool)
    inside[:, :12] = False
    augmented = augment(images, inside, torch.Generator().manual_seed(0))
    assert augmented.min() >= 0
    assert augmented.max() <= 1
    assert (augmented[:, :, :24] == 0).all()
    assert (augmented[:, :, 24:] - images[:, :, 24:] / 255).abs().mean() > 0.02
