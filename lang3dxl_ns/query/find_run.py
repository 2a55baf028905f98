"""Search for a run: a folder, a config.yml, or the newest run under outputs/."""

from __future__ import annotations

from pathlib import Path

from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.query.run_file import SCENE_FILE

OUTPUTS = Path("outputs")
"""Folder in which `ns-train` creates runs."""
_DEEPEST = 4
"""Deepest level of a run's folder below the given one; outputs/ holds SCENE/METHOD/TIME."""


def find_config(run: str | Path | None = None) -> Path:
    """Find the config.yml of a run.

    run: the file, the run's folder, or a folder above it, whose newest run is taken; None: the newest run
    under outputs/. Runs of other methods, which lack a scene description, are skipped. Raises UserError if
    there is no run.
    """
    place = OUTPUTS if run is None else expanded(run)
    if place.is_dir():
        if place.joinpath("config.yml").is_file():
            return place / "config.yml"
        found = (path for n in range(1, _DEEPEST + 1) for path in place.glob("*/" * n + "config.yml"))
        configs = [path for path in found if path.is_file()]
        ours = [path for path in configs if path.with_name(SCENE_FILE).is_file()]
        if ours:
            return max(ours, key=lambda path: path.stat().st_mtime)
        others = f" of this method ({len(configs)} of others)" if configs else ""
        raise UserError(
            f"{place} holds no run{others}: name the folder of one, or train with ns-train lang3dxl --data "
            "FOLDER"
        )
    if run is None:
        raise UserError(
            "there is no outputs/ here: name a run's folder, or train with ns-train lang3dxl --data FOLDER"
        )
    if not place.is_file():
        raise UserError(f"{place} is not a file or folder: pass a run's folder, or its config.yml")
    return place
