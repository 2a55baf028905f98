"""`load_scene`: a scene from a scene file, or from the folder of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from lang3dxl_ns.common.console import silence_libraries
from lang3dxl_ns.common.device import known_device
from lang3dxl_ns.common.errors import NO_NERFSTUDIO, UserError, misses_nerfstudio
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.files.runs import find_run, scenes_in
from lang3dxl_ns.files.scene_file import SUFFIX, Provenance, describe_scene_file, read_scene
from lang3dxl_ns.query.question import QueryConfig
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.text import text_encoder


def load_scene(
    path: str | Path | None = None,
    device: torch.device | str | None = None,
    *,
    settings: QueryConfig | None = None,
    clip: str | None = None,
) -> Scene:
    """Open a scene for rendering and queries.

    Args:
        path: a NAME.scene file, or the folder of a run or of a scene file, or one above it, whose newest run
            is opened. None opens the newest run under outputs/. Runs without a scene file, and any
            config.yml, are converted, which needs nerfstudio. No code from the files is executed.
        device: where the scene is held; by default a GPU if there is one.
        settings: default settings of queries.
        clip: name or folder of the scene's CLIP, if it is not where the scene file says.

    Raises:
        UserError: there is no scene, it is damaged, or `clip` is not the scene's CLIP.
    """
    if (file := find_scene_file(path)) is not None:
        encode_texts = None
        if clip is not None:
            about = replace(describe_scene_file(file)["scene"], clip=clip)
            encode_texts = text_encoder(about, known_device(device))
        return read_scene(file, device, settings, encode_texts)
    silence_libraries()  # nerfstudio's imports print warnings that a user can do nothing about
    try:
        from lang3dxl_ns.plugin.load_scene import load_run
    except ModuleNotFoundError as error:
        if not misses_nerfstudio(error):
            raise
        raise UserError(NO_NERFSTUDIO) from error
    return load_run(path, device, settings, clip)


def find_scene_file(path: str | Path | None = None) -> Path | None:
    """Find the scene file that a path names or holds. Returns None for a config.yml, and for a run without
    one. Raises UserError if there is neither a scene nor a run."""
    if path is not None and expanded(path).suffix == SUFFIX:  # reading it says why it can't be opened
        return expanded(path)
    place = find_run(path)
    if place.is_file():
        return None if place.suffix == ".yml" else place
    scenes = scenes_in(place)
    if len(scenes) > 1:
        names = ", ".join(file.name for file in scenes[:5])
        raise UserError(f"{place} holds several scenes ({names}): name one of them")
    return scenes[-1] if scenes else None


def existing_scene_file(path: str | Path | None = None) -> Path:
    """Find the scene file that a path names or holds. Raises UserError if there is none."""
    if (file := find_scene_file(path)) is None:
        raise UserError("this run has no scene file: write one with lang3dxl export --scene-file NAME.scene")
    return file


def provenance_of(path: str | Path | None = None) -> Provenance:
    """Read title, credit and license of the scene that `load_scene` opens; empty for a run without a file."""
    file = find_scene_file(path)
    return Provenance() if file is None else describe_scene_file(file)["provenance"]
