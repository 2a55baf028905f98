"""`lang3dxl doctor`: checks of versions, the GPU and its build of gsplat, disk, memory, ffmpeg."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from glob import glob
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.settings_help import showing

LEAST_MEMORY, LEAST_DISK = 4e9, 10e9
"""Least memory and disk space without a note, bytes. Encoders take 1 to 2 GB, and targets 8 MB per photo."""


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    what: str
    found: str
    fine: bool
    remedy: str = ""
    """Remedy if the check did not pass."""
    bad: Literal["note", "problem"] = "note"

    @property
    def verdict(self) -> Literal["ok", "note", "problem"]:
        """Whether the check passed, and how bad it is if not."""
        return "ok" if self.fine else self.bad


@showing("build", "arch")
@dataclass(kw_only=True)
class Doctor:
    """Check versions, GPU, gsplat's build, disk and memory of this machine, and say what to do.

    Nothing is downloaded or changed, unless --build requests gsplat's kernels. The exit status is 1 if
    something prevents a run.
    """

    build: bool = False
    """Build gsplat's CUDA kernels now, which takes minutes, instead of before the first training."""
    arch: str = ""
    """Compute capability to build for, such as 8.6. The default is the one of this machine's GPUs."""

    def main(self) -> None:
        problems = 0
        for finding in findings():
            problems += finding.verdict == "problem"
            print(f"[{finding.verdict:^7}] {finding.what}: {finding.found}")
            if not finding.fine:
                print(f"{'':10}{finding.remedy}")
        if self.build:
            self._build()
        if problems:
            sys.exit(f"Verdict: {problems} problem(s) found, see above")
        print("Verdict: ready")

    def _build(self) -> None:
        """Build and load gsplat's kernels. Raises UserError if something is missing."""
        from lang3dxl_ns.rendering import gsplat_build

        arch = self.arch or gsplat_build.device_arch()
        if not arch:
            raise UserError("torch sees no GPU to build for: name a compute capability, such as --arch 8.6")
        folder = gsplat_build.build_folder(arch)
        library = gsplat_build.build(folder, arch)
        gsplat_build.load(library)
        print(f"gsplat's kernels for {arch}: {library}, built in {(folder / 'done').read_text().strip()}")


def findings() -> Iterator[Finding]:
    """Run all checks, and yield each result."""
    yield from versions()
    yield from devices()
    disk, folders = shutil.disk_usage(Path.cwd()).free, "another folder: --output-dir, --cache-dir, HF_HOME"
    cache, memory = "--pipeline.datamanager.cache-gb 0.2 (ns-train)", machine_memory()
    yield Finding("memory", f"{memory / 1e9:.1f} GB", memory >= LEAST_MEMORY, f"little: use {cache}")
    yield Finding("free disk here", f"{disk / 1e9:.1f} GB", disk >= LEAST_DISK, f"little: use {folders}")
    ffmpeg = shutil.which("ffmpeg")
    remedy = "ns-render and videos need it: apt install ffmpeg, conda install ffmpeg"
    yield Finding("ffmpeg", ffmpeg or "not found", ffmpeg is not None, remedy)


def versions() -> Iterator[Finding]:
    """Check Python and the required packages, pycolmap among them, against this package's requirements."""
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    fine, remedy = sys.version_info[:2] >= (3, 10), "make an environment of Python 3.10 or later"
    yield Finding("Python", sys.version.split()[0], fine, remedy, "problem")
    whole = find_spec("nerfstudio") is not None
    yield Finding("nerfstudio", *_nerfstudio_half(whole))
    wanted = dict[str, SpecifierSet]()  # the base and the extra may both name a package
    for need in (Requirement(line) for line in requires("lang3dxl-ns") or []):
        if need.marker is None or need.marker.evaluate({"extra": "nerfstudio" if whole else ""}):
            wanted[need.name] = wanted.get(need.name, SpecifierSet()) & need.specifier
    for name, specifier in wanted.items():
        found = ""
        with suppress(PackageNotFoundError):
            found = version(name)
        good = found != "" and specifier.contains(found.partition("+")[0], prereleases=True)
        remedy = f"pip install '{name}{specifier}'"
        yield Finding(name, found or "not installed", good, remedy, "problem")


def _nerfstudio_half(installed: bool) -> tuple[str, bool, str]:
    """Say whether nerfstudio is there and, if not, whether it can be."""
    if installed:
        return "installed: ns-train, ns-eval and its viewer work", True, ""
    base = "not installed: the demo, lang3dxl train, asking, attaching and the page work without it"
    if sys.version_info[:2] >= (3, 13):
        python = f"{sys.version_info[0]}.{sys.version_info[1]}"
        remedy = f"for ns-train: an environment of Python 3.10 to 3.12 (it pins what {python} lacks)"
        return base, False, remedy
    return base, False, "for ns-train: pip install -e '.[nerfstudio]' in the checkout"


def devices() -> Iterator[Finding]:
    """Check the GPUs, and what gsplat's kernels need. Without a GPU, report the CPU."""
    cpu = f"CPU, {os.cpu_count()} cores"
    if not (shutil.which("nvidia-smi") or glob("/dev/nvidia[0-9]*") or glob("/dev/kfd")):
        yield Finding("device", cpu, False, "training is slower than on a GPU")
        return
    import torch  # takes seconds to import

    from lang3dxl_ns.common.device import unused_gpu
    from lang3dxl_ns.rendering import gsplat_build

    if trouble := unused_gpu():
        yield Finding("device", cpu, False, trouble, "problem")
        return
    for i in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(i)
        yield Finding(f"device cuda:{i}", f"{gpu.name}, {gpu.total_memory / 1e9:.1f} GB", True)
    folder = gsplat_build.build_folder(gsplat_build.device_arch())
    if torch.version.hip is None and not gsplat_build.built(folder):
        for need in gsplat_build.needs(folder):
            what, there = f"to build gsplat, {need.what}", need.found is not None
            yield Finding(what, need.found or "missing", there, need.remedy)
