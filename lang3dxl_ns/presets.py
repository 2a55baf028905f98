"""Settings that ship with the package: the YAML files under configs/."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml

from lang3dxl_ns.errors import UserError

_PACKAGE = Path(__file__).parent
# An installed wheel has them inside the package, a checkout beside it.
FOLDER = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"


def load_preset(name: str) -> dict[str, Any]:
    """The settings of configs/`name`.yaml, for example "holyscenes/milano".

    Raises UserError for a name that does not exist, with those that do, and for a damaged file.
    """
    known = sorted(path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml"))
    if name not in known:
        raise UserError(f"there is no preset {name!r}: choose one of {', '.join(known)}")
    try:
        settings = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise UserError(f"{FOLDER / name}.yaml can't be read ({error}): restore it") from error
    if not isinstance(settings, dict):
        raise UserError(f"{FOLDER / name}.yaml holds no settings, but {settings!r}: restore it")
    return settings


def train_flags(name: str) -> list[str]:
    """Flags of `ns-train lang3dxl` that train a scene as published: crop range, iterations, schedule.

    Raises UserError for a preset that isn't a scene's.
    """
    settings = load_preset(name)
    if "train" not in settings:
        raise UserError(f"{name} is no preset of a scene: choose another, such as holyscenes/milano")
    flags = {"pipeline.datamanager.scale-preset": name} | settings["train"]
    return [word for flag, value in flags.items() for word in (f"--{flag}", str(value))]


@dataclass
class Preset:
    """Print the flags that train a benchmark's scene as published, to be used as

    ns-train lang3dxl --data FOLDER $(lang3dxl preset holyscenes/milano)
    """

    name: Annotated[str, tyro.conf.Positional]
    """Such as holyscenes/milano."""

    def main(self) -> None:
        print(shlex.join(train_flags(self.name)))
