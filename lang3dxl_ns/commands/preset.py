"""`lang3dxl preset`: flags that train as in the paper for a benchmark, or as the authors' release."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from lang3dxl_ns.commands.train import Train
from lang3dxl_ns.common.presets import OFFICIAL, scene_presets, train_flags
from lang3dxl_ns.common.settings_help import showing


@showing("name", "command")
@dataclass
class Preset:
    """Print flags that train a benchmark's scene as in the paper, for use as

    `ns-train lang3dxl-paper --data FOLDER $(lang3dxl preset holyscenes/milano)`
    `lang3dxl train FOLDER $(lang3dxl preset holyscenes/milano --command train)`

    `official` prints flags for what the authors' release does differently. The flags of both can be combined.
    """

    name: Annotated[str, tyro.conf.Positional] = ""
    """Name of the preset, such as holyscenes/milano, or official. Without a name, all are listed."""
    command: Literal["ns-train", "train"] = "ns-train"
    """Command that the flags are for: ns-train lang3dxl-paper, or lang3dxl train."""

    def main(self) -> None:
        if not self.name:
            print("\n".join([OFFICIAL, *scene_presets()]))
            return
        known = {setting.name for setting in fields(Train)} if self.command == "train" else None
        print(shlex.join(train_flags(self.name, known)))
