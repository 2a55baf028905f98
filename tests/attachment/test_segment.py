"""Words taught by a segmenter: a stand-in that finds what is painted in one gray, and errs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_scene import painted_scene

from lang3dxl_ns.attachment.segment import _share as share_of
from lang3dxl_ns.attachment.segment import segmented
from lang3dxl_ns.query.match import save_picture
from lang3dxl_ns.scene.camera import resized
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.words.learn_word import MARK_SIDE

DOME = 1 / 3
"""Brightness of the dome in photos."""


class Grays:
    """Finds one gray; in some of its photos it marks the opposite."""

    def __init__(self, gray: float, wrong: tuple[int, ...] = ()) -> None:
        self.gray, self.wrong, self.count = gray, wrong, 0

    def segment(self, image, prompts):
        mask = (image.float().mean(-1) / 255 - self.gray).abs() < 0.1
        self.count += 1
        return ~mask if self.count - 1 in self.wrong else mask


@pytest.fixture(scope="module")
def scene():
    return painted_scene()


@pytest.fixture(scope="module")
def photos(scene, tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("photos"), []
    for photo in scene.photos:
        save_picture(scene.render(photo.name).pixels, folder / photo.name)
        found.append(Photo(photo.name, folder / photo.name, None, photo.lens))
    return found


def taught(scene, photos, segmenter):
    cameras = {photo.name: photo.full_camera for photo in scene.photos}
    return segmented(scene, "finial", segmenter, photos, cameras)


@pytest.mark.parametrize("wrong", [(), (1,), (2,), (3,)])
def test_a_word_is_found_where_most_photos_show_it(scene, photos, wrong):
    new = taught(scene, photos, Grays(DOME, wrong))
    assert list(new.words) == ["finial"] and not scene.words
    assert not np.array_equal(scene.find("finial").gaussians, scene.find("dome").gaussians)
    np.testing.assert_array_equal(new.find("finial").gaussians, scene.find("dome").gaussians)


def test_its_masks_are_kept_as_examples_of_photos_that_show_it(scene, photos):
    (word,) = taught(scene, photos, Grays(DOME)).words.values()
    assert {example.photo for example in word.examples} <= {photo.name for photo in photos}
    assert all(example.mask is not None and example.mask.any() for example in word.examples)
    assert len(word.examples) >= 2 and word.doubt < 0.05


def test_what_is_not_found_is_told_and_not_taught(scene, photos, capsys):
    assert taught(scene, photos, Grays(-9.0)) is scene
    assert "finds no finial" in capsys.readouterr().out
    everything = Grays(-9.0, tuple(range(9)))
    assert taught(scene, photos, everything) is scene


def test_foreground_masks_keep_votes_out(scene, photos, tmp_path):
    """With the dome outside the foreground of every photo, nobody votes for it."""
    blocked = []
    for photo in photos:
        outside = (photo.read_uint8().float().mean(-1) / 255 - DOME).abs() > 0.2
        path = tmp_path / f"{len(blocked)}.png"
        save_picture((outside * 255).to(torch.uint8).numpy(), path)
        blocked.append(Photo(photo.name, photo.path, path, photo.lens))
    assert taught(scene, blocked, Grays(DOME)) is scene


def test_a_photo_in_portrait_format_may_have_a_foreground_mask(scene, photos, tmp_path):
    """Whose rows, shrunk by the ratio of the columns, are not those of the view."""
    lens = replace(photos[0].lens, width=701, height=1103)
    save_picture(np.full((1103, 701), 255, np.uint8), tmp_path / "mask.png")
    photo = Photo(photos[0].name, photos[0].path, tmp_path / "mask.png", lens)
    camera = lens.camera(scene.photos[0].full_camera.view_matrix)
    small = resized(camera, MARK_SIDE)
    assert photo.read_mask(small.width / photo.width).shape != (small.height, small.width)
    everything = torch.ones(len(scene.splats), dtype=torch.bool)
    assert share_of(scene, photo, camera, everything) == pytest.approx(1.0)
