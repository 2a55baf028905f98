"""Which levels of the field's hash grid a run can use, decided halfway through from the codes it renders."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer

from lang3dxl_ns.components.encoder import SemanticEncoder
from lang3dxl_ns.components.semantic_field import SemanticField, ShrunkParameter
from lang3dxl_ns.scene_needs import Need


class HashLevels:
    """Watches the codes for a while, then drops the levels that they cannot resolve.

    A level whose cells are finer than the step of the code from one decoded pixel to the next sees each pixel
    in a cell of its own: all that it could learn is noise.
    """

    def __init__(self) -> None:
        self.steps: list[float] = []
        """Steps of the code seen so far."""
        self.verdict: Need | None = None
        """What was decided; None before."""

    @torch.no_grad()
    def watch(self, field: SemanticEncoder, codes: Float[Tensor, "h w 3"]) -> None:
        """Note the median step between neighbours of a map of codes, as large as it is decoded."""
        # The published forms (an index coordinate, unbounded codes) are kept as they are.
        if isinstance(field, SemanticField) and field.bounded and not field.settings.indexed:
            places = codes.sigmoid()
            self.steps.append(float((places[:, 1:] - places[:, :-1]).norm(dim=-1).median()))

    def decide(self, field: SemanticEncoder, optimizers: Mapping[str, Optimizer]) -> None:
        """Drop the levels from the field, and from the optimisers' moments."""
        if not self.steps or not isinstance(field, SemanticField):
            return
        step, levels = median(self.steps), field.grid.levels
        keep = field.grid.resolved_levels(step)
        measured = f"step of the code between decoded pixels, halfway through; {keep} of {levels} levels kept"
        self.verdict = Need("hash levels", keep == levels, measured, step, None)
        if keep == levels:
            return
        for shrunk in field.keep_levels(keep):
            for optimizer in optimizers.values():
                _follow(optimizer, shrunk)


def _follow(optimizer: Optimizer, shrunk: ShrunkParameter) -> None:
    """Let an optimiser go on with the new parameter, and with its part of the moments."""
    for group in optimizer.param_groups:
        group["params"] = [shrunk.new if p is shrunk.old else p for p in group["params"]]
    if shrunk.old in optimizer.state:
        moments = optimizer.state.pop(shrunk.old)
        optimizer.state[shrunk.new] = {k: v if k == "step" else shrunk.cut(v) for k, v in moments.items()}
