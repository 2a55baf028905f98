"""Finding a run: a folder, a config.yml, or the newest run under outputs/."""

from __future__ import annotations

from pathlib import Path

from lang3dxl_ns.common.errors import UserError

OUTPUTS = Path("outputs")
"""Where `ns-train` puts runs."""
_DEEPEST = 4
"""Folders between the one given and a run's: SCENE/METHOD/TIME in outputs/."""


def find_config(run: str | Path | None = None) -> Path:
    """The config.yml of a run.

    run: the file, the run's folder, or a folder above it, whose newest run is taken; None: the newest under
    outputs/. Raises UserError if there is none.
    """
    place = OUTPUTS if run is None else Path(run).expanduser()
    if place.is_dir():
        configs = [path for depth in range(_DEEPEST + 1) for path in place.glob("*/" * depth + "config.yml")]
        if place.joinpath("config.yml") in configs:
            return place / "config.yml"
        if configs:
            return max(configs, key=lambda path: path.stat().st_mtime)
        raise UserError(
            f"{place} holds no run: name the folder of one, or train with ns-train lang3dxl --data FOLDER"
        )
    if run is None:
        raise UserError(
            "there is no outputs/ here: name a run's folder, or train with ns-train lang3dxl --data FOLDER"
        )
    if not place.is_file():
        raise UserError(f"{place} is not a file or folder: pass a run's folder, or its config.yml")
    return place
