"""Plain settings of training: numbers and choices. Nothing heavy is imported, so that helps start fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lang3dxl_ns.preparation.settings import PreparationConfig

Method = Literal["lang3dxl", "lang3dxl-paper"]
EXTENT = 1.1
"""The published extent, 1.1 times the largest distance of a camera from the cameras' center, which is scaled
to about 1."""
PRINTED_PHOTO_SCALE = 0.5
"""Size of the paper's training photos, relative to the photos."""
PRINTED_LOOKS: Literal["on"] = "on"
"""Whether the paper models the lighting of each photo."""


@dataclass(kw_only=True)
class RunSettings:
    """Settings of a run without nerfstudio: numbers and choices."""

    seed: int = 42
    """Seed of all that is random."""
    save_every: int = 2_000
    """Iterations between two checkpoints, at most a quarter of the run."""
    mixed_precision: bool = False
    """Compute networks in bfloat16, on a GPU that multiplies it."""


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


def plain_as_printed(scene: SceneSettings, targets: PreparationConfig) -> None:
    """Set the plain settings to what the paper prints or, where it is silent, what its authors released, in
    place; docs/deviations.md lists where. Its schedule of 70,000 iterations is scaled to the run's length."""
    x = 1 / 70_000
    scene.codes_from, scene.dense_weight = "auto", 0.5
    scene.feature_gradient_to_geometry, scene.semantic_ramp = True, 15_000 * x
    scene.densify_from, scene.densify_until, scene.densify_every = 2_000 * x, 15_000 * x, 2_000 * x
    scene.densify_size_thresh = 0.2 * EXTENT
    scene.view_dependence, scene.camera_optimization = "on", "off"
    targets.scale_mode, targets.pixel_distance = "physical", "mean-inner"
    targets.regions, targets.sam = "sam", "facebook/sam-vit-huge"
