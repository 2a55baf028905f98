"""Photos to evaluate, one in memory at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Protocol

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.plugin.photo_dataset import PhotoDataset
from lang3dxl_ns.preparation.handover import Batch
from lang3dxl_ns.scene.photo import Photo


class Reader(Protocol):
    """What reads photos: the data manager."""

    eval_dataset: PhotoDataset

    @property
    def targets(self) -> Any:
        """Targets of the photos, prepared at first use."""

    def read(self, dataset: PhotoDataset, index: int) -> tuple[Cameras, Batch]:
        """Camera and batch of a photo. Raises UserError if it can't be used."""


class EvalPhotos:
    """Photos to evaluate as (camera, batch) pairs, one photo in memory at a time; damaged ones are left out
    and logged.

    Args:
        dataset: by default the held-out photos.
        names: photos of it to evaluate; by default all.
    """

    def __init__(
        self,
        datamanager: Reader,
        dataset: PhotoDataset | None = None,
        names: Collection[str] | None = None,
    ):
        self._datamanager = datamanager
        self.dataset = dataset or datamanager.eval_dataset
        photos = enumerate(self.dataset.photos)
        self._wanted = [index for index, photo in photos if names is None or photo.name in names]

    def __len__(self) -> int:
        return len(self._wanted)

    def cameras(self) -> Iterator[tuple[Cameras, Photo]]:
        """Camera and photo of each, without reading files."""
        for index in self._wanted:
            yield self.dataset.cameras[index : index + 1], self.dataset.photos[index]

    def __iter__(self) -> Iterator[tuple[Cameras, Batch]]:
        dataset = self.dataset
        _ = self._datamanager.targets  # errors in preparing them must not be blamed on a photo
        usable = False
        for index in self._wanted:
            photo = dataset.photos[index]
            try:
                item = self._datamanager.read(dataset, index)
            except UserError as reason:
                CONSOLE.log(escape(f"{photo.name} is left out of evaluation: {reason}"))
                continue
            usable = True
            yield item
        if not usable:
            raise UserError("none of the held-out photos can be used: see the reasons above")
