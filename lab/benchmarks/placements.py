"""Doubtful placements of a reconstruction against true cameras.

    lang3dxl demo-scene --seed 700 --photos 100 --no-wild --out TRUE
    mkdir FOUND && cp -r TRUE/images FOUND && lang3dxl reconstruct --data FOUND
    python -m lab.benchmarks.placements --true TRUE/sparse/0 --found FOUND/sparse/0 --report REPORT.json

REPORT.json is the report that `reconstruct` leaves in the scene's cache. A photo is wrong if, after an
alignment to the largest consistent part, it stands further from its true place than a share of the cameras'
extent. How many pixels a photo is off is told against the other photos alone: a scene is trained in the model
as it is, so that what the whole model drifts costs no sharpness.
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
    held_out: Path | None = None
    """File with names of photos that are told apart from the others."""


_FEWEST = 5
"""Fewest points by which a photo is said to be off."""


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


def pixels_off(true: Path, found: Path) -> dict[str, float]:
    """How far off each photo shows the true points, in its pixels (median over its points): a point's place
    follows from its true pixels in the other photos and their found cameras, from two on. Photos with under
    five such points are left out."""
    truth, model = pycolmap.Reconstruction(true), pycolmap.Reconstruction(found)
    known = {image.name: image for image in truth.images.values()}
    posed = [image for image in model.images.values() if image.has_pose and image.name in known]
    number = {known[image.name].image_id: index for index, image in enumerate(posed)}
    points = list(truth.points3D.values())
    seen = [(p, number[i]) for p, point in enumerate(points) for i in _photos(point) if i in number]
    point, photo = np.array(seen).T
    places = np.array([p.xyz for p in points])[point]
    pixels, lines = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, 4))
    for index, image in enumerate(posed):
        here, shows = photo == index, known[image.name]
        pixels[here] = shows.camera.img_from_cam(shows.cam_from_world() * places[here])
        rays, pose = image.camera.cam_from_img(pixels[here]), image.cam_from_world().matrix()
        # Two equations of the point by its pixel, in pixels at the distance of the scene's center.
        lines[here] = image.camera.mean_focal_length() * (rays[:, :, None] * pose[2] - pose[:2])
    moments = np.einsum("nij,nik->njk", lines, lines)
    count, total = np.bincount(point, minlength=len(points)), np.zeros((len(points), 4, 4))
    np.add.at(total, point, moments)
    others = count[point] > 2
    rest = (total[point] - moments)[others]
    there = np.full((len(seen), 3), np.nan)
    there[others] = np.linalg.solve(rest[:, :3, :3], -rest[:, :3, 3:])[..., 0]
    off = {}
    for index, image in enumerate(posed):
        here = others & (photo == index)
        if here.sum() >= _FEWEST:
            shown = image.camera.img_from_cam(image.cam_from_world() * there[here])
            off[image.name] = float(np.median(np.linalg.norm(shown - pixels[here], axis=1)))
    return off


def _photos(point: pycolmap.Point3D) -> set[int]:
    return {element.image_id for element in point.track.elements}


def main(config: Placements) -> None:
    off, wrong = wrong_photos(config.true, config.found, config.share)
    doubtful = set(json.loads(config.report.read_text())["doubtful"])
    both = wrong & doubtful
    print(f"{len(off)} with a pose, {len(wrong)} wrong, {len(doubtful)} doubtful, {len(both)} both")
    print(f"off by {np.median([*off.values()]):.3%} of the extent (median), at most {max(off.values()):.1%}")
    pixels = pixels_off(config.true, config.found)
    held_out = set(config.held_out.read_text().split()) if config.held_out else set()
    groups = {"photos": pixels.keys() - held_out, "held-out photos": pixels.keys() & held_out}
    for what, names in groups.items():
        if names:
            median, most = np.percentile([pixels[name] for name in names], (50, 90))
            print(f"{len(names)} {what} are off by {median:.2f} pixels (median), a tenth by over {most:.2f}")


if __name__ == "__main__":
    main(tyro.cli(Placements))
