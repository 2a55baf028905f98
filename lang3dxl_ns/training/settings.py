"""Settings of training: the method's schedule, its losses, and the optional parts.

Nothing heavy is imported here but torch, so that a command's help starts fast.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import attrgetter
from typing import Literal

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import model_option
from lang3dxl_ns.components.appearance import AppearanceConfig
from lang3dxl_ns.components.decoders import DecoderConfig
from lang3dxl_ns.components.downsampler import DownsamplerConfig
from lang3dxl_ns.components.semantic_field import SemanticFieldConfig
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.training.learning_rates import EXTENT, log_linear, run_length_weight

PRINTED_PHOTO_SCALE = 0.5
"""Size of the paper's training photos, relative to the photos."""
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
    """Settings of the refinement of cameras."""

    mode: Literal["off", "SO3xR3"] = "off"
    """SO3xR3: every training camera learns a rotation and a translation."""
    trans_l2_penalty: float = 1e-2
    """Weight of the mean length of the translations, world units."""
    rot_l2_penalty: float = 1e-3
    """Weight of the mean angle of the rotations, radians."""


@dataclass
class SceneSettings:
    """Settings of Gaussians, losses and schedules: numbers and choices."""

    clip_weight: float = 1.0
    """Weight of the CLIP loss, a mean absolute difference."""
    dense_weight: float | None = None
    """Weight of the dense (DINO) loss. None: 2 in short runs, falling to 0.5 in long ones."""
    region_weight: float = 5e-4
    """Weight of the loss on feature variance inside regions, if the scene has regions."""
    decode_size: tuple[int, int] | None = None
    """Range of the longer side in pixels, inclusive, at which the code map is decoded; five sizes in it are
    used. None: 56 to 72 in short runs, growing to 80 to 120 (the paper's) in long ones."""
    semantic_ramp: float = 0.5
    """Fraction of the run over which the weight of the CLIP and dense losses rises from 0.1 to 1."""
    warm_up: float = 0.0
    """Fraction of the run that trains only colors, before the semantic losses start."""
    codes_from: Literal["auto", "noise", "photos"] = "noise"
    """Start of codes and field when the warm-up is over. `noise`: random, as published. `photos`: the photos'
    features, gathered onto the Gaussians; a warm-up of 0 then becomes a quarter of the run. `auto`: `photos`
    in runs of under 5,000 iterations."""
    feature_gradient_to_geometry: bool = False
    """Let the semantic losses also move Gaussians, as in the authors' code; opacities still follow the colors
    alone."""
    view_dependence: Literal["auto", "on", "off"] = "auto"
    """Let colors depend on the viewing direction (spherical harmonics of `sh_degree`). `off` leaves one color
    and a quarter of the numbers per Gaussian. `auto` decides by measuring the scene."""
    camera_optimization: Literal["auto", "on", "off"] = "auto"
    """Refine the cameras during training. `auto`: if the COLMAP model's reprojection error is large."""
    rasterizer: Literal["auto", "gsplat", "torch"] = "auto"
    """Rasterizer on a GPU. `auto`: gsplat, which is built at its first use (docs/gpu.md), or, if the build
    fails, torch, which is many times slower."""
    max_gaussians: int | None = None
    """Most Gaussians that densification makes; above it, the least opaque are removed. None: what the GPU's
    (or the machine's) memory holds. 0: no limit."""
    sky_gaussians: int = 2_000
    """Number of Gaussians on a sphere around the scene for the sky and the far distance, where a COLMAP model
    has no points. 0: none. If photos share one lighting, their colors are one smooth function."""
    total_steps: int = 30_000
    """Iterations of the run, to which the fractions refer. The trainer sets it."""
    densify_from: float = 1 / 15
    """Fraction of the run at which densification starts (the paper: 2,000 of 30,000)."""
    densify_until: float = 0.5
    """Fraction of the run at which densification ends."""
    densify_every: float = 1 / 15
    """Fraction of the run between two densification steps (the paper: every 2,000)."""
    background_color: Literal["random", "black", "white"] = "black"
    """Color behind the scene. Black, as in the paper: where nothing is rendered, the code is zero too."""
    ssim_lambda: float = 0.5
    """Weight of 1 − SSIM relative to L1 in the color loss."""
    sh_degree: int = 3
    """Largest degree of the spherical harmonics of colors."""
    sh_degree_interval: int = 1_000
    """Iterations after which the degree in use rises by one, or a tenth of the run if that is less."""
    random_init: bool = False
    """Start from random Gaussians instead of the scene's 3D points."""
    num_random: int = 50_000
    """Number of random Gaussians."""
    random_scale: float = 10.0
    """Side of the cube that random Gaussians fill, world units."""
    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    """antialiased: Gaussians smaller than a pixel are dimmed by what the screen-space blur adds to them."""
    cull_alpha_thresh: float = 0.005
    """Opacity below which Gaussians are pruned."""
    densify_size_thresh: float = 0.01
    """Standard deviation, world units, up to which Gaussians are duplicated; larger ones are split."""
    densify_grad_thresh: float | None = None
    """Screen-space gradient (image = [−1, 1]) above which Gaussians are split or duplicated. None: 2e-3 in
    short runs, which densify while gradients are still large, falling to 2e-4 (the paper's) in long ones."""


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
    camera_optimizer: CameraRefinementConfig = field(default_factory=CameraRefinementConfig)
    """How cameras are refined."""

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

    def fit_to_run(self, iterations: int) -> None:
        """Resolve settings that depend on the length of the run. Numbers change gradually between short and
        long runs (`optimizers.run_length_weight`)."""
        x = run_length_weight(iterations)
        self.total_steps = iterations
        if self.semantic_field.preset == "auto":
            # Compression is a direct regression and does not depend on the run's length.
            compressed = self.decoder.name == "gathered"
            preset = "short" if compressed or iterations < SHORT_FIELD_RUN else "paper"
            self.semantic_field.preset = preset  # type: ignore[assignment]
            if self.decoder.name == "paper":
                say(
                    f"Semantic field: preset {preset} (short in runs of under {SHORT_FIELD_RUN:,} "
                    "iterations, paper, as printed, in longer ones)"
                )
        if self.codes_from == "auto":
            self.codes_from = "photos" if iterations < SHORT_FIELD_RUN else "noise"
        if self.codes_from == "photos" and not self.warm_up:
            self.warm_up = START_OF_CODES
        if self.appearance.preset == "auto":
            self.appearance.preset = "coarse" if iterations < SHORT_FIELD_RUN else "paper"
        self.semantic_field.resolved()  # a combination that is impossible is told before the work
        self.downsampler = self.downsampler.resolved(self.semantic_field.preset)
        if self.densify_grad_thresh is None:
            self.densify_grad_thresh = log_linear(x, 2e-3, 2e-4)
        if self.dense_weight is None:
            self.dense_weight = log_linear(x, 2.0, 0.5)
        if self.decode_size is None:
            self.decode_size = (round(56 + 24 * x), round(72 + 48 * x))

    @property
    def learns_from_renderings(self) -> bool:
        """Whether semantics are trained with the scene instead of being gathered afterwards."""
        return self.decoder.learns_from_renderings


def as_printed(settings: TrainingSettings, targets: PreparationConfig) -> None:
    """Set what the paper prints or, where it is silent, what its authors released, in place;
    docs/deviations.md lists where. Its schedule of 70,000 iterations is scaled to the length of the run."""
    x = 1 / 70_000
    settings.decoder.name, settings.codes_from = "paper", "auto"
    settings.dense_weight = 0.5
    settings.feature_gradient_to_geometry, settings.semantic_ramp = True, 15_000 * x
    settings.densify_from, settings.densify_until, settings.densify_every = 2_000 * x, 15_000 * x, 2_000 * x
    settings.densify_size_thresh = 0.2 * EXTENT
    settings.view_dependence, settings.camera_optimization = "on", "off"
    settings.appearance.use, settings.appearance.preset, settings.appearance.opacity_shift = (
        "on",
        "auto",
        True,
    )
    targets.scale_mode, targets.pixel_distance = "physical", "mean-inner"
    targets.regions, targets.sam = "sam", "facebook/sam-vit-huge"
