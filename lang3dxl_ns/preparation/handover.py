"""Data passed from the data manager to the model: scene facts once, one photo per step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypedDict

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lang3dxl_ns.preparation.targets import FeatureStatistics

_KEY = "lang3dxl"


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
    """CLIP target, as in `preparation.targets.StoredClipTarget.features`."""
    crop_sides: list[float]
    """Sides of the crops in the CLIP target, ascending, as fractions of the photo's width."""
    dense_target: Float[Tensor, "t t d"]
    """Dense features of the photo squashed to a square."""
    regions: Int[Tensor, "hr wr"]
    """Region labels, −1 for none."""


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

    def into(self, metadata: dict[str, Any]) -> None:
        """Put the facts into a dataset's metadata, which nerfstudio hands to the model."""
        metadata[_KEY] = self

    @staticmethod
    def of(metadata: Mapping[str, Any]) -> SceneFacts:
        """Return the facts in a dataset's metadata, or empty ones."""
        return metadata.get(_KEY) or SceneFacts()
