"""Pictures and COLMAP models of strangers."""

import io
import os
import shutil
import struct
import subprocess

import numpy as np
import pycolmap
import pytest
from PIL import Image
from runs import make_trainer, train_run
from scenes import write_scene

from lang3dxl_ns import cli
from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import FORMATS, NoPictureError, open_picture
from lang3dxl_ns.evaluation.layouts import read_gray
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.preparation import photo_cache
from lang3dxl_ns.preparation.foreground import with_foreground
from lang3dxl_ns.preparation.regions import _read_labels
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.companions import companion, inside
from lang3dxl_ns.scene.photo_folder import find_photos, readable, shared_cameras
from lang3dxl_ns.scene.video import extract_frames
from lang3dxl_ns.training.checkpoint import alone_in

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 72\n%%EndComments\n(trap) run\n%%EOF\n"


@pytest.fixture
def folder(tmp_path):
    return write_scene(tmp_path / "scene", photos=4, points=40)


def used(folder):
    parser = PhotoCollectionDataParserConfig(data=folder).setup()
    parser.get_dataparser_outputs(split="train")
    return {photo.name: photo for photo in parser.capture.photos}


def save_as(path, form):
    """A photo in another format under its old name; to memory, since Pillow would take the suffix for it."""
    content = io.BytesIO()
    Image.open(path).convert("F" if form == "SPIDER" else "RGB").save(content, form)
    path.write_bytes(content.getvalue())


@pytest.mark.parametrize("form", ["EPS", "DDS", "SPIDER", "TGA", "PPM", "ICO", "PCX"])
def test_a_photo_in_another_format_than_those_named_is_left_out(folder, form, capsys):
    path = folder / "images" / "photo_001.jpg"
    if form == "EPS":
        path.write_bytes(EPS)
    else:
        save_as(path, form)
    assert set(used(folder)) == {"photo_000.jpg", "photo_002.jpg", "photo_003.jpg"}
    assert "not a picture in one of the formats JPEG" in " ".join(capsys.readouterr().out.split())


def test_ghostscript_is_never_asked(tmp_path, monkeypatch):
    (tmp_path / "a.jpg").write_bytes(EPS)
    monkeypatch.setattr("PIL.EpsImagePlugin.EpsImageFile.load", lambda *_: pytest.fail("EPS was opened"))
    for read in (lambda path: read_gray(path), lambda path: _read_labels(path, "a")):
        with pytest.raises(UserError, match="not a picture in one of the formats"):
            read(tmp_path / "a.jpg")


@pytest.mark.parametrize("form", [form for form in FORMATS if form != "HEIF"])  # which Pillow can't write
def test_every_format_that_is_named_is_read(folder, form):
    path = folder / "images" / "photo_001.jpg"
    save_as(path, form)
    photo = used(folder)["photo_001.jpg"]
    assert photo.read().shape == (72, 96, 3)


@pytest.mark.parametrize("form", ["AVIF", "DDS", "SPIDER", "WEBP", "TIFF", "GIF"])
def test_a_damaged_file_of_any_format_is_left_out_and_does_not_end_the_run(folder, form, capsys):
    path = folder / "images" / "photo_001.jpg"
    save_as(path, form)
    content = path.read_bytes()
    for cut in (20, len(content) // 3, len(content) - 30):
        path.write_bytes(content[:cut])
        photo = used(folder).get("photo_001.jpg")
        if photo is not None:  # its head is whole
            with pytest.raises(UserError, match=r"photo_001\.jpg"):
                photo.read()
    capsys.readouterr()


def test_what_decoders_raise_is_one_error(tmp_path, monkeypatch):
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    for error in (RuntimeError, KeyError, struct.error, ZeroDivisionError, OverflowError):

        def fail(*_, kind=error):
            raise kind("damaged")

        monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.load", fail)
        with pytest.raises(NoPictureError), open_picture(tmp_path / "a.png") as image:
            image.convert("RGB")


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_an_empty_label_map_is_named(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape, np.int64))
    with pytest.raises(UserError, match=r"a\.npy holds .* not one whole"):
        _read_labels(tmp_path / "a.npy", "a.jpg")


def test_a_symlink_loop_among_photos_is_passed_over(folder, capsys):
    (folder / "images" / "loop").symlink_to(folder / "images")
    (folder / "images" / "self.jpg").symlink_to(folder / "images" / "self.jpg")
    photo = folder / "images" / "photo_001.jpg"
    photo.unlink()
    photo.symlink_to(photo)
    assert set(used(folder)) == {"photo_000.jpg", "photo_002.jpg", "photo_003.jpg"}
    assert "photo_001.jpg" in capsys.readouterr().out


def test_photos_to_reconstruct_are_of_the_named_formats_too(tmp_path):
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg")
    (tmp_path / "b.jpg").write_bytes(EPS)
    os.mkfifo(tmp_path / "c.jpg")
    good, bad = readable(find_photos(tmp_path))
    assert good.names == ("a.jpg",)
    assert "formats JPEG" in bad["b.jpg"] and "not a file" in bad["c.jpg"]


def test_a_gif_that_ends_early_is_not_reconstructed_from(tmp_path):
    Image.effect_noise((40, 30), 90).save(tmp_path / "a.gif")
    content = (tmp_path / "a.gif").read_bytes()
    (tmp_path / "b.gif").write_bytes(content[: len(content) // 2])
    good, bad = readable(find_photos(tmp_path))
    assert good.names == ("a.gif",) and "damaged" in bad["b.gif"]


def test_damaged_exif_is_no_exif(tmp_path):
    for i, tail in enumerate((b"", b"II*\0" + b"\xff" * 40, b"MM\0*\0\0\0\x08\xff\xff" + b"\1" * 60)):
        Image.new("RGB", (40, 30)).save(tmp_path / f"{i}.jpg", exif=b"Exif\0\0" + tail)
    assert len(shared_cameras(find_photos(tmp_path))) == 1


PLAYLISTS = {
    "playlist": "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\n{secret}\n#EXT-X-ENDLIST\n",
    "list": "ffconcat version 1.0\nfile '{secret}'\n",
}


@pytest.mark.parametrize("kind", PLAYLISTS)
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_a_video_can_not_name_other_files(tmp_path, kind):
    """A playlist under the name of a video would have its frames taken from any file of this machine."""
    secret = tmp_path / "secret.mp4"
    made = ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", "testsrc=duration=2:size=64x48", str(secret)]
    subprocess.run(made, check=True)
    assert len(list((extract_frames(secret) / "images").iterdir())) == 4
    (tmp_path / "walk.mp4").write_text(PLAYLISTS[kind].format(secret=secret))
    with pytest.raises(UserError, match=r"walk\.mp4 is not a video.*: copy it again, or convert it"):
        extract_frames(tmp_path / "walk.mp4")


@pytest.mark.parametrize("factor", [2, None])
def test_names_of_photos_never_reach_nerfstudios_shell(folder, factor):
    parser = PhotoCollectionDataParserConfig(data=folder, downscale_factor=factor).setup()
    with pytest.raises(UserError, match="--downscale-factor is"):
        parser.get_dataparser_outputs(split="train")


# ── models ──────────────────────────────────────────────────────────────────────────────────────────────


def change_points(folder, xyz):
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for i in list(model.points3D):
        if xyz is None:
            model.delete_point3D(i)
        else:
            model.points3D[i].xyz = np.array(xyz)
    model.write_binary(folder / "sparse" / "0")


@pytest.mark.parametrize("xyz", [None, [np.nan] * 3, [np.inf, 0, 0], [1e300] * 3])
def test_training_without_usable_points_says_so(folder, xyz, tiny_clip, tiny_dense, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["ns-train"])
    change_points(folder, xyz)
    trainer = make_trainer(folder, tiny_clip, tiny_dense, tmp_path / "out", 2, semantics=False)
    with pytest.raises(UserError, match=r"has 0 3D points.*--pipeline.model.random-init True"):
        trainer.setup()


def test_training_without_points_can_start_at_random(folder, tiny_clip, tiny_dense, tmp_path):
    change_points(folder, None)
    random = {"pipeline__model__random_init": True, "pipeline__model__num_random": 500}
    trainer = train_run(folder, tiny_clip, tiny_dense, tmp_path / "out", 2, **random)
    assert trainer.pipeline.model.means.isfinite().all()


def test_one_point_at_the_end_of_the_world_is_left_out(folder, capsys):
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    first = next(iter(model.points3D.values()))
    first.xyz = np.array([1e300, 0, 0])
    model.write_binary(folder / "sparse" / "0")
    assert np.abs(read_reconstruction(folder / "sparse" / "0").points).max() < 10
    assert "1 points of" in capsys.readouterr().out


def test_photos_whose_names_are_not_utf8_are_left_out_and_named(folder, capsys):
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"photo_001.jpg", b"ph\xf6to_01.jpg"))
    assert set(used(folder)) == {"photo_000.jpg", "photo_002.jpg", "photo_003.jpg"}
    assert "its name is not UTF-8" in " ".join(capsys.readouterr().out.split())


def test_a_placeholder_of_one_pixel_is_prepared(tmp_path, tiny_clip, tiny_dense, capsys):
    folder = write_scene(tmp_path / "scene", photos=4, points=60, size=(40, 40))
    Image.new("RGB", (1, 1)).save(folder / "images" / "photo_001.jpg")
    cli.main(["prepare", "--data", str(folder), "--clip", str(tiny_clip), "--dense", str(tiny_dense)])
    assert "Targets of 4 photos" in capsys.readouterr().out


@pytest.mark.parametrize("name", [b"a\x1b[2J\r\n_.jpg", b"\x1b]0;title\x07.jpg"])
def test_names_of_photos_can_not_command_the_terminal(folder, capsys, name):
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"photo_001.jpg", name.ljust(13, b"_")))
    (folder / "images" / "photo_\x1b[2J.jpg").write_bytes(b"")
    assert set(used(folder)) == {"photo_000.jpg", "photo_002.jpg", "photo_003.jpg"}
    said = capsys.readouterr().out
    assert "control characters" in said and "\x1b" not in said and "\\x1b" in said
    assert "\n_.jpg" not in said


def test_messages_never_command_the_terminal(capsys):
    assert (
        str(UserError("photo a\x1b[2J\x9b\r\ud800: é 日本\n b"))
        == r"photo a\x1b[2J\x9b\r\ud800: é 日本" + "\n b"
    )
    say("a\x1b[2J")
    assert capsys.readouterr().out == "a\\x1b[2J\n"


def test_a_camera_of_billions_of_pixels_is_refused(folder):
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for camera in model.cameras.values():
        camera.width, camera.height = 70_000, 40_000
    model.write_binary(folder / "sparse" / "0")
    with pytest.raises(UserError, match=r"photo_000\.jpg has an impossible camera"):
        read_reconstruction(folder / "sparse" / "0")


# ── photos that vanish while training runs ──────────────────────────────────────────────────────────────


@pytest.fixture
def training(tmp_path, tiny_clip, tiny_dense, monkeypatch):
    """A run of colors that reads every photo anew, and its photos' folder; nobody waits."""
    monkeypatch.setattr(photo_cache, "PATIENCE_S", (0.0, 0.0, 0.0))
    data = write_scene(tmp_path / "scene", photos=9, points=60)
    options = {"pipeline__datamanager__cache_gb": 0.0, "pipeline__datamanager__read_ahead": 0}
    trainer = make_trainer(data, tiny_clip, tiny_dense, tmp_path / "out", 40, semantics=False, **options)
    trainer.setup()
    return trainer, data / "images"


def during(trainer, step, what):
    """Do something before an iteration."""
    iterate = trainer.train_iteration

    def train_iteration(now):
        if now == step:
            what()
        return iterate(now)

    trainer.train_iteration = train_iteration


def test_photos_that_vanish_end_the_training_with_a_checkpoint_and_no_scene(training, tmp_path):
    trainer, photos = training
    during(trainer, 11, lambda: photos.rename(tmp_path / "gone"))
    with pytest.raises(UserError, match=r"2 of 7 training photos.*Stopped after 11 iterations.*--load-dir"):
        trainer.train()
    assert [path.name for path in trainer.checkpoint_dir.iterdir()][-1:] == ["step-000000010.ckpt"]
    assert not list(trainer.base_dir.glob("*.scene"))


def test_a_run_that_another_command_trains_is_left_alone(training):
    trainer, _ = training
    with alone_in(trainer.base_dir), pytest.raises(UserError, match="another command trains in"):
        trainer.train()
    assert not list(trainer.checkpoint_dir.glob("*.ckpt"))


def test_photos_that_come_back_are_waited_for(training, tmp_path, monkeypatch, capsys):
    trainer, photos = training
    waits = []

    def sleep(seconds):
        waits.append(seconds)
        if (tmp_path / "gone").exists():
            (tmp_path / "gone").rename(photos)

    during(trainer, 11, lambda: photos.rename(tmp_path / "gone"))
    monkeypatch.setattr(photo_cache.time, "sleep", sleep)
    trainer.train()
    assert waits and "retrying" in " ".join(capsys.readouterr().out.split())
    assert not trainer.pipeline.datamanager.data._left_out


def test_a_photo_that_is_damaged_is_not_waited_for(training, monkeypatch):
    trainer, photos = training
    shutil.copy(__file__, photos / "photo_001.jpg")
    monkeypatch.setattr(photo_cache.time, "sleep", lambda _: pytest.fail("waited"))
    trainer.train()
    assert len(trainer.pipeline.datamanager.data._left_out) == 1


# ── masks ───────────────────────────────────────────────────────────────────────────────────────────────


def masks(folder, colors):
    """The photos with masks of these colors; None: a damaged file."""
    (folder / "masks").mkdir()
    for i, color in enumerate(colors):
        path = folder / "masks" / f"photo_{i:03d}.png"
        Image.new("L", (8, 6), color or 0).save(path)
        if color is None:
            path.write_bytes(path.read_bytes()[:40])
    return list(used(folder).values())


def masked(photos, folder, **options):
    found = with_foreground(photos, PreparationConfig(**options), folder, folder / "cache", "cpu")
    return {photo.name for photo in found if photo.mask_path is not None}


def test_damaged_masks_are_named_all_at_once_and_left_out_where_asked(folder, capsys):
    photos = masks(folder, [None, 255, None, 255])
    with pytest.raises(
        UserError, match=r"2 masks can't be read: .*photo_000\.png .*photo_002\.png .*--skip-damaged-masks"
    ):
        masked(photos, folder)
    assert masked(photos, folder, skip_damaged_masks=True) == {"photo_001.jpg", "photo_003.jpg"}
    said = capsys.readouterr().out
    assert "2 masks can't be read" in said and "photo_002.jpg" in said


def test_masks_and_label_maps_that_are_pipes_are_refused(tmp_path):
    for suffix in (".png", ".npy"):
        os.mkfifo(tmp_path / f"a.jpg{suffix}")
        with pytest.raises(UserError, match="not a regular file"):
            companion(tmp_path, "a.jpg", [suffix])


def test_masks_that_are_all_dark_are_said_to_be(folder, capsys):
    photos = masks(folder, [0, 100, 0, 0])
    with pytest.raises(UserError, match=r"all 4 masks are dark \(the brightest pixel has 100"):
        masked(photos, folder)
    Image.new("L", (8, 6), 255).save(folder / "masks" / "photo_002.png")
    masked(photos, folder)
    assert "the masks of 3 photos are black or dark" in capsys.readouterr().out


def test_a_name_too_long_for_a_file_is_one_error(tmp_path):
    """Asking the system for such a file raises an error of its own."""
    for name in ("n" * 300, f"a/{'ä' * 200}.jpg"):
        with pytest.raises(UserError, match="too long for a file's name"):
            inside(tmp_path, name)
