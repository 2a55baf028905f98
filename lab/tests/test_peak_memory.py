"""Peak memory is that of the work alone."""

import pytest
import torch

from lab.benchmarks.peak_memory import MEBIBYTE, peak_memory


def hold_megabytes(megabytes):
    """Work that holds two tensors, after a set-up that held (and freed) eight times as much."""
    torch.ones(16 * megabytes * MEBIBYTE // 4).sum()

    def work():
        first = torch.ones(megabytes * MEBIBYTE // 4)
        return first + 1

    return work


def test_peak_memory_counts_what_the_work_holds_and_not_its_setup():
    assert peak_memory(hold_megabytes, 50) / MEBIBYTE == pytest.approx(100, abs=10)
