"""Words for a finished splat, with its photos and without; and back."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from box_splat import box_splat
from moved_splats import transformed, with_colors
from scenes import write_scene

from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.attachment.attach import attach
from lang3dxl_ns.attachment.frames import camera_in
from lang3dxl_ns.attachment.known_frames import known_frames
from lang3dxl_ns.attachment.learn import photos_of, scene_file
from lang3dxl_ns.commands.attach import Attach, _show
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.components.field_settings import CompressionConfig
from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.files.scene_file import write_scene as write_scene_file
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.training.batches import settled
from lang3dxl_ns.words.taught_words import Example

SETTINGS = AttachConfig(views=4, up="z", clip="builtin", dense="builtin", dense_tokens=16)


@pytest.fixture(scope="module", autouse=True)
def quick_codes():
    """Learning codes takes 15 seconds otherwise."""
    with pytest.MonkeyPatch.context() as patch:
        steps, batch, *others = CompressionConfig.__init__.__defaults__
        patch.setattr(CompressionConfig.__init__, "__defaults__", (steps // 10, batch // 6, *others))
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A splat in nerfstudio's frame, its photos, and the scene attached to them."""
    folder = tmp_path_factory.mktemp("attach")
    write_scene(folder / "photos", size=(120, 90), photos=5, points=400)
    photos = open_capture(folder / "photos")
    frame = known_frames(photos.reconstruction, folder / "box.ply")["nerfstudio's, with z up"]
    write_splats(folder / "box.ply", transformed(box_splat(0.1), torch.from_numpy(frame)))
    attach(folder / "box.ply", folder / "photos", folder / "box.scene", SETTINGS)
    return folder


def features(scene) -> np.ndarray:
    return scene.features.astype(np.float32)


@pytest.mark.slow
def test_the_scene_has_the_splats_gaussians_in_their_order_and_answers(place, tmp_path):
    scene, splats = read_scene(place / "box.scene"), read_splats(place / "box.ply")
    torch.testing.assert_close(scene.splats.means, splats.means)
    norms = np.linalg.norm(features(scene), axis=1)
    seen = np.linalg.norm(features(scene), axis=1) > 0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(norms[seen], 1, atol=2e-3)
    match = scene.query("windows", scene.photos[0].name)
    assert match.relevancy.shape == (90, 120)
    count = scene.export(tmp_path / "a.ply", "windows", threshold=0.0, index=tmp_path / "a.npy")
    numbers = np.load(tmp_path / "a.npy")
    assert len(numbers) == count and (np.diff(numbers) > 0).all()
    torch.testing.assert_close(read_splats(tmp_path / "a.ply").means, splats.means[numbers])


@pytest.mark.slow
def test_exported_and_attached_again_it_has_the_same_words_and_nothing_is_encoded_twice(place, capsys):
    first = read_scene(place / "box.scene")
    first.export(place / "again.ply")
    capsys.readouterr()
    second = attach(place / "again.ply", place / "photos", place / "again.scene", SETTINGS)
    assert "preparing" not in capsys.readouterr().out
    a, b = features(first), features(second)
    seen = (np.linalg.norm(a, axis=1) > 0) & (np.linalg.norm(b, axis=1) > 0)
    assert seen.mean() > 0.5
    assert float((a[seen] * b[seen]).sum(1).mean()) > 0.99


@pytest.mark.slow
def test_written_over_a_scene_it_keeps_the_words_that_were_taught(place):
    path = place / "taught.scene"
    scene = read_scene(place / "box.scene")
    photo = Example(scene.photos[0].name, box=(30, 30, 80, 60))
    write_scene_file(path, scene.teach("gizmo", photo))
    attach(place / "box.ply", place / "photos", path, SETTINGS)
    assert len(read_scene(path).words["gizmo"].examples) == 1


@pytest.mark.slow
def test_pictures_are_named_after_the_texts_that_they_show(place, tmp_path):
    _show(read_scene(place / "box.scene"), ["windows", "towers"], tmp_path / "box.scene")
    assert {path.name for path in tmp_path.iterdir()} == {"box.windows.png", "box.towers.png"}


@pytest.mark.slow
def test_without_photos_the_splat_is_its_own(place):
    scene = attach(place / "box.ply", None, place / "alone.scene", SETTINGS)
    assert len(scene.photos) == 4
    assert (place / ".alone.views" / "images" / "0000.png").is_file()
    assert float(scene.codes.isfinite().all(1).float().mean()) > 0.5


def test_a_splat_in_one_place_is_refused(tmp_path):
    splats = box_splat(0.1)
    write_splats(
        tmp_path / "one.ply", replace(splats, means=splats.means[:1].expand_as(splats.means).clone())
    )
    with pytest.raises(UserError, match="lie within 0 units of one place"):
        attach(tmp_path / "one.ply", None, tmp_path / "one.scene", SETTINGS)


def test_a_splat_in_map_coordinates_is_refused(tmp_path):
    splats = box_splat(0.1)
    far = replace(splats, means=splats.means + torch.tensor([4e5, 5e6, 0]))
    write_splats(tmp_path / "far.ply", far)
    with pytest.raises(UserError, match=r"5,015,9.. units from the origin.* without the offset"):
        attach(tmp_path / "far.ply", None, tmp_path / "far.scene", SETTINGS)


def test_a_splat_too_far_for_the_file_to_write_is_refused_before_any_work(tmp_path):
    splats = box_splat(0.1)
    splats.means[0] = 9e6
    write_splats(tmp_path / "far.ply", splats)
    with pytest.raises(UserError, match="these reach 9,000,000"):
        attach(tmp_path / "far.ply", None, tmp_path / "far.spz", replace(SETTINGS, clip="absent/clip"))


def test_photos_are_opened_with_the_reconstruction_that_the_cache_keeps(place, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    shutil.copytree(place / "photos" / "images", tmp_path / "photos")
    shutil.copytree(place / "photos" / "sparse", cache / "reconstruction" / "sparse")
    found = {}
    monkeypatch.setattr("lang3dxl_ns.attachment.attach._frame", lambda _, photos, *__: found.update(a=photos))
    with pytest.raises(TypeError):  # there is no frame
        attach(place / "box.ply", tmp_path / "photos", None, replace(SETTINGS, cache_dir=cache))
    assert len(found["a"].photos) == 5 and not (tmp_path / "photos" / "lang3dxl_cache").exists()


def test_a_damaged_splat_is_told_before_encoders_are_looked_for(tmp_path):
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    with pytest.raises(UserError, match=r"cut\.ply is damaged"):
        attach(tmp_path / "cut.ply", None, tmp_path / "a.scene", replace(SETTINGS, clip="absent/clip"))


def test_settings_of_views_beside_photos_are_told(tmp_path):
    command = Attach(splat=tmp_path / "a.ply", data=tmp_path, out=tmp_path / "a.scene", views=8)
    with pytest.raises(UserError, match="--views and --up choose views of the splat"):
        command.main()


class Upper:
    """A segmenter that finds the upper half of every picture."""

    def segment(self, image, prompts):
        return torch.arange(len(image))[:, None].expand(image.shape[:2]) < len(image) // 2


@pytest.mark.slow
def test_a_segmented_word_is_kept_in_the_scene(place, monkeypatch):
    monkeypatch.setattr("lang3dxl_ns.attachment.attach.find_text_segmenter", lambda *names: names)
    monkeypatch.setattr("lang3dxl_ns.attachment.attach.load_text_segmenter", lambda *_: Upper())
    config = replace(SETTINGS, segment=("upper part",))
    attach(place / "box.ply", place / "photos", place / "segmented.scene", config)
    scene = read_scene(place / "segmented.scene")
    assert list(scene.words) == ["upper part"] and scene.words["upper part"].examples


def test_a_segmenter_that_is_not_there_is_told_before_any_work(place, tmp_path):
    config = replace(SETTINGS, segment=["windows"], foreground_model=str(tmp_path / "none"))
    with pytest.raises(UserError, match="--foreground-model"):
        attach(place / "box.ply", place / "photos", tmp_path / "a.scene", config)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_photos_of_something_else_are_refused_with_a_picture(place):
    splats = read_splats(place / "box.ply")
    noise = torch.rand(len(splats), 3, generator=torch.Generator().manual_seed(0))
    write_splats(place / "other.ply", with_colors(splats, noise))
    with pytest.raises(UserError, match="don't show this splat"):
        attach(place / "other.ply", place / "photos", place / "other.scene", SETTINGS)
    assert (place / "other.frame.png").is_file()
    assert not (place / "other.scene").exists()


def test_mistakes_are_told_before_a_model_is_downloaded_and_an_empty_text_before_the_work(
    tmp_path, monkeypatch
):
    config = replace(SETTINGS, clip="somebody/nothing")
    with pytest.raises(UserError, match=r"nothing\.ply does not exist"):
        attach(tmp_path / "nothing.ply", None, tmp_path / "a.scene", config)
    (tmp_path / "some.ply").touch()
    with pytest.raises(UserError, match=r"typo is not a folder"):
        attach(tmp_path / "some.ply", tmp_path / "typo", tmp_path / "a.scene", config)
    with pytest.raises(OSError, match="exists"):
        attach(tmp_path / "some.ply", tmp_path, tmp_path / "some.ply" / "a.scene", config)
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(UserError, match="is read-only: choose another place"):
        attach(tmp_path / "some.ply", tmp_path, tmp_path / "a.scene", config)
    with pytest.raises(UserError, match="prompt is empty"):
        Attach(splat=tmp_path / "nothing.ply", out=tmp_path / "a.scene", text=["dome", " "]).main()


@pytest.mark.parametrize(
    ("splat", "data", "out", "message"),
    [
        ("nothing.ply", None, "a.scene", "does not exist"),
        ("nothing.ply", None, "a.ply", "must have the extension .scene"),
        ("nothing.ply", None, None, "name the file to write"),
    ],
)
def test_mistakes_end_in_a_sentence_before_any_work(splat, data, out, message, tmp_path):
    with pytest.raises(UserError, match=message):
        attach(tmp_path / splat, data, None if out is None else tmp_path / out, SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_settings_that_attaching_does_not_read_and_impossible_words_are_told_before_the_work(tmp_path):
    for config in (replace(SETTINGS, crops="pyramid"), replace(SETTINGS, regions="felzenszwalb")):
        with pytest.raises(UserError, match="leave --crops and --regions off"):
            config.check()
    with pytest.raises(UserError, match="leave --clip none off"):
        attach(tmp_path / "a.ply", tmp_path, tmp_path / "a.scene", replace(SETTINGS, clip="none"))
    config = replace(SETTINGS, segment=[" ; "])
    with pytest.raises(UserError, match="the prompt is empty"):
        attach(tmp_path / "a.ply", tmp_path, tmp_path / "a.scene", config)


def test_large_photos_are_prepared_at_the_requested_size(tmp_path):
    write_scene(tmp_path / "photos", size=(320, 240), photos=3, points=200, coarseness=4)
    config = settled(replace(SETTINGS, longer_side=120), learned=False, gathered=True)
    capture = open_capture(tmp_path / "photos")
    data = photos_of(capture, np.eye(4), config, tmp_path / "cache", "cpu")
    targets = data.targets
    assert list(data.photos) == capture.names
    assert {(photo.width, photo.height) for photo in data.photos.values()} == {(120, 90)}
    assert targets.clip(targets.names[0]).features.shape[0] < targets.clip(targets.names[0]).features.shape[1]


def test_a_damaged_photo_is_left_out_of_the_scene_and_others_are_listed_as_they_are_gathered(
    tmp_path, monkeypatch
):
    write_scene(tmp_path / "photos", size=(120, 90), photos=3, points=200)
    capture = open_capture(tmp_path / "photos")
    damaged, *others = capture.photos
    damaged.path.write_bytes(damaged.path.read_bytes()[:900])
    monkeypatch.setattr("lang3dxl_ns.attachment.learn.LONGER_SIDE", 80)
    whole = np.diag([2.0, 2.0, 2.0, 1.0])
    data = photos_of(
        capture, whole, settled(SETTINGS, learned=False, gathered=True), tmp_path / "cache", "cpu"
    )
    record = scene_file(data)
    assert [photo.name for photo in record.photos] == [photo.name for photo in others]
    assert {(photo.camera.width, photo.camera.height) for photo in record.photos} == {(80, 60)}
    assert {photo.split for photo in record.photos} == {"train"} and record.scale == pytest.approx(2)
    for photo in record.photos:
        expected = camera_in(whole, capture.reconstruction.photos[photo.name])
        torch.testing.assert_close(photo.camera.view_matrix, expected.view_matrix, atol=1e-5, rtol=0)
