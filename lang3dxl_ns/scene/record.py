"""A scene's record: photos, cameras, frame, and the CLIP that its features come from.

Training writes it at its start, so that a finished run can be queried without its photos.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Any, Literal
from unicodedata import normalize

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy import ndarray as Array
from PIL import Image
from torch import Tensor

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.errors import UserError, readable
from lang3dxl_ns.common.files import read_json, replace_file
from lang3dxl_ns.common.image import resize_nearest
from lang3dxl_ns.scene.camera import Camera, Lens, check_pose, view_matrix
from lang3dxl_ns.scene.companions import is_name
from lang3dxl_ns.scene.frame import Frame
from lang3dxl_ns.scene.georeference import Georeference, georeference, georeference_from_json, gps_position
from lang3dxl_ns.scene.photo import Photo
from lang3dxl_ns.scene.reconstruction import CONTRADICTED

SCENE_FILE = "lang3dxl_scene.json"
"""Name of the scene description, which lies beside config.yml."""
_VERSION = 2


@dataclass(frozen=True, repr=False)
class ScenePhoto:
    """A photo's name and camera, at training resolution."""

    name: str
    split: Literal["train", "eval"]
    camera_to_world: list[list[float]]
    """Pose [3, 4] in the model's frame, nerfstudio's camera axes (x right, y up, z backward)."""
    lens: Lens
    """Lens of the photo's file: masks are drawn on the distorted photo, while views are undistorted."""
    mask: str | bytes | None = None
    """Foreground mask of the photo: its file, or the bytes of a PNG with the undistorted mask."""
    size: tuple[int, int] | None = None
    """Width and height at which the photo was read; None: the lens's."""
    quarter_turns: int = 0
    """Clockwise quarter turns that bring the file's pixels as stored upright."""
    file: tuple[int, int] | None = None
    """Width and height of the file, upright; None: as read."""
    doubtful: str | None = None
    """Reason why the pose may be wrong."""

    @classmethod
    def of(
        cls,
        photo: Photo,
        split: Literal["train", "eval"],
        camera_to_world: list[list[float]],
        scale: float,
        doubtful: str | None = None,
    ) -> ScenePhoto:
        """Describe a photo that is used at `scale` and seen from a pose, which may be doubtful."""
        mask = None if photo.mask_path is None else str(photo.mask_path.absolute())
        size = photo.width, photo.height
        lens, turns, file = photo.lens.scaled(scale), photo.quarter_turns, None
        with suppress(UserError):  # the photo is gone or damaged
            file = photo.file_size()
        return cls(photo.name, split, camera_to_world, lens, mask, size, turns, file, doubtful)

    def __repr__(self) -> str:
        width, height = self.file_size
        held_out = ", held out" if self.held_out else ""
        return f"ScenePhoto({self.name!r}, {width} × {height} pixels{held_out})"

    @property
    def held_out(self) -> bool:
        """Whether training did without the photo to be judged by it, not because its pose is contradicted."""
        return self.split == "eval" and self.doubtful != CONTRADICTED

    @property
    def file_size(self) -> tuple[int, int]:
        """Width and height of the photo's file in pixels."""
        return self.file or self.read_size

    @property
    def read_size(self) -> tuple[int, int]:
        """Width and height at which the photo was read, in pixels: the file's, unless that is larger than the
        run's limit."""
        return self.size or (self.lens.width, self.lens.height)

    @property
    def camera(self) -> Camera:
        """The camera for the rasterizer, at training resolution."""
        return self.lens.camera(view_matrix(torch.tensor(self.camera_to_world, dtype=torch.float32)))

    @property
    def full_camera(self) -> Camera:
        """The camera at the resolution at which the photo was read, for the rasterizer."""
        return self.lens.resized(*self.read_size).camera(self.camera.view_matrix)

    @property
    def pose(self) -> Float64[Array, "4 4"]:
        """Pose [4, 4], camera → world in the model's frame, nerfstudio's axes."""
        return self.camera.pose

    def photo(self, folder: Path = Path()) -> Photo:
        """Return the photo in its folder, without its mask if the mask's file is gone."""
        mask = Path(self.mask) if isinstance(self.mask, str) else None
        mask = mask if mask is not None and mask.is_file() else None
        return Photo(self.name, folder / self.name, mask, self.lens, self.quarter_turns)

    def mask_stamp(self) -> list[int] | None:
        """Return size, modification time and inode of the mask's file; None without one."""
        photo = self.photo()
        return None if photo.mask_path is None else photo.stamp(photo.mask_path)

    def foreground(self, size: tuple[int, int] | None = None) -> Bool[Tensor, "h w"] | None:
        """Read the photo's undistorted foreground at a size (height and width in pixels; default: the stored
        mask's); None if it has no mask, or the mask is gone. Raises UserError for a damaged one."""
        mask = None if isinstance(self.mask, bytes) else self.photo().read_mask()
        if isinstance(self.mask, bytes):
            with readable(f"the foreground of {self.name} can't be read", "write the scene file again"):
                mask = torch.from_numpy(np.array(Image.open(io.BytesIO(self.mask)).convert("1")))
        return mask if mask is None or size is None else resize_nearest(mask, size)


@dataclass(frozen=True)
class SceneRecord:
    """Contents of a run's scene description."""

    photos: list[ScenePhoto]
    """Training photos, then held-out ones."""
    clip: str | None
    """Folder or name of the CLIP that made the targets; None for a run with colors only."""
    clip_identity: str | None
    """Fingerprint of the CLIP's weights and, after a dot, of its tokenizer (`same_clip`)."""
    scale: float
    """Factor in: model's frame = scale · transform · COLMAP's frame."""
    transform: list[list[float]]
    """Matrix [3, 4] that precedes `scale`."""
    data: str
    """Folder of the photos that the run was trained on."""
    georeference: Georeference | None = None
    """Meters, up and north, if the photos tell their GPS positions, which are not kept."""

    def located(self, photos: Iterable[Photo]) -> SceneRecord:
        """Return the record with meters, up and north, if the photos' files tell them."""
        paths = {photo.name: photo.path for photo in photos}
        positions = [gps_position(paths[p.name]) if p.name in paths else None for p in self.photos]
        poses = np.array([photo.camera_to_world for photo in self.photos], dtype=np.float64)
        return replace(self, georeference=georeference(poses[:, :, 3], poses[:, :, 1].mean(0), positions))

    def write(self, path: Path) -> None:
        """Write the file, atomically."""
        replace_file(path, json.dumps({"version": _VERSION, **asdict(self)}) + "\n")

    @classmethod
    def read(cls, path: Path) -> SceneRecord:
        """Read the file. Raises UserError if it is missing, damaged, or of another version."""
        if not path.is_file():
            raise UserError(f"{path.parent} has no {path.name}, which training writes: copy the whole folder")
        with readable(f"{path} can't be read", "restore it, or train anew"):
            content: dict[str, Any] = read_json(path)
            expect(content.pop("version") == _VERSION, "another version wrote it")
            return scene_from_json(content)

    @property
    def trained(self) -> list[str]:
        """Names of the training photos."""
        return [photo.name for photo in self.photos if photo.split == "train"]

    @property
    def frame(self) -> Frame:
        """Similarity to the model's frame from COLMAP's."""
        return Frame(np.array(self.transform, np.float64), self.scale)

    def has_frame(self, frame: Frame) -> bool:
        """Return whether the model is in this frame, to a hundredth of a unit of the model."""
        apart = np.abs(np.array(self.transform) - frame.transform)
        near = apart[:, :3].max() < 1e-3 and self.scale * apart[:, 3].max() < 1e-2
        return bool(near) and math.isclose(self.scale, frame.scale, rel_tol=1e-3)

    def photo(self, name: str) -> ScenePhoto:
        """Find the photo with this name, or with this file name or stem if only one photo has it. Raises
        UserError, which names similar photos, if there is none."""
        for wanted in (name, normalize("NFC", name), normalize("NFD", name)):  # accents in letters or behind
            for form in (str, lambda n: PurePosixPath(n).name, lambda n: PurePosixPath(n).stem):
                found = [photo for photo in self.photos if form(photo.name) == wanted]
                if len(found) == 1:
                    return found[0]
        names = [photo.name for photo in self.photos]
        similar = get_close_matches(name, names, n=3) or names[:3]
        raise UserError(f"the scene has no photo {name!r}: it has {len(names)}, such as {', '.join(similar)}")


def same_clip(one: str | None, other: str | None) -> bool:
    """Return whether two fingerprints are of one CLIP. Earlier ones lack the part of the tokenizer, after a
    dot, and fit any."""
    if one is None or other is None or "." not in one or "." not in other:
        return (one or "").partition(".")[0] == (other or "").partition(".")[0]
    return one == other


def scene_from_json(content: dict[str, Any]) -> SceneRecord:
    """Build the description from a JSON object, after validating all its values. Raises ValueError, KeyError,
    TypeError or AttributeError for anything else."""
    photos = [_photo(**photo) for photo in content["photos"]]
    meters = content.get("georeference")
    meters = None if meters is None else georeference_from_json(meters)
    scene = SceneRecord(**{**content, "photos": photos, "georeference": meters})
    expect(photos != [], "it lists no photo")
    expect(len({photo.name for photo in photos}) == len(photos), "a photo is listed twice")
    for text in (scene.clip, scene.clip_identity):
        expect(isinstance(text, str | None), f"its CLIP is {text!r}")
    expect(isinstance(scene.data, str), f"its data are in {scene.data!r}")
    expect(is_coordinate(scene.scale) and scene.scale > 0, f"its scale is {scene.scale!r}")
    known = all(is_coordinate(value) for row in scene.transform for value in row)
    expect(known and [len(row) for row in scene.transform] == [4, 4, 4], "it has no transform")
    return scene


def _photo(lens: dict[str, Any], size: Any = None, file: Any = None, **rest: Any) -> ScenePhoto:
    lens = lens | {"distortion": tuple(lens["distortion"])}
    size, file = (None if pair is None else tuple(pair) for pair in (size, file))
    photo = ScenePhoto(lens=Lens(**lens), size=size, file=file, **rest)
    expect(is_name(photo.name), f"a photo is called {photo.name!r}")
    expect(photo.split in ("train", "eval"), f"{photo.name} is in the split {photo.split!r}")
    for text in (photo.mask, photo.doubtful):
        expect(isinstance(text, str | None), f"{photo.name} has {text!r} for a mask or a reason")
    expect(photo.quarter_turns in range(4), f"{photo.name} is turned {photo.quarter_turns!r} quarters")
    expect(len(photo.camera_to_world) == 3, f"{photo.name} has no pose")
    check_pose(photo.camera_to_world)
    photo.lens.check()
    for width, height in (photo.read_size, photo.file_size):
        replace(photo.lens, width=width, height=height).check()
    return photo


def overview(photos: Sequence[ScenePhoto], middle: tuple[float, ...]) -> ScenePhoto:
    """Choose the farthest photo that sees the scene's center near its own, or else the first photo."""
    best, farthest = photos[0], 0.0
    for photo in photos:
        camera, lens = photo.camera, photo.lens
        x, y, z = camera.view_matrix[:3, :3] @ torch.tensor(middle) + camera.view_matrix[:3, 3]
        wide, high = abs(x) * lens.fx / lens.width, abs(y) * lens.fy / lens.height
        if z > farthest and max(wide, high) < z / 4:
            best, farthest = photo, float(z)
    return best
