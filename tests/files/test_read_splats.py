"""Splat files, our own and of other programs: one scene, however it is written; and files that are none."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from made_splats import assert_alike, gsplat_state, some_splats
from moved_splats import with_colors
from numpy.lib import recfunctions

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.files.activations import log_scales, logits
from lang3dxl_ns.files.read_splats import find_splats, read_splats
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.rendering import Splats
from lang3dxl_ns.rendering.projection import rotations


def table(path) -> tuple[list[str], np.ndarray]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().split("\n") if line.startswith("property")]
    return names, np.frombuffer(body, dtype=[(name, "<f4") for name in names])


def write_table(path, rows, form: str, kind: str, name: str) -> None:
    columns = "".join(f"property {name} {column}\n" for column in rows.dtype.names)
    header = f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex {len(rows)}\n{columns}end_header\n"
    numbers = recfunctions.structured_to_unstructured(rows)
    body = numbers.astype(kind).tobytes()
    if form == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in numbers.tolist()).encode()
    path.write_bytes(header.encode() + body)


def test_sizes_and_opacities_that_are_no_logarithms_and_logits_are_read_as_they_are(tmp_path, capsys):
    splats = some_splats(7)
    splats.scales[:] *= 100  # sizes in centimeters
    write_splats(tmp_path / "a.ply", splats)
    assert_alike(read_splats(tmp_path / "a.ply"), splats, scales=1e-4)
    assert "as they are" not in capsys.readouterr().out
    names, rows = table(tmp_path / "a.ply")
    rows = rows.copy()
    for name in (name for name in names if name.startswith("scale")):
        rows[name] = np.exp(rows[name])
    rows["opacity"] = 1 / (1 + np.exp(-rows["opacity"]))
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    assert_alike(read_splats(tmp_path / "b.ply"), splats, scales=1e-4, colors=1e-5)
    assert "taken as they are" in capsys.readouterr().out
    write_table(tmp_path / "c.ply", rows[[n for n in names if n != "f_dc_1"]].copy(), "ascii", "<f4", "float")
    with pytest.raises(UserError, match="its Gaussians have no f_dc_1"):
        read_splats(tmp_path / "c.ply")


@pytest.mark.parametrize("same", [False, True])
def test_opacities_that_are_no_logits_are_read_as_they_are_beside_logarithms(same, tmp_path, capsys):
    """As networks that make a splat of a few photos, and converters of meshes, write them."""
    splats = some_splats(30)
    splats.opacities[:] = 1.0 if same else splats.opacities
    write_splats(tmp_path / "a.ply", splats)
    rows = table(tmp_path / "a.ply")[1].copy()
    rows["opacity"] = splats.opacities
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    assert_alike(read_splats(tmp_path / "b.ply"), splats)
    assert "its opacities are not logits, and are taken as they are" in capsys.readouterr().out
    write_table(tmp_path / "few.ply", rows[:6], "binary_little_endian", "<f4", "float")  # may be by chance
    torch.testing.assert_close(read_splats(tmp_path / "few.ply").opacities, splats.opacities[:6].sigmoid())


def test_a_mip_splatting_is_as_wide_and_as_faint_as_it_was_drawn(tmp_path):
    """Its Gaussians, convolved with a filter of their own size, keep their mass in every direction."""
    splats, width = some_splats(20), torch.linspace(0, 0.5, 20)
    write_splats(tmp_path / "a.ply", splats)
    rows = recfunctions.append_fields(table(tmp_path / "a.ply")[1], "filter_3D", width.numpy(), usemask=False)
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    found = read_splats(tmp_path / "b.ply")
    torch.testing.assert_close(found.scales**2, splats.scales**2 + width[:, None] ** 2)
    mass = [one.opacities * one.scales.prod(1) for one in (found, splats)]
    torch.testing.assert_close(*mass)
    torch.testing.assert_close(found.opacities[0], splats.opacities[0])


def test_every_property_of_a_ply_is_in_its_place(tmp_path):
    splats, relevancy = some_splats(7), torch.linspace(0, 1, 7)
    splats.scales[2, 1] = torch.nan  # broken Gaussians stay out
    assert write_splats(tmp_path / "a.ply", splats, relevancy) == 6
    names, rows = table(tmp_path / "a.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [*(f"f_rest_{i}" for i in range(9)), "opacity", "scale_0", "scale_1", "scale_2"]
    assert names == [*expected, "rot_0", "rot_1", "rot_2", "rot_3", "relevancy"] and len(rows) == 6
    keep = splats.sound()
    splats = splats.select(keep)
    np.testing.assert_array_equal(rows["y"], splats.means[:, 1])
    np.testing.assert_allclose(1 / (1 + np.exp(-rows["opacity"])), splats.opacities, atol=1e-5)
    np.testing.assert_allclose(np.exp(rows["scale_1"]), splats.scales[:, 1], rtol=1e-5)
    np.testing.assert_array_equal(rows["relevancy"], relevancy[keep])
    np.testing.assert_array_equal(rows["f_dc_2"], splats.harmonics[:, 0, 2])
    for channel in range(3):
        np.testing.assert_array_equal(rows[f"f_rest_{3 * channel}"], splats.harmonics[:, 1, channel])
    with pytest.raises(UserError, match=r"use .ply, .spz, .sog or .glb"):
        write_splats(tmp_path / "all.obj", splats)


@pytest.mark.parametrize("ending", ["ply", "spz", "sog", "glb"])
def test_a_file_without_a_gaussian_is_not_written(ending, tmp_path):
    splats = some_splats(5)
    broken = replace(splats, means=torch.full_like(splats.means, torch.nan))
    for none in (splats.select(torch.zeros(5, dtype=torch.bool)), broken):
        with pytest.raises(UserError, match=rf"no Gaussian is left for a\.{ending}.*--hide-floaters"):
            write_splats(tmp_path / f"a.{ending}", none)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_what_is_written_as_ply_is_read_back(bands, tmp_path):
    splats = some_splats(bands=bands)
    write_splats(tmp_path / "a.ply", splats, torch.rand(len(splats)))
    assert_alike(read_splats(tmp_path / "a.ply"), splats)


@pytest.mark.parametrize(
    ("form", "kind", "name"),
    [
        ("binary_big_endian", ">f4", "float"),
        ("binary_little_endian", "<f8", "double"),
        ("ascii", "f4", "float32"),
    ],
)
def test_byte_order_number_type_and_order_of_columns_make_no_difference(form, kind, name, tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    names, rows = table(tmp_path / "a.ply")
    write_table(tmp_path / "b.ply", rows[names[::-1]], form, kind, name)
    assert_alike(read_splats(tmp_path / "b.ply"), splats)


@pytest.mark.parametrize("most", [1, 255])
def test_plain_colors_are_bytes_or_fractions(tmp_path, most):
    splats = some_splats(bands=1)
    write_splats(tmp_path / "a.ply", splats)
    rows = table(tmp_path / "a.ply")[1].copy()
    for i in range(3):
        rows[f"f_dc_{i}"] = most * (rows[f"f_dc_{i}"] * 0.28209479 + 0.5)
    plain = dict(zip(("f_dc_0", "f_dc_1", "f_dc_2"), ("red", "green", "blue"), strict=True))
    rows = recfunctions.rename_fields(rows, plain)
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    assert_alike(read_splats(tmp_path / "b.ply"), splats, colors=1e-5)


@pytest.mark.parametrize(("kind", "name", "most"), [("u1", "uchar", 255), ("<u2", "ushort", 65535)])
def test_plain_colors_that_are_whole_numbers_are_never_fractions(tmp_path, kind, name, most):
    """Also in a splat so dark that none is over 1."""
    write_splats(tmp_path / "a.ply", some_splats(bands=1))
    lines, rows = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0], table(tmp_path / "a.ply")[1]
    for colors in (np.ones((300, 3)), np.full((300, 3), most)):
        kinds = [(n, kind if n[:5] == "f_dc_" else "<f4") for n in rows.dtype.names]
        stored = rows.astype(kinds)
        for i in range(3):
            stored[f"f_dc_{i}"] = colors[:, i]
            plain = ("red", "green", "blue")[i]
            lines = lines.replace(b"float f_dc_%d" % i, b"%b %b" % (name.encode(), plain.encode()))
        (tmp_path / "b.ply").write_bytes(lines + b"end_header\n" + stored.tobytes())
        shown = read_splats(tmp_path / "b.ply").harmonics[:, 0] * 0.28209479 + 0.5
        wanted = colors[0, 0] / (255 if colors[0, 0] <= 255 else most)
        assert torch.allclose(shown, torch.tensor(wanted, dtype=torch.float32), atol=1e-3)


def test_columns_may_have_capitals(tmp_path):
    write_splats(tmp_path / "a.ply", splats := some_splats(bands=1))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    for name in table(tmp_path / "a.ply")[0]:
        head = head.replace(b"float %b\n" % name.encode(), b"float %b\n" % name.upper().encode())
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + body)
    assert_alike(read_splats(tmp_path / "b.ply"), splats)


def test_an_spz_may_be_unpacked_already(tmp_path):
    write_splats(tmp_path / "a.spz", some_splats())
    (tmp_path / "b.spz").write_bytes(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    assert_alike(read_splats(tmp_path / "b.spz"), read_splats(tmp_path / "a.spz"))


def test_two_dimensional_gaussians_are_thin(tmp_path):
    write_splats(tmp_path / "a.ply", some_splats())
    names, rows = table(tmp_path / "a.ply")
    write_table(
        tmp_path / "b.ply", rows[[n for n in names if n != "scale_2"]], "binary_little_endian", "<f4", "float"
    )
    scales = read_splats(tmp_path / "b.ply").scales
    assert bool((scales[:, 2] < 0.01 * scales[:, :2].amin(1)).all())


def test_supersplats_compressed_ply_is_read(tmp_path):
    gsply = pytest.importorskip("gsply")
    splats = some_splats(700)
    rest = splats.harmonics[:, 1:].numpy()
    parts = (splats.means, log_scales(splats), splats.quats, logits(splats), splats.harmonics[:, 0])
    data = gsply.GSData(*(part.numpy().copy() for part in parts), rest.copy())
    (tmp_path / "a.compressed.ply").write_bytes(gsply.compress_to_bytes(data))
    found = read_splats(tmp_path / "a.compressed.ply")
    # The writer may sort them.
    order = [torch.cdist(found.means, splats.means).argmin(1)]
    wanted = splats.select(order[0])
    assert_alike(found, wanted, means=5e-3, scales=5e-3, opacities=5e-3, colors=0.03, turn=1e-4)
    content = (tmp_path / "a.compressed.ply").read_bytes()
    tagged = content.replace(b"element chunk", b"comment SplatRenderMode: mip\nelement chunk", 1)
    (tmp_path / "c.compressed.ply").write_bytes(tagged)
    assert read_splats(tmp_path / "c.compressed.ply").antialiased and not found.antialiased
    # Older versions stored no bounds of the colors.
    (tmp_path / "b.compressed.ply").write_bytes(content.replace(b"float min_r\n", b"float other\n"))
    with pytest.raises(UserError, match=r"b\.compressed\.ply: an older SuperSplat wrote it: open it"):
        read_splats(tmp_path / "b.compressed.ply")


def test_an_spz_is_read(tmp_path):
    gsply = pytest.importorskip("gsply")
    splats = some_splats()
    write_splats(tmp_path / "a.spz", splats)
    found = read_splats(tmp_path / "a.spz")
    assert_alike(found, splats, means=1e-3, scales=0.04, opacities=5e-3, colors=0.02, turn=1e-4)
    assert not found.antialiased
    # Version 4 has streams of zstd. Its byte 14 has flags, of which the first is for antialiasing.
    gsply.write_spz(tmp_path / "b.spz", gsply.read_spz(tmp_path / "a.spz"), version=4)
    content = bytearray((tmp_path / "b.spz").read_bytes())
    content[14] = 1
    (tmp_path / "b.spz").write_bytes(content)
    again = read_splats(tmp_path / "b.spz")
    assert again.antialiased
    assert_alike(again, splats, means=1e-3, scales=0.04, opacities=5e-3, colors=0.02, turn=1e-4)


def test_a_splat_of_the_web_is_read(tmp_path):
    splats = some_splats(bands=1)
    colors = torch.cat([(splats.harmonics[:, 0] * 0.28209479 + 0.5), splats.opacities[:, None]], dim=1)
    rows = np.zeros(len(splats), [("m", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    rows["m"], rows["s"] = splats.means, splats.scales
    rows["c"] = (colors * 255).round()
    rows["q"] = (F.normalize(splats.quats, dim=1) * 128 + 128).round().clamp(0, 255)
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    assert_alike(read_splats(tmp_path / "a.splat"), splats, opacities=3e-3, colors=0.01, turn=1e-4)


@pytest.mark.parametrize("ending", [".ply", ".spz", ".glb"])
@pytest.mark.parametrize("named", ["a.splat", "a.spz", "b.ply", "a.txt", "a"])
def test_a_file_is_what_its_first_bytes_say_whatever_its_name(ending, named, tmp_path):
    write_splats(tmp_path / f"true{ending}", some_splats())
    (tmp_path / named).write_bytes((tmp_path / f"true{ending}").read_bytes())
    found, expected = (read_splats(tmp_path / name) for name in (named, f"true{ending}"))
    assert_alike(found, expected)


def test_a_run_folder_means_its_latest_splat(tmp_path):
    for step in (7_000, 30_000, 9_000):
        place = tmp_path / "point_cloud" / f"iteration_{step}"
        place.mkdir(parents=True)
        write_splats(place / "point_cloud.ply", some_splats(10))
    assert find_splats(tmp_path).parent.name == "iteration_30000"


def test_gaussians_with_nan_keep_their_place_and_are_invisible(tmp_path, capsys):
    splats = some_splats()
    broken = splats.means.clone()
    broken[[3, 70]] = torch.tensor([torch.nan, 0, torch.inf])
    state = gsplat_state(Splats(broken, splats.quats, splats.scales, splats.opacities, splats.harmonics))
    torch.save(state, tmp_path / "a.pt")
    found = read_splats(tmp_path / "a.pt")
    assert "a.pt: 0.67% of its Gaussians have NaN" in capsys.readouterr().out.replace("\n", " ")
    assert len(found) == len(splats) and bool(found.sound().all())
    assert float(found.opacities[[3, 70]].max()) == 0
    keep = torch.arange(len(splats)) % 67 != 3
    assert_alike(found.select(keep), splats.select(keep))
    torch.save(gsplat_state(Splats(broken * torch.nan, *list(vars(splats).values())[1:5])), tmp_path / "b.pt")
    with pytest.raises(UserError, match="100% of its Gaussians"):
        read_splats(tmp_path / "b.pt")


class _Evil:
    def __reduce__(self):
        return print, ("this was run",)


def bad_files(folder) -> dict[str, bytes]:
    zstandard = pytest.importorskip("zstandard")
    write_splats(folder / "good.ply", some_splats(20))
    good = (folder / "good.ply").read_bytes()
    torch.save({"splats": _Evil()}, folder / "evil.pt")
    huge = struct.pack("<IIIBBBB", 0x5053474E, 3, 4_000_000_000, 3, 12, 0, 0)
    bomb = struct.pack("<IIIBBBB", 0x5053474E, 3, 10, 0, 12, 0, 0) + bytes(20_000_000)
    zeros = zstandard.ZstdCompressor().compress(bytes(20_000_000))
    streams = struct.pack("<IIIBBBBI", 0x5053474E, 4, 10, 0, 12, 0, 5, 32) + bytes(12)
    for size in (90, 10, 30, 30, 40):
        streams += struct.pack("<QQ", len(zeros), size)
    return {
        "empty.ply": b"",
        "text.ply": b"hello",
        "cut.ply": good[:-1],
        "header.ply": good[:200],
        "huge.ply": good.replace(b"vertex 20", b"vertex 99999999999"),
        "negative.ply": good.replace(b"vertex 20", b"vertex -20"),
        "words.ply": good.replace(b"vertex 20", b"vertex many"),
        "types.ply": good.replace(b"float x", b"quark x"),
        "points.ply": good.replace(b"opacity", b"opaque!"),
        "none.ply": good.replace(b"vertex 20", b"vertex 0"),
        "odd.ply": good.replace(b"f_rest_0", b"f_best_0"),
        "cut.splat": bytes(33),
        "empty.splat": b"",
        "huge.spz": gzip.compress(huge),
        "bomb.spz": gzip.compress(bomb),
        "text.spz": b"hello",
        "altered.spz": gzip.compress(bomb)[:12] + 40 * b"\xff" + gzip.compress(bomb)[52:],
        "huge-4.spz": struct.pack("<IIIBBBBI", 0x5053474E, 4, 4_000_000_000, 0, 12, 0, 5, 32) + bytes(12),
        "bomb-4.spz": streams + 5 * zeros,
        "text-4.spz": streams + b"hello" * 20,
        "evil.pt": (folder / "evil.pt").read_bytes(),
        "text.ckpt": b"hello",
        "a.obj": b"v 0 0 0",
    }


def test_every_bad_file_ends_in_one_sentence(tmp_path, capsys):
    for name, content in bad_files(tmp_path).items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError) as error:
            read_splats(tmp_path / name)
        assert name in str(error.value), error.value
        assert "\n" not in str(error.value)
    assert capsys.readouterr().out == ""


def test_an_spz_is_measured_before_it_is_unpacked(tmp_path):
    files = bad_files(tmp_path)
    for name in ("bomb.spz", "bomb-4.spz", "huge.spz", "huge-4.spz"):
        (tmp_path / name).write_bytes(files[name])
        with pytest.raises(UserError, match="unpacks to more" if "bomb" in name else "GB of memory"):
            read_splats(tmp_path / name)


def test_a_ply_cut_anywhere_is_refused(tmp_path):
    write_splats(tmp_path / "a.ply", some_splats(20))
    content = (tmp_path / "a.ply").read_bytes()
    for length in range(0, len(content), 41):
        (tmp_path / "b.ply").write_bytes(content[:length])
        with pytest.raises(UserError):
            read_splats(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("form", "old", "new", "said"),
    [
        (
            "ascii",
            b" 0.0 ",
            b" 0.0 0.5 ",
            r"it has \d+ numbers, not \d+",
        ),  # each row after it would be shifted
        ("ascii", b" 0.0 ", b" 0,5 ", r"it has \d+ numbers, not \d+|something else than numbers"),
        ("ascii", b"vertex 5", b"vertex 4", r"it has \d+ numbers, not \d+"),
        (
            "binary_little_endian",
            b"end_header",
            b"property list uchar int id\nend_header",
            "it announces more than it holds",
        ),
        ("binary_little_endian", b"vertex 5", b"vertex 0", "holds no Gaussian: export it again"),
    ],
)
def test_rows_that_are_not_as_announced_are_refused_rather_than_read_shifted(form, old, new, said, tmp_path):
    write_splats(tmp_path / "a.ply", some_splats(5))
    _, rows = table(tmp_path / "a.ply")
    write_table(tmp_path / "b.ply", rows, form, "<f4", "float")
    content = (tmp_path / "b.ply").read_bytes()
    assert len(read_splats(tmp_path / "b.ply")) == 5 and old in content
    (tmp_path / "b.ply").write_bytes(content.replace(old, new, 1))
    with pytest.raises(UserError, match=said):
        read_splats(tmp_path / "b.ply")


@pytest.mark.parametrize(("order", "kind"), [("little", "<f4"), ("big", ">f4")])
def test_rows_that_no_table_announces_are_told(order, kind, tmp_path, capsys):
    write_splats(tmp_path / "a.ply", some_splats(5))
    write_table(tmp_path / "b.ply", table(tmp_path / "a.ply")[1], f"binary_{order}_endian", kind, "float")
    content = (tmp_path / "b.ply").read_bytes()
    assert len(read_splats(tmp_path / "b.ply")) == 5 and "more than" not in capsys.readouterr().out
    (tmp_path / "b.ply").write_bytes(content.replace(b"vertex 5", b"vertex 3", 1))
    assert len(read_splats(tmp_path / "b.ply")) == 3
    assert "b.ply holds 2 rows more than its header announces" in capsys.readouterr().out


def test_comments_and_properties_of_other_programs_are_skipped(tmp_path):
    write_splats(tmp_path / "a.ply", some_splats(5))
    _, rows = table(tmp_path / "a.ply")
    write_table(tmp_path / "b.ply", rows, "ascii", "<f4", "float")
    told = "comment not the end_header: Åformat none".encode()  # in Latin 1, Å ends a line
    content = (tmp_path / "b.ply").read_bytes().replace(b"comment by hand", told)
    renamed = content.replace(b"float nx\n", b"float f_rest_of_mine\n")
    assert renamed != content and b"not the end_header" in content
    for path, written in (("c.ply", content), ("d.ply", renamed)):
        (tmp_path / path).write_bytes(written)
        torch.testing.assert_close(read_splats(tmp_path / path).means, read_splats(tmp_path / "a.ply").means)


def test_a_missing_file_and_a_folder_without_a_splat_are_named(tmp_path):
    for place in (tmp_path / "nothing.ply", tmp_path):
        with pytest.raises(UserError, match=place.name):
            read_splats(place)


@pytest.mark.parametrize("line", [b"property float x\n", b"element vertex 5\n"])
def test_what_a_ply_lists_twice_is_refused(line, tmp_path):
    write_splats(tmp_path / "a.ply", some_splats())
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    (tmp_path / "a.ply").write_bytes(header + line + b"end_header\n" + body)
    with pytest.raises(UserError, match=r"twice|more than once"):
        read_splats(tmp_path / "a.ply")


def test_an_spz_of_map_coordinates_is_refused_rather_than_cut(tmp_path):
    splats = some_splats(10)
    far = replace(splats, means=splats.means + torch.tensor([0.0, 9e6, 0.0]))
    with pytest.raises(UserError, match="these reach 9,000,00"):
        write_splats(tmp_path / "far.spz", far)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"means": 1e3}, ""),
        ({"means": 2e6}, "rounds places to 0.5 units"),
        ({"scales": 1e3}, "1 larger Gaussians are cut"),
    ],
)
def test_what_one_gaussian_costs_the_others_of_an_spz_is_told(change, said, tmp_path, capsys):
    splats = some_splats(50)
    for name, value in change.items():
        getattr(splats, name)[7, 0] = value
    write_splats(tmp_path / "a.spz", splats)
    told = capsys.readouterr().out
    assert said in told and bool(said) == bool(told)


# ── what other programs write ───────────────────────────────────────────────────────────────────────────


def spz_by_hand(splats: Splats, version: int, degree: int) -> bytes:
    """Encode SPZ of one gzip stream from the format's description, with harmonics of zero and no turns."""
    count, means = len(splats), splats.means.numpy()
    fixed = np.round(means * 4096).astype("<i4").view(np.uint8).reshape(count, 3, 4)[..., :3]
    turns = np.full((count, 3), 128, np.uint8) if version < 3 else np.full(count, 3 << 30, "<u4")
    parts = (
        means.astype("<f2") if version == 1 else fixed,
        np.round(splats.opacities.numpy() * 255).astype(np.uint8),
        np.clip(np.round(splats.harmonics[:, 0].numpy() * 38.25 + 127.5), 0, 255).astype(np.uint8),
        np.clip(np.round((log_scales(splats).numpy() + 10) * 16), 0, 255).astype(np.uint8),
        turns,
        np.full((count, 3 * ((degree + 1) ** 2 - 1)), 128, np.uint8),
    )
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0)
    return gzip.compress(head + b"".join(np.ascontiguousarray(part).tobytes() for part in parts))


@pytest.mark.parametrize(("version", "degree"), [(1, 0), (2, 1), (3, 2), (3, 4)])
def test_spz_of_every_version_and_degree_is_read(version, degree, tmp_path):
    splats = some_splats(bands=1)
    splats = replace(splats, quats=torch.tensor([[1.0, 0, 0, 0]]).expand(len(splats), 4))
    (tmp_path / "a.spz").write_bytes(spz_by_hand(splats, version, degree))
    found = read_splats(tmp_path / "a.spz")
    assert found.degree == min(degree, 3)
    assert_alike(
        with_colors(found, found.colors(torch.zeros(3))), with_colors(splats, splats.colors(torch.zeros(3))),
        means=4e-3, scales=0.04, opacities=5e-3, colors=0.02, turn=1e-4,
    )  # fmt: skip


def test_an_spz_that_tells_left_handed_axes_is_not_mirrored(tmp_path, capsys):
    """Directions of x, y, z: right or left, up or down, back or front."""
    splats = some_splats(bands=16)
    write_splats(tmp_path / "a.spz", splats)
    plain = gzip.decompress((tmp_path / "a.spz").read_bytes())
    kept, place = read_splats(tmp_path / "a.spz"), torch.tensor([0.3, -5.0, 1.0])
    names = [f"{x}{y}{z}" for z in "BF" for y in "DU" for x in "LR"]
    names += [f"{x}{z}{y}" for z in "BF" for y in "DU" for x in "LR"]
    for number, axes in enumerate(names, start=1):
        record = struct.pack("<III", 0xADBE0003, 4, number)
        (tmp_path / "b.spz").write_bytes(gzip.compress(plain[:14] + b"\2" + plain[15:] + record))
        found = read_splats(tmp_path / "b.spz")
        rows = {"R": (0, 1), "L": (0, -1), "U": (1, 1), "D": (1, -1), "B": (2, 1), "F": (2, -1)}
        flip = round(np.linalg.det([np.eye(3)[row] * sign for row, sign in (rows[one] for one in axes)]))
        mirror = torch.tensor([flip, 1, 1], dtype=torch.float32)
        torch.testing.assert_close(found.means, kept.means * mirror)
        torch.testing.assert_close(found.colors(place * mirror), kept.colors(place))
        whole, other = (rotations(one.quats) @ torch.diag_embed(one.scales**2) for one in (found, kept))
        whole, other = whole @ rotations(found.quats).mT, other @ rotations(kept.quats).mT
        torch.testing.assert_close(whole, mirror[:, None] * other * mirror)
        assert ("left-handed" in capsys.readouterr().out) == (flip < 0)


def test_our_spz_is_what_gsply_reads(tmp_path):
    """Another implementation agrees on every value, rotations included."""
    gsply = pytest.importorskip("gsply")
    splats = some_splats()
    write_splats(tmp_path / "a.spz", splats)
    other = gsply.read_spz(tmp_path / "a.spz")
    found = read_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(found.means, other.means, atol=1e-6)
    np.testing.assert_allclose(log_scales(found), other.scales, atol=1e-5)
    np.testing.assert_allclose(found.quats, other.quats, atol=1e-5)
    np.testing.assert_allclose(found.harmonics[:, 1:], other.shN, atol=1e-6)


@pytest.mark.parametrize("ending", ["ply", "spz", "sog", "glb"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_antialiasing_is_written_and_read_back(ending, antialiased, tmp_path):
    write_splats(tmp_path / f"a.{ending}", replace(some_splats(), antialiased=antialiased))
    assert read_splats(tmp_path / f"a.{ending}").antialiased == antialiased


@pytest.mark.parametrize(("line", "antialiased"), [("SplatRenderMode: mip", True), ("antialiased 0", False)])
def test_comments_of_trainers_tell_antialiasing(line, antialiased, tmp_path):
    write_splats(tmp_path / "a.ply", some_splats())
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"element", f"comment {line}\nelement".encode(), 1))
    assert read_splats(tmp_path / "a.ply").antialiased == antialiased


def test_cloudcompares_names_half_floats_and_lists_of_one_length_are_read(tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    names, rows = table(tmp_path / "a.ply")
    wide = np.zeros(
        len(rows), [*((n, "<f2" if n[0] == "n" else "<f4") for n in names), ("k", "u1"), ("i", "<i4", (2,))]
    )
    for name in names:
        wide[name] = rows[name]
    wide["k"] = 2
    kinds = {name: "half" if name[0] == "n" else "float" for name in names}
    lines = [f"property {kinds[n]} {n if n in 'xyz' else 'scalar_' + n}" for n in names]
    head = ["ply", "format binary_little_endian 1.0", "element camera 3", "property uchar id"]
    head += [f"element vertex {len(rows)}", *lines, "property list uchar int ids", "end_header", ""]
    (tmp_path / "b.ply").write_bytes("\n".join(head).encode() + bytes(3) + wide.tobytes())
    assert_alike(read_splats(tmp_path / "b.ply"), splats)
    wide["k"][7] = 1
    (tmp_path / "b.ply").write_bytes("\n".join(head).encode() + bytes(3) + wide.tobytes())
    with pytest.raises(UserError, match="hold lists ids of different lengths"):
        read_splats(tmp_path / "b.ply")


@pytest.mark.parametrize("share", [0.01, 0.8])
def test_rows_of_zeros_are_invisible(share, tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    names, rows = table(tmp_path / "a.ply")
    rows = rows.copy()
    empty = np.arange(len(rows)) >= len(rows) * (1 - share)
    for name in names:
        rows[name] = np.where(empty, 0, rows[name])
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    found = read_splats(tmp_path / "b.ply")
    assert found.opacities[empty].max() == 0
    assert_alike(found.select(torch.from_numpy(~empty)), splats.select(torch.from_numpy(~empty)))


HEAD = "ply\nformat ascii 1.0\nelement vertex 1\nproperty {} x\nend_header\n1\n"
TEN = HEAD.replace(
    "property {} x\n",
    "".join(
        f"property float {name}\n"
        for name in (
            *("x", "y", "z", "opacity", *(f"{part}_{i}" for part in ("f_dc", "scale") for i in range(3))),
            *(f"rot_{i}" for i in range(4)),
            *(f"f_rest_{i}" for i in range(10)),
        )
    ),
).replace("\n1\n", "\n" + "1 " * 24)
SPZ = struct.Struct("<IIIBBBB")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.spz", SPZ.pack(0x5053474E, 9, 1, 0, 12, 0, 0), "SPZ of version 9; 1 to 4 can be read"),
        (
            "a.spz",
            gzip.compress(SPZ.pack(0x5053474E, 3, 1, 7, 12, 0, 0), mtime=0),
            "have degree 7; 0 to 4 can be",
        ),
        ("a.ply", HEAD.format("quark").encode(), "column x has the type quark"),
        ("a.ply", HEAD.format("float").encode(), "no y, z, opacity"),
        ("a.ply", TEN.encode(), "has 10 columns f_rest, not 9, 24, 45 or 72"),
        ("a.ksplat", b"PK", r"SuperSplat makes a \.ply of others"),
    ],
)
def test_a_refusal_names_version_degree_type_or_column(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said) as error:
        read_splats(tmp_path / name)
    assert "damaged" not in str(error.value)


def test_a_scene_is_told_from_unknown_formats(tmp_path):
    for name, told in (("a.scene", "a scene already"), ("a.usd", "unsupported format")):
        (tmp_path / name).write_bytes(b"PK")
        with pytest.raises(UserError, match=told):
            read_splats(tmp_path / name)


@pytest.mark.parametrize("further", ["X", "scalar_x", "scalar_Opacity", "Red"])
def test_a_column_is_not_taken_for_one_whose_name_it_resembles(further, tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    _, rows = table(tmp_path / "a.ply")
    rows = recfunctions.append_fields(rows, further, np.full(len(rows), 7, "<f4"), usemask=False)
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    assert_alike(read_splats(tmp_path / "b.ply"), splats)


@pytest.mark.parametrize(
    ("without", "told"),
    [
        (("f_dc_0", "f_dc_1", "f_dc_2"), "its Gaussians have no f_dc_0, f_dc_1, f_dc_2: export"),
        (("scale_1", "scale_2"), "its Gaussians have no scale_1: export them as"),
        (("opacity",), "a point cloud: its points have no opacity"),
    ],
)
def test_a_splat_of_another_kind_is_not_called_a_point_cloud(without, told, tmp_path):
    """As Scaffold-GS makes, whose colors come from a network, or one of balls."""
    write_splats(tmp_path / "a.ply", some_splats(9))
    _, rows = table(tmp_path / "a.ply")
    rows = recfunctions.drop_fields(rows, list(without), usemask=False)
    write_table(tmp_path / "b.ply", rows, "binary_little_endian", "<f4", "float")
    with pytest.raises(UserError, match=told):
        read_splats(tmp_path / "b.ply")
