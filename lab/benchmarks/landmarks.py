"""Landmarks for benchmarks: every seed serves either validation or the test."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lab.landmark.scene_writer import DemoScene, write_scene

Family = Literal["cathedral", "mosque", "hall"]
Landmarks = Literal["validation", "test"]
SEEDS: dict[Landmarks, dict[Family, tuple[int, ...]]] = {
    "validation": {"cathedral": (600, 601), "mosque": (602, 603), "hall": (604, 605)},
    "test": {"cathedral": (700, 701, 702), "mosque": (703, 704, 705), "hall": (706, 707, 708)},
}
"""Seeds by use and family: `validation` for decisions, `test` for published figures only. The built-in CLIP
was not trained, tuned or reported on them (its seeds are 10,000 and up, 5,000 and up, and 0 to 249)."""


def landmark_scenes(use: Landmarks, folder: Path, photos: int = 48, test_views: int = 24) -> list[Path]:
    """Write the scenes of a use into `folder`, named by family and seed, unless they exist. Return them."""
    scenes = []
    for family, seeds in SEEDS[use].items():
        for seed in seeds:
            scene = folder / f"{family}-{seed}"
            if not (scene / "scene.json").is_file():
                write_scene(DemoScene(scene, seed=seed, family=family, photos=photos, test_views=test_views))
            scenes.append(scene)
    return scenes
