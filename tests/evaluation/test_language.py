"""Language scores of the field and its teacher, by the same rules."""

import numpy as np
import torch
from label_sets import write_plain

from lang3dxl_ns.evaluation import scores
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.scores import LanguageScorer, MapScorer, resize_map
from lang3dxl_ns.query.relevancy import CANONICAL, TEMPERATURE, calibrated


class OneHot:
    """A text encoder with a channel per phrase."""

    def __init__(self, phrases):
        self.phrases = phrases

    def encode_texts(self, texts):
        return torch.stack([torch.eye(8)[self.phrases.index(t) if t in self.phrases else 7] for t in texts])


def test_field_and_teacher_are_scored_by_the_same_rules(tmp_path):
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    write_plain(tmp_path, "domes", "0001", mask)
    scorer = LanguageScorer(GroundTruth(tmp_path), OneHot(["domes"]).encode_texts)
    features = torch.zeros(40, 60, 8)
    features[..., 7] = 1
    features[torch.from_numpy(mask)] = torch.eye(8)[0]
    size = (20, 30)
    cosines = scorer.queries.cosines(features)
    field = scorer.named(scorer.queries.relevancy_of_cosines(cosines), size)
    teacher = scorer.teacher_maps(features, size)
    assert scorer.scores("0001.jpg", {"": field})["ap_domes"] == 1.0
    assert scorer.scores("0001.jpg", {"teacher_": teacher})["teacher_ap_domes"] == 1.0


def test_published_prompts_are_joined_with_common_words_and_compete_with_canonical_phrases_alone(tmp_path):
    mask = np.zeros((40, 60), bool)
    mask[8:24, 16:48] = True
    for category in ("domes", "portals"):
        write_plain(tmp_path, category, "0001", mask)
    encoder = OneHot(["domes", "portals", "doorway, gate, entrance, portals", "object"])
    published = LanguageScorer(GroundTruth(tmp_path), encoder.encode_texts).published_queries
    cosines = published.cosines(torch.eye(8)[[0, 2]])  # features of a dome, and of a portal by many names
    relevancy = published.relevancy_of_cosines(cosines)
    assert (relevancy > 0.5).tolist() == [[True, False], [False, True]]
    assert len(published.vectors) == 2 + len(CANONICAL)


def test_the_published_variant_alone_is_made_of_published_prompts(tmp_path):
    write_plain(tmp_path, "domes", "0001", np.eye(40, 60, dtype=bool))
    scorer = MapScorer(GroundTruth(tmp_path))
    ours, theirs = {"domes": torch.rand(20, 30)}, {"domes": torch.rand(20, 30)}
    mixed = scorer.variants(ours, of_published_prompts=theirs)
    for prefix, maps in {"": ours, "raw_": ours, "authors_": theirs}.items():
        assert torch.equal(mixed[prefix]["domes"], scorer.variants(maps)[prefix]["domes"])


def test_the_teachers_features_are_interpolated_and_then_compared_in_any_number_of_parts(
    tmp_path, monkeypatch
):
    write_plain(tmp_path, "domes", "0001", np.ones((40, 60), bool))
    scorer = LanguageScorer(GroundTruth(tmp_path), OneHot(["domes"]).encode_texts)
    target = torch.randn(5, 7, 8, generator=torch.Generator().manual_seed(0))
    features = resize_map(target.permute(2, 0, 1), (20, 30)).permute(1, 2, 0)
    temperature = calibrated(TEMPERATURE, scorer.yardstick.cosines(target.flatten(0, 1)))
    expected = scorer.queries.relevancy_of_cosines(scorer.queries.cosines(features), temperature)[0]
    for channels in (3, 8, 64):
        monkeypatch.setattr(scores, "_CHANNELS", channels)
        torch.testing.assert_close(scorer.teacher_maps(target, (20, 30))["domes"], expected)
