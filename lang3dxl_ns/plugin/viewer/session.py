"""Query session of a viewer: prompts to a model and outputs of its views, without user interface."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.plugin.load_scene import scene_of_model, text_encoder
from lang3dxl_ns.plugin.model import Lang3DXLModel
from lang3dxl_ns.query.answer import NOTHING, Asked, Display
from lang3dxl_ns.query.doubt import doubtful
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.heat_maps import strongest
from lang3dxl_ns.query.match import Found
from lang3dxl_ns.query.relevancy import TEMPERATURE, Queries
from lang3dxl_ns.query.run_file import SceneFile
from lang3dxl_ns.query.scene import QueryConfig, Scene
from lang3dxl_ns.query.text import EncodeTexts, Prompt
from lang3dxl_ns.query.threshold import matching


@dataclass
class Seconds:
    """Durations of the latest answer."""

    text: float | None = None
    """Encoding the text."""
    frame: float | None = None
    """Rendering, matches included."""
    words: float = 0.0
    """Of these, computing the matches."""


@dataclass(frozen=True)
class Question:
    """Prompts and their vectors."""

    prompts: tuple[Prompt, ...] = ()
    foreground: str = ""
    """Prompts that matches must lie on."""
    queries: Queries = field(default=NOTHING)
    """Of the prompts, then of the foreground."""
    thresholds: tuple[float, ...] = ()
    """Relevancy above which places match each query, by the scene."""

    @property
    def confining(self) -> int:
        """Number of foreground queries."""
        return len(self.queries) - len(self.prompts)


class Conversation:
    """Queries to a model, which may be in training in another thread.

    The render thread calls `outputs`, holding the lock, with the model in evaluation mode; the panel's
    threads call the rest, without the lock. While the model trains and its semantics don't, a question has
    them learned from the photos (`learn`) if they are missing or outdated.

    Args:
        lock: held while using the model.
        learning: whether the model still changes.
        learn: makes the Gaussians' codes for the present model, for encoders that need it.
        shown: names of the outputs that the viewer shows.
        watch: called with a short description of slow work.
    """

    def __init__(
        self,
        model: Lang3DXLModel,
        file: SceneFile,
        run: Path,
        lock: AbstractContextManager,
        learning: Callable[[], bool],
        learn: Callable[[], None],
        shown: Callable[[], set[str]],
        watch: Callable[[str], None],
    ) -> None:
        self.display = Display()
        self.per_scene = False
        """Stretch the color map to the highest relevancy in the scene instead of in each view."""
        self.question = Question()
        self.found: list[Found] | None = None
        """None: not searched yet."""
        self.seconds = Seconds()
        self._model, self._file, self._run, self._lock = model, file, run, lock
        self._learning, self._learn, self._shown, self._watch = learning, learn, shown, watch
        self._making = threading.RLock()
        self._holder: int | None = None
        self._scene: Scene | None = None
        self._scene_was_learned = False
        self._encode_texts: EncodeTexts | None = None
        self._engine: QueryEngine | None = None
        self._temperature = TEMPERATURE
        self._engine_codes: Tensor | None = None
        self._asked: Asked | None = None
        self._learned_at: int | None = None

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def ask(self, text: str, negatives: str = "", foreground: str = "") -> Question:
        """Set the question: prompts as for `parse_prompts`; negatives for all of them, separated by commas or
        semicolons; and prompts that matches must lie on, if any. Raises UserError if there is no prompt, or
        nothing can be asked."""
        scene = self._scene_now()
        phrases = [" ".join(phrase.split()) for phrase in negatives.replace(";", ",").split(",")]
        extra = tuple(phrase for phrase in phrases if phrase)
        prompts = tuple(replace(p, negatives=p.negatives + extra) for p in scene.prompts(text))
        start = time.perf_counter()
        foreground = foreground.strip()
        everything = [*prompts, *(scene.prompts(foreground) if foreground else ())]
        # In the order of `find`: who asks the scene first has to wait for nobody who holds the model.
        with self._making, self._model_to_ourselves() if self._learning() else nullcontext():
            queries, thresholds = scene.queries(everything), scene.thresholds(everything)
            self._temperature = scene.engine.temperature
        self.seconds.text = time.perf_counter() - start
        self.found = None
        self.question = Question(prompts, foreground, queries, thresholds)
        return self.question

    def forget(self) -> None:
        """Clear the question."""
        self.question, self.found = Question(), None

    def find(self) -> list[Found]:
        """Matches of each prompt in the scene. First examines the scene, which takes long once per
        checkpoint."""
        # While the model trains, the number of Gaussians changes, so training has to wait.
        with self._making, self._model_to_ourselves() if self._learning() else nullcontext():
            question, scene = self.question, self._scene_now()
            scene.config.threshold, scene.config.foreground = self.display.threshold, question.foreground
            found = scene.find(question.prompts)
        if question is self.question:
            self.found = found
        return found

    def _scene_now(self) -> Scene:
        """The present scene; while the model trains, a new one every time."""
        with self._making:
            learning = self._learning()
            if self._scene is None or not self._scene_was_learned:
                self._encode_texts = self._encode_texts or text_encoder(self._file, self._model.device)
                if learning:
                    self._catch_up()
                # Examined anew for every question, so keep it brief.
                settings = QueryConfig(views=24, view_side=160) if learning else QueryConfig()
                self._scene = scene_of_model(
                    self._model,
                    self._file,
                    None if learning else self._run,
                    settings,
                    self._model_to_ourselves,
                    self._encode_texts,
                    self._watch,
                )
                self._scene_was_learned = not learning
            return self._scene

    @contextmanager
    def _model_to_ourselves(self) -> Iterator[None]:
        """Hold the lock, with the model in evaluation mode; reentrant."""
        if self._holder == threading.get_ident():
            yield
            return
        with self._lock, torch.no_grad():
            training, self._holder = self._model.training, threading.get_ident()
            self._model.eval()
            try:
                yield
            finally:
                self._model.train(training)
                self._holder = None

    def _catch_up(self) -> None:
        """Learn codes if the model has none, or if they are older than a tenth of the run."""
        encoder = self._model.semantic_field
        if encoder is None or not encoder.needs_lifting:
            return
        behind = self._model.config.total_steps / 10
        if self._learned_at is None or self._model.step - self._learned_at > behind:
            self._watch("gathering the photos' features onto the present scene…")
            with self._model_to_ourselves():
                self._learn()
            self._learned_at = self._model.step

    # ── answering ───────────────────────────────────────────────────────────────────────────────────

    @property
    def shows_bottleneck(self) -> bool:
        """Whether anyone views the picture of the codes."""
        return "bottleneck" in self._shown()

    def carried(self) -> Float[Tensor, "n d"] | None:
        """Values that Gaussians carry in the next rendering."""
        self._asked = self._ask_now()
        return None if self._asked is None else self._asked.carried

    def _ask_now(self) -> Asked | None:
        """The question to the present model; carried values are computed once for both."""
        codes, question = self._model.carried, self.question
        if codes is None or not len(question.queries):
            return None
        if self._engine is None or codes is not self._engine_codes:
            encoder = self._model.semantic_field
            assert encoder is not None
            self._engine = make_engine(encoder, codes.detach(), self._temperature)
            self._engine_codes, self._asked = codes, None
        if self._asked is None or self._asked.queries is not question.queries:
            return Asked(self._engine, question.queries, question.confining, thresholds=question.thresholds)
        return self._asked

    def outputs(
        self, outputs: dict[str, Tensor], rendered: Float[Tensor, "h w d"] | None, seconds: float
    ) -> dict[str, Tensor]:
        """The outputs of `Asked.outputs` for a rendering that took so many seconds. There is always an
        `overlay`, since viewers break if an output they show is missing."""
        start = time.perf_counter()
        asked = replace(self._asked or Asked(), highest=self.highest(), display=self.display)
        found = asked.outputs(outputs["rgb"], rendered, outputs["accumulation"][..., 0])
        self.seconds.words = time.perf_counter() - start
        self.seconds.frame = seconds + self.seconds.words
        return found

    def of_gaussians(self) -> tuple[Float[Tensor, " n"], float] | None:
        """Relevancy of every Gaussian to the best prompt that it matches, 0 outside the foreground, and the
        relevancy from which to show it; None without prompts."""
        question = self.question
        if not question.prompts:
            return None
        scores = self._scene_now().engine.of_gaussians(question.queries)
        if question.confining:
            scores, within = scores.tensor_split([-question.confining])
            scores = scores * matching(within, question.thresholds[len(scores) :]).any(0)
        asked, own = self.display.threshold, question.thresholds[: len(scores)]
        best, _, lowest = strongest(scores, own if asked is None else (asked,) * len(scores))
        return best, lowest

    def highest(self) -> float | None:
        """Relevancy for the last color of the heat map; None: the highest shown."""
        scores = [v.score for found in self.found or () for v in found.viewpoints]
        return max(scores) if self.per_scene and scores else None

    # ── saying how it went ──────────────────────────────────────────────────────────────────────────

    def advice(self) -> str | None:
        """Advice about the answer, if something is odd about it."""
        found = self.found or []
        lines = [plain(line) for f in found if (line := doubtful(shortened(f.prompt.text), f.doubt))]
        if found and not any(f.viewpoints for f in found):
            words = " or ".join(plain(shortened(f.prompt.text)) for f in found)
            asked = self.display.threshold
            level = "" if asked is None else f" by the threshold of {asked:.2f}. Lower it, or try other words"
            lines.append(f"Nothing in the scene looks like {words}{level}.")
        return "  \n".join(lines) or None

    def status(self) -> str:
        """Times, in one line."""
        s, parts = self.seconds, []
        if s.frame is not None:
            parts.append(f"{s.frame * 1e3:.0f} ms per frame")
        if s.text is not None:
            parts.append(f"{s.text * 1e3:.0f} ms per text")
        if self._learned_at is not None and self._learning():
            parts.append(f"words as of iteration {self._learned_at}, since the model still learns")
        return " · ".join(parts)


def plain(text: str) -> str:
    """A text escaped for Markdown."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def shortened(text: str, most: int = 40) -> str:
    """A text shortened to fit on a button."""
    return text if len(text) <= most else text[: most - 1] + "…"
