"""Linear layer with initial weights from a given random generator."""

from __future__ import annotations

import torch
from torch import nn


def linear(
    inputs: int,
    outputs: int,
    generator: torch.Generator | None = None,
    *,
    bias: bool = True,
    fan_in: int | None = None,
) -> nn.Linear:
    """Create a linear layer with torch's default initial range, drawn from a generator (None: torch's global
    one). `fan_in` is the number of inputs that determines the range, for a layer that is part of a wider
    one."""
    # torch's `skip_init` would take a third of a second to import at its first use.
    with torch.random.fork_rng(devices=[]):
        layer = nn.Linear(inputs, outputs, bias=bias)
    reach = (fan_in or inputs) ** -0.5
    for parameter in layer.parameters():
        nn.init.uniform_(parameter, -reach, reach, generator=generator)
    return layer
