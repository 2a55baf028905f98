"""The GPU benchmark with small sizes, on a fake GPU (tests/fake_gpu.py) and on a real one if there is one."""

import pytest
import torch
from fake_gpu import fake_gpu, real_gpu

from lab.benchmarks import gpu as benchmark

REAL = [pytest.param(real_gpu, marks=pytest.mark.cuda, id="real")] if torch.cuda.is_available() else []


@pytest.mark.parametrize("gpu", [pytest.param(fake_gpu, id="fake"), *REAL])
def test_it_writes_a_file_and_keeps_finished_parts(tmp_path, monkeypatch, gpu):
    # Of these few steps three numbers are never enough, and six take ten times as long.
    monkeypatch.setattr("lang3dxl_ns.components.compression.CODE_DIMS", (3,))
    measure = benchmark.times_of_parts
    monkeypatch.setattr(benchmark, "times_of_parts", lambda parts, repeats=1: measure(parts, 1))
    with gpu():
        benchmark.GpuBenchmark(tmp_path, quick=True).main()
        report = (tmp_path / "gpu.md").read_text()
        monkeypatch.setattr(benchmark, "step", lambda *_: pytest.fail("measured again"))
        (tmp_path / "gpu.md").unlink()
        benchmark.GpuBenchmark(tmp_path, quick=True).main()
    assert (tmp_path / "gpu.md").read_text() == report
    assert "hard cases are within their bounds" in report
