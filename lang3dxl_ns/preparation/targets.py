"""The prepared targets of a scene, read photo by photo, and their statistics."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.preparation.encoders import CLIP_OPTION, ImageTextEncoder
from lang3dxl_ns.preparation.store import FeatureStore

CLIP, DENSE, REGIONS = "clip", "dense", "regions"

_STD_FLOOR = 0.01


@dataclass
class StoredClipTarget:
    """A photo's CLIP target, mapped from disk: float16, CPU."""

    features: Float[Tensor, "hd wd c"]
    """Mean embedding over the scales, not normalised."""
    valid: Float[Tensor, "hd wd"]
    """Mean fraction of the crops' area inside the photo, 0…1."""
    crop_fractions: list[float]
    """Crop sides as fractions of the photo's width, ascending."""

    @property
    def range_factor(self) -> float:
        """Largest over smallest crop."""
        return self.crop_fractions[-1] / self.crop_fractions[0]


@dataclass
class ChannelStatistics:
    """Mean and standard deviation per channel; the deviation is floored at 1 % of the channels' average."""

    mean: Float[Tensor, " c"]
    std: Float[Tensor, " c"]


@dataclass
class FeatureStatistics:
    """Of the CLIP and the dense targets, for whitening the field's output."""

    clip: ChannelStatistics
    dense: ChannelStatistics | None


class TargetReader:
    """The prepared targets of a scene's photos, by photo name; nothing is loaded before it is touched."""

    def __init__(
        self,
        store: FeatureStore,
        names: Sequence[str],
        with_dense: bool = True,
        with_regions: Collection[str] = (),
    ) -> None:
        self.names = list(names)
        self._store, self._with_dense, self._with_regions = store, with_dense, frozenset(with_regions)
        self.clip_dim: int = store.shapes(CLIP, self.names[0])["features"][-1]
        self.dense_dim: int = store.shapes(DENSE, self.names[0])["features"][-1] if with_dense else 0

    def clip(self, name: str) -> StoredClipTarget:
        """The CLIP target of a photo. Raises UserError when it isn't prepared."""
        settings = self._store.settings(CLIP, name)
        width = settings["size"][0]
        return StoredClipTarget(
            **self._store.read(CLIP, name), crop_fractions=[side / width for side in settings["crop_sides"]]
        )

    def clip_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "hd wd c"]]:
        """The CLIP targets of photos, one at a time, float16."""
        return (self.clip(name).features for name in names)

    def dense(self, name: str) -> Float[Tensor, "t t d"] | None:
        """The dense features of the squashed photo, float16; None when prepared without."""
        return self._store.read(DENSE, name)["features"] if self._with_dense else None

    def regions(self, name: str) -> Int[Tensor, "h w"] | None:
        """Region labels of the photo, −1 for none; None (and nothing is read) for a photo without regions."""
        return self._store.read(REGIONS, name)["labels"] if name in self._with_regions else None

    def bytes_of(self, name: str) -> int:
        """Size of a photo's targets."""
        kinds = [CLIP] + [DENSE] * self._with_dense + [REGIONS] * (name in self._with_regions)
        return sum(self._store.path(kind, name).stat().st_size for kind in kinds)

    def check(self, encoder: ImageTextEncoder) -> None:
        """Raises UserError when a photo's target is missing or comes from another CLIP than `encoder`."""
        for name in self.names:
            width = self._store.shapes(CLIP, name)["features"][-1]
            made_with = self._store.settings(CLIP, name)["encoder"]
            if (width, made_with) != (encoder.dim, encoder.identity):
                raise UserError(
                    f"the target of {name} has {width} channels and was made with another CLIP ({made_with}) "
                    f"than the one in use, which has {encoder.dim} ({encoder.identity}): run "
                    f"`lang3dxl prepare` again, or give {CLIP_OPTION} the model that made the targets"
                )

    def feature_statistics(self, names: Sequence[str] | None = None, sample: int = 100) -> FeatureStatistics:
        """Mean and deviation per channel over at most `sample` photos, evenly spaced in `names` (or all)."""
        names = self.names if names is None else list(names)
        names = names[:: -(-len(names) // sample)]
        clip = _statistics(self.clip(name).features for name in names)
        dense = (
            _statistics(self._store.read(DENSE, name)["features"] for name in names)
            if self._with_dense
            else None
        )
        return FeatureStatistics(clip, dense)


def _statistics(maps: Iterable[Float[Tensor, "h w c"]]) -> ChannelStatistics:
    """Statistics over all pixels of all maps, merged map by map in float64 (Chan, Golub & LeVeque 1983)."""
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
