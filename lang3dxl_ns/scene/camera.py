"""Lens, camera and poses: intrinsics, nerfstudio's and OpenCV's conventions, frustum culling."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.device import to_device
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.memory import machine_memory

MOST_PIXELS = 180_000_000
"""Largest picture, in pixels; Pillow rejects larger ones as an attack."""

LONGEST_SIDE = 1 << 16
"""Longest side of a picture, in pixels."""


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Compute the width and height of a photo at `scale`, at least one pixel each."""
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photo of `width` × `height` pixels, with the origin at its top-left corner."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order: k1 k2 p1 p2 [k3 …], or k1 k2 k3 k4 for a fisheye; empty for none."""
    fisheye: bool = False

    @property
    def distorts(self) -> bool:
        """Whether photos need undistortion to match a pinhole camera."""
        return self.fisheye or any(self.distortion)

    @property
    def undistortion(self) -> list[float] | None:
        """All values that an undistortion depends on; None if the lens does not distort."""
        return [self.fx, self.fy, self.cx, self.cy, *self.distortion, self.fisheye] if self.distorts else None

    @property
    def matrix(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix in float64, pixels."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def check(self) -> None:
        """Raise ValueError if the lens cannot be rendered with."""
        width, height = self.width, self.height
        values = (width, height, self.fx, self.fy, self.cx, self.cy, *self.distortion)
        expect(all(map(is_coordinate, values)), "a lens has a value that is not a number")
        whole = type(width) is int and type(height) is int and min(width, height) >= 1
        expect(whole, f"a picture has {width} × {height} pixels")
        small = width * height <= MOST_PIXELS and max(width, height) <= LONGEST_SIDE
        expect(small, f"{width} × {height} pixels are too many")
        expect(min(self.fx, self.fy) > 0, f"a lens has the focal lengths {self.fx}, {self.fy}")
        known = type(self.fisheye) is bool and len(self.distortion) in (0, 4, 5, 8)
        expect(known, "a lens has no known distortion")

    def resized(self, width: int, height: int) -> Lens:
        """Return the lens at another resolution."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )

    def scaled(self, scale: float) -> Lens:
        """Return the lens at `scale`, exact for the rounded size."""
        return self.resized(*scaled_size(self.width, self.height, scale))

    def camera(self, view_matrix: Float[Tensor, "4 4"]) -> Camera:
        """Return a camera with this lens, undistorted, at a pose (world → camera, OpenCV axes)."""
        return Camera(view_matrix, self.matrix.float(), self.width, self.height)


class HasLens:
    """Base of what was taken with a lens."""

    lens: Lens

    @property
    def width(self) -> int:
        """Width in pixels."""
        return self.lens.width

    @property
    def height(self) -> int:
        """Height in pixels."""
        return self.lens.height


def check_pose(rows: Any) -> None:
    """Check a pose from a file: a [3, 4] or [4, 4] nested list of finite numbers, a rotation (to a hundredth)
    and a position. Raises ValueError otherwise."""
    _, scale = rigid(rows)
    expect(abs(scale - 1) < _UNIT, f"a pose's axes have the length {scale:.4g}, not 1")


_UNIT = 0.01
"""Deviation of a rotation's axes from unit length up to which it counts as rounded."""


def rigid(rows: Any) -> tuple[Float64[Array, "3 4"], float]:
    """Read a pose from a file: a [3, 4] or [4, 4] nested list of finite numbers. Its rotation may be scaled.
    Return it with the nearest rotation, and the scale. Raises ValueError for anything else, such as a pose
    that is mirrored or stretched in one direction."""
    in_rows = isinstance(rows, list) and all(isinstance(row, list) and len(row) == 4 for row in rows)
    numbers = in_rows and all(is_coordinate(value) for row in rows for value in row)
    expect(numbers and len(rows) in (3, 4), "a pose is not three rows of four numbers")
    pose = np.array(rows, dtype=np.float64)
    whole = len(pose) == 3 or bool(np.abs(pose[3] - [0, 0, 0, 1]).max() < 1e-6)
    expect(whole, "a pose's last row is not 0, 0, 0, 1: it may be transposed")
    left, sizes, right = np.linalg.svd(pose[:3, :3])
    expect(sizes[2] > 1e-9, "a pose is not a rotation and a position")
    expect(np.linalg.det(left @ right) > 0, "a pose is mirrored: its axes are left-handed")
    lengths = " × ".join(f"{size:.3g}" for size in sizes)
    expect(
        sizes[0] < (1 + _UNIT) * sizes[2], f"a pose stretches space ({lengths}): its axes differ in length"
    )
    return np.column_stack([left @ right, pose[:3, 3]]), float(sizes.mean())


@dataclass(frozen=True)
class Camera:
    """Pinhole camera without distortion and skew; OpenCV axes (x right, y down, z forward)."""

    view_matrix: Float[Tensor, "4 4"]
    """Rigid transform, world → camera, world units."""
    intrinsics: Float[Tensor, "3 3"]
    """Intrinsic matrix in pixels; the origin is the photo's top-left corner, so pixel centers lie at +0.5."""
    width: int
    height: int

    @property
    def pose(self) -> Float64[Array, "4 4"]:
        """Camera → world in nerfstudio's axes (x right, y up, z backward), as accepted by `Scene.camera`."""
        return np.vstack([camera_to_world(self.view_matrix.detach().double()).cpu().numpy(), [0, 0, 0, 1.0]])

    @property
    def position(self) -> Float[Tensor, "3"]:
        """Position of the camera, world units."""
        return -self.view_matrix[:3, :3].T @ self.view_matrix[:3, 3]

    def detach(self) -> Camera:
        """Return the camera without gradient."""
        return replace(self, view_matrix=self.view_matrix.detach(), intrinsics=self.intrinsics.detach())

    def same_as(self, other: Camera) -> bool:
        """Return whether another camera has the same pose, lens and size, so that views of both coincide."""
        parts = ((self.view_matrix, other.view_matrix), (self.intrinsics, other.intrinsics))
        size = (self.width, self.height) == (other.width, other.height)
        return size and all(torch.equal(one.cpu(), another.cpu()) for one, another in parts)

    def to(self, device: torch.device | str) -> Camera:
        """Return the camera on a device."""
        view, intrinsics = (to_device(part, device) for part in (self.view_matrix, self.intrinsics))
        return replace(self, view_matrix=view, intrinsics=intrinsics)

    def at_origin(self, like: Tensor) -> tuple[Camera, Float[Tensor, "3"]]:
        """Return the camera in a world whose origin is its own (rounded) position, and that position, in the
        type and on the device of `like`.

        Far from the origin (map coordinates are in the millions) R·x + t is a small difference of large
        numbers. R·(x − position) + (R·position + t) is not, if the last bracket is computed in float64: on
        the camera's device, or on the CPU for Apple's GPUs, which lack float64.
        """
        view = self.view_matrix.cpu() if self.view_matrix.device.type == "mps" else self.view_matrix
        view = view.to(torch.float64)
        place = -(view[:3, :3].T @ view[:3, 3]).detach().to(like.dtype)
        shift = torch.eye(4, dtype=view.dtype, device=view.device)
        shift[:3, 3] = place
        moved = replace(self, view_matrix=(view @ shift).to(like.dtype))
        return moved.to(like.device), to_device(place, like.device)


def view_matrix(camera_to_world: Float[Tensor, "3 4"]) -> Float[Tensor, "4 4"]:
    """Convert nerfstudio's camera → world (OpenGL axes) to world → camera (OpenCV axes)."""
    right, up_and_back = camera_to_world[:, :3].split([1, 2], dim=1)
    rotation = torch.cat([right, -up_and_back], dim=1).T
    top = torch.cat([rotation, -rotation @ camera_to_world[:, 3:]], dim=1)
    bottom = torch.zeros_like(top[:1])
    bottom[:, 3] = 1.0
    return torch.cat([top, bottom])


def camera_to_world(view_matrix: Float[Tensor, "4 4"]) -> Float[Tensor, "3 4"]:
    """Invert `view_matrix`."""
    rotation = view_matrix[:3, :3].T
    position = -rotation @ view_matrix[:3, 3:]
    return torch.cat([rotation * view_matrix.new_tensor([1.0, -1.0, -1.0]), position], dim=1)


def in_camera_frame(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return points of the world in a camera's frame (OpenCV axes)."""
    view = to_device(camera.view_matrix.to(points.dtype), points.device)
    return points @ view[:3, :3].T + view[:3, 3]


def projected(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Project points of the world to a view: column and row in pixels, and depth. Behind the camera, only
    the depth has a meaning."""
    seen = in_camera_frame(camera, points)
    lens = to_device(camera.intrinsics.to(seen.dtype), seen.device)
    return torch.cat([(seen / seen[:, 2:]) @ lens[:2].T, seen[:, 2:]], dim=1)


@torch.no_grad()
def in_view(camera: Camera, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Return which Gaussians may be visible: all that are, and some that aren't. The ball of 3.5 standard
    deviations around each is tested against the planes through the image's edges."""
    points = in_camera_frame(camera, means)
    reach = 3.5 * scales.amax(dim=1)
    seen = points[:, 2] > 0
    margin = 8  # pixels: the rasterizer blurs every splat by one or two
    for axis, size in ((0, camera.width), (1, camera.height)):
        focal, middle = camera.intrinsics[axis, axis], camera.intrinsics[axis, 2]
        for side, edge in ((-1, middle + margin), (1, size + margin - middle)):
            outside = side * focal * points[:, axis] - edge * points[:, 2]
            seen &= outside <= reach * torch.hypot(focal, edge)
    return seen


_PER_PIXEL = 20
"""Bytes per pixel of a rendering and its maps; 5.7 GB were measured at 20,000 × 15,000 pixels."""


def resized(camera: Camera, longer_side: int) -> Camera:
    """Return the view with at most `longer_side` pixels on its longer side; it is never enlarged."""
    return with_longer_side(camera, min(longer_side, max(camera.width, camera.height)))


def with_longer_side(camera: Camera, pixels: int) -> Camera:
    """Return the view at another resolution. Raises UserError for a side below 1 or above `LONGEST_SIDE`, and
    if over half of the memory is needed."""
    if not (isinstance(pixels, Integral) and 1 <= pixels <= LONGEST_SIDE):
        raise UserError(f"a picture of {pixels} pixels can't be rendered: give 1 to {LONGEST_SIDE}")
    width, height = scaled_size(camera.width, camera.height, pixels / max(camera.width, camera.height))
    needed, most = _PER_PIXEL * width * height, machine_memory() / 2
    if needed > most:
        raise UserError(
            f"a picture of {width} × {height} pixels takes about {needed / 1e9:.1f} GB, over half of this "
            f"machine's memory: give at most {int(pixels * (most / needed) ** 0.5)} pixels"
        )
    return at_size(camera, height, width)


def at_size(camera: Camera, height: int, width: int) -> Camera:
    """Return the view in another number of pixels, stretched if the aspect ratio is another."""
    zoom = camera.intrinsics.new_tensor([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, intrinsics=camera.intrinsics * zoom, width=width, height=height)


def with_field_of_view(camera: Camera, degrees: float) -> Camera:
    """Return the view through a centered lens with another vertical field of view and square pixels. Raises
    UserError unless the field of view lies between 1 and 170 degrees."""
    if not (isinstance(degrees, Real) and 1 <= degrees <= 170):
        raise UserError(f"the field of view is {degrees}: give 1 to 170 degrees")
    focal = camera.height / 2 / math.tan(math.radians(degrees) / 2)
    lens = Lens(camera.width, camera.height, focal, focal, camera.width / 2, camera.height / 2)
    return replace(camera, intrinsics=lens.matrix.to(camera.intrinsics))


def posed(pose: Float[Tensor, "rows 4"], like: Camera) -> Camera:
    """Return a camera at a pose (camera → world, nerfstudio's axes) with the lens and size of `like`."""
    if pose.shape not in ((3, 4), (4, 4)):
        raise UserError(f"a pose has shape [3, 4] or [4, 4], not {list(pose.shape)}")
    try:
        check_pose(pose.double().tolist())
    except ValueError as error:
        raise UserError(f"{error}: give camera → world, such as the `pose` of a photo") from error
    return replace(like, view_matrix=view_matrix(pose[:3].float()))


def level(up: Float[Tensor, "3"], turn: float = 0.0) -> Float[Tensor, "3"]:
    """Return the direction perpendicular to `up` at a fraction of a full turn."""
    first = F.one_hot(up.abs().argmin(), 3).to(up)
    side = F.normalize(torch.linalg.cross(up, first), dim=0)
    return math.cos(2 * math.pi * turn) * side + math.sin(2 * math.pi * turn) * torch.linalg.cross(up, side)


def looking(
    place: Float[Tensor, "3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """Build an upright camera's view matrix (world → camera, OpenCV axes) from its place and its target."""
    forward = F.normalize(target - place, dim=0)
    right = F.normalize(torch.linalg.cross(forward, up), dim=0)
    down = torch.linalg.cross(forward, right)
    view = torch.eye(4)
    view[:3, :3] = torch.stack([right, down, forward])
    view[:3, 3] = -view[:3, :3] @ place
    return view
