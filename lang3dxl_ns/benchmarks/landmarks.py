"""Landmarks for benchmarks, each seed with one use."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lang3dxl_ns.demo.landmark.scene_writer import DemoScene, write_scene

Family = Literal["cathedral", "mosque", "hall"]
VALIDATION: dict[str, tuple[int, Family]] = {
    "cathedral-600": (600, "cathedral"),
    "cathedral-601": (601, "cathedral"),
    "mosque-602": (602, "mosque"),
    "mosque-603": (603, "mosque"),
    "hall-604": (604, "hall"),
    "hall-605": (605, "hall"),
}
"""For decisions: seed and family. The built-in CLIP was neither trained, tuned nor reported on them (its
seeds are 10,000 and up, 5,000 and up, and 0 to 249), and no published figure uses them."""
TEST: dict[str, tuple[int, Family]] = {
    "cathedral-700": (700, "cathedral"),
    "cathedral-701": (701, "cathedral"),
    "cathedral-702": (702, "cathedral"),
    "mosque-703": (703, "mosque"),
    "mosque-704": (704, "mosque"),
    "mosque-705": (705, "mosque"),
    "hall-706": (706, "hall"),
    "hall-707": (707, "hall"),
    "hall-708": (708, "hall"),
}
"""For published figures: three landmarks of each family, never used for decisions."""
LANDMARKS = VALIDATION | TEST
Landmarks = Literal["validation", "test"]


def landmark_scenes(use: Landmarks, folder: Path, photos: int = 48, test_views: int = 24) -> list[Path]:
    """Scenes of all landmarks for a use, in `folder`; existing ones are kept."""
    return [
        _scene(folder / name, *LANDMARKS[name], photos, test_views)
        for name in (VALIDATION if use == "validation" else TEST)
    ]


def _scene(out: Path, seed: int, family: Family, photos: int, test_views: int) -> Path:
    if not (out / "scene.json").is_file():
        write_scene(DemoScene(out=out, seed=seed, family=family, photos=photos, test_views=test_views))
    return out
