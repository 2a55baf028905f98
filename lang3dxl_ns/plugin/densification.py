"""Densification: gsplat's default strategy with a cap, and statistics that don't wait for the GPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.training.initialization import near_cameras

_BEYOND = 1.1
"""Factor by which growth may exceed the cap before the least opaque Gaussians are removed."""


@dataclass
class Densification(DefaultStrategy):
    """Densification by gsplat's screen-space gradient, up to a number of Gaussians."""

    grow_grad2d: float = 2e-4
    """Screen-space gradient (image = [−1, 1]) above which Gaussians grow."""
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

    def step_pre_backward(
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Take a step's rendering (`Raster.info`), and keep it until its backward pass is done."""
        super().step_pre_backward(params, optimizers, state, step, info)
        state["rendered"] = info

    def step_post_backward(  # type: ignore[override]
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int
    ) -> None:
        """Densify after the backward pass of the rendering that `step_pre_backward` took."""
        super().step_post_backward(params, optimizers, state, step, state.pop("rendered"), packed=False)

    def _update_state(
        self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False
    ) -> None:
        """Add a step's gradients as gsplat does, but unscaled. The visible Gaussians are not selected,
        because the host would have to wait for their number."""
        gradient: Tensor = info[self.key_for_gradient].grad / self.loss_scale
        half = info["width"] / 2.0 * info["n_cameras"], info["height"] / 2.0 * info["n_cameras"]
        norms = torch.stack([gradient[..., i] * half[i] for i in range(2)], dim=-1).norm(dim=-1)
        seen = info["radii"] > 0
        for name in ("grad2d", "count"):
            if state[name] is None:
                state[name] = torch.zeros(norms.shape[1], device=norms.device)
        state["grad2d"] += torch.where(seen, norms, 0.0).sum(0)
        state["grad2d"][: self.still] = 0.0
        state["count"] += seen.sum(0)

    def _grow_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> tuple[int, int]:
        """Grow Gaussians; near the cap only those with the largest gradients grow, and each becomes two."""
        usual, room = self.grow_grad2d, int(_BEYOND * self.most) - len(params["means"])
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        if self.most and int((gradients > usual).sum()) > room:
            self.grow_grad2d = float(gradients.topk(room + 1).values[-1]) if room > 0 else float("inf")
        try:
            return super()._grow_gs(params, optimizers, state, step)
        finally:
            self.grow_grad2d = usual

    def _prune_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> int:
        """Prune Gaussians, also those near a camera and, above the cap, the least opaque."""
        pruned = super()._prune_gs(params, optimizers, state, step)
        means, opacities = params["means"].detach(), params["opacities"].detach().flatten()
        gone = torch.zeros_like(opacities, dtype=torch.bool)
        if self.cameras is not None:
            gone = near_cameras(means, self.cameras, self.free)
        gone[: self.still] = False
        excess = len(means) - int(gone.sum()) - max(self.most, self.still)
        if self.most and excess > 0:
            opacities = opacities.masked_fill(gone, float("inf"))
            opacities[: self.still] = float("inf")
            gone[opacities.topk(excess, largest=False).indices] = True
        remove(params=params, optimizers=optimizers, state=state, mask=gone)
        return pruned + int(gone.sum())
