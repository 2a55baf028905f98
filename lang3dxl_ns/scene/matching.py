"""Features of photos and their matches, in COLMAP's database.

Both are stored as they are made, so that an interrupted reconstruction can be resumed.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from lang3dxl_ns.common.console import progress, say, some
from lang3dxl_ns.common.errors import DAMAGE, UserError, is_plain
from lang3dxl_ns.common.files import check_room, content_digest, read_json, replace_file
from lang3dxl_ns.common.memory import machine_memory
from lang3dxl_ns.common.options import data_option
from lang3dxl_ns.common.pictures import open_picture
from lang3dxl_ns.scene.cluster import Step, on_cluster
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.learned_features import LearnedMatcher, extract_learned
from lang3dxl_ns.scene.pairing import ROUNDS, pairs_that_share, pairs_to_match
from lang3dxl_ns.scene.photo_folder import PhotoFolder, find_photos, readable, shared_cameras, walks
from lang3dxl_ns.scene.placements import LEAST_MATCHES
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings

if TYPE_CHECKING:
    import pycolmap

_MEMORY_PER_THREAD = 1e9  # bytes that SIFT takes on a photo of 1600 pixels, the default `max_size`
_MEMORY_PER_PAIR = 5e8
_ENDINGS = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "TIFF": ".tif", "BMP": ".bmp"}
"""Formats that COLMAP reads; others become JPEGs of this quality."""
_QUALITY = 98
_BYTES_PER_FEATURE = 170  # in the database, with its part of the matches
_MOST_EXIF = 65_533  # bytes that a JPEG holds
_LENSES, _USUAL_LENS = (0.2, 10.0), 1.2
"""Focal lengths that lenses have, and that which COLMAP guesses, relative to the longer side."""
_CHUNK_PHOTOS, _CHUNK_PAIRS, _CHUNK_LEARNED = 8, 100, 5  # a step of the bar, which a killed process loses
_STAMP = "photos.json"
SNAPSHOTS = "snapshots"
"""Folder beside the database of what mapping with it has placed so far."""
_TABLES = {"keypoints": 4, "descriptors": 1, "matches": 4, "two_view_geometries": 4}
"""Bytes per value in the database's tables of matrices."""


def usable(photos: PhotoFolder) -> tuple[PhotoFolder, dict[str, str]]:
    """Separate the readable photos, without duplicate files, from the others, for which reasons are given."""
    good, left_out = readable(photos)
    first: dict[str, str] = {}
    for name in good.names:
        if not is_plain(name):  # a COLMAP model can't hold it
            left_out[name] = "its name is not plain text: rename the file"
            continue
        content = _digest(photos.folder / name)
        if first.setdefault(content, name) != name:
            left_out[name] = f"the same file as {first[content]}"
    return PhotoFolder(photos.folder, tuple(first.values())), left_out


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
                exif = exif if len(exif) <= _MOST_EXIF else b""
                image.convert("RGB").save(folder / number, quality=_QUALITY, subsampling=0, exif=exif)
        if not foreign:
            try:
                (folder / number).symlink_to(source.absolute())
            except OSError:  # the disk or system has no links
                shutil.copyfile(source, folder / number)
        numbers.append(number)
    return PhotoFolder(folder, tuple(numbers))


def feature_database(
    photos: PhotoFolder,
    copies: PhotoFolder,
    work: Path,
    settings: ReconstructionSettings,
    earlier: Sequence[Path] = (),
) -> Path:
    """Make the database of photos and cameras, or reuse one with the same photos and settings. A new one has
    the features of photos whose bytes an older one knows, here or in the folders `earlier`."""
    number = dict(zip(photos.names, copies.names, strict=True))
    paths = {name: photos.folder / name for name in photos.names}
    told = [(name, path.stat().st_size, _digest(path), number[name]) for name, path in paths.items()]
    made = [settings.features, settings.max_size, settings.max_features]
    stamp = json.dumps({"photos": told, "features": made, "one_camera": settings.one_camera})
    database, stamped = work / "database.db", work / _STAMP
    if database.is_file() and stamped.is_file() and stamped.read_text() == stamp:
        if _whole(database):
            return database
        say(f"{database} is damaged: features and matches are made anew")
    importing = work / "importing.db"
    for old in work.glob("importing.db*"):
        old.unlink()
    _import(importing, photos, copies, settings.one_camera)
    wanted = {content: name for *_, content, name in told}
    for folder in (work, *earlier):
        _keep_features(folder, importing, wanted, made)
    if earlier:
        say(f"features of {len(told) - len(wanted)} of {len(told)} photos are kept, made with these settings")
    for old in (stamped, *work.glob("database.db*"), *work.glob("xfeat/*")):
        old.unlink(missing_ok=True)
    shutil.rmtree(work / SNAPSHOTS, ignore_errors=True)
    importing.rename(database)
    replace_file(stamped, stamp)
    return database


def _import(database: Path, photos: PhotoFolder, copies: PhotoFolder, one_camera: bool | None) -> None:
    """Make a database of photos and the cameras that took them. Raises UserError if one camera can't have
    taken all."""
    pycolmap, number = load_pycolmap(), dict(zip(photos.names, copies.names, strict=True))
    pycolmap.Database.open(database).close()
    groups = shared_cameras(photos)
    if one_camera is not None:
        groups = [list(photos.names)] if one_camera else [[name] for name in photos.names]
    for group in groups:
        numbers = [number[name] for name in group]
        pycolmap.import_images(database, copies.folder, pycolmap.CameraMode.SINGLE, numbers)
    _correct_lenses(database)
    if one_camera:  # COLMAP passes over photos of another size, and later gives each its own
        with pycolmap.Database.open(database) as db:
            odd = [name for name in photos.names if not db.exists_image(number[name])]
        if odd:
            several = f"{some(odd)} can't share the camera of {photos.names[0]}, which has another size"
            raise UserError(f"{several}: lang3dxl reconstruct without --one-camera, or without them")


def _correct_lenses(database: Path) -> None:
    """Replace focal lengths that no lens has by the usual guess: COLMAP takes EXIF's resolutions of 0 and
    lenses of 1 or 65,535 mm as they are, and then finds no place for the photos."""
    with load_pycolmap().Database.open(database) as db:
        for camera in db.read_all_cameras():
            side = max(camera.width, camera.height)
            if not _LENSES[0] <= camera.focal_length / side <= _LENSES[1]:
                camera.focal_length, camera.has_prior_focal_length = _USUAL_LENS * side, False
                db.update_camera(camera)


def _keep_features(folder: Path, database: Path, wanted: dict[str, str], made: Sequence[str | int]) -> None:
    """Copy features from the database in a folder to a new one, if they were `made` with the same settings.
    Learned ones stay behind. `wanted` maps the digests of photos to their names, and loses what is found."""
    open_database = load_pycolmap().Database.open
    with suppress(*DAMAGE), open_database(database) as new:
        told = read_json(folder / _STAMP)
        known = {content: name for *_, content, name in told["photos"]}
        if told["features"] != made or "xfeat" in made or not _whole(folder / "database.db"):
            return
        with open_database(folder / "database.db") as old:
            for content in known.keys() & wanted:
                source = old.read_image_with_name(known[content]).image_id
                target = new.read_image_with_name(wanted[content]).image_id
                if old.exists_descriptors(source):
                    new.write_descriptors(target, old.read_descriptors(source))
                    new.write_keypoints(target, old.read_keypoints(source))  # last: `extract` looks for them
                    del wanted[content]


def _whole(database: Path) -> bool:
    """Return whether a database is there and undamaged: COLMAP's library trusts the sizes that it tells."""
    if not database.is_file():
        return False
    address = f"{database.absolute().as_uri()}?mode=ro"
    with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(address, uri=True)) as db:
        for table, size in _TABLES.items():
            wrong = f"rows * cols * {size} is not length(data) or cols not in (2, 4, 6, 128)"
            if db.execute(f"select 1 from {table} where rows and ({wrong})").fetchone():
                return False
        return db.execute("pragma quick_check(1)").fetchone() == ("ok",)
    return False


def extract(database: Path, photos: PhotoFolder, settings: ReconstructionSettings) -> None:
    """Extract the features that are missing in the database."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        done = {image.name for image in db.read_all_images() if db.exists_keypoints(image.image_id)}
    missing = [name for name in photos.names if name not in done]
    needed = _BYTES_PER_FEATURE * settings.max_features * len(missing)
    check_room(
        database.parent, needed, f"features of {len(missing)} photos", f"choose {data_option('cache-dir')}"
    )
    if settings.features == "xfeat":
        return extract_learned(database, photos.folder, missing, settings.max_size, settings.max_features)
    memory = _MEMORY_PER_THREAD * (settings.max_size / 1600) ** 2
    step = partial(_extract, photos.folder, settings)
    _in_chunks("features of photos", step, database, missing, _CHUNK_PHOTOS, memory, settings)


def _extract(
    folder: Path, settings: ReconstructionSettings, database: Path, names: Sequence[str], threads: int
) -> None:
    """Extract the features of some photos in so many threads."""
    options = load_pycolmap().FeatureExtractionOptions(
        max_image_size=settings.max_size,
        num_threads=threads,
        sift={
            "max_num_features": settings.max_features,
            "estimate_affine_shape": settings.features == "dsp-sift",
            "domain_size_pooling": settings.features == "dsp-sift",
        },
    )
    load_pycolmap().extract_features(database, folder, names, extraction_options=options)


def _in_chunks(
    what: str,
    step: Step,
    database: Path,
    items: Sequence[Any],
    size: int,
    memory: float,
    settings: ReconstructionSettings,
) -> None:
    """Do a step on items in chunks of a size, here in threads that take so much memory each, or on a
    cluster."""
    chunks = [items[start : start + size] for start in range(0, len(items), size)]
    with progress(what, len(items)) as advance:
        if settings.engine == "ray":
            for chunk in on_cluster(settings, step, database, chunks):
                advance(len(chunk))
            return
        for chunk in chunks:
            step(database, chunk, _threads(memory))
            advance(len(chunk))


def match(
    database: Path,
    photos: PhotoFolder,
    settings: ReconstructionSettings,
    new: Collection[str] | None = None,
    matched: Collection[tuple[str, str]] = (),
) -> None:
    """Find and verify the matches of pairs that are missing in the database.

    Args:
        database: COLMAP's database with the photos' features.
        photos: the photos, by their names in the database.
        settings: as for `reconstruct`.
        new: photos of which each pair must have one; all by default.
        matched: pairs of other photos that are known to match.
    """
    new = set(photos.names if new is None else new)
    with load_pycolmap().Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        known = sorted(n for n in photos.names if n in ids and db.num_keypoints_for_image(ids[n]))
        new.intersection_update(known)
        there = set(known)
        matched = {pair for pair in matched if there.issuperset(pair)}
        learned = LearnedMatcher(database, known) if settings.features == "xfeat" else None
        if learned:
            pairs = learned.pairs()
        else:
            in_time = walks(PhotoFolder(photos.folder, tuple(known)))
            pairs = pairs_to_match(known, lambda name: largest(db, ids[name]), new, in_time)
    tried: set[tuple[str, str]] = set()
    for further in range(1 if learned else 1 + ROUNDS):
        if further:  # without what an interrupted attempt also tried, with which other pairs would share most
            pairs = pairs_that_share(known, tried.union(matched), (tried & _matched(database)).union(matched))
        _match_pairs(database, [pair for pair in pairs if not new.isdisjoint(pair)], settings, learned)
        tried.update(pairs)


def _match_pairs(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    settings: ReconstructionSettings,
    learned: LearnedMatcher | None,
) -> None:
    """Find and verify the matches of those pairs that the database doesn't have."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        has = db.exists_matches, db.exists_two_view_geometry
        missing = [(a, b) for a, b in pairs if not all(there(ids[a], ids[b]) for there in has)]
    if not missing:
        return
    size = _CHUNK_LEARNED if learned else _CHUNK_PAIRS
    step = partial(_match, learned, settings.features == "dsp-sift")
    _in_chunks("pairs of photos", step, database, missing, size, _MEMORY_PER_PAIR, settings)


def _match(
    learned: LearnedMatcher | None,
    guided: bool,
    database: Path,
    pairs: Sequence[tuple[str, str]],
    threads: int,
) -> None:
    """Find and verify the matches of some pairs in so many threads."""
    pycolmap = load_pycolmap()
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    if learned:
        learned.match(pairs)
        pycolmap.verify_matches(database, listed)
    else:
        options = pycolmap.FeatureMatchingOptions(num_threads=threads, guided_matching=guided)
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        pycolmap.match_image_pairs(database, options, pairing)


def largest(database: pycolmap.Database, number: int) -> UInt8[Array, "n 128"]:
    """Read the SIFT descriptors of a photo's features, the largest first."""
    a, b, c, d = database.read_keypoints(number)[:, 2:6].T  # shape, as an affine matrix
    order = np.argsort(-abs(a * d - b * c), kind="stable")
    return database.read_descriptors(number).data[order]


def features_and_partners(database: Path) -> tuple[dict[str, int], Counter[str]]:
    """Count, for every photo, its features and the photos with which it has verified matches."""
    with load_pycolmap().Database.open(database) as db:
        images = {image.name: image.image_id for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(number) for name, number in images.items()}
    return features, Counter(name for pair in _matched(database) for name in pair)


def _matched(database: Path) -> set[tuple[str, str]]:
    """List the pairs of photos with verified matches, each in the order of names."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        images = {image.image_id: image.name for image in db.read_all_images()}
        pairs, inliers = db.read_two_view_geometry_num_inliers()
    matched = (pair for pair, count in zip(pairs, inliers, strict=True) if count >= LEAST_MATCHES)
    named = ([images[i] for i in pycolmap.pair_id_to_image_pair(pair)] for pair in matched)
    return {(min(names), max(names)) for names in named}


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress COLMAP's log of thousands of lines; the report contains what matters."""
    logging = load_pycolmap().logging
    level, logging.minloglevel = logging.minloglevel, int(logging.FATAL)
    try:
        yield
    finally:
        logging.minloglevel = level


def _digest(path: Path) -> str:
    state = path.stat()
    return _read_digest(path, state.st_size, state.st_mtime_ns)


@cache  # duplicates are looked for, then features that are kept
def _read_digest(path: Path, size: int, changed: int) -> str:
    return content_digest(path)


def _threads(memory_each: float) -> int:
    """Return the number of cores, limited by half of the machine's memory."""
    return int(max(1, min(os.cpu_count() or 1, machine_memory() / 2 // memory_each)))


def shows_these(work: Path, data: Path) -> bool:
    """Return whether most photos of the reconstruction in `work` are in the folder `data`, by name and size.
    A cache may be another scene's. The answer is also yes if `work` doesn't tell its photos."""
    try:
        recorded = {(name, size) for name, size, *_ in read_json(work / _STAMP)["photos"]}
    except DAMAGE:
        return True
    photos = find_photos(data)
    there = {name: photos.folder / name for name in photos.names}
    here = {(name, path.stat().st_size) for name, path in there.items() if path.is_file()}
    return 2 * len(recorded & here) > len(recorded)
