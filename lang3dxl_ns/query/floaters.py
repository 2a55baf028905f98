"""Floaters: Gaussians that no surface explains, from how large they are and what the views show of them.

Where photos disagree, training puts large, blurred Gaussians into the free space before what they show. They
are larger than most, lie before the surface that other views see, and fill pixels in nearly every view that
they are in, since nothing hides them. Sky and ground are as large, but lie behind everything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.query.visibility import VisibleGaussians
from lang3dxl_ns.rendering import Rendering, Splats
from lang3dxl_ns.scene.camera import Camera, projected, resized

FLOATS = 0.5
"""Score above which a Gaussian counts as a floater."""
_SIDE = 160
"""Longer side in pixels of the views whose depth is compared."""
_BEFORE = 0.85
"""Share of a view's depth up to which a Gaussian lies before what the view shows."""
_LEAST_FRONT = 0.2
"""Share of the views around it before whose surface a floater lies at least."""
_SIZE, _FRONT, _SEEN, _BIAS = 2.2, 5.0, 3.0, -6.8
"""Weights of the score's logit; docs/lab/speed.md shows what they hide."""


def floating(
    splats: Splats, views: Mapping[str, VisibleGaussians], draw: Callable[[Camera], Rendering]
) -> Float[Tensor, " n"]:
    """Compute how surely each Gaussian is a floater, 0…1. `views` are the Gaussians visible in each training
    view, as `Scene.visible` measures them; `draw` renders a camera with its depth."""
    count, device = len(splats), splats.means.device
    before, on, inside, seen = (torch.zeros(count, device=device) for _ in range(4))
    for view in views.values():
        camera = resized(view.camera, _SIDE)
        rows, depth, shown = _in_view(splats, camera, draw(camera))
        inside[rows] += 1
        before[rows] += (depth < _BEFORE * shown).float()
        on[rows] += ((depth >= _BEFORE * shown) & (depth < shown / _BEFORE)).float()
        seen[view.rows[view.pixels > 0.5].long()] += 1
    sizes = splats.scales.amax(1)
    known = (seen > 0) & splats.sound()
    if not bool(known.any()):
        return torch.zeros(count, device=device)
    larger = (sizes / sizes[known].median()).clamp_min(1e-9).log()
    front, share = before / (before + on + 1), seen / inside.clamp_min(1)
    logit = _SIZE * larger + _FRONT * front + _SEEN * share.clamp_max(1) + _BIAS
    return torch.where(splats.sound() & (front > _LEAST_FRONT), logit.sigmoid(), 0.0)


def _in_view(splats: Splats, camera: Camera, rendering: Rendering) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows of Gaussians with centers in a view, their depths, and the depths rendered there."""
    x, y, depth = projected(camera, splats.means).unbind(1)
    inside = (depth > 0.01) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    rows = inside.nonzero().squeeze(1)
    return rows, depth[rows], rendering.depth[y[rows].long(), x[rows].long()]
