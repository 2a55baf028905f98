"""The least time a training step could take on a machine: arithmetic and memory traffic at full speed."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from lab.benchmarks.dense_rasterizer import count_pairs
from lab.benchmarks.interleaved import interleaved_times
from lang3dxl_ns.rendering import Camera, Gaussians

_FLOAT = 4  # bytes
# Operations per pair of pixel and Gaussian that contributes. Forward: offset 2, exponent 8, exponential 10,
# weight and transmittance 4, and 2 per channel. Backward: all of that again, then 4 per channel and 30 for
# opacity, conic and center.
_PAIR, _PAIR_BACKWARD = 24, 54
_PROJECTION = 400  # operations per Gaussian: rotation, covariance, its projection, inverse; backward twice
_SSIM = 5 * 2 * 11 * 2 + 20  # operations per value of the image: five maps filtered along two axes by 11 taps


@dataclass(frozen=True)
class Speed:
    """What a machine reaches with the present number of threads."""

    flops: float
    """Operations per second in a matrix product of float32."""
    bandwidth: float
    """Bytes per second read and written in a copy that exceeds the caches."""


@dataclass(frozen=True)
class Work:
    """Operations, and bytes that must be read or written once."""

    flops: float
    bytes: float

    def seconds(self, speed: Speed) -> float:
        """Time at full speed, where arithmetic and traffic overlap entirely."""
        return max(self.flops / speed.flops, self.bytes / speed.bandwidth)


def measure_speed(side: int = 1024, values: int = 2**25) -> Speed:
    """The best of ten products of side × side matrices, and of ten copies of an array."""
    a, b = torch.randn(2, side, side)
    source, target = torch.ones(2, values)
    work = {"product": lambda: a @ b, "copy": lambda: target.copy_(source)}
    seconds = {name: min(times) for name, times in interleaved_times(work, repeats=10).items()}
    return Speed(2 * side**3 / seconds["product"], 2 * _FLOAT * values / seconds["copy"])


def step_work(gaussians: Gaussians, camera: Camera, channels: int, parameters: int) -> dict[str, Work]:
    """Least work of a step's parts, for one view in `channels` channels; `parameters` are optimized by Adam.

    Networks that learn looks or semantics are not counted, so the floor is below what a step needs.
    """
    count, pixels = len(gaussians.means), camera.width * camera.height
    pairs, _ = count_pairs(gaussians.detach(), camera.detach())
    image = _FLOAT * pixels * (channels + 1)
    scene = _FLOAT * parameters
    photo = _FLOAT * pixels * 3
    render = pairs * (_PAIR + 2 * channels) + count * _PROJECTION
    backward = pairs * (_PAIR_BACKWARD + 6 * channels) + count * 2 * _PROJECTION
    loss = pixels * 3 * _SSIM
    return {
        "data": Work(0, photo + photo / _FLOAT),  # bytes in, floats out
        "render": Work(render, scene + image),
        "losses": Work(loss, 2 * photo),
        "backward": Work(backward + 2 * loss, 2 * scene + 2 * image + 2 * photo),
        "optimizer": Work(12 * parameters, 7 * scene),  # reads value, gradient, two moments; writes three
    }
