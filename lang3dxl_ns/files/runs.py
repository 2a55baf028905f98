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
"""Folder in which training creates runs."""
_REMEDY = "name a scene file, a run's folder or its config.yml, or train one with lang3dxl train FOLDER"
_DEEPEST = 4
"""Deepest level of a run's folder below the given one; outputs/ holds NAME, or SCENE/METHOD/TIME."""
_SCENES = "[!.]*.scene"


def find_run(run: str | Path | None = None) -> Path:
    """Find a run: the file that is named, or else a folder with a config.yml or a scene file. That is the
    named one, or the newest run below it, which is said; None: the newest under outputs/. Runs of other
    methods, which lack a scene description, are skipped. Raises UserError if there is no run."""
    place = OUTPUTS if run is None else expanded(run)
    if place.is_file() or _config(place).is_file() or scenes_in(place):
        return place
    if not place.is_dir():
        what = "there is no outputs/ here" if run is None else f"{place} is not a file or folder"
        raise UserError(f"{what}: {_REMEDY}")
    below = ["[!.]*/" * n for n in range(1, _DEEPEST + 1)]
    configs = [path.parent for level in below for path in place.glob(f"{level}config.yml") if path.is_file()]
    ours = {folder for folder in configs if (folder / SCENE_FILE).is_file()}
    ours |= {path.parent for level in below for path in place.glob(level + _SCENES) if path.is_file()}
    if not ours:
        others = f" of this method ({len(configs)} of others)" if configs else ""
        raise UserError(f"{place} holds no run{others}: {_REMEDY}")
    newest = max(ours, key=_began)
    if len(ours) > 1:
        say_once(f"Opening {newest}, the newest of {len(ours)} runs in {place}")
    return newest


def find_config(run: str | Path | None = None) -> Path:
    """Find the config.yml of a run of ns-train; `run` and errors are those of `find_run`."""
    found = find_run(run)
    if not found.is_file() and not _config(found).is_file():
        raise UserError(f"{found} is no run of ns-train: name the folder of one, or its config.yml")
    return found if found.is_file() else _config(found)


def scenes_in(folder: Path) -> list[Path]:
    """List the scene files in a folder. Some systems leave a hidden file beside each (._castle.scene)."""
    return sorted(path for path in folder.glob(_SCENES) if path.is_file())


def say_what_to_do(run: str | Path, has_words: bool) -> None:
    """Say the commands that show a finished run and ask it. run: its folder. has_words: whether it was
    trained with a CLIP."""
    place = shlex.quote(str(run))
    say(f"Walk through it: lang3dxl view {place}")
    if has_words:
        say(f"Ask it:          lang3dxl query {place} --text windows --out found")


def _config(folder: Path) -> Path:
    return folder / "config.yml"


def _began(folder: Path) -> float:
    """Return when a run began: by its folder's name, or else by the time of its first file, which a copy
    changes."""
    with suppress(ValueError):
        return datetime.strptime(folder.name, "%Y-%m-%d_%H%M%S").timestamp()
    written = _config(folder), folder / SCENE_FILE, *scenes_in(folder)
    return next(path.stat().st_mtime for path in written if path.is_file())
