"""Text queries on a trained scene: relevancy maps, matches, best viewpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import progress_bar
from lang3dxl_ns.query.cache import fingerprint
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.places import Box, strongest_match
from lang3dxl_ns.query.relevancy import TEMPERATURE, Queries
from lang3dxl_ns.query.run_file import SceneFile
from lang3dxl_ns.query.text import Prompt, TextConfig, TextEncoder, parse_prompts
from lang3dxl_ns.query.visibility import VisibleGaussians, load_visible, save_visible
from lang3dxl_ns.scene.camera import Camera, posed, resized

_LEAST_PIXELS = 1.0
"""Pixels of a small view that a match must fill."""


@dataclass
class QueryConfig:
    """Settings of queries."""

    text: TextConfig = field(default_factory=TextConfig)
    """Synonyms, their combination, canonical phrases."""
    temperature: float = TEMPERATURE
    """Softmax temperature of the relevancy; changes neither the ranking of Gaussians nor what matches."""
    threshold: float = 0.5
    """Relevancy above which a pixel matches."""
    min_alpha: float = 0.3
    """Coverage below which a pixel can't match."""
    foreground: str = ""
    """Restrict matches to what this prompt finds, such as `building`; for views without a mask. The view of a
    photo with a foreground mask is always restricted to it."""
    views: int = 100
    """Number of training views, evenly spread, that `find` chooses from."""
    view_side: int = 256
    """Pixels of their longer side, for measuring which Gaussians they show."""

    def __post_init__(self) -> None:
        """Raises UserError for invalid options."""
        check_numbers(self, _BOUNDS)


_BOUNDS = {
    "temperature": (1e-3, 1e4),
    "threshold": (0, 1),
    "min_alpha": (0, 1),
    "views": (1, 1e6),
    "view_side": (8, 8192),
}


@dataclass
class View:
    """A rendering, shared by several prompts."""

    camera: Camera
    image: Float[Tensor, "h w 3"]
    """Colors, 0…1."""
    carried: Float[Tensor, "h w d"]
    """Values that Gaussians carried for the prompts, composited over black."""
    alpha: Float[Tensor, "h w"]
    """Coverage, 0…1."""
    depth: Float[Tensor, "h w"]
    """Along the camera's axis, units of the model's frame."""
    seconds: float = 0.0
    """Rendering time."""
    counts: Bool[Tensor, "h w"] | None = None
    """Foreground of the photo at this view; None: everything."""


@dataclass
class Match:
    """Match of a prompt in a view."""

    prompt: Prompt
    synonyms: list[str]
    """Synonyms searched along with the prompt."""
    doubt: float
    """Share of unrelated words that fit the scene as well: above 0.1 the scene hardly shows the prompt, or
    CLIP doesn't know it."""
    view: View
    relevancy: Float[Tensor, "h w"]
    """0…1; above 0.5 where the prompt beats all its competitors, 0 where nothing is rendered."""
    mask: Bool[Tensor, "h w"]
    """Above the threshold."""
    peak: tuple[int, int]
    """Column and row of the most relevant pixel."""
    score: float
    """Relevancy there."""
    seconds: float
    """For all prompts of the call, without rendering."""


@dataclass
class Viewpoint:
    """A training camera that shows a match."""

    name: str
    """Name of the photo."""
    camera: Camera
    area: float
    """Share of the view that matches."""
    score: float
    """Relevancy of the best pixel."""
    rank: float
    """Mean over the view of relevancy above the threshold: area times confidence."""


@dataclass
class Found:
    """Matches of a prompt in the scene."""

    prompt: Prompt
    viewpoints: list[Viewpoint]
    """Best first; empty if nothing matches."""
    box: Box | None
    """Around the strongest connected match; None if nothing matches."""
    doubt: float
    """As in `Match`."""


class Scene:
    """A trained scene; `lang3dxl_ns.load_scene(config.yml)` makes one.

    Args:
        render: renders a camera, compositing the values that Gaussians carry [n, d].
        fill: from a camera and a weight per pixel to the pixels that every Gaussian fills.
        engine: makes the query engine; called once, at the first query.
        gaussians: the model's raw parameters (means, codes, …).
        file: photos and cameras.
        encode_texts: the CLIP that made the targets, `ImageTextEncoder.encode_texts`.
        state: all tensors that affect a rendering or decoding; they key the cache.
        cache_dir: folder for small views and the table; None: no cache.
        watch: called with a short description of slow work; None: a progress bar.
    """

    def __init__(
        self,
        render: Callable[[Camera, Float[Tensor, "n d"]], View],
        fill: Callable[[Camera, Float[Tensor, "h w"]], Float[Tensor, " n"]],
        engine: Callable[[], QueryEngine],
        gaussians: Mapping[str, Tensor],
        file: SceneFile,
        encode_texts: Callable[[list[str]], Tensor],
        state: Mapping[str, Tensor],
        cache_dir: Path | None = None,
        config: QueryConfig | None = None,
        watch: Callable[[str], None] | None = None,
    ) -> None:
        self.config = config or QueryConfig()
        self._watch = watch
        self._render, self._fill, self._make_engine = render, fill, engine
        self.gaussians = gaussians
        self.file = file
        self.text = TextEncoder(encode_texts, self.config.text)
        self._state, self._cache_dir = state, cache_dir
        self._doubt_alone: dict[str, float] = {}
        """Of texts without their synonyms."""

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.gaussians["means"].device

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def camera(self, place: Camera | str | Float[Tensor, "rows 4"]) -> Camera:
        """The given camera, that of a photo by name, or one at a pose (camera → world in the model's frame,
        nerfstudio's axes) with the first photo's lens. Raises UserError for an unknown name."""
        if isinstance(place, Camera):
            return place
        if isinstance(place, str):
            return self.file.photo(place).camera
        return posed(place, like=self.file.photos[0].camera)

    def query(self, texts: str | Sequence[str], place: Camera | str | Float[Tensor, "rows 4"]) -> list[Match]:
        """Matches in a view, one per prompt.

        texts: prompts as `parse_prompts` reads them ("dome; rose window", '"windows" not "arcades"'). The
        view of a photo, by name, is restricted to its foreground. Raises UserError for an empty text or an
        unknown photo.
        """
        return self.match(self.prompts(texts), place)

    def prompts(self, texts: str | Sequence[str | Prompt]) -> list[Prompt]:
        """Parsed prompts. Raises UserError if there are none."""
        typed = [texts] if isinstance(texts, str) else texts
        prompts = [p for text in typed for p in ([text] if isinstance(text, Prompt) else parse_prompts(text))]
        return prompts or parse_prompts("")

    def match(self, prompts: Sequence[Prompt], place: Camera | str | Float[Tensor, "rows 4"]) -> list[Match]:
        """Matches of parsed prompts in a view."""
        queries, within = self._queries(prompts)
        doubts = self.doubts.of(queries)[: len(prompts)]
        start = time.perf_counter()
        carried = self.engine.carried(queries)
        seconds = time.perf_counter() - start
        view = self._render(self.camera(place), carried)
        view.counts = self._foreground_of(place) if isinstance(place, str) else None
        start = time.perf_counter()
        maps = self.engine.maps(view.carried, queries)
        keep = view.alpha >= self.config.min_alpha
        if view.counts is not None:
            keep = keep & view.counts
        if within:
            maps, confining = maps.tensor_split([-within])
            keep = keep & (confining.amax(0) > 0.5)
        maps = maps * keep
        peaks = maps.flatten(1).max(dim=1)
        scores, places = peaks.values.tolist(), peaks.indices.tolist()
        seconds += time.perf_counter() - start
        return [
            Match(
                prompt,
                self._synonyms(prompt),
                doubt,
                view,
                relevancy,
                relevancy > self.config.threshold,
                (place % view.camera.width, place // view.camera.width),
                score,
                seconds,
            )
            for prompt, doubt, relevancy, score, place in zip(
                prompts, doubts, maps, scores, places, strict=True
            )
        ]

    def queries(self, prompts: Sequence[Prompt]) -> Queries:
        """Vectors of prompts on the scene's device. A text that the scene doubts has its synonyms beside it:
        where CLIP knows the word itself, they would only blur it."""
        known = {prompt.text for prompt in prompts if not self._synonyms(prompt)}
        return self.text.queries(prompts, known).to(self.device)

    def _synonyms(self, prompt: Prompt) -> list[str]:
        """Synonyms searched along with a prompt."""
        synonyms = self.text.synonyms(prompt.text)
        if not synonyms or self.config.text.combine != "fallback":
            return synonyms
        if prompt.text not in self._doubt_alone:
            alone = self.text.plain_queries([prompt.text]).to(self.device)
            self._doubt_alone[prompt.text] = self.doubts.of(alone)[0]
        return synonyms if self._doubt_alone[prompt.text] > DOUBTFUL else []

    def _queries(self, prompts: Sequence[Prompt]) -> tuple[Queries, int]:
        """Vectors of the prompts, then of the foreground prompts, and the number of the latter."""
        confining = self.prompts(self.config.foreground) if self.config.foreground else []
        return self.queries([*prompts, *confining]), len(confining)

    def query_gaussians(self, text: str) -> Float[Tensor, " n"]:
        """Relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo."""
        prompts = self.prompts(text)
        if len(prompts) > 1:
            raise UserError(f"{text!r} are {len(prompts)} prompts: score Gaussians for one at a time")
        return self._of_gaussians(prompts)[0]

    def find(self, text: str | Sequence[str | Prompt], most: int = 10) -> list[Found]:
        """Matches of each prompt in the scene: the training views that show it best, and a box."""
        prompts = self.prompts(text)
        scores, doubts = self._of_gaussians(prompts), self.doubts.of(self.queries(prompts))
        return [self._found(*one, most) for one in zip(prompts, scores, doubts, strict=True)]

    def _of_gaussians(self, prompts: Sequence[Prompt]) -> Float[Tensor, "q n"]:
        queries, within = self._queries(prompts)
        scores = self.engine.of_gaussians(queries)
        if within:
            scores, confining = scores.tensor_split([-within])
            scores = scores * (confining.amax(0) > 0.5)
        return scores

    def _found(self, prompt: Prompt, scores: Float[Tensor, " n"], doubt: float, most: int) -> Found:
        excess = (scores - self.config.threshold).clamp_min(0)
        matching = (excess > 0).float()
        viewpoints = []
        for name, view in self.visible.items():
            area = view.share(matching)
            if area * view.camera.width * view.camera.height < _LEAST_PIXELS:
                continue
            camera, score = self.file.photo(name).camera, view.highest(scores, _LEAST_PIXELS / 4)
            viewpoints.append(Viewpoint(name, camera, area, score, view.share(excess)))
        viewpoints.sort(key=lambda v: v.rank, reverse=True)
        weight = excess * self._mass
        rows = (weight > 0).nonzero().squeeze(1)
        box = None
        if viewpoints and len(rows):
            box = strongest_match(self.gaussians["means"][rows], weight[rows], self._gap)
        return Found(prompt, viewpoints[:most], box, doubt)

    # ── computed once per checkpoint ────────────────────────────────────────────────────────────────

    @cached_property
    def engine(self) -> QueryEngine:
        """The query engine; decodes features of all Gaussians at first use."""
        return self._make_engine()

    @cached_property
    def doubts(self) -> Doubts:
        """Tells what the scene doesn't show."""
        return Doubts(self.engine.of_gaussians, lambda texts: self.text.plain_queries(texts).to(self.device))

    @cached_property
    def visible(self) -> dict[str, VisibleGaussians]:
        """Gaussians visible in the training views; computed once per checkpoint, with a progress bar."""
        path, cameras = self._cache_file("visible"), self._small_cameras
        views = load_visible(path, self._views_key, cameras, self.device) if path else None
        if views is None:
            views = {name: self._visible(name, camera) for name, camera in self._watched(cameras)}
            if path:
                save_visible(path, views, self._views_key)
        return views

    def _visible(self, name: str, camera: Camera) -> VisibleGaussians:
        counts = self._foreground_of(name)
        weight = torch.ones(1, 1) if counts is None else counts.float()
        size = camera.height, camera.width
        small = F.interpolate(weight[None, None], size, mode="nearest-exact")[0, 0]
        return VisibleGaussians.of(camera, self._fill(camera, small.to(self.device)))

    def _foreground_of(self, name: str) -> Bool[Tensor, "h w"] | None:
        counts = self.file.photo(name).foreground()
        return None if counts is None else counts.to(self.device)

    @cached_property
    def _mass(self) -> Float[Tensor, " n"]:
        """Pixels that every Gaussian fills, over all views."""
        mass = self.gaussians["means"].new_zeros(len(self.gaussians["means"]))
        for view in self.visible.values():
            mass[view.rows.long()] += view.pixels.float()
        return mass

    @cached_property
    def _gap(self) -> float:
        """Matches closer than this are connected: 3 % of the median distance at which the scene is seen,
        about eight pixels of a small view."""
        means = self.gaussians["means"]
        distances = torch.tensor([view.distance(means) for view in self.visible.values()])
        return 0.03 * float(distances.nanmedian())

    def _watched(self, cameras: Mapping[str, Camera]) -> Iterator[tuple[str, Camera]]:
        what = "measuring which Gaussians the photos show, once per checkpoint"
        if self._watch is None:
            with progress_bar() as bar:
                yield from bar.track(cameras.items(), description=what)
            return
        for i, item in enumerate(cameras.items()):
            self._watch(f"{what}: view {i + 1} of {len(cameras)}")
            yield item

    @cached_property
    def _small_cameras(self) -> dict[str, Camera]:
        photos = [photo for photo in self.file.photos if photo.split == "train"]
        count = min(self.config.views, len(photos))
        chosen = [photos[i * len(photos) // count] for i in range(count)]
        return {photo.name: resized(photo.camera, self.config.view_side) for photo in chosen}

    @cached_property
    def _views_key(self) -> str:
        c = self.config
        return fingerprint(self._state, [asdict(self.file), c.views, c.view_side])

    def _cache_file(self, name: str) -> Path | None:
        return None if self._cache_dir is None else self._cache_dir / f"lang3dxl_{name}.safetensors"
