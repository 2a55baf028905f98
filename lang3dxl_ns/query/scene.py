"""`Scene`: a finished scene that can be rendered and queried."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.components.appearance import AppearanceField, Look, render_in_look
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.files.splat_file import write_matching, write_splats
from lang3dxl_ns.query import answer
from lang3dxl_ns.query import ask as asking
from lang3dxl_ns.query.answering import Place
from lang3dxl_ns.query.ask import Text
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.floaters import FLOATS, floating
from lang3dxl_ns.query.match import Found, Match, View
from lang3dxl_ns.query.question import QueryConfig, Question
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.text import NO_SEMANTICS, EncodeTexts, Prompt, TextEncoder, text_encoder, texts_of
from lang3dxl_ns.query.thresholds import match_thresholds, matching
from lang3dxl_ns.query.trust import ANCHORS, foreignness
from lang3dxl_ns.query.visibility import VisibleGaussians, measured, median_distance, total_pixels
from lang3dxl_ns.query.vocabulary import searched, shipped_vocabulary
from lang3dxl_ns.rendering import Rendering, Splats
from lang3dxl_ns.scene.camera import Camera, posed, resized, with_field_of_view, with_longer_side
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord, overview
from lang3dxl_ns.words.taught_words import Example, TaughtWord, known_word
from lang3dxl_ns.words.teach import carried_word, learned_word, least_certain_photo

if TYPE_CHECKING:
    from lang3dxl_ns.things.find import Things

_ROWS = 65_536
"""Number of Gaussians decoded at a time."""
LARGEST = 1920
"""Longer side of pictures in pixels if no size is requested."""


@dataclass(eq=False, repr=False)
class Scene:
    """A scene: Gaussians, what they mean, and the photos they were made from.

    The scene never changes. Results that are computed from it once (decoded features, the Gaussians that each
    photo shows) are kept. Any number of threads may use one scene.
    """

    splats: Splats
    """The Gaussians, in the model's frame."""
    file: SceneRecord
    """Photos, cameras, and the CLIP that the features come from."""
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
    looks: AppearanceField | None = None
    """Lighting of the photos; None if all share one."""
    background: Float[Tensor, "3"] | None = None
    """Color behind the scene, 0…1; None for black."""
    config: QueryConfig = field(default_factory=QueryConfig)
    """Defaults of queries, sizes of pictures, and of the views that `visible` measures."""
    cache: Path | None = None
    """File that keeps which Gaussians the photos show; if None, every process measures them."""
    watch: Callable[[str], None] | None = None
    """Called with a short description of slow work; if None, a progress bar is shown."""

    def __repr__(self) -> str:
        held_out = sum(photo.split == "eval" for photo in self.photos)
        words = f"CLIP {self.file.clip}" if self.decoder is not None else "only colors"
        return (
            f"Scene({len(self.splats):,} Gaussians, {len(self.photos)} photos ({held_out} held out) "
            f"of {self.file.data}, {words})"
        )

    @property
    def device(self) -> torch.device:
        """Device that holds the Gaussians."""
        return self.splats.means.device

    @property
    def photos(self) -> list[ScenePhoto]:
        """Training photos, then held-out ones, each with its name, camera and pose."""
        return self.file.photos

    @cached_property
    def overview(self) -> ScenePhoto:
        """The photo that shows the scene as a whole."""
        return overview(self.photos, tuple(self.splats.means.median(0).values.tolist()))

    def camera(self, place: Place, size: int | None = None, fov: float | None = None) -> Camera:
        """Build a camera of the scene.

        Args:
            place: a camera; a photo by name; or a pose, which gets the first photo's lens.
            size: longer side in pixels; by default a camera keeps its size, and a photo has its file's, at
                most 1920.
            fov: vertical field of view in degrees; by default the lens's.

        Raises:
            UserError: no photo has this name, or the size or field of view is impossible.
        """
        size = self.config.size if size is None else size
        if isinstance(place, Camera):
            camera = place if size is None else with_longer_side(place, size)
        else:
            photo = self.file.photo(place) if isinstance(place, str) else self.photos[0]
            camera = photo.full_camera
            if not isinstance(place, str):
                camera = posed(_pose(place), camera)
            camera = resized(camera, LARGEST) if size is None else with_longer_side(camera, size)
        return camera if fov is None else with_field_of_view(camera, fov)

    def render(
        self, place: Place, size: int | None = None, fov: float | None = None, look: str | None = None
    ) -> View:
        """Render the scene from a photo's viewpoint, a camera or a pose; see `camera`. look: training photo
        whose lighting is used; by default the scene's rule chooses for this view. Raises UserError as
        `camera` does, and if there is no look of this photo."""
        return self.view(place, self.camera(place, size, fov), look)

    def draw(
        self, camera: Camera, channels: Float[Tensor, "n d"] | None = None, look: Look | None = None
    ) -> Rendering:
        """Render a camera, and further values of the Gaussians, as tensors on the scene's device. Without a
        look, the scene's rule chooses the lighting for this view."""
        if look is None and self.looks is not None:
            look = self.looks.of_view(camera)
        return render_in_look(self.splats, camera, look, channels, background=self.background)

    def view(
        self,
        place: Place,
        camera: Camera,
        look: str | None = None,
        channels: Float[Tensor, "n d"] | None = None,
    ) -> View:
        """Render the camera of a place, with a training photo's look and further values of the Gaussians."""
        start = time.perf_counter()
        rendering = self.draw(camera, channels, self._look(look))
        name = self.file.photo(place).name if isinstance(place, str) else None
        return View(rendering, name, time.perf_counter() - start)

    def _look(self, photo: str | None) -> Look | None:
        if photo is None:
            return None
        if self.looks is None:
            raise UserError("all photos of this scene share one lighting: there is no look to choose")
        return self.looks.of_photo(self.file.photo(photo).name)

    def baked(self, look: str | None = None) -> Splats:
        """Return the Gaussians with the look of a training photo (default: the overview photo) in their
        colors, for viewers that know no looks. Raises UserError if there is no look of this photo."""
        chosen = self._look(look)
        if self.looks is None:
            return self.splats
        camera = self.overview.camera
        return (chosen or self.looks.of_view(camera)).apply(self.splats, camera)

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def ask(
        self,
        texts: Text | Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        foreground: str | None = None,
        threshold: float | None = None,
    ) -> Question:
        """Put prompts to the scene.

        Args:
            texts: prompts as `parse_prompts` reads them ("dome; rose window", '"windows" not "arcades"'), or
                vectors.
            negatives: phrases that all prompts compete with, besides their own.
            foreground: prompts that matches must lie on, such as "building"; default: the configured ones.
            threshold: relevancy above which places match, 0…1; default: the configured one, or else chosen
                for the scene (`match_thresholds`).

        Raises:
            UserError: there is no prompt, one is its own negative, the threshold is impossible, or the scene
                has colors only.
        """
        return asking.ask(self, texts, negatives, foreground, threshold)

    @overload  # a text is a sequence of texts too, and the first form is meant
    def query(  # type: ignore[overload-overlap]
        self,
        texts: Text,
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> Match: ...

    @overload
    def query(
        self,
        texts: Sequence[Text],
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> list[Match]: ...

    def query(
        self,
        texts: Text | Sequence[Text],
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> Match | list[Match]:
        """Find matches in a view: return a `Match` for one text, a list of them for several texts, or for a
        text that holds several prompts.

        Args:
            texts, negatives, threshold: see `ask`.
            place: a photo's name (matches are restricted to its foreground), a camera or a pose; None: for
                each prompt the training view that shows it best.
            size: longer side in pixels, see `camera`.

        Raises:
            UserError: see `ask` and `camera`.
        """
        question = self.ask(texts, negatives=negatives, threshold=threshold)
        if place is None:
            return _one_or_all(texts, answer.best_matches(self, question, size))
        return _one_or_all(texts, answer.matches(self, question, place, size))

    def matches(self, question: Question, place: Place, size: int | None = None) -> list[Match]:
        """Find matches of a question's prompts in one view; see `query`."""
        return answer.matches(self, question, place, size)

    @overload
    def find(  # type: ignore[overload-overlap]
        self, texts: Text, *, negatives: Sequence[str] = (), threshold: float | None = None, most: int = 10
    ) -> Found: ...

    @overload
    def find(
        self,
        texts: Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        threshold: float | None = None,
        most: int = 10,
    ) -> list[Found]: ...

    def find(
        self,
        texts: Text | Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        threshold: float | None = None,
        most: int = 10,
    ) -> Found | list[Found]:
        """Find matches in the scene: return a `Found` with at most `most` views for one text, a list of
        them for several, as `query` does. For the other arguments see `ask`. Raises UserError as `ask` does,
        and if `most` is below 1."""
        if most < 1:
            raise UserError(f"{most} views are requested: give 1 or more")
        question = self.ask(texts, negatives=negatives, threshold=threshold)
        return _one_or_all(texts, answer.locate(self, question, most))

    def relevancy(self, text: Text) -> Float[Array, " n"]:
        """Compute the relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo.
        Raises UserError as `ask` does, and for a text that holds several prompts."""
        return asking.ask_one(self, text).relevancy[0].cpu().float().numpy()

    def export(
        self,
        path: str | Path,
        text: Text | None = None,
        *,
        threshold: float | None = None,
        everything: bool = False,
        look: str | None = None,
        index: str | Path | None = None,
        hide_floaters: bool = False,
    ) -> int:
        """Write the Gaussians as a .ply, .spz, .sog or .glb file for splat viewers, in the scene's order, and
        return how many were written.

        Args:
            text: prompt; only the Gaussians that match it are written. None: all Gaussians are written.
            threshold: see `ask`.
            everything: with a text, write all Gaussians; a PLY has their relevancy as a property.
            look: training photo whose lighting is baked into the colors; default: the overview photo.
            index: with a text, a .npy or .txt file for the numbers of the matching Gaussians: their
                positions, from 0, in the scene, and so in the splat that it was attached to.
            hide_floaters: leave out the Gaussians that `floating` takes for floaters.

        Raises:
            UserError: nothing matches, or see `ask` and `write_splats`.
        """
        splats = self.baked(look)
        path, place = expanded(path), self.file.georeference
        solid = self.floating <= FLOATS if hide_floaters else None
        if text is None:
            return write_splats(path, splats if solid is None else splats.select(solid), place=place)
        question = asking.ask_one(self, text, threshold)
        return write_matching(path, splats, question, everything, index, solid, place)

    # ── what the photos show ────────────────────────────────────────────────────────────────────────

    @cached_property
    def visible(self) -> Mapping[str, VisibleGaussians]:
        """The Gaussians visible in each training view. They are measured once, with a progress bar."""
        size = self.config.views, self.config.view_side
        return measured(self.file, self.splats, *size, cache=self.cache, watch=self.watch)

    @cached_property
    def mass(self) -> Float[Tensor, " n"]:
        """Pixels that every Gaussian fills, summed over all views."""
        return total_pixels(self.visible, self.splats.means)

    @cached_property
    def floating(self) -> Float[Tensor, " n"]:
        """How surely each Gaussian is a floater, 0…1."""
        return floating(self.splats, self.visible, self.draw)

    @cached_property
    def gap(self) -> float:
        """Distance in world units below which matches are connected: 3 % of the median distance at which the
        scene is seen, about eight pixels of a small view; 0 if no training photo shows anything."""
        return 0.03 * median_distance(self.visible, self.splats.means)

    # ── features ────────────────────────────────────────────────────────────────────────────────────

    def encode(self, texts: str | Sequence[str]) -> Float[Array, "n c"]:
        """Encode texts as unit vectors in the scene's CLIP space: [c] for a string, [n, c] for a list."""
        vectors = self.text.vectors(texts).cpu().numpy()
        return vectors[0] if isinstance(texts, str) else vectors

    @property
    def features(self) -> Float[Array, "n c"]:
        """Unit CLIP features of all Gaussians in half precision; 0 for those visible in no photo. Each access
        decodes them, in parts: 1 GB for a million Gaussians with 512 channels."""
        rows = range(0, len(self.splats), _ROWS)
        parts = [self.engine.features(slice(row, row + _ROWS)).cpu().half().numpy() for row in rows]
        return np.concatenate(parts) if parts else np.zeros((0, 0), np.float16)

    def what_is(
        self,
        place: Place,
        x: float,
        y: float,
        *,
        words: Sequence[str] | None = None,
        most: int = 5,
        size: int | None = None,
    ) -> list[tuple[str, float]]:
        """Find at most `most` of the `words` (default: the shipped vocabulary of buildings) that match a
        pixel best, with their relevancy, best first. x, y: its column and row in the view; see `camera`.

        The result is empty where the scene's Gaussians hardly cover the pixel or have no meaning, and at the
        sky: where the sky or a generic phrase matches best, and no word is clearly better. Raises UserError
        if the pixel lies outside the view.
        """
        words = shipped_vocabulary() if words is None else texts_of(words, "a word")
        return answer.words_at(self, self.camera(place, size), x, y, words, most)

    def things(self, texts: Text | Sequence[Text]) -> list[Things]:
        """Find the single things that each prompt of `texts` (see `ask`) names: windows, portals, towers."""
        from lang3dxl_ns.things.find import things_of  # whose scipy opening does not need

        return things_of(self, self.ask(texts))

    # ── words taught by example ─────────────────────────────────────────────────────────────────────

    def teach(
        self, word: str, examples: Example | Sequence[Example], selection: Bool[Tensor, " n"] | None = None
    ) -> Scene:
        """Return a scene that also knows a word, as `scene.words[word]`, and uses what it learned wherever
        the word is a prompt; this scene is unchanged. Examples that the word had before are replaced.

        Args:
            word: the word, in any case.
            examples: marks in photos of the scene.
            selection: the Gaussians that are the word, if known; default: those that the marks show.

        Raises:
            UserError: the marks show nothing or everything, or lie outside their photos; or a prompt of this
                word would mean something else.
        """
        listed = [examples] if isinstance(examples, Example) else list(examples)
        return self.with_words([*self.words.values(), learned_word(self, word, listed, selection)])

    def with_words(self, words: Iterable[TaughtWord]) -> Scene:
        """Return this scene with other taught words (the last of equal names), sharing its results."""
        changed = copy.copy(self)
        changed.words = {known_word(word.name): word for word in words}
        return changed

    def carrying(self, word: TaughtWord) -> Scene:
        """Return a scene with a word taught elsewhere. If it was taught in these photos, of which a few may
        be gone, it is learned anew; if not, or if its marks no longer show anything, it is kept as it was
        learned there. Raises UserError if it was learned with another CLIP."""
        return self.with_words([*self.words.values(), carried_word(self, word)])

    def unsure(self, word: str) -> str:
        """Find the training photo in which a taught word is least certain, the best one to mark next. Raises
        UserError if the word was not taught."""
        return least_certain_photo(self, word)

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

    # ── computed once ───────────────────────────────────────────────────────────────────────────────

    def semantics(self) -> tuple[Decoder, Float[Tensor, "n d"]]:
        """The decoder and the codes. Raises UserError for a scene with colors only."""
        if self.decoder is None or self.codes is None:
            raise UserError(NO_SEMANTICS)
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


def _pose(place: Any) -> Float[Tensor, "rows 4"]:
    try:
        return torch.as_tensor(place, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"a place is a photo's name, a camera or a pose, not {place!r:.40}") from error


Answer = TypeVar("Answer", Match, Found)


def _one_or_all(texts: object, found: list[Answer]) -> Answer | list[Answer]:
    """Return all answers to a list of texts, or to a text that holds several prompts; else the only one."""
    return found if isinstance(texts, list | tuple) or len(found) > 1 else found[0]
