"""Files of others: caches and exports don't follow links, nothing of theirs is overwritten or deleted."""

import json
import os
import stat
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_scene import CHANNELS, encode_texts, painted_scene

from lang3dxl_ns import load_scene, train
from lang3dxl_ns.attachment.views import rendered_views
from lang3dxl_ns.commands.teach import forgotten
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import file_locked, locked, replace_file, set_aside
from lang3dxl_ns.components.decoders import DecoderConfig, make_decoder
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.files.scene_file import Provenance, read_scene, replace_scene, write_scene
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene import video
from lang3dxl_ns.scene.add_photos import add_photos
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.scene.companions import cache_folder, work_folder
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.record import same_clip
from lang3dxl_ns.scene.video import frames_folder
from lang3dxl_ns.web.write_page import Page, write_page
from lang3dxl_ns.words.taught_words import Example, TaughtWord, load_words, mask_of, save_words

SETTINGS = {"rule": 1}


def stored_scene(**changes):
    """A scene that a file can hold: the painted one with random weights of the default decoder."""
    torch.manual_seed(0)
    decoder = make_decoder(DecoderConfig(name="gathered"), SemanticFieldConfig(preset="short"), CHANNELS, 0)
    codes = torch.randn(len(painted_scene().splats), 3)
    return painted_scene(decoder=decoder.requires_grad_(False), codes=codes, **changes)


@pytest.fixture
def word():
    scene = stored_scene()
    vector = torch.ones(scene.decoder.clip_dim)
    return TaughtWord("gizmo", vector, 0.0, 0.0, 0.1, clip=scene.file.clip_identity)


@pytest.mark.parametrize("dangling", [False, True])
def test_our_names_replace_links_and_pipes_and_never_follow_them(tmp_path, dangling):
    theirs, ours, pipe = tmp_path / "theirs", tmp_path / "ours", tmp_path / "pipe"
    if not dangling:
        theirs.write_text("precious")
    ours.symlink_to(theirs)
    os.mkfifo(pipe)
    for path in (ours, pipe):
        replace_file(path, "cache")
        assert path.read_text() == "cache" and not path.is_symlink()
    assert dangling != theirs.exists() and (dangling or theirs.read_text() == "precious")


def test_caches_of_a_scene_and_pages_replace_links(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    write_scene(tmp_path / "a.scene", stored_scene())
    (tmp_path / ".a.visible").symlink_to(precious)
    assert read_scene(tmp_path / "a.scene", "cpu", encode_texts=encode_texts).visible
    write_page(Page(painted_scene()), tmp_path / "page")
    (tmp_path / "page" / "page.css").unlink()
    (tmp_path / "page" / "page.css").symlink_to(precious)
    write_page(Page(painted_scene()), tmp_path / "page")
    assert precious.read_text() == "mine"


def test_a_store_enters_no_linked_folder(tmp_path):
    other, store = FeatureStore(tmp_path / "other"), FeatureStore(tmp_path / "own")
    other.write("clip", "a.jpg", {"x": torch.ones(3)}, SETTINGS)
    store.write("clip", "b.jpg", {"x": torch.ones(3)}, SETTINGS)
    (store.root / "zz").symlink_to(other.root / "clip")
    assert "zz" not in store.sizes()
    assert other.read("clip", "a.jpg")["x"].sum() == 3
    with pytest.raises(UserError, match="is a link"):
        store.write("zz", "a.jpg", {"x": torch.ones(3)}, SETTINGS)


def test_a_cache_that_came_as_a_link_is_refused_and_a_named_one_is_the_users(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "lang3dxl_cache").symlink_to(tmp_path / "theirs")
    with pytest.raises(UserError, match=rf"is a link: .*cache-dir {tmp_path}/theirs"):
        cache_folder(tmp_path / "data", None)
    linked = tmp_path / "data" / "lang3dxl_cache"
    assert cache_folder(tmp_path / "data", linked) == linked
    assert cache_folder(tmp_path, None) == tmp_path / "lang3dxl_cache"


IN_CACHES = [
    *("", "xfeat", "numbered", "dsp-sift", "adding", "sparse", "xfeat/000000.safetensors", "pairs.txt"),
    *("database.db", "adding/database.db", "adding/pairs.txt", "dsp-sift/importing.db-journal"),
]


@pytest.mark.parametrize("place", IN_CACHES)
@pytest.mark.parametrize("call", [reconstruct_scene, lambda data: add_photos(data, data)])
def test_who_made_a_scene_chooses_no_file_that_a_reconstruction_writes_or_deletes(tmp_path, place, call):
    linked = tmp_path / "data/lang3dxl_cache/reconstruction" / place
    linked.parent.mkdir(parents=True)
    (tmp_path / "theirs").mkdir()
    linked.symlink_to(tmp_path / "theirs")
    with pytest.raises(UserError, match=rf"{linked} is a link"):
        call(tmp_path / "data")
    assert not list((tmp_path / "theirs").iterdir())


def test_a_reconstructions_own_links_to_photos_are_no_fault_and_a_pipe_is_not_waited_for(tmp_path):
    work = work_folder(tmp_path, None)
    (work / "adding/numbered").mkdir(parents=True)
    (work / "adding/numbered/000000.jpg").symlink_to(tmp_path / "photo.jpg")
    assert work_folder(tmp_path, None) == work
    os.mkfifo(work / "pairs.txt")
    with pytest.raises(UserError, match=r"pairs\.txt is a link or pipe"):
        work_folder(tmp_path, None)


@pytest.mark.parametrize("name", ["", "images", "images/0000.png", "views.json"])
def test_views_of_a_splat_go_through_no_link_that_came_with_its_scene(tmp_path, name):
    folder, splats = tmp_path / ".a.views", painted_scene().splats
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).symlink_to(tmp_path)
    with pytest.raises(UserError, match="is a link"):
        rendered_views(splats, 4, "z", folder)


@pytest.mark.parametrize("name", ["lang3dxl_cache", ".images.partial"])
def test_frames_of_a_video_go_through_no_link(tmp_path, name, monkeypatch):
    folder = frames_folder(tmp_path / "a.mp4")
    folder.mkdir()
    (folder / name).symlink_to(tmp_path)
    monkeypatch.setattr(video.shutil, "which", lambda _: "ffmpeg")
    monkeypatch.setattr(video, "_duration", lambda _: 1.0)
    monkeypatch.setattr(video, "_looks", lambda _: (np.arange(4.0), np.zeros(4)))
    with pytest.raises(UserError, match="is a link"):
        video.extract_frames(tmp_path / "a.mp4")


@pytest.mark.parametrize("path", ["a" * 5000, "a/" * 3000, "a\0.scene", "a" * 300 + ".ply"])
def test_what_is_no_path_is_told_in_one_line_wherever_one_is_given(path):
    calls = (load_scene, open_capture, read_splats, painted_scene().export, train)
    for call in calls:
        with pytest.raises(UserError, match=r"is not a path .*: choose a shorter name"):
            call(path)


def test_a_command_that_waits_for_another_says_so(tmp_path, capsys):
    """The other may have been stopped by Ctrl-Z."""
    told, done = threading.Event(), threading.Event()

    def wait():
        with file_locked(tmp_path / "a.scene"):
            done.set()

    with file_locked(tmp_path / "a.scene"):
        threading.Thread(target=wait, daemon=True).start()
        for _ in range(500):
            if "Waiting for another command that writes in" in capsys.readouterr().out:
                told.set()
                break
            time.sleep(0.01)
        assert told.is_set() and not done.is_set()
    assert done.wait(5)


@pytest.mark.parametrize("number", ["1" * 5000, "²", "0", "-1", ""])
def test_forgetting_an_example_that_no_number_names_is_one_line(number, word):
    scene = painted_scene().with_words([replace(word, vector=torch.ones(CHANNELS))])
    with pytest.raises(UserError, match="was not taught: lang3dxl words lists"):
        forgotten(scene, f"gizmo/{number}")


def test_modes_stay(tmp_path):
    path = tmp_path / "a.scene"
    write_scene(path, stored_scene())
    path.chmod(0o600)
    replace_scene(path, stored_scene(), Provenance())
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("content", [b"no scene at all", b"", "cut", "newer"])
def test_what_is_no_scene_of_ours_is_kept_beside_the_new_one(tmp_path, content, capsys):
    path = tmp_path / "a.scene"
    write_scene(path, stored_scene())
    whole = path.read_bytes()
    newer = whole.replace(b'version\\":1', b'version\\":7', 1)
    assert newer != whole
    content = {"cut": whole[: len(whole) // 2], "newer": newer}.get(content, content)
    path.write_bytes(content)
    for _ in range(2):
        replace_scene(path, stored_scene(), Provenance())
    assert (tmp_path / "a.scene.old").read_bytes() == content
    assert capsys.readouterr().out.count("The file is kept as") == 1
    assert len(read_scene(path, "cpu").splats) and len(list(tmp_path.glob("*.scene"))) == 1
    path.write_bytes(b"another")
    assert set_aside(path).name == "a.scene.old2"


def test_words_that_a_scene_without_words_replaces_wait_in_it_or_are_kept_beside_it(tmp_path, word, capsys):
    """A training's scene has only colors until its end; one without a CLIP has them for good."""
    path, whole = tmp_path / "a.scene", stored_scene()
    write_scene(path, whole.with_words([word]))
    so_far = painted_scene(decoder=None, codes=None)
    for _ in range(2):
        replace_scene(path, so_far, Provenance())
        assert list(read_scene(path, "cpu").words) == ["gizmo"]
    replace_scene(path, whole, Provenance())
    assert list(read_scene(path, "cpu").words) == ["gizmo"] and not list(tmp_path.glob("*.json"))
    colors = painted_scene(decoder=None, codes=None, file=replace(whole.file, clip=None, clip_identity=None))
    replace_scene(path, colors, Provenance())
    assert [kept.name for kept in load_words(tmp_path / "a.gizmo.json")] == ["gizmo"]
    assert "is lost" in (said := capsys.readouterr().out) and f"kept in {tmp_path / 'a.gizmo.json'}" in said


def test_a_lock_is_the_files_whichever_link_names_it(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.scene").touch()
    (tmp_path / "link.scene").symlink_to(tmp_path / "real" / "a.scene")
    with (
        file_locked(tmp_path / "link.scene"),
        pytest.raises(UserError, match="busy"),
        locked(tmp_path / "real", busy="busy"),
    ):
        pass


def test_words_are_not_saved_over_another_file(tmp_path, word):
    for name, content in (
        ("transforms.json", '{"frames": []}'),
        ("newer.json", '{"version": 9, "words": []}'),
    ):
        (tmp_path / name).write_text(content)
        with pytest.raises(UserError, match="is another file"):
            save_words(tmp_path / name, [word])
        assert (tmp_path / name).read_text() == content
    save_words(tmp_path / "words.json", [word])
    save_words(tmp_path / "words.json", [word, replace(word, name="other")])
    assert len(load_words(tmp_path / "words.json")) == 2


@pytest.mark.parametrize(
    ("size", "counts"),
    [
        ([4, 4], [2**63 - 1, 2**63 - 1, 18]),  # their sum is 16 in 64 bits
        ([4, 4], [-1, 17]),
        ([4, 4], [0] * 1_000 + [16]),
        ([1, 179_000_000], [0, 179_000_000]),
        ([13_416, 13_416], [0, 13_416**2]),
    ],
)
def test_masks_are_bounded_before_they_are_made(tmp_path, word, size, counts):
    example = {"photo": "a", "points": [], "not_points": [], "mask": {"size": size, "counts": counts}}
    described = word.to_json() | {"examples": [example]}
    (tmp_path / "a.json").write_text(json.dumps({"version": 1, "words": [described]}))
    with pytest.raises(UserError, match="is not a file of taught words"):
        load_words(tmp_path / "a.json")
    many = {**example, "mask": {"size": [1024, 1024], "counts": [0, 1 << 20]}}
    drawn = {**example, "size": [40, 30], "outlines": [[[1, 1], [20, 1], [20, 20]]]}
    del drawn["mask"]
    for one in (many, drawn):
        described = word.to_json() | {"examples": [one] * 1_025}
        (tmp_path / "b.json").write_text(json.dumps({"version": 1, "words": [described]}))
        with pytest.raises(UserError, match="its masks are too large"):
            load_words(tmp_path / "b.json")
    assert Example.from_json(drawn).mask.mean() == pytest.approx(19 * 19 / 2 / 40 / 30, rel=0.02)
    for outline in ([[1, 1], [1e30, 1], [9, 9]], [[1, 1], [float("nan"), 1], [9, 9]], [[1, 1, 1]], [], 3):
        with pytest.raises((ValueError, TypeError)):
            Example.from_json(drawn | {"outlines": [outline]})
    assert np.array_equal(mask_of([1, 2, 1], (2, 2)), [[False, True], [True, False]])


@pytest.mark.parametrize(
    "change", [{"text": -5.0}, {"text": 1e9}, {"doubt": 7.0}, {"doubt": -3.0}, {"clip": "x"}]
)
def test_a_word_with_impossible_numbers_or_of_another_clip_is_refused(tmp_path, word, change):
    scene = stored_scene().with_words([word])
    write_scene(tmp_path / "a.scene", scene)
    assert "gizmo" in read_scene(tmp_path / "a.scene", "cpu").words
    write_scene(tmp_path / "a.scene", stored_scene().with_words([replace(word, **change)]))
    with pytest.raises(UserError, match="a word"):
        read_scene(tmp_path / "a.scene", "cpu")


def test_a_scene_whose_gaussians_all_have_some_nan_is_refused(tmp_path):
    scene = stored_scene()
    means = scene.splats.means.clone()
    means[:, 0] = torch.nan
    write_scene(tmp_path / "a.scene", stored_scene(splats=replace(scene.splats, means=means)))
    with pytest.raises(UserError, match="no Gaussian whose values are all numbers"):
        read_scene(tmp_path / "a.scene", "cpu")


def test_clips_with_another_tokenizer_differ_but_earlier_fingerprints_fit():
    assert same_clip("aa.bb", "aa.bb") and same_clip("aa", "aa.bb") and same_clip("aa.bb", "aa")
    assert not same_clip("aa.bb", "aa.cc") and not same_clip("aa", "cc.bb") and same_clip(None, None)
    assert not same_clip(None, "aa")
