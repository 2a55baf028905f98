"""Programs of the laboratory, which lies beside the package in a checkout."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

from lang3dxl_ns.common.errors import UserError

LAB = Path(__file__).parents[2] / "lab"


def lab_module(name: str) -> ModuleType:
    """Import a module of the laboratory, such as `lab.landmark.scene_writer`. Raises UserError where the
    package is installed without it."""
    if not (LAB / "README.md").is_file():
        raise UserError(
            "this command comes with a checkout of the repository, not with the package: clone it, "
            "and install the clone with pip install -e"
        )
    return import_module(name)
