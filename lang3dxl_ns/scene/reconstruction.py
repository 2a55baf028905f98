"""Settings and report of a reconstruction; a command's help needs no numpy or torch for them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lang3dxl_ns.common.console import some
from lang3dxl_ns.common.errors import DAMAGE
from lang3dxl_ns.common.files import content_digest, read_json

REPORT = Path("reconstruction/report.json")
"""File of the report in a scene's cache."""
PICTURE = REPORT.with_name("cameras.png")
"""File beside the report that shows cameras and points."""

_REASONS = ("left_out", "doubtful")
"""Parts of the report: photos with reasons."""
CONTRADICTED, LONELY = (
    "most of its matches are with photos placed elsewhere",
    "only one other photo supports it",
)
"""Reasons to doubt a photo's place. docs/lab/reconstruction.md tells how many of either kind stand wrong."""


@dataclass
class ReconstructionSettings:
    """Settings of a reconstruction. If they change, it starts anew."""

    mapper: Literal["incremental", "global"] = "incremental"
    """COLMAP's mapper: incremental, or global (GLOMAP), which is meant for many photos."""
    max_size: int = 1600
    """Longer side in pixels at which features are detected; larger photos are shrunk."""
    features: Literal["auto", "sift", "dsp-sift", "xfeat"] = "auto"
    """Kind of features. dsp-sift places more photos in three times the time, some less exactly; auto takes it
    where sift leaves over a tenth of up to 100 photos without a pose. xfeat (pip install -e '.[match]')
    matches more, also sides that look alike, in seconds a pair without a GPU."""
    max_features: int = 4096
    """Maximum number of features per photo."""
    one_camera: bool | None = None
    """Whether one camera with one lens took all photos. By default, EXIF and sizes decide."""
    engine: Literal["local", "ray"] = "local"
    """Where features are found and matched: on all cores of this machine, or by workers on a Ray cluster that
    sees the same folders (extra [ray]). Mapping runs here."""
    workers: int = 1
    """Number of workers on the Ray cluster, of one core each."""
    address: str | None = None
    """Address of the Ray cluster, such as auto or ray://HOST:10001. By default one is started here."""


@dataclass(frozen=True)
class ReconstructionReport:
    """Result of a reconstruction, in numbers and reasons."""

    photos: int
    registered: int
    points: int
    error: float
    """Mean reprojection error in pixels."""
    cameras: int
    mapper: str
    contradicting: int = 0
    """Pairs of photos that match, but contradict others and were left out."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Photos without a pose, with reasons."""
    doubtful: dict[str, str] = field(default_factory=dict)
    """Photos with a pose that may be wrong, with reasons."""
    other_models: tuple[int, ...] = ()
    """Sizes of further models, of photos not connected to the largest one."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Duration of each stage; if the reconstruction was resumed, in the last attempt."""

    def lines(self) -> list[str]:
        """Phrase the report as sentences."""
        found = [
            f"{self.registered} of {self.photos} photos have a pose; {self.points} points, mean error "
            f"{self.error:.2f} px, {self.cameras} camera{'s' * (self.cameras > 1)}, {self.mapper} mapper, "
            f"{sum(self.seconds.values()):.0f} s"
        ]
        if self.other_models:
            sizes = " and ".join(map(str, self.other_models))
            found.append(
                f"the photos fall into {len(self.other_models) + 1} unconnected groups: the "
                f"largest, of {self.registered}, is used; the others have {sizes}. Add photos that connect "
                "them, or give each group its own folder"
            )
        if self.contradicting:
            found.append(
                f"{self.contradicting} pairs of photos match but contradict others, as different sides that "
                "look alike do: they were left out"
            )
        found += reasons_in_words({"doubtfully placed": self.doubtful, "left out": self.left_out})
        if self.doubtful:
            found.append(
                "a building that looks alike from several sides takes photos to the wrong one: look at the "
                "doubtful ones in the viewer. Training leaves out those with matches elsewhere, unless a "
                "train_list.txt in the scene's folder names them"
            )
        return found


def reasons_in_words(told: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Phrase what became of photos, by kind, name and reason: a line for each kind and reason."""
    lines = []
    for what, photos in told.items():
        reasons: dict[str, list[str]] = {}
        for name, why in photos.items():
            reasons.setdefault(why, []).append(name)
        lines += [f"{what}, {why}: {some(names, 20)}" for why, names in reasons.items()]
    return lines


def picture_line(work: Path) -> str:
    """Name the picture of a reconstruction in its folder."""
    return f"cameras and points from above and from the side: {work / PICTURE.name}"


def read_report(cache_dir: Path, model: Path) -> dict[str, Any]:
    """Read the report on a model from a cache, with photos `left_out` and `doubtful`: none without a report,
    or in another model's, since caches may be another scene's. Reports of earlier versions name no model."""
    with suppress(*DAMAGE):
        told = read_json(cache_dir / REPORT)
        reasons = {
            part: {str(name): str(why) for name, why in told.get(part, {}).items()} for part in _REASONS
        }
        if "model" not in told or told["model"] == model_digest(model):
            return told | reasons
    return {part: {} for part in _REASONS}


def doubtful_photos(cache_dir: Path, model: Path) -> dict[str, str]:
    """Read from a cache which photos of a model were doubtfully placed, with reasons."""
    return read_report(cache_dir, model)["doubtful"]


def model_digest(model: Path) -> str:
    """Compute a digest of the photos of a model, with their poses and keypoints. Raises OSError without."""
    path = model / "images.bin"
    return content_digest(path if path.is_file() else path.with_suffix(".txt"))
