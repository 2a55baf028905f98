"""Scores of answers as a user gets them, by the scene's own thresholds: masks, selected Gaussians, boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.label_limit import Masks, lifted_labels
from lang3dxl_ns.evaluation.score_scene import truths_of
from lang3dxl_ns.evaluation.scores import overlap
from lang3dxl_ns.query.places import Box, groups
from lang3dxl_ns.query.run_file import ScenePhoto
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.scene.camera import Camera

_LEAST_SHARE = 0.03
"""Share of a word's labels below which a group is not a separate object."""


def score_selections(scene: Scene, truth: GroundTruth, photos: Sequence[ScenePhoto]) -> dict[str, float]:
    """Compute figures of every category that the labels show, 0…1.

    - `mask_iou_{category}`: IoU of the mask of `Scene.matches` with the label, mean over photos.
    - `selection_iou_{category}`: IoU of the matching Gaussians with the labeled ones. A Gaussian is labeled
      if the labels mark most of its pixels in the labeled photos. Gaussians are weighted by the pixels that
      they fill.
    - `box_iou_{category}`: IoU of the box of `Scene.find` with the labeled object's box that it matches best.
    """
    question = scene.ask([Prompt(category) for category in truth.categories])
    labels: list[tuple[Camera, Masks]] = []
    ious: dict[str, list[float]] = {category: [] for category in truth.categories}
    for photo in photos:
        camera = photo.camera
        truths = truths_of(truth, photo.photo(), (camera.height, camera.width))
        labels.append((camera, {category: found.mask for category, found in truths.items()}))
        matches = scene.matches(question, photo.name, max(camera.height, camera.width))
        for category, match in zip(truth.categories, matches, strict=True):
            if category in truths and truths[category].mask.any():
                ious[category].append(overlap(match.mask, truths[category].mask)["iou"])
    shares = lifted_labels(scene.splats, labels, truth.categories, scene.backend)
    figures: dict[str, float] = {}
    for category, found, share in zip(truth.categories, scene.places(question), shares.T, strict=True):
        marked, mass = share > 0.5, scene.mass
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
    low, high = np.maximum(a.low, b.low), np.minimum(a.high, b.high)
    both = float(np.prod((high - low).clip(0)))
    whole = sum(float(np.prod(np.subtract(box.high, box.low))) for box in (a, b)) - both
    return both / whole if whole > 0 else 0.0
