"""The scene so far, as a value of its own."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.training.state import Training

Module = TypeVar("Module", bound=nn.Module)


@torch.no_grad()
def snapshot(
    run: Training,
    record: SceneRecord,
    *,
    config: QueryConfig | None = None,
    encode_texts: EncodeTexts | None = None,
    cache: Path | None = None,
    watch: Callable[[str], None] | None = None,
) -> Scene:
    """Copy the present state to a separate scene, which later training doesn't change, with the photos,
    cameras and CLIP of a record; for the other arguments see `Scene`. While a run has no words yet, its scene
    has colors only."""
    codes, looks, semantics = run.carried, run.parts.appearance, run.parts.semantics
    background: Tensor = run.means.new_full((3,), float(run.settings.background_color == "white"))
    return Scene(
        run.splats().mapped(torch.clone),
        record,
        None if codes is None or semantics is None else _frozen(semantics.decoder),
        None if codes is None else codes.detach().clone(),
        looks=None if looks is None else _frozen(looks),
        background=background,
        config=config or QueryConfig(),
        encode_texts=encode_texts,
        cache=cache,
        watch=watch,
    )


def _frozen(module: Module) -> Module:
    """Copy a module without gradients, for evaluation."""
    return deepcopy(module).eval().requires_grad_(False)
