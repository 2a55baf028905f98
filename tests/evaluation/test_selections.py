"""Scores of masks, selected Gaussians and boxes, on a scene with known answers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from painted_scene import DOME, WINDOWS, decoded, painted_file, painted_scene, painted_splats, photo
from PIL import Image

from lang3dxl_ns import cli
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.score_scene import box_iou, score_scene, score_selections
from lang3dxl_ns.files.scene_file import write_scene
from lang3dxl_ns.query.view_ranking import Box
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.words.taught_words import Example

NAMES = ("dome", "window")


def label(scene, folder: Path, shift: float = 0.0) -> GroundTruth:
    """Exact labels of two photos, drawn from where the words are painted, moved by `shift` units."""
    for name in ("all/0003.jpg", "left/0001.jpg"):
        view = scene.file.photo(name)
        pixels = torch.stack(
            torch.meshgrid(torch.arange(96) + 0.5, torch.arange(96) + 0.5, indexing="xy"), dim=-1
        )
        lens, pose = view.lens, torch.tensor(view.camera_to_world)
        x = pose[0, 3] + 5 * (pixels[..., 0] - 48) / lens.fx
        y = pose[1, 3] + 5 * (pixels[..., 1] - 48) / lens.fy
        depth = scene.splats.means[0, 2] - pose[2, 3]
        y = y if depth > 0 else 2 * pose[1, 3] - y
        for word, places in zip(NAMES, ([DOME], WINDOWS), strict=True):
            mask = sum(((x - shift > a) & (x - shift < b) & (y > c) & (y < d)) for a, b, c, d in places) > 0
            path = folder / word / Path(name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask.numpy().astype(np.uint8) * 255).save(path)
    return GroundTruth(folder, "plain")


def scored(tmp_path, shift: float = 0.0) -> dict[str, float]:
    flat = painted_splats()
    depth = 0.1 * torch.rand(len(flat.means), generator=torch.Generator().manual_seed(0))  # boxes have volume
    scene = painted_scene(splats=replace(flat, means=flat.means + depth[:, None] * torch.tensor([0, 0, 1.0])))
    truth = label(scene, tmp_path / "ground_truth", shift)
    return score_selections(scene, truth, [p for p in scene.photos if truth.key(p.name) is not None])


def test_a_scene_that_knows_the_answers_gets_nearly_full_marks(tmp_path):
    figures = scored(tmp_path)
    assert set(figures) >= {f"{what}_iou_{w}" for what in ("mask", "selection", "box") for w in NAMES}
    assert min(figures.values()) > 0.7, figures


def test_a_label_that_fits_two_photos_of_a_scene_file_is_refused_and_one_that_fits_none_is_told(
    tmp_path, capsys
):
    scene = painted_scene()
    truth = label(scene, tmp_path)
    (tmp_path / "dome" / "left" / "0009.png").write_bytes((tmp_path / "dome/left/0001.png").read_bytes())
    score_scene(scene, GroundTruth(tmp_path, "plain"))
    assert "1 labels" in (said := capsys.readouterr().out) and "left/0009" in said
    index = next(i for i, photo in enumerate(scene.photos) if photo.name != "left/0001.jpg")
    scene.file.photos[index] = replace(scene.photos[index], name="left/0001.png")
    with pytest.raises(UserError, match=r"left/0001 in .* fits both"):
        score_scene(scene, truth)


def test_scored_photos_whose_marks_taught_a_word_are_told(tmp_path):
    scene = painted_scene()
    truth = label(scene, tmp_path)
    mark = Example("all/0003.jpg", np.asarray(Image.open(tmp_path / "dome/all/0003.png")) > 0)
    _, protocol = score_scene(scene.teach("dome", mark), truth)
    assert protocol["photos_that_taught"] == ["all/0003.jpg"]
    assert score_scene(scene, truth)[1]["photos_that_taught"] == []


def test_a_splat_that_carries_a_scene_is_scored_as_its_scene_file(tmp_path):
    scene, totals = painted_scene(**decoded("gathered")), []
    label(scene, tmp_path / "truth")
    for ending in ("scene", "GLB"):
        write_scene(tmp_path / f"a.{ending}", scene)
        words = [
            "--ground-truth",
            str(tmp_path / "truth"),
            "--split",
            "seen",
            "--out",
            str(tmp_path / ending),
        ]
        cli.main(["evaluate", "run", str(tmp_path / f"a.{ending}"), *words])
        totals.append(json.loads((tmp_path / ending / "scores.json").read_text())["results"]["map"])
    assert totals[0] == totals[1]


def test_labels_elsewhere_get_none(tmp_path):
    assert max(scored(tmp_path, shift=-1.6).values()) < 0.3


def test_photos_of_odd_sizes_that_training_halved_are_scored(tmp_path):
    """From 203 × 125 pixels, both half of them and the picture as wide as that are rounded."""
    file, (width, height) = painted_file(), (203, 125)
    lens = Lens(width, height, 200, 200, width / 2, height / 2)
    photos = [
        ScenePhoto.of(Photo(p.name, Path(p.name), None, lens), p.split, p.camera_to_world, 0.5)
        for p in file.photos
    ]
    scene = painted_scene(file=replace(file, photos=photos))
    (tmp_path / "dome" / "all").mkdir(parents=True)
    mask = np.zeros((height, width), np.uint8)
    mask[20:50, 120:160] = 255
    Image.fromarray(mask).save(tmp_path / "dome" / "all" / "0003.png")
    truth = GroundTruth(tmp_path, "plain")
    labeled = [photo for photo in photos if truth.key(photo.name)]
    assert set(score_selections(scene, truth, labeled)) >= {"mask_iou_dome"}


def test_a_word_that_only_photos_of_another_side_show_has_no_selection(tmp_path):
    """No training view shows its Gaussians."""
    places = [("left/0001.jpg", -1.5, -1, "train", 400), ("held/0004.jpg", 1.5, 1.5, "eval", 300)]
    photos = [photo(name, x, y, split, focal=focal) for name, x, y, split, focal in places]
    scene = painted_scene(file=replace(painted_file(), photos=photos))
    (tmp_path / "dome" / "held").mkdir(parents=True)
    mask = np.zeros((96, 96), np.uint8)
    mask[30:60, 30:60] = 255
    Image.fromarray(mask).save(tmp_path / "dome" / "held" / "0004.png")
    truth = GroundTruth(tmp_path, "plain")
    assert score_selections(scene, truth, photos[1:]) == {}


@pytest.mark.parametrize(
    ("low", "expected"), [((0.0, 0.0, 0.0), 1.0), ((1.0, 0.0, 0.0), 1 / 3), ((0.0, 3.0, 0.0), 0.0)]
)
def test_boxes_overlap_by_volume(low, expected):
    here, there = (Box(at, tuple(x + 2 for x in at), 1.0) for at in ((0.0, 0.0, 0.0), low))
    assert box_iou(here, there) == box_iou(there, here) == pytest.approx(expected)


def test_flat_boxes_have_no_overlap():
    flat = Box((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), 1.0)
    assert box_iou(flat, flat) == 0.0
