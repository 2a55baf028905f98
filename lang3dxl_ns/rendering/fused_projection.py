"""Projection on the CPU in fused kernels, 16 Gaussians at a time: the function of `projection.project`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.rendering.gaussians import FRUSTUM_MARGIN, MAX_SIGMA_PIXELS, Ellipses, Gaussians
from lang3dxl_ns.rendering.simd import (
    LANES,
    ceil,
    load,
    load_column,
    maximum,
    minimum,
    sqrt,
    store,
    store_column,
    total,
    where,
)
from lang3dxl_ns.scene.camera import Camera

_DETERMINANT_MIN = 1e-10
_LENGTH_MIN = 1e-12
"""Shortest length by which a quaternion is divided, as in `torch.nn.functional.normalize`."""


class Lens(NamedTuple):
    """Intrinsics of the camera and settings of a projection, as numbers of the Gaussians' type."""

    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    low_x: float
    """Limits of the slopes x / z and y / z in the Jacobian."""
    low_y: float
    high_x: float
    high_y: float
    width: float
    height: float
    near: float
    eps2d: float
    antialiased: float
    """Whether opacities are scaled for antialiasing: 1 or 0."""


def project(
    gaussians: Gaussians, camera: Camera, *, near: float, eps2d: float, antialiased: bool
) -> Ellipses:
    """Project Gaussians as `projection.project` does. Intrinsics get no gradient."""
    count = len(gaussians.means)
    parts = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    if count < LANES:  # at least one full vector; the padding is not visible
        missing = LANES - count
        parts = [F.pad(part, (0, 0) * (part.dim() - 1) + (0, missing)) for part in parts]
    intrinsics = camera.intrinsics.to(gaussians.means)
    focal, center = intrinsics.diagonal()[:2], intrinsics[:2, 2]
    size = intrinsics.new_tensor([camera.width, camera.height])
    margin = FRUSTUM_MARGIN * 0.5 * size / focal
    lens = torch.cat([focal, center, -center / focal - margin, (size - center) / focal + margin, size])
    limits = lens.new_tensor([near, eps2d, float(antialiased)])
    view = camera.view_matrix.to(gaussians.means)
    found = _Projection.apply(*parts, view, Lens(*torch.cat([lens, limits]).detach().numpy()))
    means2d, conics, depths, opacities, variances, radii = (part[:count] for part in found)
    return Ellipses(means2d[None], conics, variances, depths, opacities, radii[None])


class _World(NamedTuple):
    """Gaussians and the camera's pose, or the Gaussians' gradients without one for the pose."""

    means: Float[np.ndarray, "n 3"]
    quats: Float[np.ndarray, "n 4"]
    scales: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, " n"]
    pose: Float[np.ndarray, "4 4"] | None = None


class _Screen(NamedTuple):
    """Screen ellipses, or their gradients."""

    means2d: Float[np.ndarray, "n 2"]
    conics: Float[np.ndarray, "n 3"]
    depths: Float[np.ndarray, " n"]
    opacities: Float[np.ndarray, " n"]
    variances: Float[np.ndarray, "n 2"]
    radii: Int[np.ndarray, " n"] | None = None


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *values: Any) -> Any:  # type: ignore[override]
        inputs, lens = tuple(value.contiguous() for value in values[:-1]), values[-1]
        means, count = inputs[0], len(inputs[0])
        found = [means.new_empty(count, *columns) for columns in ((2,), (3,), (), (), (2,))]
        found.append(torch.empty(count, dtype=torch.int32))
        arrays = _World(*(part.numpy() for part in inputs)), lens, _Screen(*(part.numpy() for part in found))
        in_threads(_project, [(*part, *arrays) for part in _vectors(count)])
        ctx.lens = lens
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(found[5])
        ctx.set_materialize_grads(False)
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:  # type: ignore[override]
        inputs = ctx.saved_tensors
        count = len(inputs[0])
        slopes = [
            inputs[0].new_zeros(count, *shape) if part is None else part.contiguous()
            for part, shape in zip(upstream[:5], ((2,), (3,), (), (), (2,)), strict=True)
        ]
        found = [torch.empty_like(part) for part in inputs[:4]]
        world, gradients = (_World(*(part.numpy() for part in arrays)) for arrays in (inputs, found))
        shared = world, ctx.lens, _Screen(*(part.numpy() for part in slopes)), gradients
        parts = _vectors(count)
        views = np.zeros((len(parts), 4, 4), world.means.dtype)
        in_threads(_backward, [(*part, *shared, views[k]) for k, part in enumerate(parts)])
        return *found, torch.from_numpy(views.sum(0)), None


def _vectors(count: int) -> list[tuple[int, int]]:
    """Return a range of Gaussians for each thread, divided at vector boundaries."""
    return [(first * LANES, min(last * LANES, count)) for first, last in ranges(-(-count // LANES))]


@numba.njit(forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(forceinline=True)
def _scaled(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@numba.njit(forceinline=True)
def _plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@numba.njit(forceinline=True)
def _product(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@numba.njit(forceinline=True)
def _only(condition, a):
    return where(condition, a[0], 0.0), where(condition, a[1], 0.0), where(condition, a[2], 0.0)


@numba.njit(forceinline=True)
def _weighted(a, b, c, weights):
    """Compute a · weights[0] + b · weights[1] + c · weights[2]."""
    return _plus(_plus(_scaled(a, weights[0]), _scaled(b, weights[1])), _scaled(c, weights[2]))


@numba.njit(forceinline=True)
def _load3(matrix, row):
    return load_column(matrix, row, 0), load_column(matrix, row, 1), load_column(matrix, row, 2)


@numba.njit(forceinline=True)
def _store3(matrix, row, value):
    store_column(matrix, row, 0, value[0])
    store_column(matrix, row, 1, value[1])
    store_column(matrix, row, 2, value[2])


class _Vector(NamedTuple):
    """State of 16 Gaussians during projection, in vectors of 16 numbers and tuples of such vectors."""

    mean: Any
    scale: Any  # 0 where the Gaussian is not drawable
    drawable: Any
    z: Any
    slope_x: Any
    slope_y: Any
    held_x: Any  # slopes clamped for the Jacobian
    held_y: Any
    row_x: Any  # rows of the Jacobian: derivatives of the pixel coordinates by the world position
    row_y: Any
    quat: Any  # w, x, y, z of length 1 (or 0)
    length: Any  # the divisor that normalized it
    columns: Any  # of the rotation matrix
    plain_x: Any  # the rows in the Gaussian's own axes, then scaled
    plain_y: Any
    axes_x: Any
    axes_y: Any
    normal: Any  # cross product of the scaled rows, and its squared length
    area2: Any
    xx: Any  # covariance and its determinant, blurred (`projection.project` explains this form)
    yy: Any
    xy: Any
    determinant: Any


@numba.njit(forceinline=True)
def _camera_axes(view):
    right, down = (view[0, 0], view[0, 1], view[0, 2]), (view[1, 0], view[1, 1], view[1, 2])
    return right, down, (view[2, 0], view[2, 1], view[2, 2])


@numba.njit(forceinline=True)
def _jacobian_row(axis, forward, slope, focal, z):
    factor = focal / z
    return (
        (axis[0] - slope * forward[0]) * factor,
        (axis[1] - slope * forward[1]) * factor,
        (axis[2] - slope * forward[2]) * factor,
    )


@numba.njit(forceinline=True)
def _look(world, lens, g):
    """Transform Gaussians g … g + 15. Those that are not drawable are at (0, 0, 1) and have no size."""
    right, down, forward = _camera_axes(world.pose)
    mean, scale = _load3(world.means, g), _load3(world.scales, g)
    z = _dot(mean, forward) + world.pose[2, 3]
    sigma = maximum(maximum(scale[0], scale[1]), scale[2]) * max(lens.focal_x, lens.focal_y)
    drawable = (z > lens.near) & (sigma < z * MAX_SIGMA_PIXELS)
    scale, z = _only(drawable, scale), where(drawable, z, 1.0)
    slope_x = where(drawable, _dot(mean, right) + world.pose[0, 3], 0.0) / z
    slope_y = where(drawable, _dot(mean, down) + world.pose[1, 3], 0.0) / z
    held_x = minimum(maximum(slope_x, lens.low_x), lens.high_x)
    held_y = minimum(maximum(slope_y, lens.low_y), lens.high_y)
    row_x = _jacobian_row(right, forward, held_x, lens.focal_x, z)
    row_y = _jacobian_row(down, forward, held_y, lens.focal_y, z)

    w, i = load_column(world.quats, g, 0), load_column(world.quats, g, 1)
    j, k = load_column(world.quats, g, 2), load_column(world.quats, g, 3)
    length = maximum(sqrt(w * w + i * i + j * j + k * k), _LENGTH_MIN)
    w, i, j, k = w / length, i / length, j / length, k / length
    columns = (
        (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k), 2.0 * (i * k - w * j)),
        (2.0 * (i * j - w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k + w * i)),
        (2.0 * (i * k + w * j), 2.0 * (j * k - w * i), 1.0 - 2.0 * (i * i + j * j)),
    )

    plain_x = _dot(row_x, columns[0]), _dot(row_x, columns[1]), _dot(row_x, columns[2])
    plain_y = _dot(row_y, columns[0]), _dot(row_y, columns[1]), _dot(row_y, columns[2])
    axes_x, axes_y = _product(plain_x, scale), _product(plain_y, scale)
    normal = _cross(axes_x, axes_y)
    area2 = _dot(normal, normal)
    xx, yy, xy = _dot(axes_x, axes_x), _dot(axes_y, axes_y), _dot(axes_x, axes_y)
    determinant = area2 + (xx + yy) * lens.eps2d + lens.eps2d * lens.eps2d
    xx, yy = xx + lens.eps2d, yy + lens.eps2d
    return _Vector(
        mean, scale, drawable, z, slope_x, slope_y, held_x, held_y, row_x, row_y, (w, i, j, k), length,
        columns, plain_x, plain_y, axes_x, axes_y, normal, area2, xx, yy, xy, determinant,
    )  # fmt: skip


@kernel
def _project(first, last, world, lens, screen):
    reach = np.empty(LANES, world.means.dtype)
    for start in range(first, last, LANES):
        g = min(start, len(world.means) - LANES)  # the last vector overlaps the one before it
        v = _look(world, lens, g)
        x, y = v.slope_x * lens.focal_x + lens.center_x, v.slope_y * lens.focal_y + lens.center_y
        determinant = maximum(v.determinant, _DETERMINANT_MIN)
        alpha = where(v.drawable, load(world.opacities, g), 0.0)
        if lens.antialiased > 0:
            alpha *= sqrt(v.area2 / determinant)
        store_column(screen.means2d, g, 0, x)
        store_column(screen.means2d, g, 1, y)
        _store3(screen.conics, g, (v.yy / determinant, v.xy * -1.0 / determinant, v.xx / determinant))
        store_column(screen.variances, g, 0, v.xx)
        store_column(screen.variances, g, 1, v.yy)
        store(screen.depths, g, v.z)
        store(screen.opacities, g, alpha)
        half = (v.xx - v.yy) * 0.5
        spread = sqrt(maximum(half * half + v.xy * v.xy, 0.01))
        radius = ceil(sqrt((v.xx + v.yy) * 0.5 + spread) * 3.0)
        inside = (x + radius > 0.0) & (x - radius < lens.width) & (y + radius > 0.0)
        inside = inside & (y - radius < lens.height) & v.drawable
        store(reach, 0, where(inside, minimum(radius, 2e9), 0.0))
        for lane in range(LANES):
            screen.radii[g + lane] = int(reach[lane])


@kernel
def _backward(first, last, world, lens, upstream, found, g_view):
    """Apply the chain rule through `_project`, from its outputs back."""
    right, down, forward = _camera_axes(world.pose)
    lanes = np.empty(LANES, world.means.dtype)
    for lane in range(LANES):
        lanes[lane] = lane
    numbers = load(lanes, 0)
    zero = numbers * 0.0
    nothing = (zero, zero, zero)
    sum_right, sum_down, sum_forward, sum_shift = nothing, nothing, nothing, nothing
    for start in range(first, last, LANES):
        g = min(start, len(world.means) - LANES)
        v = _look(world, lens, g)
        g_row_x, g_row_y = _to_rows(world, lens, upstream, found, v, g)

        # Next: gradients of the camera's axes and of the point in its frame.
        g_right, g_down = _scaled(g_row_x, lens.focal_x / v.z), _scaled(g_row_y, lens.focal_y / v.z)
        g_forward = _scaled(_plus(_scaled(g_right, v.held_x), _scaled(g_down, v.held_y)), -1.0)
        free_x = (v.slope_x >= lens.low_x) & (v.slope_x <= lens.high_x)
        free_y = (v.slope_y >= lens.low_y) & (v.slope_y <= lens.high_y)
        g_slope_x = load_column(upstream.means2d, g, 0) * lens.focal_x
        g_slope_x -= where(free_x, _dot(g_right, forward), 0.0)
        g_slope_y = load_column(upstream.means2d, g, 1) * lens.focal_y
        g_slope_y -= where(free_y, _dot(g_down, forward), 0.0)
        turned = _dot(g_row_x, v.row_x) + _dot(g_row_y, v.row_y)
        turned = turned + g_slope_x * v.slope_x + g_slope_y * v.slope_y
        g_z = load(upstream.depths, g) - turned / v.z
        g_point = _only(v.drawable, (g_slope_x / v.z, g_slope_y / v.z, g_z))
        _store3(found.means, g, _weighted(right, down, forward, g_point))

        new = v.drawable & (numbers >= (start - g) * 1.0)
        g_point, mean = _only(new, g_point), _only(new, v.mean)
        sum_right = _plus(_plus(sum_right, _scaled(mean, g_point[0])), _only(new, g_right))
        sum_down = _plus(_plus(sum_down, _scaled(mean, g_point[1])), _only(new, g_down))
        sum_forward = _plus(_plus(sum_forward, _scaled(mean, g_point[2])), _only(new, g_forward))
        sum_shift = _plus(sum_shift, g_point)
    _store_total(g_view, 0, sum_right, sum_shift[0])
    _store_total(g_view, 1, sum_down, sum_shift[1])
    _store_total(g_view, 2, sum_forward, sum_shift[2])


@numba.njit(forceinline=True)
def _to_rows(world, lens, upstream, found, v, g):
    """Store the gradients of opacities, scales and quaternions, and return those of the Jacobian's rows."""
    determinant = maximum(v.determinant, _DETERMINANT_MIN)
    # From conic, variances and opacity to the covariance, its determinant and the area of the sharp ellipse.
    c0, c1, c2 = _load3(upstream.conics, g)
    g_alpha = where(v.drawable, load(upstream.opacities, g), 0.0)
    g_xx, g_yy, g_xy = c2 / determinant, c0 / determinant, c1 * -1.0 / determinant
    # The determinant is area2 plus what blur adds. The gradients of both are computed times the determinant.
    # Without that factor, they would underflow for huge ellipses, whose determinant's square overflows.
    free = v.determinant >= _DETERMINANT_MIN
    g_area2 = g_added = where(free, (c0 * v.yy - c1 * v.xy + c2 * v.xx) * -1.0 / determinant, 0.0)
    if lens.antialiased > 0:
        ratio = sqrt(v.area2 / determinant)
        half = g_alpha * load(world.opacities, g) * 0.5
        added = where(free, (v.xx + v.yy - lens.eps2d) * lens.eps2d, determinant)
        g_added -= where(free, half * ratio, 0.0)
        # The derivative of ln(area2 / determinant) by ln(area2) is added / determinant: nothing cancels.
        # The gradient of the area is zero where the area is 0, as for a vector's length.
        g_area2 += where(v.area2 > 0.0, half * added / (sqrt(v.area2) * sqrt(determinant)), 0.0)
        g_alpha *= ratio
    store(found.opacities, g, g_alpha)
    g_xx += g_added / determinant * lens.eps2d + load_column(upstream.variances, g, 0)
    g_yy += g_added / determinant * lens.eps2d + load_column(upstream.variances, g, 1)
    g_normal = _scaled(_scaled(v.normal, 2.0 / determinant), g_area2)

    # From there to the scaled axes, the scales, the rotation and the rows of the Jacobian.
    g_axes_x = _plus(_scaled(v.axes_x, g_xx * 2.0), _scaled(v.axes_y, g_xy))
    g_axes_x = _plus(g_axes_x, _cross(v.axes_y, g_normal))
    g_axes_y = _plus(_scaled(v.axes_y, g_yy * 2.0), _scaled(v.axes_x, g_xy))
    g_axes_y = _plus(g_axes_y, _cross(g_normal, v.axes_x))
    g_scale = _plus(_product(g_axes_x, v.plain_x), _product(g_axes_y, v.plain_y))
    _store3(found.scales, g, _only(v.drawable, g_scale))
    g_plain_x, g_plain_y = _product(g_axes_x, v.scale), _product(g_axes_y, v.scale)
    a = _plus(_scaled(v.row_x, g_plain_x[0]), _scaled(v.row_y, g_plain_y[0]))
    b = _plus(_scaled(v.row_x, g_plain_x[1]), _scaled(v.row_y, g_plain_y[1]))
    c = _plus(_scaled(v.row_x, g_plain_x[2]), _scaled(v.row_y, g_plain_y[2]))
    _store_quaternion(found.quats, g, v.quat, v.length, a, b, c)
    first, second, third = v.columns
    return _weighted(first, second, third, g_plain_x), _weighted(first, second, third, g_plain_y)


@numba.njit(forceinline=True)
def _store_total(view, row, axis, shift):
    view[row, 0], view[row, 1], view[row, 2] = total(axis[0]), total(axis[1]), total(axis[2])
    view[row, 3] = total(shift)


@numba.njit(forceinline=True)
def _store_quaternion(g_quats, g, quat, length, a, b, c):
    """Store the gradient of the quaternion as given, from those of the rotation's columns a, b and c."""
    w, x, y, z = quat
    g_w = ((a[1] - b[0]) * z + (c[0] - a[2]) * y + (b[2] - c[1]) * x) * 2.0
    g_x = ((a[1] + b[0]) * y + (a[2] + c[0]) * z + (b[2] - c[1]) * w - (b[1] + c[2]) * x * 2.0) * 2.0
    g_y = ((a[1] + b[0]) * x + (b[2] + c[1]) * z + (c[0] - a[2]) * w - (a[0] + c[2]) * y * 2.0) * 2.0
    g_z = ((a[2] + c[0]) * x + (b[2] + c[1]) * y + (a[1] - b[0]) * w - (a[0] + b[1]) * z * 2.0) * 2.0
    # A change along the quaternion itself has no effect.
    along = where(length > _LENGTH_MIN, g_w * w + g_x * x + g_y * y + g_z * z, 0.0)
    store_column(g_quats, g, 0, (g_w - along * w) / length)
    store_column(g_quats, g, 1, (g_x - along * x) / length)
    store_column(g_quats, g, 2, (g_y - along * y) / length)
    store_column(g_quats, g, 3, (g_z - along * z) / length)
