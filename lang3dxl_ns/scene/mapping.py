"""Mapping: cameras, poses and points of matched photos, by COLMAP's mappers.

Every hundred photos a snapshot is kept, from which a stopped mapping goes on.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from lang3dxl_ns.common.console import progress, say, tracked
from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.colmap_files import read_model_files
from lang3dxl_ns.scene.matching import SNAPSHOTS
from lang3dxl_ns.scene.photo_folder import PhotoFolder
from lang3dxl_ns.scene.placements import LEAST_MATCHES, SOUND
from lang3dxl_ns.scene.symmetry import copy_without

if TYPE_CHECKING:
    import pycolmap

SMALLEST_MODEL = 3  # photos; COLMAP's default of ten may exceed the number of photos
_POINTS, _POINTS_OF_TWINS = 15, 30
"""Fewest points that agree on a photo's pose, and fewest where sides look alike, as COLMAP's mapper has it: a
quarter more photos of a hall get one, but 15 points also agree on the wrong side."""
_SOFT, _LAST_STEPS = 1.0, 10
"""Error in pixels from which a match counts less for the cameras in the end, and steps of this adjustment: a
hundred move photos by under .003 pixels more."""
_GROWTH = 1.3
"""Growth of a model after which all of it is adjusted. COLMAP's 1.1 takes a fourth to a half more time for
the same places."""
_STEPS, _REPEATED = 20, 2
"""Most steps of such an adjustment, and most repetitions without the points that it finds wrong. COLMAP's 50
and 5 change no place, and for a thousand photos a step takes ten seconds."""
_SAVED = 100
"""Photos that get a pose between two snapshots of mapping, from which a stopped one goes on."""
_PLACED = "photos with a pose"
_RELAXED = {"init_min_num_inliers": 30, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15}
"""Thresholds of the incremental mapper where it finds no model with the usual ones."""


def map_photos(
    database: Path, photos: PhotoFolder, work: Path, kind: str, points: int = _POINTS
) -> list[pycolmap.Reconstruction]:
    """Map photos by the matches in a database, and return the models, largest first. `work` gets snapshots.
    The mapper is "global", or "incremental", for which `points` have to agree on a pose, or `_RELAXED` holds.
    """
    if kind == "global":
        models = _globally(database, photos, work)
    else:
        one_by_one = partial(_one_by_one, database, photos, work)
        models = one_by_one({"abs_pose_min_num_inliers": points}) or one_by_one(_RELAXED)
    for model in tracked(models, "models completed"):
        _complete(model, database, photos)
    return sorted(models, key=lambda model: -model.num_reg_images())


def map_without(
    pairs: Collection[tuple[int, int]], database: Path, photos: PhotoFolder, work: Path, kind: str
) -> list[pycolmap.Reconstruction]:
    """Map without some pairs, which contradict others."""
    say(f"{len(pairs)} pairs contradict others, as where sides look alike: mapping anew without them")
    with TemporaryDirectory(dir=work) as folder:
        consistent = Path(folder) / "database.db"
        copy_without(pairs, database, consistent)
        return map_photos(consistent, photos, Path(folder), kind, _POINTS_OF_TWINS)


def _globally(database: Path, photos: PhotoFolder, work: Path) -> list[pycolmap.Reconstruction]:
    pycolmap = load_pycolmap()
    with TemporaryDirectory(dir=work) as folder, progress(_PLACED, len(photos.names)):
        options = pycolmap.GlobalPipelineOptions(random_seed=0, num_threads=os.cpu_count() or 1)
        return _usable(pycolmap.global_mapping(database, photos.folder, folder, options))


def _one_by_one(
    database: Path, photos: PhotoFolder, work: Path, thresholds: dict[str, Any]
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapper with thresholds of its own, from the largest snapshot on."""
    pycolmap = load_pycolmap()
    kept = work / SNAPSHOTS
    kept.mkdir(exist_ok=True)
    with TemporaryDirectory(dir=work) as folder, progress(_PLACED, len(photos.names)) as advance:
        options = pycolmap.IncrementalPipelineOptions(
            min_model_size=SMALLEST_MODEL, extract_colors=False, mapper=thresholds,
            random_seed=0, num_threads=os.cpu_count() or 1,
            ba_global_frames_ratio=_GROWTH, ba_global_points_ratio=_GROWTH,
            ba_global_max_num_iterations=_STEPS, ba_global_max_refinements=_REPEATED,
            snapshot_path=kept, snapshot_frames_freq=_SAVED,
        )  # fmt: skip
        begun = _largest_snapshot(kept, database)
        if begun:
            advance(pycolmap.Reconstruction(begun).num_reg_images())
        files = database, photos.folder, folder
        placed = partial(_count, advance, kept)
        found = pycolmap.incremental_mapping(*files, options, begun or "", next_image_callback=placed)
        return _usable(found)


def _usable(found: dict[int, pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Return the models with enough photos, and with points."""
    return [m for m in found.values() if m.num_reg_images() >= SMALLEST_MODEL and m.num_points3D()]


def _count(advance: Callable[[], None], kept: Path) -> None:
    """Count a photo that got a pose, and keep the largest snapshot alone: together they would take disk space
    by the square of the photos."""
    advance()
    for smaller in snapshots(kept)[1:]:
        shutil.rmtree(smaller, ignore_errors=True)


def snapshots(folder: Path) -> list[Path]:
    """List the snapshots of mapping, the largest first."""
    found = folder.glob("*/images.bin")
    return [images.parent for images in sorted(found, key=lambda path: -path.stat().st_size)]


def _largest_snapshot(kept: Path, database: Path) -> Path | None:
    """Find the largest snapshot of mapping that is whole and of the database's photos: COLMAP's library
    crashes on others."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        features = {i.image_id: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}
    for snapshot in snapshots(kept):
        with suppress(UserError, *DAMAGE):  # cut off when the computer stopped
            read_model_files(snapshot)
            found = pycolmap.Reconstruction(snapshot).images
            if all(features.get(number) == image.num_points2D() for number, image in found.items()):
                return snapshot
        shutil.rmtree(snapshot, ignore_errors=True)  # or `_count` would keep it in place of new ones
    return None


def _complete(model: pycolmap.Reconstruction, database: Path, photos: PhotoFolder) -> None:
    """Adjust the cameras once more, so that false matches count less, and add the points that only two photos
    show. The mapper passes over these, since they say little about cameras. But Gaussians start from points,
    and without them thin things are lost. All points are colored here."""
    pycolmap = load_pycolmap()
    adjustment, adjusted = pycolmap.BundleAdjustmentOptions(print_summary=False), model.reg_image_ids()
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = _SOFT
    adjustment.ceres.solver_options.max_num_iterations = _LAST_STEPS
    config = pycolmap.BundleAdjustmentConfig()
    for number in adjusted:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment and triangulate_points turn COLMAP's log on again.
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    with pycolmap.Database.open(database) as db:
        names = {model.image(number).name for number in adjusted}
        options = pycolmap.DatabaseCacheOptions(min_num_matches=LEAST_MATCHES, image_names=names)
        matches = pycolmap.DatabaseCache.create(db, options).correspondence_graph
    two = pycolmap.IncrementalTriangulatorOptions(ignore_two_view_tracks=False, random_seed=0)
    triangulator = pycolmap.IncrementalTriangulator(matches, model)
    for number in adjusted:
        triangulator.triangulate_image(two, number)
    triangulator.complete_all_tracks(two)
    triangulator.merge_all_tracks(two)
    pycolmap.ObservationManager(model, matches).filter_all_points3D(*SOUND)
    model.extract_colors_for_all_images(photos.folder)
