"""Hard cases of the semantic field: codes and precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn.functional import linear

from lab.numerics.hash_grid import interpolate_reference
from lab.numerics.measure import EXACT, Bounds, Case, Maps, Problem
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.hash_grid import COORDINATE_LIMIT
from lang3dxl_ns.components.semantic_field import SemanticField

CLIP, DENSE = 128, 32
FINE = {"float32": Bounds(1e-3, 1e-4, 2e-2, 5e-3), "float64": EXACT}
CROSSING = {"float32": Bounds(1e-3, 1e-4, 0.3, 5e-2), "float64": EXACT}
HELD = {"float32": Bounds(1e-5, 1e-5, 1e-5, 1e-5), "float64": EXACT}
HALF = {"bf16": Bounds(2e-2, 1e-2, 0.2, 5e-2), "fp16": Bounds(3e-3, 2e-3, 0.1, 2e-2)}


def cases(quick: bool, device: str) -> Iterator[Case]:
    """Yield the presets with usual codes, and the short preset with hard codes and in mixed precision."""
    tf32 = {"tf32": Bounds(1e-2, 5e-3, 0.1, 2e-2)} if device == "cuda" else {}
    presets = ("short", "paper") if quick else ("short", "paper", "official")
    for preset in presets:
        note = "rounding may choose the next cell, whose slope differs" if preset != "short" else ""
        config = SemanticFieldConfig(preset=preset, log2_table_size=12)  # type: ignore[arg-type]
        # Unbounded codes reach eight times as far as a sigmoid's coordinates, so rounding grows as much.
        bounds = CROSSING if preset == "official" else FINE
        yield Case("decoder", f"preset {preset}", partial(_problem, _codes, config), bounds, note)
    # This shows that crossing into another cell is the cause: with exact coordinates there is no error.
    exact = SemanticFieldConfig(preset="official", log2_table_size=12)
    held = "codes are multiples of 1/64: their coordinates are exact in float32"
    yield Case("decoder", "preset official, no crossing", partial(_problem, _held_codes, exact), HELD, held)
    short = SemanticFieldConfig(preset="short")
    hard: dict[str, Callable[[], Tensor]] = {
        "code 0": lambda: torch.zeros(5, 3, dtype=torch.float64),
        "codes ±50": lambda: 50 * _codes().sign(),
        "codes ±1e4 and ±∞": lambda: torch.cat([1e4 * _codes(), math.inf * _codes().sign()]),
        "NaN in some codes": lambda: _codes().index_fill(0, torch.tensor([3, 8]), math.nan),
    }
    raw = SemanticFieldConfig(preset="short", bounding="raw")
    for name, codes in hard.items():
        yield Case("decoder", name, partial(_problem, codes, short, outputs_only="NaN" in name), FINE)
        if name.startswith("codes"):
            yield Case("decoder", f"{name}, raw", partial(_problem, codes, raw), FINE)
    yield Case("decoder", "mixed precision", partial(_problem, _codes, short), HALF | tf32)


def _codes() -> Tensor:
    return torch.randn(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def _held_codes() -> Tensor:
    return (64 * _codes()).round() / 64


def _problem(codes: Callable[[], Tensor], config: SemanticFieldConfig, outputs_only: bool = False) -> Problem:
    generator = torch.Generator().manual_seed(0)
    field = SemanticField(config, CLIP, DENSE, generator=generator)
    channels = CLIP + DENSE
    field.set_output_statistics(torch.full((channels,), 0.3), torch.full((channels,), 0.5))
    state = {name: value.detach().double() for name, value in field.named_parameters()}
    state["grid.table"] = 1000 * state["grid.table"]
    constants = frozenset(state) | {"codes"} if outputs_only else frozenset[str]()

    def compute(leaves: Maps) -> Maps:
        parameters = {name: leaves[name] for name in state}
        moved = field.to(leaves["codes"].device, leaves["codes"].dtype)
        clip, dense = functional_call(moved, parameters, (leaves["codes"],))
        return {"clip": clip, "dense": dense}

    def reference(leaves: Maps) -> Maps:
        return decode_reference(field, leaves)

    return Problem({"codes": codes(), **state}, compute, reference, constants=constants)


def decode_reference(field: SemanticField, leaves: Maps) -> Maps:
    """Compute the decoder as documented: bound, look up, apply the layers, undo the whitening."""
    s, codes = field.settings, leaves["codes"]
    sigmoid = s.bounding == "sigmoid"
    x = codes.sigmoid() if sigmoid else codes.clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT)
    table = leaves["grid.table"]
    if s.indexed:
        passes = math.ceil(CLIP / field.grid.output_dim)
        points = [torch.cat([torch.full_like(x[:, :1], k / passes), x], dim=1) for k in range(passes)]
        values = torch.cat([interpolate_reference(field.grid, table, p) for p in points], dim=1)
        values = values[:, :CLIP]
    else:
        values = interpolate_reference(field.grid, table, x)
    if s.fourier_frequencies:
        angles = torch.stack([2 * math.pi * 2**k * x for k in range(s.fourier_frequencies)], dim=2).flatten(1)
        values = torch.cat([x, angles.sin(), angles.cos(), values], dim=1)
    layers = sorted({int(name.split(".")[1]) for name in leaves if name.startswith("layers.")})
    for depth, layer in enumerate(layers):
        values = linear(values, leaves[f"layers.{layer}.weight"], leaves[f"layers.{layer}.bias"])
        if s.activation == "every" or depth == len(layers) - 1:
            values = values.clamp_min(0)
    outputs = linear(values, leaves["output.weight"], leaves["output.bias"])
    outputs = outputs * field.output_std.double() + field.output_mean.double()
    return {"clip": outputs[:, :CLIP], "dense": outputs[:, CLIP:]}
