"""`lang3dxl train`: a scene from photos, without nerfstudio."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.scene.capture_settings import CaptureSettings
from lang3dxl_ns.training.scene_settings import (
    PRINTED_LOOKS,
    PRINTED_PHOTO_SCALE,
    Method,
    RunSettings,
    SceneSettings,
    plain_as_printed,
)

if TYPE_CHECKING:
    from lang3dxl_ns.training.fit import Settings


@showing(
    *("data", "out", "method", "steps", "restart", "clip", "quality", "foreground", "workers", "photo_scale"),
    "looks",
)
@without("total_steps")
@dataclass(kw_only=True)
class Train(RunSettings, SceneSettings, PreparationConfig, CaptureSettings):
    """Train a scene from photos: Gaussians with colors, and words for them.

    Photos without a COLMAP model or a transforms.json are reconstructed first. A run that was stopped, by
    Ctrl-C or otherwise, goes on with the same command. `lang3dxl view OUT` beside it shows the scene so far.
    """

    data: tyro.conf.Positional[Path]
    """Folder of photos, or a video."""
    out: Path | None = None
    """Folder of the run, in which NAME.scene is written (default: outputs/NAME)."""
    method: Method = "lang3dxl"
    """lang3dxl: words are learned after training. lang3dxl-paper: codes are trained with the scene, as
    printed."""
    steps: int | None = None
    """Iterations (default: 30,000 on a GPU, 70,000 with --method lang3dxl-paper, and 3,000
    without one)."""
    looks: Literal["auto", "on", "off"] = "auto"
    """Colors that depend on each photo's lighting. auto: where the photos differ in it."""
    photo_scale: float = 1.0
    """Size of the training photos relative to the files'."""
    restart: bool = False
    """Train anew, over the run in the folder."""

    def main(self) -> None:
        from lang3dxl_ns.files.runs import say_what_to_do
        from lang3dxl_ns.training.fit import run_folder

        settings = self.settings()
        folder, _ = run_folder(self.data, self.out, settings, self.restart)
        say_what_to_do(folder, settings.targets.clip != "none")

    @classmethod
    def usual(cls, words: Sequence[str], **changes: Any) -> Train:
        """Return the settings that a command line starts from, which are those of the method that it names.

        Args:
            words: words of the command line.
            changes: settings that the caller has other usual values for.
        """
        parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        parser.add_argument("--method", nargs="?")
        usual = cls(data=tyro.MISSING)
        given, _ = parser.parse_known_args(words)
        if given.method == "lang3dxl-paper":
            plain_as_printed(usual, usual)
            usual.looks, usual.photo_scale = PRINTED_LOOKS, PRINTED_PHOTO_SCALE
        return replace(usual, **changes)

    def settings(self) -> Settings:
        """Return the settings of the run. Raises UserError for one without effect."""
        from lang3dxl_ns.training.fit import Settings

        settings = Settings.of(self.method, self.steps)
        parts: dict[type, Any] = {
            SceneSettings: settings.scene,
            PreparationConfig: settings.targets,
            CaptureSettings: settings.capture,
            RunSettings: settings,
        }
        for kind, owner in parts.items():
            for field in fields(kind):
                setattr(owner, field.name, getattr(self, field.name))
        settings.photo_scale, settings.scene.appearance.use = self.photo_scale, self.looks
        settings.check_effect()
        return settings
