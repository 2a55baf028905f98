"""Settings that ship with the package: the YAML files under configs/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
