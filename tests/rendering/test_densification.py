"""gsplat's densification strategy on our rasterizer's outputs."""

import pytest
import torch
from gsplat.strategy import DefaultStrategy
from splat_clouds import make_cloud

from lang3dxl_ns.rendering import Gaussians, rasterize


@pytest.mark.usefixtures("backend")
def test_the_default_strategy_refines_on_any_device():
    torch.manual_seed(0)
    cloud = make_cloud(200, 48, 36, size=0.1)
    leaves = cloud.leaves(torch.float32)
    parameters = torch.nn.ParameterDict(
        {
            "means": leaves["means"].detach(),
            "quats": leaves["quats"].detach(),
            "scales": leaves["scales"].detach().log(),
            "opacities": leaves["opacities"].detach().logit(),
            "channels": leaves["channels"].detach(),
        }
    )
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in parameters.items()}
    strategy = DefaultStrategy(refine_start_iter=2, refine_every=3, reset_every=100, grow_grad2d=2e-4)
    strategy.check_sanity(parameters, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    counts = []
    for step in range(1, 10):
        gaussians = Gaussians(
            parameters["means"], parameters["quats"], parameters["scales"].exp(),
            parameters["opacities"].sigmoid(),
        )  # fmt: skip
        rendering = rasterize(gaussians, cloud.camera(leaves), parameters["channels"])
        strategy.step_pre_backward(parameters, optimizers, state, step, rendering.info)
        (rendering.image - 0.5).square().mean().backward()
        strategy.step_post_backward(parameters, optimizers, state, step, rendering.info)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        counts.append(len(parameters["means"]))
    assert counts[0] == counts[1] == 200
    assert counts[2] != 200
    assert counts[5] != counts[2]
