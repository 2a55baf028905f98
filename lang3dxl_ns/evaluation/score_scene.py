"""Scores of a scene file: its words against ground truth, without its run, targets or photos."""

from __future__ import annotations

from typing import Any, Literal

import torch

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import progress_bar
from lang3dxl_ns.evaluation.annotations import Truth
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.language import LanguageScorer
from lang3dxl_ns.evaluation.scores import map_size
from lang3dxl_ns.query.run_file import ScenePhoto
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.teach import known_word
from lang3dxl_ns.scene.photo import Photo

SceneSplit = Literal["held-out", "seen", "all"]


def score_scene(
    scene: Scene, truth: GroundTruth, split: SceneSplit = "all"
) -> tuple[dict[str, dict[str, float]], dict[str, Any]]:
    """Render the labeled views of a split and score the words in them, as `ns-eval` does. Return the figures
    of each photo (`ap_{category}` etc., see `evaluation.aggregate`), and the protocol that explains them.
    Raises UserError for a scene of colors only, and if no photo of the split has a label."""
    photos = labeled_photos(scene, truth, split)
    scorer = LanguageScorer(truth, scene.text.vectors)
    words = [scene.words.get(known_word(category)) for category in truth.categories]
    queries_shown = scorer.queries.taught(words)
    figures: dict[str, dict[str, float]] = {}
    with progress_bar() as bar:
        for photo in bar.track(photos, description="evaluating"):
            width, height = photo.file_size
            size, keep = truth.scoring_size(height, width), photo.foreground()
            keep = None if keep is None else keep.to(scene.device)
            raw, published = (
                scorer.named(scene.relevancy_maps(photo.camera, queries.to(scene.device)), size)
                for queries in (queries_shown, scorer.published_queries)
            )
            of_published = None if scorer.smooths else published
            variants = scorer.variants(raw, keep, scene.engine.temperature, of_published)
            truths = truths_of(truth, photo.photo(), map_size(raw))
            figures[photo.name] = scorer.scores(photo.name, variants, truths)
    masked = sum(photo.mask is not None for photo in photos)
    mask = f"predictions are 0 outside the foreground masks of {masked} of {len(photos)} photos"
    protocol = {
        "split": split,
        "evaluated_photos": len(photos),
        "taught_words": [word.name for word in words if word is not None],
        **scorer.protocol(mask if masked else "none"),
    }
    return figures, protocol


def labeled_photos(scene: Scene, truth: GroundTruth, split: SceneSplit) -> list[ScenePhoto]:
    """List the photos of a split that have labels. Raises UserError if there are none."""
    wanted = {"held-out": ("eval",), "seen": ("train",), "all": ("train", "eval")}[split]
    photos = [p for p in scene.photos if p.split in wanted and truth.key(p.name) is not None]
    if not photos:
        raise UserError(f"no label in {truth.folder} belongs to a {split} photo of the scene")
    return photos


def truths_of(truth: GroundTruth, photo: Photo, size: tuple[int, int]) -> dict[str, Truth]:
    """Read the photo's labels and undistort them like the photo, because they were drawn on its file. Boxes
    do not match undistorted photos, so masks take their place."""
    truths = truth.truths(photo.name, size)
    if not photo.lens.distorts:
        return truths
    masks = {category: torch.from_numpy(found.mask).int() for category, found in truths.items()}
    return {category: Truth(photo.undistort_labels(mask).numpy() == 1) for category, mask in masks.items()}
