"""Reading the prepared targets of a scene, and their channel statistics."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.encoders import CLIP_OPTION, ImageTextEncoder
from lang3dxl_ns.preparation.store import FeatureStore

CLIP, FINE, DENSE, REGIONS = "clip", "clip_fine", "dense", "regions"

_STD_FLOOR = 0.01


@dataclass
class StoredClipTarget:
    """CLIP target of a photo, memory-mapped (CPU, float16)."""

    features: Float[Tensor, "hd wd c"]
    """Mean embedding over the scales, not normalized."""
    valid: Float[Tensor, "hd wd"]
    """Mean share of the crops' area inside the photo, 0…1."""
    crop_fractions: list[float]
    """Crop sides as fractions of the photo's width, ascending."""


@dataclass
class ChannelStatistics:
    """Mean and standard deviation per channel; deviations are at least 1 % of their average."""

    mean: Float[Tensor, " c"]
    std: Float[Tensor, " c"]


@dataclass
class FeatureStatistics:
    """Statistics of the CLIP and the dense targets, for whitening the field's output."""

    clip: ChannelStatistics
    dense: ChannelStatistics | None


class TargetReader:
    """Reader of the prepared targets of a scene's photos, by photo name; they are loaded on access."""

    def __init__(
        self,
        store: FeatureStore,
        names: Sequence[str],
        with_dense: Collection[str] = (),
        with_regions: Collection[str] = (),
        fine: Collection[str] = (),
    ) -> None:
        self.names, self._fine = list(names), frozenset(fine)
        self._store = store
        self._with_dense, self._with_regions = frozenset(with_dense), frozenset(with_regions)
        self.clip_dim: int = store.shapes(self._clip_kind(self.names[0]), self.names[0])["features"][-1]
        first = next((name for name in self.names if name in self._with_dense), None)
        self.dense_dim: int = 0 if first is None else store.shapes(DENSE, first)["features"][-1]

    def _clip_kind(self, name: str) -> str:
        return FINE if name in self._fine else CLIP

    def clip(self, name: str) -> StoredClipTarget:
        """Read a photo's CLIP target. Raises UserError if it isn't prepared."""
        settings = self._store.settings(self._clip_kind(name), name)
        width = settings["size"][0]
        return StoredClipTarget(
            **self._store.read(self._clip_kind(name), name),
            crop_fractions=[side / width for side in settings["crop_sides"]],
        )

    def clip_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "hd wd c"]]:
        """Yield the CLIP targets of photos, one at a time, float16."""
        return (self.clip(name).features for name in names)

    def dense(self, name: str) -> Float[Tensor, "t t d"] | None:
        """Read the dense features of the photo squashed to a square, float16; None for a photo without."""
        return self._store.read(DENSE, name)["features"] if name in self._with_dense else None

    def dense_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "t t d"]]:
        """Yield the dense features of those photos that have some, one at a time, float16."""
        return (self._store.read(DENSE, name)["features"] for name in names if name in self._with_dense)

    def regions(self, name: str) -> Int[Tensor, "h w"] | None:
        """Read the photo's region labels, −1 for none; None (no file is read) for one without regions."""
        return self._store.read(REGIONS, name)["labels"] if name in self._with_regions else None

    def check(self, encoder: ImageTextEncoder) -> None:
        """Raise UserError if a photo's target is missing or was made by another CLIP than `encoder`."""
        for name in self.names:
            width = self._store.shapes(self._clip_kind(name), name)["features"][-1]
            made_with = self._store.settings(self._clip_kind(name), name)["encoder"]
            if (width, made_with) != (encoder.dim, encoder.identity):
                raise UserError(
                    f"the target of {name} has {width} channels and was made with another CLIP ({made_with}) "
                    f"than the one in use, which has {encoder.dim} ({encoder.identity}): run "
                    f"`lang3dxl prepare` again, or give {CLIP_OPTION} the model that made the targets"
                )

    def feature_statistics(
        self, names: Sequence[str] | None = None, with_dense: bool = True, sample: int = 100
    ) -> FeatureStatistics:
        """Compute channel statistics over at most `sample` photos, evenly spaced in `names` (or in all)."""
        names = self.names if names is None else list(names)
        names = names[:: -(-len(names) // sample)]
        clip = _statistics(self.clip(name).features for name in names)
        dense = _statistics(self.dense_features(names)) if with_dense and self.dense_dim else None
        return FeatureStatistics(clip, dense)


def _statistics(maps: Iterable[Float[Tensor, "h w c"]]) -> ChannelStatistics:
    """Compute statistics over all maps' pixels, merged map by map in float64 (Chan, Golub & LeVeque 1983)."""
    count, mean, squares = 0, torch.zeros(()), torch.zeros(())
    for values in maps:
        pixels = values.flatten(0, 1).double()
        variance, own_mean = torch.var_mean(pixels, dim=0, correction=0)
        both = count + len(pixels)
        step = own_mean - mean
        mean = mean + step * len(pixels) / both
        squares = squares + variance * len(pixels) + step**2 * count * len(pixels) / both
        count = both
    std = (squares / count).sqrt()
    floor = max(_STD_FLOOR * float(std.mean()), torch.finfo(torch.float32).eps)
    return ChannelStatistics(mean.float(), std.clamp_min(floor).float())
