"""Optimizers: Adam with a guard before each step, learning rates and other schedules of runs of any length.

A schedule is a function of x, the run's fraction, and keeps its nearest end value outside [0, 1]. All return
Python floats, because a safe loader rejects NumPy scalars in checkpoints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

SHORT_RUN = 1_000
"""Iterations up to which runs use the short-run rates."""
LONG_RUN = 30_000
"""Iterations from which runs use the published rates."""


def run_length_weight(iterations: int) -> float:
    """Compute the position of a run between the short (0) and the long one (1), on a logarithmic scale."""
    position = math.log(max(iterations, 1) / SHORT_RUN) / math.log(LONG_RUN / SHORT_RUN)
    return _fraction(position)


def log_linear(x: float, start: float, end: float) -> float:
    """Interpolate from start to end (both positive), linearly in the logarithm."""
    x = _fraction(x)
    return math.exp((1 - x) * math.log(start) + x * math.log(end))


def semantic_ramp(x: float, share: float) -> float:
    """Raise the weight of the semantic losses from 0.1 to 1 over the run's first `share`: geometry leads."""
    return log_linear(x / share if share > 0 else 1.0, 0.1, 1.0)


def cosine_decay(x: float, peak: float, end: float, power: float = 1.0) -> float:
    """Go from peak to end along half a cosine of x^power; a power above 1 stays near the peak longer."""
    peak, end = float(peak), float(end)
    return end + 0.5 * (peak - end) * (1 + math.cos(math.pi * _fraction(x) ** float(power)))


def _fraction(x: float) -> float:
    return min(max(float(x), 0.0), 1.0)


@dataclass
class RunAdamConfig(AdamOptimizerConfig):
    """Settings of Adam with a learning rate for the length of the run."""

    eps: float = 1e-15
    """Constant in Adam's denominator, as in 3D Gaussian splatting: early gradients of codes are tiny."""
    short_lr: float | None = None
    """Rate for runs of up to 1,000 iterations, where `lr` is for 30,000 and more; in between, the two are
    interpolated on a logarithmic scale. None: the same as `lr`."""

    def fit(self, iterations: int) -> None:
        """Resolve `lr` for a run of this many iterations."""
        if self.short_lr is not None:
            self.lr = log_linear(run_length_weight(iterations), self.short_lr, self.lr)
            self.short_lr = None

    def setup(self, params) -> Optimizer:
        params = list(params)
        # The fused form takes one pass over parameters and moments. A CPU otherwise takes ten, which for the
        # tables of hash grids costs more than rendering.
        fused = True if all(p.device.type == "cpu" for p in params) else None
        return torch.optim.Adam(params, lr=self.lr, eps=self.eps, weight_decay=self.weight_decay, fused=fused)


@dataclass
class RunScheduleConfig(SchedulerConfig):
    """Learning-rate curve in fractions of the run: warm-up (log-linear), then decay."""

    _target: type = field(default_factory=lambda: RunSchedule)
    start: float = 1.0
    """Multiple of the rate at the first iteration."""
    warm: float = 0.0
    """Fraction of the run until the full rate."""
    end: float = 1.0
    """Multiple of the rate at the end."""
    shape: Literal["cosine", "log-linear"] = "cosine"
    """Shape of the decay after the warm-up."""
    power: float = 1.0
    """Power to which the fraction is first raised, for `cosine` only; 2 keeps the rate high longer."""
    until: float = 1.0
    """Fraction of the run at which the end is reached; the rate is constant afterwards."""
    total_steps: int = LONG_RUN
    """Iterations of the run. The trainer sets it."""


class RunSchedule(Scheduler):
    """Scheduler of a `RunScheduleConfig`."""

    config: RunScheduleConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        # A plain function is used, since LambdaLR would put a callable object's state into the checkpoint.
        return LambdaLR(optimizer, lambda step: self.multiple(step))

    def multiple(self, step: int) -> float:
        """Compute the multiple of the rate at an iteration."""
        c = self.config
        x = min(step / max(c.total_steps, 1) / c.until, 1.0)
        if x < c.warm:
            return log_linear(x / c.warm, c.start, 1.0)
        rest = (x - c.warm) / (1.0 - c.warm) if c.warm < 1.0 else 1.0
        if c.shape == "log-linear":
            return log_linear(rest, 1.0, c.end)
        return cosine_decay(rest, 1.0, c.end, c.power)


def parameter_groups() -> dict[str, dict]:
    """Return the paper's parameter groups, with schedules in fractions of the run, and short-run rates."""
    adam, schedule = RunAdamConfig, RunScheduleConfig
    learned = partial(schedule, start=0.1, warm=0.05, end=0.01, power=2.0)
    groups = {
        "means": (adam(lr=1.6e-4, short_lr=6.4e-4), schedule(shape="log-linear", end=0.01)),
        "features_dc": (adam(lr=2.5e-3, short_lr=7.5e-3), schedule(end=0.1, power=2.0)),
        "features_rest": (adam(lr=2.5e-3 / 20), schedule(end=0.1, power=2.0)),
        "opacities": (adam(lr=0.05), None),
        "scales": (adam(lr=5e-3, short_lr=1.5e-2), None),
        "quats": (adam(lr=1e-3, short_lr=5e-3), None),
        "sky": (adam(lr=1e-3, short_lr=5e-3), schedule(end=0.1)),
        "codes": (adam(lr=1e-3, short_lr=3e-2), schedule(end=0.05)),
        "field_encoding": (adam(lr=5e-4, short_lr=1e-2), learned()),
        "field_decoder": (adam(lr=5e-4, short_lr=1e-2, weight_decay=1e-5), learned()),
        "downsampler": (adam(lr=5e-4, short_lr=5e-3, weight_decay=1e-5), learned()),
        "appearance": (adam(lr=5e-4, short_lr=5e-3), schedule(start=0.1, warm=0.05, end=0.1)),
        "appearance_vectors": (adam(lr=1e-3, short_lr=5e-3), schedule(end=0.1)),
        "camera_opt": (
            AdamOptimizerConfig(lr=1e-4, eps=1e-15),
            schedule(shape="log-linear", end=5e-3),
        ),
    }
    return {name: {"optimizer": rates, "scheduler": decay} for name, (rates, decay) in groups.items()}


class GuardedOptimizers(Optimizers):
    """nerfstudio's optimizers with a guard before each step."""

    def __init__(self, config: dict, param_groups: dict, allowed: Callable[[GradScaler], bool]):
        super().__init__(config, param_groups)
        self._allowed = allowed

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Step, or drop all gradients and leave parameters and moments unchanged."""
        if self._allowed(grad_scaler):
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
            return
        for name, parameters in self.live_parameters().items():
            if any(parameter.grad is not None for parameter in parameters):
                grad_scaler.unscale_(self.optimizers[name])  # records the overflow, which lowers the scale
        self.zero_grad_all()

    def live_parameters(self) -> dict[str, list[Tensor]]:
        """Return the optimizers' present parameters; `parameters` are those before densification."""
        return {
            name: [parameter for group in optimizer.param_groups for parameter in group["params"]]
            for name, optimizer in self.optimizers.items()
        }


def add_rows_to_state(optimizer: Optimizer) -> None:
    """Give rows that a resumed run added to a parameter (vectors of new photos) an optimizer state of 0."""
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if value.dim() and len(value) < len(parameter):
                added = value.new_zeros(len(parameter) - len(value), *value.shape[1:])
                state[name] = torch.cat((value, added))
