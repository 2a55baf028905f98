"""Building and loading of gsplat's CUDA kernels on this machine, before any work starts.

gsplat's own build starts when the first frame is rendered, runs ten compilers at a time whatever the memory,
and deletes its folder when it is interrupted. This build keeps what is compiled, and needs no system CUDA
toolkit: `pip install -e '.[cuda]'` brings the compilers of torch's CUDA.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch
from filelock import FileLock, Timeout

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory

JOB_BYTES, BUILD_BYTES = 3.5e9, 0.5e9
"""Most memory that one compiler takes, and disk space that a build takes."""
UNITS = 6
"""Number of translation units for the CUDA sources. Each one pays over a minute for torch's headers."""
NAME = "gsplat_cuda"
_COMPILE = "import json, sys; from torch.utils.cpp_extension import load; load(**json.loads(sys.argv[1]))"


class Need(NamedTuple):
    """A prerequisite of the build; nothing was found if it is missing."""

    what: str
    found: str | None
    remedy: str


def _package(name: str) -> list[Path]:
    found = importlib.util.find_spec(name)
    return [Path(folder) for folder in (found and found.submodule_search_locations) or ()]


def find_toolkit(cuda: str) -> Path | None:
    """Find a toolkit of the major version of torch's CUDA ("13.2")."""
    major = cuda.partition(".")[0]
    for home in _toolkit_places(major) if major else ():
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            nvcc = [str(home / "bin" / "nvcc"), "--version"]
            told = subprocess.run(nvcc, capture_output=True, text=True, timeout=30).stdout
            if f"release {major}." in told and _headers(home):
                return home
    return None


def _toolkit_places(major: str) -> list[Path]:
    """List the environment's packages, then where torch looks, then versions beside the system's default."""
    nvcc = shutil.which("nvcc")
    named = os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), nvcc and Path(nvcc).resolve().parents[1]
    others = sorted(Path("/usr/local").glob(f"cuda-{major}*"), reverse=True)
    pip = [folder / f"cu{major}" for folder in _package("nvidia")]
    return [*pip, *(Path(home) for home in named if home), Path("/usr/local/cuda"), *others]


def _headers(home: Path) -> list[Path]:
    """Return the folders with cub's headers. A toolkit without them cannot be used."""
    include = home / "include"
    folders = (include / "cccl", include) if (include / "cuda_runtime.h").is_file() else ()
    return [folder for folder in folders if (folder / "cub" / "cub.cuh").is_file()]


def needs(folder: Path) -> list[Need]:
    """Return everything that a build in a folder needs, found or not."""
    cuda, python = torch.version.cuda or "", "python{}.{}".format(*sys.version_info)
    toolkit, header = find_toolkit(cuda), Path(sysconfig.get_paths()["include"]) / "Python.h"
    there = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    free, memory = shutil.disk_usage(there).free, machine_memory()
    trouble = "" if free > BUILD_BYTES and os.access(there, os.W_OK) else "full, or not writable"
    if re.search(r"\s", str(folder.absolute())):
        trouble = "a space in its name, which the compilers' rules can't hold"
    nvcc = f"install the CUDA toolkit {cuda} and set CUDA_HOME to it, or torch's CUDA 13 build"
    if cuda.startswith("13."):
        nvcc = f"pip install -e '.[cuda]' (or a system CUDA toolkit {cuda}, with CUDA_HOME at it)"
    apt, cub = f"apt install g++ {python}-dev", f"nvcc and cub of CUDA {cuda.partition('.')[0] or '13'}"
    compiler, ninja = (shutil.which(x, path=_path()) for x in (os.environ.get("CXX", "g++"), "ninja"))
    disk = f"{trouble}: free half a gigabyte, or set TORCH_EXTENSIONS_DIR"
    return [
        Need("torch with CUDA", cuda or None, "https://pytorch.org/get-started/locally"),
        Need(cub, str(toolkit) if toolkit else None, nvcc),
        Need("C++ compiler", compiler, apt),
        Need("Python.h", str(header) if header.is_file() else None, apt),
        Need("ninja", ninja, "pip install ninja"),
        Need("memory", f"{memory / 1e9:.1f} GB" if memory >= JOB_BYTES else None, "a build takes 3.5 GB"),
        Need(f"disk, {folder}", None if trouble else f"{free / 1e9:.1f} GB free", disk),
    ]


def _path(*first: Path) -> str:
    """Return PATH with the environment's programs first, whether it is activated or not."""
    places = *first, Path(sys.executable).parent, os.environ.get("PATH", os.defpath)
    return os.pathsep.join(map(str, places))


def device_arch() -> str:
    """Return the compute capabilities of the visible GPUs, as nvcc and torch know them: "8.6", "7.5;8.6". A
    GPU that is too new for torch gets the newest one that torch knows, compiled by the driver (+PTX).
    TORCH_CUDA_ARCH_LIST, which container images set to many, counts only without a GPU."""
    gpus = {torch.cuda.get_device_capability(index) for index in range(torch.cuda.device_count())}
    if not gpus:
        return os.environ.get("TORCH_CUDA_ARCH_LIST", "")
    known = [re.match(r"sm_(\d+)(\d)", name) for name in torch.cuda.get_arch_list()]
    newest = max(((int(sm[1]), int(sm[2])) for sm in known if sm), default=(99, 9))
    return ";".join(sorted("{}.{}".format(*min(gpu, newest)) + "+PTX" * (gpu > newest) for gpu in gpus))


def build_folder(arch: str) -> Path:
    """Return the folder of gsplat's build for these GPUs and the versions installed."""
    cache = Path(os.environ.get("TORCH_EXTENSIONS_DIR") or Path.home() / ".cache" / "lang3dxl").expanduser()
    cuda, sm = torch.version.cuda, re.sub(r"[^\w+]", "-", arch.replace(".", ""))
    versions = f"{version('gsplat')}-torch-{torch.__version__.partition('+')[0]}-cuda-{cuda}"
    return cache / "gsplat-{}-py{}{}-sm-{}".format(versions, *sys.version_info[:2], sm)


def built(folder: Path) -> Path | None:
    """Return the library if it was built completely."""
    library = folder / f"{NAME}.so"
    return library if (folder / "done").is_file() and library.is_file() else None


def build(folder: Path, arch: str) -> Path:
    """Compile gsplat's kernels into a folder, with the output in build.log, and return the library. An
    interrupted build is continued, and another process that builds there is waited for. Raises UserError if
    something is missing, or the compiler failed."""
    missing = [f"{need.what} is missing: {need.remedy}" for need in needs(folder) if need.found is None]
    if missing:
        raise UserError("gsplat's CUDA kernels can't be built here. " + ". ".join(missing))
    lock = FileLock(folder / "building")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            say(f"Another process is building gsplat's CUDA kernels in {folder}: waiting for it")
            lock.acquire()
        return built(folder) or _compile(folder, arch)
    except OSError as error:
        raise UserError(f"gsplat's CUDA kernels can't be built in {folder} ({error})") from error
    finally:
        lock.release()


def _compile(folder: Path, arch: str) -> Path:
    toolkit, sources = find_toolkit(torch.version.cuda or ""), _sources()
    assert toolkit is not None
    jobs = str(max(1, min(os.cpu_count() or 1, int(machine_memory() / JOB_BYTES))))
    jobs = os.environ.get("MAX_JOBS", jobs)
    libraries = str(_linkable(toolkit, folder / "lib")), os.environ.get("LIBRARY_PATH")
    environment = {**os.environ, "MAX_JOBS": jobs, "TORCH_CUDA_ARCH_LIST": arch, "CUDA_HOME": str(toolkit)}
    environment["PATH"] = _path(toolkit / "bin")
    environment["LIBRARY_PATH"] = os.pathsep.join(filter(None, libraries))
    included = sources, sources / "third_party" / "glm", *_headers(toolkit)
    arguments = {
        "name": NAME,
        "sources": [str(path) for path in _united(sources, folder)],
        "extra_cflags": ["-O3"],
        "extra_cuda_cflags": ["-O3", "--use_fast_math"],
        "extra_include_paths": list(map(str, included)),
        "build_directory": str(folder),
        "verbose": True,
    }
    (folder / "lock").unlink(missing_ok=True)  # older versions of torch would wait forever for its holder
    log, start, library = folder / "build.log", time.monotonic(), folder / f"{NAME}.so"
    say(
        f"Building {NAME} for compute capability {arch} with {jobs} jobs: once, for some minutes. "
        f"Interrupted, it goes on next time. Log: {log}"
    )
    command = [sys.executable, "-c", _COMPILE, json.dumps(arguments)]
    with log.open("w") as output:
        status = subprocess.run(command, stdout=output, stderr=output, env=environment).returncode
    if status != 0 or not library.is_file():
        lines = log.read_text(errors="replace").splitlines() or ["no output"]
        named = (line.strip() for line in lines if re.search(r"error|Error|No space|Killed", line))
        reason = next(named, lines[-1])[:300]
        if status < 0:
            reason = f"signal {-status} stopped it, perhaps for lack of memory (MAX_JOBS=1 takes less)"
        raise UserError(f"building {NAME} failed: {reason} (the whole output: {log})")
    # This file also marks a complete build.
    (folder / "done").write_text(f"{time.monotonic() - start:.0f} s with {jobs} job(s)\n")
    return library


def _linkable(toolkit: Path, folder: Path) -> Path:
    """Return the folder with a link libcudart.so, which the linker looks for, and pip's packages lack."""
    folder.mkdir(exist_ok=True)
    for runtime in sorted((toolkit / "lib").glob("libcudart.so.*"))[:1]:  # several are links to one file
        (folder / "libcudart.so").unlink(missing_ok=True)
        (folder / "libcudart.so").symlink_to(runtime)
    return folder


def _sources() -> Path:
    return _package("gsplat")[0] / "cuda" / "csrc"


def _united(sources: Path, folder: Path) -> list[Path]:
    """Return the sources, with the CUDA ones merged into a few files that include them. A file is written
    only if it changes, so that compiled objects stay valid."""
    cuda = sorted(sources.glob("*.cu"), key=lambda path: path.stat().st_size)
    units = [folder / f"unit_{number}.cu" for number in range(min(UNITS, len(cuda)))]
    for number, unit in enumerate(units):
        text = "".join(f'#include "{path}"\n' for path in cuda[number::UNITS])
        if not unit.is_file() or unit.read_text() != text:
            unit.write_text(text)
    return [*units, *sorted(sources.glob("*.cpp"))]


def load(library: Path) -> ModuleType:
    """Import a built library."""
    spec = importlib.util.spec_from_file_location(library.stem, library)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_ready() -> None:
    """Load gsplat's kernels for this machine's GPUs, building them first if necessary. Raises UserError that
    says what is missing and how to get it."""
    import gsplat

    with contextlib.suppress(ImportError):
        from gsplat import csrc  # noqa: F401  in a wheel that has them, or loaded before

        return
    if torch.version.hip is not None:
        raise UserError("gsplat's kernels run on NVIDIA's GPUs, and this one is AMD's")
    arch = device_arch()
    folder = build_folder(arch)
    library = built(folder) or build(folder, arch)
    try:
        kernels = load(library)
    except ImportError:  # the library is damaged
        library.unlink()
        kernels = load(build(folder, arch))
    gsplat.csrc = sys.modules["gsplat.csrc"] = kernels


@functools.cache
def ready() -> bool:
    """Return whether gsplat can render, building it if necessary. If not, say why, and that torch renders."""
    try:
        make_ready()
    except UserError as error:
        say(
            f"Warning: {error}. Until then the torch rasterizer renders on this GPU, correct but many times "
            "slower than gsplat. `lang3dxl doctor --build` tries again."
        )
        return False
    return True
