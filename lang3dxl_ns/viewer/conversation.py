"""What is asked of a model that a viewer shows, and what its views answer; no buttons here."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.model import Lang3DXLModel
from lang3dxl_ns.query.answer import NOTHING, Asked, ClipColours, Display
from lang3dxl_ns.query.lookup import CodeScorer, Lookup
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.scene import Found, QueryConfig, Scene
from lang3dxl_ns.query.scene_file import SceneFile
from lang3dxl_ns.query.text import EncodeTexts, Prompt
from lang3dxl_ns.scene_loading import scene_of_model, text_encoder


@dataclass
class Seconds:
    """What the latest answer took."""

    text: float | None = None
    """To turn the text into vectors."""
    frame: float | None = None
    """To render, words included."""
    words: float = 0.0
    """Of these, to find the words in the view."""


@dataclass(frozen=True)
class Question:
    """Prompts and their vectors."""

    prompts: tuple[Prompt, ...] = ()
    foreground: str = ""
    """Prompts outside of which nothing is found."""
    queries: Queries = field(default=NOTHING)
    """Of the prompts, then of the foreground."""

    @property
    def confining(self) -> int:
        """How many queries are the foreground's."""
        return len(self.queries) - len(self.prompts)


class Conversation:
    """Questions to a model, which may be in training in another thread.

    The thread that renders calls `outputs`, holding the lock, with the model in evaluation; threads that
    serve the panel call the rest, without it. The lookup table is of a model that has done learning: until
    then, and until it is made, every pixel is decoded.

    Args:
        lock: held by whoever uses the model.
        learning: whether the model still changes.
        shown: names of the outputs that the viewer shows.
        watch: told in a few words what takes long.
    """

    def __init__(
        self,
        model: Lang3DXLModel,
        file: SceneFile,
        run: Path,
        lock: AbstractContextManager,
        learning: Callable[[], bool],
        shown: Callable[[], set[str]],
        watch: Callable[[str], None],
    ) -> None:
        self.display = Display()
        self.exact = False
        self.per_scene = False
        """Stretch the colour map to the highest relevancy in the scene instead of in each view."""
        self.question = Question()
        self.found: list[Found] | None = None
        """None: not looked for yet."""
        self.seconds = Seconds()
        self._model, self._file, self._run, self._lock = model, file, run, lock
        self._learning, self._shown, self._watch = learning, shown, watch
        self._making = threading.Lock()
        self._scene: Scene | None = None
        self._scene_was_learned = False
        self._encode_texts: EncodeTexts | None = None
        self._lookup: Lookup | None = None
        self._colours: ClipColours | None = None

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def ask(self, text: str, negatives: str = "", foreground: str = "") -> Question:
        """Take up a question: prompts as `parse_prompts` reads them; phrases that all of them must beat,
        separated by commas or semicolons; and prompts outside of which nothing is found, if any. Raises
        UserError where nothing is asked for, or can be."""
        scene = self._scene_now()
        phrases = [" ".join(phrase.split()) for phrase in negatives.replace(";", ",").split(",")]
        extra = tuple(phrase for phrase in phrases if phrase)
        prompts = tuple(replace(p, negatives=p.negatives + extra) for p in scene.prompts(text))
        start = time.perf_counter()
        foreground = foreground.strip()
        queries = scene.queries([*prompts, *(scene.prompts(foreground) if foreground else ())])
        self.seconds.text = time.perf_counter() - start
        self.found = None
        self.question = Question(prompts, foreground, queries)
        return self.question

    def forget(self) -> None:
        """Nothing is asked for any more."""
        self.question, self.found = Question(), None

    def find(self) -> list[Found]:
        """Where in the scene each prompt is found. Looks at the scene and makes the lookup table first, which
        takes long once per checkpoint."""
        question, scene = self.question, self._scene_now()
        scene.config.threshold, scene.config.foreground = self.display.threshold, question.foreground
        exact = self.exact or not self.prepare(scene)
        found = scene.find(question.prompts, exact=exact)
        if question is self.question:
            self.found = found
        return found

    def prepare(self, scene: Scene | None = None) -> bool:
        """Make what makes answers fast, if the model has done learning; whether it has."""
        if self._learning():
            return False
        scene = scene or self._scene_now()
        self._lookup = scene.lookup
        self._colours = ClipColours.of(scene.decode, scene.rendered_codes())
        return True

    def _scene_now(self) -> Scene:
        """The scene as it is: while the model learns, a new one every time."""
        with self._making:
            learning = self._learning()
            if self._scene is None or not self._scene_was_learned:
                self._encode_texts = self._encode_texts or text_encoder(self._file, self._model.device)
                # What is looked at anew for every question is looked at briefly.
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
                self._lookup = self._colours = None
            return self._scene

    @contextmanager
    def _model_to_ourselves(self) -> Iterator[None]:
        with self._lock, torch.no_grad():
            training = self._model.training
            self._model.eval()
            try:
                yield
            finally:
                self._model.train(training)

    # ── answering ───────────────────────────────────────────────────────────────────────────────────

    def outputs(
        self, outputs: dict[str, Tensor], codes: Float[Tensor, "h w 3"], seconds: float
    ) -> dict[str, Tensor]:
        """What `Asked.outputs` has to show of a rendering, which took so many seconds. There always is an
        `overlay` and a `clip_pca`, since viewers break where an output that they show is missing."""
        start = time.perf_counter()
        alpha, field_ = outputs["accumulation"][..., 0], self._model.semantic_field
        assert field_ is not None
        table = None if self.exact or self._learning() or self._lookup is None else self._lookup.table
        # Without a table this picture alone takes as long as all the rest: only if someone looks at it.
        in_colour = table is not None or "clip_pca" in self._shown()
        asked = Asked(
            CodeScorer(field_.decode_clip, table),
            self.question.queries,
            self.question.confining,
            highest=self._highest(),
            colours=self._colours_of(field_.decode_clip, codes, alpha) if in_colour else None,
            display=self.display,
        )
        found = asked.outputs(outputs["rgb"], codes, alpha)
        found.setdefault("clip_pca", outputs["bottleneck"])
        self.seconds.words = time.perf_counter() - start
        self.seconds.frame = seconds + self.seconds.words
        return found

    def _colours_of(self, decode, codes: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]):
        if self._colours is None:
            self._colours = ClipColours.of(decode, codes[alpha >= Asked.min_alpha])
        return self._colours

    def _highest(self) -> float | None:
        scores = [v.score for found in self.found or () for v in found.viewpoints]
        return max(scores) if self.per_scene and scores else None

    # ── saying how it went ──────────────────────────────────────────────────────────────────────────

    def advice(self) -> str | None:
        """What there is to say about the answer, where something is odd about it."""
        if self.found is None or any(found.viewpoints for found in self.found):
            return None
        words = " or ".join(plain(shortened(found.prompt.text)) for found in self.found)
        return (
            f"Nothing in the scene looks like {words} by the threshold of {self.display.threshold:.2f}. "
            f"Lower it, or try other words: the CLIP of this run may not know these."
        )

    @property
    def path(self) -> str:
        """How pixels are decoded, and why."""
        if self._learning():
            return "exact, since the model still learns"
        if self.exact:
            return "exact: every pixel is decoded"
        if self._lookup is None:
            return "exact, until the lookup table is made"
        return "fast: read from the lookup table" if self._lookup.table else "exact: no table is good enough"

    def status(self) -> str:
        """Times, in one line."""
        s, parts = self.seconds, [self.path]
        if s.frame is not None:
            parts.insert(0, f"{s.frame * 1e3:.0f} ms per frame, {s.words * 1e3:.0f} of it for words")
        if s.text is not None:
            parts.insert(-1, f"{s.text * 1e3:.0f} ms per text")
        return " · ".join(parts)


def plain(text: str) -> str:
    """A text as Markdown that says just that."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def shortened(text: str, most: int = 40) -> str:
    """A text that fits on a button."""
    return text if len(text) <= most else text[: most - 1] + "…"
