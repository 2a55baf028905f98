"""Scores of maps against values worked out by hand and scikit-learn."""

import numpy as np
import pytest
import torch
from label_sets import box_object, write_holyscenes, write_labels, write_plain
from scipy.ndimage import uniform_filter

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.layouts import Truth
from lang3dxl_ns.evaluation.scores import (
    MapScorer,
    as_published,
    average_precision,
    blurred,
    inside,
    located,
    overlap,
    resize_map,
    score_map,
    score_maps,
    smooth_mask,
    softened,
    strongest_level,
)


@pytest.fixture
def mask():
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    return mask


def random_pair(seed, size=(23, 31)):
    rng = np.random.default_rng(seed)
    truth = rng.random(size) < 0.3
    # Rounded, so that many pixels share a score.
    return np.round(0.6 * rng.random(size) + 0.4 * truth, 2).astype(np.float32), truth


# ── agreement with other libraries ──────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seed", range(3))
def test_all_measures_agree_with_scikit_learn(seed):
    from sklearn import metrics

    score, truth = random_pair(seed)
    found = score_map(score, Truth(truth))
    mask, true = (score > 0.5).ravel(), truth.ravel()
    assert found["ap"] == pytest.approx(metrics.average_precision_score(true, score.ravel()))
    assert found["iou"] == pytest.approx(metrics.jaccard_score(true, mask))
    assert found["f1"] == pytest.approx(metrics.f1_score(true, mask))
    assert found["balanced_accuracy"] == pytest.approx(metrics.balanced_accuracy_score(true, mask))
    assert found["pixel_accuracy"] == pytest.approx(metrics.accuracy_score(true, mask))
    assert found["precision"] == pytest.approx(metrics.precision_score(true, mask))


def test_average_precision_by_hand():
    """Pixels with one score count as one step: their arbitrary order must not matter."""
    truth = np.array([[False, True], [False, True]])
    assert average_precision(np.array([[0.1, 0.9], [0.2, 0.8]]), truth) == 1
    assert average_precision(np.array([[0.9, 0.1], [0.8, 0.2]]), truth) == pytest.approx((1 / 3 + 2 / 4) / 2)
    assert average_precision(np.zeros((2, 2)), truth) == pytest.approx(0.5)
    assert average_precision(np.zeros((2, 2)), np.zeros((2, 2), bool)) is None
    with pytest.raises(ValueError, match="shape"):
        average_precision(np.zeros((2, 2)), np.zeros((4,), bool))


def test_the_order_of_pixels_and_any_rising_function_of_the_score_change_no_average_precision():
    score, truth = random_pair(1)
    order, expected = np.random.default_rng(1).permutation(score.size), average_precision(score, truth)
    assert average_precision(score.ravel()[order], truth.ravel()[order]) == pytest.approx(expected)
    assert average_precision(np.exp(5 * score), truth) == pytest.approx(expected)


# ── by hand ─────────────────────────────────────────────────────────────────────────────────────────────


def test_overlap_by_hand():
    """Two of three found, one too many, of eight pixels."""
    truth = np.array([[1, 1, 1, 0], [0, 0, 0, 0]], bool)
    found = np.array([[1, 1, 0, 1], [0, 0, 0, 0]], bool)
    assert overlap(found, truth) == {
        "iou": pytest.approx(2 / 4),
        "f1": pytest.approx(4 / 6),
        "balanced_accuracy": pytest.approx((2 / 3 + 4 / 5) / 2),
        "pixel_accuracy": pytest.approx(6 / 8),
        "precision": pytest.approx(2 / 3),
    }


def test_a_mask_that_finds_nothing_has_no_precision():
    assert overlap(np.zeros((2, 2), bool), np.eye(2, dtype=bool))["precision"] == 0


def test_an_object_that_fills_the_photo_has_a_balanced_accuracy():
    truth = np.ones((2, 2), bool)
    assert overlap(np.array([[True, True], [True, False]]), truth)["balanced_accuracy"] == 0.75


def test_half_is_not_above_half():
    assert score_map(np.array([[0.5, 0.6]]), Truth(np.array([[True, True]])))["iou"] == 0.5


def test_the_peak_is_looked_for_in_any_box_edges_included_or_else_in_the_mask():
    score = np.zeros((10, 20))
    score[3, 7] = 1
    mask = np.zeros((10, 20), bool)
    assert located(score, Truth(mask, np.array([[0, 0, 2, 2], [7, 3, 9, 9]]))) == 1
    assert located(score, Truth(~mask, np.array([[8, 3, 9, 9], [7, 4, 9, 9.0]]))) == 0
    assert located(score, Truth(mask)) == 0
    mask[3, 7] = True
    assert located(score, Truth(mask)) == 1


def test_any_of_several_peaks_will_do_but_a_flat_map_locates_nothing():
    mask = np.zeros((4, 4), bool)
    mask[0, 0] = True
    score = np.zeros((4, 4))
    score[0, 0] = score[3, 3] = 1
    assert located(score, Truth(mask)) == 1
    assert located(np.full((4, 4), 0.3), Truth(mask)) == 0


def test_langsplats_smoothing_passes_over_a_lonely_pixel():
    """The highest pixel is alone, far from the broad object: only smoothing finds the object."""
    score = np.zeros((120, 160))
    score[40:90, 20:70] = 0.8
    score[10, 150] = 1
    truth = Truth(score == 0.8, np.array([[20, 40, 69, 89.0]]))
    found = score_map(score, truth, smooth=True)
    assert (found["located"], found["smooth_located"]) == (0, 1)


def test_langsplats_mask_by_hand():
    """On a plateau of 1, half the map and half its mean exceed 0.7 (0.4 on −1…1) where the mean exceeds 0.4;
    outside, nowhere."""
    score = np.zeros((200, 200))
    score[50:150, 50:150] = 1
    mean = uniform_filter(score, 30, mode="mirror")
    found = smooth_mask(score, mean)
    # In the middle of an edge the first column inside has a mean of about a half: the vote keeps it.
    assert found[100, 50] and not found[100, 49]
    assert found[100, 149] and not found[100, 150]
    assert not found[50, 50]  # in a corner the mean is a quarter
    assert not smooth_mask(np.zeros((40, 40)), np.zeros((40, 40))).any()


def test_the_majority_of_neighbors_removes_specks():
    score = np.zeros((60, 60))
    score[20:40, 20:40] = 1
    score[5, 5] = 1
    found = smooth_mask(score, score)  # no smoothing but the vote
    assert found[30, 30] and not found[5, 5]


def test_the_level_with_the_highest_smoothed_peak_counts():
    levels = np.zeros((3, 80, 80))
    levels[0, 40, 40] = 1.0
    levels[1, 20:60, 20:60] = 0.6
    levels[2, 20:60, 20:60] = 0.5
    assert np.array_equal(strongest_level(levels), levels[1])


# ── processing before scoring ───────────────────────────────────────────────────────────────────────────


def test_resizing_a_constant_map_keeps_it():
    assert torch.equal(resize_map(torch.full((2, 9, 7), 0.25), (4, 3)), torch.full((2, 4, 3), 0.25))


def test_the_blur_keeps_the_mean_of_a_map_and_takes_single_pixels_out():
    maps = {"domes": torch.full((40, 60), 0.5)}
    maps["domes"][20, 30] = 1.0
    smooth = blurred(maps)["domes"]
    torch.testing.assert_close(smooth.mean(), maps["domes"].mean())
    assert smooth.max() < 0.52


def test_published_maps_are_zero_up_to_a_half_and_one_at_the_photos_best():
    score = torch.full((60, 80), 0.5)
    score[:, :40] = 0.2
    score[20:40, 50:70] = 0.6
    published = as_published({"domes": score})["domes"]
    assert published[:, :20].abs().max() < 1e-6
    assert published[30, 60] == pytest.approx(1, abs=1e-3)  # far from the edges the blur changes nothing
    assert published[30, 50] == pytest.approx(0.58, abs=0.02)
    assert not as_published({"domes": torch.full((60, 80), 0.5)})["domes"].any()


def test_softening_gives_the_relevancy_of_temperature_one():
    margin = torch.linspace(-0.5, 0.5, 12).reshape(3, 4)
    soft = softened({"domes": torch.sigmoid(10 * margin)}, 10)["domes"]
    torch.testing.assert_close(soft, torch.sigmoid(margin))


def test_nothing_is_found_outside_the_foreground():
    maps = {"domes": torch.rand(20, 30) + 0.1}
    keep = torch.zeros(40, 60, dtype=torch.bool)
    keep[:, :30] = True
    cut = inside(maps, keep)["domes"]
    assert torch.equal(cut[:, :15], maps["domes"][:, :15]) and not cut[:, 15:].any()
    assert inside(maps, None) is maps


# ── photos ──────────────────────────────────────────────────────────────────────────────────────────────


def test_a_perfect_map_scores_one_and_absent_categories_are_left_out(mask):
    maps = {"domes": torch.from_numpy(mask).float(), "windows": torch.rand(40, 60)}
    truths = {"domes": Truth(mask), "windows": Truth(np.zeros_like(mask))}
    perfect = {"ap", "iou", "f1", "balanced_accuracy", "pixel_accuracy", "precision", "located"}
    assert score_maps(maps, truths) == {f"{name}_domes": 1.0 for name in perfect}
    assert set(score_maps(maps, truths, "teacher_")) == {f"teacher_{name}_domes" for name in perfect}


def test_noise_of_jpeg_changes_no_score(tmp_path, mask):
    maps = {"domes": torch.rand(40, 60, generator=torch.Generator().manual_seed(0))}
    exact = score_maps(maps, {"domes": Truth(mask)})
    for quality in (20, 50, 80):
        write_holyscenes(tmp_path / str(quality), "domes", "0001", mask, quality)
        scorer = MapScorer(GroundTruth(tmp_path / str(quality)))
        assert scorer.scores("0001.jpg", {"": maps}) == exact


def test_photos_without_a_positive_are_counted_once(tmp_path, mask):
    write_plain(tmp_path, "domes", "0001", np.zeros_like(mask))
    write_plain(tmp_path, "windows", "0001", mask)
    scorer = MapScorer(GroundTruth(tmp_path))
    maps = {"domes": torch.rand(20, 30), "windows": torch.rand(20, 30)}
    for prefix, variant in scorer.variants(maps).items():
        assert f"{prefix}ap_domes" not in scorer.scores("0001", {prefix: variant})
    assert scorer.protocol("none")["photos_without_positives"] == {"domes": 1}


def test_masks_are_scored_in_three_ways_and_labels_by_langsplats_measures(tmp_path, mask):
    write_plain(tmp_path / "masks", "domes", "0001", mask)
    write_labels(tmp_path / "labels", "0001", [box_object("domes", 16, 8, 47, 23)])
    maps = {"domes": torch.rand(40, 60)}
    assert list(MapScorer(GroundTruth(tmp_path / "masks")).variants(maps)) == ["", "raw_", "authors_"]
    scorer = MapScorer(GroundTruth(tmp_path / "labels"))
    assert list(scorer.variants(maps)) == [""]
    assert {"smooth_located_domes", "smooth_iou_domes"} <= set(scorer.scores("0001", {"": maps}))


def test_the_raw_score_is_that_of_the_map_itself(tmp_path, mask):
    write_plain(tmp_path, "domes", "0001", mask)
    scorer, maps = MapScorer(GroundTruth(tmp_path)), {"domes": torch.rand(20, 30)}
    raw = scorer.scores("0001", scorer.variants(maps))["raw_ap_domes"]
    assert raw == pytest.approx(average_precision(maps["domes"].numpy(), mask[::2, ::2]))
