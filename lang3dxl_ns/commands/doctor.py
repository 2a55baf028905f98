"""`lang3dxl doctor`: checks versions, devices, gsplat's build, disk, memory, weights."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.preparation.settings import DENSE_MODEL, PreparationConfig

PACKAGES = ("nerfstudio", "torch", "gsplat", "transformers", "pycolmap", "numpy", "viser", "pillow")
LEAST_MEMORY = 4e9
LEAST_DISK = 10e9
"""Bytes: encoders of one or two gigabytes, targets of eight megabytes per photo, and a run."""
GSPLAT = "gsplat's CUDA kernels"
NOT_BUILT = "not built yet: before the first training, or now with lang3dxl doctor --build"


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

    Nothing is downloaded or changed, unless --build asks for gsplat's kernels. Exits with status 1 if
    something prevents a run.
    """

    data: Path | None = None
    """Folder of photos, to check its disk too."""
    build: bool = False
    """Build gsplat's CUDA kernels now (minutes), instead of before the first training."""
    arch: str = ""
    """Compute capability to build for, such as 8.6; default: this machine's GPUs."""

    def main(self) -> None:
        found = []
        for finding in findings(self.data):
            found.append(finding)
            print(f"[{finding.verdict:^7}] {finding.what}: {finding.found}")
            if finding.remedy:
                print(f"{'':10}{finding.remedy}")
        if self.build:
            build_now(self.arch)
        problems = sum(finding.verdict == "problem" for finding in found)
        if problems:
            sys.exit(f"Verdict: {problems} problem(s) found, see above")
        print(f"Verdict: {verdict(found)}")


def verdict(found: list[Finding]) -> str:
    """One sentence on what a training would use."""
    by_name = {finding.what: finding for finding in found}
    if "device cuda:0" not in by_name:
        return "ready; everything runs on the CPU"
    if all(finding.verdict == "ok" for finding in found if finding.what.startswith(GSPLAT)):
        built = by_name[GSPLAT].found != NOT_BUILT
        return "ready; the GPU renders with gsplat" + ("" if built else ", which is built first, in minutes")
    return "works, but slowly: the GPU renders with torch until gsplat can be built (see above)"


def build_now(arch: str = "") -> None:
    """Build and load gsplat's kernels for a compute capability, by default this machine's.

    Raises UserError if something is missing.
    """
    from lang3dxl_ns.rendering import gsplat_build

    arch = arch or gsplat_build.device_arch()
    if not arch:
        raise UserError("torch sees no GPU to build for: name a compute capability, such as --arch 8.6")
    folder = gsplat_build.build_folder(arch)
    library = gsplat_build.build(gsplat_build.gsplat_extension(), folder, arch)
    names = [name for name in dir(gsplat_build.load(library)) if not name.startswith("_")]
    print(f"gsplat's kernels for {arch}: {len(names)} functions in {library}, built in {built_in(folder)}")


def built_in(folder: Path) -> str:
    """Seconds that a build took, and the memory of its largest compiler."""
    return (folder / "done").read_text().strip()


def findings(data: Path | None = None) -> Iterator[Finding]:
    """Runs all checks, yielding each result."""
    yield from versions()
    yield from devices()
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


def devices() -> Iterator[Finding]:
    """GPUs, and what gsplat needs; without a GPU, the CPU rasterizer is used."""
    cores = f"CPU, {os.cpu_count()} cores"
    slower = (
        "training and queries run on the CPU, slower: read photos small "
        "(--pipeline.datamanager.camera-res-scale-factor 0.25)"
    )
    if not _has_gpu():  # then skip importing torch, which takes seconds
        yield Finding("device", "note", cores, slower)
        return
    import torch

    from lang3dxl_ns.common.device import unused_gpu

    trouble = unused_gpu()
    if trouble is not None or not torch.cuda.is_available():
        yield Finding("device", "problem" if trouble else "note", cores, trouble or slower)
        return
    for i in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(i)
        found = f"{gpu.name}, {gpu.total_memory / 1e9:.1f} GB, compute capability {gpu.major}.{gpu.minor}"
        yield Finding(f"device cuda:{i}", "ok", found)
    yield from gsplat_findings()


def gsplat_findings() -> Iterator[Finding]:
    """Whether gsplat's kernels are built; if not, everything that building them needs."""
    import torch

    from lang3dxl_ns.rendering import gsplat_build

    if torch.version.hip is not None:
        yield Finding(GSPLAT, "note", "for NVIDIA's GPUs", "this GPU renders with torch, many times slower")
        return
    folder = gsplat_build.build_folder(gsplat_build.device_arch())
    if gsplat_build.built(folder):
        yield Finding(GSPLAT, "ok", f"built in {folder}")
        return
    yield Finding(GSPLAT, "ok", NOT_BUILT)
    for need in gsplat_build.needs(folder):
        fine = need.found is not None
        what, remedy = f"{GSPLAT}, {need.what}", "" if fine else need.remedy
        yield Finding(what, "ok" if fine else "note", need.found or "missing", remedy)


def _has_gpu() -> bool:
    """Whether an NVIDIA driver is installed, judged by its program or library, or an AMD one."""
    if shutil.which("nvidia-smi") or Path("/dev/kfd").exists():
        return True
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


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
