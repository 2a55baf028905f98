"""The kinds of targets that a photo can have: how each is recorded, counted and made.

A new kind is a class like these, and a line in `targets_of`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.preparation.dense_map import (
    RULE,
    Grid,
    build_dense_map,
    map_grids,
    nested_grids,
    window_starts,
)
from lang3dxl_ns.preparation.encoders import (
    DenseEncoder,
    ImageTextEncoder,
    PatchReading,
    load_dense_encoder,
    load_image_text_encoder,
)
from lang3dxl_ns.preparation.pyramid import THIRD, Crops, build_clip_target
from lang3dxl_ns.preparation.regions import RegionSource, label_size, stored_labels
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.targets import CLIP, DENSE, FINE, REGIONS
from lang3dxl_ns.scene.photo import Photo

_CROP_RULE = 4
"""Increased when crops, their encoding or their average change, so that older entries are made again."""
_PATCHES_PER_CROP = 6
"""Patches encoded at once per crop of a batch. Windows are fewer than crops, since they take more memory."""

Recipe: TypeAlias = dict[str, Any]
"""Everything that determines an entry of the store, which is made again when it changes."""


class Networks:
    """What a worker makes targets with, each loaded when the first target needs it."""

    def __init__(self, config: PreparationConfig, regions: RegionSource | None, device: str) -> None:
        self._config, self.regions, self._device = config, regions, device
        self.crop_batch = config.crop_batch

    @cached_property
    def clip(self) -> ImageTextEncoder:
        """Load the image-text encoder. Raises UserError if it can't be."""
        return load_image_text_encoder(self._config.clip, self._device)

    @cached_property
    def dense(self) -> DenseEncoder:
        """Load the dense encoder. Raises UserError if it can't be."""
        return load_dense_encoder(self._config.dense, self._device, self._config.dense_tokens)

    def load(self, kinds: Collection[str]) -> None:
        """Load what targets of these kinds need, before the first photo."""
        if {CLIP, FINE} & {*kinds}:
            _ = self.clip
        if DENSE in kinds:
            _ = self.dense


@dataclass(frozen=True)
class Target(ABC):
    """One entry of the store for one photo. Targets are sent to other processes, networks are not."""

    kind: str
    recipe: Recipe

    @abstractmethod
    def make(self, image: Float[Tensor, "h w 3"], networks: Networks) -> dict[str, Tensor]:
        """Make the entry's tensors from the photo, RGB in 0..1."""

    @abstractmethod
    def numbers(self, networks: Networks) -> int:
        """Count the numbers that the entry stores."""

    def pictures(self, networks: Networks) -> tuple[int, int]:
        """Count the pictures that the image-text encoder reads for it, and with `--quality fast`."""
        return 0, 0


@dataclass(frozen=True)
class CropGrid(Target):
    """Embeddings of a photo's crops, averaged over their sizes."""

    photo: Photo
    crops: Crops
    fast: Crops

    def make(self, image: Float[Tensor, "h w 3"], networks: Networks) -> dict[str, Tensor]:
        clip, crops, batch = networks.clip, self.crops, networks.crop_batch
        lit, encode = clip.in_known_light(image), clip.encode_images
        return vars(build_clip_target(lit, crops.sides, encode, clip.crop_size, batch, crops.steps))

    def numbers(self, networks: Networks) -> int:
        return math.prod(self.crops.grid(self.photo.height, self.photo.width)) * (networks.clip.dim + 1)

    def pictures(self, networks: Networks) -> tuple[int, int]:
        size = self.photo.height, self.photo.width
        return self.crops.count(*size), self.fast.count(*size)


@dataclass(frozen=True)
class PatchMap(Target):
    """Map of an image-text encoder's patch features, from windows of the photo."""

    grids: tuple[Grid, ...]
    """Patches of the photo in rows and columns, coarse to fine."""

    def make(self, image: Float[Tensor, "h w 3"], networks: Networks) -> dict[str, Tensor]:
        clip = networks.clip
        tokens, patch = clip.crop_size // clip.patch_size, clip.patch_size
        windows = max(_PATCHES_PER_CROP * networks.crop_batch // tokens**2, 1)
        lit, encode = clip.in_known_light(image), clip.encode_patches
        features = build_dense_map(lit, self.grids, encode, tokens, patch, windows, clip.join_sizes)
        return {"features": features, "valid": torch.ones_like(features[..., 0])}

    def numbers(self, networks: Networks) -> int:
        return math.prod(self.grids[-1]) * (networks.clip.dim + 1)

    def pictures(self, networks: Networks) -> tuple[int, int]:
        tokens = networks.clip.crop_size // networks.clip.patch_size
        count = sum(math.prod(len(window_starts(side, tokens)) for side in grid) for grid in self.grids)
        return count, count


class DenseFeatures(Target):
    """Patch features of a vision transformer, from the photo squashed to a square."""

    def make(self, image: Float[Tensor, "h w 3"], networks: Networks) -> dict[str, Tensor]:
        return {"features": networks.dense.encode(image)}

    def numbers(self, networks: Networks) -> int:
        return networks.dense.tokens**2 * networks.dense.dim


@dataclass(frozen=True)
class RegionLabels(Target):
    """Label map of the photo's regions."""

    photo: Photo

    def make(self, image: Float[Tensor, "h w 3"], networks: Networks) -> dict[str, Tensor]:
        assert networks.regions is not None
        return {"labels": stored_labels(networks.regions.labels(self.photo, image))}

    def numbers(self, networks: Networks) -> int:
        return math.prod(label_size(self.photo.height, self.photo.width))


@dataclass(frozen=True)
class Sources:
    """Where a scene's targets come from."""

    clip: str
    """Fingerprint of the image-text encoder."""
    patches: PatchReading | None
    """How the encoder reads photos as maps of patches; None if it reads crops alone."""
    dense: str | None
    """Fingerprint of the dense encoder; None if no photo gets its features."""
    dense_tokens: int
    regions: RegionSource | None
    fine: Collection[str]
    """Names of the photos with small crops alone; if there are any, only these get dense features."""

    def targets_of(self, photo: Photo, content: str, crops: Crops, fast: Crops) -> Iterator[Target]:
        """Yield a photo's targets. `content` is the hash of its file, `crops` are the crops to encode, and
        `fast` those with `--quality fast`."""
        # What determines the photo's pixels; the lens matters only if it is undistorted.
        size, lens = [photo.width, photo.height], photo.lens.undistortion
        source: Recipe = {"photo": content, "size": size, "undistorted": lens}
        if photo.quarter_turns:
            source["turned"] = photo.quarter_turns
        fine, kind = photo.name in self.fine, FINE if photo.name in self.fine else CLIP
        made_with = {**source, "encoder": self.clip}
        if self.patches is not None and (fine or not self.patches.fine_alone):
            yield self._patch_map(kind, made_with, photo, crops)
        else:
            made_with |= {"crop_sides": crops.sides, "rule": _CROP_RULE}
            if fine and crops.steps != THIRD:
                made_with["steps"] = crops.steps
            yield CropGrid(kind, made_with, photo, crops, fast)
        if self.dense is not None and (fine or not self.fine):
            yield DenseFeatures(DENSE, {**source, "encoder": self.dense, "tokens": self.dense_tokens})
        if self.regions is not None and (labels := self.regions.settings(photo)) is not None:
            yield RegionLabels(REGIONS, {**source, **labels}, photo)

    def _patch_map(self, kind: str, made_with: Recipe, photo: Photo, crops: Crops) -> PatchMap:
        """Plan the map of a photo: of patches of one size, or of several that suit its crops."""
        reading = self.patches
        assert reading is not None
        height, width = photo.height, photo.width
        grids: tuple[Grid, ...]
        if reading.sizes is None:
            grids = map_grids(height, width, reading.tokens, self.dense_tokens)
        else:
            grids = nested_grids(height, width, reading.tokens, crops.sides[0], reading.sizes)
        cells = grids if reading.sizes is None else grids[-1:]
        sides = sorted(math.ceil(width / columns) for _, columns in cells)
        recipe = {"crop_sides": sides, "patches": reading.recipe, "grids": grids, "rule": RULE}
        return PatchMap(kind, made_with | recipe, grids)
