"""The build of gsplat's kernels: what it needs, what interrupts it, and one real build of a small source."""

import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.rendering import gsplat_build
from lang3dxl_ns.rendering.gsplat_build import Need, find_toolkit

SOURCE = """
#include <Python.h>
#include <cub/cub.cuh>

__global__ void twice(float *x) { x[threadIdx.x] *= 2; }

static PyObject *scratch(PyObject *, PyObject *count) {
  size_t bytes = 0;
  cub::DeviceScan::InclusiveSum(nullptr, bytes, (int *)nullptr, (int *)nullptr, (int)PyLong_AsLong(count));
  return PyLong_FromSize_t(bytes);
}

static PyMethodDef methods[] = {{"scratch", scratch, METH_O, nullptr}, {nullptr}};
static PyModuleDef module = {PyModuleDef_HEAD_INIT, "tiny", nullptr, -1, methods};
PyMODINIT_FUNC PyInit_tiny() { return PyModule_Create(&module); }
"""
TOOLKIT = find_toolkit(torch.version.cuda or "0")


@pytest.fixture
def build(tmp_path, monkeypatch):
    """Builds a small source into a folder."""
    sources = tmp_path / "sources"
    sources.mkdir()
    (sources / "tiny.cu").write_text(SOURCE)
    monkeypatch.setattr(gsplat_build, "_sources", lambda: sources)
    monkeypatch.setattr(gsplat_build, "NAME", "tiny")
    return lambda folder: gsplat_build.build(folder, "8.6")


@pytest.fixture
def fake_compiler(monkeypatch):
    """Replaces the compiler by Python code that is given the build's folder as sys.argv[1]."""
    monkeypatch.setattr(gsplat_build, "find_toolkit", lambda _: Path("/nowhere"))
    monkeypatch.setattr(gsplat_build, "needs", lambda _=None: [])

    def install(code: str) -> None:
        head = "import json, sys, pathlib; f = pathlib.Path(json.loads(sys.argv[1])['build_directory'])\n"
        monkeypatch.setattr(gsplat_build, "_COMPILE", head + code)

    return install


@pytest.mark.nightly
@pytest.mark.skipif(TOOLKIT is None, reason="needs pip install -e '.[cuda]'")
def test_cub_is_compiled_linked_and_loaded(build, tmp_path):
    """About 20 seconds of processor time."""
    library = build(tmp_path / "build")
    assert gsplat_build.load(library).scratch(10_000) >= 0
    before = library.stat().st_mtime_ns
    assert build(tmp_path / "build").stat().st_mtime_ns == before


def test_the_environments_compiler_comes_before_the_systems(tmp_path, monkeypatch):
    def toolkit(folder: Path, release: str) -> Path:
        for place in ("bin/nvcc", "include/cuda_runtime.h", "include/cub/cub.cuh"):
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).touch()
        (folder / "bin/nvcc").write_text(f"#!/bin/sh\necho release {release}, V1\n")
        (folder / "bin/nvcc").chmod(0o755)
        return folder

    pip, system = toolkit(tmp_path / "pip", "13.2"), toolkit(tmp_path / "system", "13.0")
    old = toolkit(tmp_path / "old", "12.4")
    monkeypatch.setattr(gsplat_build, "_toolkit_places", lambda _: [pip, system])
    assert find_toolkit("13.2") == pip
    shutil.rmtree(pip / "include")
    assert find_toolkit("13.2") == system
    monkeypatch.setattr(gsplat_build, "_toolkit_places", lambda _: [old])
    assert find_toolkit("13.2") is None


def test_what_is_missing_is_named_with_its_remedy(build, tmp_path, monkeypatch):
    monkeypatch.setattr(gsplat_build, "needs", lambda _: [Need("ninja", None, "pip install ninja")])
    with pytest.raises(UserError, match="ninja is missing: pip install ninja"):
        build(tmp_path / "build")
    assert not (tmp_path / "build").exists()


def test_a_machine_without_compilers_lacks_them(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    monkeypatch.setattr(gsplat_build, "_toolkit_places", lambda _: [])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e8))
    monkeypatch.setattr(gsplat_build, "machine_memory", lambda: 2e9)
    missing = {n.what.partition(",")[0] for n in gsplat_build.needs(tmp_path) if n.found is None}
    assert missing >= {"C++ compiler", "ninja", "memory", "disk"}
    assert any(name.startswith("nvcc") for name in missing)


@pytest.mark.parametrize(("name", "trouble"), [("plain", None), ("two words", "a space in its name")])
def test_a_folder_with_a_space_is_refused_before_the_compiler_trips_over_it(name, trouble, tmp_path):
    (disk,) = (need for need in gsplat_build.needs(tmp_path / name) if need.what.startswith("disk"))
    assert (disk.found is None) is (trouble is not None)
    assert trouble is None or (trouble in disk.remedy and "TORCH_EXTENSIONS_DIR" in disk.remedy)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("print('fine\\ntiny.cu(3): error: expected'); sys.exit(1)", r"tiny.cu\(3\): error: expected"),
        ("import os; os.kill(os.getpid(), 9)", "signal 9 stopped it, perhaps for lack of memory"),
    ],
)
def test_a_failed_build_is_one_line_with_the_reason_and_the_log(code, reason, build, tmp_path, fake_compiler):
    fake_compiler(code)
    with pytest.raises(UserError, match=reason) as error:
        build(tmp_path / "build")
    assert "\n" not in str(error.value) and str(tmp_path / "build" / "build.log") in str(error.value)


def test_a_half_built_folder_is_completed(build, tmp_path, fake_compiler):
    """A library without the mark of completeness may be cut off."""
    folder = tmp_path / "build"
    fake_compiler("(f / 'one.o').touch(); (f / 'tiny.so').write_text('half'); sys.exit(1)")
    with pytest.raises(UserError, match="failed"):
        build(folder)
    assert gsplat_build.built(folder) is None
    (folder / "lock").touch()  # of an older torch, which would wait for its holder
    fake_compiler(
        "assert (f / 'one.o').exists() and not (f / 'lock').exists(); (f / 'tiny.so').write_text('whole')"
    )
    assert build(folder).read_text() == "whole"
    assert gsplat_build.built(folder) is not None


def test_two_builds_at_once_share_one(build, tmp_path, fake_compiler):
    fake_compiler("import time; time.sleep(1); open(f / 'count', 'a').write('x'); (f / 'tiny.so').touch()")
    threads = [threading.Thread(target=build, args=(tmp_path / "build",)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "build" / "count").read_text() == "x"


def test_ctrl_c_ends_the_compilers_too(build, tmp_path, fake_compiler, monkeypatch):
    fake_compiler("import os, time; (f / 'pid').write_text(str(os.getpid())); time.sleep(60)")

    wait = subprocess.Popen.wait
    pid = tmp_path / "build" / "pid"

    def interrupted(process, timeout=None):
        monkeypatch.setattr(subprocess.Popen, "wait", wait)
        while not pid.is_file() or not pid.read_text():
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "build")
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_a_folder_that_cannot_be_written_is_named(build, tmp_path, fake_compiler):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"can't be built in .*file"):
        build(tmp_path / "file" / "build")


def test_without_gsplat_torch_renders_and_says_so(monkeypatch, capsys):
    def fail() -> None:
        raise UserError("ninja is missing: pip install ninja")

    monkeypatch.setattr(gsplat_build, "make_ready", fail)
    gsplat_build.ready.cache_clear()
    assert not gsplat_build.ready()
    assert not gsplat_build.ready()
    gsplat_build.ready.cache_clear()
    told = capsys.readouterr().out
    assert told.count("pip install ninja") == 1
    assert "many times slower" in told


def test_a_loaded_build_is_gsplats(tmp_path):
    """gsplat looks for its compiled module before it builds its own."""
    code = """
import sys, types, gsplat
kernels = types.ModuleType("gsplat.csrc")
gsplat.csrc = sys.modules["gsplat.csrc"] = kernels
from gsplat.cuda._backend import _C
from lang3dxl_ns.rendering import gsplat_build
gsplat_build.make_ready()  # has nothing to do
print(_C is kernels)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("True")


def test_a_damaged_library_is_built_again(monkeypatch, tmp_path):
    import gsplat

    damaged, rebuilt = tmp_path / f"{gsplat_build.NAME}.so", tmp_path / "rebuilt.py"
    damaged.write_bytes(b"no library")
    rebuilt.write_text("complete = True")
    (tmp_path / "done").touch()
    monkeypatch.setattr(gsplat_build, "device_arch", lambda: "8.6")
    monkeypatch.setattr(gsplat_build, "build_folder", lambda _: tmp_path)
    monkeypatch.setattr(gsplat_build, "build", lambda *_: rebuilt)
    try:
        gsplat_build.make_ready()
        assert gsplat.csrc.complete and not damaged.exists()
    finally:
        sys.modules.pop("gsplat.csrc", None)
        vars(gsplat).pop("csrc", None)


def test_a_toolkit_with_the_whole_chain_of_links_is_linked(tmp_path):
    """conda and systems have libcudart.so.13 and libcudart.so.13.2.51; pip has one of them."""
    (tmp_path / "lib").mkdir()
    for name in ("libcudart.so.13", "libcudart.so.13.2.51"):
        (tmp_path / "lib" / name).touch()
    for _ in range(2):  # an interrupted build goes on
        folder = gsplat_build._linkable(tmp_path, tmp_path / "links")
        assert (folder / "libcudart.so").resolve().parent == tmp_path / "lib"


@pytest.mark.parametrize(("gpus", "arch"), [(0, "7.0;8.0;9.0"), (1, "8.6")])
def test_an_images_list_of_architectures_counts_only_without_a_gpu(monkeypatch, gpus, arch):
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "7.0;8.0;9.0")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: ["sm_86"])
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (8, 6))
    assert gsplat_build.device_arch() == arch
