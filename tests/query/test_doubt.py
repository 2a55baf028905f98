"""Doubt about prompts: calibrated for absent things, and synonyms only where the text itself is doubted."""

import pytest
import torch
import torch.nn.functional as F

from lang3dxl_ns.query.doubt import DOUBTFUL, LEAST_PEAK, UNRELATED, Doubts, doubtful, peaks
from lang3dxl_ns.query.relevancy import Queries

CHANNELS, GAUSSIANS = 16, 1_000


class Asked(Doubts):
    def ask(self, *texts):
        return self.of(self.relevancy(self.queries(texts)))


def scene_of(features: torch.Tensor, words: dict[str, torch.Tensor]) -> Asked:
    """Doubts of a scene with these features; unrelated words point anywhere."""
    generator = torch.Generator().manual_seed(1)
    negatives = torch.randn(4, CHANNELS, generator=generator)
    vectors = {text: torch.randn(CHANNELS, generator=generator) for text in UNRELATED} | words

    def queries(texts):
        return Queries.of([vectors[text][None] for text in texts], negatives)

    relevancy = lambda q: q.relevancy_of_cosines(q.cosines(features))  # noqa: E731
    return Asked(relevancy, queries)


def random(count: int, seed: int) -> torch.Tensor:
    return torch.randn(count, CHANNELS, generator=torch.Generator().manual_seed(seed))


def test_a_thing_on_one_gaussian_in_a_hundred_is_not_doubted():
    thing = random(1, 7)[0]
    features = F.normalize(random(1, 5) + 0.1 * random(GAUSSIANS, 6), dim=1)
    features[::100] = F.normalize(thing, dim=0)
    (doubt,) = scene_of(features, {"thing": thing}).ask("thing")
    assert doubt == pytest.approx(1 / (1 + len(UNRELATED))) and doubtful("thing", doubt) is None


def test_absent_things_are_below_x_no_more_often_than_x():
    """The law of a p-value, for words drawn as the unrelated ones are."""
    absent = {str(i): vector for i, vector in enumerate(random(2_000, 9))}
    features = F.normalize(random(3, 5)[torch.arange(GAUSSIANS) % 3] + 0.2 * random(GAUSSIANS, 6), dim=1)
    found = torch.tensor(scene_of(features, absent).ask(*absent))
    for x in (0.05, DOUBTFUL, 0.5):
        assert (found <= x).double().mean() < x + 0.12  # one scene, 60 words: 2 deviations of the 60
    assert (found > DOUBTFUL).double().mean() > 0.75


@pytest.mark.parametrize(("others", "said"), [(0, False), (1, False), (2, True), (30, True)])
def test_at_most_one_unrelated_word_may_fit_as_well_and_taught_words_have_their_own_limit(others, said):
    doubt = (1 + others) / (1 + len(UNRELATED))
    assert (doubtful("dome", doubt) is not None) is said
    assert (doubtful("dome", doubt, taught=True) is not None) is (doubt > 0.1)


def test_the_best_gaussians_decide_whatever_their_order():
    relevancy = torch.linspace(0, 1, 1_000)[None]
    best = relevancy[0, -5:].mean()
    torch.testing.assert_close(peaks(relevancy), best[None])
    torch.testing.assert_close(peaks(relevancy[:, torch.randperm(1_000)]), best[None])


def test_no_more_than_a_few_words_are_asked_together():
    """All of them to millions of Gaussians would take gigabytes; the answers are the same."""
    doubts, asked = scene_of(random(GAUSSIANS, 3), {}), []
    whole = peaks(doubts.relevancy(doubts.queries(UNRELATED)))
    watched = Doubts(lambda q: asked.append(len(q.vectors)) or doubts.relevancy(q), doubts.queries)
    torch.testing.assert_close(watched.unrelated, whole, rtol=1e-5, atol=1e-6)
    assert max(asked) <= 8 and sum(asked) >= len(UNRELATED)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_hardly_any_gaussians_are_no_trouble(count):
    (doubt,) = scene_of(random(count, 3), {"thing": torch.ones(CHANNELS)}).ask("thing")
    assert 0 < doubt <= 1


def test_a_scene_without_known_gaussians_doubts_everything():
    assert scene_of(torch.zeros(GAUSSIANS, CHANNELS), {"thing": torch.ones(CHANNELS)}).ask("thing") == [1.0]


@pytest.mark.parametrize(
    ("level", "expected"), [(0.0, 1.0), (0.99 * LEAST_PEAK, 1.0), (1.01 * LEAST_PEAK, 1 / 61), (0.9, 1 / 61)]
)
def test_what_fits_nowhere_is_doubted_though_unrelated_words_fit_even_less(level, expected):
    nothing = Doubts(
        lambda queries: torch.zeros(len(queries.positive), GAUSSIANS),
        lambda texts: Queries.of([torch.ones(1, 2)] * len(texts), torch.ones(1, 2)),
    )
    assert nothing.of(torch.full((1, GAUSSIANS), level)) == pytest.approx([expected])


def test_doubt_is_said_with_the_text_and_the_share():
    said = doubtful("blorptag", 0.84)
    assert said is not None and "84%" in said and "'blorptag'" in said
