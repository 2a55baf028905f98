"""Laws of photos at working size: the same as from the file, decoded once."""

import errno
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.working_photos import WorkingPhotos
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.photo import Photo


@pytest.fixture
def photo(tmp_path):
    """A large photo with a mask and distortion, used at a quarter of its side."""
    smooth = Image.fromarray(np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8))
    smooth.resize((1600, 1200), Image.Resampling.BICUBIC).save(tmp_path / "a.jpg", quality=95)
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8) * 5).resize((1600, 1200)).save(
        tmp_path / "m.png"
    )
    lens = Lens(1600, 1200, 1500.0, 1500.0, 800.0, 600.0, (-0.1, 0.0, 0.0, 0.0))
    return Photo("a.jpg", tmp_path / "a.jpg", tmp_path / "m.png", lens).at_most(400)


@pytest.fixture
def working(tmp_path):
    return WorkingPhotos(FeatureStore(tmp_path / "store"))


def copies(tmp_path):
    return sorted(path.parent.name for path in (tmp_path / "store").rglob("*.*"))


def test_a_copy_is_read_like_the_file_which_is_decoded_once(photo, working, tmp_path, monkeypatch):
    expected, mask = photo.read_uint8().float(), photo.read_mask()
    working.read(photo), working.mask(photo)
    assert copies(tmp_path) == ["photo_masks", "photos"]
    monkeypatch.setattr(Photo, "_decoded", None)
    copy = working.read(photo).float()
    assert copy.shape == (300, 400, 3) and (copy - expected).pow(2).mean() < 255**2 / 10**4  # 40 dB
    assert torch.equal(working.mask(photo), mask)
    assert working.read(photo, 0.5).shape == (150, 200, 3) and working.mask(photo, 0.5).shape == (150, 200)


def test_a_changed_file_or_lens_and_a_cut_copy_are_decoded_again(photo, working, tmp_path):
    working.read(photo)
    bent = replace(photo, lens=replace(photo.lens, distortion=()))
    assert (working.read(bent).float() - bent.read_uint8().float()).pow(2).mean() < 6
    Image.new("RGB", (1600, 1200), (9, 9, 9)).save(photo.path)
    assert working.read(bent).max() < 15
    (copy,) = (tmp_path / "store" / "photos").iterdir()
    copy.write_bytes(copy.read_bytes()[:-300])
    assert working.read(bent).max() < 15
    photo.path.unlink()
    with pytest.raises(UserError, match="no file"):
        working.read(bent)


def test_a_file_that_is_read_as_fast_has_no_copy(photo, working, tmp_path):
    plain = replace(photo, mask_path=None, lens=replace(photo.lens.resized(1600, 1200), distortion=()))
    small = replace(plain, path=tmp_path / "small.png")
    Image.new("RGB", (800, 600)).save(small.path)
    for whole in (plain, small.at_most(400)):
        assert torch.equal(working.read(whole), whole.read_uint8())
        assert working.mask(whole) is None
    assert copies(tmp_path) == []


def test_without_room_for_copies_photos_are_read_from_their_files(photo, tmp_path):
    (tmp_path / "file").touch()
    working = WorkingPhotos(FeatureStore(tmp_path / "file" / "store"))
    assert torch.equal(working.mask(photo), photo.read_mask())
    assert working.read(photo).shape == (300, 400, 3)


def test_a_full_disk_is_told_once_and_photos_are_read_nonetheless(photo, working, monkeypatch, capsys):
    def full(path, content):
        raise OSError(errno.ENOSPC, "no space", str(path))

    monkeypatch.setattr("lang3dxl_ns.preparation.store.replace_file", full)
    for _ in range(2):
        assert torch.equal(working.mask(photo), photo.read_mask())
        assert working.read(photo).shape == photo.read_uint8().shape
    assert capsys.readouterr().out.count("decoded anew in every round, which is slow: no space left") == 1
