"""GLB, SOG and SPZ: what is written is read back, as the formats say, and a GLB or SPZ carries words."""

import gzip
import io
import itertools
import json
import re
import struct
import time
import zipfile

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from painted_scene import encode_texts, painted_scene
from PIL import Image
from test_scene_file import decoded

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files import spz
from lang3dxl_ns.files.glb import encode_glb
from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.files.scene_file import keep_words, read_scene, write_scene
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.scene.georeference import Georeference
from lang3dxl_ns.things.thing import Thing


def some_splats(count: int = 200, bands: int = 4, antialiased: bool = True) -> Splats:
    g = torch.Generator().manual_seed(0)
    quats = F.normalize(torch.randn(count, 4, generator=g), dim=1)
    scales, opacities = 0.02 + torch.rand(count, 3, generator=g), torch.rand(count, generator=g)
    means, colors = 4 * torch.randn(count, 3, generator=g), torch.rand(count, bands, 3, generator=g) - 0.5
    return Splats(means, quats, scales, opacities, colors, antialiased)


def described(path) -> tuple[dict, bytes]:
    """The JSON of a GLB and its binary part."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_a_glb_is_read_back(bands, tmp_path):
    splats = some_splats(bands=bands)
    write_splats(tmp_path / "a.glb", splats)
    found = read_splats(tmp_path / "a.glb")
    for name in ("means", "scales", "opacities", "harmonics", "quats"):
        torch.testing.assert_close(getattr(found, name), getattr(splats, name), atol=1e-6, rtol=0)
    assert found.antialiased


def test_a_glb_has_the_attributes_of_the_extension(tmp_path):
    splats = some_splats(3)
    write_splats(tmp_path / "a.glb", splats)
    about, binary = described(tmp_path / "a.glb")
    primitive = about["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and about["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    for name, wanted in {
        "POSITION": splats.means,
        "KHR_gaussian_splatting:ROTATION": splats.quats[:, [1, 2, 3, 0]],
        "KHR_gaussian_splatting:SCALE": splats.scales,
        "KHR_gaussian_splatting:OPACITY": splats.opacities,
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": splats.harmonics[:, 0],
        "KHR_gaussian_splatting:SH_DEGREE_1_COEF_2": splats.harmonics[:, 3],
    }.items():
        accessor = about["accessors"][primitive["attributes"][name]]
        view = about["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and accessor["componentType"] == 5126
        values = np.frombuffer(binary, "<f4", wanted.numel(), view["byteOffset"])
        np.testing.assert_allclose(values, wanted.flatten(), atol=1e-6)


def glb_of(path, extension: dict, attributes: dict | None = None, content: bytes = b"") -> None:
    """Write a GLB with one primitive, whose binary part is one view."""
    primitive = {"attributes": attributes or {}, "extensions": {"KHR_gaussian_splatting": extension}}
    view = {"buffer": 0, "byteLength": len(content)}
    about = {"meshes": [{"primitives": [primitive]}], "bufferViews": [view]}
    text = json.dumps(about).encode()
    parts = (
        struct.pack("<I4s", len(part), kind) + part for part, kind in ((text, b"JSON"), (content, b"BIN\0"))
    )
    body = b"".join(parts)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def test_a_glb_that_keeps_an_spz_holds_what_the_spz_holds(tmp_path):
    write_splats(tmp_path / "a.spz", some_splats())
    nested = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    glb_of(tmp_path / "a.glb", {"extensions": nested}, content=(tmp_path / "a.spz").read_bytes())
    found, wanted = read_splats(tmp_path / "a.glb"), read_splats(tmp_path / "a.spz")
    for name in ("means", "scales", "opacities", "harmonics", "quats", "antialiased"):
        assert torch.equal(torch.as_tensor(getattr(found, name)), torch.as_tensor(getattr(wanted, name)))


@pytest.mark.parametrize(
    ("extension", "attributes", "told"),
    [
        ({"extensions": {"KHR_gaussian_splatting_lgsc": {"bufferView": 0}}}, {}, "by KHR_.*_lgsc"),
        ({}, {"POSITION": 0, "_SCALE": 1}, "a draft"),
        ({}, {"POSITION": 0, "KHR_gaussian_splatting:SCALE": 1, "COLOR_0": 2}, "of points"),
        ({"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}, {}, "damaged"),
    ],
)  # fmt: skip
def test_what_a_glb_has_instead_of_known_splats_is_named(extension, attributes, told, tmp_path):
    glb_of(tmp_path / "a.glb", extension, attributes, b"\x1f\x8b")
    with pytest.raises(UserError, match=told):
        read_splats(tmp_path / "a.glb")


def changed(path, change) -> None:
    """Write a GLB again, of which a function changes the description and the binary part."""
    about, binary = described(path)
    binary = change(about, about["meshes"][0]["primitives"], bytearray(binary)) or binary
    text = json.dumps(about).encode()
    parts = (text + b" " * (-len(text) % 4), b"JSON"), (binary, b"BIN\0")
    body = b"".join(struct.pack("<I4s", len(part), kind) + part for part, kind in parts)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def test_a_glb_with_logarithms_for_scales_is_read(tmp_path):
    """As splat-transform wrote it at first."""
    splats = some_splats()

    def logarithms(about, primitives, binary):
        accessor = about["accessors"][primitives[0]["attributes"]["KHR_gaussian_splatting:SCALE"]]
        start = about["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        binary[start : start + 12 * len(splats)] = splats.scales.log().numpy().tobytes()
        return bytes(binary)

    write_splats(tmp_path / "a.glb", splats)
    changed(tmp_path / "a.glb", logarithms)
    assert torch.allclose(read_splats(tmp_path / "a.glb").scales, splats.scales, rtol=1e-5)


def test_a_glb_with_several_splats_tells_that_one_is_read(tmp_path, capsys):
    write_splats(tmp_path / "a.glb", some_splats())
    changed(tmp_path / "a.glb", lambda _, primitives, __: primitives.append(primitives[0]))
    assert len(read_splats(tmp_path / "a.glb")) == 200
    assert "holds 2 splats, of which the first is read" in capsys.readouterr().out


def test_a_glb_of_linear_colors_is_told(tmp_path, capsys):
    write_splats(tmp_path / "a.glb", some_splats())
    space = {"colorSpace": "lin_rec709_display"}
    changed(tmp_path / "a.glb", lambda _, ps, __: ps[0]["extensions"]["KHR_gaussian_splatting"].update(space))
    assert len(read_splats(tmp_path / "a.glb")) == 200
    assert "has linear colors, which are shown too dark" in capsys.readouterr().out


def test_a_glb_may_name_the_stride_of_rows_without_gaps(tmp_path):
    def stride(size):
        return lambda about, primitives, _: about["bufferViews"][
            about["accessors"][primitives[0]["attributes"]["POSITION"]]["bufferView"]
        ].update(byteStride=size)

    write_splats(tmp_path / "a.glb", splats := some_splats())
    changed(tmp_path / "a.glb", stride(12))
    assert torch.equal(read_splats(tmp_path / "a.glb").means, splats.means)
    changed(tmp_path / "a.glb", stride(16))
    with pytest.raises(UserError, match="interleaved"):
        read_splats(tmp_path / "a.glb")


def thing(number: int, word: str, rows: list[int], size: float) -> Thing:
    box = np.array([1.0, 2, 3]), np.eye(3), np.full(3, size)
    return Thing(number, word, 0.75, 3, *box, np.array(rows))


PLACE = Georeference(2.5, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 0.05, 7)


def test_things_are_features_with_a_table_of_labels(tmp_path):
    splats = some_splats(6, bands=1)
    splats.means[1] = torch.nan  # is left out, and the ids follow
    small, large = thing(4, "Rose-Fenster ü", [4, 5], 1.0), thing(0, "tower", [0, 1, 2, 4], 9.0)
    inner = thing(2, "tower", [2], 1.0)
    codes = torch.rand(6, 3)
    (tmp_path / "a.glb").write_bytes(
        encode_glb(splats, codes=codes, things=[inner, small, large], place=PLACE)
    )
    about, binary = described(tmp_path / "a.glb")
    assert_valid(about, binary)

    def viewed(number: int, kind: str) -> np.ndarray:
        view = about["bufferViews"][number]
        return np.frombuffer(binary[view["byteOffset"] :][: view["byteLength"]], kind)

    primitive = about["meshes"][0]["primitives"][0]
    values = {
        name: viewed(about["accessors"][number]["bufferView"], "<f4")
        for name, number in primitive["attributes"].items()
    }
    np.testing.assert_array_equal(values["_CODE"].reshape(-1, 3), codes[[0, 2, 3, 4, 5]].numpy())
    sets = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
    # Rows are those of the table; a small thing is seen before a large one that it is part of; 3 is none.
    ids = [values[f"_FEATURE_ID_{one['attribute']}"].tolist() for one in sets]
    assert ids == [[2, 0, 3, 2, 3], [3, 3, 3, 1, 1]]
    assert [one["featureCount"] for one in sets] == [2, 1] and {one["nullFeatureId"] for one in sets} == {3}
    assert all(re.fullmatch(r"[a-zA-Z_][a-zA-Z0-9_]*", one["label"]) for one in sets)
    table = about["extensions"]["EXT_structural_metadata"]["propertyTables"][0]
    columns = table["properties"]
    ends = viewed(columns["word"]["stringOffsets"], "<u4")
    text = viewed(columns["word"]["values"], "u1").tobytes()
    words = [text[a:b].decode() for a, b in itertools.pairwise(ends)]
    assert words == ["tower", "Rose-Fenster ü", "tower"] and table["count"] == 3
    assert viewed(columns["id"]["values"], "<u4").tolist() == [2, 4, 0]
    assert viewed(columns["size"]["values"], "<f4").reshape(3, 3)[:, 0].tolist() == [1, 1, 9]
    assert len(read_splats(tmp_path / "a.glb")) == 5


def test_a_glb_stands_upright_in_meters(tmp_path):
    """Up is glTF's y, north its -z, and another program reads the node so."""
    trimesh = pytest.importorskip("trimesh")
    splats = some_splats(5, bands=1)
    write_splats(tmp_path / "a.glb", splats, place=PLACE)
    cloud = trimesh.load(tmp_path / "a.glb").to_geometry()
    east, north, up = (splats.means * 2.5).T.numpy()
    np.testing.assert_allclose(cloud.vertices, np.stack([east, up, -north], 1), atol=1e-5)
    torch.testing.assert_close(read_splats(tmp_path / "a.glb").means, splats.means)  # in its own frame
    write_splats(tmp_path / "a.ply", splats, place=PLACE)
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
    assert b"\ncomment 1 unit is 2.5 m +- 5%, by the GPS" in header and header.isascii()  # as plyfile demands
    torch.testing.assert_close(read_splats(tmp_path / "a.ply").means, splats.means)


def assert_valid(about: dict, binary: bytes) -> None:
    """Rules of glTF 2.0 and of the two extensions' schemas."""
    assert about["asset"]["version"] == "2.0" and about["buffers"] == [{"byteLength": len(binary)}]
    used = set(about["extensionsUsed"])
    (primitive,) = about["meshes"][0]["primitives"]
    assert used == {*primitive["extensions"], *about.get("extensions", {})}
    end = 0
    for view in about["bufferViews"]:
        assert view["buffer"] == 0 and view["byteLength"] > 0 and view["byteOffset"] >= end
        assert view["byteOffset"] % 8 == 0  # what EXT_structural_metadata demands
        end = view["byteOffset"] + view["byteLength"]
    assert end <= len(binary) < end + 4
    counts = set()
    for name, number in primitive["attributes"].items():
        accessor = about["accessors"][number]
        sides = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        view = about["bufferViews"][accessor["bufferView"]]
        assert view["target"] == 34962 and view["byteLength"] == 4 * sides * accessor["count"]
        values = np.frombuffer(binary, "<f4", sides * accessor["count"], view["byteOffset"])
        assert np.isfinite(values).all()
        values = values.reshape(-1, sides)
        assert accessor["min"] == values.min(0).tolist() and accessor["max"] == values.max(0).tolist()
        assert name == "POSITION" or name.startswith(("_", "KHR_gaussian_splatting:"))
        counts.add(accessor["count"])
    assert len(counts) == 1
    tables = about.get("extensions", {}).get("EXT_structural_metadata", {"propertyTables": []})
    for one in primitive["extensions"].get("EXT_mesh_features", {"featureIds": []})["featureIds"]:
        assert one["featureCount"] >= 1 and one["propertyTable"] < len(tables["propertyTables"])
    for table in tables["propertyTables"]:
        known = tables["schema"]["classes"][table["class"]]["properties"]
        assert known.keys() == table["properties"].keys() and table["count"] >= 1


@pytest.mark.parametrize("ending", ["glb", "spz", "GLB"])
def test_a_splat_that_carries_a_scene_answers_as_the_scene_does(ending, tmp_path):
    scene = painted_scene(**decoded("gathered"))
    names = "a.scene", f"a.{ending}"
    for name in names:
        write_scene(tmp_path / name, scene)
    ours, other = (read_scene(tmp_path / name, encode_texts=encode_texts) for name in names)
    np.testing.assert_array_equal(ours.relevancy("dome"), other.relevancy("dome"))
    assert len(read_splats(tmp_path / names[1])) == len(scene.splats)
    if ending != "spz":
        assert_valid(*described(tmp_path / names[1]))
    with pytest.raises(UserError, match=r"--scene-file NAME.scene"):
        keep_words(tmp_path / names[1], {})
    write_splats(tmp_path / f"b.{ending}", scene.splats)
    with pytest.raises(UserError, match="without words"):
        read_scene(tmp_path / f"b.{ending}")


def test_an_spz_with_a_scene_is_an_spz_for_others_and_of_any_version_for_us(tmp_path):
    gsply = pytest.importorskip("gsply")
    scene = painted_scene(**decoded("gathered"))
    path, plain = tmp_path / "a.spz", tmp_path / "b.spz"
    write_scene(path, scene)
    write_splats(plain, scene.baked())
    np.testing.assert_array_equal(gsply.read_spz(path).means, gsply.read_spz(plain).means)
    record = spz.scene_record(path)
    gsply.write_spz(plain, gsply.read_spz(path), version=4)
    content = bytearray(plain.read_bytes())
    records = struct.pack("<III", 0xADBE0002, 4, 0) + struct.pack("<II", 0x4C330001, len(record)) + record
    content[14] |= 2  # flags
    content[16:20] = struct.pack("<I", 32 + len(records))
    path.write_bytes(bytes(content[:32]) + records + bytes(content[32:]))
    assert spz.scene_record(path) == record
    torch.testing.assert_close(read_splats(path).means, read_splats(plain).means)
    content[16:20] = struct.pack("<I", 32 + 12)
    path.write_bytes(bytes(content[:32]) + records[:12] + bytes(content[32:]))
    assert spz.scene_record(path) is None


def test_a_small_spz_cannot_unpack_to_a_large_scene(tmp_path):
    write_splats(tmp_path / "a.spz", some_splats(2))
    content = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    content[14] |= 2
    bomb = bytes(content) + struct.pack("<II", 0x4C330001, 30_000_000) + bytes(30_000_000)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bomb))
    with pytest.raises(UserError, match="unpacks to more"):
        read_scene(tmp_path / "b.spz")


def test_a_sog_is_read_back(tmp_path):
    splats = some_splats(500, bands=1)
    write_splats(tmp_path / "a.sog", splats)
    found = read_splats(tmp_path / "a.sog")
    torch.testing.assert_close(found.means, splats.means, atol=2e-3, rtol=1e-3)
    torch.testing.assert_close(found.scales.log(), splats.scales.log(), atol=0.03, rtol=0)
    torch.testing.assert_close(found.opacities, splats.opacities, atol=2 / 255, rtol=0)
    torch.testing.assert_close(found.harmonics, splats.harmonics, atol=0.01, rtol=0)
    assert float((found.quats * splats.quats).sum(1).abs().min()) > 0.9995 and found.antialiased


def test_a_sog_is_written_whatever_the_clock_says(tmp_path, monkeypatch):
    """Boards without a battery begin in 1970, which a ZIP can't hold."""
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    write_splats(tmp_path / "a.sog", some_splats(10, bands=1))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert all(part.external_attr >> 16 & 0o444 == 0o444 for part in bundle.infolist())
    assert len(read_splats(tmp_path / "a.sog")) == 10


def test_a_sog_has_the_pictures_that_its_meta_names(tmp_path):
    splats = some_splats(10, bands=1)
    write_splats(tmp_path / "a.sog", splats)
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        meta = json.loads(bundle.read("meta.json"))
        pixels = {
            name: np.asarray(Image.open(io.BytesIO(bundle.read(name))).convert("RGBA")).reshape(-1, 4)
            for part in ("means", "scales", "quats", "sh0")
            for name in meta[part]["files"]
        }
    assert meta["version"] == 2 and meta["count"] == 10 and meta["antialias"] is True
    low, high = meta["means"]["mins"], meta["means"]["maxs"]
    for i in range(10):
        for axis in range(3):
            steps = int(pixels["means_u.webp"][i, axis]) * 256 + int(pixels["means_l.webp"][i, axis])
            log = low[axis] + steps / 65535 * (high[axis] - low[axis])
            place = (1 if log >= 0 else -1) * (np.exp(abs(log)) - 1)
            assert abs(place - float(splats.means[i, axis])) < 5e-3
            book = meta["scales"]["codebook"][pixels["scales.webp"][i, axis]]
            assert abs(book - float(splats.scales[i, axis].log())) < 0.1
        largest = int(pixels["quats.webp"][i, 3]) - 252
        assert largest == int(splats.quats[i].abs().argmax())


def test_the_palette_of_a_sog_is_read(tmp_path):
    splats = some_splats(6, bands=1)
    write_splats(tmp_path / "a.sog", splats)
    palette = np.random.default_rng(0).integers(0, 256, (64, 3, 3), np.uint8)
    labels = np.zeros((16, 4), np.uint8) + 255
    labels[:6, 0], labels[:6, 1] = [5, 0, 63, 7, 7, 1], 0
    book = np.linspace(-1, 1, 256)

    def webp(pixels) -> bytes:
        written = io.BytesIO()
        Image.fromarray(pixels).save(written, "WEBP", lossless=True, exact=True)
        return written.getvalue()

    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        files = {name: bundle.read(name) for name in bundle.namelist()}
    meta = json.loads(files["meta.json"])
    meta["shN"] = {"count": 64, "bands": 1, "codebook": book.tolist(), "files": ["c.webp", "l.webp"]}
    files |= {"meta.json": json.dumps(meta), "l.webp": webp(labels.reshape(4, 4, 4))}
    files["c.webp"] = webp(palette.reshape(1, 64 * 3, 3))
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as bundle:
        for name, content in files.items():
            bundle.writestr(name, content)
    found = read_splats(tmp_path / "b.sog")
    np.testing.assert_allclose(found.harmonics[2, 1:], book[palette[63]], atol=1e-6)


@pytest.mark.parametrize("told", [{"antialias": True}, {"model": "antialiased"}, {"model": "2dgs"}, {}])
def test_a_sog_of_any_age_tells_antialiasing_and_may_lack_the_lowest_value(told, tmp_path):
    splats = some_splats(400, bands=1)
    write_splats(tmp_path / "a.sog", splats)
    with zipfile.ZipFile(tmp_path / "a.sog") as ours, zipfile.ZipFile(tmp_path / "b.sog", "w") as other:
        meta = json.loads(ours.read("meta.json"))
        assert meta.pop("antialias") and meta.pop("model") == "antialiased"
        meta["scales"]["codebook"][0] = None
        for name in ours.namelist():
            content = json.dumps(meta | told) if name == "meta.json" else ours.read(name)
            other.writestr(name, content)
    found = read_splats(tmp_path / "b.sog")
    torch.testing.assert_close(found.scales.log(), splats.scales.log(), atol=0.06, rtol=0)
    assert found.antialiased == (told not in ({"model": "2dgs"}, {}))


@pytest.mark.parametrize(("form", "known"), [("PNG", True), ("TIFF", False), ("EPS", False)])
def test_pictures_of_a_sog_are_webp_or_png_whatever_their_names(form, known, tmp_path):
    """A decoder of others would start Ghostscript."""
    splats = some_splats(100, bands=1)
    write_splats(tmp_path / "a.sog", splats)
    with zipfile.ZipFile(tmp_path / "a.sog") as ours, zipfile.ZipFile(tmp_path / "b.sog", "w") as other:
        for name in ours.namelist():
            content, written = ours.read(name), io.BytesIO()
            if name == "means_l.webp":  # which has no transparency
                Image.open(io.BytesIO(content)).convert("RGB").save(written, form)
            other.writestr(name, written.getvalue() or content)
    if known:
        ours, other = (read_splats(tmp_path / f"{name}.sog").means for name in "ab")
        torch.testing.assert_close(ours, other)
    else:
        with pytest.raises(UserError, match=r"b\.sog is damaged or incomplete \(cannot identify"):
            read_splats(tmp_path / "b.sog")


@pytest.mark.parametrize("how", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2, zipfile.ZIP_DEFLATED])
def test_a_damaged_sog_that_is_packed_in_any_way_is_refused(how, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.sog", "w", how) as bundle:
        bundle.writestr("meta.json", json.dumps({"version": 2, "count": 3}))
    content = bytearray((tmp_path / "a.sog").read_bytes())
    start = bundle.getinfo("meta.json").header_offset + 30 + len("meta.json")
    content[start + 9 : start + 19] = b"\xff" * 10
    (tmp_path / "a.sog").write_bytes(content)
    with pytest.raises(UserError, match="damaged or incomplete"):
        read_splats(tmp_path / "a.sog")


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.glb", b"glTF"), ("a.glb", b"glTF" + bytes(60)), ("a.sog", b"PK"), ("a.sog", b"")],
)
def test_what_is_no_glb_or_sog_is_refused(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match="damaged or incomplete"):
        read_splats(tmp_path / name)
