"""Region label maps: from colors, from overlapping masks, from files."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_models import make_tiny_sam

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import segmentation
from lang3dxl_ns.preparation.regions import (
    FelzenszwalbRegions,
    FolderRegions,
    MaskRegions,
    label_map,
    label_size,
    region_source,
    stored_labels,
)
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo

PHOTO = Photo("north/a.jpg", None, None, Lens(40, 30, 40.0, 43.0, 20.0, 15.0))
IMAGE = torch.zeros(30, 40, 3)


def disc(radius, size=64):
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (rows - size // 2) ** 2 + (columns - size // 2) ** 2 < radius**2


# ------------------------------------------------------------------ from masks that overlap


def test_nested_masks_give_the_smallest():
    discs = torch.stack([disc(20), disc(5), disc(30), disc(10)])
    by_size = [1, 3, 0, 2]  # positions of the masks, smallest first
    labels = label_map(discs)
    assert torch.equal(labels >= 0, discs.any(dim=0))
    for row in range(64):
        inside = [rank for rank, mask in enumerate(by_size) if discs[mask, row, 32]]
        assert int(labels[row, 32]) == (inside[0] if inside else -1)


def test_the_order_of_masks_does_not_matter():
    masks = torch.rand(7, 20, 30, generator=torch.manual_seed(0)) > torch.linspace(0.2, 0.9, 7)[:, None, None]
    shuffled = masks[torch.randperm(7, generator=torch.manual_seed(1))]
    assert torch.equal(label_map(masks), label_map(shuffled))


# ------------------------------------------------------------------ as stored


def test_stored_labels_are_small_numbered_and_nearest():
    coarse = torch.tensor([[5, 5, 900_000_000_000], [-7, 2, 900_000_000_000]])
    large = coarse.repeat_interleave(300, 0).repeat_interleave(300, 1)
    found = stored_labels(large)
    assert found.shape == label_size(600, 900) == (171, 256)
    assert found.dtype == torch.int16
    assert set(found.unique().tolist()) == {-1, 0, 1, 2}
    middles = found[[[84], [85]], [42, 128, 213]]  # the border is at 300 / 600 * 171 = 85.5, row 85's middle
    assert middles.tolist() == [[1, 1, 2], [-1, 0, 2]]
    assert torch.equal(stored_labels(coarse), torch.tensor([[1, 1, 2], [-1, 0, 2]], dtype=torch.int16))


def test_a_map_without_any_region_stays_so_and_many_regions_keep_their_numbers():
    assert torch.equal(stored_labels(torch.full((5, 6), -3)), torch.full((5, 6), -1, dtype=torch.int16))
    many = torch.arange(200 * 250).view(200, 250)
    assert torch.equal(stored_labels(many), many.int())


# ------------------------------------------------------------------ from colors


def test_felzenszwalb_separates_colors_and_shrinks_the_photo_first():
    image = torch.full((600, 900, 3), 0.2)
    image[:, 450:] = 0.9
    labels = FelzenszwalbRegions().labels(PHOTO, image)
    assert labels.shape == (171, 256)
    assert labels[0, 0] != labels[0, -1]  # the border, smoothed, has a few thin regions of its own
    assert torch.equal(labels[:, :120], labels[:1, :1].expand(171, 120))
    assert torch.equal(labels[:, 136:], labels[:1, -1:].expand(171, 120))


# ------------------------------------------------------------------ from SAM


@pytest.fixture(scope="module")
def sam(tmp_path_factory):
    return str(make_tiny_sam(tmp_path_factory.mktemp("models") / "sam", seed=2))


def test_sam_labels_are_made_of_its_masks(sam, monkeypatch):
    settings = {"points_per_crop": 3, "pred_iou_thresh": -1e9, "stability_score_thresh": -1}
    for name, value in settings.items():
        monkeypatch.setitem(segmentation._AUTOMATIC, name, value)
    image = torch.rand(60, 90, 3, generator=torch.manual_seed(0))
    source = region_source(PreparationConfig(regions="sam", sam=sam), PHOTO.path)
    assert isinstance(source, MaskRegions)
    source = pickle.loads(pickle.dumps(source))  # as a worker process gets it
    labels = source.labels(PHOTO, image)
    masks = torch.stack(source._masks((image * 255).round().byte()))
    assert torch.equal(labels, label_map(masks))
    assert source.labels(PHOTO, torch.rand(300, 512, 3)).shape == (150, 256)
    monkeypatch.setitem(segmentation._AUTOMATIC, "pred_iou_thresh", 1e9)
    assert torch.equal(source.labels(PHOTO, image), torch.full((60, 90), -1))


def test_sam_settings_name_weights_and_level(sam):
    settings = region_source(PreparationConfig(regions="sam", sam=sam), None).settings(PHOTO)
    assert settings["level"] == "small" and settings["model"]


# ------------------------------------------------------------------ from a folder


def test_pictures_count_from_one_and_arrays_from_zero(tmp_path):
    labels = np.array([[0, 1, 500], [40_000, 65_535, 0]])
    (tmp_path / "north").mkdir()
    Image.fromarray(labels.astype(np.uint16)).save(tmp_path / "north" / "a.png")
    source = FolderRegions(tmp_path)
    expected = torch.tensor([[-1, 0, 1], [2, 3, -1]])
    assert torch.equal(source.labels(PHOTO, IMAGE), expected)
    (tmp_path / "north" / "a.png").unlink()
    np.save(tmp_path / "north" / "a.jpg.npy", labels.astype(np.int64) - 1)
    assert torch.equal(source.labels(PHOTO, IMAGE), expected)
    np.save(tmp_path / "north" / "a.jpg.npy", labels.astype(np.uint16))  # no negative number: all are regions
    assert source.labels(PHOTO, IMAGE).min() == 0


def test_label_maps_lie_on_the_file_and_are_undistorted_with_it(tmp_path):
    labels = np.tile(np.arange(40), (30, 1))
    (tmp_path / "north").mkdir()
    np.save(tmp_path / "north" / "a.npy", labels)
    distorted = replace(PHOTO, lens=replace(PHOTO.lens, distortion=(0.4, 0.0, 0.0, 0.0)))
    found = FolderRegions(tmp_path).labels(distorted, IMAGE)
    assert found.min() == -1
    assert torch.equal(found, distorted.undistort_labels(torch.from_numpy(labels)))


def test_a_folders_settings_follow_the_file_and_are_none_without_one(tmp_path):
    source = FolderRegions(tmp_path)
    assert source.settings(PHOTO) is None
    (tmp_path / "north").mkdir()
    np.save(tmp_path / "north" / "a.npy", np.zeros((3, 4), int))
    first = source.settings(PHOTO)
    np.save(tmp_path / "north" / "a.npy", np.ones((3, 4), int))
    assert source.settings(PHOTO) != first
    json.dumps(first)


def test_label_maps_are_links_out_of_their_folder_only_where_links_are_followed(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 4), int))
    (folder := tmp_path / "labels" / "north").mkdir(parents=True)
    (folder / "a.npy").symlink_to(tmp_path / "a.npy")
    config = PreparationConfig(regions="labels")
    with pytest.raises(UserError, match="leads out of"):
        region_source(config, tmp_path).settings(PHOTO)
    assert region_source(config, tmp_path, follow_links=True).settings(PHOTO)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("a.npy", np.zeros((3, 4))),  # not whole numbers
        ("a.npy", np.zeros((4, 3, 4), int)),
        ("a.npy", np.array([{"pickled": 1}], dtype=object)),
        ("a.png", np.zeros((3, 4, 3), np.uint8)),  # colors
        ("a.png", None),
    ],
)
def test_a_file_that_is_not_a_label_map_is_a_user_error(tmp_path, file, content):
    path = tmp_path / "north" / file
    path.parent.mkdir()
    if content is None:
        path.write_bytes(b"not a picture")
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        Image.fromarray(content).save(path)
    with pytest.raises(UserError, match=r"regions of north/a\.jpg: .*a\.(png|npy)"):
        FolderRegions(tmp_path).labels(PHOTO, IMAGE)


# ------------------------------------------------------------------ which source


def test_the_option_names_the_source(tmp_path):
    def kind(choice):
        return type(region_source(PreparationConfig(regions=choice, sam="no/such-sam"), tmp_path))

    assert kind("none") is kind("auto") is type(None)
    assert kind("felzenszwalb") is FelzenszwalbRegions
    (tmp_path / "regions").mkdir()
    assert kind("auto") is kind("regions") is kind(str(tmp_path / "regions")) is FolderRegions
    assert kind("none") is type(None)
    with pytest.raises(UserError, match=r"regions elsewhere: there is no folder"):
        kind("elsewhere")
    with pytest.raises(UserError, match=r"hf download no/such-sam"):
        kind("sam")
