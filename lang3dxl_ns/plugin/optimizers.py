"""nerfstudio's settings of the optimizers: training's rates and schedules, and a guard before each step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.training.learning_rates import Rate, Rates, Schedule

_OF_SCHEDULES = {**dict.fromkeys(("start", "end", "until"), (1e-9, 1e9)), "warm": (0, 1), "power": (0, 100)}


@dataclass
class RunAdamConfig(Rate, AdamOptimizerConfig):  # type: ignore[misc]
    """Settings of Adam with a learning rate for the length of the run."""

    def setup(self, params) -> Optimizer:
        return self.adam(params)


@dataclass
class RunScheduleConfig(Schedule, SchedulerConfig):
    """Learning-rate curve in fractions of the run: warm-up (log-linear), then decay."""

    _target: type = field(default_factory=lambda: RunSchedule)


class RunSchedule(Scheduler):
    """Scheduler of a `RunScheduleConfig`."""

    config: RunScheduleConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        return self.config.scheduler(optimizer)


def parameter_groups(rates: Rates) -> dict[str, dict]:
    """Convert rates and schedules to nerfstudio's settings of the parameter groups."""
    return {
        name: {
            "optimizer": RunAdamConfig(**asdict(rate)),
            "scheduler": None if decay is None else RunScheduleConfig(**asdict(decay)),
        }
        for name, (rate, decay) in rates.items()
    }


def check_rates(groups: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise UserError for a rate or schedule of the parameter groups that is out of its range."""
    for name, group in groups.items():
        option = f"--optimizers.{name.replace('_', '-')}."
        check_numbers(group["optimizer"], {"lr": (1e-12, 1e3)}, f"{option}optimizer.")
        if isinstance(group["scheduler"], RunScheduleConfig):
            check_numbers(group["scheduler"], _OF_SCHEDULES, f"{option}scheduler.")


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
