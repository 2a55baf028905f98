"""Settings of the preparation: encoders, crops, workers, foreground, regions.

Nothing heavy is imported here, so that a command's help and `lang3dxl doctor` start fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import data_option

ClipFeatures = Literal["auto", "crops", "dense"]
DistanceRule = Literal["median", "mean", "mean-inner"]
AngleRule = Literal["half", "paper", "exact"]
Quality = Literal["fast", "normal", "fine"]
DENSE_MODEL = "facebook/dinov2-small"
"""Dense encoder for semantics that are trained with the scene."""


_BOUNDS = {
    "longer_side": (16, 1 << 16),
    "scales": (1, 100),
    "dense_tokens": (1, 1024),
    "crop_batch": (1, 1 << 16),
    "workers": (1, 1024),
}


@dataclass
class PreparationConfig:
    """Settings of the preparation of targets."""

    longer_side: int = 1600
    """Maximum longer side of photos in pixels. Larger photos are shrunk once, before crops are cut and colors
    are trained."""
    quality: Quality = "normal"
    """Number of crops. normal: at most 2,500 per photo for an encoder of 224 pixels (as many pixels for other
    encoders). fast: at most 700. fine: no bound, about 10,000 in a photo of 1,600 pixels."""
    clip: str = "auto"
    """CLIP, SigLIP or another image-text encoder in Hugging Face format (docs/encoders.md): a name, a folder,
    or builtin. auto: openai/clip-vit-base-patch32 if it and its dense encoder were downloaded before,
    otherwise the built-in one. The paper uses the former, fine-tuned on landmarks."""
    clip_features: ClipFeatures = "auto"
    """How the image-text encoder reads photos. crops: one vector for each of thousands of crops. dense: a map
    of patch features in about ten passes. auto: dense if its patches were trained to match texts (TIPSv2),
    otherwise crops; training photos are read as maps if the encoder has a head for patches, as the built-in
    one does."""
    dense: str = "auto"
    """Vision transformer whose patch tokens sharpen what crops blur; the paper's method learns them. A name,
    a folder, or "none" to do without. auto: facebook/dinov2-small, or the built-in one with the built-in
    CLIP; none where a head for patches reads the photos, since nothing is blurred then."""
    scale_range: tuple[float, float] | None = None
    """Sides of the smallest and largest crop, in COLMAP units ("physical") or in photo widths ("relative").
    Default: proposed from the scene."""
    scale_preset: str | None = None
    """Scene whose published crop range is used instead of `scale_range`, such as "holyscenes/milano"."""
    scale_mode: Literal["auto", "physical", "relative"] = "auto"
    """Whether crops have one size in the world (physical) or in the photo (relative). A physical size that
    matches a window does so in near and far photos. auto: physical, unless the scene has no 3D points or its
    photos agree in scale anyway."""
    scales: int | None = None
    """Number of crop sizes in the range; 1 is its (geometric) middle. Default: two per doubling, or 7
    if crops have no size in the world."""
    crops: Literal["auto", "pyramid", "fine"] = "auto"
    """Crop scales at which CLIP encodes the training photos. pyramid: all sizes, half a side apart, averaged
    (Lang3D-XL's targets). fine: the smallest size and 0.7 of it, a third of a side apart, which makes three
    times as many crops in all. auto: fine where features are gathered onto Gaussians, also to start codes
    (`codes_from`); pyramid where they are trained through the downsampler alone, which sharpens. Held-out
    photos have the pyramid, which is scored as the 2-D teacher."""
    pixel_distance: DistanceRule = "median"
    """Distance of a photo's subject: from the camera to the median of its tracked points, to their mean,
    or to the mean of those away from the edges ("mean-inner", the paper's text)."""
    pixel_angle: AngleRule = "half"
    """Width that a pixel shows at the distance d of a photo's subject: 2 d tan(θ/2) ("half", assumed by the
    published scale ranges), the paper's text ("paper"), or the pinhole's d / f ("exact")."""
    dense_tokens: int = 64
    """Dense tokens per side of a photo, which is squashed to a square. The authors use 128, which takes four
    times the disk and over four times the time. This is also the minimum number of patches along a photo's
    longer side with dense `clip_features`."""
    crop_batch: int = 256
    """Number of crops encoded at once. More are faster on a GPU, but need more memory."""
    workers: int = 1
    """Number of processes that encode photos. On one machine, each has its own copy of the encoders and, if
    there are several GPUs, its own GPU in turn."""
    engine: Literal["local", "ray"] = "local"
    """Where workers run: on this machine, or on a Ray cluster that sees the same folders (extra [ray])."""
    address: str | None = None
    """Address of the Ray cluster, such as auto or ray://HOST:10001. By default one is started here."""
    foreground: str = "auto"
    """Foreground of photos: "auto" (masks/ in the data folder, if there is one), "none" (everything), "text"
    (where a model sees the prompts), or a folder of masks named like the photos, in which white is kept."""
    skip_damaged_masks: bool = False
    """Use photos with an unreadable mask whole, instead of exiting with an error."""
    foreground_prompts: tuple[str, ...] = ("building",)
    """Prompts for foreground "text": the foreground is everything that any of them names."""
    foreground_model: str = "IDEA-Research/grounding-dino-tiny"
    """Model that finds the prompts, by name or folder: a GroundingDINO, with `sam` for the masks; a CLIPSeg,
    lighter and coarser (CIDAS/clipseg-rd64-refined); or SAM 3, the best (facebook/sam3, gated)."""
    regions: str = "auto"
    """Segments inside which features should agree: "auto" (regions/ in the data folder, if there is one),
    "none", "sam", "felzenszwalb" (needs no weights), "text" (instances of `region_prompts`, found by a SAM 3
    as `foreground_model`), or a folder of label maps named like the photos (16-bit PNG, where 0 is no region,
    or .npy, where negative is no region)."""
    region_prompts: tuple[str, ...] = ("window", "door", "tower", "roof", "column", "statue")
    """Prompts for regions "text": each instance of any of them is a region."""
    sam: str = "facebook/sam-vit-base"
    """SAM for regions and for boxes: a name or a folder. The authors use facebook/sam-vit-huge, which is
    several times as slow; label maps are too small to show much difference."""
    cache_dir: Path | None = None
    """Folder of prepared targets (default: lang3dxl_cache inside the data folder)."""

    @property
    def makes_dense(self) -> bool:
        """Whether the configuration names a dense encoder; False while it is "auto"."""
        return self.dense not in ("none", "auto")

    def check(self) -> None:
        """Raise UserError for invalid options, before any work."""
        check_numbers(self, _BOUNDS, data_option(""))
        option = data_option("scale-range")
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
