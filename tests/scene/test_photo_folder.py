"""Photos are found where people put them; those of one camera share it."""

import os
from itertools import pairwise

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from pycolmap import Database

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene import pairing
from lang3dxl_ns.scene.matching import extract, feature_database
from lang3dxl_ns.scene.pairing import pairs_that_share, pairs_to_match, similar_pairs
from lang3dxl_ns.scene.photo_folder import (
    check_data,
    find_photos,
    mention_passed_over,
    readable,
    shared_cameras,
    walks,
)
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings


def put(path, size=(8, 6), body=None, focal=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if body:
        exif[ExifTags.Base.Model] = body
    if focal:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal
    Image.new("RGB", size).save(path, exif=exif)


@pytest.mark.parametrize(
    ("files", "folder", "names"),
    [
        (["b.jpg", "a.JPG", "notes.txt"], ".", ["a.JPG", "b.jpg"]),
        (["images/a.jpg", "images/more/b.png", "loose.jpg"], "images", ["a.jpg", "more/b.png"]),
        (["day/a.jpg", "night/a.jpg"], ".", ["day/a.jpg", "night/a.jpg"]),
        (["a.jpg", "masks/a.png", "outputs/x/r.png", ".trash/b.jpg"], ".", ["a.jpg"]),
        (["sparse/0/images.bin"], ".", []),
        (["a.jpg", "targets/photos/a.jpg.0123456789abcdef.jpg"], ".", ["a.jpg"]),
        (["a.jpg", "targets/reconstruction/numbered/0.jpg"], ".", ["a.jpg"]),
    ],
    ids=["flat", "images", "sub-folders", "no masks", "none", "no cache", "no reconstruction's copies"],
)
def test_photos_are_found(tmp_path, files, folder, names):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    found = find_photos(tmp_path)
    assert found.folder == tmp_path / folder
    assert list(found.names) == names


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(UserError, match="not a folder"):
        find_photos(tmp_path / "nowhere")


def groups(tmp_path):
    return sorted(map(sorted, shared_cameras(find_photos(tmp_path))))


def test_photos_of_one_size_without_exif_share_a_camera(tmp_path):
    for name in "abc":
        put(tmp_path / f"{name}.jpg")
    assert groups(tmp_path) == [["a.jpg", "b.jpg", "c.jpg"]]


def test_photos_of_several_sizes_without_exif_have_a_camera_each(tmp_path):
    for i, name in enumerate("abc"):
        put(tmp_path / f"{name}.jpg", size=(8, 6 + i // 2))
    assert groups(tmp_path) == [["a.jpg"], ["b.jpg"], ["c.jpg"]]


def test_photos_of_several_sizes_cannot_have_one_camera(tmp_path):
    for i in range(4):
        put(tmp_path / f"{i}.jpg", size=(40 + i % 2, 30))
    photos = find_photos(tmp_path)
    with pytest.raises(UserError, match=r"1\.jpg, 3\.jpg can't share the camera of 0\.jpg"):
        feature_database(photos, photos, tmp_path, ReconstructionSettings(one_camera=True))


def test_each_folder_of_frames_without_exif_has_one_camera(tmp_path):
    """Two videos, and photos of strangers beside them."""
    for folder, sizes in {
        "drone": [(64, 36)] * 3,
        "phone": [(64, 36)] * 2,
        "found": [(30, 20), (20, 30)],
    }.items():
        (tmp_path / folder).mkdir()
        for i, size in enumerate(sizes):
            Image.new("RGB", size).save(tmp_path / folder / f"{i}.jpg")
    groups = shared_cameras(find_photos(tmp_path))
    assert sorted(map(len, groups)) == [1, 1, 2, 3]


def test_panoramas_are_named_and_stereo_pictures_read(tmp_path):
    phone = Image.Exif()
    phone.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.CustomRendered] = 6
    sphere = b'<x:xmpmeta><rdf GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    Image.new("RGB", (60, 40)).save(tmp_path / "sweep.jpg", exif=phone)
    Image.new("RGB", (60, 40)).save(tmp_path / "sphere.jpg", xmp=sphere)
    Image.new("RGB", (160, 40)).save(tmp_path / "stitched.png")
    Image.new("RGB", (90, 40)).save(tmp_path / "wide.png")
    both = [Image.new("RGB", (60, 40), color) for color in ("red", "blue")]
    both[0].save(tmp_path / "stereo.mpo", save_all=True, append_images=both[1:])
    good, bad = readable(find_photos(tmp_path))
    assert set(good.names) == {"wide.png", "stereo.mpo"}
    assert set(bad) == {"sweep.jpg", "sphere.jpg", "stitched.png"}
    assert all("panorama" in why for why in bad.values())


def test_photos_that_would_crash_colmap_are_named(tmp_path):
    for name, size in {"dot.png": (1, 1), "thumb.jpg": (45, 15), "least.png": (48, 16)}.items():
        Image.new("RGB", size).save(tmp_path / name)
    good, bad = readable(find_photos(tmp_path))
    assert good.names == ("least.png",) and set(bad) == {"dot.png", "thumb.jpg"}
    assert "45 × 15 pixels are too few" in bad["thumb.jpg"]
    settings = ReconstructionSettings(features="dsp-sift")
    extract(feature_database(good, good, tmp_path, settings), good, settings)  # smaller ones end the process


def test_exif_tells_cameras_and_zooms_apart(tmp_path):
    put(tmp_path / "a.jpg", body="X", focal=35.0)
    put(tmp_path / "b.jpg", body="X", focal=35.0)
    put(tmp_path / "zoomed.jpg", body="X", focal=70.0)
    put(tmp_path / "other.jpg", body="Y", focal=35.0)
    put(tmp_path / "turned.jpg", size=(6, 8), body="X", focal=35.0)
    assert groups(tmp_path) == [["a.jpg", "b.jpg"], ["other.jpg"], ["turned.jpg"], ["zoomed.jpg"]]


def test_what_a_camera_enlarged_by_itself_has_another_lens(tmp_path):
    for name, zoom, wide in [("a", None, 0), ("b", 1.0, 0), ("c", 2.0, 0), ("d", 2.0, 0), ("e", 2.0, 70)]:
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = "X"
        told = {ExifTags.Base.FocalLength: 6.0, ExifTags.Base.DigitalZoomRatio: zoom}
        told[ExifTags.Base.FocalLengthIn35mmFilm] = wide  # which the zoom is a part of
        exif.get_ifd(ExifTags.IFD.Exif).update({tag: value for tag, value in told.items() if value})
        Image.new("RGB", (8, 6)).save(tmp_path / f"{name}.jpg", exif=exif)
    assert groups(tmp_path) == [["a.jpg", "b.jpg"], ["c.jpg", "d.jpg"], ["e.jpg"]]


def test_few_photos_are_matched_all_with_all():
    assert pairs_to_match(["a", "b", "c"], None, "abc", []) == [("a", "b"), ("a", "c"), ("b", "c")]


def test_similar_photos_find_each_other(monkeypatch):
    """Photos of four places, whose descriptors are drawn around those of their place."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 255, (4, 60, 128))
    names = [f"{i:02d}" for i in rng.permutation(24)]
    described = {
        name: (places[int(name) % 4] + rng.normal(0, 20, (60, 128))).clip(0, 255).astype(np.uint8)
        for name in names
    }
    monkeypatch.setattr(pairing, "ALIKE", 5)
    pairs = similar_pairs(sorted(names), described.__getitem__, names)
    assert {(int(a) - int(b)) % 4 for a, b in pairs} == {0}
    assert len(pairs) == 4 * 15
    new = {"11", "22"}
    found = similar_pairs(sorted(names), described.__getitem__, new)
    assert found == [pair for pair in pairs if not new.isdisjoint(pair)]


def test_photos_that_match_the_same_one_are_paired_unless_they_were():
    matched = {("a", "b"), ("b", "c"), ("c", "d")}
    assert pairs_that_share("abcde", matched, matched) == [("a", "c"), ("b", "d")]
    assert pairs_that_share("abcde", {*matched, ("a", "c")}, matched) == [("b", "d")]


def test_photos_without_features_look_like_no_other():
    same = np.random.default_rng(0).integers(0, 255, (60, 128), dtype=np.uint8)
    described = {"a": same, "b": same[:0], "c": same, "d": same[:0]}
    assert similar_pairs("abcd", described.__getitem__, "abcd") == [("a", "c")]


def test_a_photo_finds_the_one_that_finds_another_first(monkeypatch):
    monkeypatch.setattr(pairing, "ALIKE", 1)
    a, b, c = np.random.default_rng(0).integers(0, 255, (3, 60, 128), dtype=np.uint8)
    described = {"a": a, "b": np.concatenate([a[:20], b[20:]]), "c": np.concatenate([c[:20], a[20:]])}
    assert similar_pairs("abc", described.__getitem__, "abc") == [("a", "b"), ("a", "c")]


def test_large_collections_are_matched_with_neighbors_alone(monkeypatch):
    monkeypatch.setattr(pairing, "EXHAUSTIVE", 20)
    rng = np.random.default_rng(0)
    names = [f"{i:03d}" for i in range(60)]
    described = {name: rng.integers(0, 255, (20, 128), dtype=np.uint8) for name in names}
    walk = [names[i] for i in rng.permutation(60)[:12]]
    pairs = pairs_to_match(names, described.__getitem__, names, [walk])
    assert len(set(pairs)) == len(pairs) < 60 * (20 + 4)
    assert set(pairwise(names)) <= set(pairs)
    assert {tuple(sorted(pair)) for pair in pairwise(walk)} <= set(pairs)


def test_a_walk_is_what_one_camera_took_in_an_hour(tmp_path):
    """Whatever the names; a clock that was never set says nothing of others' photos."""
    taken = {
        "z.jpg": ("X", "2026:05:01 10:00:00", "2"),
        "y.jpg": ("X", "2026:05:01 10:00:00", "15"),
        "a.jpg": ("X", "2026:05:01 10:09:00", None),
        "late.jpg": ("X", "2026:05:02 10:09:01", None),
        "other.jpg": ("Y", "2026:05:01 10:00:01", None),
        "bad.jpg": ("X", "0000:00:00 00:00:00", None),
        "silent.jpg": (None, "2026:05:01 10:00:02", None),
        "timeless.jpg": ("X", None, None),
    }
    for name, (model, time, fraction) in taken.items():
        exif = Image.Exif()
        told = {ExifTags.Base.DateTimeOriginal: time, ExifTags.Base.SubsecTimeOriginal: fraction}
        if model:
            exif[ExifTags.Base.Model] = model
        exif.get_ifd(ExifTags.IFD.Exif).update({tag: value for tag, value in told.items() if value})
        Image.new("RGB", (8, 6)).save(tmp_path / name, exif=exif)
    assert [*walks(find_photos(tmp_path))] == [
        ["y.jpg", "z.jpg", "a.jpg"],
        ["bad.jpg"],
        ["late.jpg"],
        ["other.jpg"],
    ]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp", ".gif"])
@pytest.mark.parametrize("kept", [0.5, 0.95])
def test_a_photo_that_was_not_copied_to_its_end_is_named(tmp_path, suffix, kept):
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    for name in (f"whole{suffix}", f"cut{suffix}"):
        Image.fromarray(noise).save(tmp_path / name)
    content = (tmp_path / f"cut{suffix}").read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(content[: int(kept * len(content))])
    good, bad = readable(find_photos(tmp_path))
    assert good.names == (f"whole{suffix}",)
    assert "damaged" in bad[f"cut{suffix}"]


PLANE = ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneYResolution


@pytest.mark.parametrize(
    "told",
    [
        {ExifTags.Base.FocalLengthIn35mmFilm: 1},
        {ExifTags.Base.FocalLengthIn35mmFilm: 65535},
        dict.fromkeys(PLANE, IFDRational(0, 1)),
        dict.fromkeys(PLANE, IFDRational(0, 0)),
    ],
)
def test_a_focal_length_that_no_lens_has_is_none(tmp_path, told):
    """As scanners, adapters and editors write them; COLMAP would begin with a lens of 0 or of none."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = exif[ExifTags.Base.Model] = "X"
    focal = {ExifTags.Base.FocalLength: 50.0, ExifTags.Base.FocalPlaneResolutionUnit: 2}
    exif.get_ifd(ExifTags.IFD.Exif).update(focal | told)
    Image.new("RGB", (320, 240)).save(tmp_path / "a.jpg", exif=exif)
    photos = find_photos(tmp_path)
    with Database.open(feature_database(photos, photos, tmp_path, ReconstructionSettings())) as db:
        (camera,) = db.read_all_cameras()
    assert camera.focal_length == 1.2 * 320 and not camera.has_prior_focal_length


def test_a_focal_length_that_exif_tells_is_begun_with(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=exif)
    photos = find_photos(tmp_path)
    with Database.open(feature_database(photos, photos, tmp_path, ReconstructionSettings())) as db:
        (camera,) = db.read_all_cameras()
    assert camera.focal_length == pytest.approx(26 / 43.27 * 500, rel=1e-3) and camera.has_prior_focal_length


@pytest.mark.parametrize("place", ["@eaDir/a.jpg", "day/@eaDir", "#recycle", "$RECYCLE.BIN", "Thumbnails"])
def test_thumbnails_and_deleted_photos_are_no_photos(tmp_path, place, capsys):
    for file in ("day/a.jpg", f"{place}/SYNOPHOTO_THUMB_XL.jpg"):
        put(tmp_path / file)
    assert find_photos(tmp_path).names == ("day/a.jpg",)
    mention_passed_over(tmp_path)
    assert not capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "content", "told"),
    [
        ("tour.MOV", b"", "1 videos (give one instead of the folder, or later add it: lang3dxl recon"),
        ("takeout-001.zip", b"", "1 archives (unpack them): takeout-001.zip"),
        (".b.HEIC.icloud", b"", "1 photos that are only in iCloud (download them): .b.HEIC.icloud"),
        ("day/b.jpg_large", b"\xff\xd8\xff\xe0", "1 pictures under other endings (call them .jpg): day/b"),
        ("b.jpg?width=800", b"\x89PNG\r\n", "1 pictures under other endings (call them .jpg): b.jpg?"),
        ("b", b"RIFF\n\0\0\0WEBPVP8 ", "1 pictures under other endings (call them .jpg): b"),
        ("b.jpg.json", b"{}", ""),  # of Google's archives
        ("a.MP4", b"", ""),  # of a phone's photo that moves
        ("a_HEIC.MOV", b"", ""),
        ("a.THM", b"\xff\xd8\xff\xe0", ""),
        ("a.jpg_original", b"\xff\xd8\xff\xe0", ""),
        ("._a.jpg", b"\0\5\x16\7", ""),
        ("Thumbs.db", b"\xd0\xcf\x11\xe0", ""),
        ("a.xmp", b"<x:xmpmeta/>", ""),
    ],
)
def test_what_is_passed_over_though_it_may_hold_photos_is_told(tmp_path, file, content, told, capsys):
    put(tmp_path / "a.jpg")
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_bytes(content)
    assert find_photos(tmp_path).names == ("a.jpg",)
    mention_passed_over(tmp_path)
    said = " ".join(capsys.readouterr().out.split())
    assert told in said and bool(told) == bool(said)


def test_links_to_folders_and_folders_that_may_not_be_read_are_told(tmp_path, capsys, monkeypatch):
    put(tmp_path / "scene/a.jpg")
    put(tmp_path / "elsewhere/b.jpg")
    (tmp_path / "scene/more").symlink_to(tmp_path / "elsewhere")
    walk = os.walk

    def closed(top, onerror=None):
        yield from walk(top, onerror=onerror)
        onerror(PermissionError(13, "no", "closed"))

    monkeypatch.setattr(os, "walk", closed)
    mention_passed_over(tmp_path / "scene")
    told = " ".join(capsys.readouterr().out.split())
    assert "1 links to folders, which are not followed (copy the photos): more" in told
    assert "1 folders that you may not read (allow it, or copy them): closed" in told


@pytest.mark.parametrize("name", ["takeout.zip", "old.wmv"])
def test_a_file_that_is_no_folder_of_photos_is_told_with_the_way_out(tmp_path, name):
    (tmp_path / name).touch()
    (tmp_path / "one.jpg").touch()
    for look in (find_photos, check_data):
        with pytest.raises(UserError, match=rf"{name} is neither a folder nor a video .*unpack or convert"):
            look(tmp_path / name)
        with pytest.raises(UserError, match=rf"one photo: give the folder that holds it .*{tmp_path.name}"):
            look(tmp_path / "one.jpg")
