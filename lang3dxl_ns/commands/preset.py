"""`lang3dxl preset`: flags that train a benchmark scene as published."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Annotated

import tyro

from lang3dxl_ns.common.presets import scene_presets, train_flags


@dataclass
class Preset:
    """Print the flags that train a benchmark scene as published, for use as

    ns-train lang3dxl --data FOLDER $(lang3dxl preset holyscenes/milano)
    """

    name: Annotated[str, tyro.conf.Positional] = ""
    """Such as holyscenes/milano; without a name, lists them all."""

    def main(self) -> None:
        if not self.name:
            print("\n".join(scene_presets()))
            return
        print(shlex.join(train_flags(self.name)))
