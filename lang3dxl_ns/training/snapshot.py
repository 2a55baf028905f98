"""Snapshots: the scene so far of a model that may be in training, as a scene of its own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Lock
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts, text_encoder
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.training.learn_codes import forget_words
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


class Snapshot(NamedTuple):
    """A scene that was copied from a model."""

    scene: Scene
    step: int | None
    """Iteration that it was taken at; None: training was over."""


@dataclass(eq=False, repr=False)
class Snapshots:
    """Takes snapshots of a model that may be in training in another thread. Decoders that learn from lifted
    features first learn words for the present model from the photos."""

    model: Training
    record: SceneRecord
    """Photos, cameras and CLIP."""
    run: Path
    """Folder of the run, which keeps results that are computed once."""
    lock: AbstractContextManager
    """Held while using the model."""
    learning: Callable[[], bool]
    """Returns whether the model still changes."""
    learn: Callable[[], None]
    """Makes the Gaussians' codes for the present model, for decoders that need it."""
    watch: Callable[[str], None]
    """Called with a short description of slow work."""
    _latest: Snapshot | None = None
    _taking: AbstractContextManager = field(default_factory=Lock)

    def latest(self) -> Snapshot:
        """Return the latest snapshot, or take one: during training it is used for at most a tenth of the run,
        afterwards one is taken for good."""
        with self._taking:
            if self._latest is None or self._is_outdated(self._latest.step):
                self._latest = self._take()
            return self._latest

    def _is_outdated(self, step: int | None) -> bool:
        if step is None:
            return False
        return not self.learning() or self.model.step - step > self.model.settings.total_steps / 10

    def _take(self) -> Snapshot:
        latest = self._latest
        encode_texts = latest.scene.encode_texts if latest else text_encoder(self.record, self.model.device)
        with self.lock, torch.no_grad():
            copied = partial(snapshot, self.model, self.record, encode_texts=encode_texts, watch=self.watch)
            # Asked inside the lock, since training may end, and learn its words, while it is waited for.
            if not self.learning():
                return Snapshot(copied(cache=self.run / "lang3dxl_visible.safetensors"), None)
            try:
                if self.model.learns_words_at_the_end:
                    self.watch("gathering the photos' features onto the present scene…")
                    self.learn()
                # In training every snapshot is examined anew, so keep that brief.
                return Snapshot(copied(config=QueryConfig(views=24, view_side=160)), self.model.step)
            finally:
                forget_words(self.model)
