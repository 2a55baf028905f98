"""Test views of a landmark in test_views/: cameras that took no photo, with reference pictures and labels.

`test_views/cameras.json` holds the cameras in the COLMAP model's world, `images/` the pictures, `masks/`
(optional) the foreground, and `ground_truth/<category>/` the labels. The views are not in the COLMAP model;
only evaluation reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.landmark.demo_scene import CAMERAS, FOLDER
from lang3dxl_ns.common.errors import readable
from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.evaluation.ground_truth import GroundTruth
from lang3dxl_ns.scene.camera import Lens, check_pose
from lang3dxl_ns.scene.colmap import TrackedPhoto


@dataclass(frozen=True)
class NovelViews:
    """Test views of a scene."""

    folder: Path
    cameras: list[TrackedPhoto]
    """Cameras in the COLMAP model's world, each with some of the surface points it sees. Names are
    `test_views/NNNN.jpg`, relative to the scene; the pictures are in `images/`."""
    same_light: bool
    """Whether the scene's photos share one lighting, so that the colors of views can be compared."""

    @property
    def truth(self) -> GroundTruth:
        """The labels."""
        return GroundTruth(self.folder / "ground_truth", "plain")

    def image(self, view: TrackedPhoto) -> Path:
        """Return the file of a view's picture."""
        return self.folder / "images" / Path(view.name).name


def read_novel_views(scene: Path) -> NovelViews | None:
    """Read a scene's test views; None if it has none. Raises UserError for a damaged cameras.json."""
    path = scene / FOLDER / CAMERAS
    if not path.is_file():
        return None
    with readable(f"{path} is damaged", "make the scene again, or remove the file"):
        content = read_json(path)
        cameras = [_tracked(view) for view in content["views"]]
        return NovelViews(path.parent, cameras, bool(content["same_light"]))


def _tracked(view: dict) -> TrackedPhoto:
    fx, fy, cx, cy = map(float, view["intrinsics"])
    lens = Lens(int(view["width"]), int(view["height"]), fx, fy, cx, cy)
    lens.check()
    check_pose(view["camera_from_world"])
    pose = np.array(view["camera_from_world"], dtype=np.float64).reshape(3, 4)
    points = np.array(view["points"], dtype=np.float64).reshape(-1, 3)
    x, y, z = pose[:, :3] @ points.T + pose[:, 3:]
    pixels = np.column_stack([fx * x / z + cx, fy * y / z + cy])
    return TrackedPhoto(f"{FOLDER}/{view['name']}", lens, pose, points, pixels)
