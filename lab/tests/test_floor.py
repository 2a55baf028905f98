"""Laws of the least time that a step could take: it grows with the work."""

import pytest
import torch

from lab.benchmarks.dense_rasterizer import count_pairs
from lab.benchmarks.floor import Speed, Work, measure_speed, step_work
from lab.benchmarks.rasterizer_scenes import Case, make_problem
from lang3dxl_ns.rendering import rasterize


def test_time_at_full_speed_is_of_what_takes_longer():
    speed = Speed(flops=100.0, bandwidth=10.0)
    assert Work(flops=200, bytes=5).seconds(speed) == 2
    assert Work(flops=200, bytes=50).seconds(speed) == 5


def test_a_pair_counts_where_a_gaussian_shows():
    """Each Gaussian alone, in a channel of its own: the pixels in which its channel is above zero."""
    problem = make_problem(Case("B", 40, 30, 22), None, dtype=torch.float64)
    channels = torch.eye(40, dtype=torch.float64)
    shown = rasterize(problem.gaussians, problem.camera, channels, torch.zeros_like(channels[0])).image
    assert count_pairs(problem.gaussians, problem.camera)[0] == int((shown > 0).sum())


def test_the_floor_of_a_step_grows_with_channels_parameters_and_the_image():
    speed, small = Speed(1e9, 1e9), make_problem(Case("B", 400, 50, 37), None)
    large = make_problem(Case("B", 400, 100, 74), None)

    def floor(problem, channels=3, parameters=10_000):
        work = step_work(problem.gaussians, problem.camera, channels, parameters)
        return {part: of.seconds(speed) for part, of in work.items()}

    base = floor(small)
    assert floor(small, channels=6)["backward"] > base["backward"]
    assert floor(small, parameters=20_000)["optimizer"] == pytest.approx(2 * base["optimizer"])
    assert floor(large)["losses"] == pytest.approx(4 * base["losses"])


def test_a_machine_has_a_speed():
    speed = measure_speed(side=64, values=2**12)
    assert speed.flops > 0
    assert speed.bandwidth > 0
