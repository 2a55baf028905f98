"""Densification: Gaussians multiply where photos pull at them, and vanish where they are transparent.

As in 3D Gaussian splatting, a Gaussian whose screen position has a large mean gradient is duplicated if it is
small, and split in two if it is large. Here there is also a cap on their number, and space is kept free
around the cameras. Statistics don't wait for the GPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from lang3dxl_ns.rendering.projection import rotations
from lang3dxl_ns.training.gaussians import Parameters, near_cameras
from lang3dxl_ns.training.settings import TrainingSettings

_BEYOND = 1.1
"""Factor by which growth may exceed the cap before the least opaque Gaussians are removed."""
_SHRINK = 1.6
"""Factor by which the two halves of a split Gaussian are smaller."""
State = dict[str, Any]


@dataclass
class Densification:
    """When and where Gaussians grow and are pruned. Parameters and statistics change in place; each of the
    Gaussians' parameters may have an optimizer of its own, of the same name."""

    start: int
    """Iteration after which Gaussians grow and are pruned."""
    stop: int
    """Iteration from which they no longer do."""
    every: int
    """Iterations between two times."""
    gradient: float = 2e-4
    """Screen-space gradient (image = [−1, 1]) above which Gaussians grow."""
    large: float = 0.01
    """Standard deviation, world units, above which Gaussians are split instead of duplicated."""
    faint: float = 0.005
    """Opacity below which Gaussians are pruned."""
    most: int = 0
    """Most Gaussians; 0: no limit."""
    still: int = 0
    """Number of the sky's Gaussians, which come first and are neither grown nor pruned."""
    cameras: Float[Tensor, "p 3"] | None = None
    """Positions of the training cameras, around which Gaussians are pruned."""
    free: float = 0.0
    """Distance around the cameras within which Gaussians are pruned, world units."""
    loss_scale: float = 1.0
    """Factor of the latest step's gradients, under mixed precision."""

    @staticmethod
    def of(settings: TrainingSettings) -> Densification:
        """Build the densification of a run whose settings are fitted to its length."""
        steps = settings.total_steps
        assert settings.densify_grad_thresh is not None  # set by `fitted`
        return Densification(
            start=round(settings.densify_from * steps),
            stop=round(settings.densify_until * steps),
            every=max(round(settings.densify_every * steps), 1),
            gradient=settings.densify_grad_thresh,
            large=settings.densify_size_thresh,
            faint=settings.cull_alpha_thresh,
        )

    @torch.no_grad()
    def after_backward(
        self,
        gaussians: Parameters,
        optimizers: Mapping[str, Optimizer],
        state: State,
        step: int,
        seen: Mapping[str, Any],
    ) -> None:
        """Add a step's gradients to the statistics `state` (empty at first), then grow and prune when due.
        `seen` is the step's `Raster.info`, whose screen positions kept their gradient."""
        if step >= self.stop:
            return
        self._observe(state, seen)
        if step <= self.start or step % self.every:
            return
        self._grow(gaussians, optimizers, state)
        self._prune(gaussians, optimizers, state)
        state["grad2d"].zero_()
        state["count"].zero_()
        torch.cuda.empty_cache()

    def _observe(self, state: State, seen: Mapping[str, Any]) -> None:
        """Add the gradients of the visible Gaussians. These are not selected, because the host would have to
        wait for their number."""
        gradient: Tensor = seen["means2d"].grad / self.loss_scale
        half = seen["width"] / 2.0 * seen["n_cameras"], seen["height"] / 2.0 * seen["n_cameras"]
        norms = torch.stack([gradient[..., i] * half[i] for i in range(2)], dim=-1).norm(dim=-1)
        visible = seen["radii"] > 0
        for name in ("grad2d", "count"):
            if state.get(name) is None:
                state[name] = torch.zeros(norms.shape[1], device=norms.device)
        state["grad2d"] += torch.where(visible, norms, 0.0).sum(0)
        state["grad2d"][: self.still] = 0.0
        state["count"] += visible.sum(0)

    def _grow(self, gaussians: Parameters, optimizers: Mapping[str, Optimizer], state: State) -> None:
        """Duplicate and split; near the cap only those with the largest gradients, and each becomes two."""
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        threshold, room = self.gradient, int(_BEYOND * self.most) - len(gradients)
        if self.most and int((gradients > threshold).sum()) > room:
            threshold = float(gradients.topk(room + 1).values[-1]) if room > 0 else float("inf")
        grows = gradients > threshold
        small = gaussians["scales"].exp().amax(1) <= self.large
        splits, everyone = grows & ~small, torch.arange(len(grows), device=grows.device)
        twins, halves = everyone[grows & small], everyone[splits]
        if len(twins):
            rearrange(gaussians, optimizers, state, everyone, twins)
        if len(halves):
            newest = torch.arange(len(grows), len(grows) + len(twins), device=grows.device)
            kept = torch.cat((everyone[~splits], newest))
            rearrange(gaussians, optimizers, state, kept, halves.repeat(2), _halved(gaussians, halves))

    def _prune(self, gaussians: Parameters, optimizers: Mapping[str, Optimizer], state: State) -> None:
        """Remove faint Gaussians, those near a camera and, above the cap, the least opaque."""
        opacities = gaussians["opacities"].flatten()
        gone = opacities.sigmoid() < self.faint
        if self.cameras is not None:
            gone |= near_cameras(gaussians["means"], self.cameras, self.free)
        gone[: self.still] = False
        excess = len(gone) - int(gone.sum()) - max(self.most, self.still)
        if self.most and excess > 0:
            opacities = opacities.masked_fill(gone, float("inf"))
            opacities[: self.still] = float("inf")
            gone[opacities.topk(excess, largest=False).indices] = True
        kept = (~gone).nonzero()[:, 0]
        rearrange(gaussians, optimizers, state, kept, kept[:0])


def _halved(gaussians: Parameters, rows: Int[Tensor, " m"]) -> dict[str, Tensor]:
    """Draw the centers of two halves of every Gaussian from the Gaussian itself, and shrink the scales."""
    scales = gaussians["scales"][rows].exp()
    noise = torch.randn(2, len(rows), 3, device=scales.device)
    offsets = torch.einsum("nij,nj,bnj->bni", rotations(gaussians["quats"][rows]), scales, noise)
    means = (gaussians["means"][rows] + offsets).reshape(-1, 3)
    return {"means": means, "scales": (scales / _SHRINK).log().repeat(2, 1)}


def rearrange(
    gaussians: Parameters,
    optimizers: Mapping[str, Optimizer],
    state: State,
    kept: Int[Tensor, " k"],
    added: Int[Tensor, " m"],
    changes: Mapping[str, Tensor] | None = None,
) -> None:
    """Keep some Gaussians, in this order, and add copies of others after them, with `changes` to the copies'
    parameters. Adam's moments of copies are 0; their statistics are those of the original."""
    for name, old in list(gaussians.items()):
        copies = (changes or {}).get(name, old.detach()[added])
        new = Parameter(torch.cat((old.detach()[kept], copies)), requires_grad=old.requires_grad)
        if (optimizer := optimizers.get(name)) is not None:
            optimizer.param_groups[0]["params"] = [new]
            moments = optimizer.state.pop(old, {})
            for key, value in moments.items():
                if key != "step":
                    moments[key] = torch.cat((value[kept], value.new_zeros(len(added), *value.shape[1:])))
            if moments:
                optimizer.state[new] = moments
        gaussians[name] = new
    for name, value in state.items():
        if isinstance(value, Tensor):
            state[name] = torch.cat((value[kept], value[added]))
