"""Foreground masks from a folder or from prompts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_models import make_tiny_clipseg

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation import foreground
from lang3dxl_ns.preparation.foreground import with_foreground
from lang3dxl_ns.preparation.segmentation import ClipSeg
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.masks import MaskFolder
from lang3dxl_ns.scene.photo import Photo

NAMES = ["north/a.png", "north/b.png", "c.png"]


@pytest.fixture(scope="module")
def clipseg(tmp_path_factory):
    return str(make_tiny_clipseg(tmp_path_factory.mktemp("models") / "clipseg"))


@pytest.fixture
def config(clipseg):
    return PreparationConfig(foreground="text", foreground_model=clipseg, foreground_prompts=("tower", "sky"))


@pytest.fixture
def photos(tmp_path):
    return [make_photo(tmp_path, name, seed) for seed, name in enumerate(NAMES)]


@pytest.fixture
def seen(monkeypatch):
    """Sizes of the images that the network has seen."""
    sizes, segment = [], ClipSeg.segment

    def counting(self, image, prompts):
        sizes.append(tuple(image.shape))
        return segment(self, image, prompts)

    monkeypatch.setattr(ClipSeg, "segment", counting)
    return sizes


def make_photo(folder, name, seed, size=(40, 30)):
    path = folder / "images" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return Photo(name, path, None, Lens(*size, fx=40.0, fy=43.0, cx=size[0] / 2, cy=size[1] / 2))


def make_mask(path, size=(8, 6), bright=200):
    """Bright on the right half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = Image.new("L", size, 60)
    mask.paste(bright, (size[0] // 2, 0, *size))
    mask.save(path)


def run(photos, config, folder, **options):
    return with_foreground(photos, config, folder, folder / "cache", "cpu", **options)


def test_a_folder_gives_masks_of_any_size_and_the_log_names_photos_without(photos, tmp_path, capsys):
    make_mask(tmp_path / "kept" / "north" / "a.png", size=(8, 6))
    make_mask(tmp_path / "kept" / "c.png.png", size=(400, 300))
    masked = run(photos, PreparationConfig(foreground="kept"), tmp_path)
    right = (torch.arange(40) >= 20).expand(30, 40)
    assert torch.equal(masked[0].read_mask(), right)
    assert torch.equal(masked[2].read_mask(), right)
    assert masked[1].read_mask() is None  # the whole photo
    assert capsys.readouterr().out == "1 of 3 photos have no mask and are used whole: north/b.png\n"


def test_masks_are_links_out_of_their_folder_only_where_links_are_followed(photos, tmp_path):
    make_mask(tmp_path / "elsewhere" / "c.png")
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "c.png").symlink_to(tmp_path / "elsewhere" / "c.png")
    config = PreparationConfig(foreground="kept")
    with pytest.raises(UserError, match="leads out of"):
        run(photos, config, tmp_path)
    masked = run(photos, config, tmp_path, follow_links=True)
    assert [photo.mask_path is None for photo in masked] == [True, True, False]


def test_auto_keeps_what_the_data_has_and_none_drops_it(photos, tmp_path, capsys):
    make_mask(tmp_path / "masks" / "c.png")
    found = [replace(photo, mask_path=MaskFolder(tmp_path / "masks").find(photo.name)) for photo in photos]
    assert run(found, PreparationConfig(), tmp_path) == found
    assert "north/a.png, north/b.png" in capsys.readouterr().out
    assert run(found, PreparationConfig(foreground="none"), tmp_path) == photos
    assert run(photos, PreparationConfig(), tmp_path) == photos
    assert not capsys.readouterr().out  # without any mask there is no message
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_is_not_there_or_fits_nothing_is_a_users_error(photos, tmp_path):
    with pytest.raises(UserError, match=r"foreground kept: there is no folder"):
        run(photos, PreparationConfig(foreground="kept"), tmp_path)
    (tmp_path / "kept").mkdir()
    with pytest.raises(UserError, match=r"no mask in .*kept.*north/a\.png"):
        run(photos, PreparationConfig(foreground="kept"), tmp_path)


def test_words_give_the_networks_masks(photos, config, tmp_path):
    masked = run(photos, config, tmp_path)
    from lang3dxl_ns.preparation.segmentation import find_text_segmenter, load_text_segmenter

    segmenter = load_text_segmenter(find_text_segmenter(config.foreground_model, config.sam), "cpu")
    for photo in masked:
        assert photo.mask_path.suffix == ".png"
        expected = segmenter.segment(photo.read_uint8(), ["tower", "sky"])
        assert torch.equal(photo.read_mask(), expected)
        assert 0 < expected.float().mean() < 1


def test_masks_of_a_distorting_lens_lie_on_the_file(config, tmp_path, seen):
    """So they are undistorted once, with the photo; large photos are shrunk for the network alone."""
    photo = make_photo(tmp_path, "wide.png", 0, (2000, 1500))
    photo = replace(photo, lens=replace(photo.lens, distortion=(0.2, 0.0, 0.0, 0.0)))
    (masked,) = run([photo], config, tmp_path)
    assert seen == [(768, 1024, 3)]
    with Image.open(masked.mask_path) as image:
        assert image.size == (1024, 768)
    assert masked.read_mask().shape == (1500, 2000)


def test_a_second_run_makes_nothing_and_reads_neither_network_nor_photos(
    photos, config, tmp_path, seen, monkeypatch
):
    first = run(photos, config, tmp_path)
    assert len(seen) == 3
    monkeypatch.setattr(foreground, "load_text_segmenter", None)
    monkeypatch.setattr(Photo, "content_hash", lambda _: pytest.fail("a photo was read"))
    assert run(photos, config, tmp_path) == first
    assert len(seen) == 3


def test_only_what_a_change_concerns_is_made_again(photos, config, tmp_path, seen):
    masked = run(photos, config, tmp_path)
    make_photo(tmp_path, NAMES[1], seed=9)  # another photo under the old name
    content = masked[2].mask_path.read_bytes()
    masked[2].mask_path.write_bytes(content[:-20])  # a damaged mask
    seen.clear()
    assert run(photos, config, tmp_path) == masked
    assert len(seen) == 2
    assert masked[2].mask_path.read_bytes() == content
    seen.clear()
    run(photos, replace(config, foreground_prompts=("sky", "tower")), tmp_path)
    assert seen == []  # the order of prompts means nothing
    run(photos, replace(config, foreground_prompts=("tower",)), tmp_path)
    assert len(seen) == 3


def test_an_interrupted_run_goes_on_where_it_stopped(photos, config, tmp_path, seen, monkeypatch):
    write = FeatureStore.write_bytes

    def interrupted(self, path, *rest):
        if "north_b" in path.name:
            raise KeyboardInterrupt
        write(self, path, *rest)

    monkeypatch.setattr(FeatureStore, "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(photos, config, tmp_path)
    monkeypatch.setattr(FeatureStore, "write_bytes", write)
    seen.clear()
    assert all(photo.mask_path.is_file() for photo in run(photos, config, tmp_path))
    assert len(seen) == 2


def test_a_photo_in_which_nothing_is_found_counts_whole_and_is_named(
    photos, config, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(ClipSeg, "segment", lambda self, image, _: torch.zeros(image.shape[:2]) > 0)
    assert all(photo.read_mask().all() for photo in run(photos, config, tmp_path))
    assert "found nothing in 3 photos, which are used whole: north/a.png" in capsys.readouterr().out


def test_an_unreadable_photo_has_no_mask_and_affects_no_other(photos, config, tmp_path, seen):
    photos[0].path.write_bytes(b"not a photo")
    photos[1].path.unlink()
    masked = run(photos, config, tmp_path)
    assert [photo.mask_path for photo in masked[:2]] == [None, None]
    assert masked[2].mask_path.is_file()
    assert len(seen) == 1


def test_words_are_needed(photos, config, tmp_path):
    with pytest.raises(UserError, match="foreground-prompts"):
        run(photos, replace(config, foreground_prompts=()), tmp_path)


def test_masks_of_other_prompts_stay(photos, config, tmp_path):
    first = run(photos, config, tmp_path)
    kept = [photo.mask_path.read_bytes() for photo in first]
    other = replace(config, foreground_prompts=("roof",))
    second = run(photos, other, tmp_path)
    assert not {photo.mask_path for photo in first} & {photo.mask_path for photo in second}
    assert [photo.mask_path.read_bytes() for photo in first] == kept
