"""Frames: a splat moved as a program moves it is laid back onto its photos."""

import json

import numpy as np
import pytest
import torch
from box_splat import box_splat
from moved_splats import transformed, with_colors
from scenes import write_scene
from scipy.spatial.transform import Rotation

from lang3dxl_ns.attachment import frames
from lang3dxl_ns.attachment.frames import Fit, camera_in, find_frame
from lang3dxl_ns.attachment.known_frames import RUN_TRANSFORM, known_frames, registered_frames
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.rendering import render
from lang3dxl_ns.scene.capture import open_capture


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    folder = write_scene(tmp_path_factory.mktemp("box") / "scene", size=(120, 90), photos=8, points=400)
    return open_capture(folder)


def moved(similarity):
    return transformed(box_splat(), torch.from_numpy(similarity))


def similarity(turn=(0.3, -0.2, 0.5), scale=0.4, shift=(1.0, -2.0, 0.5)) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3] = scale * Rotation.from_rotvec(turn).as_matrix()
    whole[:3, 3] = shift
    return whole


def misplacement(found: np.ndarray, wanted: np.ndarray) -> float:
    """How far corners of the box are from where they belong, in units of the box."""
    corners = np.array([[x, y, z, 1.0] for x in (-1.2, 1.2) for y in (-0.6, 0.6) for z in (0, 1)])
    scale = np.cbrt(np.linalg.det(wanted[:3, :3]))
    return float(np.abs((found - wanted) @ corners.T).max() / scale)


def test_a_camera_moves_along_with_the_splat(collection):
    whole, name = similarity(), collection.photos[0].name
    tracked = collection.reconstruction.photos[name]
    still = render(box_splat(), camera_in(np.eye(4), tracked))
    again = render(moved(whole), camera_in(whole, tracked))
    torch.testing.assert_close(again.rgb, still.rgb, atol=2e-3, rtol=0)
    torch.testing.assert_close(again.depth, 0.4 * still.depth, atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    "name", ["the photos' own, as in 3D Gaussian splatting", "nerfstudio's, with z up", "gsplat's"]
)
def test_the_frames_of_programs_are_found(collection, name, tmp_path):
    wanted = known_frames(collection.reconstruction, tmp_path / "a.ply")[name]
    fit = find_frame(moved(wanted), collection, tmp_path / "a.ply")
    assert fit.fits, fit
    assert misplacement(fit.similarity, wanted) < 0.02


def test_nerfstudio_frame_is_what_nerfstudio_computes(collection, tmp_path):
    """Its own function is the reference."""
    cameras = pytest.importorskip("nerfstudio.cameras.camera_utils")
    photos = collection.reconstruction.photos.values()
    poses = np.linalg.inv([np.vstack([p.camera_from_world, [0, 0, 0, 1]]) for p in photos])
    poses[:, :3, 1:3] *= -1
    poses = poses[:, [0, 2, 1, 3]]
    poses[:, 2] *= -1
    oriented, _ = cameras.auto_orient_and_center_poses(torch.from_numpy(poses).float(), "up", "poses")
    wanted = oriented[:, :3, 3] / oriented[:, :3, 3].abs().max()
    frame = known_frames(collection.reconstruction, tmp_path / "a.ply")["nerfstudio's, with z up"]
    centers = np.array([p.center for p in photos])
    np.testing.assert_allclose(centers @ frame[:3, :3].T + frame[:3, 3], wanted.numpy(), atol=1e-4)


def test_a_frame_that_is_close_is_refined(collection, tmp_path):
    wanted = similarity((0.02, -0.03, 0.02), 1.02, (0.05, -0.04, 0.03))
    fit = find_frame(moved(wanted), collection, tmp_path / "a.ply")
    assert fit.fits
    assert misplacement(fit.similarity, wanted) < 0.03


def test_of_many_gaussians_some_are_enough_to_refine_a_frame(collection, tmp_path, monkeypatch):
    monkeypatch.setattr(frames, "_MOST", len(box_splat()) // 2)
    counted, refined = set(), frames._refined

    def watched(splats, *rest):
        counted.add(len(splats))
        return refined(splats, *rest)

    monkeypatch.setattr(frames, "_refined", watched)
    wanted = similarity((0.02, -0.03, 0.02), 1.02, (0.05, -0.04, 0.03))
    fit = find_frame(moved(wanted), collection, tmp_path / "a.ply")
    assert max(counted) <= len(box_splat()) // 2 + 1
    assert misplacement(fit.similarity, wanted) < 0.6 * misplacement(np.eye(4), wanted)


def test_a_run_tells_its_frame(collection, tmp_path):
    wanted = similarity()
    content = {"transform": (wanted[:3] / 0.4).tolist(), "scale": 0.4}
    (tmp_path / RUN_TRANSFORM).write_text(json.dumps(content))
    place = tmp_path / "nerfstudio_models" / "step-1.ckpt"
    found = known_frames(collection.reconstruction, place)["the run's"]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_photos_of_something_else_fit_nowhere(collection, tmp_path):
    g = torch.Generator().manual_seed(0)
    other = box_splat()
    other = with_colors(other, torch.rand(len(other), 3, generator=g))
    assert not find_frame(other, collection, tmp_path / "a.ply").fits


def test_few_photos_must_agree_better_than_many():
    def fit(score: float, photos: int) -> Fit:
        return Fit("a frame", np.eye(4), score, photos)

    assert fit(0.55, 12).fits and not fit(0.55, 3).fits and fit(0.7, 3).fits and not fit(0.45, 12).fits


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, 1e308])
def test_a_file_of_a_run_that_names_no_frame_leaves_the_others(collection, scale, tmp_path):
    others = known_frames(collection.reconstruction, tmp_path / "a.ply")
    content = {"transform": np.eye(4)[:3].tolist(), "scale": scale}
    (tmp_path / RUN_TRANSFORM).write_text(json.dumps(content))
    assert known_frames(collection.reconstruction, tmp_path / "a.ply").keys() == others.keys()


@pytest.mark.parametrize("damaged", ["images", "masks"])
def test_a_damaged_photo_or_mask_is_not_compared(tmp_path, damaged):
    write_scene(tmp_path, size=(120, 90), photos=8, points=400)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "photo_000.png").write_bytes(b"junk" if damaged == "masks" else b"")
    photo = tmp_path / "images" / "photo_000.jpg"
    if damaged == "images":
        photo.write_bytes(photo.read_bytes()[:2000])
    collection = open_capture(tmp_path)
    assert find_frame(box_splat(), collection, tmp_path / "a.ply").fits
    for photo in (tmp_path / "images").iterdir():
        photo.write_bytes(photo.read_bytes()[:1500])
    with pytest.raises(UserError, match="can't read"):
        find_frame(box_splat(), collection, tmp_path / "a.ply")


@pytest.mark.parametrize("kept", [(1, 0, 1), (1, 0, 0), (0, 0, 0)])
def test_flat_and_thin_shapes_are_aligned_or_a_line_says_that_they_cannot_be(kept, capsys):
    draw = np.random.default_rng(0)
    points, means = draw.normal(size=(200, 3)), draw.normal(size=(300, 3)) * kept
    found = registered_frames(points, means)
    assert all(np.isfinite(fit).all() and np.linalg.det(fit) > 0 for fit in found.values())
    assert found or "can't be aligned" in capsys.readouterr().out
    assert registered_frames(points[:9], means) == {}
    assert "too few to align by shape: 9 points" in capsys.readouterr().out.replace("\n", " ")
