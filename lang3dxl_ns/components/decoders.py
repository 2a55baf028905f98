"""Choice of a run's feature decoder by name."""

from __future__ import annotations

from dataclasses import dataclass, field

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.components.compression import CompressedField, JointField
from lang3dxl_ns.components.feature_decoder import Decoder
from lang3dxl_ns.components.field_settings import CompressionConfig, SemanticFieldConfig

DECODERS: dict[str, type[Decoder]] = {"gathered": CompressedField, "paper": JointField}
"""Classes of feature decoders by name. Another one is added by the module that defines it."""


@showing("name")
@dataclass
class DecoderConfig:
    """Settings of the model's feature decoder.

    Targets, losses and schedules are the same for all decoders, so that a comparison isolates the decoder."""

    name: str = "gathered"
    """How features are stored on Gaussians and decoded. gathered: targets are averaged onto the Gaussians
    after training and compressed to three numbers each, which the semantic field decodes Gaussian by
    Gaussian. paper: Lang3D-XL as published, with codes trained with the scene and decoded pixel by pixel.
    """

    compression: CompressionConfig = field(default_factory=CompressionConfig)
    """gathered: how gathered features are compressed to codes."""

    @property
    def kind(self) -> type[Decoder]:
        """The decoder's class. Raises UserError if there is none of that name."""
        if self.name not in DECODERS:
            raise UserError(f"unknown feature decoder {self.name!r}: choose one of {', '.join(DECODERS)}")
        return DECODERS[self.name]

    @property
    def learns_from_renderings(self) -> bool:
        """Whether codes are trained with the scene, with all semantic losses."""
        return not self.kind.needs_lifting


def make_decoder(
    config: DecoderConfig, settings: SemanticFieldConfig, clip_dim: int, dense_dim: int
) -> Decoder:
    """Build the feature decoder that `config` names; `settings` applies to decoders with a hash grid."""
    decoder = config.kind.build(settings, clip_dim, config.compression, dense_dim)
    decoder.name = config.name
    return decoder
