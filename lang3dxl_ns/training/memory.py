"""Memory of training: an estimate by Gaussians and pixels, and the cap on Gaussians that follows from it."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from lang3dxl_ns.common.kernels import MOST_SUMS
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.options import model_option
from lang3dxl_ns.training.state import PhotoCamera, Training

PER_PARAMETER = 16.0
"""Bytes per parameter for its value, its gradient, and Adam's two moments."""
PER_GAUSSIAN = 1_500.0
"""Bytes of a step's other tensors per Gaussian on a CPU, whose threads sum gradients separately, measured
with 300,000 of them. Learning words takes less."""
PER_GAUSSIAN_ON_GPU = 150.0
"""The same on a GPU. On an H200 a step of a million Gaussians in one color held .54 GB in all, where this
plan says .71; learning their words held 1.15, where it says 1.57 (docs/gpu.md)."""
PER_LOOK = 3_000.0
"""Additional bytes per Gaussian in view, with appearance."""
PER_PIXEL = 480.0
"""Bytes of a step per pixel of the photo."""
PER_CODE = 12.0
"""Bytes of a step per Gaussian and number of its code. Codes are drawn at few pixels."""
WORDS = {"cpu": 1.5e9, "cuda": 1.2e9}
"""Most bytes, in addition to the model, that learning words takes after the last step, by device."""
CONTEXT = 0.8e9
"""Bytes of CUDA's context, its libraries, and gaps between tensors."""
SHARE = 0.85
"""Share of the free memory to plan with, since densification copies a tensor at a time."""
MAIN_SHARE = 0.5
"""Share of the main memory to plan with; photos and their targets share this memory."""


def bytes_of(run: Training, pixels: int) -> tuple[float, float]:
    """Estimate the bytes of training, fixed and per Gaussian, for photos with this number of pixels."""
    count, modules = len(run.gaussians["means"]), run.parts.modules().values()
    numbers = sum(p.numel() for p in run.gaussians.values()) / count
    others = sum(p.numel() for module in modules for p in module.parameters())
    on_gpu = run.device.type == "cuda"
    words = WORDS["cuda" if on_gpu else "cpu"] if run.learns_words_at_the_end else 0.0
    codes = run.gaussians["codes"] if run.learns_from_renderings and "codes" in run.gaussians else None
    of_codes = 0.0 if codes is None else PER_CODE * codes.shape[1]
    # Of two threads, `PER_GAUSSIAN` has the sums.
    many = not on_gpu and torch.get_num_threads() > 2
    fixed = PER_PARAMETER * others + max(PER_PIXEL * pixels, words) + many * MOST_SUMS
    others_each = PER_GAUSSIAN_ON_GPU if on_gpu else PER_GAUSSIAN
    looks = 0.0 if run.parts.appearance is None else PER_LOOK
    return fixed, PER_PARAMETER * numbers + others_each + of_codes + looks


def memory_to_plan_with(device: torch.device) -> float:
    """Return the bytes of the device that training may fill."""
    if device.type == "cuda":
        torch.cuda.empty_cache()  # what preparing the targets took
        # What the model takes already is part of the plan.
        there = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_allocated(device)
        return SHARE * there - CONTEXT
    return MAIN_SHARE * machine_memory()


def plan(run: Training, cameras: Iterable[PhotoCamera]) -> str:
    """Cap the run's Gaussians by its settings or, for photos of these cameras, by memory; return a line for
    the log."""
    memory, now, wanted = memory_to_plan_with(run.device), len(run.means), run.settings.max_gaussians
    fixed, each = bytes_of(run, max(camera.width * camera.height for camera in cameras))
    most = max(int((memory - fixed) / each), now) if wanted is None else wanted
    run.densification.most = most
    limit = f"at most {most:,} Gaussians" if most else "no limit to their number"
    where = "the GPU" if run.device.type == "cuda" else "training"
    return (
        f"memory of {where}: about {(fixed + now * each) / 1e9:.1f} GB with the first {now:,} Gaussians, "
        f"{each * 1e6 / 1e9:.1f} GB per million more; {memory / 1e9:.1f} GB to plan with, "
        f"{limit} (max-gaussians)"
    )


def out_of_memory(count: int, when: str, smaller: str, kept: str) -> str:
    """Describe that memory ran out with this number of Gaussians, and what helps. `smaller`: the option that
    halves the photos. `kept`: what is kept of the run."""
    fewer, plainer = model_option(f"max-gaussians {count // 2}"), model_option("view-dependence off")
    return (
        f"out of memory {when} with {count:,} Gaussians. Three settings help: {fewer}, {smaller}, {plainer}. "
        f"The latest checkpoint: {kept}"
    )
