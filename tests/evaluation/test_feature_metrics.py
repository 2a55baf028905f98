"""Feature metrics against numbers worked out by hand, matched colors, and the files of a photo's pictures."""

import numpy as np
import pytest
import torch
from sklearn.preprocessing import PolynomialFeatures

from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto, feature_metrics, matched_colors, psnr


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


def test_colors_changed_by_a_quadratic_map_are_matched_and_others_as_well_as_a_solver_can():
    draw = torch.Generator().manual_seed(0)
    wanted = 0.2 + 0.6 * torch.rand(4000, 3, generator=draw)
    mixed = wanted @ torch.tensor([[0.8, 0.1, 0.0], [0.1, 0.7, 0.1], [0.0, 0.1, 0.8]])
    lens = 0.9 * mixed.sqrt()  # whose inverse is quadratic
    assert psnr(lens, wanted) < 25 < 60 < psnr(matched_colors(lens, wanted), wanted)
    noise = torch.rand(4000, 3, generator=draw)
    terms = PolynomialFeatures(2).fit_transform(noise.double().numpy())
    fit = np.linalg.lstsq(terms, wanted.double().numpy(), rcond=None)[0]
    np.testing.assert_allclose(matched_colors(noise, wanted, rounds=1), terms @ fit, atol=5e-3)


def test_saturated_colors_do_not_spoil_the_match():
    draw = torch.Generator().manual_seed(1)
    wanted = 0.2 + 0.6 * torch.rand(4000, 3, generator=draw)
    bright = 1.5 * wanted  # a third is clipped
    found = matched_colors(bright.clamp(max=1.0), wanted)
    seen = (bright < 1).all(1)
    assert psnr(found[seen], wanted[seen]) > 45
    assert torch.isfinite(matched_colors(torch.full((9, 3), 0.5), wanted[:9])).all()
