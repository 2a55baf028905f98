"""Splats to write and read back, and how alike two are.

from made_splats import assert_alike, some_splats
"""

import torch
import torch.nn.functional as F

from lang3dxl_ns.files.activations import log_scales, logits
from lang3dxl_ns.rendering import Splats


def some_splats(count: int = 300, bands: int = 4) -> Splats:
    g = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(count, *shape, generator=g)

    quats = F.normalize(rand(4) - 0.5, dim=1)
    return Splats(rand(3) * 4 - 2, quats, 0.02 + rand(3), 0.05 + 0.9 * rand(), rand(bands, 3) - 0.5)


def assert_alike(
    found: Splats, wanted: Splats, means=1e-6, scales=1e-5, opacities=1e-5, colors=1e-6, turn=1e-6
):
    assert len(found) == len(wanted)
    torch.testing.assert_close(found.means, wanted.means, atol=means, rtol=0)
    torch.testing.assert_close(found.scales.log(), wanted.scales.log(), atol=scales, rtol=0)
    torch.testing.assert_close(found.opacities, wanted.opacities, atol=opacities, rtol=0)
    torch.testing.assert_close(found.harmonics, wanted.harmonics, atol=colors, rtol=0)
    # q and −q are the same rotation.
    cosine = (F.normalize(found.quats, dim=1) * F.normalize(wanted.quats, dim=1)).sum(1).abs()
    assert float(cosine.min()) > 1 - turn


def gsplat_state(splats: Splats) -> dict:
    parts = {"means": splats.means, "scales": log_scales(splats), "quats": splats.quats}
    parts |= {"opacities": logits(splats), "sh0": splats.harmonics[:, :1], "shN": splats.harmonics[:, 1:]}
    return {"step": 29_999, "splats": parts}
