"""Memory that is full, in the words of torch, CUDA and its libraries."""

import pytest
import torch

from lang3dxl_ns import cli
from lang3dxl_ns.common.memory import ran_out_of_memory, with_less_memory


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        RuntimeError("CUDA error: out of memory\nCUDA kernel errors might be reported later"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
    ],
)
def test_a_full_memory_is_known_in_every_form(error, monkeypatch):
    tried = []

    def work(amount):
        tried.append(amount)
        if amount > 2:
            raise error
        return amount

    assert with_less_memory(work, 8) == 2 and tried == [8, 4, 2]

    def full(words):
        raise error

    monkeypatch.setattr(cli, "_parsed", full)
    with pytest.raises(SystemExit, match="out of memory: give a smaller --size"):
        cli.main(["query", "x"])


def test_other_errors_are_not_called_so():
    assert not ran_out_of_memory(RuntimeError("CUDA error: an illegal memory access was encountered"))
