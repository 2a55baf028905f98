"""Where numba can't be had, torch takes its place."""

import sys

import numba
import pytest
import torch

from lang3dxl_ns.common import jit
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.kernels import numba_works, takes_kernels


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("raise ImportError('numpy is too new')", True),
        ("import nosuchllvm", True),
        ("1 / 0", True),
        (None, False),
    ],
)
def test_a_broken_numba_is_told_of_and_a_missing_one_is_not(tmp_path, monkeypatch, capsys, content, told):
    monkeypatch.delenv("LANG3DXL_CPU_KERNELS", raising=False)
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    if content is None:
        monkeypatch.setitem(sys.modules, "numba", None)
    else:
        (tmp_path / "numba.py").write_text(content)
        monkeypatch.syspath_prepend(tmp_path)
    numba_works.cache_clear()
    try:
        assert not takes_kernels(torch.zeros(3)) and not takes_kernels(torch.zeros(3))
    finally:
        numba_works.cache_clear()
    assert capsys.readouterr().out.count("numba does not work") == told


def test_a_numba_that_loads_but_does_not_compile_is_told_of(monkeypatch, capsys):
    def fails(number):
        raise OSError("LLVM ERROR: unsupported processor")

    monkeypatch.delenv("LANG3DXL_CPU_KERNELS", raising=False)
    monkeypatch.setattr(jit, "successor", fails)
    numba_works.cache_clear()
    try:
        assert not takes_kernels(torch.zeros(3))
    finally:
        numba_works.cache_clear()
    assert "numba does not work (LLVM ERROR: unsupported processor)" in " ".join(
        capsys.readouterr().out.split()
    )


def test_a_numba_that_is_told_not_to_compile_is_left_alone(monkeypatch, capsys):
    """Python itself would run the kernels, for hours."""
    monkeypatch.delenv("LANG3DXL_CPU_KERNELS", raising=False)
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    numba_works.cache_clear()
    try:
        assert not takes_kernels(torch.zeros(3))
    finally:
        numba_works.cache_clear()
    assert "NUMBA_DISABLE_JIT is set" in capsys.readouterr().out


def test_an_unknown_name_of_kernels_is_an_error(monkeypatch):
    monkeypatch.setenv("LANG3DXL_CPU_KERNELS", "nubma")
    with pytest.raises(UserError, match="LANG3DXL_CPU_KERNELS is 'nubma'"):
        takes_kernels(torch.zeros(3))
