"""A trained scene that answers questions: type words, see where."""

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

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.report import progress_bar
from lang3dxl_ns.query.cache import (
    SmallView,
    fingerprint,
    load_lookup,
    load_small_views,
    save_lookup,
    save_small_views,
)
from lang3dxl_ns.query.lookup import CodeScorer, Lookup, LookupConfig
from lang3dxl_ns.query.places import Box, strongest_match, world_points
from lang3dxl_ns.query.relevancy import TEMPERATURE, Decode, Queries
from lang3dxl_ns.query.scene_file import SceneFile, posed, resized
from lang3dxl_ns.query.text import Prompt, TextConfig, TextEncoder, parse_prompts
from lang3dxl_ns.rendering import Camera

PROBES = (
    "window",
    "door",
    "tower",
    "dome",
    "column",
    "roof",
    "statue",
    "stairs",
    "wall",
    "tree",
    "sky",
    "people",
)
"""Everyday words, with which a lookup table checks itself."""


@dataclass
class QueryConfig:
    """How a scene answers."""

    text: TextConfig = field(default_factory=TextConfig)
    """Synonyms, their combination, canonical phrases."""
    lookup: LookupConfig = field(default_factory=LookupConfig)
    """The fast path."""
    temperature: float = TEMPERATURE
    """Steepness of the relevancy; no say in what is found."""
    threshold: float = 0.5
    """Relevancy above which a pixel matches."""
    min_alpha: float = 0.3
    """Coverage below which a pixel shows nothing that could match."""
    foreground: str = ""
    """Only what this prompt finds can match, such as `building`; for views that have no mask. The view of a
    photo with a foreground mask is always restricted to it."""
    exact_mb: float = 256.0
    """Memory for decoded features on the exact path."""
    views: int = 100
    """Training views, evenly spread, that the table is made for and that `find` chooses from."""
    view_side: int = 256
    """Pixels of their longer side."""


@dataclass
class View:
    """What a camera sees; several prompts share one."""

    camera: Camera
    image: Float[Tensor, "h w 3"]
    """Colours, 0…1."""
    codes: Float[Tensor, "h w d"]
    alpha: Float[Tensor, "h w"]
    """Coverage, 0…1."""
    depth: Float[Tensor, "h w"]
    """Along the camera's axis, units of the model's frame."""
    seconds: float = 0.0
    """To render it."""
    counts: Bool[Tensor, "h w"] | None = None
    """Foreground of the photo whose view it is; None: all of it."""


@dataclass
class Match:
    """Where a prompt is found in a view."""

    prompt: Prompt
    synonyms: list[str]
    """Words that were searched for beside the prompt."""
    view: View
    relevancy: Float[Tensor, "h w"]
    """0…1; above 0.5 where the prompt fits better than all that it competes with, 0 where nothing is seen."""
    mask: Bool[Tensor, "h w"]
    """Above the threshold."""
    peak: tuple[int, int]
    """Column and row of the most relevant pixel."""
    score: float
    """Relevancy there."""
    seconds: float
    """To answer all prompts of the call, without rendering."""


@dataclass
class Viewpoint:
    """A training camera that shows what was asked for."""

    name: str
    """The photo's."""
    camera: Camera
    area: float
    """Share of the view that matches."""
    score: float
    """Relevancy of the best pixel."""
    rank: float
    """Mean over the view of how far relevancy exceeds the threshold: area times how sure."""


@dataclass
class Found:
    """Where a prompt is found in the scene."""

    prompt: Prompt
    viewpoints: list[Viewpoint]
    """Best first; none where nothing matches."""
    box: Box | None
    """Around the strongest connected match; None where nothing matches."""


class Scene:
    """A trained scene; `lang3dxl_ns.load_scene(config.yml)` makes one.

    Args:
        render: draws a camera.
        decode: codes to CLIP features, `SemanticField.decode_clip`.
        bounded: codes are squashed by a sigmoid before they are decoded.
        gaussians: the model's parameters (means, codes, …), raw.
        file: photos and cameras.
        encode_texts: the CLIP that made the targets, `ImageTextEncoder.encode_texts`.
        state: all tensors that a rendering or a decode depends on; they name the cache.
        cache_dir: where small views and the table are kept; None: nowhere.
        watch: told in a few words what takes long; None: a progress bar shows it.
    """

    def __init__(
        self,
        render: Callable[[Camera], View],
        decode: Decode,
        bounded: bool,
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
        self.render = render
        self.decode = decode
        self.gaussians = gaussians
        self.file = file
        self.text = TextEncoder(encode_texts, self.config.text)
        self.bounded = bounded
        self._state, self._cache_dir = state, cache_dir

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.gaussians["means"].device

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    def camera(self, place: Camera | str | Float[Tensor, "rows 4"]) -> Camera:
        """A camera as it is, that of a photo by name, or one at a pose (camera → world in the model's frame,
        nerfstudio's axes) with the first photo's lens. Raises UserError for an unknown name."""
        if isinstance(place, Camera):
            return place
        if isinstance(place, str):
            return self.file.photo(place).camera
        return posed(place, like=self.file.photos[0].camera)

    def view(self, place: Camera | str | Float[Tensor, "rows 4"]) -> View:
        """What a camera sees; the view of a photo, by name, knows the photo's foreground."""
        view = self.render(self.camera(place))
        if isinstance(place, str):
            counts = self.file.photo(place).foreground()
            view.counts = None if counts is None else counts.to(view.alpha.device)
        return view

    def query(
        self, texts: str | Sequence[str], place: Camera | str | Float[Tensor, "rows 4"], exact: bool = False
    ) -> list[Match]:
        """Where a view shows what is asked for, a match per prompt.

        texts: prompts as `parse_prompts` reads them ("dome; rose window", '"windows" not "arcades"').
        exact: decode every pixel instead of reading the table. Raises UserError for an empty text or an
        unknown photo.
        """
        prompts = self.prompts(texts)  # a mistake in them is told before anything is rendered
        return self.match(prompts, self.view(place), exact)

    def prompts(self, texts: str | Sequence[str | Prompt]) -> list[Prompt]:
        """What is typed, as prompts. Raises UserError where nothing is asked for."""
        typed = [texts] if isinstance(texts, str) else texts
        prompts = [p for text in typed for p in ([text] if isinstance(text, Prompt) else parse_prompts(text))]
        return prompts or parse_prompts("")

    def match(self, prompts: Sequence[Prompt], view: View, exact: bool = False) -> list[Match]:
        """Where a rendered view shows what is asked for."""
        queries = self.queries(prompts)
        scorer = self.scorer(exact)
        start = time.perf_counter()
        keep = view.alpha >= self.config.min_alpha
        keep = self._foreground(scorer, view.codes, keep if view.counts is None else keep & view.counts)
        maps = scorer.relevancy(view.codes, queries, keep)
        peaks = maps.flatten(1).max(dim=1)
        scores, places = peaks.values.tolist(), peaks.indices.tolist()
        seconds = time.perf_counter() - start
        return [
            Match(
                prompt,
                self.text.synonyms(prompt.text),
                view,
                relevancy,
                relevancy > self.config.threshold,
                (place % view.camera.width, place // view.camera.width),
                score,
                seconds,
            )
            for prompt, relevancy, score, place in zip(prompts, maps, scores, places, strict=True)
        ]

    def queries(self, prompts: Sequence[Prompt]) -> Queries:
        """Vectors of prompts on the scene's device."""
        return self.text.queries(prompts).to(self.device)

    def query_gaussians(self, text: str) -> Float[Tensor, " n"]:
        """Relevancy of every Gaussian's own code to one prompt, 0…1.

        For picking Gaussians: a pixel mixes the codes of several, so a map made of these scores differs from
        a query's in a few percent of the pixels.
        """
        prompts = self.prompts(text)
        if len(prompts) > 1:
            raise UserError(f"{text!r} are {len(prompts)} prompts: Gaussians are scored for one at a time")
        return self.scorer().relevancy(self.gaussians["codes"], self.queries(prompts))[0]

    def find(self, text: str | Sequence[str | Prompt], most: int = 10, exact: bool = False) -> list[Found]:
        """Where in the scene each prompt is found: the training views that show it best, and a box."""
        prompts = self.prompts(text)
        queries = self.queries(prompts)
        scorer, maps = self.scorer(exact), []
        for view in self.small_views:
            codes, keep = view.codes.float(), view.seen(self.config.min_alpha) & view.counts
            maps.append(scorer.relevancy(codes, queries, self._foreground(scorer, codes, keep)))
        return [self._found(p, [of_view[i] for of_view in maps], most) for i, p in enumerate(prompts)]

    def _foreground(
        self, scorer: CodeScorer, codes: Float[Tensor, "h w d"], keep: Bool[Tensor, "h w"]
    ) -> Bool[Tensor, "h w"]:
        """Those pixels of `keep` that the foreground's prompt finds, where there is one."""
        if not self.config.foreground:
            return keep
        queries = self.queries(self.prompts(self.config.foreground))
        return keep & (scorer.relevancy(codes, queries, keep).amax(dim=0) > 0.5)

    def _found(self, prompt: Prompt, maps: Sequence[Float[Tensor, "h w"]], most: int) -> Found:
        viewpoints, points, weights = [], [], []
        for view, relevancy in zip(self.small_views, maps, strict=True):
            excess = (relevancy - self.config.threshold).clamp_min(0)
            mask = excess > 0
            if mask.any():
                camera = self.file.photo(view.name).camera
                area, score = float(mask.float().mean()), float(relevancy.max())
                viewpoints.append(Viewpoint(view.name, camera, area, score, float(excess.mean())))
                points.append(world_points(view.camera, view.depth.float(), mask))
                weights.append(excess[mask])
        viewpoints.sort(key=lambda v: v.rank, reverse=True)
        box = strongest_match(torch.cat(points), torch.cat(weights), self._gap) if points else None
        return Found(prompt, viewpoints[:most], box)

    @cached_property
    def _gap(self) -> float:
        """Matches nearer to each other than this are connected: 3 % of the median distance at which the scene
        is seen, about eight pixels of a small view."""
        depths = [v.depth[v.seen(self.config.min_alpha)].float() for v in self.small_views]
        return 0.03 * float(torch.cat(depths).median())

    # ── computed once per checkpoint ────────────────────────────────────────────────────────────────

    def scorer(self, exact: bool = False) -> CodeScorer:
        """Relevancy of codes: through the table, or by decoding each."""
        table = None if exact else self.lookup.table
        return CodeScorer(self.decode, table, self.config.temperature, self.config.exact_mb)

    @cached_property
    def small_views(self) -> list[SmallView]:
        """Training views from small; rendered at the first use of a checkpoint, with a progress bar."""
        path = self._cache_file("views")
        cameras = self._small_cameras
        views = load_small_views(path, self._views_key, cameras, self.device) if path else None
        if views is None:
            views = [self._small_view(name, camera) for name, camera in self._watched(cameras)]
            if path:
                save_small_views(path, views, self._views_key)
        return views

    @cached_property
    def lookup(self) -> Lookup:
        """The table of this checkpoint; built at its first use."""
        path, key = self._cache_file("lookup"), self._lookup_key
        lookup = load_lookup(path, key, self.device) if path else None
        if lookup is None:
            if self._watch:
                self._watch("making the lookup table, once per checkpoint")
            probes = self.text.plain_queries(PROBES).to(self.device)
            lookup = Lookup.build(
                self.decode,
                self.rendered_codes(),
                probes,
                self.bounded,
                self.config.lookup,
                self.config.temperature,
            )
            if path:
                save_lookup(path, lookup, key)
        return lookup

    def rendered_codes(self) -> Float[Tensor, "n d"]:
        """Codes of all pixels of the small views that show something."""
        seen = [view.codes[view.seen(self.config.min_alpha)] for view in self.small_views]
        return torch.cat(seen).float()

    def _watched(self, cameras: Mapping[str, Camera]) -> Iterator[tuple[str, Camera]]:
        what = "looking at the scene, once per checkpoint"
        if self._watch is None:
            with progress_bar() as bar:
                yield from bar.track(cameras.items(), description=what)
            return
        for i, item in enumerate(cameras.items()):
            self._watch(f"{what}: view {i + 1} of {len(cameras)}")
            yield item

    def _small_view(self, name: str, camera: Camera) -> SmallView:
        view, counts = self.render(camera), self.file.photo(name).foreground()
        if counts is None:
            counts = torch.ones_like(view.alpha, dtype=torch.bool)
        small = F.interpolate(counts[None, None].float(), view.alpha.shape, mode="nearest-exact")[0, 0] > 0
        codes, alpha, depth = view.codes.half(), view.alpha.half(), view.depth.half()
        return SmallView(name, camera, codes, alpha, depth, small.to(alpha.device))

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

    @cached_property
    def _lookup_key(self) -> str:
        c = self.config
        settings = [self._views_key, asdict(c.lookup), c.text.canonical, c.temperature, c.min_alpha, PROBES]
        return fingerprint({}, settings)

    def _cache_file(self, name: str) -> Path | None:
        return None if self._cache_dir is None else self._cache_dir / f"lang3dxl_{name}.safetensors"
