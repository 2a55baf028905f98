"""`lang3dxl info`: contents of a scene file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.errors import UserError


@dataclass(kw_only=True)
class Info:
    """Print what a scene file holds and where it comes from."""

    scene: tyro.conf.Positional[Path | None] = None
    """A .scene file, or a folder that holds one (default: the newest run under outputs/)."""

    def main(self) -> None:
        from lang3dxl_ns.open_scene import find_scene_file
        from lang3dxl_ns.query.scene_file import describe_scene_file

        file = find_scene_file(self.scene)
        if file is None:
            raise UserError(
                "the run has no scene file: `lang3dxl export RUN --scene-file NAME.scene` writes one"
            )
        told = describe_scene_file(file)
        origin = told["provenance"]
        decoder, count = told["decoder"], told["gaussians"]
        words = "none: colors alone" if decoder is None else f"CLIP {told['clip']}, decoder {decoder['name']}"
        lines = {
            "title": origin.title,
            "credit": origin.credit,
            "license": origin.license,
            "made by": origin.made_by,
            "made how": origin.made_how,
            "Gaussians": f"{count:,}",
            "photos": f"{told['photos']}{', each with its lighting' if told['looks'] else ''}",
            "words": words,
            "size": f"{told['bytes'] / 1e6:.2f} MB, {told['bytes'] / max(count, 1):.0f} bytes a Gaussian",
        }
        say(*(f"{name:10} {value}" for name, value in lines.items() if value))
