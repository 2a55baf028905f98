"""Test views of a landmark in a run: placed, prepared and scored like its photos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from lab.landmark.novel_views import NovelViews, read_novel_views
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.photo_metrics import EvaluatedPhoto
from lang3dxl_ns.evaluation.score_run import score_photos
from lang3dxl_ns.evaluation.scores import open_scorer
from lang3dxl_ns.preparation.physical_scale import pixel_sizes
from lang3dxl_ns.scene.capture import Capture, Split
from lang3dxl_ns.scene.colmap import TrackedPhoto
from lang3dxl_ns.scene.masks import MaskFolder
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.training.batches import TrainingData
from lang3dxl_ns.training.state import Training

_COLORS_OF_LIGHT = ("psnr", "ssim", "lpips")
"""Image metrics that are meaningless for views whose lighting differs from the photos'."""


def evaluate_novel_views(run: Training, data: TrainingData) -> Iterator[EvaluatedPhoto]:
    """Render and score the test views of a run's scene, with targets made with the photos' crop sizes. Raises
    UserError if the scene has none."""
    folder, scorer = data.capture.folder, None
    views = read_novel_views(folder)
    if views is None:
        raise UserError(f"{folder} has no test views: `lang3dxl demo-scene` makes scenes with them")
    novel = novel_data(data, views)
    if run.parts.semantics is not None:
        scorer = open_scorer(views.truth, data.config.clip, run.device)
    for photo in score_photos(run, novel, novel.capture.split.held_out, scorer):
        for name in () if views.same_light else _COLORS_OF_LIGHT:
            photo.metrics.pop(name, None)
        yield photo


def novel_data(data: TrainingData, views: NovelViews) -> TrainingData:
    """Return the test views as held-out photos, with the frame and the crop sizes of the run's own."""

    def photo(view: TrackedPhoto) -> Photo:
        picture = views.image(view)
        mask = MaskFolder(views.folder / "masks").find(picture.name) if masked else None
        return Photo.from_model(view, picture, mask)

    masked = data.config.foreground != "none"
    config = replace(data.config, foreground="auto" if masked else "none", regions="none")
    if not data.targets_in_steps:
        config.dense = "none"
    own, cameras = data.capture, {view.name: view for view in views.cameras}
    capture = Capture(
        own.folder,
        [photo(view) for view in views.cameras],
        replace(own.reconstruction, photos=cameras),
        known_split=Split((), tuple(cameras)),
        known_frame=own.recorded_frame,
    )
    novel = TrainingData(capture, config, data.cache_dir, data.device, True, data.scale)
    sizes = novel_pixel_sizes(data, views, novel.as_read)
    novel.crops = replace(data.crops, pixel_sizes=sizes, reasons=[])
    return novel


def novel_pixel_sizes(data: TrainingData, views: NovelViews, photos: list[Photo]) -> dict[str, float] | None:
    """Return the world units per pixel of the test views' photos, by the same rules as for all others; None
    if crops are relative."""
    if data.crops.pixel_sizes is None:
        return None
    cameras = {view.name: view for view in views.cameras}
    # These are per pixel of the views' files.
    seen = replace(data.capture.reconstruction, photos=cameras)
    sizes, _ = pixel_sizes(seen, data.config.pixel_distance, data.config.pixel_angle)
    return {photo.name: sizes[photo.name] * cameras[photo.name].width / photo.width for photo in photos}
