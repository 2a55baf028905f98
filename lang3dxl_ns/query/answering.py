"""`Answering`: what a scene's Gaussians mean, which every answer is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.rendered_scene import RenderedScene
from lang3dxl_ns.query.text import EncodeTexts, Prompt, TextEncoder, text_encoder, why_no_words
from lang3dxl_ns.query.thresholds import match_thresholds, matching
from lang3dxl_ns.query.trust import ANCHORS, foreignness
from lang3dxl_ns.query.visibility import VisibleGaussians, measured
from lang3dxl_ns.query.vocabulary import searched
from lang3dxl_ns.scene.camera import in_camera_frame
from lang3dxl_ns.words.taught_words import TaughtWord


@dataclass(eq=False, repr=False)
class Answering(RenderedScene):
    """A scene with what its Gaussians mean: all that answers to questions need of it, each computed once."""

    decoder: Decoder | None = None
    """Turns codes into features; None for a scene with colors only."""
    codes: Float[Tensor, "n d"] | None = None
    """Semantic values of the Gaussians, a row each; NaN for those visible in no photo."""
    _: KW_ONLY
    encode_texts: EncodeTexts | None = None
    """The scene's CLIP, if it is already loaded; otherwise it is loaded at the first text that is not among
    `vectors`."""
    vectors: Mapping[str, Float[Tensor, " c"]] | None = None
    """Unit vectors of common words, which need no CLIP."""
    words: Mapping[str, TaughtWord] = field(default_factory=dict)
    """Words taught by example, by their names in lower case; see `with_words`."""
    cache: Path | None = None
    """File that keeps which Gaussians the photos show; if None, every process measures them."""
    watch: Callable[[str], None] | None = None
    """Called with a short description of slow work; if None, a progress bar is shown."""

    @cached_property
    def visible(self) -> Mapping[str, VisibleGaussians]:
        """The Gaussians visible in each training view. They are measured once, with a progress bar."""
        size = self.config.views, self.config.view_side
        return measured(self.file, self.splats, *size, cache=self.cache, watch=self.watch)

    @cached_property
    def mass(self) -> Float[Tensor, " n"]:
        """Pixels that every Gaussian fills, summed over all views."""
        mass = self.splats.means.new_zeros(len(self.splats))
        for view in self.visible.values():
            mass[view.rows.long()] += view.pixels.float()
        return mass

    @cached_property
    def gap(self) -> float:
        """Distance in world units below which matches are connected: 3 % of the median distance at which the
        scene is seen, about eight pixels of a small view; 0 if no training photo shows anything."""
        seen, means = [view for view in self.visible.values() if len(view.rows)], self.splats.means
        depths = [float(in_camera_frame(view.camera, means[view.rows])[:, 2].median()) for view in seen]
        return 0.03 * float(torch.tensor(depths).nanmedian()) if depths else 0.0

    # ── prompts ─────────────────────────────────────────────────────────────────────────────────────

    def queries(self, prompts: Sequence[Prompt]) -> Queries:
        """Encode prompts on the scene's device. Only texts that the scene doubts get their synonyms: where
        CLIP knows the word itself, synonyms would only blur it."""
        known = {prompt.text for prompt in prompts if not self.synonyms(prompt)}
        return self.text.queries(prompts, known).to(self.device)

    def synonyms(self, prompt: Prompt) -> list[str]:
        """Return the synonyms searched along with a prompt."""
        fixed = prompt.vector is not None or prompt.taught is not None
        synonyms = [] if fixed else self.text.synonyms(prompt.text)
        if not synonyms or self.config.text.combine != "fallback":
            return synonyms
        return synonyms if self.doubts.alone(searched(prompt.text)) > DOUBTFUL else []

    # ── features ────────────────────────────────────────────────────────────────────────────────────

    def semantics(self) -> tuple[Decoder, Float[Tensor, "n d"]]:
        """The decoder and the codes. Raises UserError for a scene without words."""
        if self.decoder is None or self.codes is None:
            raise UserError(why_no_words(self.file))
        return self.decoder, self.codes

    @cached_property
    def engine(self) -> QueryEngine:
        """The query engine, which decodes the features of all Gaussians at first use."""
        engine = make_engine(*self.semantics(), self.config.temperature)
        return engine.calibrated(self.text.yardstick.to(self.device))

    @cached_property
    def text(self) -> TextEncoder:
        """The encoder of prompts, which loads the scene's CLIP at the first text that it doesn't know."""
        self.semantics()
        return TextEncoder(self._encode, self.config.text, self.vectors)

    def _encode(self, texts: list[str]) -> Float[Tensor, "n c"]:
        if self.encode_texts is None:
            self.encode_texts = text_encoder(self.file, self.device)
        return self.encode_texts(texts)

    @cached_property
    def foreignness(self) -> float | None:
        """How far the scene is from what its CLIP was trained on, about 1 for scenes like that; see
        `trust.foreignness`."""
        return foreignness(self.engine, self.file.clip_identity)

    @cached_property
    def anchors(self) -> Bool[Tensor, "anchors n"]:
        """Which Gaussians match each of the common words `trust.ANCHORS`."""
        relevancy = self.engine.of_gaussians(self.text.plain_queries(ANCHORS).to(self.device))
        levels = match_thresholds(relevancy, self.doubts.of(relevancy), [False] * len(ANCHORS))
        return matching(relevancy, levels)

    @cached_property
    def doubts(self) -> Doubts:
        """Estimator of which prompts the scene does not contain."""
        return Doubts(self.engine.of_gaussians, lambda texts: self.text.plain_queries(texts).to(self.device))
