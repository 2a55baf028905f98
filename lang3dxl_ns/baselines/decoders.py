"""Choice of a run's feature decoder: the semantic field or a baseline."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.baselines.fmgs import PlaceField
from lang3dxl_ns.baselines.langsplat import LangSplat
from lang3dxl_ns.baselines.lifting import DirectFeatures, Feature3DGS, LiftedFeatures
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.components.compression import CompressedField, CompressionConfig, JointField
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig

DecoderName = Literal["gathered", "paper", "feature3dgs", "fmgs", "langsplat", "direct", "lifting"]

NAMES: tuple[str, ...] = get_args(DecoderName)


@showing("name")
@dataclass
class DecoderConfig:
    """Settings of the model's feature decoder.

    Targets, losses and schedules are the same for all decoders, so that a comparison isolates the decoder."""

    name: DecoderName = "gathered"
    """How features are stored on Gaussians and decoded. gathered: targets are averaged onto the Gaussians
    after training and compressed to three numbers each, which the semantic field decodes Gaussian by
    Gaussian. paper: Lang3D-XL as published, with codes trained with the scene and decoded pixel by pixel.
    feature3dgs: codes of half the CLIP width and one linear layer after rendering. fmgs: a hash grid over
    positions, decoded before rendering; whole features are rendered. langsplat: a per-scene autoencoder's
    three numbers. direct: the whole feature on every Gaussian. lifting: targets averaged onto the Gaussians
    and rendered uncompressed."""

    compression: CompressionConfig = field(default_factory=CompressionConfig)
    """gathered: how gathered features are compressed to codes."""

    @property
    def learns_from_renderings(self) -> bool:
        """Whether codes are trained with the scene, with all semantic losses."""
        return self.name not in ("gathered", "lifting")

    alignment_weight: float = 0.01
    """fmgs: weight of the loss that aligns CLIP with dense features (published: 0.01 to 0.03)."""
    autoencoder_steps: int = 2_000
    """langsplat: iterations of the autoencoder before the run, of 1,024 features each."""


def make_decoder(
    config: DecoderConfig,
    settings: SemanticFieldConfig,
    clip_dim: int,
    dense_dim: int,
    center: Float[Tensor, "3"],
    radius: float,
) -> Decoder:
    """Build the feature decoder that `config` names. `settings` applies to decoders with a hash grid;
    `center` and `radius` are the scene's, in world units."""
    if config.name == "feature3dgs":
        decoder: Decoder = Feature3DGS(clip_dim, dense_dim)
    elif config.name == "fmgs":
        decoder = PlaceField(settings, clip_dim, dense_dim, center, radius, config.alignment_weight)
    elif config.name == "langsplat":
        decoder = LangSplat(clip_dim, config.autoencoder_steps)
    elif config.name == "direct":
        decoder = DirectFeatures(clip_dim, dense_dim)
    elif config.name == "lifting":
        decoder = LiftedFeatures(clip_dim, dense_dim)
    elif config.name == "paper":
        decoder = JointField(settings, clip_dim, config.compression, dense_dim)
    elif config.name == "gathered":
        decoder = CompressedField(settings, clip_dim, config.compression)
    else:
        raise UserError(f"there is no feature decoder {config.name!r}: choose one of {', '.join(NAMES)}")
    decoder.name = config.name
    return decoder
