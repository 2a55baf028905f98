"""Whatever stands in a file, its reader answers, or says in a `UserError` what is wrong with it."""

import contextlib
import json
import os
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from scenes import write_scene

from lang3dxl_ns import presets
from lang3dxl_ns.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.preparation.companions import companion, inside
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.preparation.physical_scale import read_reconstruction
from lang3dxl_ns.preparation.regions import FolderRegions
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.query.scene_file import SceneFile, read_camera_path

INPUTS = int(os.environ.get("LANG3DXL_FUZZ", "60"))
"""Inputs per reader."""
fuzz = settings(
    max_examples=INPUTS,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@st.composite
def damage(draw, content: bytes) -> bytes:
    """Cut short, bytes changed, a stretch repeated or taken out; now and then something else altogether."""
    how = draw(st.sampled_from(["cut", "change", "change", "repeat", "remove", "other"]))
    if how == "other":
        return draw(st.binary(max_size=64))
    if how == "cut":
        return content[: draw(st.integers(0, len(content)))]
    if how == "change":
        changed = bytearray(content)
        for _ in range(draw(st.integers(1, 8))):
            changed[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
        return bytes(changed)
    start, length = draw(st.integers(0, len(content))), draw(st.integers(1, 64))
    piece = content[start : start + length]
    return content[:start] + (piece * 2 if how == "repeat" else b"") + content[start + length :]


@contextlib.contextmanager
def only_user_errors():
    """Every other error is the reader's mistake."""
    with contextlib.suppress(UserError):
        yield


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Files of a COLMAP model, by name, binary and text."""
    import pycolmap

    folder = write_scene(tmp_path_factory.mktemp("scene"), photos=3, points=12) / "sparse" / "0"
    (text := folder / "text").mkdir()
    pycolmap.Reconstruction(folder).write_text(text)
    return {
        path.name: path.read_bytes() for where in (folder, text) for path in where.iterdir() if path.is_file()
    }


@pytest.mark.parametrize("ending", [".bin", ".txt"])
@fuzz
@given(data=st.data())
def test_colmap_models(model, tmp_path, ending, data):
    shutil.rmtree(tmp_path / "model", ignore_errors=True)
    (tmp_path / "model").mkdir()
    names = sorted(name for name in model if name.endswith(ending))
    victim = data.draw(st.sampled_from(names))
    for name in names:
        content = data.draw(damage(model[name])) if name == victim else model[name]
        (tmp_path / "model" / name).write_bytes(content)
    with only_user_errors():
        read_reconstruction(tmp_path / "model")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Pictures of every format that people have, by suffix."""
    folder = tmp_path_factory.mktemp("pictures")
    image = Image.effect_noise((24, 16), 60).convert("RGB")
    for suffix in ("jpg", "png", "webp", "tif", "gif", "bmp"):
        image.save(folder / f"a.{suffix}")
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".gif", ".bmp"])
@fuzz
@given(data=st.data())
def test_photos_and_masks(pictures, tmp_path, suffix, data):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data.draw(damage(pictures[suffix])))
    photo = Photo(path.name, path, path, 24, 16, 20.0, 20.0, 12.0, 8.0)
    with only_user_errors():
        photo.read()
    with only_user_errors():
        photo.read_mask()


@fuzz
@given(data=st.data())
def test_ground_truth(pictures, tmp_path, data):
    (tmp_path / "domes").mkdir(exist_ok=True)
    (tmp_path / "domes" / "0001-gt.jpg").write_bytes(data.draw(damage(pictures[".jpg"])))
    with only_user_errors():
        GroundTruth(tmp_path).masks("0001.jpg", (8, 12))


@fuzz
@given(data=st.data())
def test_label_maps(tmp_path, data):
    import numpy as np

    np.save(tmp_path / "whole.npy", np.arange(12).reshape(3, 4))
    (tmp_path / "a.npy").write_bytes(data.draw(damage((tmp_path / "whole.npy").read_bytes())))
    photo = Photo("a.jpg", tmp_path / "a.jpg", None, 8, 6, 5.0, 5.0, 4.0, 3.0)
    with only_user_errors():
        FolderRegions(tmp_path).labels(photo, torch.zeros(6, 8, 3))


@fuzz
@given(data=st.data())
def test_store_entries(tmp_path, data):
    store, made_with = FeatureStore(tmp_path), {"encoder": "a", "size": [9, 9]}
    features = {"features": torch.arange(12.0).view(3, 4), "valid": torch.ones(3)}
    store.write("clip", "a.jpg", features, made_with)
    path = store.path("clip", "a.jpg")
    whole = path.read_bytes()
    path.write_bytes(data.draw(damage(whole)))
    if store.is_current("clip", "a.jpg", made_with):  # then nothing that counts has changed
        found = store.read("clip", "a.jpg")
        assert all(torch.equal(found[key], value.half()) for key, value in features.items())
    for read in (store.read, store.shapes, store.settings):
        with only_user_errors():
            read("clip", "a.jpg")


@fuzz
@given(content=st.binary(max_size=60) | JSON.map(lambda value: yaml.safe_dump(value).encode()))
def test_presets(content, tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "FOLDER", tmp_path)
    (tmp_path / "a.yaml").write_bytes(content)
    with only_user_errors():
        assert isinstance(presets.load_preset("a"), dict)


@fuzz
@given(content=st.binary(max_size=60) | JSON.map(lambda value: json.dumps(value).encode()))
def test_scene_files_and_camera_paths(content, tmp_path):
    (tmp_path / "a.json").write_bytes(content)
    with only_user_errors():
        SceneFile.read(tmp_path / "a.json")
    with only_user_errors():
        read_camera_path(tmp_path / "a.json")


@fuzz
@given(
    name=st.text(max_size=12)
    | st.lists(st.sampled_from(["..", ".", "a", "/", "\\", "b.jpg", "~"])).map("/".join)
)
def test_names_never_lead_out_of_their_folder(name, tmp_path):
    with only_user_errors():
        assert Path(os.path.normpath(inside(tmp_path, name))).is_relative_to(tmp_path)
    with only_user_errors():
        companion(tmp_path, name, (".png",))
