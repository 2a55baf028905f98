"""Recall of the pairs that `reconstruct` matches in a large collection, whose true model is known.

    lang3dxl demo-scene --family cathedral --seed 601 --photos 1000 --weathered --out TRUE
    python -m lab.benchmarks.pairs --true TRUE --work DIR

A true pair shares at least 15 % of the points of the photo with fewer, seen less than 30° apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np
import pycolmap
import tyro
from jaxtyping import Bool
from numpy import ndarray as Array
from scipy.sparse import csr_matrix

from lang3dxl_ns.scene.matching import extract, feature_database, largest, numbered, quiet
from lang3dxl_ns.scene.pairing import similar_pairs
from lang3dxl_ns.scene.photo_folder import find_photos
from lang3dxl_ns.scene.reconstruction import ReconstructionSettings

SHARED, TURNED = 0.15, 30.0
PARTNERS = 3
"""True partners that a photo needs to get a pose."""


@dataclass
class Pairs:
    """Count the true pairs among those that are matched."""

    true: Path
    """Scene of `lang3dxl demo-scene`."""
    work: Path
    """Folder for the features."""
    neighbors: tuple[int, ...] = (10, 20, 40, 80)


def true_pairs(model: pycolmap.Reconstruction, names: list[str]) -> Bool[Array, "n n"]:
    """Tell which photos show the same, by the tracks of the true model."""
    images = {image.name: image for image in model.images.values()}
    shown = [[p.point3D_id for p in images[name].points2D if p.has_point3D()] for name in names]
    photo = np.repeat(np.arange(len(names)), [len(points) for points in shown])
    _, point = np.unique(np.concatenate(shown), return_inverse=True)
    seen = csr_matrix((np.ones(len(point)), (photo, point)))
    fewer = np.minimum.outer(*2 * [np.array([len(points) for points in shown])])
    ahead = np.stack([images[name].cam_from_world().rotation.matrix()[2] for name in names])
    near = ahead @ ahead.T > np.cos(np.radians(TURNED))
    return (seen @ seen.T).toarray() * near * (1 - np.eye(len(names))) > SHARED * fewer


def main(config: Pairs) -> None:
    photos, settings = find_photos(config.true), ReconstructionSettings(features="sift")
    config.work.mkdir(parents=True, exist_ok=True)
    copies = numbered(photos, config.work)
    with quiet():
        database = feature_database(photos, copies, config.work, settings)
        extract(database, copies, settings)
    truth = true_pairs(pycolmap.Reconstruction(config.true / "sparse/0"), list(photos.names))
    partners = truth.sum(1)
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        number = {name: i for i, name in enumerate(copies.names)}
        for count in config.neighbors:
            start = process_time()
            pairs = similar_pairs(copies.names, lambda name: largest(db, ids[name]), count)
            seconds, found = process_time() - start, np.zeros_like(truth)
            for one, other in pairs:
                found[number[one], number[other]] = found[number[other], number[one]] = True
            lost = int(((found & truth).sum(1) < PARTNERS)[partners >= PARTNERS].sum())
            print(
                f"{count} neighbors: {len(pairs):,} pairs, {found[truth].mean():.3f} of the true ones; under "
                f"{PARTNERS} of them for {lost} of {(partners >= PARTNERS).sum()} photos; {seconds:.0f} s"
            )


if __name__ == "__main__":
    main(tyro.cli(Pairs, description=__doc__))
