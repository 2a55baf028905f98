"""How messages spell the options of the command that runs."""

from __future__ import annotations

import sys
from pathlib import Path

OWN_NAMES = {"appearance.use": "looks"}  # of settings that our own commands call otherwise


def data_option(name: str) -> str:
    """Spell an option of photos and their targets, such as `clip`: nerfstudio's commands have it at the
    setting's place in their configuration, our own by its name."""
    return f"{'--pipeline.datamanager.' if _in_nerfstudio() else '--'}{name}"


def capture_option(name: str) -> str:
    """Spell an option of where a capture's parts are, such as `masks-path`: nerfstudio's commands have it
    after a word of its own, at the end (see `data_option`)."""
    before = "lang3dxl-colmap"
    return f"{before} --{name}" if _in_nerfstudio() else f"--{name}"


def model_option(name: str) -> str:
    """Spell an option of the model, such as `max-gaussians` (see `data_option`)."""
    return f"--pipeline.model.{name}" if _in_nerfstudio() else f"--{OWN_NAMES.get(name, name)}"


def switched_on(option: str) -> str:
    """Spell an option, as `data_option` and `model_option` return it, that is switched on."""
    return f"{option} True" if _in_nerfstudio() else option


def _in_nerfstudio() -> bool:
    """Return whether one of nerfstudio's commands runs, by its name or as `python -m nerfstudio.…`."""
    command = Path(sys.argv[0] if sys.argv else "")
    return command.name.startswith("ns-") or "nerfstudio/scripts/" in command.as_posix()
