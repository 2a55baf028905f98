"""Scores of a scene file against ground truth, without its run, targets or photos.

Its maps are scored as those of runs, and its answers as a user gets them, by the scene's own thresholds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.label_limit import Masks, lifted_labels
from lang3dxl_ns.evaluation.layouts import Truth
from lang3dxl_ns.evaluation.scores import LanguageScorer, map_size, overlap
from lang3dxl_ns.query.answer import locate, relevancy_maps
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.query.view_ranking import Box, groups, shared_volume
from lang3dxl_ns.scene.camera import Camera
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.record import ScenePhoto
from lang3dxl_ns.words.taught_words import known_word

SceneSplit = Literal["held-out", "seen", "all"]
_LEAST_SHARE = 0.03
"""Share of a word's labels below which a group is not a separate object."""


def score_scene(
    scene: Scene, truth: GroundTruth, split: SceneSplit = "all"
) -> tuple[dict[str, dict[str, float]], dict[str, Any]]:
    """Render the labeled views of a split and score the words in them, as `ns-eval` does. Return the figures
    of each photo (`ap_{category}` etc., see `evaluation.aggregate`), and the protocol that explains them.
    Raises UserError for a scene of colors only, and if no photo of the split has a label."""
    truth.check([photo.name for photo in scene.photos])
    photos = labeled_photos(scene, truth, split)
    scorer = LanguageScorer(truth, scene.text.vectors)
    words = [scene.words.get(known_word(category)) for category in truth.categories]
    queries_shown = scorer.queries.taught(words)
    figures: dict[str, dict[str, float]] = {}
    for photo in tracked(photos, "evaluating"):
        width, height = photo.read_size
        size, keep = truth.scoring_size(height, width), photo.foreground()
        keep = None if keep is None else keep.to(scene.device)
        raw, published = (
            scorer.named(relevancy_maps(scene, photo.camera, queries.to(scene.device)), size)
            for queries in (queries_shown, scorer.published_queries)
        )
        variants = scorer.variants(raw, keep, scene.engine.temperature, published)
        truths = truths_of(truth, photo.photo(), map_size(raw))
        figures[photo.name] = scorer.scores(photo.name, variants, truths)
    masked = sum(photo.mask is not None for photo in photos)
    mask = f"predictions are 0 outside the foreground masks of {masked} of {len(photos)} photos"
    protocol = {
        "split": split,
        "evaluated_photos": len(photos),
        "taught_words": [word.name for word in words if word is not None],
        "photos_that_taught": sorted(
            figures.keys() & {e.photo for word in words if word for e in word.examples}
        ),
        **scorer.protocol(mask if masked else "none"),
    }
    return figures, protocol


def labeled_photos(scene: Scene, truth: GroundTruth, split: SceneSplit) -> list[ScenePhoto]:
    """List the photos of a split that have labels. Raises UserError if there are none."""
    trained = [p for p in scene.photos if p.split == "train" and split != "held-out"]
    held_out = [p for p in scene.photos if p.held_out and split != "seen"]
    photos = [p for p in (*trained, *held_out) if truth.key(p.name) is not None]
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


def score_selections(scene: Scene, truth: GroundTruth, photos: Sequence[ScenePhoto]) -> dict[str, float]:
    """Compute figures of every category that the labels show, 0…1.

    - `mask_iou_{category}`: IoU of the mask of `Scene.matches` with the label, mean over photos.
    - `selection_iou_{category}`: IoU of the matching Gaussians with the labeled ones. A Gaussian is labeled
      if the labels mark most of its pixels in the labeled photos, and a training view shows it. Gaussians
      are weighted by the pixels that they fill.
    - `box_iou_{category}`: IoU of the box of `Scene.find` with the labeled object's box that it matches best.
    """
    question = scene.ask([Prompt(category) for category in truth.categories])
    labels: list[tuple[Camera, Masks]] = []
    ious: dict[str, list[float]] = {category: [] for category in truth.categories}
    for photo in photos:
        camera = scene.camera(photo.name, max(photo.camera.height, photo.camera.width))
        truths = truths_of(truth, photo.photo(), (camera.height, camera.width))
        labels.append((camera, {category: found.mask for category, found in truths.items()}))
        matches = scene.matches(question, photo.name, max(camera.height, camera.width))
        for category, match in zip(truth.categories, matches, strict=True):
            if category in truths and truths[category].mask.any():
                ious[category].append(overlap(match.mask, truths[category].mask)["iou"])
    shares = lifted_labels(scene.splats, labels, truth.categories)
    figures: dict[str, float] = {}
    for category, found, share in zip(truth.categories, locate(scene, question), shares.T, strict=True):
        mass = scene.mass
        marked = (share > 0.5) & (mass > 0)
        if not ious[category] or not marked.any():
            continue
        chosen = torch.from_numpy(found.gaussians).to(marked.device)
        figures[f"mask_iou_{category}"] = float(np.mean(ious[category]))
        both, either = mass[chosen & marked].sum(), mass[chosen | marked].sum()
        figures[f"selection_iou_{category}"] = float(both / either)
        things = groups(scene.splats.means[marked], mass[marked], scene.gap)
        fits = [box_iou(found.box, box) for box in things if box.share >= _LEAST_SHARE] if found.box else []
        figures[f"box_iou_{category}"] = max(fits, default=0.0)
    return figures


def box_iou(a: Box, b: Box) -> float:
    """Compute intersection over union of two boxes' volumes; 0 if both are flat."""
    both = shared_volume(a, b)
    whole = shared_volume(a, a) + shared_volume(b, b) - both
    return both / whole if whole > 0 else 0.0
