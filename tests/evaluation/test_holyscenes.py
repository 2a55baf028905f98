"""Ground truth in HolyScenes' layout: read despite JPEG noise, scored at half the photo's size."""

import numpy as np
import pytest
import torch
from PIL import Image

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.holyscenes import (
    GroundTruth,
    mean_average_precision,
    resize_map,
    score_maps,
    scoring_size,
)
from lang3dxl_ns.evaluation.language import LanguageScorer, blurred, inside


def write_mask(folder, category, number, mask, quality=75):
    (folder / category).mkdir(parents=True, exist_ok=True)
    grey = np.where(mask, np.uint8(0), np.uint8(255))
    Image.fromarray(grey).save(folder / category / f"{number}-gt.jpg", quality=quality)
    Image.fromarray(grey).save(folder / category / f"{number}-img.jpg")


@pytest.fixture
def mask():
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    return mask


def test_masks_survive_jpeg_and_belong_to_their_photo_and_category(tmp_path, mask):
    write_mask(tmp_path, "domes", "0001", mask, quality=30)
    write_mask(tmp_path, "windows", "0002", ~mask)
    truth = GroundTruth(tmp_path)
    assert truth.categories == ["domes", "windows"]
    assert truth.photos("domes") == ["0001"]
    assert list(truth.masks("0001.png", (40, 60))) == ["domes"]
    assert np.array_equal(truth.masks("folder/0001.JPG", (40, 60))["domes"], mask)
    assert truth.masks("0003.jpg", (40, 60)) == {}


def test_masks_come_at_the_size_of_the_map(tmp_path, mask):
    write_mask(tmp_path, "domes", "0001", mask, quality=95)
    small = GroundTruth(tmp_path).masks("0001.jpg", (20, 30))["domes"]
    assert np.array_equal(small, mask[::2, ::2])


def test_a_folder_without_masks_says_what_is_expected(tmp_path):
    with pytest.raises(UserError, match=r"NNNN-gt\.jpg"):
        GroundTruth(tmp_path)


def test_an_unreadable_mask_is_named(tmp_path, mask):
    write_mask(tmp_path, "domes", "0001", mask)
    (tmp_path / "domes" / "0001-gt.jpg").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"0001-gt\.jpg"):
        GroundTruth(tmp_path).masks("0001.jpg", (4, 4))


def test_a_perfect_map_scores_one_and_absent_categories_are_left_out(mask):
    maps = {"domes": torch.from_numpy(mask).float(), "windows": torch.rand(40, 60)}
    truth = {"domes": mask, "windows": np.zeros_like(mask)}
    assert score_maps(maps, truth) == {"ap_domes": 1.0}
    assert list(score_maps(maps, truth, "teacher_")) == ["teacher_ap_domes"]


def test_the_mean_is_over_categories_not_over_photos():
    means = {"psnr": 20.0, "ap_domes": 0.5, "ap_windows": 1.0, "teacher_ap_domes": 0.1}
    assert mean_average_precision(means) == 0.75
    assert mean_average_precision(means, "teacher_") == pytest.approx(0.1)
    assert mean_average_precision({"psnr": 20.0}) is None


def test_resizing_a_constant_map_keeps_it_and_the_scoring_size_is_half():
    assert scoring_size(361, 480) == (180, 240)
    assert torch.equal(resize_map(torch.full((2, 9, 7), 0.25), (4, 3)), torch.full((2, 4, 3), 0.25))


class OneHot:
    """A text encoder with a channel per phrase."""

    def __init__(self, phrases):
        self.phrases = phrases

    def encode_texts(self, texts):
        return torch.stack([torch.eye(8)[self.phrases.index(t) if t in self.phrases else 7] for t in texts])


def test_field_and_teacher_are_scored_by_the_same_rules_and_the_foreground_cuts_both(tmp_path, mask):
    write_mask(tmp_path, "domes", "0001", mask, quality=95)
    scorer = LanguageScorer(GroundTruth(tmp_path), OneHot(["domes"]))
    features = torch.zeros(40, 60, 8)
    features[..., 7] = 1
    features[torch.from_numpy(mask)] = torch.eye(8)[0]
    size = (20, 30)
    field, teacher = scorer.field_maps(lambda f: f, features, size), scorer.teacher_maps(features, size)
    assert scorer.scores("0001.jpg", field) == {"ap_domes": 1.0}
    assert scorer.scores("0001.jpg", teacher, "teacher_") == {"teacher_ap_domes": 1.0}
    keep = torch.zeros(40, 60, dtype=torch.bool)
    assert not inside(field, keep)["domes"].any()
    assert inside(field, ~keep)["domes"].equal(field["domes"])


def test_the_blur_keeps_the_mean_of_a_map_and_takes_single_pixels_out():
    maps = {"domes": torch.full((40, 60), 0.5)}
    maps["domes"][20, 30] = 1.0
    smooth = blurred(maps)["domes"]
    torch.testing.assert_close(smooth.mean(), maps["domes"].mean())
    assert smooth.max() < 0.52
