"""Words for splats of other programs: frames, views, and learning without a trainer."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from math import hypot, inf

import tyro

from lang3dxl_ns.common.checks import check_numbers
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.preparation.settings import PreparationConfig


@dataclass(kw_only=True)
class AttachConfig(PreparationConfig):
    """Settings of `attach`: those of its views and words, and of encoders, crops and foreground."""

    views: int = 48
    """Number of views of the splat to render and learn from, without photos."""
    up: str = "auto"
    """Direction of the splat that points up, without photos: x, -x, y, -y, z, -z, or numbers x,y,z (write
    --up=-y). With auto, it is found by walls, and by what CLIP sees in views of the splat."""
    segment: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """Word that the foreground model finds in the photos and teaches the scene. Repeat the flag for more."""

    def check(self) -> None:
        """Raise UserError if a setting is invalid."""
        super().check()
        check_numbers(self, {"views": (4, 1000)})
        if self.up != "auto":
            direction_of(self.up)
        if self.crops == "pyramid" or self.regions not in ("auto", "none"):
            raise UserError("attach learns from fine crops alone: leave --crops and --regions off")


def direction_of(name: str) -> tuple[float, ...]:
    """Return the unit direction that an axis (x, -x, y …) or three numbers "x,y,z" name. Raises UserError for
    other texts."""
    sign, letter = -1.0 if name.startswith("-") else 1.0, name.removeprefix("-")
    numbers = tuple(sign * (axis == letter) for axis in "xyz")
    with suppress(ValueError):
        numbers = numbers if any(numbers) else tuple(float(number) for number in name.split(","))
    length = hypot(*numbers)
    if len(numbers) != 3 or not 0 < length < inf:
        raise UserError(f"--up is {name}: give x, -x, y, -y, z, -z, or three numbers such as --up=0,-1,0.2")
    return tuple(number / length for number in numbers)
