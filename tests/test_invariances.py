"""Invariance of renderings, relevancy and crops to the world's frame, photo order and threads."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numerics.physical_scale import in_world
from scenes import write_scene

from lab.numerics.rasterizer import Scene
from lang3dxl_ns.components.field_settings import SemanticFieldConfig
from lang3dxl_ns.components.semantic_field import SemanticField
from lang3dxl_ns.plugin.dataparser import PhotoCollectionDataParserConfig
from lang3dxl_ns.preparation.physical_scale import (
    crop_sides,
    physical_scales,
    pixel_sizes,
    propose_scale_range,
)
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.rendering import Gaussians, rasterize
from lang3dxl_ns.scene.camera import Camera, view_matrix
from lang3dxl_ns.scene.colmap import read_reconstruction

WORLDS = [(1.0, 0.0), (1e3, 0.0), (1e-3, 0.0), (1.0, 1e5), (1e3, 1e5), (1e-3, 1e5)]


def render(scene: Scene, dtype: torch.dtype) -> torch.Tensor:
    leaves = {name: value.to(dtype) for name, value in scene.leaves.items()}
    (fx, fy), (cx, cy) = scene.focal, scene.center
    intrinsics = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=dtype)
    return rasterize(
        Gaussians(leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["logits"].sigmoid()),
        Camera(scene.leaves["view_matrix"], intrinsics, scene.width, scene.height),
        leaves["channels"],
        near=scene.near,
    ).image


@pytest.mark.parametrize(("scale", "offset"), WORLDS)
def test_the_image_is_the_same_in_every_world(scale, offset):
    # In units of the scene an offset of 1e5 leaves float64 about eleven digits, in a world of 1e-3 eight.
    expected = render(Scene(), torch.float64)
    found = render(Scene().in_world(scale, offset), torch.float64)
    assert float((found - expected).abs().max()) < 1e-13 * max(1, offset / scale)


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_the_image_is_the_same_at_every_scale_in_single_precision(scale):
    found, expected = (render(scene, torch.float32) for scene in (Scene().in_world(scale), Scene()))
    assert float((found - expected).abs().max()) < 1e-5


def relevancies(scene: Scene, dtype: torch.dtype) -> torch.Tensor:
    """Relevancy of the rendered channels, used as codes, to two prompts."""
    generator = torch.Generator().manual_seed(0)
    field = SemanticField(SemanticFieldConfig(preset="short"), 32, generator=generator).to(dtype)
    with torch.no_grad():
        field.grid.table.mul_(300)  # as large as after training
        features = field.decode_clip(10 * render(scene, dtype) - 5)
    texts, canonical = torch.randn(6, 32, generator=generator).to(dtype).split([2, 4])
    prompts = Queries.of(texts[:, None].unbind(), canonical)
    return prompts.relevancy_of_cosines(prompts.cosines(features))


@pytest.mark.parametrize(("scale", "offset"), WORLDS)
def test_relevancy_is_the_same_in_every_world(scale, offset):
    found, expected = (relevancies(s, torch.float64) for s in (Scene().in_world(scale, offset), Scene()))
    assert float(expected.std()) > 0.05
    # A code moves ten times as far as a color, the field's slope and the temperature ten times each.
    assert float((found - expected).abs().max()) < 1e-10 * max(1, offset / scale)


def test_relevancy_is_the_same_at_another_scale_in_single_precision():
    found, expected = (relevancies(s, torch.float32) for s in (Scene().in_world(1e3), Scene()))
    assert float((found - expected).abs().max()) < 1e-2
    assert float((found - expected).abs().mean()) < 1e-5


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory):
    folder = write_scene(tmp_path_factory.mktemp("invariance"), photos=6, mixed=True)
    return read_reconstruction(folder / "sparse" / "0")


@pytest.mark.parametrize(("scale", "offset"), WORLDS)
def test_the_crops_are_the_same_in_every_world_with_the_range_scaled_along(reconstruction, scale, offset):
    photos = {name: in_world(photo, scale, offset) for name, photo in reconstruction.photos.items()}
    origin = in_world(_point_photo(reconstruction), scale, offset).points
    moved = type(reconstruction)(photos, origin, reconstruction.colors)
    before, after = pixel_sizes(reconstruction)[0], pixel_sizes(moved)[0]
    for name, photo in photos.items():
        # Meters from cameras that are 1e5 · 4.6 away: ten digits, in a world of 1e-3 seven.
        assert after[name] == pytest.approx(scale * before[name], rel=1e-14 * max(1e2, 1e2 * offset / scale))
        crops = [
            crop_sides(physical_scales(0.2 * unit, 2.0 * unit), sizes[name], photo.width)
            for unit, sizes in ((1.0, before), (scale, after))
        ]
        assert crops[0] == crops[1]
    first, second = propose_scale_range(reconstruction, before), propose_scale_range(moved, after)
    assert second.smallest == pytest.approx(scale * first.smallest, rel=1e-5)
    # The building's size is measured around a per-axis median, which turns only nearly with the world.
    assert second.largest == pytest.approx(scale * first.largest, rel=0.05)


def _point_photo(reconstruction):
    """A photo that tracks all points."""
    return replace(next(iter(reconstruction.photos.values())), points=reconstruction.points)


@pytest.mark.parametrize("offset", [1e5, 1e6])
def test_map_coordinates_reach_the_scene_without_loss(tmp_path, offset):
    """Cameras and seed points of a model far from the origin show the same pixels as those of one at it."""
    folder = write_scene(tmp_path, photos=6, points=100)
    near = parse(folder)
    far = parse(folder, offset * np.array([0.48, 4.6, 0.1]))
    assert max(float(points.abs().max()) for _, points, _ in (near, far)) < 100
    pixels = [
        [project(cameras, i, points) for i in range(len(cameras.width))] for cameras, points, _ in (near, far)
    ]
    for first, second in zip(*pixels, strict=True):
        assert float((first - second).abs().max()) < 1e-3
    # And the transform that is saved still takes the model's own coordinates to the scene's.
    _, points, outputs = far
    original = outputs.metadata["original_points"]
    again = torch.from_numpy(outputs.frame.points(original.numpy()))
    assert float((again - points).abs().max()) < 1e-6


def parse(folder, offset=None):
    """Cameras and seed points as the trainer gets them, of the model or of a copy moved by an offset."""
    parser = PhotoCollectionDataParserConfig(data=folder, load_3D_points=True).setup()
    if offset is not None:
        model = parser.capture.reconstruction
        photos = {
            name: replace(
                photo,
                points=photo.points + offset,
                camera_from_world=np.column_stack(
                    [
                        photo.camera_from_world[:, :3],
                        photo.camera_from_world[:, 3] - photo.camera_from_world[:, :3] @ offset,
                    ]
                ),
            )
            for name, photo in model.photos.items()
        }
        moved = replace(model, photos=photos, points=model.points + offset)
        parser.capture = replace(parser.capture, reconstruction=moved)
    outputs = parser.get_dataparser_outputs(split="train")
    outputs.metadata["original_points"] = torch.from_numpy(parser.capture.reconstruction.points)
    return outputs.cameras, outputs.metadata["points3D_xyz"], outputs


def project(cameras, index: int, points: torch.Tensor) -> torch.Tensor:
    view = view_matrix(cameras.camera_to_worlds[index])
    camera = points @ view[:3, :3].T + view[:3, 3]
    focal = torch.stack([cameras.fx[index, 0], cameras.fy[index, 0]])
    return focal * camera[:, :2] / camera[:, 2:]


def test_the_order_of_photos_in_the_model_does_not_matter(train, tmp_path):
    runs = []
    for name, shuffled in (("listed", False), ("shuffled", True)):
        folder = write_scene(tmp_path / name, photos=6, points=100, mixed=True, shuffled=shuffled)
        runs.append(train(folder, iterations=6))
    first, second = (dict(run.pipeline.model.named_parameters()) for run in runs)
    for name in first:
        # Features are summed over the photos in the model's order, and codes fitted to these sums.
        if name != "gauss_params.codes" and not name.startswith("semantic_field."):
            assert torch.equal(first[name], second[name]), name


def test_the_number_of_threads_changes_only_rounding(train, scene):
    trainer = train(scene, iterations=8, steps_per_eval_image=0)
    model, datamanager = trainer.pipeline.model.train(), trainer.pipeline.datamanager
    camera, batch = datamanager.next_train(0)
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 4):
            torch.set_num_threads(count)
            model.zero_grad()
            losses = model.get_loss_dict(model.get_outputs(camera), batch)
            sum(losses.values()).backward()
            gradients = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
            found.append((losses, gradients))
    finally:
        torch.set_num_threads(threads)
    (losses, gradients), (other_losses, other_gradients) = found
    for name, loss in losses.items():
        assert loss.item() == pytest.approx(other_losses[name].item(), rel=1e-5), name
    for name, gradient in gradients.items():
        # At least 1e-9: the downsampler's last bias shifts all logits alike, its gradient is rounding alone.
        bound = 1e-9 + 1e-4 * float(gradient.norm())
        assert float((gradient - other_gradients[name]).norm()) <= bound, name
