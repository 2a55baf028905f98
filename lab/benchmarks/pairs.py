"""How many of the true pairs of photos `reconstruct` tries and verifies, where the true model is known.

    lang3dxl demo-scene --family cathedral --seed 601 --photos 1000 --weathered --out TRUE
    mkdir FOUND && cp -r TRUE/images FOUND && lang3dxl reconstruct --data FOUND
    python -m lab.benchmarks.pairs --true TRUE --found FOUND

A true pair shares at least 15 % of the points of the photo with fewer, seen less than 30° apart.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import tyro
from jaxtyping import Bool
from numpy import ndarray as Array
from scipy.sparse import csr_matrix

from lang3dxl_ns.common.files import read_json
from lang3dxl_ns.scene.placements import LEAST_MATCHES

SHARED, TURNED = 0.15, 30.0
PARTNERS = 3
"""True partners that a photo needs to get a pose."""


@dataclass
class Pairs:
    """Count the true pairs among those that were tried."""

    true: Path
    """Scene of `lang3dxl demo-scene`."""
    found: Path
    """Folder with some or all of its photos, reconstructed."""


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


def matched_pairs(database: Path) -> tuple[Bool[Array, "n n"], Bool[Array, "n n"]]:
    """Tell which pairs were tried, and which of them were verified, by the photos' numbers in a database."""
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as db:
        number = {i: int(Path(name).stem) for i, name in db.execute("SELECT image_id, name FROM images")}
        rows = db.execute("SELECT pair_id, rows FROM two_view_geometries").fetchall()
    tried, verified = np.zeros((2, len(number), len(number)), bool)
    for pair, count in rows:
        one, other = (number[i] for i in pycolmap.pair_id_to_image_pair(pair))
        tried[one, other] = tried[other, one] = True
        verified[one, other] = verified[other, one] = count >= LEAST_MATCHES
    return tried, verified


def main(config: Pairs) -> None:
    work = config.found / "lang3dxl_cache" / "reconstruction"
    names = [name for name, *_ in read_json(work / "photos.json")["photos"]]
    truth = true_pairs(pycolmap.Reconstruction(config.true / "sparse/0"), names)
    partners = truth.sum(1)
    print(f"{len(names)} photos, {truth.sum() // 2:,} true pairs")
    for label, pairs in zip(("tried", "verified"), matched_pairs(work / "database.db"), strict=True):
        lost = int(((pairs & truth).sum(1) < PARTNERS)[partners >= PARTNERS].sum())
        print(
            f"{label}: {pairs.sum() // 2:,} pairs, {pairs[truth].mean():.3f} of the true ones; under "
            f"{PARTNERS} of them for {lost} of {(partners >= PARTNERS).sum()} photos"
        )


if __name__ == "__main__":
    main(tyro.cli(Pairs, description=__doc__))
