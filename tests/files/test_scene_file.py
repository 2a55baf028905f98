"""Scene files: what is written is read, and nothing else is."""

import io
import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_scene import (
    COUNT,
    decoded,
    encode_texts,
    painted_file,
    painted_looks,
    painted_scene,
    painted_splats,
)
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import save

from lab.baselines import BASELINES
from lang3dxl_ns.commands.view import Info
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.scene_file import Provenance, describe_scene_file, read_scene, write_scene
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.query.relevancy import TEMPERATURE
from lang3dxl_ns.query.scene import Scene

ATOL = 1e-4 * TEMPERATURE
"""Of relevancies, whose slope is a quarter of the temperature: files hold half the digits."""


@pytest.fixture
def written(tmp_path):
    scene = painted_scene(
        **decoded("gathered"), looks=painted_looks(), background=torch.tensor([0.2, 0.0, 1.0])
    )
    path = tmp_path / "wall.scene"
    write_scene(path, scene, Provenance(title="A wall", credit="Painters", license="CC BY 4.0"))
    return scene, path


def test_a_scene_survives_its_file(written):
    scene, path = written
    found = read_scene(path, "cpu", encode_texts=encode_texts)
    for word in ("dome", '"window not a word"', "wall"):
        np.testing.assert_allclose(found.relevancy(word), scene.relevancy(word), atol=ATOL)
    for photo in ("0001", "0003"):
        here, there = scene.query("dome", photo), found.query("dome", photo)
        np.testing.assert_allclose(there.relevancy, here.relevancy, atol=2 * ATOL)
        error = (there.view.pixels.astype(float) - here.view.pixels) / 255
        assert 10 * np.log10(1 / np.square(error).mean()) > 45
    lit = found.render("0002", look="0001").pixels.astype(int)  # by its stem, like every photo
    assert np.abs(lit - scene.render("0002", look="left/0001.jpg").pixels).max() <= 3
    assert [asdict_of(p) for p in found.photos] == [asdict_of(p) for p in scene.photos]
    assert (found.file.clip, found.file.scale) == (scene.file.clip, scene.file.scale)


def asdict_of(photo):
    return photo.name, photo.split, photo.camera_to_world, photo.lens, photo.size


@pytest.mark.parametrize("looks", [None, painted_looks()], ids=["one lighting", "looks"])
def test_common_words_need_no_clip(tmp_path, looks):
    """The CLIP that this scene names is nowhere."""
    scene, path = painted_scene(**decoded("gathered"), looks=looks), tmp_path / "wall.scene"
    write_scene(path, scene)
    found = read_scene(path, "cpu")
    for word in ("dome", "windows", "pilasters"):
        np.testing.assert_allclose(found.relevancy(word), scene.relevancy(word), atol=2 * ATOL)
    with pytest.raises(UserError, match="clip"):
        found.relevancy("a word that nobody stored")


def test_unknown_gaussians_stay_unknown(written):
    scene, path = written
    assert torch.equal(read_scene(path, "cpu").codes.isnan(), scene.codes.isnan())


@pytest.mark.parametrize("name", ["gathered", "paper", *BASELINES])
def test_every_decoder_answers_from_its_file_as_before(name, tmp_path):
    scene = painted_scene(**decoded(name))
    write_scene(tmp_path / "a.scene", scene)
    found = read_scene(tmp_path / "a.scene", "cpu", encode_texts=encode_texts)
    np.testing.assert_allclose(found.relevancy("dome"), scene.relevancy("dome"), atol=2 * ATOL)


def test_colors_alone_make_a_scene(tmp_path):
    write_scene(tmp_path / "a.scene", Scene(painted_splats(), painted_file()))
    found = read_scene(tmp_path / "a.scene", "cpu")
    assert found.decoder is None and found.render("0003").pixels.any()


def test_a_gaussian_of_one_color_takes_at_most_48_bytes(tmp_path):
    small, large = painted_scene(**decoded("gathered")), painted_scene(**decoded("gathered"))
    rows = torch.arange(len(large.splats)).repeat(4)
    large = painted_scene(splats=large.splats.select(rows), decoder=large.decoder, codes=large.codes[rows])
    sizes = [write_scene(tmp_path / "a.scene", scene) for scene in (small, large)]
    assert (sizes[1] - sizes[0]) / (3 * len(small.splats)) <= 48


def test_the_file_tells_what_it_is_without_paths_of_its_machine(written, tmp_path):
    scene, path = written
    told = describe_scene_file(path)
    assert told["provenance"].credit == "Painters" and told["gaussians"] == COUNT and told["photos"] == 4
    scene.file.photos[0] = replace(scene.file.photos[0], mask=str(tmp_path / "somewhere" / "mask.png"))
    file = replace(scene.file, data="/home/somebody/wall")
    scene = painted_scene(file=file, decoder=scene.decoder, codes=scene.codes)
    write_scene(path, scene)
    assert b"/home" not in path.read_bytes() and b"somewhere" not in path.read_bytes()


def test_info_takes_a_file_or_the_folder_that_holds_it(written, capsys):
    _, path = written
    told = []
    for place in (path, path.parent):
        Info(scene=place).main()
        told.append(capsys.readouterr().out)
    assert told[0] == told[1] and f"{COUNT:,}" in told[0] and "Painters" in told[0]


def test_foregrounds_travel_with_the_scene(tmp_path):
    mask = np.zeros((24, 24), np.uint8)
    mask[:, 12:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    scene = painted_scene()
    scene = painted_scene(**decoded("gathered"))
    scene.file.photos[2] = replace(scene.file.photos[2], mask=str(tmp_path / "mask.png"))
    expected = scene.query("dome", "0003").relevancy
    write_scene(tmp_path / "a.scene", scene)
    (tmp_path / "mask.png").unlink()
    found = read_scene(tmp_path / "a.scene", "cpu", encode_texts=encode_texts).query("dome", "0003").relevancy
    assert not found[:, :48].any() and found[:, 48:].any()
    np.testing.assert_allclose(found, expected, atol=2e-3)


# ── hostile files ───────────────────────────────────────────────────────────────────────────────────────


def rewritten(path, change, tensors=None):
    """The file with another description, or other tensors."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    told = json.loads(header["__metadata__"]["lang3dxl"])
    change(told, header)
    header["__metadata__"]["lang3dxl"] = json.dumps(told)
    data = json.dumps(header).encode()
    data += b" " * (-len(data) % 8)
    path.write_bytes(struct.pack("<Q", len(data)) + data + content[8 + length :])


def set_at(told, value, *keys):
    for key in keys[:-1]:
        told = told[key]
    told[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("version",), "no number"),
        (("scene", "photos"), []),
        (("scene", "photos", 0, "lens", "fx"), "wide"),
        (("scene", "photos", 0, "camera_to_world"), [[1, 2], [3]]),
        (("scene",), None),
        (("provenance", "title"), 7),
        (("provenance",), {"evil": 1}),
        (("background",), [0, 0]),
        (("background",), ["0", "0", "0"]),
        (("antialiased",), "yes"),
        (("decoder", "name"), "os.system"),
        (("decoder", "clip_dim"), 10**9),
        (("decoder", "clip_dim"), -4),
        (("decoder", "settings", "levels"), 10**6),
        (("decoder", "settings", "log2_table_size"), 62),
        (("decoder", "settings", "hidden_width"), 99_999),
        (("decoder", "settings", "levels"), [1, 2]),
        (("decoder", "settings", "evil"), 1),
        (("looks", "names"), ["a"]),
        (("looks", "names"), "abc"),
        (("looks", "config", "vector_dim"), 10**9),
        (("looks", "config", "preset"), "nope"),
    ],
)
def test_a_description_that_lies_is_one_sentence(written, keys, value):
    _, path = written
    rewritten(path, lambda told, _: set_at(told, value, *keys))
    with pytest.raises(UserError, match=r"wall.scene"):
        read_scene(path, "cpu")


def test_a_newer_format_is_told(written):
    _, path = written
    rewritten(path, lambda told, _: told.update(version=2))
    for read in (read_scene, describe_scene_file):
        with pytest.raises(UserError, match=r"format 2.*update"):
            read(path)


@pytest.mark.parametrize("name", ["means", "codes", "logits", "decoder.output.weight", "looks.vectors"])
def test_tensors_of_wrong_shapes_are_refused(written, name):
    _, path = written

    def change(_, header):
        shape = header[name]["shape"]
        header[name]["shape"] = (
            [shape[0] * 2, *shape[1:]] if len(shape) == 1 else [shape[1], shape[0], *shape[2:]]
        )

    rewritten(path, change)
    with pytest.raises(UserError, match=r"wall.scene"):
        read_scene(path, "cpu")


def altered(path, change):
    """The file with other tensors."""
    with safe_open(path, "np") as file:
        tensors, metadata = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118
    path.write_bytes(save(change(tensors), metadata))


@pytest.mark.parametrize(
    ("name", "rows", "said"),
    [
        ("means", slice(None), "no value of means is a number"),
        ("words", slice(None), "no value of words is a number"),
        ("words", slice(1), "its words are not made of numbers"),
        ("decoder.output.bias", slice(1), "its decoder is not made of numbers"),
    ],
)
def test_a_scene_without_numbers_is_refused_rather_than_answered_with_0(written, name, rows, said):
    _, path = written

    def spoiled(tensors):
        tensors[name] = tensors[name].copy()
        tensors[name][rows] = np.nan
        return tensors

    altered(path, spoiled)
    with pytest.raises(UserError, match=rf"wall\.scene is not a readable scene \({said}\)"):
        read_scene(path, "cpu")


def test_codes_and_words_of_another_width_and_a_scene_of_nothing_are_refused(written):
    _, path = written
    whole = path.read_bytes()
    altered(path, lambda t: t | {"codes": np.concatenate([t["codes"], t["codes"][:, :1]], axis=1)})
    with pytest.raises(UserError, match=r"codes has the shape"):
        read_scene(path, "cpu")
    path.write_bytes(whole)
    altered(path, lambda t: t | {"words": t["words"][:, :8].copy()})
    with pytest.raises(UserError, match=r"words has the shape"):
        read_scene(path, "cpu")
    path.write_bytes(whole)
    each = ("means", "quats", "log_scales", "logits", "harmonics", "codes")
    altered(path, lambda t: {name: value[:0] if name in each else value for name, value in t.items()})
    with pytest.raises(UserError, match=r"it holds no Gaussian"):
        read_scene(path, "cpu")


def test_numbers_that_no_bytes_stand_for_allocate_nothing(written):
    _, path = written
    whole, wide = path.read_bytes(), np.zeros((0, 10**12), np.float32)
    altered(path, lambda t: t | {"looks.vectors": wide, "looks.from_photo.weight": wide})
    rewritten(path, lambda told, _: told["looks"].update(names=[]))
    rewritten(path, lambda told, _: set_at(told, 10**12, "looks", "config", "vector_dim"))
    with pytest.raises(UserError, match=r"wall\.scene is not a readable scene \(its looks\)"):
        read_scene(path, "cpu")
    path.write_bytes(whole)
    rewritten(path, lambda told, _: set_at(told, 99_999, "decoder", "settings", "fourier_frequencies"))
    with pytest.raises(UserError, match=r"its decoder has too many layers"):
        read_scene(path, "cpu")


def test_a_mask_whose_pixels_are_no_picture_is_told_where_it_is_needed(written):
    _, path = written
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 96, 96, 8, 0, 0, 0, 0)), (b"IDAT", b"no zlib"), (b"IEND", b"")]
    chunks = (
        struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts
    )  # with sound checksums
    mask = np.frombuffer(b"\x89PNG\r\n\x1a\n" + b"".join(chunks), np.uint8)
    altered(path, lambda tensors: tensors | {"mask.0": mask})
    scene = read_scene(path, "cpu", encode_texts=encode_texts)
    with pytest.raises(UserError, match=rf"the foreground of {scene.photos[0].name} can't be read"):
        scene.query("dome", scene.photos[0].name)


@pytest.mark.parametrize("size", [30_000, 24])
def test_a_mask_that_is_damaged_or_would_fill_the_memory_is_refused(written, size):
    _, path = written
    picture = io.BytesIO()
    Image.new("1", (size, size)).save(picture, "PNG")
    mask = np.frombuffer(picture.getvalue(), np.uint8).copy()
    if size < 100:
        mask[-20] ^= 1
    altered(path, lambda tensors: tensors | {"mask.0": mask})
    with pytest.raises(UserError, match=r"wall\.scene is not a readable scene \((Image size|broken PNG)"):
        read_scene(path, "cpu")


@pytest.mark.parametrize("content", [b"", b"\0" * 8, b"\xff" * 64, b"PK\x03\x04", b"no scene"])
def test_what_is_no_scene_is_refused(content, tmp_path):
    (tmp_path / "wall.scene").write_bytes(content)
    with pytest.raises(UserError, match=r"wall.scene"):
        read_scene(tmp_path / "wall.scene", "cpu")


def test_errors_of_the_device_are_not_the_files(written):
    _, path = written
    with pytest.raises(UserError, match=r"give cpu|this machine has \d+ GPUs") as error:
        read_scene(path, "cuda:63")
    assert "copy it again" not in str(error.value)


def test_other_names_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"must have the extension .scene"):
        write_scene(tmp_path / "a.ply", painted_scene())
    write_splats(tmp_path / "a.ply", painted_splats())
    with pytest.raises(UserError, match=r"a\.ply is not a readable scene .*: a splat .* lang3dxl attach"):
        read_scene(tmp_path / "a.ply")
    with pytest.raises(UserError, match="not a file"):
        read_scene(tmp_path / "none.scene")
    (tmp_path / "folder.scene").mkdir()
    with pytest.raises(UserError, match=r"folder\.scene is a folder"):
        write_scene(tmp_path / "folder.scene", painted_scene())
