"""Ground truth in three layouts: masks and boxes are those that were labeled, and errors name the file."""

import json
import unicodedata

import numpy as np
import pytest
from label_sets import box_object, write_holyscenes, write_labels, write_plain
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, find_ground_truth, held_out_photos

BOX = box_object("dome", 1, 1, 9, 9)
MASK = np.zeros((40, 60), bool)
MASK[8:24, 16:48] = True


def test_the_same_object_in_every_layout_is_the_same_mask(tmp_path):
    write_holyscenes(tmp_path / "holyscenes", "dome", "0001", MASK, quality=95)
    write_plain(tmp_path / "plain", "dome", "0001", MASK)
    write_labels(tmp_path / "lerf_ovs", "0001", [box_object("dome", 16, 8, 47, 23)])
    for layout in ("holyscenes", "plain", "lerf_ovs"):
        truth = GroundTruth(tmp_path / layout)
        assert truth.layout == layout
        assert truth.categories == ["dome"]
        assert truth.photos("dome") == truth.labeled == ["0001"]
        assert truth.size("0001") == (40, 60)
        assert np.array_equal(truth.masks("0001.jpg", (40, 60))["dome"], MASK), layout
        assert np.array_equal(truth.masks("0001.jpg", (20, 30))["dome"], MASK[::2, ::2])
        assert GroundTruth(tmp_path / layout, layout).categories == ["dome"]


def test_photos_are_found_with_and_without_their_folders(tmp_path):
    write_plain(tmp_path, "dome", "left/0001", MASK)
    write_plain(tmp_path, "dome", "0002.v2", ~MASK)
    truth = GroundTruth(tmp_path)
    assert truth.key("left/0001.JPG") == "left/0001"
    assert truth.key("right/0001.JPG") is None
    assert truth.key("somewhere/0002.v2.png") == "0002.v2"
    assert truth.masks("0003.jpg", (40, 60)) == {}


def test_labels_in_another_form_of_letters_are_found_and_a_line_of_no_name_is_none(tmp_path):
    """As archives and disks of other systems write them."""
    for name in (unicodedata.normalize("NFD", "façade"), "0002", "IMG_3"):
        write_plain(tmp_path, "dome", name, MASK)
    truth = GroundTruth(tmp_path)
    assert truth.key(unicodedata.normalize("NFC", "façade.png")) == unicodedata.normalize("NFD", "façade")
    assert truth.key("a\\0002.JPG") == "0002" and truth.key("img_3.jpg") == "IMG_3"
    assert [truth.key(name) for name in (".", "..", "/", "")] == [None] * 4
    write_plain(tmp_path, "dome", "img_3", ~MASK)
    assert [GroundTruth(tmp_path).key(name) for name in ("img_3.jpg", "IMG_3.jpg")] == ["img_3", "IMG_3"]


def test_a_label_whose_name_has_a_dot_is_its_own(tmp_path):
    write_plain(tmp_path, "dome", "tower", MASK)
    write_plain(tmp_path, "dome", "tower.v2", ~MASK)
    truth = GroundTruth(tmp_path)
    assert [truth.key(name) for name in truth.labeled] == truth.labeled == ["tower", "tower.v2"]
    assert truth.key("a/tower.v2.jpg") == "tower.v2"
    assert np.array_equal(truth.masks("tower.v2", (40, 60))["dome"], ~MASK)
    assert held_out_photos(truth) == truth.labeled


@pytest.mark.parametrize("quality", [30, 75, 95])
def test_masks_survive_jpeg_and_belong_to_their_photo_and_category(tmp_path, quality):
    write_holyscenes(tmp_path, "domes", "0001", MASK, quality=quality)
    write_holyscenes(tmp_path, "windows", "0002", ~MASK)
    truth = GroundTruth(tmp_path)
    assert truth.categories == ["domes", "windows"] and truth.photos("domes") == ["0001"]
    assert list(truth.masks("0001.png", (40, 60))) == ["domes"]
    assert np.array_equal(truth.masks("folder/0001.JPG", (40, 60))["domes"], MASK)


def test_masks_are_scored_at_half_size_and_polygons_at_their_own(tmp_path):
    write_plain(tmp_path / "plain", "dome", "0001", MASK)
    write_labels(tmp_path / "labels", "0001", [BOX])
    assert GroundTruth(tmp_path / "plain").scoring_size(361, 480) == (180, 240)
    assert GroundTruth(tmp_path / "labels").scoring_size(361, 480) == (361, 480)


@pytest.mark.parametrize("size", [(60, 40), (40, 40)])
def test_a_photo_of_another_shape_is_refused_with_both_sizes(tmp_path, size):
    write_plain(tmp_path / "plain", "dome", "0001", MASK)
    write_labels(tmp_path / "labels", "0001", [BOX])
    for layout, name in (("plain", r"0001\.png"), ("labels", r"0001\.json")):
        with pytest.raises(UserError, match=rf"{name} has 60 × 40 pixels, .* {size[1]} × {size[0]}"):
            GroundTruth(tmp_path / layout).masks("0001", size)


def test_a_pixel_of_rounding_is_allowed(tmp_path):
    write_plain(tmp_path, "dome", "0001", np.ones((75, 97), bool))
    assert GroundTruth(tmp_path).masks("0001", (37, 48))["dome"].all()


def test_a_plain_folder_may_hold_its_photos(tmp_path):
    write_plain(tmp_path, "rose window", "0001", MASK)
    write_plain(tmp_path, "images", "0001", MASK)
    assert GroundTruth(tmp_path).categories == ["rose window"]


def two_layouts(folder):
    write_holyscenes(folder, "dome", "0001", MASK)
    write_labels(folder, "0001", [BOX])


def no_mask(folder):
    write_plain(folder, "dome", "0001", MASK)
    (folder / "tower").mkdir()


def zeros_and_ones(folder):
    (folder / "dome").mkdir(parents=True)
    Image.fromarray(MASK.astype(np.uint8)).save(folder / "dome" / "0001.png")


def twice(folder):
    write_plain(folder, "dome", "0001", MASK)
    (folder / "dome" / "0001.png").rename(folder / "dome" / "0001.tif")
    write_plain(folder, "dome", "0001", MASK)


def damaged(folder):
    write_holyscenes(folder, "dome", "0001", MASK)
    (folder / "dome" / "0001-gt.jpg").write_bytes(b"no picture")


def photo_alone(folder):
    for photo in ("0001", "0002"):
        write_holyscenes(folder, "dome", photo, MASK)
    (folder / "dome" / "0002-gt.jpg").unlink()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: None, "truth is not a folder"),
        (lambda folder: folder.mkdir(), "make a folder for each prompt"),
        (two_layouts, "name the layout"),
        (lambda folder: write_holyscenes(folder / "milano", "dome", "1", MASK), "milano"),
        (lambda folder: write_labels(folder / "teatime", "frame_1", [BOX]), "teatime"),
        (no_mask, "tower holds no mask"),
        (zeros_and_ones, "save 0 and 255"),
        (twice, "label the same photo"),
        (damaged, r"0001-gt\.jpg"),
        (photo_alone, r"no .*dome/0002-gt\.jpg"),
        (lambda folder: write_labels(folder, "0001", []), "contain no objects"),
    ],
)
def test_folders_that_are_no_ground_truth_are_told_in_a_sentence(tmp_path, make, message):
    make(tmp_path / "truth")
    with pytest.raises(UserError, match=message):
        GroundTruth(tmp_path / "truth").masks("0001", (40, 60))


def test_a_named_layout_is_read_where_two_are(tmp_path):
    two_layouts(tmp_path)
    assert GroundTruth(tmp_path, "lerf_ovs").layout == "lerf_ovs"
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"NNNN-gt\.jpg"):
        GroundTruth(tmp_path / "empty", "holyscenes")


# ── polygons of LERF-OVS ────────────────────────────────────────────────────────────────────────────────


def test_objects_of_one_category_make_one_mask_and_keep_their_boxes(tmp_path):
    corners = {"bear": [(2, 2, 9, 9), (20, 20, 29, 29)], "mug": [(30, 5, 39, 9)]}
    objects = [box_object(category, *box) for category, boxes in corners.items() for box in boxes]
    write_labels(tmp_path, "frame_00001", objects)
    write_labels(tmp_path, "frame_00002", [box_object("mug", 0, 0, 59, 39)])
    truth = GroundTruth(tmp_path)
    assert truth.categories == ["bear", "mug"]
    assert truth.photos("bear") == ["frame_00001"]
    bear = truth.truths("frame_00001.jpg", (40, 60))["bear"]
    expected = np.zeros((40, 60), bool)
    expected[2:10, 2:10] = expected[20:30, 20:30] = True
    assert np.array_equal(bear.mask, expected)
    assert bear.boxes.tolist() == [[2, 2, 9, 9], [20, 20, 29, 29]]
    assert truth.masks("frame_00002", (40, 60))["mug"].all()


def test_boxes_follow_the_size_of_the_map(tmp_path):
    write_labels(tmp_path, "0001", [box_object("bear", 20, 10, 40, 30)])
    half = GroundTruth(tmp_path).truths("0001", (20, 30))["bear"]
    assert half.boxes.tolist() == [[10, 5, 20, 15]]
    assert 100 <= half.mask.sum() <= 121


def test_an_outline_may_exceed_the_edge_slightly(tmp_path):
    write_labels(tmp_path, "0001", [box_object("bear", -1, -0.5, 60.5, 40.5)])
    assert GroundTruth(tmp_path).masks("0001", (40, 60))["bear"].all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"segmentation": [[1, 1], [9, 1], [9, 400]]}, r"'dome' reaches \(9, 400\), outside the photo"),
        ({"bbox": [1, 1, 900, 9]}, r"reaches \(900, 9\), outside"),
        ({"bbox": [9, 1, 1, 9]}, "is not .left, top, right, bottom"),
        ({"bbox": [1, 1, 9]}, "can't be used"),
        ({"bbox": None}, "can't be used"),
        ({"segmentation": [[1, 1], [9, 1]]}, "has 2 points"),
        ({"segmentation": [[1, 1, 1], [9, 1, 1], [2, 2, 2]]}, "can't be used"),
        ({"segmentation": [[1, "1"], [9, 1], [2, 2]]}, "'1'.* is not a coordinate"),
        ({"segmentation": [[1, float("nan")], [9, 1], [2, 2]]}, "nan.* is not a coordinate"),
        ({"bbox": [1, 1, 10**400, 9]}, "is not a coordinate"),
        ({"segmentation": [[1, True], [9, 1], [2, 2]]}, "True.* is not a coordinate"),
        ({"segmentation": None}, "can't be used"),
        *(({"category": name}, "not a plain name") for name in ("", "../../etc", " .. ", "a\\b")),
        ({"category": 7}, "can't be used"),
    ],
)
def test_an_invalid_object_is_refused_with_the_file(tmp_path, change, message):
    write_labels(tmp_path, "0001", [BOX | change])
    with pytest.raises(UserError, match=message) as error:
        GroundTruth(tmp_path)
    assert "0001.json" in str(error.value)


@pytest.mark.parametrize(
    "info", [{"width": 0}, {"width": 60.5}, {"height": "40"}, {"height": True}, {"height": 10**9}]
)
def test_sizes_in_labels_are_validated(tmp_path, info):
    write_labels(tmp_path, "0001", [BOX], **info)
    with pytest.raises(UserError, match=r"0001\.json can't be used \(a photo of"):
        GroundTruth(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"7", b"null", b'{"info": {}}', b'{"objects": []}', b"[" * 100_000, b"\xff\xfe{",
     json.dumps({"info": {"width": 6, "height": 4}, "objects": ["bear", None]}).encode()],
)  # fmt: skip
def test_a_file_that_is_not_a_label_is_named(tmp_path, content):
    (tmp_path / "0001.json").write_bytes(content)
    with pytest.raises(UserError, match=r"0001\.json"):
        GroundTruth(tmp_path)


# ── ground truth beside a scene, and held-out photos ────────────────────────────────────────────────────


def test_ground_truth_is_found_where_benchmarks_have_it(tmp_path):
    data = tmp_path / "teatime"
    data.mkdir()
    assert find_ground_truth(data) is None
    write_labels(tmp_path / "label" / "teatime", "0001", [BOX])
    assert find_ground_truth(data) == tmp_path / "label" / "teatime"
    write_labels(data / "label", "0001", [BOX])
    assert find_ground_truth(data) == data / "label"
    (data / "ground_truth").mkdir()
    assert find_ground_truth(data) == data / "ground_truth"


def test_held_out_photos_are_shared_between_categories_sorted_and_show_something(tmp_path):
    for i in range(20):
        write_plain(tmp_path, "dome", f"{i:04d}", MASK)
    for i in range(10, 20):
        write_plain(tmp_path, "tower", f"{i:04d}", MASK if i >= 14 else np.zeros_like(MASK))
    truth = GroundTruth(tmp_path)
    assert held_out_photos(truth) == ["0002", "0006", "0010", "0014", "0015", "0017", "0018", "0019"]
    assert held_out_photos(truth, 1) == ["0010", "0017"]
    assert held_out_photos(truth, 100) == truth.labeled
