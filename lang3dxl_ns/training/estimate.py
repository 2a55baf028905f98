"""Time of training, estimated by renderings before it begins, and the GPU that it needs."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from time import perf_counter

import torch

from lang3dxl_ns.common.device import unused_gpu, warn_of_unused_gpu
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import synchronize
from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.components.appearance import render_in_look
from lang3dxl_ns.components.feature_decoder import LearningDecoder
from lang3dxl_ns.rendering import gsplat_build
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.training.state import PhotoCamera, Training

RENDERINGS_PER_STEP = {False: 3.0, True: 4.0}
"""Duration of an iteration in renderings of its photo, by whether semantics are trained with the scene: 1.5
to 2.7 on landmarks and `castle`, and 3.0 for `paper` on a landmark, measured on a busy CPU."""
RENDERINGS_PER_PHOTO = 30.0
"""Duration of reading a photo's features onto the Gaussians, in renderings of it: measured 30 on one core for
160 channels, 18,000 Gaussians, 240×180 pixels."""


@torch.no_grad()
def estimate(run: Training, cameras: Sequence[PhotoCamera], steps: int) -> tuple[str, float]:
    """Estimate how long a number of iterations and learning words take with the present Gaussians. Return a
    line for the log, and the duration of learning words relative to the iterations'. It comes from the median
    of five renderings of a photo's view, since the first may compile kernels, and others may wait for another
    program."""
    view = sorted(cameras, key=lambda camera: camera.width * camera.height)[len(cameras) // 2]
    camera, looks, splats = view.camera(run.pose(view)), run.parts.appearance, run.splats()
    times = []
    for _ in range(5):
        start = perf_counter()
        look = None if looks is None else looks.of_view(camera)
        render_in_look(splats, camera, look, background=run.means.new_zeros(3))
        synchronize()
        times.append(perf_counter() - start)
    rendering, words = median(times), 0.0
    seconds = rendering * steps * RENDERINGS_PER_STEP[run.learns_from_renderings]
    line = f"training: {roughly(seconds)} for {steps:,} iterations"
    decoder = None if run.parts.semantics is None else run.parts.semantics.decoder
    if isinstance(decoder, LearningDecoder) and decoder.needs_lifting:
        words = rendering * len(cameras) * RENDERINGS_PER_PHOTO + decoder.learning_seconds(len(run.means))
        line += f", then {roughly(words)} to learn words"
    return f"{line}, more if Gaussians multiply", words / seconds if seconds else 1.0


def check_device(device: str, rasterizer: Backend) -> None:
    """Warn about an unused GPU, and build gsplat if it is needed, before anything is prepared. Raises
    UserError if there is no GPU though one is asked for, or if it must have gsplat and can't."""
    on_gpu = device.startswith("cuda")
    if on_gpu and not torch.cuda.is_available():
        raise UserError(f"torch can't use a GPU here: {unused_gpu() or 'there is none'}")
    warn_of_unused_gpu()
    if on_gpu and rasterizer == "gsplat":
        gsplat_build.make_ready()
    elif on_gpu and rasterizer == "auto":
        gsplat_build.ready()  # without it, training is slow: this and the estimate say so
