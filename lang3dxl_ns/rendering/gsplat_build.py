"""Build of gsplat's CUDA kernels on this machine: compilers, link tree, folder, lock, log; and loading them.

gsplat's own build starts when the first frame is rendered, takes ten compilers at a time whatever the
memory, and deletes its folder when it is interrupted. This one runs before any work, keeps what is compiled,
and needs no system CUDA toolkit: `pip install 'lang3dxl-ns[cuda]'` brings the compilers of torch's CUDA.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.machinery
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from filelock import FileLock, Timeout

from lang3dxl_ns.common.console import progress, say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory

JOB_BYTES = 3.5e9
"""Memory that one compiler takes at most."""
BUILD_BYTES = 0.5e9
"""Disk space of a build."""
INSTALL = "pip install 'lang3dxl-ns[cuda]'"
UNITS = 6
"""Files that the CUDA sources are united to: torch's headers alone take a compiler more than a minute."""
_COMPILE = "import json, sys; from torch.utils.cpp_extension import load; load(**json.loads(sys.argv[1]))"


@dataclass(frozen=True)
class Extension:
    """CUDA and C++ sources that become one Python module."""

    name: str
    sources: Sequence[Path]
    include: Sequence[Path] = ()
    flags: Sequence[str] = ("-O3", "--use_fast_math")
    """For nvcc."""


@dataclass(frozen=True)
class Toolkit:
    """A CUDA toolkit: the folder of bin/, include/, lib or lib64/."""

    home: Path
    release: str
    """Such as 13.2."""
    from_pip: bool
    """Whether it lies in the environment; its libraries then need links before anything can be linked."""


@dataclass(frozen=True)
class Need:
    """One thing that the build needs."""

    what: str
    found: str | None
    """None: missing."""
    remedy: str


def gsplat_extension() -> Extension:
    """gsplat's kernels."""
    found = importlib.util.find_spec("gsplat")
    assert found is not None and found.submodule_search_locations is not None
    source = Path(found.submodule_search_locations[0]) / "cuda" / "csrc"
    sources = sorted([*source.glob("*.cu"), *source.glob("*.cpp")])
    return Extension("gsplat_cuda", sources, [source, source / "third_party" / "glm"])


# ── what is there ───────────────────────────────────────────────────────────────────────────────────────


def find_toolkit(cuda: str) -> Toolkit | None:
    """The environment's toolkit, else the system's, of the same major version as torch's CUDA ("13.2")."""
    major = cuda.partition(".")[0]
    for home, from_pip in _toolkit_places(major):
        nvcc = home / "bin" / "nvcc"
        if not nvcc.is_file() or not any(_headers(home)):
            continue
        release = _release(nvcc)
        if release is not None and release.partition(".")[0] == major:
            return Toolkit(home, release, from_pip)
    return None


def _toolkit_places(major: str) -> Iterator[tuple[Path, bool]]:
    nvidia = importlib.util.find_spec("nvidia")
    for folder in (nvidia and nvidia.submodule_search_locations) or ():
        yield Path(folder) / f"cu{major}", True
    for name in ("CUDA_HOME", "CUDA_PATH"):
        if os.environ.get(name):
            yield Path(os.environ[name]), False
    nvcc = shutil.which("nvcc")
    if nvcc:
        yield Path(nvcc).resolve().parents[1], False
    for place in (Path("/usr/local/cuda"), *sorted(Path("/usr/local").glob(f"cuda-{major}*"), reverse=True)):
        yield place, False


def _headers(home: Path) -> Iterator[Path]:
    """Folders with cub's headers; without them there is no toolkit to use."""
    include = home / "include"
    if (include / "cuda_runtime.h").is_file():
        yield from (p for p in (include / "cccl", include) if (p / "cub" / "cub.cuh").is_file())


def _release(nvcc: Path) -> str | None:
    try:
        told = subprocess.run([nvcc, "--version"], capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    found = re.search(r"release (\d+\.\d+)", told)
    return found and found[1]


def needs(folder: Path | None = None) -> list[Need]:
    """Everything that the build needs, found or not."""
    import torch

    cuda = torch.version.cuda or ""
    toolkit = find_toolkit(cuda) if cuda else None
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    folder = folder or cache_folder()
    there = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    free, memory = shutil.disk_usage(there).free, machine_memory()
    compiler = shutil.which(os.environ.get("CXX", "g++"), path=search_path())
    where = None if toolkit is None else f"{toolkit.release} in {toolkit.home}"
    trouble = None
    if not os.access(there, os.W_OK):
        trouble = "not writable"
    elif re.search(r"\s", str(folder.absolute())):
        trouble = "a space in its name, which the compilers' rules can't hold"
    elif free <= BUILD_BYTES:
        trouble = f"only {free / 1e9:.1f} GB free"
    room = None if trouble else f"{free / 1e9:.1f} GB free"
    nvcc_remedy = (
        f"{INSTALL} (or a system CUDA toolkit {cuda}, with CUDA_HOME at it)"
        if cuda.startswith("13.")
        else f"install the CUDA toolkit {cuda} and set CUDA_HOME to it, or torch's CUDA 13 build"
    )
    apt = f"apt install g++ python{sys.version_info.major}.{sys.version_info.minor}-dev"
    return [
        Need("torch with CUDA", cuda or None, "https://pytorch.org/get-started/locally"),
        Need(f"nvcc and cub of CUDA {cuda.partition('.')[0] or '13'}", where, nvcc_remedy),
        Need("C++ compiler", compiler, apt),
        Need("Python.h", str(header) if header.is_file() else None, apt),
        Need("ninja", shutil.which("ninja", path=search_path()), "pip install ninja"),
        Need("memory", f"{memory / 1e9:.1f} GB" if memory >= JOB_BYTES else None, "a build takes 3.5 GB"),
        Need(f"disk, {folder}", room, f"{trouble}: free half a gigabyte, or set TORCH_EXTENSIONS_DIR"),
    ]


def search_path() -> str:
    """PATH with the environment's programs first, whether it is activated or not."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])


def device_arch() -> str:
    """Compute capabilities of the visible GPUs, as nvcc and torch know them: "8.6", "7.5;8.6". One that
    torch is too old for gets the newest it knows, compiled by the driver (+PTX). TORCH_CUDA_ARCH_LIST counts
    only where there is no GPU: container images set it to five architectures, five times the work."""
    import torch

    if not torch.cuda.device_count():
        return os.environ.get("TORCH_CUDA_ARCH_LIST", "")
    known = [re.fullmatch(r"sm_(\d+)(\d)\w*", name) for name in torch.cuda.get_arch_list()]
    newest = max(((int(m[1]), int(m[2])) for m in known if m), default=(99, 9))
    arches = set()
    for index in range(torch.cuda.device_count()):
        major, minor = torch.cuda.get_device_capability(index)
        newer = (major, minor) > newest
        arches.add(f"{newest[0]}.{newest[1]}+PTX" if newer else f"{major}.{minor}")
    return ";".join(sorted(arches))


def cache_folder() -> Path:
    """Parent of all builds: TORCH_EXTENSIONS_DIR, or ~/.cache/lang3dxl."""
    return Path(os.environ.get("TORCH_EXTENSIONS_DIR") or Path.home() / ".cache" / "lang3dxl").expanduser()


def build_folder(arch: str) -> Path:
    """Folder of gsplat's build for these versions of gsplat, torch, CUDA and Python, and these GPUs."""
    import torch

    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    cuda, sm = torch.version.cuda, re.sub(r"[^\w+]", "-", arch.replace(".", ""))
    plain = torch.__version__.partition("+")[0]
    return cache_folder() / f"gsplat-{version('gsplat')}-torch-{plain}-cuda-{cuda}-{python}-sm-{sm}"


# ── building and loading ────────────────────────────────────────────────────────────────────────────────


def built(folder: Path, name: str = "gsplat_cuda") -> Path | None:
    """The library, if it was built completely."""
    library = folder / f"{name}.so"
    return library if (folder / "done").is_file() and library.is_file() else None


def build(extension: Extension, folder: Path, arch: str) -> Path:
    """Compile into a folder, and go on where an earlier build there was interrupted; returns the library.

    Another process that builds there is waited for. Output goes to `folder`/build.log.

    Raises:
        UserError: something is missing, or the compiler failed.
    """
    missing = [f"{need.what} is missing: {need.remedy}" for need in needs(folder) if need.found is None]
    if missing:
        raise UserError("gsplat's CUDA kernels can't be built here. " + ". ".join(missing))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / "building")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            say(f"Another process builds gsplat's CUDA kernels in {folder}: waiting for it")
            lock.acquire()
        with lock:
            try:
                return built(folder, extension.name) or _compile(extension, folder, arch)
            finally:
                lock.release()
    except OSError as error:
        raise UserError(f"gsplat's CUDA kernels can't be built in {folder} ({error})") from error


def _compile(extension: Extension, folder: Path, arch: str) -> Path:
    import torch

    toolkit = find_toolkit(torch.version.cuda or "")
    assert toolkit is not None
    home = _link_tree(toolkit, folder / "cuda") if toolkit.from_pip else toolkit.home
    jobs = max(1, min(os.cpu_count() or 1, int(machine_memory() / JOB_BYTES)))
    own = {"CUDA_HOME": str(home), "TORCH_CUDA_ARCH_LIST": arch, "MAX_JOBS": str(jobs)}
    own["PATH"] = os.pathsep.join([str(home / "bin"), search_path()])
    environment = {**os.environ, **own, "MAX_JOBS": os.environ.get("MAX_JOBS", own["MAX_JOBS"])}
    includes = [*extension.include, *_headers(home)]
    sources = _united(extension.sources, folder)
    arguments = {
        "name": extension.name,
        "sources": [str(path) for path in sources],
        "extra_cflags": ["-O3"],
        "extra_cuda_cflags": list(extension.flags),
        "extra_include_paths": [str(path) for path in includes],
        "build_directory": str(folder),
        "verbose": True,
    }
    (folder / "lock").unlink(missing_ok=True)  # older versions of torch would wait for ever for its holder
    log, start = folder / "build.log", time.monotonic()
    command = [sys.executable, "-c", _COMPILE, json.dumps(arguments)]
    say(
        f"Building {extension.name} for compute capability {arch} with {environment['MAX_JOBS']} jobs: once, "
        f"for some minutes. Interrupted, it goes on next time. Log: {log}"
    )
    with log.open("w") as file:
        process = subprocess.Popen(
            command, stdout=file, stderr=subprocess.STDOUT, env=environment, start_new_session=True
        )
        try:
            _watch(process, folder, len(sources))
        except BaseException:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()
            raise
    library = folder / f"{extension.name}.so"
    if process.returncode != 0 or not library.is_file():
        reason = _reason(log)
        if process.returncode < 0:
            reason = (
                f"signal {-process.returncode} stopped it, perhaps for lack of memory (MAX_JOBS=1 takes less)"
            )
        raise UserError(f"building {extension.name} failed: {reason} (the whole output: {log})")
    # Also the mark of a complete build.
    (folder / "done").write_text(f"{time.monotonic() - start:.0f} s with {environment['MAX_JOBS']} job(s)\n")
    return library


def _united(sources: Sequence[Path], folder: Path) -> list[Path]:
    """The sources, with the CUDA ones dealt to a few files that include them; written only if they change,
    so that what is compiled stays valid."""
    cuda = sorted((path for path in sources if path.suffix == ".cu"), key=lambda p: p.stat().st_size)
    if len(cuda) <= UNITS:
        return list(sources)
    units = []
    for number in range(UNITS):
        unit = folder / f"unit_{number}.cu"
        text = "".join(f'#include "{path}"\n' for path in cuda[number::UNITS])
        if not unit.is_file() or unit.read_text() != text:
            unit.write_text(text)
        units.append(unit)
    return [*units, *(path for path in sources if path.suffix != ".cu")]


def _watch(process: subprocess.Popen[bytes], folder: Path, sources: int) -> None:
    """Show how many sources are compiled until the process ends."""
    with progress("building gsplat", sources) as advance:
        shown = 0
        while process.poll() is None:
            ready = len(list(folder.glob("*.o")))
            for _ in range(ready - shown):
                advance()
            shown = max(ready, shown)
            time.sleep(0.2)


def _reason(log: Path) -> str:
    """The first line of a build's output that names an error."""
    lines = log.read_text(errors="replace").splitlines()
    named = (line.strip() for line in lines if re.search(r"error|Error|No space|Killed", line))
    return next(named, lines[-1] if lines else "no output")[:300]


def _link_tree(toolkit: Toolkit, folder: Path) -> Path:
    """Links to the environment's toolkit, laid out like a system's: the linker looks for lib64/libcudart.so,
    which pip's packages lack."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "lib64").mkdir(parents=True)
    for name in ("bin", "include", "nvvm"):
        (folder / name).symlink_to(toolkit.home / name)
    libraries = toolkit.home / "lib"
    for library in libraries.glob("lib*.a"):
        (folder / "lib64" / library.name).symlink_to(library)
    for library in sorted(libraries.glob("libcudart.so.*"))[:1]:  # others are links to it, or its target
        (folder / "lib64" / "libcudart.so").symlink_to(library)
    return folder


def load(library: Path, name: str = "gsplat_cuda") -> ModuleType:
    """Import a built library."""
    loader = importlib.machinery.ExtensionFileLoader(name, str(library))
    spec = importlib.util.spec_from_file_location(name, library, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


# ── use ─────────────────────────────────────────────────────────────────────────────────────────────────


def make_ready() -> None:
    """Load gsplat's kernels for this machine's GPUs, building them first if need be.

    Raises:
        UserError: they can't be had; says what is missing and how to get it.
    """
    import gsplat
    import torch

    with contextlib.suppress(ImportError):
        from gsplat import csrc  # noqa: F401  in a wheel that has them, or loaded before

        return
    if torch.version.hip is not None:
        raise UserError("gsplat's kernels run on NVIDIA's GPUs, and this one is AMD's")
    arch = device_arch()
    folder = build_folder(arch)
    library = built(folder) or build(gsplat_extension(), folder, arch)
    try:
        kernels = load(library)
    except ImportError:  # damaged
        (folder / "done").unlink(missing_ok=True)
        library.unlink(missing_ok=True)
        kernels = load(build(gsplat_extension(), folder, arch))
    gsplat.csrc = sys.modules["gsplat.csrc"] = kernels


@functools.cache
def ready() -> bool:
    """Whether gsplat can render, built first if need be; if not, says so, and that torch renders instead."""
    try:
        make_ready()
    except UserError as error:
        say(
            f"Warning: {error}. Until then the torch rasterizer renders on this GPU, correct but many times "
            "slower than gsplat. `lang3dxl doctor --build` tries again."
        )
        return False
    return True
