"""`Scene`: a finished scene that can be rendered and queried."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.console import say_once, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.components.appearance import AppearanceField, Look, render_in_look
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.files.splat_file import write_index, write_splats
from lang3dxl_ns.preparation.encoders import load_image_text_encoder
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts, doubtful
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.match import Found, Match, View
from lang3dxl_ns.query.negatives import CLEAR, NOTHING
from lang3dxl_ns.query.question import QueryConfig, Question
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.text import (
    EncodeTexts,
    Prompt,
    TextEncoder,
    listed_phrases,
    parse_prompts,
    taught_prompt,
    texts_of,
)
from lang3dxl_ns.query.thresholds import match_thresholds
from lang3dxl_ns.query.view_ranking import Viewpoint, rank_views, strongest_match
from lang3dxl_ns.query.visibility import VisibleGaussians, fingerprint, load_visible, save_visible, spread
from lang3dxl_ns.query.vocabulary import searched, shipped_vocabulary
from lang3dxl_ns.rendering import Backend, Rendering, Splats, composite
from lang3dxl_ns.rendering.gathering import filled_pixels
from lang3dxl_ns.scene.camera import Camera, posed, resized, with_field_of_view, with_longer_side
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord, overview
from lang3dxl_ns.words.learn_word import Weights, learn
from lang3dxl_ns.words.taught_words import Example, TaughtWord, known_word

_ROWS = 65_536
"""Number of Gaussians decoded at a time."""
LARGEST = 1920
"""Longer side of pictures in pixels if no size is requested."""
NO_SEMANTICS = "this scene has colors alone (it was trained with clip none): it can't be queried"
Text: TypeAlias = str | Prompt | Float[Tensor, " c"] | Float[Array, " c"]
"""A text as `parse_prompts` reads it, or a vector in the space of the scene's CLIP."""
Place: TypeAlias = Camera | str | Float[Tensor, "rows 4"] | Float[Array, "rows 4"]
"""A camera, a photo's name, or a pose (camera → world in the model's frame, nerfstudio's axes)."""


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
    backend: Backend = "auto"
    """The rasterizer, see `rasterize`."""
    watch: Callable[[str], None] | None = None
    """Called with a short description of slow work; if None, a progress bar is shown."""
    _doubt_alone: dict[str, float] = field(default_factory=dict, init=False)
    """Doubt about texts without their synonyms, by text."""

    def __repr__(self) -> str:
        held_out = sum(photo.split == "eval" for photo in self.photos)
        words = f"CLIP {self.file.clip}" if self.decoder is not None else "colors alone"
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
        return self._view(self.camera(place, size, fov), self._name(place), look)

    def draw(
        self, camera: Camera, channels: Float[Tensor, "n d"] | None = None, look: Look | None = None
    ) -> Rendering:
        """Render a camera, and further values of the Gaussians, as tensors on the scene's device. Without a
        look, the scene's rule chooses the lighting for this view."""
        if look is None and self.looks is not None:
            look = self.looks.of_view(camera)
        return render_in_look(
            self.splats, camera, look, channels, background=self.background, backend=self.backend
        )

    def _view(
        self,
        camera: Camera,
        name: str | None,
        look: str | None = None,
        channels: Float[Tensor, "n d"] | None = None,
    ) -> View:
        start = time.perf_counter()
        rendering = self.draw(camera, channels, self._look(look))
        return View(rendering, name, time.perf_counter() - start)

    def _look(self, photo: str | None) -> Look | None:
        if photo is None:
            return None
        if self.looks is None:
            raise UserError("all photos of this scene share one lighting: there is no look to choose")
        return self.looks.of_photo(self.file.photo(photo).name)

    def _name(self, place: Place) -> str | None:
        return self.file.photo(place).name if isinstance(place, str) else None

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
        requested = self.config.threshold if threshold is None else threshold
        if requested is not None and not 0 <= requested <= 1:
            raise UserError(f"the threshold is {requested}: give a relevancy from 0 to 1")
        rivals = listed_phrases(texts_of(negatives, "a negative"))
        prompts = [replace(p, negatives=(*p.negatives, *rivals)) for p in self.prompts(texts)]
        within = self.config.foreground if foreground is None else foreground
        everything = [*prompts, *(self.prompts(within) if within else ())]
        if own := [p.text for p in everything if known_word(p.text) in map(known_word, p.negatives)]:
            raise UserError(f"{own[0]!r} is its own negative, so nothing can match it: name another negative")
        queries, count = self.queries(everything), len(prompts)
        relevancy = self.engine.of_gaussians(queries)
        doubts = [
            doubt if prompt.taught is None else prompt.taught.doubt
            for prompt, doubt in zip(everything, self.doubts.of(relevancy), strict=True)
        ]
        for prompt, doubt in zip(everything[count:], doubts[count:], strict=True):
            if advice := doubtful(prompt.text, doubt, prompt.taught is not None):
                say_once(f"foreground {prompt.text}: {advice}")
        strict = [bool(prompt.negatives or prompt.taught) for prompt in everything]
        levels = match_thresholds(relevancy, doubts, strict)
        return Question(
            self.engine,
            tuple(prompts),
            queries,
            relevancy,
            tuple(doubts[:count]),
            levels[:count] if requested is None else (requested,) * count,
            levels[count:],
            self.config.min_alpha,
        )

    def query(
        self,
        texts: Text | Sequence[Text],
        place: Place | None = None,
        *,
        negatives: Sequence[str] = (),
        size: int | None = None,
        threshold: float | None = None,
    ) -> Any:
        """Find matches in a view: return a `Match` for one prompt, a list of them for several.

        Args:
            texts, negatives, threshold: see `ask`.
            place: a photo's name (matches are restricted to its foreground), a camera or a pose; None: for
                each prompt the training view that shows it best.
            size: longer side in pixels, see `camera`.

        Raises:
            UserError: see `ask` and `camera`.
        """
        question = self.ask(texts, negatives=negatives, threshold=threshold)
        if place is not None:
            found = self.matches(question, place, size)
        else:
            names = self.best_views(question)
            questions = [self.ask([p], threshold=threshold) for p in question.prompts]
            found = [self.matches(q, n, size)[0] for q, n in zip(questions, names, strict=True)]
        return found if _several(texts, found) else found[0]

    def matches(self, question: Question, place: Place, size: int | None = None) -> list[Match]:
        """Find matches of a question's prompts in one view; see `query`.

        Relevancies are composited with at most as many pixels as the training photos have, and enlarged for a
        larger view: nothing was learned between these pixels, and Gaussians too thin for them would stand out
        as lines.
        """
        start = time.perf_counter()
        channels = question.channels
        asked = time.perf_counter()
        camera, name = self.camera(place, size), self._name(place)
        small = resized(camera, self.trained_side)
        enlarged = small.width < camera.width
        view = self._view(camera, name, channels=None if enlarged else channels)
        rendered, rendering = time.perf_counter(), view.rendering
        if enlarged:
            rendering = replace(rendering, channels=composite(self.splats, small, channels, self.backend))
        foreground = None if name is None else self.file.photo(name).foreground()
        maps, masks = question.maps(rendering, foreground)
        found = maps.cpu().float().numpy(), masks.cpu().numpy()
        seconds = asked - start + time.perf_counter() - rendered
        rows = zip(question.prompts, question.doubts, *found, question.thresholds, strict=True)
        return [
            Match(prompt, self.synonyms(prompt), doubt, view, relevancy, mask, level, seconds)
            for prompt, doubt, relevancy, mask, level in rows
        ]

    @torch.no_grad()
    def relevancy_maps(self, camera: Camera, queries: Queries) -> Float[Tensor, "q h w"]:
        """Compute every pixel's relevancy to every query, 0…1, as it is scored, without a foreground."""
        rendering = self.draw(camera, self.engine.channels(queries))
        assert rendering.channels is not None
        return self.engine.maps(rendering.channels, queries)

    def find(
        self,
        texts: Text | Sequence[Text],
        *,
        negatives: Sequence[str] = (),
        threshold: float | None = None,
        most: int = 10,
    ) -> Any:
        """Find matches in the scene: return a `Found` with at most `most` views for one prompt, a list of
        them for several. For the other arguments see `ask`. Raises UserError as `ask` does, and if `most` is
        below 1."""
        if most < 1:
            raise UserError(f"{most} views are requested: give 1 or more")
        found = self.places(self.ask(texts, negatives=negatives, threshold=threshold), most)
        return found if _several(texts, found) else found[0]

    def places(self, question: Question, most: int = 10) -> list[Found]:
        """Find matches of a question's prompts in the scene; see `find`."""
        found = []
        for row, prompt in enumerate(question.prompts):
            scores, threshold = question.relevancy[row], question.thresholds[row]
            views, box = [view for view in self._ranked(question, row) if view.shown][:most], None
            if views:
                box = strongest_match(self.splats.means, scores, self.mass, threshold, self.gap)
            relevancy, matching = scores.cpu().float().numpy(), question.gaussians[row].cpu().numpy()
            found.append(Found(prompt, views, box, relevancy, matching, question.doubts[row], threshold))
        return found

    def best_views(self, question: Question) -> list[str]:
        """Return for each prompt the name of the training photo whose view shows it best, or comes closest.
        Raises UserError if the scene has no training photos."""
        self._check_views()
        return [self._ranked(question, row)[0].name for row in range(len(question.prompts))]

    def _check_views(self) -> None:
        if not self.visible:
            raise UserError("this scene has no training photos to choose from: name a photo or a camera")

    def relevancy(self, text: Text) -> Float[Array, " n"]:
        """Compute the relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo.
        Raises UserError as `ask` does, and for a text that holds several prompts."""
        return self._one(text).relevancy[0].cpu().float().numpy()

    def export(
        self,
        path: str | Path,
        text: Text | None = None,
        *,
        threshold: float | None = None,
        everything: bool = False,
        look: str | None = None,
        index: str | Path | None = None,
    ) -> int:
        """Write the Gaussians as a .ply or .spz file for splat viewers, in the scene's order, and return how
        many were written.

        Args:
            text: prompt; only the Gaussians that match it are written. None: all Gaussians are written.
            threshold: see `ask`.
            everything: with a text, write all Gaussians; a PLY has their relevancy as a property.
            look: training photo whose lighting is baked into the colors; default: the overview photo.
            index: with a text, a .npy or .txt file for the numbers of the matching Gaussians: their
                positions, from 0, in the scene, and so in the splat that it was attached to.

        Raises:
            UserError: nothing matches, or see `ask` and `write_splats`.
        """
        splats = self.baked(look)
        if text is None:
            return write_splats(expanded(path), splats)
        question = self._one(text, threshold)
        relevancy, keep = question.relevancy[0], question.gaussians[0]
        if not everything and not keep.any():
            best, level = float(relevancy.max()), question.thresholds[0]
            raise UserError(
                f"no Gaussian matches {question.prompts[0].text!r}: the best reaches {best:.2f}; lower "
                f"--threshold, now {level:.2f}, or write all with their relevancy (--all)"
            )
        if not everything:
            splats, relevancy = splats.select(keep), relevancy[keep]
        if index is not None:
            write_index(expanded(index), keep)
        return write_splats(expanded(path), splats, relevancy)

    # ── what the photos show ────────────────────────────────────────────────────────────────────────

    @cached_property
    def visible(self) -> Mapping[str, VisibleGaussians]:
        """The Gaussians visible in each training view. They are measured once, with a progress bar."""
        count, side = self.config.views, self.config.view_side
        chosen = spread([photo for photo in self.photos if photo.split == "train"], count)
        cameras = {photo.name: resized(photo.camera, side) for photo in chosen}
        key = ""
        if self.cache is not None:
            masks = [photo.mask_stamp() for photo in chosen]
            how = [asdict(self.file), count, side, self.splats.antialiased, masks]
            key = fingerprint(vars(self.splats.gaussians), how)
            if (kept := load_visible(self.cache, key, cameras, self.device)) is not None:
                return kept
        views, what = dict[str, VisibleGaussians](), "measuring which Gaussians the photos show, once"
        for name, camera in tracked(cameras.items(), what):
            if self.watch is not None:
                self.watch(f"{what}: view {len(views) + 1} of {len(cameras)}")
            size = camera.height, camera.width
            mask = self.file.photo(name).foreground(size)
            weight = torch.ones(size) if mask is None else mask.float()
            views[name] = VisibleGaussians.of(camera, self._fill(camera, weight.to(self.device)))
        if self.cache is not None and views:
            save_visible(self.cache, views, key)
        return views

    def _fill(self, camera: Camera, weight: Float[Tensor, "h w"]) -> Float[Tensor, " n"]:
        drawn = partial(composite, self.splats, camera, backend=self.backend)
        return filled_pixels(drawn, weight, len(self.splats))

    @cached_property
    def mass(self) -> Float[Tensor, " n"]:
        """Pixels that every Gaussian fills, summed over all views."""
        mass = self.splats.means.new_zeros(len(self.splats))
        for view in self.visible.values():
            mass[view.rows.long()] += view.pixels.float()
        return mass

    @cached_property
    def trained_side(self) -> int:
        """Median of the training photos' longer sides in pixels."""
        sides = sorted(max(p.camera.width, p.camera.height) for p in self.photos if p.split == "train")
        return sides[len(sides) // 2] if sides else LARGEST

    @cached_property
    def gap(self) -> float:
        """Distance in world units below which matches are connected: 3 % of the median distance at which the
        scene is seen, about eight pixels of a small view; 0 if no training photo shows anything."""
        distances = []
        for view in self.visible.values():
            pose, means = view.camera.view_matrix.to(self.splats.means), self.splats.means[view.rows]
            if len(means):
                distances.append(float((means @ pose[2, :3] + pose[2, 3]).median()))
        return 0.03 * float(torch.tensor(distances).nanmedian()) if distances else 0.0

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
        camera = self.camera(place, size)
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise UserError(f"{x}, {y} lies outside the view of {camera.width} × {camera.height} pixels")
        pixel = torch.zeros(camera.height, camera.width, device=self.device)
        pixel[int(y), int(x)] = 1.0
        share = self._fill(camera, pixel)
        rows = share.nonzero().squeeze(1)
        features = self.engine.features(rows)
        if not words or float(share[rows] @ (features != 0).any(1).float()) < self.config.min_alpha:
            return []
        queries, negatives = self.text.plain_queries(words).to(self.device), self.text.config.negatives
        cosines = queries.cosines(share[rows] @ features)
        scores = queries.relevancy_of_cosines(cosines, self.engine.temperature).tolist()
        named = sorted(zip(words, scores, strict=True), key=lambda pair: pair[1], reverse=True)
        clear = any(score > CLEAR for word, score in named if word != "sky")
        if not clear and negatives[int(cosines[: len(negatives)].argmax())] in NOTHING:
            return []
        return named[: max(most, 0)]

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
        prompt = taught_prompt(word)
        listed = [examples] if isinstance(examples, Example) else list(examples)
        photos = [self.file.photo(example.photo) for example in listed]
        listed = [replace(e, photo=p.name, size=p.file_size) for e, p in zip(listed, photos, strict=True)]
        pairs = zip(listed, photos, strict=True)
        weights = [Weights.of(example, photo, self.splats, self.backend) for example, photo in pairs]
        if selection is not None:
            selection = torch.as_tensor(selection, device=self.device)
            weights = [Weights(w.seen * selection, torch.zeros_like(w.seen), w.seen) for w in weights]
        queries = self.text.plain_queries([prompt.text]).to(self.device)
        learned = learn(prompt.text, listed, weights, self.engine, queries)
        learned = replace(learned, clip=self.file.clip_identity, scene=Path(self.file.data).name)
        return self.with_words([*self.words.values(), learned])

    def with_words(self, words: Iterable[TaughtWord]) -> Scene:
        """Return this scene with other taught words (the last of equal names), sharing its results."""
        changed = copy.copy(self)
        changed.words = {known_word(word.name): word for word in words}
        return changed

    def carrying(self, word: TaughtWord) -> Scene:
        """Return a scene with a word taught elsewhere. If it was taught in these photos, of which a few may
        be gone, it is learned anew; if not, or if its marks no longer show anything, it is kept as it was
        learned there. Raises UserError if it was learned with another CLIP."""
        sizes = {photo.name: photo.file_size for photo in self.photos}
        marked = [e for e in word.examples if e.photo in sizes and e.size in (None, sizes[e.photo])]
        # Two folders may have one name, with some photos of the same names.
        if word.scene == Path(self.file.data).name and len(marked) > len(word.examples) / 2:
            with suppress(UserError):
                return self.teach(word.name, marked)
        if len(word.vector) != self._semantics()[0].clip_dim or word.clip != self.file.clip_identity:
            raise UserError(f"{word.name!r} was learned with another CLIP than this scene's: teach it anew")
        return self.with_words([*self.words.values(), replace(word, examples=(), precision={})])

    def unsure(self, word: str) -> str:
        """Find the training photo in which a taught word is least certain, the best one to mark next. Raises
        UserError if the word was not taught."""
        taught = self.words.get(known_word(word))
        if taught is None:
            raise UserError(f"{word!r} was not taught: see lang3dxl words")
        self._check_views()
        chance = self._one(taught.name).relevancy[0]
        marked = {self.file.photo(example.photo).name for example in taught.examples}
        views = {name: view for name, view in self.visible.items() if name not in marked} or self.visible
        open_question = chance * (1 - chance)
        unsure = {name: view.pixels @ open_question[view.rows.long()] for name, view in views.items()}
        return max(unsure, key=lambda name: float(unsure[name]))

    # ── prompts ─────────────────────────────────────────────────────────────────────────────────────

    def prompts(self, texts: Text | Sequence[Text]) -> list[Prompt]:
        """Parse prompts, and attach the taught words. Raises UserError if there are no prompts."""
        prompts = list[Prompt]()
        listed: Sequence[Any] = texts if isinstance(texts, list | tuple) else [texts]
        for text in listed:
            if isinstance(text, Tensor | Array):
                text = Prompt("vector", vector=self._vector(text))
            for prompt in [text] if isinstance(text, Prompt) else parse_prompts(text):
                word = None if prompt.vector is not None else self.words.get(known_word(prompt.text))
                prompts.append(prompt if word is None else replace(prompt, taught=word))
        return prompts or parse_prompts("")

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
        if prompt.text not in self._doubt_alone:
            alone = self.text.plain_queries([searched(prompt.text)]).to(self.device)
            self._doubt_alone[prompt.text] = self.doubts.of(self.engine.of_gaussians(alone))[0]
        return synonyms if self._doubt_alone[prompt.text] > DOUBTFUL else []

    def _vector(self, values: Any) -> Float[Tensor, " c"]:
        vector = values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values, np.float32))
        width = self._semantics()[0].clip_dim
        if vector.shape != (width,) or not bool(vector.isfinite().all()) or not bool(vector.any()):
            raise UserError(
                f"a vector to search for has shape {list(vector.shape)}: this scene's CLIP has {width} "
                "finite numbers, not all of them 0"
            )
        return (vector.double() / vector.double().norm()).float()

    def _one(self, text: Text, threshold: float | None = None) -> Question:
        question = self.ask(text, threshold=threshold)
        if len(question.prompts) > 1:
            raise UserError(f"{text!r} are {len(question.prompts)} prompts: ask for one at a time")
        return question

    def _ranked(self, question: Question, row: int) -> list[Viewpoint]:
        """Return all training views, those that show a prompt first, best first."""
        scores, threshold = question.relevancy[row], question.thresholds[row]
        ranks = rank_views(self.visible, self.splats.means, scores, threshold)
        return [replace(view, camera=self.file.photo(view.name).camera) for view in ranks]

    # ── computed once ───────────────────────────────────────────────────────────────────────────────

    def _semantics(self) -> tuple[Decoder, Float[Tensor, "n d"]]:
        if self.decoder is None or self.codes is None:
            raise UserError(NO_SEMANTICS)
        return self.decoder, self.codes

    @cached_property
    def engine(self) -> QueryEngine:
        """The query engine, which decodes the features of all Gaussians at first use."""
        engine = make_engine(*self._semantics(), self.config.temperature)
        return engine.calibrated(self.text.yardstick.to(self.device))

    @cached_property
    def text(self) -> TextEncoder:
        """The encoder of prompts, which loads the scene's CLIP at the first text that it doesn't know."""
        self._semantics()
        return TextEncoder(self._encode, self.config.text, self.vectors)

    def _encode(self, texts: list[str]) -> Float[Tensor, "n c"]:
        if self.encode_texts is None:
            self.encode_texts = text_encoder(self.file, self.device)
        return self.encode_texts(texts)

    @cached_property
    def doubts(self) -> Doubts:
        """Estimator of which prompts the scene does not contain."""
        return Doubts(self.engine.of_gaussians, lambda texts: self.text.plain_queries(texts).to(self.device))


def text_encoder(file: SceneRecord, device: torch.device | str) -> EncodeTexts:
    """Load the CLIP that a scene's features come from. Raises UserError if it is missing or has changed."""
    if file.clip is None:
        raise UserError(NO_SEMANTICS)
    encoder = load_image_text_encoder(file.clip, device)
    if encoder.identity != file.clip_identity:
        raise UserError(
            f"the CLIP in {file.clip} is not the one that this scene was made with: restore it, or train anew"
        )
    return encoder.encode_texts


def _pose(place: Any) -> Float[Tensor, "rows 4"]:
    try:
        return torch.as_tensor(place, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"a place is a photo's name, a camera or a pose, not {place!r:.40}") from error


def _several(texts: Any, found: Sequence[Any]) -> bool:
    """Return whether the answer is a list: for a list of texts, and for a text that holds several prompts."""
    return isinstance(texts, list | tuple) or len(found) > 1
