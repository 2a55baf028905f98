"""Text queries on a trained scene: relevancy maps, matches, best viewpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import watched
from lang3dxl_ns.query.cache import fingerprint
from lang3dxl_ns.query.doubt import DOUBTFUL, Doubts
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.match import Found, Match, View, Viewpoint
from lang3dxl_ns.query.overview import overview
from lang3dxl_ns.query.places import strongest_match
from lang3dxl_ns.query.query_config import QueryConfig
from lang3dxl_ns.query.rank_views import rank_views
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.run_file import SceneFile, ScenePhoto
from lang3dxl_ns.query.splat_file import GaussianArrays, write_gaussians
from lang3dxl_ns.query.text import Prompt, TextEncoder, parse_prompts
from lang3dxl_ns.query.threshold import match_thresholds, matching
from lang3dxl_ns.query.visibility import VisibleGaussians, load_visible, save_visible
from lang3dxl_ns.scene.camera import Camera, posed, resized, with_longer_side

_LEAST_PIXELS = 1.0
"""Pixels of a small view that a match must fill."""
LARGEST = 1920
"""Longer side of pictures in pixels, where no size is asked for."""
Place = Camera | str | Float[Tensor, "rows 4"] | Float[Array, "rows 4"]
"""A camera, a photo's name, or a pose (camera → world in the model's frame, nerfstudio's axes)."""


class Scene:
    """A trained scene; `lang3dxl_ns.load_scene(run)` makes one.

    Args:
        render: renders a camera, compositing the values that Gaussians carry [n, d], if any.
        fill: from a camera and a weight per pixel to the pixels that every Gaussian fills.
        engine: makes the query engine; called once, at the first query.
        gaussians: the model's raw parameters (means, codes, …).
        file: photos and cameras.
        encode_texts: the CLIP that made the targets, `ImageTextEncoder.encode_texts`.
        state: all tensors that affect a rendering or decoding; they key the cache.
        cache_dir: folder for small views and the table; None: no cache.
        paint: from a camera and a training photo's name (None: the look of the camera's own view) to the
            Gaussians as arrays, with their colors as seen from there.
        watch: called with a short description of slow work; None: a progress bar.
    """

    def __init__(
        self,
        render: Callable[[Camera, Float[Tensor, "n d"] | None], View],
        fill: Callable[[Camera, Float[Tensor, "h w"]], Float[Tensor, " n"]],
        engine: Callable[[], QueryEngine],
        gaussians: Mapping[str, Tensor],
        file: SceneFile,
        encode_texts: Callable[[list[str]], Tensor],
        state: Mapping[str, Tensor],
        paint: Callable[[Camera, str | None], GaussianArrays],
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
        self._state, self._paint, self._cache_dir = state, paint, cache_dir
        self._doubt_alone: dict[str, float] = {}
        """Of texts without their synonyms."""

    def __repr__(self) -> str:
        photos = self.photos
        held_out = sum(photo.split == "eval" for photo in photos)
        return (
            f"Scene({len(self.gaussians['means']):,} Gaussians, {len(photos)} photos ({held_out} held out) "
            f"of {self.file.data}, CLIP {self.file.clip})"
        )

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        return self.gaussians["means"].device

    # ── asking ──────────────────────────────────────────────────────────────────────────────────────

    @property
    def photos(self) -> list[ScenePhoto]:
        """Training photos, then held-out ones: names, cameras, poses."""
        return self.file.photos

    def camera(self, place: Place, size: int | None = None) -> Camera:
        """The given camera, that of a photo by name, or one at a pose (camera → world in the model's frame,
        nerfstudio's axes) with the first photo's lens. size: of the longer side in pixels; by default a
        camera's own, and that of the photo's file, at most 1920. Raises UserError for an unknown name."""
        size = self.config.size if size is None else size
        if isinstance(place, Camera):
            return place if size is None else with_longer_side(place, size)
        photo = self.file.photo(place) if isinstance(place, str) else self.photos[0]
        camera = (
            photo.full_camera if isinstance(place, str) else posed(torch.as_tensor(place), photo.full_camera)
        )
        return resized(camera, LARGEST) if size is None else with_longer_side(camera, size)

    def render(self, place: Place, size: int | None = None) -> View:
        """The scene from a photo's viewpoint by name, a camera or a pose, at a size as for `camera`."""
        view = self._render(self.camera(place, size), None)
        view.name = self.file.photo(place).name if isinstance(place, str) else None
        return view

    def query(
        self,
        texts: str | Sequence[str],
        place: Place | None = None,
        size: int | None = None,
        threshold: float | None = None,
    ) -> list[Match]:
        """Matches in a view, one per prompt.

        Args:
            texts: prompts as `parse_prompts` reads them ("dome; rose window", '"windows" not "arcades"').
            place: a photo's name (matches are restricted to its foreground), a camera or a pose; None: for
                each prompt the training view that shows it best.
            size: of the longer side in pixels, as for `camera`.
            threshold: relevancy above which a pixel matches; default: the settings', or by the scene
                (`match_thresholds`).

        Raises UserError for an empty text or an unknown photo.
        """
        prompts = self.prompts(texts)
        if place is not None:
            return self.match(prompts, place, size, threshold)
        names = self.best_views(prompts)
        return [self.match([p], n, size, threshold)[0] for p, n in zip(prompts, names, strict=True)]

    def best_views(self, prompts: str | Sequence[str | Prompt]) -> list[str]:
        """For each prompt the name of the training photo whose view shows it best, or comes closest."""
        return [(f.viewpoints or f.closest)[0].name for f in self.find(prompts, most=1)]

    def prompts(self, texts: str | Sequence[str | Prompt]) -> list[Prompt]:
        """Parsed prompts. Raises UserError if there are none."""
        typed = [texts] if isinstance(texts, str) else texts
        prompts = [p for text in typed for p in ([text] if isinstance(text, Prompt) else parse_prompts(text))]
        return prompts or parse_prompts("")

    def match(
        self,
        prompts: Sequence[Prompt],
        place: Place,
        size: int | None = None,
        threshold: float | None = None,
    ) -> list[Match]:
        """Matches of parsed prompts in a view; see `query`."""
        confining = self._confining()
        queries = self.queries([*prompts, *confining])
        doubts, thresholds = self._judge([*prompts, *confining], self.engine.of_gaussians(queries))
        thresholds = self._asked(threshold, thresholds, len(prompts))
        start = time.perf_counter()
        carried = self.engine.carried(queries)
        seconds = time.perf_counter() - start
        view = self._render(self.camera(place, size), carried)
        if isinstance(place, str):
            view.name, view.counts = self.file.photo(place).name, self._foreground_of(place, view.camera)
        start = time.perf_counter()
        assert view.carried is not None
        maps = self.engine.maps(view.carried, queries)
        keep = view.alpha >= self.config.min_alpha
        if view.counts is not None:
            keep = keep & view.counts
        if confining:
            maps, within = maps.tensor_split([len(prompts)])
            keep = keep & matching(within, thresholds[len(prompts) :]).any(0)
        maps = maps * keep
        peaks = maps.flatten(1).max(dim=1)
        scores, places = peaks.values.tolist(), peaks.indices.tolist()
        seconds += time.perf_counter() - start
        return [
            Match(
                prompt,
                self.synonyms(prompt),
                doubt,
                view,
                relevancy,
                relevancy > level,
                (place % view.camera.width, place // view.camera.width),
                score,
                seconds,
                level,
            )
            for prompt, doubt, level, relevancy, score, place in zip(
                prompts, doubts, thresholds, maps, scores, places, strict=False
            )
        ]

    def _judge(
        self, prompts: Sequence[Prompt], relevancy: Float[Tensor, "q n"]
    ) -> tuple[list[float], tuple[float, ...]]:
        """Doubt about prompts and the thresholds of their matches, from the relevancy of all Gaussians."""
        doubts = self.doubts.of(relevancy)
        return doubts, match_thresholds(relevancy, doubts, [bool(prompt.negatives) for prompt in prompts])

    def thresholds(self, prompts: Sequence[Prompt]) -> tuple[float, ...]:
        """Relevancy above which places match each prompt by the scene, whatever the settings are."""
        return self._judge(prompts, self.engine.of_gaussians(self.queries(prompts)))[1]

    def _asked(self, asked: float | None, own: tuple[float, ...], prompts: int) -> tuple[float, ...]:
        """Thresholds, those of the first prompts replaced by what is asked for, here or in the settings."""
        asked = self.config.threshold if asked is None else asked
        if asked is None:
            return own
        if not 0 <= asked <= 1:
            raise UserError(f"the threshold is {asked}: give a relevancy from 0 to 1")
        return (asked,) * prompts + own[prompts:]

    def queries(self, prompts: Sequence[Prompt]) -> Queries:
        """Vectors of prompts on the scene's device. A text that the scene doubts has its synonyms beside it:
        where CLIP knows the word itself, they would only blur it."""
        known = {prompt.text for prompt in prompts if not self.synonyms(prompt)}
        return self.text.queries(prompts, known).to(self.device)

    def synonyms(self, prompt: Prompt) -> list[str]:
        """Synonyms searched along with a prompt."""
        synonyms = self.text.synonyms(prompt.text)
        if not synonyms or self.config.text.combine != "fallback":
            return synonyms
        if prompt.text not in self._doubt_alone:
            alone = self.text.plain_queries([prompt.text]).to(self.device)
            self._doubt_alone[prompt.text] = self.doubts.of(self.engine.of_gaussians(alone))[0]
        return synonyms if self._doubt_alone[prompt.text] > DOUBTFUL else []

    def _confining(self) -> list[Prompt]:
        """Prompts that matches must lie on."""
        return self.prompts(self.config.foreground) if self.config.foreground else []

    def query_gaussians(self, text: str | Prompt) -> Float[Tensor, " n"]:
        """Relevancy of every Gaussian to one prompt, 0…1; 0 for Gaussians visible in no photo."""
        return self._of_gaussians([self._one_prompt(text)])[0][0]

    def _one_prompt(self, text: str | Prompt) -> Prompt:
        first, *others = self.prompts([text])
        if others:
            raise UserError(f"{text!r} are {1 + len(others)} prompts: score Gaussians for one at a time")
        return first

    def find(
        self, text: str | Sequence[str | Prompt], most: int = 10, threshold: float | None = None
    ) -> list[Found]:
        """Matches of each prompt in the scene: the training views that show it best, and a box."""
        prompts = self.prompts(text)
        scores, doubts, thresholds = self._of_gaussians(prompts, threshold)
        return [self._found(*one, most) for one in zip(prompts, scores, doubts, thresholds, strict=True)]

    def arrays(self, text: str | None = None, look: str | None = None) -> GaussianArrays:
        """All Gaussians as NumPy arrays, with their relevancy to a prompt if one is given.

        Colors that depend on the view, or on a photo's light, are those towards the overview photo, under the
        look of the training photo `look` (default: of the overview photo).
        """
        camera = overview(self.photos, tuple(self.gaussians["means"].median(0).values.tolist())).camera
        found = self._paint(camera, look)
        if text is None:
            return found
        return replace(found, relevancy=self.query_gaussians(text).cpu().float().numpy())

    def export(
        self,
        path: str | Path,
        text: str | None = None,
        threshold: float | None = None,
        everything: bool = False,
        look: str | None = None,
    ) -> int:
        """Write the Gaussians as a .ply or .spz file for splat viewers; returns how many.

        With a text, only those that match it, or with `everything` all of them; the PLY has their relevancy
        as a property. Colors as in `arrays`. Raises UserError if nothing matches.
        """
        found = self.arrays(text if everything else None, look)
        if text is not None and not everything:
            (scores,), _, (threshold,) = self._of_gaussians([self._one_prompt(text)], threshold)
            relevancy = scores.cpu().float().numpy()
            keep = relevancy > threshold
            if not keep.any():
                raise UserError(
                    f"no Gaussian matches {text!r}: the best reaches {relevancy.max():.2f}; lower "
                    f"--threshold, now {threshold:.2f}, or write all with their relevancy (--all)"
                )
            found = replace(found, relevancy=relevancy)[keep]
        return write_gaussians(Path(path), found)

    def _of_gaussians(
        self, prompts: Sequence[Prompt], threshold: float | None = None
    ) -> tuple[Float[Tensor, "q n"], list[float], tuple[float, ...]]:
        """Relevancy of all Gaussians, 0 outside the foreground; doubts and thresholds."""
        everything = [*prompts, *self._confining()]
        scores = self.engine.of_gaussians(self.queries(everything))
        doubts, thresholds = self._judge(everything, scores)
        thresholds, count = self._asked(threshold, thresholds, len(prompts)), len(prompts)
        scores, within = scores.tensor_split([count])
        if len(within):
            scores = scores * matching(within, thresholds[count:]).any(0)
        return scores, doubts[:count], thresholds[:count]

    def _found(
        self, prompt: Prompt, scores: Float[Tensor, " n"], doubt: float, threshold: float, most: int
    ) -> Found:
        ranks = rank_views(self.visible, self.gaussians["means"], scores, threshold)
        closest = [
            Viewpoint(name, self.file.photo(name).camera, found.area, found.peak, found.rank)
            for name, found in ranks.items()
        ]
        closest.sort(key=lambda v: v.rank, reverse=True)
        viewpoints = [v for v in closest if v.area * self.visible[v.name].size >= _LEAST_PIXELS]
        box = None
        if viewpoints:
            box = strongest_match(self.gaussians["means"], scores, self._mass, threshold, self._gap)
        return Found(prompt, viewpoints[:most], box, doubt, threshold, closest[:most])

    # ── computed once per checkpoint ────────────────────────────────────────────────────────────────

    @cached_property
    def engine(self) -> QueryEngine:
        """The query engine; decodes features of all Gaussians at first use."""
        return self._make_engine().calibrated(self.text.yardstick.to(self.device))

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
            what = "measuring which Gaussians the photos show, once per checkpoint"
            shown = watched(cameras.items(), what, self._watch)
            views = {name: self._visible(name, camera) for name, camera in shown}
            if path:
                save_visible(path, views, self._views_key)
        return views

    def _visible(self, name: str, camera: Camera) -> VisibleGaussians:
        counts = self._foreground_of(name, camera)
        weight = torch.ones(camera.height, camera.width) if counts is None else counts.float()
        return VisibleGaussians.of(camera, self._fill(camera, weight.to(self.device)))

    def _foreground_of(self, name: str, camera: Camera) -> Bool[Tensor, "h w"] | None:
        counts = self.file.photo(name).foreground()
        if counts is None:
            return None
        size = camera.height, camera.width
        return (
            F.interpolate(counts[None, None].float(), size, mode="nearest-exact")[0, 0].bool().to(self.device)
        )

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
