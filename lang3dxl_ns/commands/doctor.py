"""`lang3dxl doctor`: checks versions, devices, gsplat's build, disk, memory, weights."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.preparation.settings import DENSE_MODEL, PreparationConfig

PACKAGES = ("nerfstudio", "torch", "gsplat", "transformers", "pycolmap", "numpy", "viser", "pillow")
LEAST_MEMORY = 4e9
LEAST_DISK = 10e9
"""Bytes: encoders of one or two gigabytes, targets of eight megabytes per photo, and a run."""

_PROBE = """
import torch
from gsplat import rasterization
means, quats = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
k = torch.tensor([[[50.0, 0.0, 16.0], [0.0, 50.0, 16.0], [0.0, 0.0, 1.0]]])
scene = means, quats, torch.full((1, 3), 0.1), torch.ones(1), torch.ones(1, 3), torch.eye(4)[None], k
_, alpha, _ = rasterization(*(tensor.cuda() for tensor in scene), 32, 32)
assert float(alpha.max()) > 0.5, "a Gaussian in front of the camera was not drawn"
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    what: str
    verdict: Literal["ok", "note", "problem"]
    found: str
    remedy: str = ""
    """What to do if it isn't fine."""


@dataclass(kw_only=True)
class Doctor:
    """Check this machine: versions, devices, gsplat's build, disk, memory and weights, and say what to do.

    Nothing is downloaded or changed, except that gsplat caches the kernels it builds. Exits with status 1
    if something prevents a run.
    """

    data: Path | None = None
    """Folder of photos, to check its disk too."""
    build_seconds: float = 60.0
    """Time limit for gsplat to build or load its CUDA kernels. The first build takes many minutes."""

    def main(self) -> None:
        problems = 0
        for finding in findings(self.data, self.build_seconds):
            problems += finding.verdict == "problem"
            print(f"[{finding.verdict:^7}] {finding.what}: {finding.found}")
            if finding.remedy:
                print(f"{'':10}{finding.remedy}")
        if problems:
            sys.exit(f"{problems} problem(s) found")


def findings(data: Path | None = None, build_seconds: float = 60.0) -> Iterator[Finding]:
    """Runs all checks, yielding each result."""
    yield from versions()
    yield from devices(build_seconds)
    yield memory()
    yield from disks(data)
    yield from weights()
    yield from programs()


def versions() -> Iterator[Finding]:
    """Python and the main packages, against this package's requirements."""
    python = sys.version.split()[0]
    if (3, 10) <= sys.version_info[:2] < (3, 13):
        yield Finding("Python", "ok", python)
    else:
        yield Finding(
            "Python", "problem", python, "nerfstudio needs 3.10, 3.11 or 3.12: make an environment of it"
        )
    wanted = _requirements()
    for name in PACKAGES:
        try:
            found = version(name)
        except PackageNotFoundError:
            yield Finding(name, "problem", "not installed", f"pip install '{name}{wanted.get(name, '')}'")
            continue
        yield _against(name, found, wanted.get(name, ""))


def _requirements() -> dict[str, str]:
    """Package → version specifier, from this package's metadata."""
    from packaging.requirements import Requirement

    try:
        parsed = [Requirement(line) for line in requires("lang3dxl-ns") or []]
    except PackageNotFoundError:  # a checkout without installation
        return {}
    return {r.name.lower(): str(r.specifier) for r in parsed if r.marker is None}


def _against(name: str, found: str, wanted: str) -> Finding:
    from packaging.specifiers import SpecifierSet

    if SpecifierSet(wanted).contains(found.partition("+")[0], prereleases=True):
        return Finding(name, "ok", found)
    return Finding(name, "problem", f"{found}, needs {wanted}", f"pip install '{name}{wanted}'")


def devices(build_seconds: float) -> Iterator[Finding]:
    """GPUs and gsplat's kernels; without a GPU, the CPU rasterizer is used."""
    cores = f"CPU, {os.cpu_count()} cores"
    slower = (
        "training and queries run on the CPU, slower: read photos small "
        "(--pipeline.datamanager.camera-res-scale-factor 0.25)"
    )
    if not _has_driver():  # then skip importing torch, which takes seconds
        yield Finding("device", "note", cores, slower)
        return
    import torch

    if not torch.cuda.is_available():
        # A driver without a GPU visible to torch is a problem; no GPU at all is not.
        mistaken = shutil.which("nvidia-smi") is not None
        remedy = (
            "nvidia-smi is there, but torch sees no GPU: install the torch build that fits the driver "
            "(https://pytorch.org/get-started/locally)"
        )
        yield Finding("device", "problem" if mistaken else "note", cores, remedy if mistaken else slower)
        return
    for i in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(i)
        yield Finding(f"device cuda:{i}", "ok", f"{gpu.name}, {gpu.total_memory / 1e9:.1f} GB")
    yield gsplat_build(_PROBE, build_seconds)


def _has_driver() -> bool:
    """Whether NVIDIA's driver is installed, judged by its program or library."""
    if shutil.which("nvidia-smi"):
        return True
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def gsplat_build(probe: str, seconds: float) -> Finding:
    """Renders a Gaussian with gsplat in a separate process with a time limit."""
    start = time.monotonic()
    what = "gsplat's CUDA kernels"
    try:
        done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        remedy = (
            "the first build takes many minutes: give it time (lang3dxl doctor --build-seconds 1800), or "
            "install a prebuilt wheel (https://docs.gsplat.studio/whl)"
        )
        return Finding(what, "note", f"not built within {seconds:.0f} s", remedy)
    if done.returncode == 0:
        return Finding(what, "ok", f"work, after {time.monotonic() - start:.0f} s")
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    compiler = shutil.which("nvcc") or os.environ.get("CUDA_HOME")
    remedy = (
        "install a prebuilt wheel (https://docs.gsplat.studio/whl), or the CUDA toolkit of "
        f"torch's version for nvcc{'' if compiler else ', which is missing'}"
    )
    return Finding(what, "problem", last, remedy)


def memory() -> Finding:
    """Main memory, and how much of it a run uses for photos."""
    total = machine_memory()
    found = f"{total / 1e9:.1f} GB, of which photos and targets may take {total / 4e9:.1f}"
    if total >= LEAST_MEMORY:
        return Finding("memory", "ok", found)
    return Finding(
        "memory", "note", found, "little: use --pipeline.datamanager.cache-gb 0.2 and small photos"
    )


def disks(data: Path | None) -> Iterator[Finding]:
    """Free space in the folders that get written to."""
    places = {"here (runs)": Path.cwd(), "model cache": model_cache()}
    if data is not None:
        places["data (prepared targets)"] = data
    for name, place in places.items():
        there = next(p for p in (place, *place.absolute().parents) if p.exists())
        free = shutil.disk_usage(there).free
        found = f"{free / 1e9:.1f} GB free in {place}"
        if not os.access(there, os.W_OK):
            remedy = "not writable: choose another folder (--output-dir, --cache-dir, HF_HOME)"
            yield Finding(f"disk, {name}", "problem", found, remedy)
        elif free < LEAST_DISK:
            yield Finding(f"disk, {name}", "note", found, "little: encoders and targets take gigabytes")
        else:
            yield Finding(f"disk, {name}", "ok", found)


def model_cache() -> Path:
    """Hugging Face's model cache."""
    from huggingface_hub.constants import HF_HUB_CACHE

    return Path(HF_HUB_CACHE)


def weights() -> Iterator[Finding]:
    """The default models: whether they are cached, and where they would come from."""
    from huggingface_hub import constants, try_to_load_from_cache

    defaults = PreparationConfig()
    options = {
        "clip": "",
        "dense": "only for semantics that are trained with the scene",
        "foreground_model": "only for --foreground text",
        "sam": "only for regions sam",
    }
    for option, when in options.items():
        name = getattr(defaults, option)
        name = DENSE_MODEL if name == "auto" else name
        found = try_to_load_from_cache(name, "config.json")
        what = f"weights {name}" + (f" ({when})" if when else "")
        if isinstance(found, str):
            yield Finding(what, "ok", f"cached in {Path(found).parent}")
            continue
        offline = " (now offline: HF_HUB_OFFLINE is set)" if constants.HF_HUB_OFFLINE else ""
        flag = option.replace("_", "-")
        yield Finding(
            what,
            "note",
            f"not cached; would be downloaded from {constants.ENDPOINT}{offline}",
            f"without Internet: run hf download {name} --local-dir DIR elsewhere, copy it, and pass "
            f"--pipeline.datamanager.{flag} DIR",
        )


def programs() -> Iterator[Finding]:
    """External programs that commands use."""
    for name, use in {"ffmpeg": "ns-render writes videos", "colmap": "new scenes are reconstructed"}.items():
        path = shutil.which(name)
        if path:
            yield Finding(name, "ok", path)
        else:
            yield Finding(name, "note", "not found", f"with it {use}: apt install {name}")
