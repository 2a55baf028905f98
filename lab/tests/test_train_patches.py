"""The patch head's fit: patches are read as the texts of what they show, also if only their context tells."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from lab.clip_training.captions import CLASSES, MAY_BE
from lab.clip_training.train_patches import averaged, fit
from lang3dxl_ns.preparation.families import PatchHead

WIDTH, CHANNELS, COUNT = 24, 32, 6_000


@pytest.mark.parametrize("told_by", ["patch", "context", "both"])
def test_patches_are_read_as_the_texts_of_what_they_show(told_by):
    """`both`: neither the patch nor its context tells alone what is shown, only their combination."""
    torch.manual_seed(0)
    number = len(CLASSES)
    texts = F.normalize(torch.randn(number, CHANNELS), dim=-1)
    free = [k for k in range(number) if MAY_BE[k, :number].sum() <= MAY_BE[k, k]]  # may show nothing unnamed
    assert len(free) >= 4
    free = free[:4]
    kind = torch.randint(4, (COUNT,))
    fine, coarse = {"patch": (kind, kind * 0), "context": (kind * 0, kind), "both": (kind % 2, kind // 2)}[
        told_by
    ]
    centers = 3 * torch.randn(2, 4, WIDTH)
    tokens = torch.stack([centers[0, coarse], centers[1, fine]]) + 0.3 * torch.randn(2, COUNT, WIDTH)
    tokens = F.normalize(tokens, dim=-1)
    shown = torch.tensor(free)[kind]
    head = PatchHead(WIDTH, CHANNELS, 2, 16)

    def right() -> float:
        with torch.no_grad():
            found = (head(tokens) @ texts.T)[:, free].argmax(1)
        return float((found == kind).float().mean())

    before = right()
    fit(head, [((tokens, F.one_hot(shown, number).float()), 1.0)], texts, 300)
    assert before < 0.6 < 0.95 < right()


def test_the_mean_of_two_heads_is_one_head():
    heads = [PatchHead(WIDTH, CHANNELS, 2, hidden).eval() for hidden in (16, 24)]
    for head in heads:
        for parameter in head.norm.parameters():
            torch.nn.init.normal_(parameter)
    tokens = F.normalize(torch.randn(2, 50, WIDTH), dim=-1)
    torch.testing.assert_close(averaged(*heads)(tokens), (heads[0](tokens) + heads[1](tokens)) / 2)
