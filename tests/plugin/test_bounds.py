"""Where Gaussians may be in training, how long, and in which colors."""

import numpy as np
import pytest
import torch
from runs import make_trainer

from lang3dxl_ns.files.read_splats import read_splats
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.rendering import Gaussians, rasterize, spherical_harmonics
from lang3dxl_ns.scene.camera import Lens
from lang3dxl_ns.training.gaussians import FREE, LONGEST, NEEDLE, keep_in_bounds

SKY = 40
"""Few, so that they are large."""


@pytest.fixture
def planted(scene, tiny_clip, tiny_dense, tmp_path):
    """Trains with the last three Gaussians spoiled: one at a camera, a needle, one glaring."""

    def train(**changes):
        changes = {"pipeline__model__sky_gaussians": SKY, "pipeline__model__appearance__use": "off"} | changes
        trainer = make_trainer(scene, tiny_clip, tiny_dense, tmp_path, 20, False, **changes)
        trainer.setup()
        model, g = trainer.pipeline.model, trainer.pipeline.model.gauss_params
        with torch.no_grad():
            pose = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[3]
            g["means"][-1] = pose[:, 3] - 0.5 * FREE * model.run.extent[1] * pose[:, 2]
            g["scales"][-1] = -9.0
            g["scales"][-2, 0] = np.log(40 * model.run.extent[1])
            g["opacities"][-3:] = 4.0
            if model.config.sh_degree:
                g["features_dc"][-3], g["features_rest"][-3] = 9.0, 9.0
        sky = g["scales"][:SKY].detach().clone()
        trainer.train()
        return trainer, sky

    return train


def distances(trainer) -> torch.Tensor:
    cameras = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[..., 3]
    return torch.cdist(trainer.pipeline.model.means.detach(), cameras).amin(1)


def test_pruning_clears_the_space_at_the_cameras_and_keeps_the_sky(planted):
    trainer, sky = planted()
    model = trainer.pipeline.model
    assert distances(trainer).min() > FREE * model.run.extent[1]
    assert torch.equal(model.gauss_params["scales"][:SKY], sky)


def test_no_needle_stays_and_the_sky_keeps_its_size(planted):
    trainer, sky = planted(pipeline__model__densify_until=0.0)
    model = trainer.pipeline.model
    center, radius = model.run.extent
    _, wide, longest = model.scales.detach().exp().sort(dim=1).values.unbind(1)
    away = (model.means.detach() - center).norm(dim=1).clamp_min(radius)
    bound = (2 * wide).maximum(NEEDLE * away).minimum(LONGEST * away)
    assert (longest[SKY:] <= 1.001 * bound[SKY:]).all()
    assert longest[-2] <= NEEDLE * away[-2]
    assert torch.equal(model.gauss_params["scales"][:SKY], sky)


def test_needles_and_giants_are_shortened_sheets_and_the_sky_are_not():
    sizes = torch.tensor([[50.0, 50, 50], [0.6, 0.01, 0.4], [0.6, 0.01, 0.1], [9, 8, 7], [0.01, 0.01, 1]])
    means = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [20, 0, 0]])
    g = torch.nn.ParameterDict({"means": means, "scales": sizes.log()})
    keep_in_bounds(g, torch.zeros(3), 2.0, 1, 0)
    expected = sizes.clone()
    expected[2, 0], expected[3] = 0.5, 2.0
    torch.testing.assert_close(g["scales"].exp(), expected)


def test_exported_colors_are_near_0_to_1_from_everywhere(planted, tmp_path):
    trainer, _ = planted(pipeline__model__densify_until=0.0, pipeline__model__view_dependence="on")
    write_splats(tmp_path / "scene.ply", trainer.pipeline.model.run.splats())
    splats = read_splats(tmp_path / "scene.ply")
    assert splats.sound().all()
    directions = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    for direction in directions:
        every = direction.expand(len(splats), 3)
        colors = spherical_harmonics(splats.degree, every, splats.harmonics) + 0.5
        assert colors.min() > -0.6 and colors.max() < 1.6


def test_a_scene_without_points_is_bounded_too(planted):
    trainer, _ = planted(pipeline__model__random_init=True, pipeline__model__num_random=300)
    assert distances(trainer).min() > FREE * trainer.pipeline.model.run.extent[1]


def test_one_beside_the_camera_does_not_cover_the_picture():
    """The camera stands with its back to a wall, of which one Gaussian is a little in front of it."""
    camera = Lens(32, 24, 30.0, 33.0, 16.0, 12.0).camera(torch.eye(4))
    means = torch.tensor([[0.04, 0.0, 0.03], [0.0, 0.0, 2.0]])
    scales = torch.tensor([[0.025] * 3, [0.4] * 3])
    gaussians = Gaussians(means, torch.tensor([[1.0, 0, 0, 0]] * 2), scales, torch.tensor([0.9, 0.8]))
    colors = torch.eye(3)[:2]
    swamped, seen = (
        rasterize(shown, camera, colors).image for shown in (gaussians, gaussians.seen_from(camera))
    )
    alone = rasterize(Gaussians(*(part[1:] for part in vars(gaussians).values())), camera, colors[1:]).image
    assert swamped[..., 0].mean() > 0.3
    torch.testing.assert_close(seen, alone)


def test_only_what_is_small_for_its_depth_shows():
    camera = Lens(32, 24, 30.0, 33.0, 16.0, 12.0).camera(torch.eye(4))
    depths = torch.tensor([-1.0, 0.0, 1.4, 2.0, 2.5, 3.1, 100.0])
    means = torch.stack([torch.zeros(7), torch.zeros(7), depths], dim=1)
    opacities = torch.full((7,), 0.6, requires_grad=True)
    sizes = torch.tensor([0.1, 1.0, 0.5]).expand(7, 3)
    seen = Gaussians(means, torch.ones(7, 4), sizes, opacities).seen_from(camera)
    expected = 0.6 * torch.tensor([0, 0, 0, 1 / 3, 2 / 3, 1, 1])
    torch.testing.assert_close(seen.opacities, expected)
