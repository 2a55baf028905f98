"""New photos for an existing COLMAP model, which keeps its cameras, poses and points.

Features of the new photos are matched with those of the model's photos, whose keypoints tell the points that
the matches show. A photo's pose follows from its points alone, so nothing of the model has to move.
"""

from __future__ import annotations

import filecmp
import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array
from scipy.sparse import csr_array, triu
from scipy.spatial import KDTree

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import absolute, expanded, locked, replace_file
from lang3dxl_ns.scene.colmap import load_pycolmap, read_reconstruction
from lang3dxl_ns.scene.colmap_files import PARTS
from lang3dxl_ns.scene.companions import inside, work_folder
from lang3dxl_ns.scene.layout import find_model, has_model, images_folder
from lang3dxl_ns.scene.matching import extract, feature_database, match, numbered, quiet, usable
from lang3dxl_ns.scene.photo_folder import PhotoFolder, find_photos, shared_cameras
from lang3dxl_ns.scene.placements import LEAST_MATCHES, SOUND, doubtful_placements, matched_pairs
from lang3dxl_ns.scene.reconstruct import check_settings, writable, write_model, write_picture
from lang3dxl_ns.scene.reconstruction import (
    REPORT,
    ReconstructionSettings,
    model_digest,
    picture_line,
    read_report,
    reasons_in_words,
)
from lang3dxl_ns.scene.video import extract_frames, is_video

if TYPE_CHECKING:
    import pycolmap

_LEAST_POINTS = 30
"""Fewest points that agree on a photo's pose, as in COLMAP's mapper."""
_NEAR = 0.0015
"""Distance from a keypoint of the model to a feature of the same place, relative to the longer side."""
_FOCAL = 0.1, 10.0  # plausible focal lengths, relative to the longer side
_ERROR = 0.005
"""Largest distance of a point from its pixel that agrees with a pose, relative to the longer side."""
_TRUST = 1.1
"""How many times as many points must agree with a camera of its own as with one of the model's."""
_FILES = {part + end for part in (*PARTS, "rigs", "frames") for end in (".bin", ".txt")}


@dataclass(frozen=True, eq=False)
class _Placed:
    """Pose of a new photo."""

    camera: pycolmap.Camera
    camera_from_world: pycolmap.Rigid3d
    points: Int64[Array, " n"]
    """Number of the point that each keypoint shows; −1 for none."""


def add_photos(
    data: Path, folder: Path, cache_dir: Path | None = None, settings: ReconstructionSettings | None = None
) -> Path:
    """Add the photos of a folder to a scene's model, or resume an earlier attempt, and return the model.

    Photos that find a place are copied to a folder of the same name beside the scene's. The model as it was
    is kept in the cache. Raises UserError without a model, its photos or new ones, for names that are taken,
    for a mapper, since none runs, and if no photo finds a place.

    Args:
        data: the scene's folder, with photos and a COLMAP model.
        folder: new photos, or a video; may lie among the scene's.
        cache_dir: folder for features and matches; by default lang3dxl_cache in `data`.
        settings: as for `reconstruct`; features "auto" are plain SIFT's.
    """
    settings = settings or ReconstructionSettings()
    check_settings(settings)
    if settings.features == "auto":
        settings = replace(settings, features="sift")
    if settings.mapper != "incremental":
        raise UserError("--add places photos without a mapper: leave out --mapper")
    folder = absolute(folder)
    folder = extract_frames(folder) if is_video(folder) else folder
    data, folder = (Path(os.path.realpath(expanded(path))) for path in (data, folder))
    work = work_folder(data, cache_dir)
    place = find_model(data) or work / "sparse" / "0"
    images, old = _photos_of(data, place)
    adding = work / "adding"
    with locked(adding, busy=f"another command adds photos in {adding}: wait for it, or end it"), quiet():
        with readable(
            f"{place} can't be added to", "export it in binary form, or reconstruct the photos anew"
        ):
            model = load_pycolmap().Reconstruction(place)
        targets = _targets(folder, images, {image.name for image in model.images.values()})
        good, left_out = usable(PhotoFolder(images, (*old, *targets)))
        copies = numbered(good, adding)
        database = feature_database(good, copies, adding, settings, (work, work / "dsp-sift"))
        extract(database, copies, settings)
        number = dict(zip(good.names, copies.names, strict=True))
        new = {number[name] for name in targets if name in number}
        known = {(number[a], number[b]) for a, b in _pairs_of(model) if a in number and b in number}
        match(database, copies, settings, new, known)
        with load_pycolmap().Database.open(database) as db:
            ids = {name: db.read_image_with_name(number[name]).image_id for name in good.names}
            scene = _Scene(model, db, {ids[name]: name for name in good.names}, good)
            placed = scene.place_all([ids[name] for name in targets if name in ids])
            doubtful = {targets[name]: why for name, why in scene.doubts(placed).items()}
            numbers = {
                i: _add(model, photo, targets[scene.names[i]], db.read_keypoints(i)[:, :2].astype(float))
                for i, photo in placed.items()
            }
            _triangulate(model, db, numbers)
    found = {scene.names[i] for i in placed}
    lost = {targets[n]: left_out.get(n, "too few of its matches agree") for n in targets if n not in found}
    words = reasons_in_words({"without a place": lost, "doubtfully placed": doubtful})
    if not found:
        raise UserError(f"none of the {len(targets)} new photos can be placed; {'; '.join(words)}")
    for name in found:
        if not (images / targets[name]).exists():
            _copied(images / name, images / targets[name])
    for image in numbers.values():
        model.extract_colors_for_image(image, images)  # only of points without a color
    told = read_report(work.parent, place)
    kept = _replace(place, model, work)
    told["left_out"] |= lost
    told["doubtful"] |= doubtful
    write_picture(model, told["doubtful"], work)
    _report(work / REPORT.name, told, model, place)
    say(f"{len(found)} of {len(targets)} new photos have a pose; the model as it was is in {kept}", *words)
    say(picture_line(work))
    return place


def _photos_of(data: Path, place: Path) -> tuple[Path, list[str]]:
    """Return the folder of a model's photos, and their names. Raises UserError if the model or its photos are
    missing, can't be written, or is behind a link out of the scene."""
    if not has_model(place):
        raise UserError(f"{data} has no COLMAP model to add photos to: reconstruct its own photos first")
    images = Path(os.path.realpath(images_folder(data, place)))
    old = [name for name in read_reconstruction(place).photos if inside(images, name).is_file()]
    if not old:
        raise UserError(f"none of the photos in the model {place} is in {images}: put them there")
    for written in (images, place):
        if not os.access(written, os.W_OK):
            raise UserError(f"{written} can't be written to: copy the scene to where it can")
    if place.is_relative_to(data):
        inside(data, os.path.relpath(place, data))  # who made the scene would choose which model is replaced
    return images, old


def _pairs_of(model: pycolmap.Reconstruction) -> set[tuple[str, str]]:
    """List the pairs of photos that show enough points of a model together, each in the order of names."""
    names = sorted(image.name for image in model.images.values())
    row = {name: i for i, name in enumerate(names)}
    seen = [(row[i.name], p.point3D_id) for i in model.images.values() for p in i.points2D if p.has_point3D()]
    if not seen:
        return set()
    photos, points = np.array(seen, np.int64).T
    points = np.unique(points, return_inverse=True)[1]
    shows = csr_array((np.ones(len(seen), np.int32), (photos, points)))
    shared = triu(shows @ shows.T, k=1).tocoo()
    enough = shared.data >= LEAST_MATCHES
    found = zip(shared.row[enough].tolist(), shared.col[enough].tolist(), strict=True)
    return {(names[i], names[j]) for i, j in found}


def _targets(folder: Path, images: Path, known: set[str]) -> dict[str, str]:
    """Name the new photos: relative to the scene's, where they are → where they will be."""
    photos = find_photos(folder)
    targets = {}
    for name in photos.names:
        path = photos.folder / name
        within = path.is_relative_to(images)
        target = path.relative_to(images).as_posix() if within else f"{folder.name}/{name}"
        if target in known:
            continue
        if not within and inside(images, target).exists() and not filecmp.cmp(path, images / target, False):
            raise UserError(f"{images / target} is another photo: rename the folder {folder}")
        targets[os.path.relpath(path, images)] = target
    if not targets:
        raise UserError(f"{folder} holds no photos that the model lacks")
    return targets


class _Scene:
    """A model, and features of its photos and new ones, by their numbers in the database."""

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        database: pycolmap.Database,
        names: dict[int, str],
        photos: PhotoFolder,
    ) -> None:
        self.names = names
        self._database = database
        self._positions = {number: point.xyz for number, point in model.points3D.items()}
        self._rotations: dict[int, Float[Array, "3 3"]] = {}
        self._cameras: dict[int, pycolmap.Camera] = {}
        self._points: dict[int, Int64[Array, " n"]] = {}
        """Number of the point that each feature shows, for photos with a pose; −1 for none."""
        images = {image.name: image for image in model.images.values() if image.has_pose}
        own = {name: model.cameras[image.camera_id] for name, image in images.items()}
        self._shared: dict[str, pycolmap.Camera | None] = {}
        for group in shared_cameras(photos):
            known = next((own[name] for name in group if name in own), None)
            self._shared |= dict.fromkeys(group, known)
        uses = Counter(image.camera_id for image in images.values())
        sizes = Counter((camera.width, camera.height) for camera in own.values())
        self._usual = {
            (camera.width, camera.height): camera
            for camera in model.cameras.values()
            if uses[camera.camera_id] > max(2, sizes[camera.width, camera.height] / 2)
        }
        """Cameras that took most photos of their size."""
        for number, name in names.items():
            if name in images:
                self._points[number] = self._shown(number, images[name], own[name])
                self._cameras[number] = own[name]
                self._rotations[number] = images[name].cam_from_world().rotation.matrix()

    def _stored(self, number: int) -> pycolmap.Camera:
        return self._database.read_camera(self._database.read_image(number).camera_id)

    def _shown(self, number: int, image: pycolmap.Image, camera: pycolmap.Camera) -> Int64[Array, " n"]:
        """Find the points that features of a photo in the model show, by its keypoints there."""
        stored, keypoints = self._stored(number), self._database.read_keypoints(number)[:, :2]
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen or not len(keypoints):
            return np.full(len(keypoints), -1)
        scale = np.array([camera.width / stored.width, camera.height / stored.height])
        near = _NEAR * max(camera.width, camera.height)
        tree = KDTree(np.array([point.xy for point in seen]))
        distances, nearest = tree.query(keypoints * scale, distance_upper_bound=near)
        points = np.array([*(point.point3D_id for point in seen), -1], np.int64)
        return points[np.where(np.isfinite(distances), nearest, -1)]

    def place_all(self, new: Sequence[int]) -> dict[int, _Placed]:
        """Place new photos, one after the other: a placed one may tell the points of the next."""
        matches = {photo: self._matches(photo) for photo in new}
        placed: dict[int, _Placed] = {}
        while True:
            before = len(placed)
            for photo in [photo for photo in new if photo not in placed]:
                if found := self._place(photo, matches[photo]):
                    placed[photo] = found
                    self._points[photo], self._cameras[photo] = found.points, found.camera
                    self._rotations[photo] = found.camera_from_world.rotation.matrix()
            if len(placed) == before:
                return placed

    def _matches(self, photo: int) -> dict[int, Int64[Array, "m 2"]]:
        """Read a photo's verified matches with others: its feature, the other's."""
        geometry = self._database.read_two_view_geometry
        others = [n for n in self.names if n != photo and self._database.exists_two_view_geometry(photo, n)]
        return {n: np.asarray(geometry(photo, n).inlier_matches, np.int64).reshape(-1, 2) for n in others}

    def _place(self, photo: int, matches: dict[int, Int64[Array, "m 2"]]) -> _Placed | None:
        rows = [
            np.column_stack([pairs[:, 0], self._points[other][pairs[:, 1]]])
            for other, pairs in matches.items()
            if other in self._points
        ]
        shown, votes = np.unique(
            np.concatenate([np.zeros((0, 2), np.int64), *rows]), axis=0, return_counts=True
        )
        shown = shown[np.argsort(-votes, kind="stable")]
        shown = shown[shown[:, 1] >= 0]
        for column in (0, 1):  # a feature shows one point, and a point is seen once
            shown = shown[np.sort(np.unique(shown[:, column], return_index=True)[1])]
        if len(shown) < _LEAST_POINTS:
            return None
        keypoints = self._database.read_keypoints(photo)
        pixels = keypoints[shown[:, 0], :2].astype(float)
        positions = np.stack([self._positions[point] for point in shown[:, 1].tolist()])
        best, most = None, float(_LEAST_POINTS)
        for camera, fixed in self._cameras_for(photo):
            found = _solve(camera, fixed, pixels, positions)
            if found and found["num_inliers"] >= most:
                best, most = (camera, found), found["num_inliers"] * _TRUST
        if best is None:
            return None
        agreeing = shown[np.asarray(best[1]["inlier_mask"], bool)]
        points = np.full(len(keypoints), -1)
        points[agreeing[:, 0]] = agreeing[:, 1]
        return _Placed(best[0], best[1]["cam_from_world"], points)

    def _cameras_for(self, photo: int) -> list[tuple[pycolmap.Camera, bool]]:
        """Return the cameras that may have taken a photo, and whether each is fixed: one of the model's by
        EXIF, or by size where EXIF is silent, and the photo's own."""
        own = self._stored(photo)
        size = own.width, own.height
        known = self._shared[self.names[photo]]
        if known is None and not own.has_prior_focal_length:
            known = self._usual.get(size)
        fits = known is not None and (known.width, known.height) == size
        return [*([(type(own)(known.todict()), True)] if known and fits else []), (own, False)]

    def doubts(self, placed: dict[int, _Placed]) -> dict[str, str]:
        """Find new photos whose matches contradict their place, with reasons."""
        pairs = matched_pairs(self._database, self._cameras)
        reasons = doubtful_placements(self._rotations, pairs)
        return {self.names[number]: why for number, why in reasons.items() if number in placed}


def _solve(
    camera: pycolmap.Camera, fixed: bool, pixels: Float[Array, "n 2"], points: Float[Array, "n 3"]
) -> dict[str, Any] | None:
    """Find a photo's pose by the points that its pixels show, with COLMAP's answer, and its lens unless that
    is `fixed`."""
    estimation = {
        "estimate_focal_length": not fixed and not camera.has_prior_focal_length,
        "ransac": {"random_seed": 0, "max_error": _ERROR * max(camera.width, camera.height)},
    }
    refinement = {"refine_focal_length": not fixed, "refine_extra_params": not fixed}
    estimate = load_pycolmap().estimate_and_refine_absolute_pose
    found: dict[str, Any] | None = estimate(pixels, points, camera, estimation, refinement)
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    return found if _FOCAL[0] < focal < _FOCAL[1] else None


def _add(model: pycolmap.Reconstruction, photo: _Placed, name: str, keypoints: Float[Array, "n 2"]) -> int:
    """Add a placed photo to the model, and return its number there."""
    pycolmap = load_pycolmap()
    photo.camera.camera_id = max([*model.cameras, *model.rigs]) + 1
    model.add_camera_with_trivial_rig(photo.camera)
    number = max([*model.images, *model.frames]) + 1
    image = pycolmap.Image(name, keypoints, photo.camera.camera_id, number)
    model.add_image_with_trivial_frame(image, photo.camera_from_world)
    for feature in np.flatnonzero(photo.points >= 0).tolist():
        model.add_observation(int(photo.points[feature]), pycolmap.TrackElement(number, feature))
    return number


def _triangulate(
    model: pycolmap.Reconstruction, database: pycolmap.Database, added: Mapping[int, int]
) -> None:
    """Add the points that matches among new photos show; the model's own stay where they are.

    Args:
        added: numbers of the new photos: in the database → in the model.
    """
    pycolmap = load_pycolmap()
    known, matches = set(model.points3D), pycolmap.CorrespondenceGraph()
    for number, image in model.images.items():
        matches.add_image(number, image.num_points2D())
    for one, other in combinations(added, 2):
        if database.exists_two_view_geometry(one, other):
            geometry = database.read_two_view_geometry(one, other)
            matches.add_two_view_geometry(added[one], added[other], geometry)
    matches.finalize()
    options = pycolmap.IncrementalTriangulatorOptions(ignore_two_view_tracks=False, random_seed=0)
    for number in added.values():
        pycolmap.IncrementalTriangulator(matches, model).triangulate_image(options, number)
    pycolmap.ObservationManager(model, matches).filter_points3D(*SOUND, set(model.points3D) - known)


def _report(path: Path, told: dict[str, Any], model: pycolmap.Reconstruction, place: Path) -> None:
    """Write the report on a model at its place: doubtful photos are asked for there. `told` is the one on the
    model as it was, with the photos that are new."""
    placed = {image.name for image in model.images.values() if image.has_pose}
    left_out = {name: why for name, why in told["left_out"].items() if name not in placed}
    counts = {"photos": len(placed | left_out.keys()), "registered": len(placed)}
    counts["points"] = model.num_points3D()
    told |= {**counts, "left_out": left_out, "model": model_digest(place)}
    replace_file(path, json.dumps(told, indent=2))


def _replace(place: Path, model: pycolmap.Reconstruction, work: Path) -> Path:
    """Replace a model's files, in their format, and return the folder of their copies. Whatever else is in
    the model's folder, which may be the photos', stays."""
    forms = (work / f"before_adding_{number}" for number in range(1, 10_000))
    kept = next(form for form in forms if not form.exists())
    old = [path for path in sorted(place.iterdir()) if path.name in _FILES]
    write = model.write_binary if (place / "images.bin").exists() else model.write_text
    with writable(place), TemporaryDirectory(prefix=".adding.", dir=place) as folder:
        new = Path(folder) / "new"
        write_model(write, new)
        for path in old:
            _copied(path, kept / path.name)
        for path in old:
            if not (new / path.name).exists():
                path.unlink()
        for part in sorted(new.iterdir()):
            os.replace(part, place / part.name)
    return kept


def _copied(source: Path, target: Path) -> None:
    """Copy a file with its times. An interruption leaves none, rather than a part of it."""
    replace_file(target, source.read_bytes())
    shutil.copystat(source, target)
