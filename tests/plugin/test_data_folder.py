"""`--data` may be photos alone, a video, or a folder with a transforms.json."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scenes import speckled, write_scene
from scipy.spatial.transform import Rotation

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import locked
from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManagerConfig
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig, parser_for
from lang3dxl_ns.scene.capture import Capture
from lang3dxl_ns.scene.layout import images_folder
from lang3dxl_ns.scene.video import _RESIZED, _duration, _looks, _sharpest, _write, extract_frames

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Photos of a speckled box, flat in a folder."""
    folder = tmp_path_factory.mktemp("walk")
    write_scene(folder / "scene", photos=8, size=(240, 180), paint=speckled)
    return folder / "scene" / "images"


def datamanager(data, **changes):
    config = Lang3DXLDataManagerConfig(data=data, clip="none", dense="none", **changes)
    return config.setup(device="cpu", test_mode="val")


def test_photos_that_are_held_out_are_told(tmp_path, capsys, monkeypatch):
    datamanager(write_scene(tmp_path / "scene", photos=3))
    assert "1 of 3 photos are held out of training" in " ".join(capsys.readouterr().out.split())
    monkeypatch.setattr(Capture, "contradicted", {"photo_001.jpg": "its matches"})  # in neither split
    datamanager(tmp_path / "scene", dataparser=PhotoCollectionDataParserConfig(eval_mode="all"))
    assert "held out" not in capsys.readouterr().out


def test_a_flat_folder_of_photos_is_all_that_training_needs(walk, tmp_path):
    data = shutil.copytree(walk, tmp_path / "data")
    before = {path.name: path.stat().st_mtime_ns for path in data.iterdir()}
    manager = datamanager(data)
    assert len(manager.data.photos) == 8
    assert {name: (data / name).stat().st_mtime_ns for name in before} == before
    assert {path.name for path in data.iterdir()} - set(before) == {"sparse", "lang3dxl_cache"}
    again = datamanager(data)  # finds the model, and the photos beside it
    assert list(again.data.photos) == list(manager.data.photos)
    assert (
        again.train_dataset.cameras.camera_to_worlds == manager.train_dataset.cameras.camera_to_worlds
    ).all()


def test_sub_folders_of_photos_are_read_with_their_model(walk, tmp_path):
    for i, path in enumerate(sorted(walk.iterdir())):
        (tmp_path / "data" / f"day{i % 2}").mkdir(parents=True, exist_ok=True)
        shutil.copy(path, tmp_path / "data" / f"day{i % 2}" / path.name)
    manager = datamanager(tmp_path / "data")
    assert {name.split("/")[0] for name in manager.data.photos} == {"day0", "day1"}


def test_a_run_whose_model_is_gone_gets_no_other_one(walk, tmp_path):
    data = shutil.copytree(walk, tmp_path / "data")
    with pytest.raises(UserError, match="no COLMAP model"):
        datamanager(data, run=tmp_path)
    assert not (data / "sparse").exists()


def test_the_model_of_other_photos_in_a_shared_cache_is_not_used(walk, tmp_path):
    """Their names are the same. A read-only folder's model lies in the cache."""
    data, work = shutil.copytree(walk, tmp_path / "data"), tmp_path / "cache" / "reconstruction"
    shutil.copytree(write_scene(tmp_path / "other", photos=3) / "sparse", work / "sparse")
    parser, own = PhotoCollectionDataParserConfig(data=data), []
    for folder in (tmp_path / "other" / "images", walk):
        recorded = [[path.name, path.stat().st_size, 0] for path in folder.iterdir()]
        (work / "photos.json").write_text(json.dumps({"photos": recorded}))
        own.append(parser_for(parser, tmp_path / "cache", False).colmap_path == work / "sparse" / "0")
        parser.colmap_path = PhotoCollectionDataParserConfig().colmap_path
    assert own == [False, True]


def write_transforms(data, count=12):
    """A row of photos with a transforms.json."""
    data.mkdir()
    frames = []
    for i in range(count):
        Image.fromarray(np.full((6, 8, 3), 20 * i, np.uint8)).save(data / f"{i}.png")
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0.3, 0.02 * i, -0.1]).as_matrix()
        pose[:3, 3] = [i, 0.2 * i * i, 3]
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}
    moved = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]}
    (data / "transforms.json").write_text(json.dumps({**lens, **moved, "frames": frames}))
    return data


def test_a_folder_with_transforms_is_read_in_nerfstudios_frame_and_splits_by_our_rule(tmp_path):
    data = write_transforms(tmp_path / "data")
    theirs = NerfstudioDataParserConfig(data=data)
    ours = parser_for(PhotoCollectionDataParserConfig(data=data), None, True)
    poses = []
    for parser in (theirs, ours):
        outputs = [parser.setup().get_dataparser_outputs(split) for split in ("train", "val")]
        names = [path.name for part in outputs for path in part.image_filenames]
        placed = torch.cat([part.cameras.camera_to_worlds for part in outputs])
        poses.append(dict(sorted(zip(names, placed, strict=True))))
    torch.testing.assert_close(*poses, atol=1e-5, rtol=1e-5)
    assert [path.name for path in outputs[1].image_filenames] == [*poses[1]][::8]
    manager = datamanager(data)
    assert len(manager.train_dataset) + len(manager.eval_dataset) == 12


def test_nerfstudios_other_readers_are_refused_with_the_way_out(tmp_path):
    with pytest.raises(
        UserError, match="BlenderDataParserConfig is not read here: leave the dataparser's name"
    ):
        parser_for(BlenderDataParserConfig(data=write_transforms(tmp_path / "data")), None, True)


def make_video(photos, path):
    command = ["ffmpeg", "-v", "error", "-framerate", "2", "-i", str(photos / "photo_%03d.jpg"), "-r", "8"]
    subprocess.run([*command, "-q:v", "2", str(path)], check=True)
    return path


@needs_ffmpeg
def test_a_video_becomes_a_folder_of_frames_and_a_model(walk, tmp_path):
    video = make_video(walk, tmp_path / "walk.mp4")
    parser = parser_for(PhotoCollectionDataParserConfig(data=video), None, True)
    assert parser.data == tmp_path / "walk_photos"
    assert len(list((parser.data / "images").iterdir())) == 8  # four seconds, two frames of each
    assert (parser.data / parser.colmap_path / "images.bin").is_file()
    video.unlink()  # a run goes on without it
    again = parser_for(PhotoCollectionDataParserConfig(data=video), None, False)
    assert (again.data, again.colmap_path) == (parser.data, parser.colmap_path)


@needs_ffmpeg
def test_frames_of_another_video_are_not_taken_for_this_ones(walk, tmp_path):
    video = make_video(walk, tmp_path / "walk.mp4")
    folder = extract_frames(video)
    assert extract_frames(video) == folder
    with pytest.raises(UserError, match=r"frames of another video: rename walk\.mov"):
        extract_frames(make_video(walk, tmp_path / "walk.mov"))
    video.write_bytes(video.read_bytes() + b"more")
    with pytest.raises(UserError, match="frames of another video"):
        extract_frames(video)


@needs_ffmpeg
def test_what_is_typed_while_frames_are_read_is_no_command_to_ffmpeg(walk, tmp_path, monkeypatch):
    """A script may feed its other commands by the same standard input."""
    for program in ("ffmpeg", "ffprobe"):  # which reads its input first: ffmpeg looks at it now and then
        greedy = tmp_path / program
        greedy.write_text(f'#!/bin/sh\ncat > /dev/null\nexec {shutil.which(program)} "$@"\n')
        greedy.chmod(0o755)
    video, typed, own = make_video(walk, tmp_path / "walk.mp4"), tmp_path / "typed", os.dup(0)
    typed.write_text("q" * 10)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with typed.open() as file:
        os.dup2(file.fileno(), 0)
        try:
            frames = list((extract_frames(video) / "images").iterdir())
            left = os.read(0, 20)
        finally:
            os.dup2(own, 0)
            os.close(own)
    assert len(frames) == 8 and left == b"q" * 10


def test_an_empty_images_folder_does_not_hide_the_photos(walk, tmp_path):
    data = shutil.copytree(walk, tmp_path / "data")
    (data / "images").mkdir()
    (data / "images" / ".DS_Store").touch()
    assert images_folder(data, data / "sparse" / "0") == data


@needs_ffmpeg
def test_a_videos_place_may_have_a_percent_sign(tmp_path):
    """As in names that were copied from an address. ffmpeg takes one for the place of a number."""
    (tmp_path / "My%20Videos 100%d").mkdir()
    video = tmp_path / "My%20Videos 100%d" / "a%d.mkv"
    graph = ["-f", "lavfi", "-i", "testsrc=size=64x48:rate=10:duration=1", "-c:v", "mjpeg"]
    subprocess.run(["ffmpeg", "-v", "error", *graph, str(video)], check=True)
    frames = extract_frames(video)
    assert frames.parent == video.parent and len(list((frames / "images").iterdir())) == 2


@needs_ffmpeg
@pytest.mark.parametrize(
    ("name", "rate", "filters"),
    [("a.mp4", 30, "null"), ("a.mkv", 30, "select='not(mod(n,3))+gt(n,30)'"), ("a.avi", 2, "null")],
    ids=["steady", "unsteady", "slow, in ticks of half a second"],
)
def test_each_frame_of_a_video_is_looked_at_and_written_once(tmp_path, name, rate, filters):
    """By options that ffmpeg has long had: -fps_mode came in 5.1."""
    graph = ["-f", "lavfi", "-i", f"testsrc=size=64x48:rate={rate},trim=end_frame=60", "-vf", filters]
    command = ["ffmpeg", "-v", "error", *graph, "-fps_mode", "vfr", str(tmp_path / name)]
    subprocess.run(command, check=True)
    sharpness, _ = _looks(tmp_path / name)
    assert len(sharpness) == (40 if "select" in filters else 60)
    _write(tmp_path / name, tmp_path / "frames", np.arange(len(sharpness)))
    assert len(list((tmp_path / "frames/images").iterdir())) == len(sharpness)


@needs_ffmpeg
@pytest.mark.parametrize("fields", ["null", "interlace=lowpass=0"], ids=["whole", "interlaced"])
def test_an_interlaced_video_has_frames_without_combs(tmp_path, fields):
    """Stripes that move sideways: rows of one moment are alike."""
    graph = (
        f"color=black:size=64x48:rate=50,format=gray,geq=lum='128+100*sin(X/5+N)',{fields},trim=end_frame=9"
    )
    how = ["-c:v", "mpeg2video", "-q:v", "1", *(["-flags", "+ildct+ilme"] if fields != "null" else [])]
    subprocess.run(
        ["ffmpeg", "-v", "error", "-f", "lavfi", "-i", graph, *how, str(tmp_path / "a.mpg")], check=True
    )
    _write(tmp_path / "a.mpg", tmp_path / "frames", np.arange(2, 6))
    for path in (tmp_path / "frames/images").iterdir():
        with Image.open(path) as image:
            rows = np.asarray(image.convert("L")).astype(float)
        assert np.abs(np.diff(rows, axis=0)).mean() < 5 < np.abs(np.diff(rows, axis=1)).mean()


@needs_ffmpeg
@pytest.mark.parametrize(
    ("transfer", "pale"), [("arib-std-b67", True), ("smpte2084", True), ("bt709", False)]
)
def test_that_a_video_is_hdr_is_told(tmp_path, transfer, pale, capsys):
    graph = ["-f", "lavfi", "-i", "testsrc=size=64x48:rate=5,trim=end_frame=5"]
    how = ["-c:v", "ffv1", "-color_trc", transfer]
    subprocess.run(["ffmpeg", "-v", "error", *graph, *how, str(tmp_path / "a.mkv")], check=True)
    assert _duration(tmp_path / "a.mkv") == pytest.approx(1, abs=0.3)
    assert ("a.mkv is HDR" in capsys.readouterr().out) is pale


@needs_ffmpeg
def test_a_video_that_changes_its_size_is_told(tmp_path):
    film = tmp_path / "turned.mts"
    for size in ("64x48", "48x64"):
        graph = ["-f", "lavfi", "-i", f"testsrc=size={size}:rate=25,trim=end_frame=30", "-f", "mpegts", "-"]
        part = subprocess.run(["ffmpeg", "-v", "error", *graph], check=True, capture_output=True).stdout
        film.write_bytes((film.read_bytes() if film.exists() else b"") + part)
    with pytest.raises(UserError, match=r"turned.mts changes its size from 64 x 48 to 48 x 64 pixels"):
        _looks(film)
    other_color = "filter context - w: 64 h: 48 fmt: 0 csp: a, incoming frame - w: 64 h: 48 fmt: 4 csp: b "
    assert _RESIZED.search(other_color * 20_000) is None  # at once


@needs_ffmpeg
def test_what_ffmpeg_says_of_a_video_that_it_cannot_read_is_told(tmp_path):
    with pytest.raises(UserError, match=r"ffmpeg can't read .*a\.mp4 \(.*No such file.*copy it again"):
        _looks(tmp_path / "a.mp4")


@needs_ffmpeg
def test_a_video_whose_name_is_in_another_encoding_is_told(tmp_path):
    video = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.mp4"))
    video.write_bytes(b"not a video")
    with pytest.raises(UserError, match=r"caf.*\.mp4 is not a video that ffmpeg reads"):
        extract_frames(video)


@needs_ffmpeg
def test_a_second_command_that_reads_the_same_video_ends_at_once(walk, tmp_path):
    film = make_video(walk, tmp_path / "walk.mp4")
    with locked(tmp_path / "walk_photos"), pytest.raises(UserError, match="another command writes frames"):
        extract_frames(film)


def test_a_video_without_ffmpeg_is_an_error_that_names_it(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").touch()
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(UserError, match="ffmpeg isn't installed"):
        extract_frames(tmp_path / "a.mp4")


def test_of_every_stretch_the_sharpest_frame_is_taken():
    sharpness = np.array([1, 5, 2, 9, 0, 3, 4.0])
    for steady in (np.zeros(7), np.ones(7)):
        assert _sharpest(sharpness, steady, 3).tolist() == [1, 3, 6]


def test_where_much_changes_more_frames_are_taken():
    """Somebody stands still for half of the time, and then turns; a flash at the start changes nothing."""
    change = np.repeat([0.0, 1.0], 500)
    sharpness = np.random.default_rng(0).random(1000)
    flash = change.copy()
    flash[1:3] = 1e6
    for motion in (change, flash):
        chosen = _sharpest(sharpness, motion, 40)
        assert len(chosen) == 40
        assert 8 <= (chosen < 500).sum() <= 12  # a quarter


@needs_ffmpeg
def test_change_is_seen_in_a_video_in_spite_of_its_noise(tmp_path):
    still = "color=gray:size=320x180:rate=10:duration=2,noise=alls=20:allf=t"
    moving = "testsrc2=size=320x180:rate=10:duration=2"
    graph = f"{still}[a];{moving}[b];[a][b]concat"
    subprocess.run(["ffmpeg", "-v", "error", "-f", "lavfi", "-i", graph, str(tmp_path / "a.mp4")], check=True)
    _, change = _looks(tmp_path / "a.mp4")
    assert len(change) == 40
    assert np.median(change[21:]) > 5 * np.median(change[1:20])


@pytest.mark.parametrize("other", ["cache/reconstruction/sparse/0/images.bin", "scene/transforms.json"])
def test_a_misspelled_model_is_not_replaced_by_the_caches_or_by_transforms(tmp_path, other):
    data = write_scene(tmp_path / "scene", photos=3, points=30)
    (tmp_path / other).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / other).write_text("{}")
    parser = PhotoCollectionDataParserConfig(data=data, colmap_path=Path("sparse/geo"))
    chosen = parser_for(parser, tmp_path / "cache", True)
    assert chosen is parser and chosen.colmap_path == Path("sparse/geo")
