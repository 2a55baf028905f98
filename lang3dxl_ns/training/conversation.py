"""Questions to snapshots of a model that may be in training, without a user interface."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from torch import Tensor

from lang3dxl_ns.query.answer import locate
from lang3dxl_ns.query.match import Found
from lang3dxl_ns.query.question import Question, pictures
from lang3dxl_ns.query.text import caution
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.things.find import Things, things_of
from lang3dxl_ns.training.snapshot import Snapshot, Snapshots

_LONGEST = 40
"""Most characters of a prompt in the summary."""


class Asked(NamedTuple):
    """A question and the snapshot that it was put to."""

    snapshot: Snapshot
    question: Question


@dataclass(eq=False, repr=False)
class Conversation:
    """The question that a viewer shows, while the model may be in training in another thread. A question is
    put to a snapshot of the model, a separate scene, so that only taking the snapshot waits for training."""

    snapshots: Snapshots
    shown: Callable[[], set[str]]
    """Returns the names of the outputs that the viewer shows."""
    drawn: Callable[[], None] = lambda: None
    """Called after each frame."""
    found: list[Found] | None = None
    """Matches of the question; None: not searched yet."""
    seconds: float | None = None
    """Duration of the latest frame in seconds, matches included."""
    _asked: Asked | None = None
    """The latest question. It is replaced as a whole, because other threads read it."""
    _of_frame: Asked | None = None
    """The question of the frame being drawn."""

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    @property
    def question(self) -> Question | None:
        """The latest question, if any."""
        return None if self._asked is None else self._asked.question

    def ask(self, text: str) -> Question:
        """Set the question to prompts as `parse_prompts` reads them. Raises UserError as `Scene.ask` does."""
        snapshot = self.snapshots.latest()
        question = snapshot.scene.ask(text)
        self._asked, self.found = Asked(snapshot, question), None
        return question

    def forget(self) -> None:
        """Clear the question."""
        self._asked = self.found = None

    def find(self) -> list[Found]:
        """Find matches of each prompt in the scene. The first search examines the scene, which takes long."""
        assert self._asked is not None
        (scene, _), question = self._asked
        found = locate(scene, question)
        if question is self.question:
            self.found = found
        return found

    def things(self) -> list[Things]:
        """Find the single things of each prompt, which takes seconds."""
        assert self._asked is not None
        return things_of(self._asked.snapshot.scene, self._asked.question)

    # ── answering: called by the render thread, which holds the lock ────────────────────────────────

    @property
    def shows_bottleneck(self) -> bool:
        """Whether a viewer shows the picture of the codes, which costs three more channels."""
        return "bottleneck" in self.shown()

    def channels(self) -> Tensor | None:
        """Return the values that Gaussians carry in the next rendering; None if the question was asked in
        training, since they may then not be the snapshot's."""
        self._of_frame = self._asked
        if self._of_frame is None or self._of_frame.snapshot.step is not None:
            return None
        return self._of_frame.question.channels

    def outputs(self, rendering: Rendering, seconds: float) -> dict[str, Tensor]:
        """Return `overlay` and the relevancies of a rendering that took `seconds`, for the question at the
        preceding call of `channels`. `overlay` is always present, since viewers break without it."""
        start, question = time.perf_counter(), None
        if self._of_frame is not None:
            (scene, _), question = self._of_frame
            if rendering.channels is None:
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
        step = None if self._asked is None else self._asked.snapshot.step
        if step is not None and self.snapshots.learning():
            parts.append(f"words as of iteration {step}, since the model still learns")
        return " · ".join(parts)


def plain(text: str) -> str:
    """Escape a text for Markdown."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)
