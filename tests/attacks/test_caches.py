"""Damaged caches of a scene and targets: made again, whatever the damage."""

import torch

from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.query.cache import load_tensors, save_tensors


def test_a_cache_with_any_damage_counts_as_absent(tmp_path):
    path, notes = tmp_path / "kept.safetensors", [3, 4]
    save_tensors(path, {"rows": torch.arange(7), "pixels": torch.ones(7)}, "key", notes)
    tensors, said = load_tensors(path, "key")
    assert said == notes and tensors["rows"].tolist() == list(range(7))
    assert load_tensors(path, "another") is None
    whole = path.read_bytes()
    for place in range(0, len(whole), 3):
        path.write_bytes(whole[:place])
        assert load_tensors(path, "key") is None
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        found = load_tensors(path, "key")  # a flipped bit in padding changes nothing
        assert found is None or torch.equal(found[0]["rows"], tensors["rows"])


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
