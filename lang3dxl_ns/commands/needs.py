"""`lang3dxl needs`: the optional components that a scene needs."""

from __future__ import annotations

import contextlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path

from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.preparation.settings import PreparationConfig


@showing("data", "json", "clip")
@dataclass(kw_only=True)
class Needs(PreparationConfig):
    """Measure a scene's needs without training: which optional components will be built, and why.

    `ns-train lang3dxl` measures the same, and applies it to every component left at "auto".
    """

    data: Path
    """Folder with images/ and sparse/0/."""
    json: bool = False
    """Print JSON instead of a table."""

    def main(self) -> None:
        from lang3dxl_ns.commands.prepare import open_datamanager
        from lang3dxl_ns.preparation.needs import as_data, needs_table

        # Keep nerfstudio's start-up output out of the answer.
        with contextlib.redirect_stdout(sys.stderr):
            needs = open_datamanager(self, self.data, None).needs
        print(json.dumps(as_data(needs), indent=2) if self.json else needs_table(needs))
