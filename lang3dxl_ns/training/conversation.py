"""Questions to snapshots of a model that may be in training, without a user interface."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from torch import Tensor

from lang3dxl_ns.query.answer import locate
from lang3dxl_ns.query.match import Found
from lang3dxl_ns.query.question import QueryConfig, Question, pictures
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import EncodeTexts, caution, text_encoder
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.things.find import Things, things_of
from lang3dxl_ns.training.learn_codes import forget_words
from lang3dxl_ns.training.snapshot import snapshot
from lang3dxl_ns.training.state import Training

_LONGEST = 40
"""Most characters of a prompt in the summary."""


@dataclass(eq=False, repr=False)
class Conversation:
    """Questions to a model that may be in training in another thread. Each is put to a snapshot of the model,
    a separate scene, so that only taking the snapshot waits for training; then words are first learned from
    the photos, if the decoder learns from lifted features."""

    model: Training
    """What is asked, trained or in training."""
    file: SceneRecord
    """Photos, cameras and CLIP."""
    run: Path
    """Folder of the run, which keeps results that are computed once."""
    lock: AbstractContextManager
    """Held while using the model."""
    learning: Callable[[], bool]
    """Returns whether the model still changes."""
    learn: Callable[[], None]
    """Makes the Gaussians' codes for the present model, for decoders that need it."""
    shown: Callable[[], set[str]]
    """Returns the names of the outputs that the viewer shows."""
    watch: Callable[[str], None]
    """Called with a short description of slow work."""
    drawn: Callable[[], None] = lambda: None
    """Called after each frame."""
    found: list[Found] | None = None
    """Matches of the question; None: not searched yet."""
    seconds: float | None = None
    """Duration of the latest frame in seconds, matches included."""
    _asked: tuple[Scene, Question] | None = None
    """The question with its snapshot: one tuple, replaced as a whole because other threads read it."""
    _drawn: tuple[Scene, Question] | None = None
    """The question and the snapshot of the frame being drawn."""
    _making: AbstractContextManager = field(default_factory=Lock)
    _scene: Scene | None = None
    _scene_step: int | None = None
    """Iteration of the snapshot; None: training was over."""
    _encode_texts: EncodeTexts | None = None

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    @property
    def question(self) -> Question | None:
        """The latest question, if any."""
        return None if self._asked is None else self._asked[1]

    def ask(self, text: str) -> Question:
        """Set the question to prompts as `parse_prompts` reads them. Raises UserError as `Scene.ask` does."""
        scene = self._scene_now()
        question = scene.ask(text)
        self._asked, self.found = (scene, question), None
        return question

    def forget(self) -> None:
        """Clear the question."""
        self._asked = self.found = None

    def find(self) -> list[Found]:
        """Find matches of each prompt in the scene. The first search examines the scene, which takes long."""
        assert self._asked is not None
        scene, question = self._asked
        found = locate(scene, question)
        if question is self.question:
            self.found = found
        return found

    def things(self) -> list[Things]:
        """Find the single things of each prompt, which takes seconds."""
        assert self._asked is not None
        return things_of(*self._asked)

    def _scene_now(self) -> Scene:
        """Return a snapshot of the present model. After training there is one final snapshot; during training
        a snapshot is reused for at most a tenth of the run."""
        with self._making:
            behind, taken = self.model.settings.total_steps / 10, self._scene_step
            recent = taken is None or (self.learning() and self.model.step - taken <= behind)
            if self._scene is None or not recent:
                self._encode_texts = self._encode_texts or text_encoder(self.file, self.model.device)
                self._scene, self._scene_step = self._snapshot()
            return self._scene

    def _snapshot(self) -> tuple[Scene, int | None]:
        """Take a snapshot; return it with the iteration that it was taken at (None: training was over)."""
        with self.lock, torch.no_grad():
            # Asked inside the lock, since training may end, and learn its words, while it is waited for.
            learning, step = self.learning(), self.model.step
            # In training every snapshot is examined anew, so keep that brief.
            config = QueryConfig(views=24, view_side=160) if learning else QueryConfig()
            cache = None if learning else self.run / "lang3dxl_visible.safetensors"
            try:
                if learning and self.model.learns_words_at_the_end:
                    self.watch("gathering the photos' features onto the present scene…")
                    self.learn()
                how: dict[str, Any] = {"cache": cache, "watch": self.watch}
                scene = snapshot(self.model, self.file, config=config, encode_texts=self._encode_texts, **how)
                return scene, step if learning else None
            finally:
                if learning:
                    forget_words(self.model)

    # ── answering: called by the render thread, which holds the lock ────────────────────────────────

    @property
    def shows_bottleneck(self) -> bool:
        """Whether a viewer shows the picture of the codes, which costs three more channels."""
        return "bottleneck" in self.shown()

    def channels(self) -> Tensor | None:
        """Return the values that Gaussians carry in the next rendering; None if the question was asked in
        training, since they may then not be the snapshot's."""
        self._drawn = self._asked
        if self._drawn is None or self._drawn[0] is not self._scene or self._scene_step is not None:
            return None
        return self._drawn[1].channels

    def outputs(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        """Return `overlay` and the relevancies of a rendering that took `seconds`, for the question at the
        preceding call of `channels`. `overlay` is always present, since viewers break without it."""
        start, (scene, question) = time.perf_counter(), self._drawn or (None, None)
        if question is not None and scene is not None and rendering.channels is None:
            of_snapshot = scene.draw(rendering.camera, question.channels)
            rendering = replace(rendering, channels=of_snapshot.channels, alpha=of_snapshot.alpha)
        found = pictures(rendering, question)
        self.seconds = seconds + time.perf_counter() - start
        self.drawn()
        return found

    # ── saying how it went ──────────────────────────────────────────────────────────────────────────

    def summary(self) -> str:
        """Describe what was found, in Markdown: a line for each prompt, and one for each warning about it."""
        lines = []
        for found in self.found or ():
            count, text = len(found.views), found.prompt.text
            text = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
            best = max((view.score for view in found.views), default=0.0)
            where = f"{count} good views, best {best:.2f}" if count else "nothing in the scene looks like it"
            lines.append(f"**{plain(text)}**: {where}")
            taught = found.prompt.taught is not None
            warnings = (None if taught else caution(text), str(found.trust))
            lines += [plain(line) for line in warnings if line]
        return "  \n".join(lines)

    def status(self) -> str:
        """Describe how long a frame takes, and what training still lacks."""
        parts = [] if self.seconds is None else [f"{self.seconds * 1e3:.0f} ms per frame"]
        if self._scene_step is not None and self.learning():
            parts.append(f"words as of iteration {self._scene_step}, since the model still learns")
        return " · ".join(parts)


def plain(text: str) -> str:
    """Escape a text for Markdown."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)
