"""Run state in a checkpoint, beyond parameters and optimizers, for an exact resume."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline


def run_state(pipeline: Lang3DXLPipeline) -> dict[str, Any]:
    """Collect densification statistics, whether codes have begun, the current round through the photos, and
    the random generators' states.

    The state has only tensors and plain values, which torch's weights-only loader accepts.
    """
    model = pipeline.model
    return {
        "strategy": dict(model.strategy_state),
        "codes_have_begun": model.codes_have_begun,
        "photos": pipeline.datamanager.round_state(),
        "random": torch.get_rng_state(),
        "random_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def restore_run_state(pipeline: Lang3DXLPipeline, state: dict[str, Any]) -> None:
    """Restore `run_state` on the pipeline's device, whichever device it was saved from."""
    model = pipeline.model
    model.strategy_state = {
        name: value.to(model.device) if isinstance(value, Tensor) else value
        for name, value in state["strategy"].items()
    }
    model.codes_have_begun = state.get("codes_have_begun", False)  # earlier checkpoints lack this
    pipeline.datamanager.restore_round(state["photos"])
    torch.set_rng_state(state["random"])
    if torch.cuda.is_available() and len(state["random_cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["random_cuda"])
