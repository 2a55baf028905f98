"""Projection on the CPU in fused kernels, 16 Gaussians at a time: same function as `projection.project`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
import torch.nn.functional as F
from torch.autograd.function import once_differentiable

from lang3dxl_ns.common.jit import in_threads, kernel, ranges
from lang3dxl_ns.rendering.ellipses import FRUSTUM_MARGIN, MAX_SIGMA_PIXELS, Ellipses
from lang3dxl_ns.rendering.gaussians import Gaussians
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
"""A quaternion shorter than this is divided by this, as by `torch.nn.functional.normalize`."""


class Lens(NamedTuple):
    """The camera without its pose, and the settings of a projection; numbers of the Gaussians' type."""

    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    low_x: float
    """Slopes x / z and y / z are held between these for the Jacobian."""
    low_y: float
    high_x: float
    high_y: float
    width: float
    height: float
    near: float
    eps2d: float
    antialiased: float
    """1 or 0."""


def project(
    gaussians: Gaussians, camera: Camera, *, near: float, eps2d: float, antialiased: bool
) -> Ellipses:
    """See `projection.project`; no gradient for the intrinsics, and none from the variances."""
    count = len(gaussians.means)
    parts = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    if count < LANES:  # a vector's worth at least; the rest is out of sight
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
    means2d, conics, variances, depths, opacities, radii = (part[:count] for part in found)
    return Ellipses(means2d[None], conics, variances, depths, opacities, radii[None])


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *values: Any) -> Any:  # type: ignore[override]
        inputs = tuple(value.contiguous() for value in values[:-1])
        means, count = inputs[0], len(inputs[0])
        found = tuple(means.new_empty(count, *columns) for columns in ((2,), (3,), (2,), (), ()))
        found += (torch.empty(count, dtype=torch.int32),)
        arrays = [part.numpy() for part in (*inputs, *found)]
        arguments = (*arrays[: len(inputs)], values[-1], *arrays[len(inputs) :])
        in_threads(_project, [(*part, *arguments) for part in _vectors(count)])
        ctx.lens = values[-1]
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(found[2], found[5])
        ctx.set_materialize_grads(False)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, means2d, conics, _variances, depths, opacities, _radii) -> Any:  # type: ignore[override]
        inputs = ctx.saved_tensors
        count = len(inputs[0])
        upstream = [
            inputs[0].new_zeros(count, *shape) if part is None else part.contiguous()
            for part, shape in ((means2d, (2,)), (conics, (3,)), (depths, ()), (opacities, ()))
        ]
        found = [torch.empty_like(part) for part in inputs[:4]]
        arrays = [part.numpy() for part in (*inputs, *upstream, *found)]
        arguments = (*arrays[: len(inputs)], ctx.lens, *arrays[len(inputs) :])
        parts = _vectors(count)
        views = np.zeros((len(parts), 4, 4), arrays[0].dtype)
        in_threads(_backward, [(*part, *arguments, views[k]) for k, part in enumerate(parts)])
        return *found, torch.from_numpy(views.sum(0)), None


def _vectors(count: int) -> list[tuple[int, int]]:
    """A range of Gaussians for each thread, divided between vectors."""
    return [(first * LANES, min(last * LANES, count)) for first, last in ranges(-(-count // LANES))]


@numba.njit(forceinline=True)
def _camera_axes(view):
    return (
        (view[0, 0], view[0, 1], view[0, 2]),
        (view[1, 0], view[1, 1], view[1, 2]),
        (view[2, 0], view[2, 1], view[2, 2]),
    )


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
def _load3(matrix, row):
    return load_column(matrix, row, 0), load_column(matrix, row, 1), load_column(matrix, row, 2)


@numba.njit(forceinline=True)
def _store3(matrix, row, value):
    store_column(matrix, row, 0, value[0])
    store_column(matrix, row, 1, value[1])
    store_column(matrix, row, 2, value[2])


@numba.njit(forceinline=True)
def _unit(quats, g):
    """Quaternions (w, x, y, z) of length 1 (or 0), and their divisors."""
    w, x = load_column(quats, g, 0), load_column(quats, g, 1)
    y, z = load_column(quats, g, 2), load_column(quats, g, 3)
    length = maximum(sqrt(w * w + x * x + y * y + z * z), _LENGTH_MIN)
    return w / length, x / length, y / length, z / length, length


@numba.njit(forceinline=True)
def _columns(w, x, y, z):
    """Columns of the rotation matrix."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@numba.njit(forceinline=True)
def _points(means, scales, view, lens, g):
    """Camera coordinates, scales, and where they are drawable; elsewhere (0, 0, 1) and 0."""
    right, down, forward = _camera_axes(view)
    mean, scale = _load3(means, g), _load3(scales, g)
    z = _dot(mean, forward) + view[2, 3]
    sigma = maximum(maximum(scale[0], scale[1]), scale[2]) * max(lens.focal_x, lens.focal_y)
    drawable = (z > lens.near) & (sigma < z * MAX_SIGMA_PIXELS)
    x = where(drawable, _dot(mean, right) + view[0, 3], 0.0)
    y = where(drawable, _dot(mean, down) + view[1, 3], 0.0)
    scale = where(drawable, scale[0], 0.0), where(drawable, scale[1], 0.0), where(drawable, scale[2], 0.0)
    return mean, scale, drawable, x, y, where(drawable, z, 1.0)


@numba.njit(forceinline=True)
def _jacobian_row(axis, forward, slope, focal, z):
    """Derivative of one pixel coordinate by the world position."""
    factor = focal / z
    return (
        (axis[0] - slope * forward[0]) * factor,
        (axis[1] - slope * forward[1]) * factor,
        (axis[2] - slope * forward[2]) * factor,
    )


@numba.njit(forceinline=True)
def _ellipse(row_x, row_y, columns, scale, eps2d):
    """The rows in the Gaussian's own axes, before and after scaling; their cross product and its length; the
    covariance and its determinant, blurred (`projection.project` has the reason for this form)."""
    plain_x = _dot(row_x, columns[0]), _dot(row_x, columns[1]), _dot(row_x, columns[2])
    plain_y = _dot(row_y, columns[0]), _dot(row_y, columns[1]), _dot(row_y, columns[2])
    axes_x = plain_x[0] * scale[0], plain_x[1] * scale[1], plain_x[2] * scale[2]
    axes_y = plain_y[0] * scale[0], plain_y[1] * scale[1], plain_y[2] * scale[2]
    normal = _cross(axes_x, axes_y)
    area2 = _dot(normal, normal)
    xx, yy, xy = _dot(axes_x, axes_x), _dot(axes_y, axes_y), _dot(axes_x, axes_y)
    determinant = area2 + (xx + yy) * eps2d + eps2d * eps2d
    return plain_x, plain_y, axes_x, axes_y, normal, area2, xx + eps2d, yy + eps2d, xy, determinant


@kernel
def _project(
    first, last, means, quats, scales, opacities, view, lens, means2d, conics, variances, depths, opacity,
    radii,
):  # fmt: skip
    right, down, forward = _camera_axes(view)
    width, height, eps2d, antialiased = lens.width, lens.height, lens.eps2d, lens.antialiased > 0
    reach = np.empty(LANES, means.dtype)
    for start in range(first, last, LANES):
        g = min(start, len(means) - LANES)  # the last vector repeats some of the one before it
        _, scale, drawable, x, y, z = _points(means, scales, view, lens, g)
        slope_x, slope_y = x / z, y / z
        u, v = slope_x * lens.focal_x + lens.center_x, slope_y * lens.focal_y + lens.center_y
        row_x = _jacobian_row(
            right, forward, minimum(maximum(slope_x, lens.low_x), lens.high_x), lens.focal_x, z
        )
        row_y = _jacobian_row(
            down, forward, minimum(maximum(slope_y, lens.low_y), lens.high_y), lens.focal_y, z
        )
        w, i, j, k, _ = _unit(quats, g)
        _, _, _, _, _, area2, xx, yy, xy, determinant = _ellipse(
            row_x, row_y, _columns(w, i, j, k), scale, eps2d
        )
        determinant = maximum(determinant, _DETERMINANT_MIN)
        alpha = where(drawable, load(opacities, g), 0.0)
        if antialiased:
            alpha *= sqrt(area2 / determinant)
        store_column(means2d, g, 0, u)
        store_column(means2d, g, 1, v)
        store_column(conics, g, 0, yy / determinant)
        store_column(conics, g, 1, xy * -1.0 / determinant)
        store_column(conics, g, 2, xx / determinant)
        store_column(variances, g, 0, xx)
        store_column(variances, g, 1, yy)
        store(depths, g, z)
        store(opacity, g, alpha)
        half = (xx - yy) * 0.5
        spread = sqrt(maximum(half * half + xy * xy, 0.01))
        radius = ceil(sqrt((xx + yy) * 0.5 + spread) * 3.0)
        inside = (u + radius > 0.0) & (u - radius < width) & (v + radius > 0.0) & (v - radius < height)
        store(reach, 0, where(inside & drawable, minimum(radius, 2e9), 0.0))
        for lane in range(LANES):
            radii[g + lane] = int(reach[lane])


@kernel
def _backward(
    first, last, means, quats, scales, opacities, view, lens, g_means2d, g_conics, g_depths, g_opacity,
    g_means, g_quats, g_scales, g_opacities, g_view,
):  # fmt: skip
    """The chain rule through `_project`, from its outputs back."""
    right, down, forward = _camera_axes(view)
    eps2d, antialiased = lens.eps2d, lens.antialiased > 0
    lanes = np.empty(LANES, means.dtype)
    for lane in range(LANES):
        lanes[lane] = lane
    numbers = load(lanes, 0)
    zero = numbers * 0.0
    nothing = (zero, zero, zero)
    sum_right, sum_down, sum_forward, sum_shift = nothing, nothing, nothing, nothing
    for start in range(first, last, LANES):
        g = min(start, len(means) - LANES)
        mean, scale, drawable, x, y, z = _points(means, scales, view, lens, g)
        slope_x, slope_y = x / z, y / z
        held_x = minimum(maximum(slope_x, lens.low_x), lens.high_x)
        held_y = minimum(maximum(slope_y, lens.low_y), lens.high_y)
        row_x = _jacobian_row(right, forward, held_x, lens.focal_x, z)
        row_y = _jacobian_row(down, forward, held_y, lens.focal_y, z)
        w, i, j, k, length = _unit(quats, g)
        columns = _columns(w, i, j, k)
        plain_x, plain_y, axes_x, axes_y, normal, area2, xx, yy, xy, exact = _ellipse(
            row_x, row_y, columns, scale, eps2d
        )
        determinant = maximum(exact, _DETERMINANT_MIN)

        # Conic and opacity to the covariance, its determinant and the area of the sharp ellipse.
        c0, c1, c2 = _load3(g_conics, g)
        g_alpha = where(drawable, load(g_opacity, g), 0.0)
        g_xx, g_yy, g_xy = c2 / determinant, c0 / determinant, c1 * -1.0 / determinant
        g_determinant = (c0 * yy - c1 * xy + c2 * xx) * -1.0 / (determinant * determinant)
        g_area2 = zero
        if antialiased:
            ratio = sqrt(area2 / determinant)
            opacity = load(opacities, g)
            g_determinant -= g_alpha * opacity * ratio * 0.5 / determinant
            # The area's own gradient; zero where the area is 0, as for a vector's length.
            g_area2 = where(area2 > 0.0, g_alpha * opacity * 0.5 / (sqrt(area2) * sqrt(determinant)), 0.0)
            g_alpha *= ratio
        store(g_opacities, g, g_alpha)
        g_determinant = where(exact >= _DETERMINANT_MIN, g_determinant, 0.0)
        g_xx += g_determinant * eps2d
        g_yy += g_determinant * eps2d
        g_normal = _scaled(normal, (g_determinant + g_area2) * 2.0)

        # To the scaled axes, the scales, the rotation and the rows of the Jacobian.
        g_axes_x = _plus(_plus(_scaled(axes_x, g_xx * 2.0), _scaled(axes_y, g_xy)), _cross(axes_y, g_normal))
        g_axes_y = _plus(_plus(_scaled(axes_y, g_yy * 2.0), _scaled(axes_x, g_xy)), _cross(g_normal, axes_x))
        g_scale = (
            where(drawable, g_axes_x[0] * plain_x[0] + g_axes_y[0] * plain_y[0], 0.0),
            where(drawable, g_axes_x[1] * plain_x[1] + g_axes_y[1] * plain_y[1], 0.0),
            where(drawable, g_axes_x[2] * plain_x[2] + g_axes_y[2] * plain_y[2], 0.0),
        )
        _store3(g_scales, g, g_scale)
        g_plain_x = g_axes_x[0] * scale[0], g_axes_x[1] * scale[1], g_axes_x[2] * scale[2]
        g_plain_y = g_axes_y[0] * scale[0], g_axes_y[1] * scale[1], g_axes_y[2] * scale[2]
        a = _plus(_scaled(row_x, g_plain_x[0]), _scaled(row_y, g_plain_y[0]))
        b = _plus(_scaled(row_x, g_plain_x[1]), _scaled(row_y, g_plain_y[1]))
        c = _plus(_scaled(row_x, g_plain_x[2]), _scaled(row_y, g_plain_y[2]))
        _store_quaternion(g_quats, g, w, i, j, k, length, a, b, c)
        g_row_x = _plus(
            _plus(_scaled(columns[0], g_plain_x[0]), _scaled(columns[1], g_plain_x[1])),
            _scaled(columns[2], g_plain_x[2]),
        )
        g_row_y = _plus(
            _plus(_scaled(columns[0], g_plain_y[0]), _scaled(columns[1], g_plain_y[1])),
            _scaled(columns[2], g_plain_y[2]),
        )

        # To the camera's axes and the point in its frame.
        g_right, g_down = _scaled(g_row_x, lens.focal_x / z), _scaled(g_row_y, lens.focal_y / z)
        g_forward = _scaled(_plus(_scaled(g_right, held_x), _scaled(g_down, held_y)), -1.0)
        free_x = where((slope_x >= lens.low_x) & (slope_x <= lens.high_x), _dot(g_right, forward), 0.0)
        free_y = where((slope_y >= lens.low_y) & (slope_y <= lens.high_y), _dot(g_down, forward), 0.0)
        g_slope_x = load_column(g_means2d, g, 0) * lens.focal_x - free_x
        g_slope_y = load_column(g_means2d, g, 1) * lens.focal_y - free_y
        turned = _dot(g_row_x, row_x) + _dot(g_row_y, row_y) + g_slope_x * slope_x + g_slope_y * slope_y
        new = drawable & (numbers >= (start - g) * 1.0)
        g_x, g_y = where(drawable, g_slope_x / z, 0.0), where(drawable, g_slope_y / z, 0.0)
        g_z = where(drawable, load(g_depths, g) - turned / z, 0.0)
        g_point = _plus(_plus(_times(right, g_x), _times(down, g_y)), _times(forward, g_z))
        _store3(g_means, g, g_point)

        g_x, g_y, g_z = where(new, g_x, 0.0), where(new, g_y, 0.0), where(new, g_z, 0.0)
        mean = where(new, mean[0], 0.0), where(new, mean[1], 0.0), where(new, mean[2], 0.0)
        sum_right = _plus(_plus(sum_right, _scaled(mean, g_x)), _only(new, g_right))
        sum_down = _plus(_plus(sum_down, _scaled(mean, g_y)), _only(new, g_down))
        sum_forward = _plus(_plus(sum_forward, _scaled(mean, g_z)), _only(new, g_forward))
        sum_shift = _plus(sum_shift, (g_x, g_y, g_z))
    _store_total(g_view, 0, sum_right, sum_shift[0])
    _store_total(g_view, 1, sum_down, sum_shift[1])
    _store_total(g_view, 2, sum_forward, sum_shift[2])


@numba.njit(forceinline=True)
def _times(scalars, vector):
    return vector * scalars[0], vector * scalars[1], vector * scalars[2]


@numba.njit(forceinline=True)
def _only(condition, a):
    return where(condition, a[0], 0.0), where(condition, a[1], 0.0), where(condition, a[2], 0.0)


@numba.njit(forceinline=True)
def _store_total(view, row, axis, shift):
    view[row, 0], view[row, 1], view[row, 2], view[row, 3] = (
        total(axis[0]), total(axis[1]), total(axis[2]), total(shift),
    )  # fmt: skip


@numba.njit(forceinline=True)
def _store_quaternion(g_quats, g, w, x, y, z, length, a, b, c):
    """Gradient of the quaternion as given, from that of the rotation's columns a, b and c."""
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
