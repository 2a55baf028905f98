"""Measurement of one numerics case: errors against a float64 reference, and run time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.common.reports import synchronize

Maps = dict[str, Tensor]
Function = Callable[[Maps], Mapping[str, Tensor]]

AUTOCAST = {"bf16": torch.bfloat16, "fp16": torch.float16}
"""Number types of the mixed-precision modes: inputs are float32, and the component runs under autocast."""
FLIP = 1e-4
"""Error, as a share of the largest value, above which a pixel counts as flipped across a threshold."""


@dataclass(frozen=True)
class Bounds:
    """Largest errors that pass, relative to the reference's largest value (max) or its RMS (rms)."""

    output_max: float = 1e-5
    output_rms: float = 1e-6
    gradient_max: float = 1e-4
    gradient_rms: float = 1e-5
    flipped: float = 0.0
    """Share of pixels that may fall on another side of a threshold than the reference's."""

    def times(self, factor: float) -> Bounds:
        """Return bounds whose errors are multiplied by a factor."""
        names = ("output_max", "output_rms", "gradient_max", "gradient_rms")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


EXACT = Bounds(1e-9, 1e-9, 1e-7, 1e-7)
"""Bounds in float64, where rounding is negligible and only the formula could be wrong."""


@dataclass
class Problem:
    """A case with its data: float64 leaves, and two functions of them that should agree."""

    leaves: Maps
    compute: Function
    """The component, in the precision and on the device of its leaves."""
    reference: Function
    """Reference in float64, written for clarity. It may be infinite or NaN where the component may be too."""
    thresholds: bool = False
    """Whether pixels that flip across a threshold are counted, and excluded from the gradient."""
    constants: frozenset[str] = frozenset()
    """Leaves without a gradient."""
    output_scale: float = 0.0
    """Smallest denominator of relative output errors, for outputs that nearly vanish."""
    gradient_scale: float = 0.0
    """Smallest denominator of relative gradient errors."""


@dataclass(frozen=True)
class Case:
    """A component and one hard case of it."""

    component: str
    name: str
    build: Callable[[], Problem]
    bounds: Mapping[str, Bounds] = field(default_factory=lambda: {"float32": Bounds(), "float64": EXACT})
    """Bounds by mode: float32, float64, bf16 and fp16 (autocast), tf32 (on a GPU)."""
    note: str = ""
    """Reason for the bounds, where it is not obvious."""


@dataclass
class Row:
    """Measured figures of a case in a mode: relative errors, and `ms` of one forward and backward pass."""

    component: str
    case: str
    mode: str
    output_max: float
    output_rms: float
    gradient_max: float | None
    gradient_rms: float | None
    flipped: float
    finite: bool
    ms: float
    bounds: Bounds
    note: str

    @property
    def name(self) -> str:
        """The component, the case and the mode."""
        return f"{self.component}, {self.case}, {self.mode}"

    @property
    def misses(self) -> list[str]:
        """Bounds exceeded, in words; empty for a pass."""
        found = [] if self.finite else ["not finite"]
        for name, bound in vars(self.bounds).items():
            value = getattr(self, name)
            if value is not None and not value <= bound:
                found.append(f"{name.replace('_', ' ')} {value:.1e} > {bound:.0e}")
        return found


def measure(case: Case, mode: str, device: torch.device | str = "cpu", repeats: int = 0) -> Row:
    """Measure a case in one mode: errors, whether all is finite, and the time if `repeats` is not 0."""
    problem = case.build()
    dtype = torch.float64 if mode == "float64" else torch.float32
    leaves = _leaves(problem, {n: v.to(device, dtype) for n, v in problem.leaves.items()})
    # The reference sees the rounded inputs: input rounding is not the component's error.
    exact = _leaves(problem, {n: v.detach().double() for n, v in leaves.items()})
    with _precision(mode, device):
        found = problem.compute(leaves)
    expected = problem.reference(exact)
    settled = _settled(found, expected) if problem.thresholds else {}
    upstream = _upstream(expected, settled)
    gradients = _gradients(found, leaves, upstream)
    exact_gradients = _gradients(expected, exact, upstream)
    outputs = [_errors(found[name], value, problem.output_scale) for name, value in expected.items()]
    slopes = [
        _errors(gradients[name], value, problem.gradient_scale) for name, value in exact_gradients.items()
    ]

    def work() -> None:
        with _precision(mode, device):
            again = problem.compute(leaves)
        _gradients(again, leaves, upstream)

    clock = time.process_time if torch.device(device).type == "cpu" else time.perf_counter
    seconds: list[float] = []
    for number in range(repeats and repeats + 1):
        start = clock()
        work()
        synchronize()
        if number:  # the first warms up
            seconds.append(clock() - start)
        if sum(seconds) > 0.2:
            break
    return Row(
        case.component,
        case.name,
        mode,
        output_max=_worst(error.max for error in outputs),
        output_rms=_worst(error.rms for error in outputs),
        gradient_max=_worst(error.max for error in slopes) if slopes else None,
        gradient_rms=_worst(error.rms for error in slopes) if slopes else None,
        flipped=1 - _share(settled),
        finite=all(error.finite for error in (*outputs, *slopes)),
        ms=1e3 * median(seconds or [0.0]),
        bounds=case.bounds[mode],
        note=case.note,
    )


@dataclass(frozen=True)
class _Error:
    max: float
    rms: float
    finite: bool
    """Whether the component is finite wherever the reference is."""


def _errors(found: Tensor, expected: Tensor, scale: float = 0.0) -> _Error:
    """Compute errors relative to the reference's largest value and RMS (at least `scale`).

    Where the reference is not finite, the component may be anything; where it is all zero, errors are
    absolute.
    """
    if found.shape != expected.shape:
        raise ValueError(f"the component gives {tuple(found.shape)}, the reference {tuple(expected.shape)}")
    keep = expected.detach().isfinite()
    true, ours = expected.detach()[keep], found.detach().to(expected.device)[keep].double()
    if not true.numel():
        return _Error(0.0, 0.0, True)
    difference = ours - true
    largest, size = max(float(true.abs().max()), scale), max(_rms(true), scale)
    return _Error(
        float(difference.abs().max()) / (largest or 1.0),
        _rms(difference) / (size or 1.0),
        bool(ours.isfinite().all()),
    )


def _rms(values: Tensor) -> float:
    """Compute the root mean square, of scaled values so that nothing under- or overflows."""
    largest = values.abs().max()
    if not largest > 0 or not bool(largest.isfinite()):
        return float(largest)
    return float(largest * (values / largest).square().mean().sqrt())


def _worst(values: Iterable[float]) -> float:
    """Return the largest value, or NaN if any is NaN (`max` could lose it)."""
    listed = list(values)
    return math.nan if any(math.isnan(value) for value in listed) else max(listed, default=0.0)


def _leaves(problem: Problem, values: Maps) -> Maps:
    return {name: value.requires_grad_(name not in problem.constants) for name, value in values.items()}


def _settled(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> Maps:
    """Return for each map the mask [h, w, 1] of the pixels in which no map flips across a threshold."""
    flipped = [
        (found[name].detach().double() - true.detach()).abs().amax(2, keepdim=True)
        > FLIP * float(true.detach().abs().max())
        for name, true in expected.items()
        if true.numel()
    ]
    if not flipped:
        return {}
    settled = ~torch.stack(flipped).any(0)
    return dict.fromkeys(expected, settled)


def _share(settled: Maps) -> float:
    return float(next(iter(settled.values())).double().mean()) if settled else 1.0


def _upstream(expected: Mapping[str, Tensor], settled: Maps) -> Maps:
    generator = torch.Generator().manual_seed(0)
    random = {
        name: torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value.device)
        for name, value in expected.items()
    }
    finite = {name: value.detach().isfinite() for name, value in expected.items()}
    return {name: value * settled.get(name, True) * finite[name] for name, value in random.items()}


def _gradients(outputs: Mapping[str, Tensor], leaves: Maps, upstream: Maps) -> Maps:
    """Compute the gradients of Σ output · upstream for all leaves; zero for leaves without influence."""
    wanted = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    attached = {name: value for name, value in outputs.items() if value.requires_grad}
    if not attached:
        return {name: torch.zeros_like(leaf) for name, leaf in wanted.items()}
    found = torch.autograd.grad(
        list(attached.values()),
        list(wanted.values()),
        [upstream[name].to(value) for name, value in attached.items()],
        allow_unused=True,
    )
    return {
        name: torch.zeros_like(leaf) if gradient is None else gradient
        for (name, leaf), gradient in zip(wanted.items(), found, strict=True)
    }


def narrowed(values: Tensor) -> Tensor:
    """Round to autocast's number type, like a layer's output; return values unchanged outside autocast."""
    device = values.device.type
    return values.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else values


def _precision(mode: str, device: torch.device | str) -> AbstractContextManager[Any]:
    """Create the context of a mode: autocast, TF32, or none."""
    if mode in AUTOCAST:
        return torch.autocast(torch.device(device).type, AUTOCAST[mode])
    return _tf32() if mode == "tf32" else nullcontext()


@contextmanager
def _tf32() -> Iterator[None]:
    """Use TF32 for matrix products inside the context, on GPUs that support it."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
