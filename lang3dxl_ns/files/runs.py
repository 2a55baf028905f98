"""Search for the folders of runs, and what can be done with one."""

from __future__ import annotations

import shlex
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from lang3dxl_ns.common.console import say, say_once
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.files import expanded
from lang3dxl_ns.scene.record import SCENE_FILE

OUTPUTS = Path("outputs")
"""Folder in which `ns-train` creates runs."""
_REMEDY = "name a run's folder or config.yml, or train one with lang3dxl train FOLDER"
_DEEPEST = 4
"""Deepest level of a run's folder below the given one; outputs/ holds SCENE/METHOD/TIME."""


def find_config(run: str | Path | None = None) -> Path:
    """Find the config.yml of a run: the file itself, or that in the run's folder, or in a folder above it,
    whose newest run is taken, which is said; None: the newest run under outputs/. Runs of other methods,
    which lack a scene description, are skipped. Raises UserError if there is no run."""
    place = OUTPUTS if run is None else expanded(run)
    if place.is_dir():
        if place.joinpath("config.yml").is_file():
            return place / "config.yml"
        found = (path for n in range(1, _DEEPEST + 1) for path in place.glob("*/" * n + "config.yml"))
        configs = [path for path in found if path.is_file()]
        ours = [path for path in configs if path.with_name(SCENE_FILE).is_file()]
        if ours:
            newest = max(ours, key=_began)
            if len(ours) > 1:
                say_once(f"Opening {newest.parent}, the newest of {len(ours)} runs in {place}")
            return newest
        others = f" of this method ({len(configs)} of others)" if configs else ""
        raise UserError(f"{place} holds no run{others}: {_REMEDY}")
    if not place.is_file():
        what = "there is no outputs/ here" if run is None else f"{place} is not a file or folder"
        raise UserError(f"{what}: {_REMEDY}")
    return place


def say_what_to_do(run: str | Path, has_words: bool) -> None:
    """Say the commands that show a finished run and ask it. run: its folder. has_words: whether it was
    trained with a CLIP."""
    place = shlex.quote(str(run))
    say(f"Walk through it: lang3dxl view {place}")
    if has_words:
        say(f"Ask it:          lang3dxl query {place} --text windows --out found")


def _began(config: Path) -> float:
    """Return when a run began: by its folder's name, or else by the file's time, which a copy changes."""
    with suppress(ValueError):
        return datetime.strptime(config.parent.name, "%Y-%m-%d_%H%M%S").timestamp()
    return config.stat().st_mtime
