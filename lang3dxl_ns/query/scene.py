"""`Scene`: a finished scene that can be rendered and queried."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.appearance import AppearanceField
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.preparation.encoders import load_image_text_encoder
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts
from lang3dxl_ns.query.engine import QueryEngine, make_engine
from lang3dxl_ns.query.learn_word import Weights, learn
from lang3dxl_ns.query.match import Found, Match, Viewpoint
from lang3dxl_ns.query.negatives import CLEAR, NOTHING
from lang3dxl_ns.query.places import strongest_match
from lang3dxl_ns.query.query_config import QueryConfig
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.query.rank_views import rank_views
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.run_file import SceneFile
from lang3dxl_ns.query.splat_file import write_index, write_splats
from lang3dxl_ns.query.teach import Example, TaughtWord, known_word
from lang3dxl_ns.query.text import EncodeTexts, Prompt, TextEncoder, parse_prompts, searched, texts_of
from lang3dxl_ns.query.threshold import match_thresholds
from lang3dxl_ns.query.viewed_scene import Place, ViewedScene
from lang3dxl_ns.query.vocabulary import shipped_vocabulary
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.rendering.render import composite
from lang3dxl_ns.rendering.splats import Splats
from lang3dxl_ns.scene.camera import Camera, resized

_ROWS = 65_536
"""Number of Gaussians decoded at a time."""
NO_SEMANTICS = "this scene has colors alone (it was trained with clip none): it can't be queried"
Text: TypeAlias = str | Prompt | Float[Tensor, " c"] | Float[Array, " c"]
"""A text as `parse_prompts` reads it, or a vector in the space of the scene's CLIP."""


class Scene(ViewedScene):
    """A scene: Gaussians, what they mean, and the photos they were made from.

    The scene never changes. Results that are computed from it once (decoded features, the Gaussians that each
    photo shows) are kept. Any number of threads may use one scene.

    Args:
        splats, looks, background, cache, backend, watch: see `ViewedScene`.
        file: photos, cameras, and the CLIP that the features come from.
        decoder: turns codes into features; None for a scene with colors only.
        codes: semantic values of the Gaussians, a row each; NaN for those visible in no photo.
        config: defaults of queries.
        encode_texts: the scene's CLIP, if it is already loaded; otherwise it is loaded at the first text that
            is not among `vectors`.
        vectors: unit vectors of common words, which need no CLIP.
        words: words taught by example, see `teach`.
    """

    def __init__(
        self,
        splats: Splats,
        file: SceneFile,
        decoder: Decoder | None = None,
        codes: Float[Tensor, "n d"] | None = None,
        *,
        looks: AppearanceField | None = None,
        background: Float[Tensor, "3"] | None = None,
        config: QueryConfig | None = None,
        encode_texts: EncodeTexts | None = None,
        vectors: Mapping[str, Float[Tensor, " c"]] | None = None,
        cache: Path | None = None,
        backend: Backend = "auto",
        watch: Callable[[str], None] | None = None,
        words: Iterable[TaughtWord] = (),
    ) -> None:
        super().__init__(splats, file, looks, background, config, cache, backend, watch)
        self.words: Mapping[str, TaughtWord] = {known_word(word.name): word for word in words}
        """Taught words, by their names in lower case."""
        self.decoder, self.codes = decoder, codes
        self._encode_texts, self._vectors = encode_texts, vectors
        self._doubt_alone: dict[str, float] = {}
        """Doubt about texts without their synonyms, by text."""

    def __repr__(self) -> str:
        held_out = sum(photo.split == "eval" for photo in self.photos)
        words = f"CLIP {self.file.clip}" if self.decoder is not None else "colors alone"
        return (
            f"Scene({len(self.splats):,} Gaussians, {len(self.photos)} photos ({held_out} held out) "
            f"of {self.file.data}, {words})"
        )

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
            UserError: there is no prompt, the threshold is impossible, or the scene has colors only.
        """
        requested = self.config.threshold if threshold is None else threshold
        if requested is not None and not 0 <= requested <= 1:
            raise UserError(f"the threshold is {requested}: give a relevancy from 0 to 1")
        rivals = texts_of(negatives, "a negative")
        prompts = [replace(p, negatives=(*p.negatives, *rivals)) for p in self.prompts(texts)]
        within = self.config.foreground if foreground is None else foreground
        everything = [*prompts, *(self.prompts(within) if within else ())]
        queries, count = self.queries(everything), len(prompts)
        relevancy = self.engine.of_gaussians(queries)
        doubts = [
            doubt if prompt.taught is None else prompt.taught.doubt
            for prompt, doubt in zip(everything, self.doubts.of(relevancy), strict=True)
        ]
        strict = [bool(prompt.negatives or prompt.taught) for prompt in everything]
        levels = match_thresholds(relevancy, doubts, strict)
        return Question(
            self.engine,
            tuple(prompts),
            queries,
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

        Relevancies are composited with at most as many pixels as the training photos have. If the view has
        more, they are rendered in a separate pass and enlarged: nothing was learned between these pixels, and
        Gaussians too thin for them would stand out as lines.
        """
        start = time.perf_counter()
        channels = question.channels
        seconds = time.perf_counter() - start
        camera, name = self.camera(place, size), self._name(place)
        small = resized(camera, self.trained_side)
        enlarged = small.width < camera.width
        view = self._view(camera, name, channels=None if enlarged else channels)
        start = time.perf_counter()
        rendering = view.rendering
        if enlarged:
            rendering = replace(rendering, channels=composite(self.splats, small, channels, self.backend))
        foreground = None if name is None else self.file.photo(name).foreground()
        maps, masks = question.maps(rendering, foreground)
        found = maps.cpu().float().numpy(), masks.cpu().numpy()
        seconds += time.perf_counter() - start
        rows = zip(question.prompts, question.doubts, *found, question.thresholds, strict=True)
        return [
            Match(prompt, self.synonyms(prompt), doubt, view, relevancy, mask, level, seconds)
            for prompt, doubt, relevancy, mask, level in rows
        ]

    @torch.no_grad()
    def relevancy_maps(self, camera: Camera, queries: Queries) -> Float[Tensor, "q h w"]:
        """Compute the relevancy of every pixel to every query, 0…1, as it is scored, without a foreground."""
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
        """Find matches in the scene: return a `Found` for one prompt, a list of them for several.

        Args:
            texts, negatives, threshold: see `ask`.
            most: number of views to return at most, at least 1.

        Raises:
            UserError: see `ask`; or `most` is below 1.
        """
        if most < 1:
            raise UserError(f"{most} views are requested: give 1 or more")
        found = self.places(self.ask(texts, negatives=negatives, threshold=threshold), most)
        return found if _several(texts, found) else found[0]

    def places(self, question: Question, most: int = 10) -> list[Found]:
        """Find matches of a question's prompts in the scene; see `find`."""
        return [self._found(question, i, most) for i in range(len(question.prompts))]

    def best_views(self, question: Question) -> list[str]:
        """Return for each prompt the name of the training photo whose view shows it best, or comes closest.

        Raises:
            UserError: the scene has no training photos.
        """
        if not self.visible:
            raise UserError("this scene has no training photos to choose from: name a photo or a camera")
        return [self._views(question, row)[1][0].name for row in range(len(question.prompts))]

    def relevancy(self, text: Text) -> Float[Array, " n"]:
        """Compute the relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo.

        Raises:
            UserError: see `ask`; or the text holds several prompts.
        """
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
        """Write the Gaussians as a .ply or .spz file for splat viewers, in the scene's order.

        Args:
            path: the file.
            text: prompt; only the Gaussians that match it are written. None: all Gaussians are written.
            threshold: see `ask`.
            everything: with a text, write all Gaussians; a PLY has their relevancy as a property.
            look: training photo whose lighting is baked into the colors; default: the overview photo.
            index: with a text, a .npy or .txt file for the numbers of the matching Gaussians: their
                positions, from 0, in the scene, and so in the splat that it was attached to.

        Returns:
            The number of Gaussians written.

        Raises:
            UserError: nothing matches, or see `ask` and `write_splats`.
        """
        splats = self.baked(look)
        if text is None:
            return write_splats(Path(path), splats)
        question = self._one(text, threshold)
        relevancy, keep = question.relevancy[0], question.gaussians[0]
        if not everything:
            _expect_match(question)
            splats, relevancy = splats.select(keep), relevancy[keep]
        if index is not None:
            write_index(Path(index), keep)
        return write_splats(Path(path), splats, relevancy)

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
        """Find the words that match a pixel best; return them with their relevancy, best first.

        The result is empty where the scene's Gaussians hardly cover the pixel or have no meaning, and at the
        sky: where the sky or a generic phrase matches best, and no word is clearly better.

        Args:
            place, size: the view, see `camera`.
            x, y: column and row in pixels of that view.
            words: the words to choose from; default: the shipped vocabulary of buildings.
            most: number of words to return at most.

        Raises:
            UserError: the pixel lies outside the view.
        """
        words = shipped_vocabulary() if words is None else texts_of(words, "a word")
        feature = self._feature_at(self.camera(place, size), x, y)
        if feature is None:
            return []
        queries, negatives = self.text.plain_queries(words).to(self.device), self.text.config.negatives
        cosines = queries.cosines(feature)
        scores = queries.relevancy_of_cosines(cosines, self.engine.temperature).tolist()
        named = sorted(zip(words, scores, strict=True), key=lambda pair: pair[1], reverse=True)
        clear = any(score > CLEAR for word, score in named if word != "sky")
        if not clear and negatives[int(cosines[: len(negatives)].argmax())] in NOTHING:
            return []
        return named[: max(most, 0)]

    def _feature_at(self, camera: Camera, x: float, y: float) -> Float[Tensor, " c"] | None:
        """Blend the features that a pixel shows, unnormalized; None where too little of it has a meaning."""
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise UserError(f"{x}, {y} lies outside the view of {camera.width} × {camera.height} pixels")
        pixel = torch.zeros(camera.height, camera.width, device=self.device)
        pixel[int(y), int(x)] = 1.0
        share = self._fill(camera, pixel)
        rows = share.nonzero().squeeze(1)
        features = self.engine.features(rows)
        meant = float(share[rows] @ (features != 0).any(1).float())
        return None if meant < self.config.min_alpha else share[rows] @ features

    # ── words taught by example ─────────────────────────────────────────────────────────────────────

    def teach(
        self,
        word: str,
        examples: Example | Sequence[Example],
        selection: Bool[Tensor, " n"] | None = None,
    ) -> Scene:
        """Return a scene that also knows a word from examples, as `scene.words[word]`; this one is unchanged.

        `query`, `find`, `relevancy` and `export` of the new scene use what it learned wherever the word is a
        prompt. Examples that the word had before are replaced.

        Args:
            word: the word, in any case.
            examples: marks in photos of the scene.
            selection: the Gaussians that are the word, if known; default: those that the marks show.

        Raises:
            UserError: the marks show nothing or everything, or lie outside their photos.
        """
        (prompt,) = parse_prompts(f'"{word}"')
        listed = [examples] if isinstance(examples, Example) else list(examples)
        photos = [self.file.photo(example.photo) for example in listed]
        weights = [
            Weights.of(example, photo, self.splats, self.backend)
            for example, photo in zip(listed, photos, strict=True)
        ]
        if selection is not None:
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
        """Return a scene with a word taught elsewhere. If it was taught in these photos, it is learned anew;
        if not, or if its marks no longer show anything, it is kept as it was learned there.

        Raises:
            UserError: the word was learned with another CLIP.
        """
        if word.examples and word.scene == Path(self.file.data).name:
            with suppress(UserError):
                return self.teach(word.name, word.examples)
        if word.clip != self.file.clip_identity:
            raise UserError(f"{word.name!r} was learned with another CLIP than this scene's: teach it anew")
        return self.with_words([*self.words.values(), replace(word, examples=(), precision={})])

    def unsure(self, word: str) -> str:
        """Find the training photo in which a taught word is least certain, the best one to mark next.

        Raises:
            UserError: the word was not taught.
        """
        taught = self.words.get(known_word(word))
        if taught is None:
            raise UserError(f"{word!r} was not taught: see lang3dxl words")
        chance = self._one(taught.name).relevancy[0]
        marked = {self.file.photo(example.photo).name for example in taught.examples}
        views = {name: view for name, view in self.visible.items() if name not in marked} or self.visible
        open_question = chance * (1 - chance)
        unsure = {name: view.pixels @ open_question[view.rows.long()] for name, view in views.items()}
        return max(unsure, key=lambda name: float(unsure[name]))

    def _with_taught(self, prompt: Prompt) -> Prompt:
        taught = self.words.get(known_word(prompt.text))
        return prompt if taught is None or prompt.vector is not None else replace(prompt, taught=taught)

    # ── prompts ─────────────────────────────────────────────────────────────────────────────────────

    def prompts(self, texts: Text | Sequence[Text]) -> list[Prompt]:
        """Parse prompts, and attach the taught words. Raises UserError if there are no prompts."""
        prompts: list[Prompt] = []
        for text in _listed(texts):
            if isinstance(text, Prompt):
                prompts.append(self._with_taught(text))
            elif isinstance(text, Tensor | Array):
                prompts.append(Prompt("vector", vector=self._vector(text)))
            else:
                prompts += map(self._with_taught, parse_prompts(text))
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
        return vector.float()

    def _one(self, text: Text, threshold: float | None = None) -> Question:
        question = self.ask(text, threshold=threshold)
        if len(question.prompts) > 1:
            raise UserError(f"{text!r} are {len(question.prompts)} prompts: ask for one at a time")
        return question

    def _views(self, question: Question, row: int) -> tuple[list[Viewpoint], list[Viewpoint]]:
        """Return the training views that show a prompt, and all training views, both best first."""
        ranks = rank_views(self.visible, self.splats.means, question.relevancy[row], question.thresholds[row])
        everything = [
            Viewpoint(name, self.file.photo(name).camera, found.area, found.peak, found.rank)
            for name, found in ranks.items()
        ]
        return [view for view in everything if ranks[view.name].shown], everything

    def _found(self, question: Question, row: int, most: int) -> Found:
        scores, threshold = question.relevancy[row], question.thresholds[row]
        views, closest = self._views(question, row)
        box = strongest_match(self.splats.means, scores, self.mass, threshold, self.gap) if views else None
        relevancy, matching = scores.cpu().float().numpy(), question.gaussians[row].cpu().numpy()
        prompt, doubt = question.prompts[row], question.doubts[row]
        return Found(prompt, views[:most], box, relevancy, matching, doubt, threshold, closest[:most])

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
        return TextEncoder(self._encode, self.config.text, self._vectors)

    def _encode(self, texts: list[str]) -> Float[Tensor, "n c"]:
        if self._encode_texts is None:
            self._encode_texts = text_encoder(self.file, self.device)
        return self._encode_texts(texts)

    @cached_property
    def doubts(self) -> Doubts:
        """Estimator of which prompts the scene does not contain."""
        return Doubts(self.engine.of_gaussians, lambda texts: self.text.plain_queries(texts).to(self.device))


def text_encoder(file: SceneFile, device: torch.device | str) -> EncodeTexts:
    """Load the CLIP that a scene's features come from. Raises UserError if it is missing or has changed."""
    if file.clip is None:
        raise UserError(NO_SEMANTICS)
    encoder = load_image_text_encoder(file.clip, device)
    if encoder.identity != file.clip_identity:
        raise UserError(
            f"the CLIP in {file.clip} is not the one that this scene was made with: restore it, or train anew"
        )
    return encoder.encode_texts


def _expect_match(question: Question) -> None:
    """Raise UserError if no Gaussian matches the first prompt."""
    if not question.gaussians[0].any():
        best, level = float(question.relevancy[0].max()), question.thresholds[0]
        raise UserError(
            f"no Gaussian matches {question.prompts[0].text!r}: the best reaches {best:.2f}; lower "
            f"--threshold, now {level:.2f}, or write all with their relevancy (--all)"
        )


def _listed(texts: Any) -> list[Any]:
    return list(texts) if isinstance(texts, list | tuple) else [texts]


def _several(texts: Any, found: Sequence[Any]) -> bool:
    """Return whether the answer is a list: for a list of texts, and for a text that holds several prompts."""
    return isinstance(texts, list | tuple) or len(found) > 1
