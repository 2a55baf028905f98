"""Reading the prepared targets of a scene, their statistics, and what the data manager hands to the model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict, TypeVar

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.pyramid import ClipTarget
from lang3dxl_ns.preparation.store import FeatureStore, PhotosGoneError

Read = TypeVar("Read")
CLIP, FINE, DENSE, REGIONS = "clip", "clip_fine", "dense", "regions"
_OF_CLIP = {"features": 3, "valid": 2}
_DIMENSIONS = {CLIP: _OF_CLIP, FINE: _OF_CLIP, DENSE: {"features": 3}, REGIONS: {"labels": 2}}
"""Dimensions of a target's tensors, by kind."""

_STD_FLOOR = 0.01
FACTS = "lang3dxl"
"""Key of a scene's facts in a dataset's metadata, which nerfstudio hands to the model."""


@dataclass(frozen=True)
class StoredClipTarget(ClipTarget):
    """CLIP target of a photo, memory-mapped (CPU, float16)."""

    crop_fractions: list[float]
    """Crop sides as fractions of the photo's width, ascending."""


@dataclass(frozen=True)
class ChannelStatistics:
    """Mean and standard deviation per channel; deviations are at least 1 % of their average."""

    mean: Float[Tensor, " c"]
    std: Float[Tensor, " c"]


@dataclass(frozen=True)
class FeatureStatistics:
    """Statistics of the CLIP and the dense targets, for whitening the field's output."""

    clip: ChannelStatistics
    dense: ChannelStatistics | None


class TargetReader:
    """Reader of the prepared targets of a scene's photos, by photo name; they are loaded on access.

    `made_with` are the settings of each photo's targets, by kind. Every access raises UserError for a target
    that isn't prepared, or that another command has made with other settings since.
    """

    def __init__(self, store: FeatureStore, made_with: Mapping[str, Mapping[str, dict[str, Any]]]) -> None:
        self.names, self._made_with = list(made_with), made_with
        self._store = store
        self.clip_dim: int = self.clip(self.names[0]).features.shape[-1]
        dense = next((found for name in self.names if (found := self.dense(name)) is not None), None)
        self.dense_dim: int = 0 if dense is None else dense.shape[-1]

    def _settings(self, name: str) -> Mapping[str, dict[str, Any]]:
        if name not in self._made_with:
            raise UserError(f"targets of {name} are not prepared: run `lang3dxl prepare`")
        return self._made_with[name]

    def _clip_kind(self, name: str) -> str:
        return FINE if FINE in self._settings(name) else CLIP

    def _read(self, kind: str, name: str) -> dict[str, Tensor]:
        found = self._store.read(kind, name, self._made_with[name][kind])
        if {key: value.ndim for key, value in found.items()} != _DIMENSIONS[kind]:
            path = self._store.path(kind, name)
            raise UserError(f"{path} holds no target of this kind: delete it; run `lang3dxl prepare`")
        return found

    def clip(self, name: str) -> StoredClipTarget:
        """Read a photo's CLIP target."""
        kind = self._clip_kind(name)
        settings = self._made_with[name][kind]
        fractions = [side / settings["size"][0] for side in settings["crop_sides"]]
        return StoredClipTarget(**self._read(kind, name), crop_fractions=fractions)

    def clip_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "hd wd c"]]:
        """Yield the CLIP targets of photos, one at a time, float16, without those that have vanished."""
        return (target.features for _, target in each_readable(self.clip, names))

    def dense(self, name: str) -> Float[Tensor, "t t d"] | None:
        """Read the dense features of the photo squashed to a square, float16; None for a photo without."""
        return self._read(DENSE, name)["features"] if DENSE in self._settings(name) else None

    def dense_features(self, names: Iterable[str]) -> Iterator[Float[Tensor, "t t d"]]:
        """Yield the dense features of those photos that have some, one at a time, float16, without those that
        have vanished."""
        return (features for _, features in each_readable(self.dense, names) if features is not None)

    def regions(self, name: str) -> Int[Tensor, "h w"] | None:
        """Read the photo's region labels, −1 for none; None (no file is read) for one without regions."""
        return self._read(REGIONS, name)["labels"] if REGIONS in self._settings(name) else None

    def feature_statistics(
        self, names: Sequence[str] | None = None, with_dense: bool = True, sample: int = 100
    ) -> FeatureStatistics:
        """Compute channel statistics over at most `sample` photos, evenly spaced in `names` (or in all)."""
        names = self.names if names is None else list(names)
        names = names[:: -(-len(names) // sample)]
        clip = _statistics(self.clip(name).features for name in names)
        dense = _statistics(self.dense_features(names)) if with_dense and self.dense_dim else None
        return FeatureStatistics(clip, dense)


def each_readable(read: Callable[[str], Read], names: Iterable[str]) -> Iterator[tuple[str, Read]]:
    """Read what belongs to photos, and yield it with their names. Those that can't be read are left out, with
    a message. Raises PhotosGoneError if targets were replaced."""
    for name in names:
        try:
            yield name, read(name)
        except PhotosGoneError:
            raise
        except UserError as reason:
            say(f"{name} is left out: {reason}")


def _statistics(maps: Iterable[Float[Tensor, "h w c"]]) -> ChannelStatistics:
    """Compute statistics over all maps' pixels. Sums in float64 are exact enough for values of 16 bits."""
    count, total, squares = 0, torch.zeros(()), torch.zeros(())
    for values in maps:
        pixels = values.flatten(0, 1).double()
        count, total = count + len(pixels), total + pixels.sum(0)
        squares = squares + pixels.square().sum(0)
    mean = total / count
    std = (squares / count - mean.square()).clamp_min(0).sqrt()
    floor = max(_STD_FLOOR * float(std.mean()), torch.finfo(torch.float32).eps)
    return ChannelStatistics(mean.float(), std.clamp_min(floor).float())


class _Photo(TypedDict):
    image: UInt8[Tensor, "h w 3"]
    image_idx: int
    """Index of the photo in its dataset."""
    name: str


class Batch(_Photo, total=False):
    """Photo and its targets on the model's device; keys that a scene doesn't have are absent."""

    mask: Bool[Tensor, "h w 1"]
    """Foreground."""
    clip_target: Float[Tensor, "hd wd c"]
    """CLIP target, as in `StoredClipTarget.features`."""
    crop_sides: list[float]
    """Sides of the crops in the CLIP target, ascending, as fractions of the photo's width."""
    dense_target: Float[Tensor, "t t d"]
    """Dense features of the photo squashed to a square."""
    regions: Int[Tensor, "hr wr"]
    """Region labels, −1 for none."""


def foreground(batch: Batch) -> Bool[Tensor, "h w"] | None:
    """Return a photo's foreground; None if it is the whole photo."""
    return batch["mask"][..., 0] if "mask" in batch else None


@dataclass
class SceneFacts:
    """Facts about a scene from which a model is built, beside its settings and the scene's points."""

    names: list[str] = field(default_factory=list)
    """Names of the training photos, in the order of their cameras."""
    positions: Float[Tensor, "p 3"] | None = None
    """Positions of the training cameras, in the model's frame; None for a model that is loaded."""
    needs: Mapping[str, bool] = field(default_factory=dict)
    """Whether the scene needs each optional component; empty if that wasn't measured."""
    statistics: FeatureStatistics | None = None
    """Channel statistics of the targets; None for a model without semantics, or one that is loaded."""
    clip_targets: Callable[[], Iterator[Float[Tensor, "hd wd c"]]] | None = None
    """Function that yields the CLIP targets of the training photos, one at a time."""
    dense_targets: Callable[[], Iterator[Float[Tensor, "t t d"]]] | None = None
    """Function that yields the dense features of the training photos; None without a dense encoder."""

    def wants(self, component: str, choice: str, unmeasured: bool = True) -> bool:
        """Return whether to build a component (named as in `needs`) for a setting: `on`, `off`, or `auto`,
        for which its need decides, or `unmeasured` if that is unknown."""
        return self.needs.get(component, unmeasured) if choice == "auto" else choice == "on"
