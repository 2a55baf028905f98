"""Region label maps: segments of a photo with similar features, from networks, colors, or a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import content_digest, read_array
from lang3dxl_ns.common.image import fitted_size, resize, resize_nearest
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.common.pictures import NoPictureError, open_picture
from lang3dxl_ns.preparation.model_files import ModelFiles
from lang3dxl_ns.preparation.segmentation import (
    TEXT_OPTION,
    AutomaticSam,
    Sam3,
    find_sam,
    find_text_segmenter,
    is_sam3,
)
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.companions import companion, named_folder
from lang3dxl_ns.scene.photo import Photo

LONGER_SIDE = 256
"""Longer side of a stored label map in pixels, over twice the size at which training decodes."""
LABEL_SUFFIXES = (".png", ".npy")

_SAM_SIDE = 1024
"""Longer side of SAM's input in pixels."""
_FELZENSZWALB = {"scale": 100.0, "sigma": 0.8, "min_size": 20}
"""Parameters that give about 250 regions per photo, half of them over 60 pixels."""
_RULE = 1
"""Version of the label maps, increased when they are made in another way, to make older ones again."""


FindMasks = Callable[[UInt8[Tensor, "h w 3"]], Sequence[Bool[Tensor, "h w"]]]
"""Function from a picture to masks of it, on the CPU."""


class RegionSource(Protocol):
    """Source of a scene's label maps."""

    def settings(self, photo: Photo) -> dict[str, Any] | None:
        """Return everything besides the photo that determines its labels; None for one without regions."""

    def labels(self, photo: Photo, image: Float[Tensor, "h w 3"]) -> Int[Tensor, "hl wl"]:
        """Label `image`, the photo as read by `photo.read()`, at any size; negative for no region."""


def region_source(config: PreparationConfig, data: Path, follow_links: bool = False) -> RegionSource | None:
    """Create the source that `config.regions` names; None for "none", or "auto" without a folder regions/. A
    folder is relative to `data`, and with `follow_links` its maps may be links out of it. Raises UserError if
    it does not exist, or a network can't be found or downloaded, or is no SAM 3 where prompts name the
    regions."""
    choice = config.regions
    if choice == "none" or (choice == "auto" and not (data / "regions").is_dir()):
        return None
    if choice == "felzenszwalb":
        return FelzenszwalbRegions()
    if choice == "sam":
        files = find_sam(config.sam)
        return MaskRegions(partial(_masks_of_sam, files), regions="sam", model=files.identity)
    if choice == "text":
        found = find_text_segmenter(config.foreground_model, config.sam)
        prompts = sorted(config.region_prompts)
        if not is_sam3(found):
            raise UserError(
                f"regions text needs a SAM 3, which {found.words.name} is not: "
                f"{data_option(TEXT_OPTION)} facebook/sam3"
            )
        load = partial(_masks_of_instances, found.words, prompts)
        return MaskRegions(load, regions="text", prompts=prompts, model=found.identity)
    folder = data / "regions" if choice == "auto" else named_folder(choice, data, "regions")
    return FolderRegions(folder, follow_links)


class FelzenszwalbRegions:
    """Regions of similar color (Felzenszwalb and Huttenlocher 2004), fast and without weights."""

    def settings(self, photo: Photo) -> dict[str, Any]:
        """Return the algorithm's parameters."""
        return {"regions": "felzenszwalb", **_FELZENSZWALB, "rule": _RULE}

    def labels(self, photo: Photo, image: Float[Tensor, "h w 3"]) -> Int[Tensor, "hl wl"]:
        """Label the regions of similar color in `image`, shrunk to the size of a stored label map."""
        from skimage.segmentation import felzenszwalb

        return torch.from_numpy(felzenszwalb(_shrunk(image, LONGER_SIDE).numpy(), **_FELZENSZWALB))


class MaskRegions:
    """Regions from a network's masks, which may overlap: a pixel of several gets the smallest. `load` loads
    the network onto the first photo's device and returns its masks' function; `made_with` are the settings of
    the masks, the network's identity among them. Processes get a source before its network is loaded."""

    def __init__(self, load: Callable[[torch.device], FindMasks], **made_with: Any) -> None:
        self._load = load
        self._masks: FindMasks | None = None
        self._made_with = {**made_with, "level": "small", "rule": _RULE}

    def settings(self, photo: Photo) -> dict[str, Any]:
        """Return the network's identity and the settings of its masks."""
        return self._made_with

    def labels(self, photo: Photo, image: Float[Tensor, "h w 3"]) -> Int[Tensor, "hl wl"]:
        """Label `image` by the network's masks, at the size of a stored label map."""
        small = (_shrunk(image, _SAM_SIDE) * 255).round().to(torch.uint8)
        size = label_size(*small.shape[:2])
        if self._masks is None:
            self._masks = self._load(image.device)
        masks = [resize_nearest(mask, size) for mask in self._masks(small)]
        return label_map(torch.stack(masks)) if masks else torch.full(size, -1)


def _masks_of_sam(files: ModelFiles, device: torch.device) -> FindMasks:
    return AutomaticSam(files, device).masks


def _masks_of_instances(files: ModelFiles, prompts: Sequence[str], device: torch.device) -> FindMasks:
    sam = Sam3(files, device)
    return lambda image: [mask for masks, _ in sam.instances(image, prompts) for mask in masks]


class FolderRegions:
    """Regions from the user's label maps, drawn on the photos' files at any size and named like them."""

    def __init__(self, folder: Path, follow_links: bool = False) -> None:
        self._find = partial(companion, folder, suffixes=LABEL_SUFFIXES, follow_links=follow_links)

    def settings(self, photo: Photo) -> dict[str, Any] | None:
        """Return a hash of the photo's label map; None for a photo without one."""
        if (path := self._find(photo.name)) is None:
            return None
        return {"regions": "folder", "file": content_digest(path), "rule": _RULE}

    def labels(self, photo: Photo, image: Float[Tensor, "h w 3"]) -> Int[Tensor, "hl wl"]:
        """Read and undistort the photo's label map. Raises UserError for a file that is not a label map."""
        path = self._find(photo.name)
        assert path is not None, "settings() found it"
        return photo.undistort_labels(_numbered(_read_labels(path, photo.name)))


def label_map(masks: Bool[Tensor, "n h w"]) -> Int[Tensor, "h w"]:
    """Choose one label per pixel from overlapping masks: the smallest mask that contains it, as in the paper;
    −1 outside all masks."""
    masks = masks[masks.sum(dim=(1, 2)).argsort(stable=True)]
    return torch.where(masks.any(dim=0), masks.to(torch.uint8).argmax(dim=0), -1)


def stored_labels(labels: Int[Tensor, "hl wl"]) -> Int[Tensor, "h w"]:
    """Convert a label map for storage: `label_size` (nearest), numbered from 0, −1 for none, on the CPU."""
    small = _numbered(resize_nearest(labels, label_size(*labels.shape)).cpu())
    return small.to(torch.int16 if small.max() < 2**15 else torch.int32)


def label_size(height: int, width: int) -> tuple[int, int]:
    """Compute the rows and columns of a stored label map, at most 256 on the longer side."""
    return fitted_size((height, width), LONGER_SIDE)


def _read_labels(path: Path, name: str) -> Int[Tensor, "hl wl"]:
    """Read a file's labels: integers, negative for no region (0 in a picture, which has no sign)."""
    damage = (OSError, NoPictureError, ValueError)
    with readable(f"regions of {name}: can't read {path}", "make it again, or remove it", damage):
        if path.suffix == ".npy":
            labels, first = read_array(path), 0
        else:
            with open_picture(path) as picture:
                labels, first = np.asarray(picture), 1
    if labels.ndim != 2 or not labels.size or labels.dtype.kind not in "iu":
        raise UserError(
            f"regions of {name}: {path} holds {labels.dtype} numbers of shape {labels.shape}, not one whole "
            "number per pixel: save a gray 16-bit PNG, or a .npy of integers [height, width]"
        )
    return torch.from_numpy(labels.astype(np.int64)) - first


def _numbered(labels: Int[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Renumber regions without gaps from 0; −1 for none."""
    regions, numbers = labels.clamp(min=-1).unique(return_inverse=True)
    return numbers - int(regions[0] < 0)


def _shrunk(image: Float[Tensor, "h w 3"], longer_side: int) -> Float[Tensor, "hs ws 3"]:
    """Average an image down to at most `longer_side` pixels, and return it on the CPU."""
    return resize(image, fitted_size(image.shape, longer_side)).contiguous().clamp(0, 1).cpu()
