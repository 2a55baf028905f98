"""Writes a scene as a static web page, with prompts answered beforehand."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from numpy import ndarray as Array

from lang3dxl_ns.common.files import make_folder, slugs, write_atomically
from lang3dxl_ns.query.heat_maps import color
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.query.splat_file import write_splats
from lang3dxl_ns.query.text import Prompt
from lang3dxl_ns.scene.camera import Camera

_HERE = Path(__file__).parent
_FILES = ("index.html", "page.js", "splats.js", "LICENSES.txt")


def write_page(
    scene: Scene,
    folder: Path,
    texts: Sequence[str | Prompt],
    title: str = "",
    credit: str = "",
    look: str | None = None,
) -> int:
    """Write index.html and what it needs into `folder`, for any static web server; returns the bytes.

    Args:
        texts: prompts that get a button each, as `Scene.prompts` reads them.
        title: heading (default: the photos' folder).
        credit: line about the photos and their licence.
        look: training photo whose light is shown.

    Raises UserError if a text is no prompt.
    """
    make_folder(folder)
    prompts = scene.prompts(texts) if texts else []
    # View-dependent colors are drawn as from the overview, since heat replaces colors.
    baked = scene.baked(look)
    baked = baked.with_colors(baked.colors(scene.overview.camera.position))
    splats, sound = "scene.spz" if find_spec("gsply") is not None else "scene.ply", baked.sound()
    write_splats(folder / splats, baked)
    middle = np.median(baked.means.cpu().numpy(), axis=0)
    words = []
    names = slugs([prompt.text for prompt in prompts])
    for found, name in zip(scene.find(prompts) if prompts else [], names, strict=True):
        relevancy = found.relevancy[sound.cpu().numpy()]
        heat = (relevancy * 255).round().astype(np.uint8)
        write_atomically(folder / f"heat-{name}.bin", heat.tobytes())
        view = (found.views or found.closest)[0]
        center = middle if found.box is None else np.array(found.box.center)
        words.append(
            {
                "text": found.prompt.text,
                "heat": f"heat-{name}.bin",
                "threshold": found.threshold,
                "highest": float(relevancy.max(initial=0)),
                "view": _view(scene.file.photo(view.name).full_camera, center),
            }
        )
    start = _view(scene.overview.full_camera, middle)
    up = np.mean([photo.pose[:3, 1] for photo in scene.photos], axis=0)
    description = {
        "title": title or Path(scene.file.data).name,
        "credit": credit,
        "splats": splats,
        "up": (up / max(float(np.linalg.norm(up)), 1e-9)).tolist(),
        "near": 1e-3 * start["distance"],
        "far": 1e3 * start["distance"],
        "start": start,
        "words": words,
        "colors": color(torch.linspace(0, 1, 256)).tolist(),
    }
    write_atomically(folder / "scene.json", json.dumps(description))
    for file in _FILES:
        shutil.copyfile(_HERE / file, folder / file)
    return sum(path.stat().st_size for path in folder.iterdir() if path.is_file())


def _view(camera: Camera, center: Float64[Array, "3"]) -> dict[str, Any]:
    """A photo's viewpoint for the page: pose, fields of view (radians), and distance of the orbit center."""
    pose, k = camera.pose, camera.intrinsics.double().cpu().numpy()
    high = 2 * math.atan(max(k[1, 2], camera.height - k[1, 2]) / k[1, 1])
    wide = 2 * math.atan(max(k[0, 2], camera.width - k[0, 2]) / k[0, 0])
    ahead = float((center - pose[:3, 3]) @ -pose[:3, 2])
    return {"pose": pose.tolist(), "high": high, "wide": wide, "distance": max(ahead, 0.05)}
