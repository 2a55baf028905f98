"""Test views of a landmark in a run: placed, prepared and scored like its photos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from lab.landmark.novel_views import NovelViews, read_novel_views
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto
from lang3dxl_ns.evaluation.scores import open_scorer
from lang3dxl_ns.plugin.cameras import to_nerfstudio
from lang3dxl_ns.plugin.photo_dataset import PhotoDataset
from lang3dxl_ns.preparation.physical_scale import pixel_sizes
from lang3dxl_ns.preparation.prepare import prepare
from lang3dxl_ns.preparation.store import FeatureStore
from lang3dxl_ns.scene.camera import camera_to_world
from lang3dxl_ns.scene.colmap import TrackedPhoto
from lang3dxl_ns.scene.masks import find_mask
from lang3dxl_ns.scene.photo import Photo

if TYPE_CHECKING:
    from lang3dxl_ns.plugin.datamanager import Lang3DXLDataManager
    from lang3dxl_ns.plugin.pipeline import Lang3DXLPipeline

_COLORS_OF_LIGHT = ("psnr", "ssim", "lpips")
"""Image metrics that are meaningless for views whose lighting differs from the photos'."""


def evaluate_novel_views(pipeline: Lang3DXLPipeline) -> Iterator[EvaluatedPhoto]:
    """Render and score the test views of a run's scene, with targets made with the photos' crop sizes. Raises
    UserError if the scene has none."""
    data, model = pipeline.datamanager, pipeline.model
    views = read_novel_views(data.data_folder)
    if views is None:
        raise UserError(f"{data.data_folder} has no test views: `lang3dxl demo-scene` makes scenes with them")
    dataset, config, scorer = novel_dataset(data, views), data.config, None
    if data.targets is not None:
        config = config if config.targets_in_steps else replace(config, dense="none")
        sizes, store = novel_pixel_sizes(data, views, dataset.photos), FeatureStore(data.cache_dir)
        views_of = prepare(dataset.photos, sizes, config, data.crop_plan.scales, store, data.device)
        data.targets = data.targets.joined(views_of)
    if model.semantic_field is not None:
        scorer = open_scorer(views.truth, config.clip, model.device)
    for photo in pipeline.evaluation.evaluate_photos(data.evaluated(dataset), scorer):
        for name in () if views.same_light else _COLORS_OF_LIGHT:
            photo.metrics.pop(name, None)
        yield photo


def novel_dataset(data: Lang3DXLDataManager, views: NovelViews) -> PhotoDataset:
    """Return the test views as photos, whose cameras have the transform and scale of the run's own."""

    def photo(view: TrackedPhoto) -> Photo:
        picture = views.image(view)
        return Photo.from_model(
            view, picture, find_mask(views.folder / "masks", picture.name) if masked else None
        )

    masked, trained = data.config.foreground != "none", data.train_dataparser_outputs
    photos = [photo(view) for view in views.cameras]
    transform, scale = trained.dataparser_transform.double(), trained.dataparser_scale
    poses = [_pose(torch.from_numpy(g.camera_from_world), transform, scale) for g in views.cameras]
    cameras = to_nerfstudio([photo.lens for photo in photos], torch.stack(poses).float())
    files, metadata = [photo.path for photo in photos], {"photos": photos}
    return data.dataset_of(
        replace(trained, image_filenames=files, mask_filenames=None, cameras=cameras, metadata=metadata)
    )


def _pose(
    camera_from_world: Float[Tensor, "3 4"], transform: Float[Tensor, "3 4"], scale: float
) -> Float[Tensor, "3 4"]:
    """Convert to camera → world in the run's frame, x ↦ scale · transform(x), with nerfstudio's axes."""
    bottom = camera_from_world.new_tensor([[0.0, 0.0, 0.0, 1.0]])
    pose = camera_to_world(torch.cat([camera_from_world, bottom]))
    position = transform[:, :3] @ pose[:, 3:] + transform[:, 3:]
    return torch.cat([transform[:, :3] @ pose[:, :3], scale * position], dim=1)


def novel_pixel_sizes(
    data: Lang3DXLDataManager, views: NovelViews, photos: list[Photo]
) -> dict[str, float] | None:
    """Return the world units per pixel of the test views' photos, by the same rules as for all others; None
    if crops are relative."""
    if data.crop_plan.pixel_sizes is None:
        return None
    cameras = {view.name: view for view in views.cameras}
    # These are per pixel of the views' files.
    seen = replace(data.reconstruction, photos=cameras)
    sizes, _ = pixel_sizes(seen, data.config.pixel_distance, data.config.pixel_angle)
    return {photo.name: sizes[photo.name] * cameras[photo.name].width / photo.width for photo in photos}
