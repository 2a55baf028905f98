"""The patch head's fit: patches are read as the texts of what they show, whatever their world's share."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from lab.clip_training.captions import CLASSES, MAY_BE
from lab.clip_training.train_patches import fit


def test_patches_are_read_as_the_texts_of_what_they_show():
    torch.manual_seed(0)
    number, width, channels, count = len(CLASSES), 40, 32, 6_000
    texts = F.normalize(torch.randn(number, channels), dim=-1)
    centers = 3 * torch.randn(number, width)
    free = [k for k in range(number) if MAY_BE[k, :number].sum() <= MAY_BE[k, k]]  # may show nothing unnamed
    assert len(free) > 2
    shown = torch.tensor(free)[torch.randint(len(free), (count,))]
    tokens = centers[shown] + 0.3 * torch.randn(count, width)
    world = tokens, F.one_hot(shown, number).float()
    start = 0.1 * torch.randn(channels, width)
    head = fit([(world, 1.0)], texts, start, 300)

    def right(weight: torch.Tensor, bias: torch.Tensor) -> float:
        found = (F.linear(tokens, weight, bias) @ texts.T)[:, free].argmax(1)
        return float((torch.tensor(free)[found] == shown).float().mean())

    assert right(start, torch.zeros(channels)) < 0.6 < 0.95 < right(head["weight"], head["bias"])
