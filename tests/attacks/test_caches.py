"""Damaged caches of a scene and targets: made again, whatever the damage."""

import pytest
import torch
from safetensors.torch import save_file

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.preparation.targets import TargetReader
from lang3dxl_ns.query.visibility import VisibleGaussians, load_visible, save_visible
from lang3dxl_ns.scene.camera import Lens


def test_a_cache_with_any_damage_counts_as_absent(tmp_path):
    path, camera = tmp_path / "kept.visible", Lens(4, 3, 5.0, 5.0, 2.0, 1.5).camera(torch.eye(4))
    cameras = {"a.jpg": camera, "b.jpg": camera}
    views = {
        name: VisibleGaussians(camera, torch.arange(count), torch.ones(count))
        for name, count in (("a.jpg", 3), ("b.jpg", 4))
    }
    save_visible(path, views, "key")

    def rows(key="key"):
        found = load_visible(path, key, cameras, "cpu")
        return None if found is None else {name: view.rows.tolist() for name, view in found.items()}

    expected = {"a.jpg": [0, 1, 2], "b.jpg": [0, 1, 2, 3]}
    assert rows() == expected and rows("another") is None
    whole = path.read_bytes()
    for place in range(0, len(whole), 3):
        path.write_bytes(whole[:place])
        assert rows() is None
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        assert rows() in (None, expected)  # a flipped bit in padding changes nothing


def test_a_target_whose_settings_are_lost_or_altered_counts_as_absent(tmp_path):
    store, made_with = FeatureStore(tmp_path), {"encoder": "a"}
    store.write("clip", "a.jpg", {"features": torch.arange(12.0).view(3, 4)}, made_with)
    assert store.is_current("clip", "a.jpg", made_with)
    path = store.path("clip", "a.jpg")
    whole = path.read_bytes()
    for damage in ((b"settings", b"sittings"), (b"encoder", b"encodex"), (b"[0,24]", b"[0,99]")):
        assert damage[0] in whole
        path.write_bytes(whole.replace(*damage))
        assert not store.is_current("clip", "a.jpg", made_with)


def test_a_target_of_settings_that_nest_without_end_counts_as_absent(tmp_path):
    store = FeatureStore(tmp_path)
    (path := store.path("clip", "a.jpg")).parent.mkdir()
    save_file({"features": torch.zeros(2)}, path, {"settings": "[" * 100_000})
    assert not store.is_current("clip", "a.jpg", {})


@pytest.mark.parametrize(
    "tensors", [{"other": torch.zeros(2)}, {"features": torch.ones(4), "valid": torch.ones(4)}]
)
def test_a_target_with_the_checksum_but_not_the_parts_of_its_kind_is_named(tmp_path, tensors):
    store, made_with = FeatureStore(tmp_path), {"size": [4, 4], "crop_sides": [2]}
    store.write("clip", "a.jpg", tensors, made_with)
    with pytest.raises(UserError, match=r"a\.jpg.* holds no target of this kind: delete it"):
        TargetReader(store, {"a.jpg": {"clip": made_with}})
