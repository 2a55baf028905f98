"""Scoring of relevancy maps made by any program, with the code that scores runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array
from torch import Tensor

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import expanded, read_array, slugs
from lang3dxl_ns.common.pictures import PHOTO_SUFFIXES, mask_values
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.evaluation.layouts import PICTURES, check_shape, read_gray
from lang3dxl_ns.evaluation.scores import Maps, MapScorer, resize_map, strongest_level
from lang3dxl_ns.scene.masks import MaskFolder

_LARGEST = 1e30
"""Largest score taken as finite. The squares of larger ones overflow float32."""


def score_predictions(
    truth: GroundTruth,
    maps: Path,
    photos: Sequence[str] | None = None,
    masks: Path | None = None,
    temperature: float = 1.0,
) -> tuple[dict[str, dict[str, float]], dict[str, Any]]:
    """Score every labeled photo; return the figures by photo name, and the scoring protocol.

    Args:
        truth: the labels.
        maps: folder of `<prompt>/<photo>.npy` (float, [h, w], or LangSplat's [levels, h, w]) or pictures
            (black 0, white 1), of any size with the photo's aspect ratio. Prompts and photos are named as in
            the ground truth, or as `lang3dxl query` names its files.
        photos: names of the photos (or labels) to score; by default all with a label.
        masks: folder of foreground masks, white = keep; predictions become 0 elsewhere.
        temperature: temperature that the maps were made with (see `MapScorer.variants`).

    Raises:
        UserError: a map is missing, damaged or of another aspect ratio.
    """
    maps = expanded(maps)
    if not maps.is_dir():
        raise UserError(f"{maps} is not a folder: pass the one that holds <prompt>/<photo>.npy")
    scorer, folders = MapScorer(truth), dict(zip(truth.categories, slugs(truth.categories), strict=True))
    keys = truth.labeled if photos is None else list(dict.fromkeys(_key(truth, photo) for photo in photos))
    files = {} if masks is None else _mask_files(expanded(masks), keys)
    figures: dict[str, dict[str, float]] = {}
    for key in tracked(keys, "scoring"):
        size = truth.scoring_size(*truth.size(key))
        truths = truth.truths(key, size)
        found: Maps = {c: _read_map(maps, (c, folders[c]), key, size) for c in truths}
        keep = None
        if files:
            keep = torch.from_numpy(np.asarray(read_gray(files[key], "mask", mask_values)) >= 128)
            check_shape(files[key], (keep.shape[0], keep.shape[1]), size)
        figures[key] = scorer.scores(key, scorer.variants(found, keep, temperature), truths)
    statement = f"predictions are 0 outside the masks of {len(files)} of {len(keys)} photos, {masks}"
    protocol = {"maps": str(maps), "evaluated_photos": len(keys)} | scorer.protocol(
        statement if files else "none beyond those in the maps", of="labels'"
    )
    return figures, protocol


def _read_map(
    maps: Path, folders: tuple[str, str], photo: str, size: tuple[int, int]
) -> Float[Tensor, "h w"]:
    """Read a prompt's map at `size`, from the first of the prompt's folders that holds one for the photo."""
    names = dict.fromkeys((photo, photo.replace("/", "_")))
    suffixes = (".npy", *PICTURES, ".JPG", ".JPEG", ".PNG")
    paths = [maps / folder / f"{name}{suffix}" for folder in folders for name in names for suffix in suffixes]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        raise UserError(
            f"there is no map of {folders[0]!r} for the photo {photo}: make {paths[0]} (or a picture), or "
            f"name the photos to score with --photos"
        )
    score = _read_array(path) if path.suffix == ".npy" else np.asarray(read_gray(path, "map")) / 255
    if score.ndim == 3:
        score = strongest_level(score)
    check_shape(path, (score.shape[0], score.shape[1]), size)
    return resize_map(torch.from_numpy(score.astype(np.float32))[None], size)[0]


def _read_array(path: Path) -> Float[Array, "*levels h w"]:
    with readable(f"map {path} can't be read", "write it with numpy.save"):
        score = read_array(path)
    if score.ndim not in (2, 3) or 0 in score.shape:
        raise UserError(f"map {path} has shape {score.shape}, not [h, w] or [levels, h, w]")
    if score.dtype.kind not in "fiub":
        raise UserError(f"map {path} holds {score.dtype}, not numbers")
    score = score.astype(np.float64)
    if not (np.abs(score) < _LARGEST).all():
        raise UserError(f"map {path} holds NaN or infinity: fix the program that made it")
    return score


def _key(truth: GroundTruth, photo: str) -> str:
    key = truth.key(photo)
    if key is None:
        raise UserError(f"the photo {photo} has no label in {truth.folder}: correct the list of photos")
    return key


def _mask_files(folder: Path, keys: Sequence[str]) -> dict[str, Path]:
    """Find the masks of labels, whose names lack the photos' suffixes. Raises UserError for a missing one."""
    masks, files = MaskFolder(folder), dict[str, Path]()
    for key in keys:
        found = filter(None, (masks.find(f"{key}{suffix}") for suffix in (*PHOTO_SUFFIXES, "")))
        if (path := next(found, None)) is None:
            raise UserError(f"{folder} holds no mask of the photo {key}: add it, white = keep")
        files[key] = path
    return files
