"""Compiled kernels: logged once, cached on disk, compiled anew without a writable cache."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from processes import Process

from lang3dxl_ns.common import jit
from lang3dxl_ns.common.jit import in_threads

MODULE = """
from lang3dxl_ns.common.jit import kernel

@kernel
def doubled(values):
    return 2 * values
"""


def call_the_smallest_kernel(folder: Path, environment: dict[str, str]) -> None:
    os.environ.update(environment)
    sys.path.insert(0, str(folder))
    from jit_module import successor

    print(successor(1))


def call_the_kernel(folder: Path, environment: dict[str, str]) -> None:
    os.environ.update(environment)
    sys.path.insert(0, str(folder))
    from kernel_module import doubled

    print(doubled(np.arange(3.0)))


@pytest.fixture
def run(tmp_path):
    """Call a kernel in a separate process; returns its output."""
    (tmp_path / "kernel_module.py").write_text(MODULE)

    def program(**environment: str) -> str:
        done = Process(call_the_kernel, tmp_path, environment).wait()
        assert done.returncode == 0, done.stderr
        return done.stdout

    return program


def test_a_kernel_is_compiled_once_with_a_word_and_then_read_from_the_disk(run):
    first, second = run(), run()
    assert first.count("Compiling") == 1
    assert "Compiling" not in second
    assert first.endswith("[0. 2. 4.]\n") and second.endswith("[0. 2. 4.]\n")


def test_a_kernel_is_compiled_anew_when_a_source_that_kernels_share_changes(run, tmp_path):
    """Their constants and small functions are compiled into it."""
    run()
    changed = "from lang3dxl_ns.common import jit\n\njit._shared_sources = lambda: 'changed'\n"
    (tmp_path / "kernel_module.py").rename(tmp_path / "same.py")
    (tmp_path / "kernel_module.py").write_text(f"{changed}from same import doubled\n")
    again = "from same import doubled\n"
    assert run().count("Compiling") == 1  # this file's first kernel
    assert run().count("Compiling") == 0
    (tmp_path / "kernel_module.py").write_text(again)
    assert run().count("Compiling") == 1


def test_without_a_folder_that_can_be_written_a_kernel_is_compiled_anew(run, tmp_path):
    (tmp_path / "__pycache__").write_text("a file where the folder would be")
    for _ in range(2):
        printed = run(XDG_CACHE_HOME=str(tmp_path / "__pycache__" / "cache"))
        assert printed.count("Compiling") == 1
        assert printed.endswith("[0. 2. 4.]\n")
    assert not list(Path(tmp_path).rglob("*.nbi"))


@pytest.mark.parametrize("left", ["nbi", "nbc", "folder"])
def test_a_cache_that_a_loss_of_power_left_empty_is_made_anew(run, tmp_path, left):
    run()
    files = [path for path in tmp_path.rglob("*.nb*") if left == "folder" or path.suffix == f".{left}"]
    for path in files:
        path.write_bytes(b"")
        if left == "folder":  # neither read nor written
            path.unlink()
            path.mkdir()
    assert files and all(run().endswith("[0. 2. 4.]\n") for _ in range(2))
    if left != "folder":
        assert run().count("Compiling") == 0


def test_the_probe_of_the_compiler_needs_no_folder_that_can_be_written(tmp_path):
    (tmp_path / "jit_module.py").write_text(Path(jit.__file__).read_text())
    (tmp_path / "__pycache__").write_text("a file where the folder would be")
    environment = {"XDG_CACHE_HOME": str(tmp_path / "__pycache__" / "cache")}
    done = Process(call_the_smallest_kernel, tmp_path, environment).wait()
    assert done.returncode == 0 and done.stdout.endswith("2\n"), done.stderr


def test_threads_return_results_in_the_order_of_the_arguments():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert in_threads(lambda a, b: a * b, [(k, k) for k in range(20)]) == [k * k for k in range(20)]
    finally:
        torch.set_num_threads(before)
    assert in_threads(np.sum, []) == []


def test_kernels_of_different_numbers_of_parts_share_one_pool(monkeypatch):
    made, before = [], torch.get_num_threads()
    pool = jit.ThreadPoolExecutor
    monkeypatch.setattr(jit, "ThreadPoolExecutor", lambda *a, **k: made.append(a) or pool(*a, **k))
    jit._pool.cache_clear()
    torch.set_num_threads(8)
    try:
        for parts in (3, 8, 5, 20, 3):
            assert in_threads(lambda k: k, [(k,) for k in range(parts)]) == list(range(parts))
    finally:
        torch.set_num_threads(before)
        jit._pool.cache_clear()
    assert made == [(8,)]
