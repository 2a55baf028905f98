"""Ground truth in the layout of the HolyScenes benchmark, and the scores of a photo against it.

A folder per category with `NNNN-gt.jpg` (object black on white, JPEG) for the photo `NNNN.<suffix>`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.average_precision import average_precision

_SUFFIX = "-gt"


class GroundTruth:
    """Masks of a scene's categories, by photo.

    Raises UserError for a folder that is missing or holds no mask.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._paths: dict[str, dict[str, Path]] = {}
        for path in sorted(self.folder.glob(f"*/*{_SUFFIX}.*")):
            stem = path.stem.removesuffix(_SUFFIX)
            self._paths.setdefault(path.parent.name, {})[stem] = path
        if not self._paths:
            raise UserError(
                f"{self.folder} holds no ground truth: a folder per category is expected, with a mask "
                f"NNNN{_SUFFIX}.jpg (object black on white) for each photo NNNN.jpg"
            )

    @property
    def categories(self) -> list[str]:
        """Names of the categories, which are the prompts."""
        return list(self._paths)

    def photos(self, category: str) -> list[str]:
        """Stems of the photos that have a mask of the category."""
        return list(self._paths[category])

    def unknown(self, photos: Iterable[str]) -> list[str]:
        """Masks that belong to none of the scene's photos, as category/stem."""
        known = {PurePosixPath(photo).stem for photo in photos}
        return [f"{c}/{stem}" for c, paths in self._paths.items() for stem in paths if stem not in known]

    def masks(self, photo: str, size: tuple[int, int]) -> dict[str, Bool[Array, "h w"]]:
        """The photo's masks, {category: True on the object}, at `size` (height, width).

        Resized as grey values, then split at half, so that noise of JPEG has no say. A category without a
        mask of this photo is left out: it wasn't annotated. Raises UserError for an unreadable mask.
        """
        stem = PurePosixPath(photo).stem
        return {c: _read(paths[stem], size) for c, paths in self._paths.items() if stem in paths}


def _read(path: Path, size: tuple[int, int]) -> Bool[Array, "h w"]:
    try:
        with Image.open(path) as image:
            grey = image.convert("L").resize(size[::-1], Image.Resampling.BILINEAR)
    except (OSError, SyntaxError, ValueError) as error:
        raise UserError(f"ground truth {path} can't be read ({error}): replace or remove it") from error
    return np.asarray(grey) < 128


def scoring_size(height: int, width: int) -> tuple[int, int]:
    """Size at which maps are scored: half the photo's, as in Lang3D-XL."""
    return max(height // 2, 1), max(width // 2, 1)


def resize_map(image: Float[Tensor, "n H W"], size: tuple[int, int]) -> Float[Tensor, "n h w"]:
    """Maps or feature channels at another size (height, width), bilinear."""
    if tuple(image.shape[-2:]) == size:
        return image
    return F.interpolate(image[None].float(), size, mode="bilinear", align_corners=False)[0]


def score_maps(
    maps: Mapping[str, Float[Tensor, "h w"]], truth: Mapping[str, Bool[Array, "h w"]], prefix: str = ""
) -> dict[str, float]:
    """AP of each category's map, {`{prefix}ap_{category}`: …}; categories without a positive are left out."""
    scores = {}
    for category, mask in truth.items():
        value = average_precision(maps[category].detach().cpu().numpy(), mask)
        if value is not None:
            scores[f"{prefix}ap_{category}"] = value
    return scores


def mean_average_precision(means: Mapping[str, float], prefix: str = "") -> float | None:
    """Unweighted mean of the categories' APs in `means`, each a mean over photos; None without any."""
    found = [value for name, value in means.items() if name.startswith(f"{prefix}ap_")]
    return float(torch.tensor(found, dtype=torch.float64).mean()) if found else None
