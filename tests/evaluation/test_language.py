"""Language scores of the field and its teacher, by the same rules."""

import numpy as np
import torch
from label_sets import write_plain

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.language import LanguageScorer


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
    scorer = LanguageScorer(GroundTruth(tmp_path), OneHot(["domes"]))
    features = torch.zeros(40, 60, 8)
    features[..., 7] = 1
    features[torch.from_numpy(mask)] = torch.eye(8)[0]
    size = (20, 30)
    cosines = scorer.queries.cosines(features)
    field = scorer.named(scorer.queries.relevancy_of_cosines(cosines), size)
    teacher = scorer.teacher_maps(features, size)
    assert scorer.scores("0001.jpg", field)["ap_domes"] == 1.0
    assert scorer.scores("0001.jpg", teacher, "teacher_")["teacher_ap_domes"] == 1.0
