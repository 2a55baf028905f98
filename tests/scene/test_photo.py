import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms
from scenes import texture, write_scene

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.scene.camera import Lens, scaled_size
from lang3dxl_ns.scene.colmap import read_reconstruction
from lang3dxl_ns.scene.photo import Photo

RNG = np.random.default_rng(0)


def make_photo(path, width=40, height=30, mask_path=None, **camera):
    focal = camera.pop("focal", 50.0)
    lens = Lens(width, height, focal, camera.pop("fy", focal), width / 2, height / 2, **camera)
    return Photo(path.name, path, mask_path, lens)


def with_lens(photo, **changes):
    return replace(photo, lens=replace(photo.lens, **changes))


@pytest.fixture
def colors():
    return RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8)


@pytest.fixture
def photo(tmp_path, colors):
    Image.fromarray(colors).save(tmp_path / "a.png")
    return make_photo(tmp_path / "a.png")


def test_a_photo_reads_as_it_is_on_disk(photo, colors):
    assert torch.equal(photo.read_uint8(), torch.from_numpy(colors))
    assert torch.equal(photo.read(), torch.from_numpy(colors).float() / 255)
    assert photo.read_mask() is None


def test_a_photo_without_distortion_needs_no_opencv(photo, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert with_lens(photo, distortion=(0.0, 0.0, 0.0, 0.0)).read().shape == (30, 40, 3)
    with pytest.raises(ImportError):
        with_lens(photo, distortion=(0.1, 0.0, 0.0, 0.0)).read()


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.33, 1.7, 1e-4])
def test_photo_and_mask_have_the_scaled_size(photo, tmp_path, scale):
    Image.new("L", (7, 5), 255).save(tmp_path / "mask.png")
    masked = replace(photo, mask_path=tmp_path / "mask.png")
    width, height = scaled_size(40, 30, scale)
    assert (width, height) == (max(1, round(40 * scale)), max(1, round(30 * scale)))
    assert masked.read(scale).shape == (height, width, 3)
    assert masked.read_mask(scale).shape == (height, width)


def test_shrinking_averages_instead_of_skipping(tmp_path):
    checkers = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    Image.fromarray(checkers).save(tmp_path / "a.png")
    assert (make_photo(tmp_path / "a.png", 64, 64).read(0.25) - 0.5).abs().max() < 0.02


@pytest.mark.parametrize(
    ("mode", "ending"),
    [
        *((mode, "png") for mode in ("L", "LA", "1", "P", "RGBA")),
        ("CMYK", "tif"),
        ("CMYK", "jpg"),
        ("RGB", "webp"),
    ],
)
def test_every_kind_of_picture_becomes_rgb(tmp_path, mode, ending):
    gray = Image.new("RGB", (40, 30), (255, 255, 255))
    gray.paste((0, 0, 0), (0, 0, 20, 30))
    path = tmp_path / f"a.{ending}"
    gray.convert(mode).save(path, **({"lossless": True} if ending == "webp" else {}))
    pixels = make_photo(path).read()
    assert pixels.shape == (30, 40, 3)
    assert pixels[:, :20].max() < 0.01
    assert pixels[:, 20:].min() > 0.99


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_sixteen_bits_are_scaled_not_cut(tmp_path, ending):
    ramp = np.linspace(0, 65535, 1200).reshape(30, 40).astype(np.uint16)
    Image.fromarray(ramp).save(tmp_path / f"a.{ending}")
    pixels = make_photo(tmp_path / f"a.{ending}").read()
    assert (pixels[..., 0] - torch.linspace(0, 1, 1200).view(30, 40)).abs().max() < 0.003


@pytest.mark.parametrize("ending", ["gif", "webp", "png"])
def test_of_an_animation_the_first_picture_is_read(tmp_path, ending):
    first, second = Image.new("RGB", (40, 30), (255, 255, 255)), Image.new("RGB", (40, 30), (0, 0, 0))
    first.save(tmp_path / f"a.{ending}", save_all=True, append_images=[second])
    assert Image.open(tmp_path / f"a.{ending}").n_frames == 2
    assert make_photo(tmp_path / f"a.{ending}").read().min() > 0.95


def swapped_profile() -> bytes:
    """Return a profile of sRGB in which the first number of a pixel means green, and the second red."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    name = "sRGB".encode("utf-16-be")
    profile = profile.replace(name, "Swap".encode("utf-16-be"))
    return profile.replace(b"rXYZ", b"tXYZ", 1).replace(b"gXYZ", b"rXYZ", 1).replace(b"tXYZ", b"gXYZ", 1)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".webp", ".tif", ".avif"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_colors_are_those_that_the_color_profile_means(tmp_path, ending, mode):
    kept = "RGB" if ending == ".jpg" else mode
    path = tmp_path / f"a{ending}"
    image = Image.new("RGB", (16, 12), (200, 60, 20)).convert(kept)
    image.save(path, icc_profile=swapped_profile(), quality=95)
    read = make_photo(path, 16, 12).read_uint8().float().mean(dim=(0, 1))
    assert torch.allclose(read, torch.tensor([60.0, 200, 20]), atol=4)


@pytest.mark.parametrize("profile", [b"", b"none", b"\0" * 300, b"gray", b"sRGB"])
def test_a_profile_that_means_nothing_changes_nothing(tmp_path, profile):
    if profile == b"gray":  # of pixels of another kind
        profile = swapped_profile().replace(b"RGB XYZ", b"GRAYXYZ", 1)
    if profile == b"sRGB":
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=profile)
    assert (make_photo(tmp_path / "a.png", 16, 12).read_uint8().numpy() == pixels).all()


def test_without_a_model_that_was_turned_pixels_are_read_as_stored(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # "turn by 90 degrees"
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=exif)
    assert make_photo(tmp_path / "a.jpg").read().shape == (30, 40, 3)


def test_a_resized_copy_is_read_at_the_cameras_size(photo):
    camera = with_lens(photo, width=80, height=60)
    assert camera.read().shape == (60, 80, 3)
    assert camera.read(0.5).shape == (30, 40, 3)


def test_the_camera_adapts_to_a_resized_file(tmp_path):
    scene = write_scene(tmp_path / "scene", photos=3, size=(96, 72), points=50)
    geometry = read_reconstruction(scene / "sparse" / "0").photos["photo_000.jpg"]
    path = scene / "images" / geometry.name
    full = Photo.from_model(geometry, path)
    assert full.lens == geometry.lens
    Image.open(path).resize((48, 36)).save(path)
    half = Photo.from_model(geometry, path)
    assert (half.width, half.height) == (48, 36)
    assert torch.equal(half.lens.matrix[:2], full.lens.matrix[:2] / 2)


def test_a_file_of_another_shape_is_refused_with_both_sizes(photo, tmp_path):
    turned = with_lens(photo, width=30, height=40)
    with pytest.raises(UserError, match=r"a\.png.*40 × 30.*30 × 40"):
        turned.read()
    scene = write_scene(tmp_path / "scene", photos=3, points=50)
    geometry = read_reconstruction(scene / "sparse" / "0").photos["photo_000.jpg"]
    with pytest.raises(UserError, match="another aspect ratio"):
        Photo.from_model(with_lens(geometry, width=72, height=96), scene / "images" / geometry.name)


def test_unreadable_files_are_named(tmp_path, photo):
    noise = tmp_path / "noise.jpg"
    noise.write_bytes(b"not a picture")
    empty = tmp_path / "empty.jpg"
    empty.touch()
    half = tmp_path / "half.png"
    half.write_bytes(photo.path.read_bytes()[:600])
    floats = tmp_path / "floats.tif"
    Image.fromarray(np.zeros((30, 40), np.float32)).save(floats)
    for path in (noise, empty, half, floats, tmp_path):
        with pytest.raises(UserError, match=rf"{path.name}.*can't read"):
            make_photo(path).read()
    missing = make_photo(tmp_path / "missing.jpg")
    for use in (missing.read, missing.content_hash):
        with pytest.raises(UserError, match=r"missing\.jpg.*no file"):
            use()
    with pytest.raises(UserError, match=r"photo a\.png.*no file.*gone\.png"):
        replace(photo, mask_path=tmp_path / "gone.png").read_mask()


def test_a_mask_of_another_aspect_ratio_is_refused(photo, tmp_path):
    masked = replace(photo, mask_path=tmp_path / "mask.png")
    for size in ((30, 40), (7, 50), (4000, 2000), (40, 20)):
        Image.new("L", size, 255).save(masked.mask_path)
        with pytest.raises(UserError, match=rf"{size[0]} × {size[1]} pixels, but its photo 40 × 30"):
            masked.read_mask()


def test_a_mask_counts_from_half_brightness_and_fits_any_size(photo, tmp_path):
    mask = Image.new("L", (4, 3), 127)
    mask.paste(128, (2, 0, 4, 3))
    mask.save(tmp_path / "mask.png")
    read = replace(photo, mask_path=tmp_path / "mask.png").read_mask()
    assert read.dtype == torch.bool
    assert not read[:, :20].any()
    assert read[:, 20:].all()


def test_the_hash_follows_the_bytes_alone(photo, tmp_path):
    copy = tmp_path / "copy.png"
    copy.write_bytes(photo.path.read_bytes())
    assert make_photo(copy).content_hash() == photo.content_hash()
    copy.write_bytes(photo.path.read_bytes() + b"x")
    assert make_photo(copy).content_hash() != photo.content_hash()


def draw_spots(pixels, width, height):
    """A white Gaussian spot around each of the pixel positions (origin at the corner of the first pixel)."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    spots = sum(np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18) for x, y in pixels)
    return Image.fromarray((255 * np.clip(spots, 0, 1)).astype(np.uint8)).convert("RGB")


def locate(image, x, y, radius=9):
    """Center of gravity of the spot near (x, y)."""
    x0, y0 = round(x) - radius, round(y) - radius
    window = image[y0 : y0 + 2 * radius, x0 : x0 + 2 * radius].double()
    steps = torch.arange(2 * radius) + 0.5
    return x0 + float((window * steps).sum() / window.sum()), y0 + float(
        (window * steps[:, None]).sum() / window.sum()
    )


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [300, 155, 118, -0.15]),
        ("RADIAL", [300, 155, 118, 0.1, 0.02]),
        ("OPENCV", [300, 280, 155, 118, -0.2, 0.05, 0.01, -0.015]),
        ("FULL_OPENCV", [300, 280, 155, 118, -0.2, 0.05, 0.01, -0.01, 0.01, 0.02, 0.01, 0.0]),
        ("SIMPLE_FISHEYE", [250, 155, 118]),
        ("FISHEYE", [250, 260, 155, 118]),
        ("SIMPLE_RADIAL_FISHEYE", [250, 155, 118, 0.05]),
        ("RADIAL_FISHEYE", [250, 155, 118, 0.05, -0.02]),
        ("OPENCV_FISHEYE", [250, 260, 155, 118, 0.05, -0.02, 0.01, 0.005]),
    ],
)
@pytest.mark.parametrize("file_scale", [1, 2])
def test_an_undistorted_point_lies_where_the_pinhole_projects_it(tmp_path, model, params, file_scale):
    import pycolmap

    camera = pycolmap.Camera(camera_id=1, model=model, width=320, height=240, params=params)
    points = np.array([[x, y, 1.0] for x in (-0.35, 0.0, 0.35) for y in (-0.25, 0.25)])
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", keypoints=np.zeros((0, 2)), camera_id=1, image_id=1)
    reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    reconstruction.write_binary(tmp_path)
    distorted = camera.img_from_cam(points)
    draw_spots(distorted * file_scale, 320 * file_scale, 240 * file_scale).save(tmp_path / "a.png")

    photo = Photo.from_model(read_reconstruction(tmp_path).photos["a.png"], tmp_path / "a.png")
    pixels = photo.read(1 / file_scale)[..., 0]
    assert pixels.shape == (240, 320)
    shift = []
    for (x, y, _), old in zip(points, distorted, strict=True):
        u = camera.focal_length_x * x + camera.principal_point_x
        v = camera.focal_length_y * y + camera.principal_point_y
        assert locate(pixels, u, v) == pytest.approx((u, v), abs=0.35)
        shift.append(np.hypot(u - old[0], v - old[1]))
    assert max(shift) > 1.5  # else the distortion would prove nothing


@pytest.mark.parametrize("bend", [None, (-0.4, 0.1, 0.02, -0.02)])
def test_a_photo_shows_the_points_colors_where_the_pinhole_projects_them(tmp_path, bend):
    size = (320, 240)
    scene = write_scene(tmp_path / "s", 3, size, points=2000, distortion=bend, image_ext="png")
    for geometry in read_reconstruction(scene / "sparse" / "0").photos.values():
        x, y, z = (
            geometry.camera_from_world @ np.column_stack([geometry.points, np.ones(len(geometry.points))]).T
        )
        columns = (geometry.lens.fx * x / z + geometry.lens.cx).astype(int)
        rows = (geometry.lens.fy * y / z + geometry.lens.cy).astype(int)
        pixels = Photo.from_model(geometry, scene / "images" / geometry.name).read()[rows, columns].numpy()
        difference = np.abs(pixels - texture(geometry.points)).max(axis=1)
        assert np.median(difference) < 0.02
        assert np.mean(difference > 0.1) < 0.15  # at the edges of the windows


def test_pixels_outside_the_undistorted_photo_are_black_and_masked(tmp_path):
    Image.new("RGB", (160, 120), (255, 255, 255)).save(tmp_path / "a.png")
    Image.new("L", (16, 12), 255).save(tmp_path / "mask.png")
    photo = make_photo(tmp_path / "a.png", 160, 120, focal=100.0, distortion=(0.3, 0.0, 0.0, 0.0))
    seen = photo.read_mask()
    assert not seen[0, 0]
    assert seen[60, 80]
    assert 0.5 < seen.float().mean() < 0.95
    assert torch.equal(seen, seen.flip(0))  # the principal point is the middle of the photo
    assert torch.equal(seen, seen.flip(1))
    assert torch.equal(photo.read()[..., 0] > 0.5, seen)
    assert torch.equal(replace(photo, mask_path=tmp_path / "mask.png").read_mask(), seen)


def test_a_polynomial_that_turns_back_shows_nothing_twice(tmp_path):
    Image.new("RGB", (160, 120), (255, 255, 255)).save(tmp_path / "a.png")
    photo = make_photo(tmp_path / "a.png", 160, 120, focal=60.0, distortion=(-0.3, 0.0, 0.0, 0.0))
    seen = photo.read_mask()
    radius = (
        torch.from_numpy(np.hypot(*(np.mgrid[:120, :160] + 0.5 - np.array([60, 80])[:, None, None]))) / 60
    )
    turn = (1 / 0.9) ** 0.5  # where r (1 - 0.3 r²) stops growing
    assert seen[radius < turn - 0.05].all()
    assert not seen[radius > turn + 0.05].any()


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("bend", [1e9, -1e9, 1e30, -400.0, 400.0])
def test_a_lens_that_no_photo_can_have_is_refused(tmp_path, bend, fisheye):
    scene = write_scene(tmp_path / "s", 3, (160, 120), points=50, image_ext="png")
    (tracked, *_) = read_reconstruction(scene / "sparse" / "0").photos.values()
    absurd = with_lens(tracked, distortion=(bend, 0.0, 0.0, 0.0), fisheye=fisheye)
    with pytest.raises(UserError, match="distortion is wrong"):
        Photo.from_model(absurd, scene / "images" / tracked.name)


def test_the_mask_is_undistorted_with_the_photo(tmp_path):
    picture = np.zeros((120, 160), np.uint8)
    picture[:, 120:] = 255
    Image.fromarray(picture).save(tmp_path / "a.png")
    photo = make_photo(
        tmp_path / "a.png", 160, 120, tmp_path / "a.png", focal=100.0, distortion=(-0.2, 0.0, 0.0, 0.0)
    )
    mask, pixels = photo.read_mask(), photo.read()[..., 0]
    assert (mask != (pixels > 0.5)).float().mean() < 0.005
    assert not torch.equal(mask, torch.from_numpy(picture > 0))


def test_read_file_keeps_the_distortion_and_bounds_the_size(photo):
    distorted = with_lens(photo, distortion=(0.3, 0.0, 0.0, 0.0))
    assert torch.equal(distorted.read_file(40), photo.read_uint8())
    assert distorted.read_file(20).shape == (15, 20, 3)
    assert distorted.read_file(1000).shape == (30, 40, 3)


def test_labels_are_undistorted_with_the_photo_and_never_mixed(tmp_path):
    """A dot of label 7 on the file ends up where the photo's own bright dot does."""
    picture = np.zeros((90, 120, 3), dtype=np.uint8)
    picture[20:26, 30:36] = 255
    Image.fromarray(picture).save(tmp_path / "a.png")
    photo = make_photo(tmp_path / "a.png", 120, 90, distortion=(0.4, 0.0, 0.0, 0.0))
    labels = torch.where(torch.from_numpy(picture[..., 0]) > 0, 70_000, 3)
    seen = photo.undistort_labels(labels)
    assert set(seen.unique().tolist()) == {-1, 3, 70_000}
    assert torch.equal(seen < 0, ~photo.read_mask())
    bright = photo.read()[..., 0] > 0.5
    assert ((seen == 70_000) != bright).float().mean() < 0.005
    assert not torch.equal(seen == 70_000, labels == 70_000)
    assert photo.undistort_labels(labels[::2, ::2]).shape == (45, 60)  # of any size
    straight = with_lens(photo, distortion=())
    assert torch.equal(straight.undistort_labels(labels), labels)


@pytest.mark.parametrize("size", [(1, 16), (16, 1), (1, 1)])
def test_a_distorted_photo_of_one_pixel_is_read(tmp_path, size):
    Image.new("RGB", size, (9, 9, 9)).save(tmp_path / "a.png")
    lens = Lens(*size, 20.0, 21.0, size[0] / 2, size[1] / 2, (0.1, 0.0, 0.0, 0.0))
    photo = Photo("a.png", tmp_path / "a.png", None, lens)
    assert photo.read().shape == (size[1], size[0], 3) and photo.read_mask().all()


@pytest.mark.parametrize(("size", "side"), [((2000, 41), 160), ((160, 90), 4), ((3, 200), 100)])
def test_a_long_photo_that_is_read_small_is_its_own_file(size, side, tmp_path):
    """Its shorter side is a rounded number of a few pixels."""
    Image.new("RGB", size).save(tmp_path / "a.png")
    small = make_photo(tmp_path / "a.png", *size).at_most(side)
    assert small.read().shape == (small.height, small.width, 3)


def test_a_mask_ends_where_it_is_transparent(photo, tmp_path):
    mask = np.full((30, 40, 4), 255, np.uint8)
    mask[:, 20:, 3] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    found = replace(photo, mask_path=tmp_path / "m.png").read_mask()
    assert found[:, :20].all() and not found[:, 20:].any()
