"""What a resumed run needs besides parameters and optimisers, to end where it would have ended."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.pipeline import Lang3DXLPipeline


def run_state(pipeline: Lang3DXLPipeline) -> dict[str, Any]:
    """Statistics of densification, watched codes, the round through the photos and the random generators.

    Tensors and plain values, which torch's weights-only loader reads.
    """
    model = pipeline.model
    return {
        "strategy": dict(model.strategy_state),
        "code_steps": list(model.hash_levels.steps),
        "photos": pipeline.datamanager.round_state(),
        "random": torch.get_rng_state(),
        "random_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def restore_run_state(pipeline: Lang3DXLPipeline, state: dict[str, Any]) -> None:
    """The reverse, on the pipeline's device, whichever that was then."""
    model = pipeline.model
    model.strategy_state = {
        name: value.to(model.device) if isinstance(value, Tensor) else value
        for name, value in state["strategy"].items()
    }
    model.hash_levels.steps = list(state["code_steps"])
    pipeline.datamanager.restore_round(state["photos"])
    torch.set_rng_state(state["random"])
    if torch.cuda.is_available() and len(state["random_cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["random_cuda"])
