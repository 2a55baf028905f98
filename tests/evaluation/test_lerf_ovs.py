"""Ground truth of LERF-OVS: polygons and boxes in JSON, and errors that name the file."""

import json

import numpy as np
import pytest
from label_sets import box_object, write_labels

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth


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


def broken(**changes):
    return box_object("bear", 1, 1, 9, 9) | changes


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (broken(segmentation=[[1, 1], [9, 1], [9, 400]]), r"'bear' reaches \(9, 400\), outside the photo"),
        (broken(bbox=[1, 1, 900, 9]), r"reaches \(900, 9\), outside"),
        (broken(bbox=[9, 1, 1, 9]), "is not .left, top, right, bottom"),
        (broken(bbox=[1, 1, 9]), "can't be used"),
        (broken(segmentation=[[1, 1], [9, 1]]), "has 2 points"),
        (broken(segmentation=[[1, 1, 1], [9, 1, 1], [2, 2, 2]]), "can't be used"),
        (broken(segmentation=[[1, "1"], [9, 1], [2, 2]]), "'1' is not a coordinate"),
        (broken(segmentation=[[1, float("nan")], [9, 1], [2, 2]]), "nan is not a coordinate"),
        (broken(bbox=[1, 1, 10**400, 9]), "is not a coordinate"),
        (broken(segmentation=[[1, True], [9, 1], [2, 2]]), "True is not a coordinate"),
        (broken(category=""), "not a plain name"),
        (broken(category=7), "not a plain name"),
        (broken(category="../../etc"), "not a plain name"),
        (broken(category=" .. "), "not a plain name"),
        ({"category": "bear", "bbox": [1, 1, 9, 9]}, "have no 'segmentation'"),
        ({"bbox": [1, 1, 9, 9], "segmentation": []}, "have no 'category'"),
        ("bear", "can't be used"),
        (None, "can't be used"),
    ],
)
def test_an_invalid_object_is_refused_with_the_file(tmp_path, item, message):
    write_labels(tmp_path, "0001", [item])
    with pytest.raises(UserError, match=message) as error:
        GroundTruth(tmp_path)
    assert "0001.json" in str(error.value)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"name": "../../0001.jpg"}, "not a plain name"),
        ({"name": "/etc/passwd"}, "not a plain name"),
        ({"name": "..\\0001.jpg"}, "not a plain name"),
        ({"name": None}, "not a plain name"),
        ({"width": 0}, "a side of 0 pixels"),
        ({"width": 60.5}, "a side of 60.5 pixels"),
        ({"height": "40"}, "a side of '40' pixels"),
        ({"height": 10**9}, "too large"),
    ],
)
def test_photo_names_and_sizes_in_labels_are_validated(tmp_path, info, message):
    write_labels(tmp_path, "0001", [box_object("bear", 1, 1, 9, 9)], **info)
    with pytest.raises(UserError, match=message):
        GroundTruth(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", "null", '{"info": {}}', '{"objects": []}', "[" * 100_000]
)
def test_a_file_that_is_not_a_label_is_named(tmp_path, text):
    (tmp_path / "0001.json").write_text(text)
    with pytest.raises(UserError, match=r"0001\.json"):
        GroundTruth(tmp_path)


def test_bytes_that_are_not_text_are_named(tmp_path):
    (tmp_path / "0001.json").write_bytes(b"\xff\xfe{")
    with pytest.raises(UserError, match=r"0001\.json"):
        GroundTruth(tmp_path)


def test_labels_without_any_object_are_refused(tmp_path):
    path = write_labels(tmp_path, "0001", [])
    assert json.loads(path.read_text())["objects"] == []
    with pytest.raises(UserError, match="contain no objects"):
        GroundTruth(tmp_path)
