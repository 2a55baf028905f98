"""What a run folder says about its scene: the photos' names and cameras, and the CLIP that it speaks.

Written when training starts, so that a finished run can be queried without its photos.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lang3dxl_ns.errors import UserError
from lang3dxl_ns.files import write_atomically
from lang3dxl_ns.geometry import view_matrix
from lang3dxl_ns.preparation.photo import Photo
from lang3dxl_ns.rendering import Camera

SCENE_FILE = "lang3dxl_scene.json"
"""Its name, beside config.yml."""
_VERSION = 1


@dataclass(frozen=True)
class ScenePhoto:
    """A photo's name and camera, at the size that it was trained at."""

    name: str
    split: Literal["train", "eval"]
    camera_to_world: list[list[float]]
    """[3, 4], the model's frame, nerfstudio's camera axes (x right, y up, z backward)."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    mask: str | None = None
    """File of the photo's foreground mask."""
    distortion: list[float] = field(default_factory=list)
    """The lens's, as `Photo` has it: masks are drawn on the file, and views are undistorted."""
    fisheye: bool = False

    @property
    def camera(self) -> Camera:
        """As the rasteriser takes it."""
        return Camera(
            view_matrix(torch.tensor(self.camera_to_world)),
            torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]),
            self.width,
            self.height,
        )

    def photo(self, folder: Path = Path()) -> Photo:
        """The photo in its folder, without its mask where that is no longer there."""
        mask = None if self.mask is None else Path(self.mask)
        return Photo(
            name=self.name,
            path=folder / self.name,
            mask_path=mask if mask is not None and mask.is_file() else None,
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            distortion=tuple(self.distortion),
            fisheye=self.fisheye,
        )

    def foreground(self) -> Bool[Tensor, "h w"] | None:
        """Where the photo counts; None where all of it does, as where its mask is no longer there."""
        return self.photo().read_mask()


@dataclass(frozen=True)
class SceneFile:
    """The contents of the file."""

    photos: list[ScenePhoto]
    """Training photos, then held-out ones."""
    clip: str | None
    """Folder or name of the CLIP that made the targets; None for a run of colours only."""
    clip_identity: str | None
    """Of its weights."""
    scale: float
    """The model's frame = scale · transform · COLMAP's frame."""
    transform: list[list[float]]
    """[3, 4]."""
    data: str
    """Folder that the photos came from."""

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, json.dumps({"version": _VERSION, **asdict(self)}) + "\n")

    @classmethod
    def read(cls, path: Path) -> SceneFile:
        """Read the file. Raises UserError where it is missing, damaged, or of another version."""
        if not path.is_file():
            raise UserError(
                f"{path.parent} has no {path.name}, which training writes when it starts: the run was made "
                f"by an earlier version, or a part of its folder was left behind"
            )
        try:
            content: dict[str, Any] = json.loads(path.read_text())
            if content.pop("version") != _VERSION:
                raise ValueError("another version wrote it")
            content["photos"] = [ScenePhoto(**photo) for photo in content["photos"]]
            return cls(**content)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(f"{path} can't be read ({error}): restore it, or train anew") from error

    def photo(self, name: str) -> ScenePhoto:
        """The photo of this name, or of this file name or stem where only one has it.

        Raises UserError with similar names where there is none.
        """
        for form in (str, lambda n: PurePosixPath(n).name, lambda n: PurePosixPath(n).stem):
            found = [photo for photo in self.photos if form(photo.name) == name]
            if len(found) == 1:
                return found[0]
        names = [photo.name for photo in self.photos]
        similar = get_close_matches(name, names, n=3) or names[:3]
        raise UserError(
            f"the scene has no photo {name!r}: there are {len(names)}, such as {', '.join(similar)}"
        )


def resized(camera: Camera, longer_side: int) -> Camera:
    """The same view with fewer pixels (never more)."""
    factor = min(longer_side / max(camera.width, camera.height), 1.0)
    width, height = max(round(camera.width * factor), 1), max(round(camera.height * factor), 1)
    zoom = camera.intrinsics.new_tensor([[width / camera.width], [height / camera.height], [1.0]])
    return Camera(camera.view_matrix, camera.intrinsics * zoom, width, height)


def posed(pose: Float[Tensor, "rows 4"], like: Camera) -> Camera:
    """A camera at a pose (camera → world, nerfstudio's axes) with another's lens and size."""
    if pose.shape not in ((3, 4), (4, 4)):
        raise UserError(f"a pose has shape [3, 4] or [4, 4], not {list(pose.shape)}")
    return Camera(view_matrix(pose[:3].float()), like.intrinsics, like.width, like.height)


def read_camera_path(path: Path) -> Sequence[Camera]:
    """Cameras of a camera path as nerfstudio's viewer saves it. Raises UserError for other files."""
    try:
        content = json.loads(path.read_text())
        width, height = int(content["render_width"]), int(content["render_height"])
        return [_path_camera(frame, width, height) for frame in content["camera_path"]]
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(
            f"{path} is not a camera path ({error!r}): save one in the viewer (Render tab, Save Path)"
        ) from error


def _path_camera(frame: dict[str, Any], width: int, height: int) -> Camera:
    pose = torch.tensor(frame["camera_to_world"], dtype=torch.float32).reshape(4, 4)
    focal = height / 2 / math.tan(math.radians(frame["fov"]) / 2)
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(view_matrix(pose[:3]), intrinsics, width, height)
