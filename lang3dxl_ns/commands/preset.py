"""`lang3dxl preset`: flags of `ns-train lang3dxl-paper` for a benchmark, or as the authors' release."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Annotated

import tyro

from lang3dxl_ns.common.presets import OFFICIAL, scene_presets, train_flags


@dataclass
class Preset:
    """Print flags that train a benchmark's scene as in the paper, for use as

    ns-train lang3dxl-paper --data FOLDER $(lang3dxl preset holyscenes/milano)

    `official`: flags for what the authors' release does otherwise; both can be given.
    """

    name: Annotated[str, tyro.conf.Positional] = ""
    """Such as holyscenes/milano, or official; without a name, lists them all."""

    def main(self) -> None:
        if not self.name:
            print("\n".join([OFFICIAL, *scene_presets()]))
            return
        print(shlex.join(train_flags(self.name)))
