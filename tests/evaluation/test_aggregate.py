"""Averages over photos, categories and scenes, with values worked out by hand."""

import itertools

import pytest

from lang3dxl_ns.evaluation.aggregate import average, pool, pooled_table, scene_table

PHOTOS = [
    {"psnr": 20.0, "ap_domes": 0.2, "iou_domes": 0.1, "located_domes": 1.0},
    {"psnr": 24.0, "ap_domes": 0.4, "iou_domes": 0.3, "located_domes": 0.0,
     "ap_windows": 0.9, "iou_windows": 0.8, "located_windows": 1.0},
    {"psnr": 22.0},
]  # fmt: skip


def test_average_precision_is_averaged_over_categories_and_all_else_over_pairs():
    results = average(PHOTOS)
    assert results["psnr"] == 22
    assert results["ap_domes"] == pytest.approx(0.3)
    assert results["map"] == pytest.approx((0.3 + 0.9) / 2)
    assert results["miou"] == pytest.approx((0.1 + 0.3 + 0.8) / 3)
    assert results["localization_accuracy"] == pytest.approx(2 / 3)
    assert (results["ap_domes_photos"], results["ap_windows_photos"]) == (2, 1)
    assert "teacher_map" not in results


def test_deviations_are_of_the_sample():
    results = average(PHOTOS, with_deviation=True)
    assert results["psnr_std"] == pytest.approx(2)
    assert results["ap_windows_std"] == 0
    assert "map_std" not in results


def test_prefixes_are_kept_apart():
    photos = [{"ap_domes": 0.5, "raw_ap_domes": 0.4, "teacher_ap_domes": 0.3, "teacher_iou_domes": 0.2}]
    results = average(photos)
    assert (results["map"], results["raw_map"], results["teacher_map"]) == (0.5, 0.4, 0.3)
    assert results["teacher_miou"] == 0.2 and "miou" not in results


def test_the_order_of_photos_changes_nothing():
    expected = average(PHOTOS, with_deviation=True)
    for photos in itertools.permutations(PHOTOS):
        assert average(photos, with_deviation=True) == pytest.approx(expected)


def test_pooled_images_and_means_of_scenes_differ_as_by_hand():
    """Milano has three photos of portals, St Paul's one: pooled (3 × 0.4 + 0.0) / 4, by scenes 0.2."""
    milano = [{"ap_portals": 0.4}] * 3
    st_paul = [{"ap_portals": 0.0, "ap_towers": 0.5}]
    pooled = pool({"milano": milano, "st_paul": st_paul})
    assert pooled["image_pooled"]["ap_portals"] == pytest.approx(0.3)
    assert pooled["image_pooled"]["map"] == pytest.approx(0.4)
    assert pooled["scene_mean"]["ap_portals"] == pytest.approx(0.2)
    assert pooled["scene_mean"]["map"] == pytest.approx(0.35)  # over categories, not over the scenes' mAPs
    assert pooled["per_scene"]["st_paul"]["map"] == pytest.approx(0.25)


def test_a_category_may_be_called_as_a_count_is():
    photos = [{"ap_framed_photos": 0.5, "ap_domes": 0.9}, {"ap_framed_photos": 0.7, "ap_domes": 0.8}]
    results = average(photos, with_deviation=True) | {"protocol": {}}
    table = scene_table("scene", results)
    assert "| framed_photos | 2 | 0.600" in table and "| framed |" not in table
    pooled = pool({"one": photos, "two": photos[:1]})
    assert pooled["scene_mean"]["map"] == pytest.approx((0.55 + 0.875) / 2)
    assert "| framed_photos | 3 |" in pooled_table(pooled)
