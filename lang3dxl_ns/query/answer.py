"""Answers of a scene to questions: matches in views, places in the scene, and words for a pixel."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from statistics import median_high

import torch
from jaxtyping import Float
from torch import Tensor

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.query.answering import Answering
from lang3dxl_ns.query.match import Found, Match
from lang3dxl_ns.query.negatives import CLEAR, NOTHING
from lang3dxl_ns.query.question import Question
from lang3dxl_ns.query.relevancy import Queries
from lang3dxl_ns.query.rendered_scene import Place
from lang3dxl_ns.query.view_ranking import Viewpoint, rank_views, strongest_match
from lang3dxl_ns.rendering import composite
from lang3dxl_ns.rendering.gathering import filled_pixels
from lang3dxl_ns.scene.camera import Camera, resized


def matches(scene: Answering, question: Question, place: Place, size: int | None = None) -> list[Match]:
    """Find matches of a question's prompts in one view; see `Scene.query`.

    Relevancies are composited with at most as many pixels as the training photos have, and enlarged for a
    larger view: nothing was learned between these pixels, and Gaussians too thin for them would stand out
    as lines.
    """
    start = time.perf_counter()
    channels = question.channels
    asked = time.perf_counter()
    camera = scene.camera(place, size)
    sides = [max(photo.camera.width, photo.camera.height) for photo in scene.photos if photo.split == "train"]
    small = resized(camera, median_high(sides)) if sides else camera
    enlarged = small.width < camera.width
    view = scene.view(place, camera, channels=None if enlarged else channels)
    rendered, rendering = time.perf_counter(), view.rendering
    if enlarged:
        rendering = replace(rendering, channels=composite(scene.splats, small, channels))
    foreground = None if view.name is None else scene.file.photo(view.name).foreground()
    maps, masks = question.maps(rendering, foreground)
    found = maps.cpu().float().numpy(), masks.cpu().numpy()
    seconds = asked - start + time.perf_counter() - rendered
    rows = zip(question.prompts, question.doubts, question.trusts, *found, question.thresholds, strict=True)
    return [
        Match(prompt, scene.synonyms(prompt), doubt, trust, view, relevancy, mask, level, seconds)
        for prompt, doubt, trust, relevancy, mask, level in rows
    ]


def locate(scene: Answering, question: Question, most: int = 10) -> list[Found]:
    """Find matches of a question's prompts in the scene, with at most `most` views each."""
    found = []
    for row, prompt in enumerate(question.prompts):
        scores, threshold = question.relevancy[row], question.thresholds[row]
        views, box = [view for view in ranked_views(scene, question, row) if view.shown][:most], None
        if views:
            box = strongest_match(scene.splats.means, scores, scene.mass, threshold, scene.gap)
        relevancy, matching = scores.cpu().float().numpy(), question.gaussians[row].cpu().numpy()
        doubt, trust = question.doubts[row], question.trusts[row]
        found.append(Found(prompt, views, box, relevancy, matching, doubt, trust, threshold))
    return found


def ranked_views(scene: Answering, question: Question, row: int) -> list[Viewpoint]:
    """Return all training views, those that show the prompt of this row first, best first."""
    ranks = rank_views(scene.visible, scene.splats.means, question.relevancy[row], question.thresholds[row])
    return [replace(view, camera=scene.file.photo(view.name).camera) for view in ranks]


def best_views(scene: Answering, question: Question) -> list[str]:
    """Return for each prompt the name of the training photo whose view shows it best, or comes closest.
    Raises UserError if the scene has no training photos."""
    check_views(scene)
    return [ranked_views(scene, question, row)[0].name for row in range(len(question.prompts))]


def check_views(scene: Answering) -> None:
    """Raise UserError if the scene has no training photos."""
    if not scene.visible:
        raise UserError("this scene has no training photos to choose from: name a photo or a camera")


@torch.no_grad()
def relevancy_maps(scene: Answering, camera: Camera, queries: Queries) -> Float[Tensor, "q h w"]:
    """Compute every pixel's relevancy to every query, 0…1, as it is scored, without a foreground."""
    rendering = scene.draw(camera, scene.engine.channels(queries))
    assert rendering.channels is not None
    return scene.engine.maps(rendering.channels, queries)


def words_at(
    scene: Answering, camera: Camera, x: float, y: float, words: Sequence[str], most: int
) -> list[tuple[str, float]]:
    """Find the words that match a camera's pixel best, with their relevancy; see `Scene.what_is`."""
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise UserError(f"{x}, {y} lies outside the view of {camera.width} × {camera.height} pixels")
    pixel = torch.zeros(camera.height, camera.width, device=scene.device)
    pixel[int(y), int(x)] = 1.0
    share = filled_pixels(partial(composite, scene.splats, camera), pixel, len(scene.splats))
    rows = share.nonzero().squeeze(1)
    features = scene.engine.features(rows)
    if not words or float(share[rows] @ (features != 0).any(1).float()) < scene.config.min_alpha:
        return []
    queries, negatives = scene.text.plain_queries(words).to(scene.device), scene.text.config.negatives
    cosines = queries.cosines(share[rows] @ features)
    scores = queries.relevancy_of_cosines(cosines, scene.engine.temperature).tolist()
    named = sorted(zip(words, scores, strict=True), key=lambda pair: pair[1], reverse=True)
    clear = any(score > CLEAR for word, score in named if word != "sky")
    if not clear and negatives[int(cosines[: len(negatives)].argmax())] in NOTHING:
        return []
    return named[: max(most, 0)]
