"""Which encoder a run has: the semantic field, or one of the systems that it is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.baselines.direct import DirectFeatures
from lang3dxl_ns.baselines.feature3dgs import Feature3DGS
from lang3dxl_ns.baselines.fmgs import PlaceField
from lang3dxl_ns.baselines.langsplat import LangSplat
from lang3dxl_ns.baselines.lifting import LiftedFeatures
from lang3dxl_ns.components.encoder import SemanticEncoder
from lang3dxl_ns.components.semantic_field import SemanticField, SemanticFieldConfig

EncoderName = Literal["lang3dxl", "feature3dgs", "fmgs", "langsplat", "direct", "lifting"]


@dataclass
class EncoderConfig:
    """What carries the semantics. Targets, losses and schedules are the same for all, so that a comparison
    shows the encoder alone."""

    name: EncoderName = "lang3dxl"
    """lang3dxl: the semantic field. feature3dgs: codes of half the CLIP width and one linear layer after
    rendering. fmgs: a hash grid over places, decoded before rendering, whole features rendered. langsplat: a
    per-scene autoencoder's three numbers. direct: the whole feature on every Gaussian. lifting: no learning;
    every Gaussian gets the mean of the target features of the pixels it contributes to."""
    alignment_weight: float = 0.01
    """fmgs: weight of the pixel alignment of CLIP to dense features (0.01 to 0.03 are published)."""
    autoencoder_steps: int = 2_000
    """langsplat: iterations of 1,024 features each, before the run."""


def make_encoder(
    config: EncoderConfig,
    field: SemanticFieldConfig,
    clip_dim: int,
    dense_dim: int,
    centre: Float[Tensor, "3"],
    radius: float,
) -> SemanticEncoder:
    """The encoder of this name; `field` are the settings of those that have a hash grid.

    centre, radius: of the scene, world units.
    """
    if config.name == "feature3dgs":
        return Feature3DGS(clip_dim, dense_dim)
    if config.name == "fmgs":
        return PlaceField(field, clip_dim, dense_dim, centre, radius, config.alignment_weight)
    if config.name == "langsplat":
        return LangSplat(clip_dim, config.autoencoder_steps)
    if config.name == "direct":
        return DirectFeatures(clip_dim, dense_dim)
    if config.name == "lifting":
        return LiftedFeatures(clip_dim, dense_dim)
    return SemanticField(field, clip_dim, dense_dim)
