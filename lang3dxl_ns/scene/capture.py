"""Capture: a folder's photos with cameras, masks, points, split and frame, for training and for `attach`.

A capture comes from a COLMAP model, a transforms.json, a folder of photos alone, or a video.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import say, some
from lang3dxl_ns.common.errors import UserError, printable, readable
from lang3dxl_ns.common.files import absolute, expanded, read_names
from lang3dxl_ns.common.options import capture_option
from lang3dxl_ns.scene.camera import camera_to_world, view_matrix
from lang3dxl_ns.scene.capture_settings import CAPTURE_BOUNDS, CaptureSettings
from lang3dxl_ns.scene.colmap import Reconstruction, TrackedPhoto, photos_in_model, read_reconstruction
from lang3dxl_ns.scene.companions import cache_folder, inside, is_inside
from lang3dxl_ns.scene.frame import COLMAP_UP, Frame, find_frame, lost_cameras, no_scene, wrong_cameras
from lang3dxl_ns.scene.layout import (
    MODEL_FOLDERS,
    find_model,
    find_transforms,
    has_model,
    images_folder,
    mention_other_cameras,
    whole_scene,
)
from lang3dxl_ns.scene.masks import mask_folder
from lang3dxl_ns.scene.matching import shows_these
from lang3dxl_ns.scene.names import listed, resolve
from lang3dxl_ns.scene.photo import Photo, stored_size, upright
from lang3dxl_ns.scene.photo_folder import check_data, find_photos, mention_passed_over, photos_below
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.reconstruction import CONTRADICTED, doubtful_photos, reasons_in_words
from lang3dxl_ns.scene.record import SceneRecord
from lang3dxl_ns.scene.transforms import Transforms, read_transforms
from lang3dxl_ns.scene.video import extract_frames, frames_folder, is_video

_OWN_MODEL = Path("lang3dxl_cache/reconstruction/sparse/0")
"""Folder of a model that is reconstructed here, if sparse/ is taken."""
_SPLIT_LISTS = ("train_list.txt", "validation_list.txt", "val_list.txt", "test_list.txt")
"""Files of a folder that list the photos of a split, for nerfstudio."""


class Split(NamedTuple):
    """Names of the photos to train on, and of those held out. Under "all", both name every photo."""

    train: tuple[str, ...]
    held_out: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos on disk with their cameras and points, in the coordinates of the file that they come from."""

    folder: Path
    """Folder of the capture."""
    photos: list[Photo]
    """Usable photos with their masks, sorted by name."""
    reconstruction: Reconstruction
    """Poses of these photos, tracks, and points with colors."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Photos that can't be used, with reasons."""
    doubtful: dict[str, str] = field(default_factory=dict)
    """Photos whose pose may be wrong, with reasons. Contradicted ones are used only if a list names them."""
    images: Path = Path()
    """Folder that the photos' names are relative to."""
    source: Path | None = None
    """COLMAP model or transforms.json that it was read from."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    transforms: Transforms | None = None
    """Contents of the transforms.json, if it comes from one."""
    known_split: Split | None = None
    """The split, if another program chose it."""
    known_frame: Frame | None = None
    """Similarity to training's coordinates, if it is that of another capture or program."""

    @property
    def names(self) -> list[str]:
        """Names of the usable photos."""
        return [photo.name for photo in self.photos]

    @cached_property
    def split(self) -> Split:
        """Photos to train on and photos held out, as lists in the folder say, or by the settings' rule.
        Raises UserError if one of the two is empty, or a list names an unknown photo."""
        if self.known_split is not None:
            return self.known_split
        train, held_out = self._listed_split() or self._split_by_rule()
        if train and not held_out and self.settings.held_out is None:
            say(
                f"the lists of {self.folder} hold out no photo that is there: those of training are evaluated"
            )
            held_out = train
        for part, names in (("train", train), ("held-out", held_out)):
            if not names:
                raise UserError(
                    f"the {part} split of {self.folder} has none of the {len(self.photos)} photos: add "
                    f"photos, or correct the lists there ({', '.join(_SPLIT_LISTS)})"
                )
        return Split(train, held_out)

    def _listed_split(self) -> Split | None:
        """Split as the settings' list, the transforms.json or lists in the folder say; None without any."""
        if self.settings.held_out is not None:
            return self._of_lists(None, self._named(self.settings.held_out))
        if self.transforms is not None and (self.transforms.train or self.transforms.held_out):
            return self._of_lists(self.transforms.train, self.transforms.held_out)
        lists = [self.folder / name for name in _SPLIT_LISTS if (self.folder / name).is_file()]
        if not lists:
            return None
        parts = (
            [self._named(f) for f in lists if f.name.startswith("train") is kind] for kind in (True, False)
        )
        return self._of_lists(*(frozenset[str]().union(*part) or None for part in parts))

    def _of_lists(self, train: frozenset[str] | None, held_out: frozenset[str] | None) -> Split:
        """Split by two lists. One that is missing holds all other photos whose poses are not contradicted."""
        sure = frozenset(self.sure)
        chosen = train or sure.difference(held_out or ())
        others = held_out or sure.difference(chosen)
        return Split(*(tuple(n for n in self.names if n in part) for part in (chosen, others)))

    def _named(self, path: Path) -> frozenset[str]:
        """Read a list of photos. Raises UserError for an unknown one."""
        with readable(f"{path} can't be used", "correct the list"):
            known = {*self.names, *self.left_out}
            return listed(read_names(path, known=known), known, "it")

    def _split_by_rule(self) -> Split:
        sure, every = self.sure, self.settings.eval_interval
        if self.settings.eval_mode == "all":
            return Split(tuple(sure), tuple(sure))
        return Split(tuple(n for i, n in enumerate(sure) if i % every), tuple(sure[::every]))

    @property
    def sure(self) -> list[str]:
        """Names of the usable photos whose poses are not contradicted."""
        return [name for name in self.names if name not in self.contradicted]

    @property
    def contradicted(self) -> dict[str, str]:
        """Photos that most of their matches contradict, with that reason."""
        return {name: why for name, why in self.doubtful.items() if why == CONTRADICTED}

    @cached_property
    def frame(self) -> Frame:
        """Similarity from the file's coordinates to training's."""
        if self.known_frame is not None:
            return self.known_frame
        settings = self.settings
        return find_frame(
            self._world_from_camera(self.names), self.reconstruction.points,
            np.eye(3) if self.transforms is not None else COLMAP_UP,
            settings.orientation_method, settings.center_method, settings.auto_scale_poses,
            settings.scale_factor, )  # fmt: skip

    @property
    def recorded_frame(self) -> Frame:
        """Similarity to training's coordinates from the original ones, which a transforms.json may have
        moved."""
        moved = self.transforms
        return self.frame if moved is None else self.frame.after(moved.applied, moved.applied_scale)

    def poses(self, names: Sequence[str]) -> Float32[Array, "n 3 4"]:
        """Compute photos' poses in training's frame (camera → world; x right, y up, z backward)."""
        return self.frame.poses(self._world_from_camera(names)).astype(np.float32)

    @property
    def seeds(self) -> tuple[Float32[Tensor, "m 3"], UInt8[Tensor, "m 3"]] | None:
        """Points that training starts from, in its frame, and their colors. A transforms.json may have none;
        training then starts from random ones."""
        points = self.frame.points(self.reconstruction.points)
        if self.transforms is not None and not len(points):
            return None
        return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(self.reconstruction.colors)

    def _world_from_camera(self, names: Sequence[str]) -> Float64[Array, "n 3 4"]:
        views = np.array([self.reconstruction.photos[name].camera_from_world for name in names], np.float64)
        return np.array([camera_to_world(torch.from_numpy(view)).numpy() for view in views]).reshape(-1, 3, 4)


def open_capture(
    data: str | Path,
    settings: CaptureSettings | None = None,
    cache_dir: Path | None = None,
    may_reconstruct: bool = True,
) -> Capture:
    """Open a capture.

    Args:
        data: folder with a COLMAP model, with a transforms.json, or with photos alone; or a transforms.json,
            or a video. Photos without poses are reconstructed, which takes minutes.
        settings: where its parts are, and how it is split and normalized.
        cache_dir: folder of a reconstruction, if not lang3dxl_cache in the folder.
        may_reconstruct: whether photos may be reconstructed, and frames of a video extracted.

    Raises:
        UserError: there are no photos, or none of them can be used, or the file with their cameras is
        damaged.
    """
    settings = settings or CaptureSettings()
    check_numbers(settings, CAPTURE_BOUNDS)
    folder, source = find_source(data, settings, cache_dir, may_reconstruct)
    if source.suffix == ".json":
        capture = _of_transforms(source, settings)
    else:
        capture = _of_model(folder, source, settings)
        doubts = doubtful_photos(cache_folder(folder, cache_dir), source)
        capture = replace(capture, doubtful={n: doubts[n] for n in capture.names if n in doubts})
    if not capture.photos:
        first = next(iter(capture.left_out.items()), ("", "it lists none"))
        images = f"put them into images/ there, or name their folder ({capture_option('images-path')})"
        remedy = f"correct {source}" if capture.transforms is not None else images
        raise UserError(
            f"none of the {len(capture.left_out)} photos of {folder} can be used: {remedy}. The first: "
            f"{': '.join(first)}"
        )
    capture = _without_lost_cameras(capture)
    tracked, points = list(capture.reconstruction.photos.values()), capture.reconstruction.points
    centers = np.array([photo.center for photo in tracked])
    if why := no_scene(centers, points) or wrong_cameras(tracked, points):
        say(f"{source}: {why}. No scene comes of it: give the cameras that the photos were taken with")
    return capture


def find_source(
    data: str | Path, settings: CaptureSettings, cache_dir: Path | None = None, may_reconstruct: bool = True
) -> tuple[Path, Path]:
    """Find a capture's folder and the COLMAP model or transforms.json with its cameras, or make a model.

    The first of these counts: the transforms.json that is `data`; the model that the settings name; a model,
    earlier reconstruction or transforms.json in the folder, or in the scene that the folder is a part of.
    Raises UserError as `open_capture` does.
    """
    folder = _with_frames(absolute(data), may_reconstruct)
    if folder.suffix == ".json" and folder.is_file():
        return folder.parent, folder
    check_data(folder)
    if settings.colmap_path is not None:
        return folder, folder / settings.colmap_path
    if (whole := whole_scene(folder)) != folder:
        say(f"{folder} is a part of the scene {whole}, which is read")
        return whole, folder if has_model(folder) else _source_in(whole, cache_dir) or folder
    if (source := _source_in(folder, cache_dir)) is not None:
        return source.parent if source.suffix == ".json" else folder, source
    if may_reconstruct and (photos := find_photos(folder)).names:
        # Names of nothing and links out of the scene are told now rather than after hours.
        images_folder(folder, folder, settings.images_path)
        mask_folder(folder, settings.masks_path)
        for name in photos.names:
            if (photos.folder / name).exists():  # a link to nothing is left out like a damaged file
                inside(photos.folder, name, settings.follow_links)
        mention_other_cameras(folder)
        return reconstruct_scene(folder, cache_dir)
    of_models = (path for part in ("images", "cameras") for path in folder.rglob(f"{part}.[bt]*"))
    if may_reconstruct and not any(of_models):
        mention_passed_over(folder)
        lacks = "holds no photos and no COLMAP model" if any(folder.iterdir()) else "is empty"
        raise UserError(f"{folder} {lacks}: give the folder with your photos (then lang3dxl reconstruct)")
    return folder, folder / MODEL_FOLDERS[0]  # reading it tells what is missing


def _with_frames(data: Path, may_extract: bool) -> Path:
    """Return the folder of a video's frames, also of one that is gone; any other path as it is."""
    if not is_video(data) and (data.exists() or not frames_folder(data).is_dir()):
        return data
    return extract_frames(data) if may_extract else frames_folder(data)


def _source_in(folder: Path, cache_dir: Path | None) -> Path | None:
    """Find a model in a folder, one that was reconstructed from it before, or a transforms.json."""
    reconstructed = [folder / _OWN_MODEL]
    if cache_dir is not None:
        work = expanded(cache_dir).absolute() / "reconstruction"
        reconstructed += [work / "sparse/0"] if shows_these(work, folder) else []
    return find_model(folder) or next(filter(has_model, reconstructed), None) or find_transforms(folder)


# ── from a COLMAP model ─────────────────────────────────────────────────────────────────────────────────


def _of_model(folder: Path, model: Path, settings: CaptureSettings) -> Capture:
    found, images = read_reconstruction(model), images_folder(folder, model, settings.images_path)
    exists = partial(is_inside, images)
    files, doubts = resolve(list(found.photos), exists, lambda: photos_below(images), "photos")
    places = {name: files.get(name, name) for name in found.photos}
    capture = _usable(folder, images, found, places, doubts, settings, settings.follow_links)
    _mention_what_is_not_used(capture, model, set(places.values()))
    return replace(capture, source=model)


def _usable(
    folder: Path,
    images: Path,
    found: Reconstruction,
    files: dict[str, str],
    doubts: dict[str, UserError],
    settings: CaptureSettings,
    links: bool,
    masks_of: dict[str, Path] | None = None,
) -> Capture:
    """Match cameras with files on disk, by the names in `files`. Photos that can't be used are left out."""
    masks = mask_folder(folder, settings.masks_path, links, images)
    photos, left_out, kept = list[Photo](), dict[str, str](), dict[str, TrackedPhoto]()
    for name, tracked in found.photos.items():
        file = files[name]
        path = images / file
        try:
            if name in doubts:
                raise doubts[name]
            if not inside(images, file, links).is_file():
                raise UserError(f"there is no {path}")
            turned = replace(upright(tracked, *stored_size(path, name)), name=file)
            mask = (masks_of or {}).get(name)
            if mask is None and masks is not None:
                mask = masks.find(file)
            if mask is not None and mask.samefile(path):
                mask = None  # the folder of the photos was named as that of their masks
            photos.append(Photo.from_model(turned, path, mask))
            kept[file] = turned
        except UserError as reason:
            left_out[name] = str(reason)
    if cut_out := [photo.name for photo in photos if photo.mask_path == photo.path]:
        say(f"{len(cut_out)} photos have transparent parts, which do not count: {some(cut_out, 3)}")
    unmasked = photos and all(photo.mask_path in (None, photo.path) for photo in photos)
    if masks is not None and unmasked and any(masks.folder.iterdir()):
        say(
            f"{masks.folder} has no picture that is named like a photo (as {photos[0].name}): no mask is "
            "used. Name masks like the photos, with .png or .jpg"
        )
    photos.sort(key=lambda photo: photo.name)
    kept = dict(sorted(kept.items()))
    return Capture(folder, photos, replace(found, photos=kept), left_out, images=images, settings=settings)


def _mention_what_is_not_used(capture: Capture, model: Path, listed: set[str]) -> None:
    """Say which other models are beside the one in use, and which photos are missing from it."""
    # COLMAP's mapper leaves its models in one folder: 0, 1, …
    beside = sorted(model.parent.glob("[0-9]*")) if model.name.isdigit() else []
    others = [f for f in beside if f != model and f.name.isdigit() and any(f.glob("images.*"))]
    if others:
        counted = [
            f"{os.path.relpath(f, capture.folder)} with {photos_in_model(f)}" for f in (model, *others)
        ]
        say(
            f"{capture.folder} has {len(counted)} models; used is {counted[0]} photos. There are also "
            f"{', '.join(counted[1:])}: to use one of them, give its folder instead of the scene's"
        )
    unknown = [name for name in photos_below(capture.images) if name not in listed]
    if unknown:
        say(
            f"{len(unknown)} photos of {capture.images} are not in the COLMAP model and not used: "
            f"{some(unknown)}"
        )


# ── from a transforms.json ──────────────────────────────────────────────────────────────────────────────


def _of_transforms(path: Path, settings: CaptureSettings) -> Capture:
    if settings.images_path != CaptureSettings.images_path:
        raise UserError(f"{path} names its photos itself: leave {capture_option('images-path')} off")
    content = read_transforms(path)
    found = Reconstruction(content.photos, content.points, content.colors)
    files = {name: name for name in content.photos}
    capture = _usable(path.parent, path.parent, found, files, {}, settings, True, content.masks)
    left_out = {name: str(reason) for name, reason in content.left_out.items()} | capture.left_out
    return replace(capture, left_out=left_out, source=path, transforms=content)


# ── from a run's record ─────────────────────────────────────────────────────────────────────────────────


def recorded_capture(record: SceneRecord) -> Capture:
    """Return a run's photos and cameras, at training resolution, as its record has them, without a `source`.
    Its points are as few as can be begun with, since the run's checkpoint brings its Gaussians."""
    poses = record.frame.inverse().poses(np.array([photo.camera_to_world for photo in record.photos]))
    tracked, nothing = {}, np.zeros((0, 3))
    for photo, pose in zip(record.photos, torch.from_numpy(poses), strict=True):
        view = view_matrix(pose)[:3].numpy()
        tracked[photo.name] = TrackedPhoto(photo.name, photo.lens, view, nothing, nothing[:, :2])
    model = Reconstruction(tracked, np.eye(4)[:, :3], np.zeros((4, 3), np.uint8))
    held_out = tuple(photo.name for photo in record.photos if photo.held_out)
    split = Split(tuple(record.trained), held_out or tuple(record.trained))  # no photo may be held out
    photos = [photo.photo(Path(record.data)) for photo in record.photos]
    doubtful = {photo.name: photo.doubtful for photo in record.photos if photo.doubtful}
    return Capture(
        Path(record.data), photos, model, {}, doubtful, known_split=split, known_frame=record.frame
    )


# ── cameras that are lost ───────────────────────────────────────────────────────────────────────────────


def _without_lost_cameras(capture: Capture) -> Capture:
    """Leave out photos whose cameras stand so far from all others that their poses must be wrong."""
    names = capture.names
    centers = np.array([capture.reconstruction.photos[name].center for name in names])
    lost = {names[i] for i in np.flatnonzero(lost_cameras(centers, capture.reconstruction.points))}
    if not lost:
        return capture
    reason = "its camera stands over a hundred times as far away as the others: its pose is wrong"
    kept = {name: photo for name, photo in capture.reconstruction.photos.items() if name not in lost}
    return replace(
        capture,
        photos=[photo for photo in capture.photos if photo.name not in lost],
        reconstruction=replace(capture.reconstruction, photos=kept),
        left_out=capture.left_out | dict.fromkeys(sorted(lost), reason),
    )


def say_left_out(capture: Capture) -> None:
    """Say which photos are left out, and why."""
    if capture.left_out:
        say(f"{len(capture.left_out)} photos of {capture.source} are left out:")
        say(*(f"  {printable(name)}: {why}" for name, why in capture.left_out.items()))
    if capture.contradicted:
        used = frozenset().union(*capture.split)
        unused = {name: why for name, why in capture.contradicted.items() if name not in used}
        say(*reasons_in_words({"doubtfully placed, and not used": unused}))


def say_held_out(capture: Capture) -> None:
    """Say how many photos training does without, and how it would use them."""
    if held_out := set(capture.split.held_out) - set(capture.split.train):
        say(
            f"{len(held_out)} of {len(capture.photos)} photos are held out of training, for evaluation "
            f"({capture_option('eval-mode')} all trains on all that no list holds out)"
        )
