"""`lang3dxl demo-scene`: photos of a procedural landmark."""

from __future__ import annotations

from dataclasses import dataclass

from lang3dxl_ns.common.console import say
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.demo.landmark.demo_scene import DemoScene


@showing("out", "photos", "seed", "family")
@dataclass
class GenerateScene(DemoScene):
    """Generate a demo scene: photos of a procedural landmark."""

    def main(self) -> None:
        from lang3dxl_ns.demo.landmark.scene_writer import write_scene

        folder = write_scene(self)
        say(f"{self.photos} photos, COLMAP model, masks and ground truth in {folder}")
