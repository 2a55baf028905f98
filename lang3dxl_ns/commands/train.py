"""`lang3dxl train`: a scene from photos, without nerfstudio."""

from __future__ import annotations

import shlex
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing, without
from lang3dxl_ns.preparation.settings import PreparationConfig
from lang3dxl_ns.training.scene_settings import RunSettings, SceneSettings

if TYPE_CHECKING:
    from lang3dxl_ns.training.fit import Settings


@showing(
    *("data", "out", "method", "steps", "restart", "clip", "quality", "foreground", "workers", "photo_scale"),
    "looks",
)
@without("total_steps")
@dataclass(kw_only=True)
class Train(RunSettings, SceneSettings, PreparationConfig):
    """Train a scene from photos: Gaussians with colors, and words for them.

    Photos without a COLMAP model or a transforms.json are reconstructed first. A run that was stopped, by
    Ctrl-C or otherwise, goes on with the same command. `lang3dxl view OUT` beside it shows the scene so far.
    """

    data: tyro.conf.Positional[Path]
    """Folder of photos, or a video."""
    out: Path | None = None
    """Folder of the run, in which NAME.scene is written (default: outputs/NAME)."""
    method: Literal["lang3dxl", "lang3dxl-paper"] = "lang3dxl"
    """lang3dxl: words are learned after training. lang3dxl-paper: codes are trained with the scene, as
    printed."""
    steps: int | None = None
    """Iterations (default: 30,000 on a GPU, 70,000 as printed, and 3,000 without one)."""
    looks: Literal["auto", "on", "off"] = "auto"
    """Colors that depend on each photo's lighting. auto: where the photos differ in it."""
    photo_scale: float | None = None
    """Size of the training photos relative to the files' (default: 1, as printed 0.5)."""
    restart: bool = False
    """Train anew, over the run in the folder."""

    def main(self) -> None:
        from lang3dxl_ns.training.fit import run_folder

        settings = self.settings()
        folder, _ = run_folder(self.data, self.out, settings, self.restart)
        run = shlex.quote(str(folder))
        say(f"Walk through it: lang3dxl view {run}")
        if settings.targets.clip != "none":
            say(f"Ask it:          lang3dxl query {run} --text windows --out found")

    def settings(self) -> Settings:
        """Return the settings of the run: its method's usual ones, but for those that were given here."""
        from lang3dxl_ns.training.fit import Settings

        settings = Settings.of(self.method, self.steps)
        parts = {SceneSettings: settings.scene, PreparationConfig: settings.targets, RunSettings: settings}
        for kind, owner in parts.items():
            for name, value in _changed(self, kind).items():
                setattr(owner, name, value)
        settings.photo_scale = self.photo_scale or settings.photo_scale
        if self.looks != "auto":
            settings.scene.appearance.use = self.looks
        return settings


def _changed(settings: object, kind: type) -> dict[str, Any]:
    """Return the plain settings of a kind that differ from its defaults."""
    plain = [f for f in fields(kind) if f.default is not MISSING]
    return {f.name: getattr(settings, f.name) for f in plain if getattr(settings, f.name) != f.default}
