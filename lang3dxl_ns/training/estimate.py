"""Time of training, estimated by renderings before it begins; GPUs on which it would take hours."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from time import perf_counter

import torch

from lang3dxl_ns.common.device import unused_gpu, warn_of_unused_gpu
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.options import model_option
from lang3dxl_ns.common.reports import synchronize
from lang3dxl_ns.common.stages import roughly
from lang3dxl_ns.components.appearance import render_in_look
from lang3dxl_ns.rendering import Gaussians, gsplat_build, rasterize
from lang3dxl_ns.rendering.rasterize import Backend
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.training.state import PhotoCamera, Training

RENDERINGS_PER_STEP = {False: 3.0, True: 4.0}
"""Duration of an iteration in renderings of its photo, by whether semantics are trained with the scene: 1.5
to 2.7 on landmarks and `castle`, and 3.0 for `paper` on a landmark, measured on a busy CPU."""
RENDERINGS_PER_PHOTO = 30.0
"""Duration of reading a photo's features onto the Gaussians, in renderings of it: measured 30 on one core for
160 channels, 18,000 Gaussians, 240×180 pixels."""
LONG_RUN_S = 3_600.0
"""Seconds of training on a slow GPU rasterizer above which a run is refused."""


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
    if (semantics := run.parts.semantics) is not None and semantics.decoder.needs_lifting:
        words = rendering * len(cameras) * RENDERINGS_PER_PHOTO
        words += semantics.decoder.learning_seconds(len(run.means))
        line += f", then {roughly(words)} to learn words"
    return f"{line}, more if Gaussians multiply", words / seconds if seconds else 1.0


def check_device(device: str, rasterizer: Backend, steps: int) -> None:
    """Warn about an unused GPU, and build gsplat if it is needed, before anything is prepared. Raises
    UserError if there is no GPU though one is asked for, or if it would take hours without gsplat."""
    on_gpu = device.startswith("cuda")
    if on_gpu and not torch.cuda.is_available():
        raise UserError(f"torch can't use a GPU here: {unused_gpu() or 'there is none'}")
    warn_of_unused_gpu()
    if on_gpu and rasterizer == "gsplat":
        gsplat_build.make_ready()
    elif on_gpu and rasterizer == "auto" and not gsplat_build.ready():
        seconds = RENDERINGS_PER_STEP[False] * steps * torch_rendering_seconds()
        if seconds > LONG_RUN_S:
            raise UserError(
                f"without gsplat (the warning above says what is missing) {steps:,} iterations would take "
                f"{roughly(seconds)} or more on this GPU: install what is missing, or pass "
                f"{model_option('rasterizer torch')} to train with the slow rasterizer all the same"
            )


def torch_rendering_seconds(count: int = 50_000, size: tuple[int, int] = (1000, 700)) -> float:
    """Measure the seconds of the second rendering, which is warm, of random Gaussians by torch on the GPU."""
    draw = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=draw) * 4 - torch.tensor([2.0, 2.0, -3.0])
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    parts = means, quats, torch.full((count, 3), 0.02), torch.full((count,), 0.5)
    gaussians = Gaussians(*(part.to("cuda") for part in parts))
    lens = torch.tensor([[900.0, 0.0, size[0] / 2], [0.0, 900.0, size[1] / 2], [0.0, 0.0, 1.0]])
    camera, seconds = Camera(torch.eye(4), lens, *size), 0.0
    for _ in range(2):
        start = perf_counter()
        rasterize(gaussians, camera, torch.ones(count, 3, device="cuda"), backend="torch")
        synchronize()
        seconds = perf_counter() - start
    return seconds
