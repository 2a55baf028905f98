"""Feature metrics against numbers worked out by hand, and the files of a photo's pictures."""

import pytest
import torch

from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto, feature_metrics


def test_a_constant_error_has_the_l1_and_psnr_of_that_error():
    target = torch.randn(5, 7, 16, generator=torch.Generator().manual_seed(0))
    metrics = feature_metrics("clip", target + 0.2, target, target.mean(dim=(0, 1)))
    assert metrics["clip_l1"] == pytest.approx(0.2, rel=1e-5)
    assert metrics["clip_psnr"] == pytest.approx(13.979, abs=1e-3)  # the paper's scale: rmse 0.2 is 13.98 dB


def test_predicting_the_mean_scores_as_the_mean():
    target = torch.randn(4, 4, 8)
    mean = target.mean(dim=(0, 1))
    metrics = feature_metrics("dense", mean.expand_as(target), target, mean)
    for name in ("l1", "psnr", "cosine"):
        assert metrics[f"dense_{name}"] == pytest.approx(metrics[f"dense_{name}_of_mean"])


def test_cells_without_weight_do_not_count():
    target, weight = torch.randn(4, 4, 8), torch.ones(4, 4)
    predicted = target.clone()
    predicted[0] += 100
    weight[0] = 0
    assert feature_metrics("clip", predicted, target, target[0, 0], weight)["clip_l1"] == 0
    assert feature_metrics("clip", predicted, target, target[0, 0], torch.zeros(4, 4)) == {}


def test_every_photo_has_a_picture_of_its_own_whatever_its_name(tmp_path):
    names = ["a/b.jpg", "a_b.jpg", "ä" * 200 + ".jpg", "a/" + "ä" * 200 + ".jpg"]
    for name in names:
        EvaluatedPhoto(name, {}, {"img": torch.zeros(2, 4, 3)}, {}).write_pictures(tmp_path)
    assert len(list(tmp_path.glob("*.img.jpg"))) == len(names)
