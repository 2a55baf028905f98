"""Presets: YAML settings shipped in configs/."""

from __future__ import annotations

import re
from collections.abc import Container
from pathlib import Path
from typing import Any

from lang3dxl_ns.common.errors import UserError, readable

_PACKAGE = Path(__file__).parents[1]
# Configs are inside the package in an installed wheel, and beside it in a checkout.
FOLDER = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"


def load_preset(name: str) -> dict[str, Any]:
    """Load the settings in configs/`name`.yaml, for example "holyscenes/milano". Raises UserError for an
    unknown name (listing the known ones) and for a damaged file."""
    known = sorted(path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml"))
    if name not in known:
        raise UserError(f"there is no preset {name!r}: choose one of {', '.join(known)}")
    import yaml

    with readable(f"{FOLDER / name}.yaml can't be read", "restore it", (yaml.YAMLError, ValueError)):
        settings = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    if not isinstance(settings, dict):
        raise UserError(f"{FOLDER / name}.yaml should hold settings, not {settings!r}: restore it")
    return settings


OFFICIAL = "official"
"""Preset for what the authors' release does differently from the paper."""


def scene_presets() -> list[str]:
    """List the names of the presets that describe a scene."""
    return sorted(f"holyscenes/{path.stem}" for path in FOLDER.glob("holyscenes/*.yaml"))


def train_flags(name: str, known: Container[str] | None = None) -> list[str]:
    """Return flags of a scene's crop range and schedule, or of what the authors' release does differently:
    those of `ns-train lang3dxl-paper` or, with the settings that it has (`known`), of `lang3dxl train`.
    Raises UserError for another name, and if that lacks a setting."""
    choices = [OFFICIAL, *scene_presets()]
    if name not in choices:
        raise UserError(f"{name!r} is not a preset for training: choose one of {', '.join(choices)}")
    settings = load_preset(name)
    scale = {"pipeline.datamanager.scale-preset": name} if "scale_range" in settings else {}
    flags = scale | settings["train"]
    if known is not None:
        shorter = (re.sub(r"^pipeline\.(model|datamanager)\.", "", flag) for flag in flags)
        names = ["steps" if flag == "max-num-iterations" else flag for flag in shorter]
        if missing := [flag for flag in names if flag.replace("-", "_") not in known]:
            raise UserError(
                f"lang3dxl train has no {', '.join(missing)}, which {name} sets: train with "
                "ns-train lang3dxl-paper, whose flags are printed by default"
            )
        flags = {"method": "lang3dxl-paper", **dict(zip(names, flags.values(), strict=True))}
    return [word for flag, value in flags.items() for word in (f"--{flag}", str(value))]
