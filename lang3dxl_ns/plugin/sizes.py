"""Memory of training: an estimate per Gaussian, pixel and component, and the cap on Gaussians from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from lang3dxl_ns.common.memory import machine_memory

if TYPE_CHECKING:
    from lang3dxl_ns.plugin.model import Lang3DXLModel

COPIES = 4
"""Numbers kept per parameter: its value, gradient, and Adam's two moments."""
PER_GAUSSIAN = 1_500.0
"""Bytes of a step's other tensors per Gaussian; measured with 300,000 of them."""
PER_LOOK = 3_000.0
"""Bytes more per Gaussian in view, with appearance."""
PER_PIXEL = 480.0
"""Bytes of a step per pixel of the photo."""
PER_CODE = 12.0
"""Bytes per number of a code that is rendered, for every Gaussian and for every pixel."""
PER_DECODED = 24.0
"""Bytes per number of a decoded feature map: itself, its hidden layers, gradients, and what is compared."""
CONTEXT = 0.8e9
"""Bytes of CUDA's context, its libraries, and gaps between tensors."""
SHARE = 0.85
"""Share of the free memory to plan with; densification copies a tensor at a time."""
MAIN_SHARE = 0.5
"""The same of the main memory, which photos and their targets share."""


@dataclass(frozen=True)
class Sizes:
    """What training's memory depends on."""

    numbers: int
    """Parameters per Gaussian."""
    network: int
    """All other parameters."""
    pixels: int
    """Of the largest photo."""
    looks: bool
    """Whether colors depend on the photo."""
    codes: int
    """Length of the codes that are rendered; 0 if semantics aren't trained."""
    decoded: int
    """Numbers of the largest feature map that a step decodes; 0 if it decodes none."""
    on_gpu: bool

    @property
    def per_gaussian(self) -> float:
        """Bytes, if all are in view."""
        work = PER_GAUSSIAN + PER_LOOK * self.looks + PER_CODE * self.codes
        return 4 * COPIES * self.numbers + work

    @property
    def fixed(self) -> float:
        """Bytes, whatever the number of Gaussians."""
        maps = (PER_PIXEL + PER_CODE * self.codes) * self.pixels + PER_DECODED * self.decoded
        return 4 * COPIES * self.network + maps + CONTEXT * self.on_gpu

    def memory(self, gaussians: int) -> float:
        """Bytes at the peak of a step."""
        return self.fixed + gaussians * self.per_gaussian

    def most(self, memory: float) -> int:
        """Number of Gaussians that fit, at least one."""
        return max(int((memory - self.fixed) / self.per_gaussian), 1)


def sizes_of(model: Lang3DXLModel, pixels: int, on_gpu: bool) -> Sizes:
    """Sizes of a model, and of the photos' largest number of pixels."""
    gaussians, codes, decoded = model.gauss_params, 0, 0
    if model.learns_from_renderings:
        assert model.semantic_field is not None and model.config.decode_size is not None
        # Of one Gaussian, since some encoders compute what a Gaussian carries.
        carried = model.semantic_field.carried({name: p.detach()[:1] for name, p in gaussians.items()})
        codes = 0 if carried is None else carried.shape[1]
        decoded = max(model.config.decode_size) ** 2 * (len(model.clip_mean) + len(model.dense_mean))
    own = sum(p.numel() for p in gaussians.values())
    count = len(gaussians["means"])
    total = sum(p.numel() for p in model.parameters())
    return Sizes(own // count, total - own, pixels, model.appearance is not None, codes, decoded, on_gpu)


def memory_to_plan_with(device: torch.device) -> float:
    """Bytes of the device that training may fill."""
    if device.type == "cuda":
        return SHARE * torch.cuda.mem_get_info(device)[0]
    return MAIN_SHARE * machine_memory()


def plan(sizes: Sizes, device: torch.device, now: int, wanted: int | None) -> tuple[int, str]:
    """The cap on Gaussians (0: none) for the setting `max_gaussians`, and a line for the log."""
    memory = memory_to_plan_with(device)
    most = max(sizes.most(memory), now) if wanted is None else wanted
    limit = f"at most {most:,} Gaussians" if most else "no limit to their number"
    where = "the GPU" if sizes.on_gpu else "training"
    return most, (
        f"memory of {where}: about {sizes.memory(now) / 1e9:.1f} GB with the first {now:,} Gaussians, "
        f"{sizes.per_gaussian * 1e6 / 1e9:.1f} GB per million more; {memory / 1e9:.1f} GB to plan with, "
        f"{limit} (--pipeline.model.max-gaussians)"
    )
