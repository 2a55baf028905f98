"""Ground truth of HolyScenes: masks in JPEG, and errors that name the file."""

import numpy as np
import pytest
from label_sets import write_holyscenes

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth


@pytest.fixture
def mask():
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    return mask


@pytest.mark.parametrize("quality", [30, 75, 95])
def test_masks_survive_jpeg_and_belong_to_their_photo_and_category(tmp_path, mask, quality):
    write_holyscenes(tmp_path, "domes", "0001", mask, quality=quality)
    write_holyscenes(tmp_path, "windows", "0002", ~mask)
    truth = GroundTruth(tmp_path)
    assert truth.categories == ["domes", "windows"]
    assert truth.photos("domes") == ["0001"]
    assert list(truth.masks("0001.png", (40, 60))) == ["domes"]
    assert np.array_equal(truth.masks("folder/0001.JPG", (40, 60))["domes"], mask)
    assert truth.masks("0003.jpg", (40, 60)) == {}


def test_masks_come_at_the_size_of_the_map(tmp_path, mask):
    write_holyscenes(tmp_path, "domes", "0001", mask, quality=95)
    small = GroundTruth(tmp_path).masks("0001.jpg", (20, 30))["domes"]
    assert np.array_equal(small, mask[::2, ::2])


def test_a_folder_without_masks_says_what_is_expected(tmp_path):
    with pytest.raises(UserError, match=r"NNNN-gt\.jpg"):
        GroundTruth(tmp_path, "holyscenes")


def test_an_unreadable_mask_is_named(tmp_path, mask):
    write_holyscenes(tmp_path, "domes", "0001", mask)
    (tmp_path / "domes" / "0001-gt.jpg").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"0001-gt\.jpg"):
        GroundTruth(tmp_path).masks("0001.jpg", (4, 4))


def test_a_photo_without_its_mask_is_named(tmp_path, mask):
    write_holyscenes(tmp_path, "domes", "0001", mask)
    write_holyscenes(tmp_path, "domes", "0002", mask)
    (tmp_path / "domes" / "0002-gt.jpg").unlink()
    with pytest.raises(UserError, match=r"no .*domes/0002-gt\.jpg"):
        GroundTruth(tmp_path)


def test_a_category_without_any_mask_is_named(tmp_path, mask):
    write_holyscenes(tmp_path, "domes", "0001", mask)
    (tmp_path / "spires").mkdir()
    with pytest.raises(UserError, match="spires holds no mask"):
        GroundTruth(tmp_path)
