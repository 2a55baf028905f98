"""The torch rasterizer computes in float32 alone, as Apple's GPUs (mps) need."""

import pytest
import torch
from splat_clouds import make_cloud, maps
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lang3dxl_ns.rendering import rasterize

CAMERA = 16
"""Numbers of a view matrix, which is multiplied in float64 on the CPU."""


class NoDoubles(TorchDispatchMode):
    """Refuses float64 results that are larger than a camera, as a device without float64 would."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor) and tensor.dtype == torch.float64 and tensor.numel() > CAMERA:
                raise TypeError(f"{func}: Cannot convert a MPS Tensor to float64")
        return out


def test_nothing_but_the_camera_is_in_float64():
    cloud = make_cloud(100, 24, 16)
    leaves = cloud.leaves(torch.float32)
    with NoDoubles():
        rendering = cloud.render(rasterize, leaves, backend="torch", antialiased=True)
        sum(value.square().mean() for value in maps(rendering).values()).backward()
    assert all(leaf.grad is None or torch.isfinite(leaf.grad).all() for leaf in leaves.values())
    assert leaves["means"].grad.abs().max() > 0


def test_the_guard_refuses_float64():
    cloud = make_cloud(100, 24, 16)
    leaves = cloud.leaves(torch.float64)
    with NoDoubles(), pytest.raises(TypeError, match="MPS"):
        cloud.render(rasterize, leaves, backend="torch")
