"""Fuzzing of file readers: any input gives a result or a `UserError`."""

import contextlib
import gzip
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from painted_scene import decoded, painted_looks, painted_scene, painted_splats
from PIL import Image
from scenes import write_scene

from lang3dxl_ns.commands.evaluate import EvaluatePool
from lang3dxl_ns.common import presets
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.pictures import FORMATS
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.layouts import read_lerf_ovs
from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.files.scene_file import write_scene as write_scene_file
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.methods import lang3dxl
from lang3dxl_ns.plugin.run_checkpoint import check_checkpoint, read_checkpoint
from lang3dxl_ns.plugin.trainer_config import read_config
from lang3dxl_ns.preparation.needs import read_needs
from lang3dxl_ns.preparation.regions import FolderRegions
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.query.vocabulary import whole_words
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.companions import companion, inside
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto, SceneRecord
from lang3dxl_ns.words.taught_words import load_words

INPUTS = int(os.environ.get("LANG3DXL_FUZZ", "60"))
"""Inputs per reader."""
fuzz = settings(
    max_examples=INPUTS,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
WRITTEN = [form for form in FORMATS if form != "HEIF"]
"""Formats that Pillow writes."""
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@st.composite
def damage(draw, content: bytes) -> bytes:
    """Truncated, bytes changed or numbers made large, a stretch repeated or removed, often in the header;
    sometimes entirely random."""
    how = draw(st.sampled_from(["cut", "change", "change", "enlarge", "repeat", "remove", "other"]))
    last = min(draw(st.sampled_from([40, 4000, len(content)])), len(content)) - 1
    if how == "other":
        return draw(st.binary(max_size=64))
    if how == "cut":
        return content[: draw(st.integers(0, len(content)))]
    if how == "change":
        changed = bytearray(content)
        for _ in range(draw(st.integers(1, 8))):
            changed[draw(st.integers(0, last))] = draw(st.integers(0, 255))
        return bytes(changed)
    start, length = draw(st.integers(0, last)), draw(st.integers(1, 64))
    if how == "enlarge":
        return content[:start] + b"\xff\xff\xff\x7f" + content[start + 4 :]
    piece = content[start : start + length]
    return content[:start] + (piece * 2 if how == "repeat" else b"") + content[start + length :]


@contextlib.contextmanager
def only_user_errors():
    """Any other error is a bug of the reader."""
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
    """Pictures of every accepted format."""
    folder = tmp_path_factory.mktemp("pictures")
    image = Image.effect_noise((24, 16), 60).convert("RGB")
    for form in WRITTEN:
        image.save(folder / form, form)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("form", WRITTEN)
@fuzz
@given(data=st.data())
def test_photos_and_masks(pictures, tmp_path, form, data):
    path = tmp_path / "a.jpg"
    path.write_bytes(data.draw(damage(pictures[form])))
    photo = Photo(path.name, path, path, Lens(24, 16, 20.0, 21.0, 12.0, 8.0))
    with only_user_errors():
        photo.read()
    with only_user_errors():
        photo.read_mask()


@fuzz
@given(data=st.data())
def test_ground_truth(pictures, tmp_path, data):
    (tmp_path / "domes").mkdir(exist_ok=True)
    (tmp_path / "domes" / "0001-gt.jpg").write_bytes(data.draw(damage(pictures["JPEG"])))
    with only_user_errors():
        GroundTruth(tmp_path).masks("0001.jpg", (8, 12))


@fuzz
@given(data=st.data())
def test_label_maps(tmp_path, data):
    np.save(tmp_path / "whole.npy", np.arange(12).reshape(3, 4))
    (tmp_path / "a.npy").write_bytes(data.draw(damage((tmp_path / "whole.npy").read_bytes())))
    photo = Photo("a.jpg", tmp_path / "a.jpg", None, Lens(8, 6, 5.0, 5.5, 4.0, 3.0))
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
    if store.is_current("clip", "a.jpg", made_with):  # then nothing relevant has changed
        found = store.read("clip", "a.jpg")
        assert all(torch.equal(found[key], value.half()) for key, value in features.items())
    with only_user_errors():
        store.read("clip", "a.jpg")


@fuzz
@given(content=st.binary(max_size=60) | JSON.map(lambda value: yaml.safe_dump(value).encode()))
def test_presets(content, tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "FOLDER", tmp_path)
    (tmp_path / "a.yaml").write_bytes(content)
    with only_user_errors():
        assert isinstance(presets.load_preset("a"), dict)


@fuzz
@given(content=st.binary(max_size=60) | JSON.map(lambda value: json.dumps(value).encode()))
def test_scene_files(content, tmp_path):
    (tmp_path / "a.json").write_bytes(content)
    with only_user_errors():
        SceneRecord.read(tmp_path / "a.json")


@st.composite
def altered(draw, document: Any) -> Any:
    """A JSON document with a value somewhere in it replaced, or left out."""
    if not isinstance(document, dict | list) or not document or draw(st.integers(0, 5)) == 0:
        return draw(ODD)
    keys = list(document) if isinstance(document, dict) else range(len(document))
    key = draw(st.sampled_from(keys))
    copy = document.copy()
    if draw(st.integers(0, 9)) == 0:
        del copy[key]
    else:
        copy[key] = draw(altered(document[key]))
    return copy


NUMBERS = st.floats() | st.integers() | st.sampled_from([0, -1, 1e309, 1e-320, 2**31, 2_000_000, True])
ODD = JSON | NUMBERS | st.sampled_from(["", "..", "\0", [], {}, [[]]])
POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]]


@fuzz
@given(data=st.data())
def test_scene_files_in_use(tmp_path, data):
    lens = Lens(24, 16, 20.0, 21.0, 12.0, 8.0, (0.1, 0.0, 0.0, 0.0))
    photos = [ScenePhoto(f"{i}.jpg", "train", POSE, lens, str(tmp_path / "mask.png")) for i in range(2)]
    SceneRecord(photos, "clip", "identity", 1.0, POSE, "data").write(tmp_path / "whole.json")
    document = json.loads((tmp_path / "whole.json").read_text())
    (tmp_path / "a.json").write_text(json.dumps(data.draw(altered(document))))
    with only_user_errors():
        scene = SceneRecord.read(tmp_path / "a.json")
        for photo in scene.photos:
            assert scene.photo(photo.name) is photo
            assert photo.camera.at_origin(torch.zeros(1))[1].isfinite().all()
            assert photo.foreground() is None or max(photo.lens.width, photo.lens.height) < 1e5


@fuzz
@given(data=st.data())
def test_checkpoints(tmp_path, data):
    torch.save({"step": 7, "pipeline": {"x": torch.arange(4.0)}}, tmp_path / "whole.ckpt")
    path = tmp_path / "step-000000007.ckpt"
    path.write_bytes(data.draw(damage((tmp_path / "whole.ckpt").read_bytes())))
    with only_user_errors():
        check_checkpoint(path)
    with only_user_errors():
        assert set(read_checkpoint(path)) >= {"step", "pipeline"}


@pytest.fixture(scope="module")
def settings_of_a_run():
    """The lines of a config.yml."""
    return yaml.dump(lang3dxl.config).encode()


@settings(fuzz, max_examples=max(INPUTS // 20, 1))  # reading one takes half a second
@given(data=st.data())
def test_configs(settings_of_a_run, tmp_path, data):
    (tmp_path / "config.yml").write_bytes(data.draw(damage(settings_of_a_run)))
    with only_user_errors():
        read_config(tmp_path / "config.yml")


# ── files that people hand on ───────────────────────────────────────────────────────────────────────────


MASK = {"size": [4, 5], "counts": [3, 4, 13]}
EXAMPLE = {"photo": "a.jpg", "points": [[1, 2]], "not_points": [], "size": [50, 40], "mask": MASK}
OUTLINED = EXAMPLE | {"outlines": [[[1, 1], [20, 1], [20, 30]]]}
del OUTLINED["mask"]
VALUES = {"bias": 0.1, "text": 0.2, "doubt": 0.05, "vector": [0.5, 0.5], "precision": {"a.jpg": 0.5}}
WORD = VALUES | {"name": "door", "clip": "abc", "scene": "castle", "examples": [EXAMPLE, OUTLINED]}
OBJECT = {"category": "door", "segmentation": [[1, 1], [20, 1], [20, 30]], "bbox": [1, 1, 20, 30]}
FIGURES = {"protocol": {"layout": "plain"}, "photos": {"a.jpg": {"ap_door": 0.4}}, "map": 0.4}


def draw_labels(path: Path):
    for photos in read_lerf_ovs(path.parent).values():
        for outlines in photos.values():
            outlines.truth((30, 40))


OTHERS = {  # content, name, and what reads it
    "words": ({"version": 1, "words": [WORD]}, "words.json", load_words),
    "labels": ({"info": {"width": 80, "height": 60}, "objects": [OBJECT]}, "a.json", draw_labels),
    "report": (
        {"scene": "castle", "results": FIGURES},
        "scores.json",
        lambda path: EvaluatePool(reports=[path], out=path.parent / "pooled").main(),
    ),
    "needs": ({"sky": {"needed": True}}, "scene_needs.json", lambda path: read_needs(path.parent)),
    "tokenizer": (
        {"model": {"vocab": [["tower", -1.0], ["door", -2.0]]}},
        "tokenizer.json",
        lambda path: whole_words(path.parent),
    ),
}


@pytest.mark.parametrize("kind", OTHERS)
@fuzz
@given(data=st.data())
def test_files_that_people_hand_on(tmp_path, kind, data):
    content, name, read = OTHERS[kind]
    if kind == "tokenizer":
        (tmp_path / "config.json").write_text("{}")
        (tmp_path / "model.safetensors").write_bytes(b"")
    if data.draw(st.booleans()):
        changed = json.dumps(data.draw(altered(content))).encode()
    else:
        changed = data.draw(damage(json.dumps(content).encode()))
    (tmp_path / name).write_bytes(changed)
    said = ""
    try:
        read(tmp_path / name)
    except UserError as error:
        said = str(error)
    assert "\n" not in said and len(said) < 800


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A scene and its splats, by the ending of their names."""
    gsply = pytest.importorskip("gsply")
    at, splats = tmp_path_factory.mktemp("scenes"), painted_splats(along=6)
    write_scene_file(at / "a.scene", painted_scene(**decoded("gathered"), looks=painted_looks()))
    for kind in ("ply", "spz", "sog", "glb"):
        write_splats(at / f"a.{kind}", splats)
    header, body = (at / "a.ply").read_bytes().split(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(len(splats), -1).tolist()
    text = "\n".join(" ".join(map(str, row)) for row in rows).encode()
    header = header.replace(b"binary_little_endian", b"ascii")
    (at / "a.ascii.ply").write_bytes(header + b"end_header\n" + text)
    gsply.write_spz(at / "a.4.spz", gsply.read_spz(at / "a.spz"), version=4)
    (at / "a.splat").write_bytes(np.ones((64, 8), "<f4").tobytes())
    for path in at.iterdir():  # a file that is refused undamaged would hide everything
        (read_scene if path.suffix == ".scene" else read_splats)(path)
    return {path.name.removeprefix("a."): path.read_bytes() for path in at.iterdir()}


@pytest.mark.parametrize("kind", ["scene", "ply", "ascii.ply", "spz", "4.spz", "sog", "glb", "splat"])
@fuzz
@given(data=st.data())
def test_scenes_and_splats(scenes, tmp_path, kind, data):
    """What is read is finite; what is refused is named."""
    path, zipped = tmp_path / f"a.{kind}", kind == "spz"
    content = data.draw(damage(gzip.decompress(scenes[kind]) if zipped else scenes[kind]))
    path.write_bytes(gzip.compress(content) if zipped else content)
    said = path.name
    try:
        sound = read_scene(path, "cpu") if kind == "scene" else read_splats(path).sound().all()
    except UserError as error:
        sound, said = True, str(error)
    assert sound and path.name in said and "\n" not in said


# ── names of files ──────────────────────────────────────────────────────────────────────────────────────


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
