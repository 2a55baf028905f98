"""Doubtful placements of a reconstruction against true cameras.

    lang3dxl demo-scene --seed 700 --photos 100 --no-wild --out TRUE
    mkdir FOUND && cp -r TRUE/images FOUND && lang3dxl reconstruct --data FOUND
    python -m lab.benchmarks.placements --true TRUE/sparse/0 --found FOUND/sparse/0 --report REPORT.json

REPORT.json is the report that `reconstruct` leaves in the scene's cache. A photo is wrong if, after an
alignment to the largest consistent part, it stands further from its true place than a share of the cameras'
extent.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import tyro
from skimage.measure import ransac
from skimage.transform import SimilarityTransform


@dataclass
class Placements:
    """Compare the photos that `reconstruct` doubts with those that stand wrong."""

    true: Path
    """COLMAP model with the true cameras."""
    found: Path
    """The reconstruction."""
    report: Path
    """report.json of the reconstruction."""
    share: float = 0.05
    """Distance from which a photo is wrong, as a share of the cameras' extent."""


def wrong_photos(true: Path, found: Path, share: float) -> tuple[dict[str, float], set[str]]:
    """Distances of the photos with a pose from their true places, as shares of the cameras' extent, and the
    names of those that stand wrong."""
    truth, model = ({i.name: i for i in pycolmap.Reconstruction(p).images.values()} for p in (true, found))
    names = sorted(name for name, image in model.items() if image.has_pose and name in truth)
    places = np.array([model[name].projection_center() for name in names])
    wanted = np.array([truth[name].projection_center() for name in names])
    extent = 2 * np.linalg.norm(wanted - wanted.mean(0), axis=1).max()
    aligned, right = ransac(
        (places, wanted),
        SimilarityTransform,
        min_samples=4,
        residual_threshold=share * extent,
        max_trials=4_000,
        rng=0,
    )
    off = np.linalg.norm(aligned(places) - wanted, axis=1) / extent
    wrong = {name for name, stands in zip(names, right, strict=True) if not stands}
    return dict(zip(names, off.tolist(), strict=True)), wrong


def main(config: Placements) -> None:
    off, wrong = wrong_photos(config.true, config.found, config.share)
    doubtful = set(json.loads(config.report.read_text())["doubtful"])
    both = wrong & doubtful
    print(f"{len(off)} with a pose, {len(wrong)} wrong, {len(doubtful)} doubtful, {len(both)} both")
    print(f"off by {np.median([*off.values()]):.3%} of the extent (median), at most {max(off.values()):.1%}")


if __name__ == "__main__":
    main(tyro.cli(Placements))
