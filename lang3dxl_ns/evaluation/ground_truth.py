"""Ground truth of a scene, in any of the supported layouts (HolyScenes, LERF-OVS, plain masks)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path, PurePosixPath
from typing import Literal

from jaxtyping import Bool
from numpy import ndarray as Array

from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.evaluation.layouts import (
    MaskFile,
    Outlines,
    Truth,
    is_holyscenes,
    is_lerf_ovs,
    read_holyscenes,
    read_lerf_ovs,
    read_plain,
)
from lang3dxl_ns.scene.names import normal_parts

Layout = Literal["holyscenes", "lerf_ovs", "plain"]
_READERS: dict[str, Callable[[Path], Mapping[str, Mapping[str, MaskFile | Outlines]]]] = {
    "holyscenes": read_holyscenes,
    "lerf_ovs": read_lerf_ovs,
    "plain": read_plain,
}
"""Readers of annotations by category, then by photo (its name without suffix, or the end of that)."""


class GroundTruth:
    """Labels of a scene's photos, by category. Raises UserError for a folder that is missing or holds
    something else.

    Args:
        folder: folder of one scene.
        layout: "holyscenes" (<category>/NNNN-gt.jpg), "lerf_ovs" (<photo>.json, also PT-OVS), or "plain"
            (<prompt>/<photo>.png); "auto" detects it.
    """

    def __init__(self, folder: Path, layout: Layout | Literal["auto"] = "auto") -> None:
        self.folder = expanded(folder)
        if not self.folder.is_dir():
            raise UserError(f"{self.folder} is not a folder: pass the one that holds the ground truth")
        self.layout: Layout = _layout(self.folder) if layout == "auto" else layout
        self._annotations = _READERS[self.layout](self.folder)
        self._labeled = {photo for photos in self._annotations.values() for photo in photos}
        self._forms = {normal_parts(name): name for name in self._labeled}
        self._forms |= {PurePosixPath(name).parts: name for name in self._labeled}

    @property
    def categories(self) -> list[str]:
        """Category names, which are also the prompts, sorted."""
        return list(self._annotations)

    @property
    def labeled(self) -> list[str]:
        """Labeled photos, sorted, with the names that the labels use (no suffix)."""
        return sorted(self._labeled)

    def photos(self, category: str) -> list[str]:
        """List the photos with a label of the category, with the names that the labels use."""
        return list(self._annotations[category])

    def key(self, photo: str) -> str | None:
        """Find the labels' name for a photo (whose name may contain folders, other capitals, or accents in
        another form); None if it has no label."""
        for *folders, last in filter(None, (PurePosixPath(photo).parts, normal_parts(photo))):
            stem = PurePosixPath(last).stem
            for form in ((*folders, last), (*folders, stem), (last,), (stem,)):
                if form in self._forms:
                    return self._forms[form]
        return None

    def check(self, photos: Collection[str]) -> None:
        """Check that each label belongs to one photo of the scene; warn about labels without a photo."""
        named: dict[str, str] = {}
        for name in photos:
            key = self.key(name)
            if key is not None and named.setdefault(key, name) != name:
                raise UserError(
                    f"the label {key} in {self.folder} fits both {named[key]} and {name}: name labels with "
                    f"their photos' folders, or as {name}.png"
                )
        absent = [photo for photo in self.labeled if photo not in named]
        if not named:
            raise UserError(
                f"no label in {self.folder} belongs to a photo of the scene: labels are named like photos, "
                f"but the first are {absent[0]} and {next(iter(photos))}"
            )
        if absent:
            absence = "belong to no photo of the scene and are not scored"
            say(f"{len(absent)} labels in {self.folder} {absence}: {some(absent)}")

    def size(self, photo: str) -> tuple[int, int]:
        """Return height and width of a labeled photo."""
        return next(iter(self._of(photo).values())).size()

    def scoring_size(self, height: int, width: int) -> tuple[int, int]:
        """Return height and width at which maps of a photo are scored: half the photo's size for masks, as in
        Lang3D-XL, and the photo's own size for LERF-OVS, whose filter sizes are in its pixels."""
        return (height, width) if self.layout == "lerf_ovs" else (max(height // 2, 1), max(width // 2, 1))

    def truths(self, photo: str, size: tuple[int, int]) -> dict[str, Truth]:
        """Read the photo's labels by category, at `size` (height, width), without categories that were not
        annotated in it. Raises UserError for an unreadable label, and for one of another aspect ratio."""
        return {category: label.truth(size) for category, label in self._of(photo).items()}

    def masks(self, photo: str, size: tuple[int, int]) -> dict[str, Bool[Array, "h w"]]:
        """Read only the masks of `truths`."""
        return {category: truth.mask for category, truth in self.truths(photo, size).items()}

    def _of(self, photo: str) -> dict[str, MaskFile | Outlines]:
        key = self.key(photo)
        return {c: photos[key] for c, photos in self._annotations.items() if key in photos} if key else {}


def _layout(folder: Path) -> Layout:
    if is_holyscenes(folder) and is_lerf_ovs(folder):
        raise UserError(f"{folder} holds masks NNNN-gt.jpg and labels <photo>.json: name the layout to read")
    if is_lerf_ovs(folder):
        return "lerf_ovs"
    # For a folder above one in a layout, that layout's reader gives the error message.
    if is_holyscenes(folder) or any(folder.glob("*/*/*-gt.*")):
        return "holyscenes"
    return "lerf_ovs" if any(folder.glob("*/*.json")) else "plain"


def find_ground_truth(data: Path) -> Path | None:
    """Find the ground truth of a scene's data: ground_truth/ or label/ in its folder, or label/<scene> next
    to it (as LERF-OVS and PT-OVS are published)."""
    if (data / "ground_truth").is_dir():
        return data / "ground_truth"
    labels = (data / "label", data / "label" / data.name, data.parent / "label" / data.name)
    return next((folder for folder in labels if is_lerf_ovs(folder)), None)


def held_out_photos(truth: GroundTruth, per_category: int = 5) -> list[str]:
    """Choose labeled photos to hold out of training, sorted: up to `per_category` that show each category,
    preferring those already chosen for another (Lang3D-XL's rule; its own list is not published). The rest
    are spread evenly over the category's photos, so the same labels always give the same list."""
    chosen: set[str] = set()
    sizes = {photo: truth.scoring_size(*truth.size(photo)) for photo in truth.labeled}
    for category in sorted(truth.categories):
        photos = [p for p in sorted(truth.photos(category)) if truth.masks(p, sizes[p])[category].any()]
        left = [photo for photo in photos if photo not in chosen]
        count = max(min(per_category - (len(photos) - len(left)), len(left)), 0)
        chosen.update(left[(2 * i + 1) * len(left) // (2 * count)] for i in range(count))
    return sorted(chosen)
