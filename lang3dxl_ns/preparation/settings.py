"""Settings of the preparation: encoders, crops, workers, foreground, regions.

Nothing heavy is imported here, so that a command's help and `lang3dxl doctor` start fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError

ClipFeatures = Literal["auto", "crops", "dense"]
DistanceRule = Literal["median", "mean", "mean-inner"]
AngleRule = Literal["half", "paper", "exact"]
RegionLevel = Literal["small", "medium", "large"]
Quality = Literal["fast", "normal", "fine"]
DENSE_MODEL = "facebook/dinov2-small"
"""For semantics that are trained with the scene."""


_BOUNDS = {
    "longer_side": (16, 1 << 16),
    "scales": (1, 100),
    "dense_tokens": (1, 1024),
    "crop_batch": (1, 1 << 16),
    "workers": (1, 1024),
}


@dataclass
class PreparationConfig:
    """Settings of the targets."""

    longer_side: int = 1600
    """Pixels of a photo's longer side at most: larger photos are shrunk once, before crops are cut and colors
    are trained."""
    quality: Quality = "normal"
    """Number of crops. normal: at most 2,500 of a photo for an encoder of 224 pixels (as many pixels of other
    encoders); fast: at most 700; fine: no bound, some 10,000 in a photo of 1,600 pixels."""
    clip: str = "openai/clip-vit-base-patch32"
    """CLIP, SigLIP or another image-text encoder (docs/encoders.md) in Hugging Face format: a name, a folder,
    or "builtin". Queries need the same one. The paper uses this architecture fine-tuned on landmarks."""
    clip_features: ClipFeatures = "auto"
    """What it reads photos as. crops: one vector for each of thousands of crops. dense: a map of patch
    features in about ten passes. auto: dense if its patches were trained to fit texts (TIPSv2), otherwise
    crops, in training photos with the mean of the patches if it has a head for them, as the built-in one."""
    dense: str = "auto"
    """Vision transformer whose patch tokens sharpen what crops blur: a name, a folder, or "none" to do
    without. auto: facebook/dinov2-small, or the built-in one with the built-in CLIP."""
    scale_range: tuple[float, float] | None = None
    """Sides of the smallest and largest crop, in COLMAP units ("physical") or in photo widths ("relative").
    Default: proposed from the scene."""
    scale_preset: str | None = None
    """Scene whose published range to use instead, such as "holyscenes/milano"."""
    scale_mode: Literal["auto", "physical", "relative"] = "auto"
    """Whether crops have one size in the world or in the photo. In the world, a crop that fits a window does
    so in near and far photos; `auto`: in the world, unless the photos agree in scale anyway."""
    scales: int | None = None
    """Number of crop sizes in the range; 1 is its (geometric) middle. Default: two per doubling, or 7
    if crops have no size in the world."""
    crops: Literal["auto", "pyramid", "fine"] = "auto"
    """What training photos are read at. pyramid: crops of all sizes, half a side apart, averaged (Lang3D-XL's
    targets). fine: the smallest, and 0.7 of them a third of a side apart: three times as many in all. auto:
    fine where features are gathered onto Gaussians, also to start codes (`codes_from`); pyramid where they
    are trained through the downsampler alone, which sharpens. Held-out photos have the pyramid, as the 2-D
    teacher that is scored."""
    pixel_distance: DistanceRule = "median"
    """Distance of a photo's subject: from the camera to the median of its tracked points, to their mean,
    or to the mean of those away from the edges ("mean-inner", the paper's text)."""
    pixel_angle: AngleRule = "half"
    """Width that a pixel shows at that distance: 2 d tan(θ/2) ("half", assumed by the published scale
    ranges), the paper's text ("paper"), or the pinhole's d / f ("exact")."""
    dense_tokens: int = 64
    """Dense tokens per side of a photo, which is squashed to a square. The authors use 128: four times the
    disk and over four times the time. Also the fewest patches along a photo's longer side in dense
    `clip_features`."""
    crop_batch: int = 256
    """Crops encoded at once: more are faster on a GPU, but need more memory."""
    workers: int = 1
    """Processes that encode photos: on one machine, each with its own copy of the encoders and, with several
    GPUs, its own GPU in turn."""
    engine: Literal["local", "ray"] = "local"
    """Where they run: on this machine, or on a Ray cluster that sees the same folders (extra [ray])."""
    address: str | None = None
    """Address of the Ray cluster, such as auto or ray://HOST:10001. Default: starts one on this machine."""
    foreground: str = "auto"
    """Foreground of photos: "auto" (masks/ in the data folder, if there is one), "none" (everything), "text"
    (where a model sees the prompts), or a folder of masks, white = keep, named like the photos."""
    skip_damaged_masks: bool = False
    """Use photos with an unreadable mask whole, instead of exiting with an error."""
    foreground_prompts: tuple[str, ...] = ("building",)
    """With "text": the foreground is everything that any of these prompts names."""
    foreground_model: str = "IDEA-Research/grounding-dino-tiny"
    """Model that finds the prompts: a GroundingDINO, with `sam` for the masks; a CLIPSeg, lighter and coarser
    (CIDAS/clipseg-rd64-refined); or SAM 3, the best (facebook/sam3, gated). A name or a folder."""

    @property
    def makes_dense(self) -> bool:
        """Whether dense features are made."""
        return self.dense not in ("none", "auto")

    regions: str = "auto"
    """Segments inside which features should agree: "auto" (regions/ in the data folder, if there is one),
    "none", "sam", "felzenszwalb" (needs no weights), "text" (instances of `region_prompts`, found by a SAM 3
    as `foreground_model`), or a folder of label maps named like the photos: 16-bit
    PNG, 0 = no region, or .npy, negative = no region."""
    region_prompts: tuple[str, ...] = ("window", "door", "tower", "roof", "column", "statue")
    """With "text": what regions are instances of."""
    region_level: RegionLevel = "small"
    """Which of SAM's masks a pixel gets where they overlap. Small, as in the paper."""
    sam: str = "facebook/sam-vit-base"
    """SAM for regions and for boxes: a name or a folder. The authors use facebook/sam-vit-huge, several times
    as slow; label maps are too small to show much difference."""

    def check(self) -> None:
        """Raises UserError for invalid options, before any work."""
        check_numbers(self, _BOUNDS, "--pipeline.datamanager.")
        option = "--pipeline.datamanager.scale-range"
        if self.scale_range is None:
            return
        smallest, largest = self.scale_range
        if self.scale_preset is not None:
            raise UserError(f"{option} and scale-preset exclude each other: give one of them")
        if not 0 < smallest <= largest < math.inf:
            raise UserError(
                f"{option} {smallest} {largest} is not a range: give the smallest crop first, both above 0"
            )
        if self.scale_mode == "relative" and largest > 1:
            raise UserError(f"{option} {smallest} {largest}: a relative crop is at most 1 photo wide")
