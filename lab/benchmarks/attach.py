"""Average precision of words in scene files of one splat: a run's own, and those that `attach` made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from lab.landmark.novel_views import read_novel_views
from lang3dxl_ns.attachment import AttachConfig
from lang3dxl_ns.attachment.attach import attach
from lang3dxl_ns.attachment.frames import camera_in
from lang3dxl_ns.common.console import say, tracked
from lang3dxl_ns.common.errors import UserError
from lang3dxl_ns.common.reports import markdown_table
from lang3dxl_ns.common.settings_help import showing
from lang3dxl_ns.evaluation.aggregate import average
from lang3dxl_ns.evaluation.ground_truth import GroundTruth, find_ground_truth
from lang3dxl_ns.evaluation.scores import LanguageScorer, open_scorer
from lang3dxl_ns.files.scene_file import read_scene
from lang3dxl_ns.open_scene import find_scene_file
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.scene.camera import Camera


@showing("scenes", "data", "out")
@dataclass
class AttachBenchmark:
    """Score words in scenes of one splat, in the test views or labeled photos of its data.

    Of a single scene, the Gaussians are written as a PLY and attached again, with the photos of --data and
    without: one table tells what each costs.
    """

    scenes: tyro.conf.Positional[list[Path]]
    """Scene files or runs, all in one frame. The first knows where the photos were taken."""
    data: Path
    """Folder with test_views/, or with ground_truth/ of photos."""
    out: Path = Path("attach-benchmark")
    """Folder for what is attached; finished scenes in it are kept."""
    most: int | None = None
    """Views to score, evenly spread (default: all)."""

    def main(self) -> None:
        files = [find_scene_file(path) or path for path in self.scenes]
        first = read_scene(files[0])
        if first.file.clip is None:
            raise UserError(f"{self.scenes[0]} has only colors: name a scene with words")
        files += attached(first, self.data, self.out) if len(files) == 1 else []
        scenes = {path: read_scene(path) for path in files}
        truth, views = _labeled(self.data, first)
        chosen = views if self.most is None else views[:: -(-len(views) // self.most)]
        scorer = open_scorer(truth, first.file.clip, first.device)
        rows = []
        for path, scene in scenes.items():
            means = average(list(_scores(scene, scorer, chosen)))
            seen = float(scene.codes.isfinite().all(1).float().mean()) if scene.codes is not None else 0.0
            found = [f"{means[f'ap_{c}']:.3f}" if f"ap_{c}" in means else None for c in truth.categories]
            rows.append([path.name, f"{means['map']:.3f}", f"{seen:.0%}", *found])
        say(f"{len(chosen)} views of {self.data}")
        say(markdown_table(["scene", "mAP", "Gaussians seen", *truth.categories], rows))


def attached(scene: Scene, data: Path, out: Path) -> list[Path]:
    """Scene files of a scene's own Gaussians as a PLY, attached with its photos and without.

    Args:
        scene: the scene, with words.
        data: folder of its photos.
        out: folder for the files; those in it are kept.

    Raises:
        UserError: see `attach`.
    """
    assert scene.file.clip is not None
    splat, config = out / "splat.ply", AttachConfig(clip=scene.file.clip)
    found = {out / "with-photos.scene": data, out / "without-photos.scene": None}
    if not splat.is_file():
        scene.export(splat)
    for file, photos in found.items():
        if not file.is_file():
            attach(splat, photos, file, config)
    return list(found)


Labeled = tuple[str, Camera, tuple[int, int]]
"""A view's name, camera and size for scoring."""


def _labeled(data: Path, scene: Scene) -> tuple[GroundTruth, list[Labeled]]:
    """The test views, or else the labeled photos."""
    if (novel := read_novel_views(data)) is not None:
        similarity = np.vstack([scene.file.scale * np.array(scene.file.transform), [0, 0, 0, 1]])
        truth = novel.truth
        cameras = [(view.name, camera_in(similarity, view)) for view in novel.cameras]
    else:
        folder = find_ground_truth(data)
        if folder is None:
            raise UserError(f"{data} has neither test_views/ nor ground_truth/: there is nothing to score")
        truth = GroundTruth(folder)
        named = [photo for photo in scene.photos if truth.key(photo.name) is not None]
        cameras = [(photo.name, photo.full_camera) for photo in named]
    return truth, [(name, c, truth.scoring_size(c.height, c.width)) for name, c in cameras]


def _scores(scene: Scene, scorer: LanguageScorer, views: list[Labeled]) -> Iterator[dict[str, float]]:
    queries = scorer.queries.to(scene.device)
    channels = scene.engine.channels(queries)
    for name, camera, size in tracked(views, "scoring"):
        rendered = scene.draw(camera, channels).channels
        assert rendered is not None
        maps = scorer.named(scene.engine.maps(rendered, queries), size)
        yield scorer.scores(name, {"": scorer.variants(maps)[""]})
