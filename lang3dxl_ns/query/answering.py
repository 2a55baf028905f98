"""What answers need of a scene: the part of `Scene` that modules below it may use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeAlias

import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.query.doubt import Doubts
from lang3dxl_ns.query.engine import QueryEngine
from lang3dxl_ns.query.match import View
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.text import Prompt, TextEncoder
from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.rendering import Rendering, Splats
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord
from lang3dxl_ns.words.taught_words import TaughtWord

Place: TypeAlias = Camera | str | Float[Tensor, "rows 4"] | Float[Array, "rows 4"]
"""A camera, a photo's name, or a pose (camera → world in the model's frame, nerfstudio's axes)."""


class Answering(Protocol):
    """A scene that can be asked. `Scene` describes its members."""

    splats: Splats
    file: SceneRecord
    words: Mapping[str, TaughtWord]
    config: QueryConfig

    @property
    def device(self) -> torch.device: ...
    @property
    def photos(self) -> list[ScenePhoto]: ...
    @property
    def overview(self) -> ScenePhoto: ...
    @property
    def visible(self) -> Mapping[str, VisibleGaussians]: ...
    @property
    def mass(self) -> Float[Tensor, " n"]: ...
    @property
    def gap(self) -> float: ...
    @property
    def engine(self) -> QueryEngine: ...
    @property
    def text(self) -> TextEncoder: ...
    @property
    def doubts(self) -> Doubts: ...
    @property
    def foreignness(self) -> float | None: ...
    @property
    def anchors(self) -> Bool[Tensor, "anchors n"]: ...
    def semantics(self) -> tuple[Decoder, Float[Tensor, "n d"]]: ...
    def baked(self, look: str | None = None) -> Splats: ...
    def camera(self, place: Place, size: int | None = None) -> Camera: ...
    def draw(self, camera: Camera, channels: Float[Tensor, "n d"] | None) -> Rendering: ...
    def view(self, place: Place, camera: Camera, *, channels: Float[Tensor, "n d"] | None) -> View: ...
    def queries(self, prompts: Sequence[Prompt]) -> Queries: ...
    def synonyms(self, prompt: Prompt) -> list[str]: ...
