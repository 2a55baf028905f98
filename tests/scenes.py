"""Small COLMAP folders for tests: photos of a textured box, consistent between views, with points and tracks.

from scenes import write_scene
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np  # before pycolmap: the other way round, Pillow's PNG writer aborts the process
from PIL import Image

CENTER = np.array([0.0, 0.0, 0.5])
HALF_SIZES = np.array([1.2, 0.6, 0.5])  # world units; the box stands on the ground, z is up
Paint = Callable[[np.ndarray], np.ndarray]
FACES = np.array([[0.9, 0.5, 0.3], [0.4, 0.6, 0.9], [0.5, 0.8, 0.4]])  # color by the face's normal axis


def write_scene(
    folder: Path,
    photos: int = 6,
    size: tuple[int, int] = (96, 72),
    points: int = 200,
    seed: int = 0,
    mixed: bool = False,
    distortion: tuple[float, ...] | None = None,
    image_ext: str = "jpg",
    shuffled: bool = False,
    duplicates: int = 0,
    coarseness: int = 1,
    paint: Paint | None = None,
) -> Path:
    """Write `folder`/images/photo_000.jpg … and `folder`/sparse/0/*.bin; returns `folder`.

    The cameras stand on an arc in front of the box, 3.5 to 4.5 units away. `mixed` gives every photo its own
    size, focal length and principal point, every third one portrait; otherwise all share one camera.
    `distortion` is OpenCV's k1 k2 p1 p2. `shuffled` lists the photos in another order in the model. The last
    `duplicates` photos are the first once more. Squares of `coarseness` pixels have one color: a ray for
    each pixel of a large photo takes long. `paint` colors points on the box, 0…1 (default: `texture`). Every
    point has a track of at least two photos that see it unhidden.
    """
    import pycolmap

    rng, paint = np.random.default_rng(seed), paint or texture
    model = pycolmap.Reconstruction()
    ids = np.random.default_rng(1).permutation(photos) + 1 if shuffled else np.arange(photos) + 1
    cameras = [_camera(pycolmap, i + 1, size, distortion, rng if mixed else None) for i in range(photos)]
    for camera in cameras[: photos - duplicates] if mixed else cameras[:1]:
        model.add_camera_with_trivial_rig(camera)
    poses = [_pose(fraction, rng) for fraction in (np.arange(photos) + 0.5) / photos - 0.5]

    first = photos - duplicates
    cameras, poses = (kind[:first] + kind[:1] * duplicates for kind in (cameras, poses))
    surface = _surface_points(points, rng)
    seen = [_project(camera, pose, surface) for camera, pose in zip(cameras, poses, strict=True)]
    tracked = np.sum([visible for _, visible in seen], axis=0) >= 2
    folder = Path(folder)
    (folder / "images").mkdir(parents=True)
    for i, (camera, pose, (pixels, visible)) in enumerate(zip(cameras, poses, seen, strict=True)):
        name = f"photo_{i:03d}.{image_ext}"
        Image.fromarray(_render(camera, pose, coarseness, paint)).save(folder / "images" / name, quality=95)
        image = pycolmap.Image(
            name=name,
            keypoints=pixels[visible & tracked],
            camera_id=camera.camera_id if mixed else 1,
            image_id=int(ids[i]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))

    for index in np.flatnonzero(tracked):
        track = pycolmap.Track()
        for i, (_, visible) in enumerate(seen):
            if visible[index]:
                track.add_element(int(ids[i]), int(np.count_nonzero((visible & tracked)[:index])))
        model.add_point3D(
            surface[index], track, np.round(paint(surface[index][None])[0] * 255).astype(np.uint8)
        )
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    return folder


def _camera(pycolmap, camera_id, size, distortion, rng):
    """A camera that sees the whole box; with a generator, one of its own. Pixels are not square and the
    principal point is off the middle, so that no axis can stand in for the other."""
    width, height = size
    focal, center = 1.1 * max(size), np.array([width, height]) * [0.48, 0.53]
    if rng is not None:
        width, height = np.round(np.array(size) * rng.uniform(0.7, 1.2)).astype(int)
        if camera_id % 3 == 0:
            width, height = height, width
        focal = rng.uniform(0.9, 1.4) * max(width, height)
        center = np.array([width, height]) * rng.uniform(0.45, 0.55, 2)
    return pycolmap.Camera(
        camera_id=camera_id,
        model="OPENCV" if distortion else "PINHOLE",
        width=int(width),
        height=int(height),
        params=[focal, 1.07 * focal, *center, *(distortion or ())],
    )


def _pose(fraction: float, rng: np.random.Generator) -> np.ndarray:
    """[3, 4] camera from world, looking at the box from an arc of 100 degrees."""
    angle = np.deg2rad(100) * fraction
    position = CENTER + rng.uniform(3.5, 4.5) * np.array(
        [np.sin(angle), -np.cos(angle), rng.uniform(0.1, 0.4)]
    )
    forward = (CENTER - position) / np.linalg.norm(CENTER - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ position])


def _surface_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """[n, 3] points on the faces that the arc can see: front, left, right, top."""
    points = rng.uniform(-1, 1, (count, 3))
    axis, side = np.array([[1, -1], [1, -1], [0, -1], [0, 1], [2, 1]]).T
    face = rng.integers(len(axis), size=count)
    points[np.arange(count), axis[face]] = side[face]
    return CENTER + HALF_SIZES * points


def _project(camera, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[n, 2] pixels, and which points are in the photo and not hidden by the box."""
    pixels = camera.img_from_cam(points @ pose[:, :3].T + pose[:, 3])
    position = -pose[:, :3].T @ pose[:, 3]
    reach = _hit_box(position, points - position)
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return pixels, inside & (np.abs(reach - 1) < 1e-6)


def _render(camera, pose: np.ndarray, step: int, paint: Paint) -> np.ndarray:
    """[h, w, 3] uint8 photo: one ray through the middle of every square of `step` pixels a side."""
    rows, columns = np.mgrid[: camera.height : step, : camera.width : step] + step / 2
    plane = camera.cam_from_img(np.column_stack([columns.ravel(), rows.ravel()]))
    directions = np.column_stack([plane, np.ones(len(plane))]) @ pose[:, :3]
    position = -pose[:, :3].T @ pose[:, 3]
    reach = _hit_box(position, directions)
    hit = np.isfinite(reach)
    up = directions[:, 2] / np.linalg.norm(directions, axis=1)
    colors = np.array([0.75, 0.8, 0.9]) + 0.3 * up[:, None] * [-1, -0.6, 0.2]  # the sky
    colors[hit] = paint(position + reach[hit, None] * directions[hit])
    photo = np.round(colors.clip(0, 1) * 255).astype(np.uint8).reshape(*rows.shape, 3)
    return photo.repeat(step, 0).repeat(step, 1)[: camera.height, : camera.width]


def _hit_box(position: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[n] multiples of the directions after which the rays enter the box, infinite for those that miss it."""
    with np.errstate(divide="ignore"):
        bounds = (CENTER - position + HALF_SIZES * np.array([[[-1.0]], [[1.0]]])) / directions
    enter, leave = bounds.min(axis=0).max(axis=1), bounds.max(axis=0).min(axis=1)
    return np.where((enter <= leave * (1 + 1e-9)) & (enter > 0), enter, np.inf)


def texture(points: np.ndarray) -> np.ndarray:
    """[n, 3] colors in 0..1 of points on the box: a color per face, soft bands and a grid of windows."""
    local = (points - CENTER) / HALF_SIZES
    face = FACES[np.abs(local).argmax(axis=1)]
    bands = 0.85 + 0.15 * np.sin(points * [7, 9, 11]).prod(axis=1)
    windows = (np.sin(points * [9, 9, 12] + 0.4) > 0.2).sum(axis=1) >= 2
    return face * (bands * np.where(windows, 0.45, 1.0))[:, None]


def speckled(points: np.ndarray) -> np.ndarray:
    """Another `texture`: cells of two sizes, colored by lot, so that SIFT finds corners everywhere."""
    colors = 0.0
    for size in (0.21, 0.053):
        cells = np.floor((points + 0.0137) / size)
        draws = np.sin(cells @ [[127.1, 269.5, 113.5], [311.7, 183.3, 271.9], [74.7, 246.1, 124.6]]) * 43758.5
        colors = colors + 0.5 * (draws % 1)
    return colors


def view_of(camera):
    """One of our cameras as a nerfstudio camera."""
    from lang3dxl_ns.plugin.cameras import to_nerfstudio
    from lang3dxl_ns.scene.camera import Lens, camera_to_world

    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    lens = Lens(camera.width, camera.height, fx, fy, cx, cy)
    return to_nerfstudio([lens], camera_to_world(camera.view_matrix.cpu())[None])


def write_ply(path, form, kinds, rows, colors=("red", "green", "blue")):
    """Write points as a PLY of a form ("ascii", "binary_little_endian" …), with columns of these kinds."""
    names = ["x", "y", "z", *colors][: len(rows[0])]
    words = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort"}
    head = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property {words[k]} {n}\n" for k, n in zip(kinds, names, strict=True)) + "end_header\n"
    order = ">" if "big" in form else "<"
    table = np.array([tuple(r) for r in rows], [(n, order + k) for n, k in zip(names, kinds, strict=True)])
    body = "\n".join(" ".join(map(str, r)) for r in rows).encode() if form == "ascii" else table.tobytes()
    path.write_bytes(head.encode() + body)
    return path


def write_transforms(folder, names=None, scale=1.0, **top):
    """Write a scene, of photos of one size, as transforms.json too, and return its COLMAP model."""
    from lang3dxl_ns.scene.colmap import read_reconstruction

    model = read_reconstruction(folder / "sparse" / "0")
    frames = []
    for name, photo in model.photos.items():
        pose = np.linalg.inv(np.vstack([photo.camera_from_world, [0, 0, 0, 1]]))
        pose[:3, 1:3] *= -1
        pose[:3, :3] *= scale
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    lens = next(iter(model.photos.values())).lens
    content = {"w": 96, "h": 72, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    for frame, name in zip(frames, names or (), strict=False):
        frame["file_path"] = name
    (folder / "transforms.json").write_text(json.dumps(content | top | {"frames": frames}))
    return model
