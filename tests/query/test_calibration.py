"""Queries don't depend on how far an encoder's cosines spread, nor on their mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from painted_scene import Painted, encode_texts, painted_codes, painted_scene

from lang3dxl_ns.query.engine import PerGaussian, PerPixel
from lang3dxl_ns.query.relevancy import SPREAD, TEMPERATURE, Queries, calibrated, spread
from lang3dxl_ns.query.text import TextEncoder

ENCODERS = [(0.1, 0.0), (0.1, 0.7), (0.5, -0.2), (0.03, 0.2)]
"""Factor and shift of all cosines: real encoders' margins are ten to thirty times as narrow as the
built-in's."""


def other(vectors: torch.Tensor, factor: float, shift: float, is_text: bool) -> torch.Tensor:
    """Unit vectors whose cosines are factor · cosine + shift: three channels more. Zero stays zero."""
    units = F.normalize(vectors, dim=-1)
    there = (units != 0).any(-1, keepdim=True).to(units)
    sign = -1.0 if shift < 0 and is_text else 1.0
    common = sign * abs(shift) ** 0.5 * there
    rest = (1 - factor - abs(shift)) ** 0.5 * there
    none = torch.zeros_like(rest)
    own = (none, rest) if is_text else (rest, none)
    return torch.cat([factor**0.5 * units, common, *own], dim=-1)


def scene_of(factor: float, shift: float):
    """The painted scene as another encoder sees it."""

    def texts(words):
        return other(encode_texts(words), factor, shift, is_text=True)

    codes = other(painted_codes(), factor, shift, is_text=False)
    return painted_scene(encode_texts=texts, decoder=Painted(codes.shape[1]), codes=codes)


@pytest.mark.parametrize(("factor", "shift"), ENCODERS)
def test_every_answer_is_the_same_for_an_encoder_of_other_cosines(factor, shift):
    prompts = ["dome; window; wall; submarine"]
    expected, found = painted_scene(), scene_of(factor, shift)
    for before, after in zip(
        expected.query(prompts, "all/0003.jpg"), found.query(prompts, "all/0003.jpg"), strict=True
    ):
        np.testing.assert_allclose(after.relevancy, before.relevancy, rtol=0, atol=2e-3)
        assert (after.mask != before.mask).mean() < 2e-3
        assert after.doubt == before.doubt
        assert after.threshold == pytest.approx(before.threshold, abs=2e-3)
    for before, after in zip(expected.find(prompts), found.find(prompts), strict=True):
        assert [v.name for v in after.views] == [v.name for v in before.views]
        assert (after.box is None) == (before.box is None)


def test_the_spread_ignores_shifts_and_unknown_features_and_follows_the_factor():
    cosines = torch.rand(300, 20, generator=torch.Generator().manual_seed(0))
    own = spread(cosines)
    assert own == pytest.approx(float(cosines.double().var(1, correction=0).mean().sqrt()))
    each = cosines + torch.rand(300, 1)
    assert spread(each) == pytest.approx(own, rel=1e-4)
    assert spread(0.1 * cosines + 0.3) == pytest.approx(0.1 * own, rel=1e-4)
    unknown = torch.cat([cosines, torch.zeros(50, 20), torch.full((5, 20), torch.nan)])
    assert spread(unknown) == pytest.approx(own)
    assert calibrated(TEMPERATURE, SPREAD / own * cosines) == pytest.approx(TEMPERATURE, rel=1e-4)


@pytest.mark.parametrize("cosines", [torch.zeros(0, 4), torch.zeros(9, 4), torch.full((9, 4), 0.2)])
def test_scenes_that_say_nothing_stay_finite(cosines):
    assert 0 < calibrated(TEMPERATURE, cosines) < 1e5


def test_both_engines_are_calibrated_alike():
    features = F.normalize(torch.randn(500, 16, generator=torch.Generator().manual_seed(1)), dim=1)
    words = Queries(F.normalize(torch.randn(30, 16), dim=1), (), ())
    each, pixel = (
        PerGaussian(features).calibrated(words),
        PerPixel(lambda codes: codes, features).calibrated(words),
    )
    assert each.temperature == pytest.approx(pixel.temperature, rel=1e-4)
    assert replace(each, temperature=1.0).calibrated(words).temperature == pytest.approx(
        each.temperature / TEMPERATURE
    )


def test_the_yardstick_does_not_follow_the_settings():
    from lang3dxl_ns.query.text import TextConfig

    plain = TextEncoder(encode_texts).yardstick
    strict = TextEncoder(encode_texts, TextConfig(negatives=("object",))).yardstick
    assert torch.equal(plain.vectors, strict.vectors) and len(plain.vectors) > 70
