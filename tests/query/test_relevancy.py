"""Laws of relevancy; `lab/numerics/relevancy.py` compares it with LERF's formula in float64."""

import pytest
import torch

from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.semantic_field import SemanticField
from lang3dxl_ns.query import relevancy as module
from lang3dxl_ns.query.relevancy import TEMPERATURE, Queries, cosines_of_codes


def relevancy(features, queries, canonical, temperature=TEMPERATURE):
    prompts = Queries.of(queries[:, None].unbind(), canonical)
    return prompts.relevancy_of_cosines(prompts.cosines(features), temperature)


@pytest.fixture
def vectors():
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(n, 32, generator=generator) for n in (200, 3, 4)]


def test_the_half_contour_and_the_ranking_do_not_depend_on_the_temperature(vectors):
    features, queries, canonical = (v.double() for v in vectors)
    cool, hot = (relevancy(features, queries, canonical, t) for t in (1.0, 30.0))
    assert torch.equal(cool > 0.5, hot > 0.5)
    assert torch.equal(cool.argsort(dim=1), hot.argsort(dim=1))


def test_neither_lengths_nor_the_order_of_phrases_matter(vectors):
    features, queries, canonical = vectors
    expected = relevancy(features, queries, canonical)
    torch.testing.assert_close(relevancy(7 * features, 0.1 * queries, canonical.flip(0)), expected)


@pytest.mark.parametrize("max_mb", [1e-6, 0.01, 256.0])
def test_chunks_change_nothing(vectors, max_mb, monkeypatch):
    monkeypatch.setattr(module, "_CPU_MB", max_mb)
    field = SemanticField(SemanticFieldConfig(preset="short"), 32, 8)
    codes = torch.randn(7, 11, 3, generator=torch.Generator().manual_seed(1))
    _, queries, canonical = vectors
    expected = relevancy(field.decode_clip(codes).detach(), queries, canonical)
    prompts = Queries.of(queries[:, None].unbind(), canonical)
    cosines = cosines_of_codes(field.decode_clip, codes.flatten(0, 1), prompts)
    torch.testing.assert_close(prompts.relevancy_of_cosines(cosines), expected.flatten(1))


def test_any_synonym_may_fit(vectors):
    features, prompts, canonical = vectors
    together = Queries.of([prompts], canonical)
    best = relevancy(features, prompts, canonical).amax(0)
    torch.testing.assert_close(together.relevancy_of_cosines(together.cosines(features))[0], best)


def test_a_negative_of_its_own_is_one_more_phrase_to_beat(vectors):
    features, prompts, canonical = vectors
    own = [prompts[:0], canonical[:2], prompts[:1]]
    queries = Queries.of(prompts[:, None].unbind(), canonical[2:], own)
    scores = queries.relevancy_of_cosines(queries.cosines(features))
    for i, extra in enumerate(own):
        alone = relevancy(features, prompts[i : i + 1], torch.cat([canonical[2:], extra]))[0]
        torch.testing.assert_close(scores[i], alone)


def test_a_prompt_without_words_or_rivals_is_refused(vectors):
    _, prompts, canonical = vectors
    with pytest.raises(ValueError, match="needs a vector"):
        Queries.of([prompts[:0]], canonical)
    with pytest.raises(ValueError, match="compete"):
        Queries.of([prompts], canonical[:0])


def test_a_prompt_that_is_a_canonical_phrase_is_never_relevant(vectors):
    features, _, canonical = vectors
    scores = relevancy(features, canonical, canonical)
    assert scores.max() <= 0.5
    torch.testing.assert_close(scores.amax(0), torch.full((len(features),), 0.5))
