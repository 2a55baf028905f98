"""Ground truth in three layouts: detection, and errors that name the file."""

import numpy as np
import pytest
from label_sets import box_object, write_holyscenes, write_labels, write_plain

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import (
    GroundTruth,
    find_ground_truth,
    held_out_photos,
    scoring_size,
)


@pytest.fixture
def mask():
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    return mask


def test_the_same_object_in_every_layout_is_the_same_mask(tmp_path, mask):
    write_holyscenes(tmp_path / "holyscenes", "dome", "0001", mask, quality=95)
    write_plain(tmp_path / "plain", "dome", "0001", mask)
    write_labels(tmp_path / "lerf_ovs", "0001", [box_object("dome", 16, 8, 47, 23)])
    for layout in ("holyscenes", "plain", "lerf_ovs"):
        truth = GroundTruth(tmp_path / layout)
        assert truth.layout == layout
        assert truth.categories == ["dome"]
        assert truth.photos("dome") == truth.labeled == ["0001"]
        assert truth.size("0001") == (40, 60)
        assert np.array_equal(truth.masks("0001.jpg", (40, 60))["dome"], mask), layout
        assert GroundTruth(tmp_path / layout, layout).categories == ["dome"]


def test_photos_are_found_with_and_without_their_folders(tmp_path, mask):
    write_plain(tmp_path, "dome", "left/0001", mask)
    write_plain(tmp_path, "dome", "0002.v2", ~mask)
    truth = GroundTruth(tmp_path)
    assert truth.key("left/0001.JPG") == "left/0001"
    assert truth.key("right/0001.JPG") is None
    assert truth.key("somewhere/0002.v2.png") == "0002.v2"
    assert truth.masks("0003.jpg", (40, 60)) == {}


def test_masks_are_scored_at_half_size_and_polygons_at_their_own(tmp_path, mask):
    write_plain(tmp_path / "plain", "dome", "0001", mask)
    write_labels(tmp_path / "labels", "0001", [box_object("dome", 1, 1, 9, 9)])
    assert GroundTruth(tmp_path / "plain").scoring_size(361, 480) == (180, 240) == scoring_size(361, 480)
    assert GroundTruth(tmp_path / "labels").scoring_size(361, 480) == (361, 480)


@pytest.mark.parametrize("size", [(60, 40), (40, 40)])
def test_a_photo_of_another_shape_is_refused_with_both_sizes(tmp_path, mask, size):
    write_plain(tmp_path / "plain", "dome", "0001", mask)
    write_labels(tmp_path / "labels", "0001", [box_object("dome", 1, 1, 9, 9)])
    for layout, name in (("plain", r"0001\.png"), ("labels", r"0001\.json")):
        with pytest.raises(UserError, match=rf"{name} has 60 × 40 pixels, .* {size[1]} × {size[0]}"):
            GroundTruth(tmp_path / layout).masks("0001", size)


def test_a_pixel_of_rounding_is_allowed(tmp_path):
    write_plain(tmp_path, "dome", "0001", np.ones((75, 97), bool))
    assert GroundTruth(tmp_path).masks("0001", (37, 48))["dome"].all()


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere is not a folder"):
        GroundTruth(tmp_path / "nowhere")


def test_an_empty_folder_says_what_is_expected(tmp_path):
    with pytest.raises(UserError, match="make a folder for each prompt"):
        GroundTruth(tmp_path)


def test_two_layouts_in_one_folder_are_an_error(tmp_path, mask):
    write_holyscenes(tmp_path, "dome", "0001", mask)
    write_labels(tmp_path, "0001", [box_object("dome", 1, 1, 9, 9)])
    with pytest.raises(UserError, match="name the layout"):
        GroundTruth(tmp_path)
    assert GroundTruth(tmp_path, "lerf_ovs").layout == "lerf_ovs"


def test_one_folder_too_high_names_the_scenes_folder(tmp_path, mask):
    write_holyscenes(tmp_path / "all" / "cathedral" / "milano", "dome", "0001", mask)
    with pytest.raises(UserError, match="cathedral"):
        GroundTruth(tmp_path / "all" / "cathedral")
    write_labels(tmp_path / "label" / "teatime", "frame_00001", [box_object("dome", 1, 1, 9, 9)])
    with pytest.raises(UserError, match="teatime"):
        GroundTruth(tmp_path / "label")


# ── plain masks ─────────────────────────────────────────────────────────────────────────────────────────


def test_a_plain_folder_may_hold_its_photos(tmp_path, mask):
    write_plain(tmp_path, "rose window", "0001", mask)
    write_plain(tmp_path, "images", "0001", mask)
    assert GroundTruth(tmp_path).categories == ["rose window"]


def test_a_prompt_without_any_mask_is_named(tmp_path, mask):
    write_plain(tmp_path, "dome", "0001", mask)
    (tmp_path / "tower").mkdir()
    with pytest.raises(UserError, match="tower holds no mask"):
        GroundTruth(tmp_path)


def test_a_mask_of_zeros_and_ones_is_not_taken_for_an_empty_one(tmp_path, mask):
    from PIL import Image

    (tmp_path / "dome").mkdir()
    Image.fromarray(mask.astype(np.uint8)).save(tmp_path / "dome" / "0001.png")
    with pytest.raises(UserError, match="save 0 and 255"):
        GroundTruth(tmp_path).masks("0001", (40, 60))


def test_two_masks_of_one_photo_are_refused(tmp_path, mask):
    write_plain(tmp_path, "dome", "0001", mask)
    (tmp_path / "dome" / "0001.png").rename(tmp_path / "dome" / "0001.tif")
    write_plain(tmp_path, "dome", "0001", mask)
    with pytest.raises(UserError, match="label the same photo"):
        GroundTruth(tmp_path)


# ── ground truth beside a scene, and held-out photos ────────────────────────────────────────────────────


def test_ground_truth_is_found_where_benchmarks_have_it(tmp_path):
    data = tmp_path / "teatime"
    data.mkdir()
    assert find_ground_truth(data) is None
    write_labels(tmp_path / "label" / "teatime", "0001", [box_object("dome", 1, 1, 9, 9)])
    assert find_ground_truth(data) == tmp_path / "label" / "teatime"
    write_labels(data / "label", "0001", [box_object("dome", 1, 1, 9, 9)])
    assert find_ground_truth(data) == data / "label"
    (data / "ground_truth").mkdir()
    assert find_ground_truth(data) == data / "ground_truth"


def test_held_out_photos_are_shared_between_categories_sorted_and_show_something(tmp_path, mask):
    for i in range(20):
        write_plain(tmp_path, "dome", f"{i:04d}", mask)
    for i in range(10, 20):
        write_plain(tmp_path, "tower", f"{i:04d}", mask if i >= 14 else np.zeros_like(mask))
    truth = GroundTruth(tmp_path)
    assert held_out_photos(truth) == ["0002", "0006", "0010", "0014", "0015", "0017", "0018", "0019"]
    assert held_out_photos(truth, 1) == ["0010", "0017"]
    assert held_out_photos(truth, 100) == truth.labeled
