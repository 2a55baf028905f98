"""Pictures and masks of every kind, as cameras and other programs leave them."""

import base64
import io
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, PngImagePlugin, TiffImagePlugin
from scenes import write_transforms

from lang3dxl_ns.common.pictures import mask_values, open_picture
from lang3dxl_ns.scene.capture import open_capture
from lang3dxl_ns.scene.capture_settings import CaptureSettings
from lang3dxl_ns.scene.matching import numbered
from lang3dxl_ns.scene.photo_folder import find_photos, readable

HEIC = (
    b"c-muNV30{GsVvAy%}izhg51nBLl8SRGck>Uf$?~5YDppk1Sn>t<P<^K3<a6VB@Af5Br_);Y>0~k0}}%yh{gCCLIXhqPz(r|v"
    b"f&~sKx~njnU@CUfn-I2oK&zfpqh-bWJ3ldK}L`g*NRNAa=wDhl3WI;N=CNKf}#Q-`)OuDaz2nQ1?qKXWCjUM04tLF!0_kqj~"
    b"@&S{LBeJ9TE<VJdFSUgA_1>R4{{(+%6`EM4+Um6C)#<%mRf*)@iTS&3g7galwHG1_qu6kZ?;9P&Jzi<H6#Coj^N;lk;<m@{)"
    b"5ZfTFw%Y(OOpBALYnsZifKK(R)0P9n%*3J|w5NPy`7|NlP#g#nPh0Sya*g3O9ckVa+>4h|s2nOT%y0(1_8WM)AwEKV4Kes5%"
    b"AW^HK$a-=egQq!Oke90-r$>3N3*|8=!B@q-|H5!cTg%y|2-SJgRL-1h0AG`jIyt7|$WC`jt#jf95F7o@-^M>scBA)1RP1v!k"
    b"@`?O{9ly6dxZRU0<D2rwsr>TZBa5;=%o5IyHEW%>;^3$J_YSkuPRXZk;deN%J%86%>2@*hMvr*sob(+ohgPi@xRf2{E1;}!;"
    b"vdh~`Yt|@|JWeW=j+R$1>|usFfs~(LKqZ`5N87bqkNeX"
)
"""HEIC of 32 × 24 pixels (8 x, 10 y, 60), stored lying: it is turned clockwise by a quarter when shown."""


def heic() -> bytes:
    return zlib.decompress(base64.b85decode(HEIC))


# ── masks ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("place", ["masks", "mask"])
@pytest.mark.parametrize(
    "form", ["{}.png", "{}.jpg", "{}.png.png", "{}_mask.png", "{}.png.mask.png", "{}.mask.png", "mask_{}.png"]
)
def test_masks_are_found_by_every_usual_name(folder, place, form):
    (folder / place).mkdir()
    for i in range(6):
        Image.new("L", (96, 72), 255).save(folder / place / form.format(f"photo_{i:03d}"))
    assert all(photo.mask_path is not None for photo in open_capture(folder).photos)


def test_a_mask_with_the_ending_mask_is_found(folder):
    (folder / "masks").mkdir()
    Image.new("L", (96, 72), 255).save(folder / "masks" / "photo_000.png.mask", "PNG")
    assert open_capture(folder).photos[0].mask_path.name == "photo_000.png.mask"


@pytest.mark.parametrize("name", ["other.png", "photo_000.npy"])
def test_masks_that_no_photo_finds_are_told(folder, capsys, name):
    (folder / "masks").mkdir()
    Image.new("L", (96, 72), 255).save(folder / "masks" / name, "PNG")
    open_capture(folder)
    assert "has no picture that is named like a photo" in capsys.readouterr().out


def test_a_photo_is_no_mask_of_itself(folder, capsys):
    """As where --foreground names the folder of the photos."""
    found = open_capture(folder, CaptureSettings(masks_path=Path("images")))
    assert all(photo.mask_path is None for photo in found.photos)
    assert "has no picture that is named like a photo" in capsys.readouterr().out
    write_transforms(folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["mask_path"] = frame["file_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    assert all(photo.mask_path is None for photo in open_capture(folder / "transforms.json").photos)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_what_is_transparent_in_a_photo_does_not_count(folder, capsys, mode):
    """Cut-outs, as programs that remove backgrounds make them. An opaque fourth channel means nothing."""
    cut, whole = (folder / "images" / f"photo_00{i}.png" for i in (0, 1))
    alpha = Image.fromarray(np.repeat(np.uint8([[0] * 48 + [255] * 48]), 72, axis=0))
    with Image.open(cut) as photo:
        shown = photo.convert("RGBA")
    shown.putalpha(alpha)
    shown.convert(mode).save(cut)
    with Image.open(whole) as photo:
        photo.convert("RGBA").save(whole)
    capture = open_capture(folder)
    assert "1 photos have transparent parts, which do not count: photo_000.png" in capsys.readouterr().out
    assert capture.photos[1].mask_path is None
    mask = capture.photos[0].read_mask()
    assert mask[:, 48:].all() and not mask[:, :48].any()


def palette(colors):
    image = Image.fromarray(np.array([[0, 0, 1, 1]], np.uint8), "P")
    image.putpalette([value for color in colors for value in color])
    return image


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(np.array([[0, 0, 255, 255]], np.uint8)),
        Image.fromarray(np.array([[0, 0, 1, 1]], np.uint8)),
        Image.fromarray(np.array([[0, 0, 1, 1]], np.uint16)),
        Image.fromarray(np.array([[0, 0, 65535, 65535]], np.uint16)),
        Image.fromarray(np.array([[0, 0, 1, 1]], bool)),
        Image.fromarray(np.array([[[0] * 3] * 2 + [[255, 0, 0]] * 2], np.uint8)),
        palette([(0, 0, 0), (255, 255, 255)]),
        palette([(0, 0, 0), (1, 1, 1)]),
        palette([(0, 0, 0), (128, 0, 0)]),
        palette([(0, 0, 0), (64, 0, 0)]),
        Image.fromarray(np.array([[[0, 0]] * 2 + [[255, 255]] * 2], np.uint8), "LA"),
        Image.fromarray(np.array([[[0, 0]] * 2 + [[0, 255]] * 2], np.uint8), "LA"),
        Image.fromarray(np.array([[[90, 80, 70, 0]] * 2 + [[90, 180, 70, 255]] * 2], np.uint8)),
        Image.fromarray(np.array([[[0, 0, 0, 255]] * 2 + [[255] * 4] * 2], np.uint8)),
    ],
)
def test_masks_of_every_kind_keep_their_right_half(tmp_path, image):
    image.save(tmp_path / "a.png")
    with open_picture(tmp_path / "a.png") as stored:
        assert (np.asarray(mask_values(stored)) >= 128).tolist() == [[False, False, True, True]]


def test_a_dark_jpeg_is_no_mask_of_ones(tmp_path):
    Image.new("L", (8, 8), 1).save(tmp_path / "a.jpg", quality=100)
    with open_picture(tmp_path / "a.jpg") as stored:
        assert np.asarray(mask_values(stored)).max() <= 1


# ── pictures ────────────────────────────────────────────────────────────────────────────────────────────


def test_a_heic_is_upright_everywhere(tmp_path):
    (tmp_path / "a.HEIC").write_bytes(heic())
    with open_picture(tmp_path / "a.HEIC") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (32, 24, 3)
    y, x = np.mgrid[:24, :32]
    stored = np.stack([8 * x, 10 * y, np.full_like(x, 60)], axis=-1)
    assert np.abs(np.rot90(stored, -1) - pixels).mean() < 6
    assert readable(find_photos(tmp_path))[0].names == ("a.HEIC",)


def test_colmap_gets_a_jpeg_of_a_heic_and_the_right_ending_of_others(tmp_path):
    (tmp_path / "a.heic").write_bytes(heic())
    Image.new("RGB", (8, 6)).save(tmp_path / "b.jfif", "JPEG")
    Image.new("RGB", (8, 6)).save(tmp_path / "c.jpe", "PNG")
    exif = Image.Exif()
    exif[ExifTags.Base.ImageDescription] = "x" * 70_000  # more than a JPEG holds
    Image.new("RGB", (8, 6)).save(tmp_path / "d.webp", exif=exif)
    copies = numbered(find_photos(tmp_path), tmp_path / "work")
    assert copies.names == ("000000.jpg", "000001.jpg", "000002.png", "000003.jpg")
    with Image.open(copies.folder / "000000.jpg") as image:
        assert image.size == (24, 32)


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_is_read_as_stored(tmp_path, orientation, compression):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 10, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(pixels).save(tmp_path / "a.tif", exif=exif, compression=compression)
    with open_picture(tmp_path / "a.tif") as image:
        assert image.size == (10, 6) and image.getexif().get(0x112) == orientation
        assert (np.asarray(image.convert("RGB")) == pixels).all()


def write_tiff(path, pixels, planar=1, negative=False, kind=0):
    """Write a TIFF of one strip, or of one per channel."""
    height, width, channels = pixels.shape
    strips = [
        np.ascontiguousarray(part).tobytes()
        for part in (np.moveaxis(pixels, 2, 0) if planar > 1 else [pixels])
    ]
    bits, sizes = (8 * pixels.itemsize,) * channels, [len(strip) for strip in strips]
    tags = {254: kind, 256: width, 257: height, 258: bits, 259: 1, 277: channels, 278: height, 284: planar}
    tags |= {262: 2 if channels == 3 else 0 if negative else 1, 279: tuple(sizes)}
    tags |= {273: tuple(sum(sizes[:i]) for i in range(len(sizes)))}  # counted from the end of the tags
    content, directory = io.BytesIO(), TiffImagePlugin.ImageFileDirectory_v2()
    for tag, value in tags.items():
        directory[tag] = value
    directory.save(content)
    path.write_bytes(content.getvalue() + b"".join(strips))


@pytest.mark.parametrize(
    ("kind", "layout"), [("uint16", {}), ("uint8", {"planar": 2}), ("uint8", {"negative": True})]
)
def test_a_tiff_of_every_layout_has_its_colors(tmp_path, kind, layout):
    channels = 1 if "negative" in layout else 3
    pixels = np.random.default_rng(0).integers(0, 256, (6, 10, channels), np.uint8)
    stored = (255 - pixels if "negative" in layout else pixels).astype(kind)
    write_tiff(tmp_path / "a.tif", stored * (257 if kind == "uint16" else 1), **layout)
    with open_picture(tmp_path / "a.tif") as image:
        assert (np.asarray(image.convert("RGB")) == pixels).all()


@pytest.mark.parametrize(
    ("layout", "channels", "told"),
    [
        ({"planar": 2}, 3, "16 bits are stored by channel"),  # Pillow mixes rows and colors
        ({"negative": True}, 1, "or as a negative"),  # Pillow leaves white black
        ({"kind": 1}, 3, "its first picture is a thumbnail"),  # as scanners and cameras put it first
    ],
)
def test_a_tiff_that_would_be_read_wrongly_is_left_out_with_the_reason(tmp_path, layout, channels, told):
    pixels = np.random.default_rng(0).integers(0, 65536, (24, 40, channels), np.uint16)
    write_tiff(tmp_path / "a.tif", pixels, **layout)
    _, bad = readable(find_photos(tmp_path))
    assert told in bad["a.tif"] and "JPEG or PNG" in bad["a.tif"]


def test_a_png_with_megabytes_of_text_is_read(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 10, 3), dtype=np.uint8)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", "x" * 3_000_000, zip=True)
    Image.fromarray(pixels).save(tmp_path / "a.png", pnginfo=text)
    with open_picture(tmp_path / "a.png") as image:
        assert (np.asarray(image.convert("RGB")) == pixels).all()


@pytest.mark.parametrize("name", ["a.dng", "a.NEF", "a.cr3", "a.psd", "a.jp2"])
def test_pictures_that_are_never_read_are_named_with_the_way_out(tmp_path, name):
    Image.new("RGB", (8, 6)).save(tmp_path / name, "TIFF")  # as raw files begin: Pillow reads a thumbnail
    _, bad = readable(find_photos(tmp_path))
    assert "JPEG" in bad[name]
