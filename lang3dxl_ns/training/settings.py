"""Settings of training: the method's schedule, its losses, and the optional parts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Literal, TypeVar

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import model_option
from lang3dxl_ns.components.appearance import AppearanceConfig
from lang3dxl_ns.components.decoders import DecoderConfig
from lang3dxl_ns.components.downsampler import DownsamplerConfig
from lang3dxl_ns.components.feature_decoder import LearningDecoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.training.learning_rates import log_linear, run_length_weight
from lang3dxl_ns.training.scene_settings import PRINTED_LOOKS, SceneSettings, plain_as_printed

Fitted = TypeVar("Fitted", bound="TrainingSettings")
SHORT_FIELD_RUN = 5_000
"""Iterations below which a run that trains the field with the scene uses its `short` preset, since the
published grid has learned no words after 300. `auto` of `codes_from` and of the looks' grid use this too."""
START_OF_CODES = 0.25
"""Fraction of the run after which codes start from photos; the paper's densification is over by then."""


_BOUNDS: dict[str, tuple[float, float]] = {
    **{"max_gaussians": (0, 1e9), "sky_gaussians": (0, 1e7), "num_random": (4, 1e9)},
    **{"sh_degree": (0, 3), "random_scale": (1e-9, 1e9), "cull_alpha_thresh": (0, 0.5)},
    **dict.fromkeys(("densify_from", "densify_until", "densify_every", "semantic_ramp"), (0, 1)),
    **dict.fromkeys(
        ("clip_weight", "dense_weight", "region_weight", "densify_grad_thresh", "warm_up"), (0, 1e6)
    ),
    "ssim_lambda": (0, 1),
}
"""Smallest and largest values of settings."""
_OF_PARTS: dict[str, dict[str, tuple[float, float]]] = {
    "semantic_field": {
        **{"code_std": (0, 1e3), "fourier_frequencies": (0, 32), "levels": (0, 64)},
        **{"features_per_level": (1, 256), "log2_table_size": (3, 30), "min_resolution": (3, 1e6)},
        **{"max_resolution": (3, 1e6), "hidden_width": (1, 1e5)},
    },
    "downsampler": {"hidden": (0, 1e5), "logit_bound": (0.01, 1e4)},
    "appearance": {"vector_dim": (1, 1e4)},
    "decoder.compression": {
        **{"steps": (1, 1e6), "batch": (1, 1e7), "sample": (1, 1e8)},
        **{"code_rate": (0, 100), "field_rate": (0, 100)},
    },
}
"""The same for the settings of components."""


@dataclass
class CameraRefinementConfig:
    """Settings that nothing reads. The config.yml of every run until commit 1b7f663 has them."""

    mode: str = "off"
    trans_l2_penalty: float = 1e-2
    rot_l2_penalty: float = 1e-3


@dataclass
class TrainingSettings(SceneSettings):
    """Settings of Gaussians, their parts, losses and schedules."""

    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    """Feature decoder: the semantic field, or a baseline."""
    semantic_field: SemanticFieldConfig = field(default_factory=SemanticFieldConfig)
    """Settings of the field that decodes a 3-number code to CLIP and dense features."""
    downsampler: DownsamplerConfig = field(default_factory=DownsamplerConfig)
    """Settings of the training-only network that reduces decoded features to the CLIP target's grid."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    """Settings of colors that depend on each photo's lighting."""

    def check(self) -> None:
        """Raise UserError if a setting is out of its range."""
        check_numbers(self, _BOUNDS, model_option(""))
        for part, bounds in _OF_PARTS.items():
            check_numbers(attrgetter(part)(self), bounds, model_option(f"{part.replace('_', '-')}."))
        smallest, largest = self.decode_size or (1, 1)
        if not 1 <= smallest <= largest <= 4096:
            raise UserError(
                f"{model_option('decode-size')} is {smallest} {largest}: give a range in 1 to 4096"
            )

    def fitted(self: Fitted, iterations: int) -> Fitted:
        """Return these settings for a run of this length: every `auto` and None that depends on it has its
        value. Numbers change gradually between short and long runs (`learning_rates.run_length_weight`)."""
        x, short = run_length_weight(iterations), iterations < SHORT_FIELD_RUN
        field_preset, looks_preset = self.semantic_field.preset, self.appearance.preset
        if field_preset == "auto":
            # Compression is a direct regression and does not depend on the run's length.
            field_preset = "short" if short or self.decoder.name == "gathered" else "paper"
            if self.decoder.name == "paper":
                say(
                    f"Semantic field: preset {field_preset} (short in runs of under {SHORT_FIELD_RUN:,} "
                    "iterations, paper, as printed, in longer ones)"
                )
        if looks_preset == "auto":
            looks_preset = "coarse" if short else "paper"
        semantic_field = replace(self.semantic_field, preset=field_preset)
        semantic_field.resolved()  # a combination that is impossible is told before the work
        codes_from = self._codes_from(short)
        start_of_codes = START_OF_CODES if codes_from == "photos" else 0.0
        threshold, weight, sizes = self.densify_grad_thresh, self.dense_weight, self.decode_size
        return replace(
            self,
            total_steps=iterations,
            semantic_field=semantic_field,
            appearance=replace(self.appearance, preset=looks_preset),
            downsampler=self.downsampler.resolved(field_preset),
            codes_from=codes_from,
            warm_up=self.warm_up or start_of_codes,
            densify_grad_thresh=log_linear(x, 2e-3, 2e-4) if threshold is None else threshold,
            dense_weight=log_linear(x, 2.0, 0.5) if weight is None else weight,
            decode_size=(round(56 + 24 * x), round(72 + 48 * x)) if sizes is None else sizes,
        )

    def _codes_from(self, short: bool) -> Literal["noise", "photos"]:
        learns = issubclass(self.decoder.kind, LearningDecoder)
        if self.codes_from == "auto":
            return "photos" if learns and short else "noise"
        if self.codes_from == "photos" and not learns:
            raise UserError(
                f"codes of the decoder {self.decoder.name} can't start from photos: leave "
                f"{model_option('codes-from')} off"
            )
        return self.codes_from


def as_printed(settings: TrainingSettings, targets: PreparationConfig) -> None:
    """Set all to what the paper prints, in place; see `plain_as_printed`."""
    plain_as_printed(settings, targets)
    settings.decoder.name = "paper"
    looks = settings.appearance
    looks.use, looks.preset, looks.opacity_shift = PRINTED_LOOKS, "auto", True


_OF_RENDERINGS = (
    *("clip_weight", "dense_weight", "region_weight", "decode_size", "warm_up", "semantic_ramp"),
    *("codes_from", "feature_gradient_to_geometry", "downsampler", "semantic_field.code_std"),
)
"""Settings that matter only for semantics that are trained with the scene."""


def without_effect(scene: TrainingSettings, targets: PreparationConfig) -> tuple[list[str], list[str]]:
    """List the settings, of the scene and of the targets, that differ from their defaults although they have
    no effect in this run. Call this before `fitted`, which fills them in."""
    if scene.decoder.learns_from_renderings:
        return [], []
    usual, regions = TrainingSettings(), targets.regions not in ("auto", "none")
    changed = [name for name in _OF_RENDERINGS if attrgetter(name)(scene) != attrgetter(name)(usual)]
    return changed, ["regions"] if regions else []
