"""Scores of things against COCO instances."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from painted_scene import painted_file, painted_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.score_things import score_things
from lang3dxl_ns.things.write import coco


def test_own_boxes_score_full_marks_in_any_size_and_each_is_found_once(tmp_path):
    scene, file = painted_scene(), tmp_path / "labels.json"
    content = coco(scene, scene.things("windows"))
    file.write_text(json.dumps(content))
    count = len(content["annotations"])
    assert count > 2
    assert score_things(scene, file) == [("windows", count, count, 0, 1.0)]
    for image in content["images"]:  # labeled in photos of twice the size
        image["width"], image["height"] = 2 * image["width"], 2 * image["height"]
    for label in content["annotations"]:
        label["bbox"] = [2 * side for side in label["bbox"]]
    file.write_text(json.dumps(content))
    assert score_things(scene, file) == [("windows", count, count, 0, 1.0)]
    content["annotations"] += content["annotations"]
    file.write_text(json.dumps(content))
    assert score_things(scene, file) == [("windows", 2 * count, count, 0, 0.667)]
    for label in content["annotations"]:
        label["bbox"][0] += label["bbox"][2]
    file.write_text(json.dumps(content))
    ((_, _, found, false, _),) = score_things(scene, file)
    assert found < count and false == count - found


def test_photos_and_words_count_once_however_they_are_written(tmp_path, capsys):
    scene, file = painted_scene(), tmp_path / "labels.json"
    content = coco(scene, scene.things("windows"))
    file.write_text(json.dumps(content))
    wanted = score_things(scene, file)
    changes = str, str.upper, lambda name: f"D:\\{name}", os.path.basename
    for image, change in zip(content["images"], changes, strict=True):
        image["file_name"] = change(image["file_name"])
    content["categories"].append({"id": 9, "name": "windows"})
    content["annotations"][0]["category_id"] = 9
    content["images"].append(content["images"][0] | {"id": 99, "file_name": "elsewhere.jpg"})
    file.write_text(json.dumps(content))
    assert score_things(scene, file) == wanted
    assert "1 photos of" in (told := capsys.readouterr().out) and "elsewhere.jpg" in told


def test_a_category_is_one_word_and_has_no_score_without_any_box(tmp_path):
    scene, file = painted_scene(), tmp_path / "labels.json"
    content = coco(scene, scene.things("windows"))
    count = len(content["annotations"])
    content["categories"][0]["name"] = "windows, all of them"
    content["categories"].append({"id": 9, "name": "nothing of the kind"})
    file.write_text(json.dumps(content))
    whole, nothing = score_things(scene, file)
    assert whole == ("windows, all of them", count, count, 0, 1.0)
    assert nothing == ("nothing of the kind", 0, 0, 0, None)
    with pytest.raises(UserError, match=r"there is no .*missing\.json"):
        score_things(scene, tmp_path / "missing.json")


def test_labels_of_lerf_ovs_score_as_the_same_boxes_in_coco(tmp_path):
    scene, file, folder = painted_scene(), tmp_path / "labels.json", tmp_path / "labels"
    content = coco(scene, scene.things("windows"))
    content["annotations"] = content["annotations"][1:]
    file.write_text(json.dumps(content))
    folder.mkdir()
    for image in content["images"]:
        own = [one["bbox"] for one in content["annotations"] if one["image_id"] == image["id"]]
        objects = [
            {
                "category": "windows",
                "bbox": [x, y, x + w, y + h],
                "segmentation": [[x, y], [x + w, y], [x, y + h]],
            }
            for x, y, w, h in own
        ]
        labels = {"info": {"width": image["width"], "height": image["height"]}, "objects": objects}
        (folder / image["file_name"].split("/")[1]).with_suffix(".json").write_text(json.dumps(labels))
    scores = score_things(scene, folder)
    assert [score[:3] for score in scores] == [score[:3] for score in score_things(scene, file)]
    with pytest.raises(UserError, match=r"labels\.json can't be used"):
        score_things(scene, tmp_path)


@pytest.mark.parametrize("turns", [0, 1])
def test_boxes_drawn_on_files_are_found_in_undistorted_photos(tmp_path, turns):
    plain, file, bend = painted_file(), tmp_path / "labels.json", 0.0 if turns else -0.3
    lenses = [
        replace(photo.lens, width=128, cx=64.0, distortion=(bend, 0.0, 0.0, 0.0)) for photo in plain.photos
    ]
    photos = [
        replace(photo, lens=lens, quarter_turns=turns)
        for photo, lens in zip(plain.photos, lenses, strict=True)
    ]
    scene = painted_scene(file=replace(plain, photos=photos))
    content = coco(scene, scene.things("windows"))
    count = len(content["annotations"])
    file.write_text(json.dumps(content))
    assert score_things(scene, file) == [("windows", count, count, 0, 1.0)]  # ours are undistorted
    for label in content["annotations"]:
        lens, (x, y, wide, high) = lenses[label["image_id"] - 1], label["bbox"]
        if turns:  # the file lies on its side
            label["bbox"] = [y, lens.width - x - wide, high, wide]
            continue
        corners = np.array([(a, b) for a in (x, x + wide) for b in (y, y + high)])
        seen = (corners - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
        seen *= 1 + bend * (seen**2).sum(1, keepdims=True)
        low, high = (end(seen * (lens.fx, lens.fy) + (lens.cx, lens.cy), axis=0) for end in (np.min, np.max))
        label["bbox"] = [*low.tolist(), *(high - low).tolist()]
    for image in content["images"] if turns else ():
        image["width"], image["height"] = image["height"], image["width"]
    file.write_text(json.dumps(content | {"info": {"description": "by hand"}}))
    assert score_things(scene, file) == [("windows", count, count, 0, 1.0)]


FLAT = {
    "images": [{"id": 1, "file_name": "x", "width": 0, "height": 1}],
    "categories": [{"id": 1, "name": "x"}],
    "annotations": [{"image_id": 1, "category_id": 1, "bbox": [0, 0, 1, 1]}],
}
NUMBERS = {"images": 3, "categories": 3, "annotations": [1]}
EMPTY = {"images": [], "categories": [], "annotations": []}


@pytest.mark.parametrize("text", ["[]", "{", *map(json.dumps, (EMPTY, NUMBERS, FLAT))])
def test_what_is_no_coco_file_of_the_scene_is_said(tmp_path, text):
    file = tmp_path / "labels.json"
    file.write_text(text)
    with pytest.raises(UserError, match=r"labels\.json"):
        score_things(painted_scene(), file)
