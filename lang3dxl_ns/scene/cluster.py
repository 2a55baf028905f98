"""Steps of matching on a Ray cluster that sees the same folders.

A worker does its share of a step in a database of its own, with the features that it needs, so that no two
processes write to one file. This process collects what they find.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from lang3dxl_ns.common import parallel
from lang3dxl_ns.scene.colmap import load_pycolmap

Step: TypeAlias = Callable[[Path, Sequence[Any], int], None]
"""Function that adds to a database what a chunk of photos or pairs lacks, in so many threads. It can be sent
to another process."""
Rows: TypeAlias = dict[str, list[tuple[Any, ...]]]
"""Rows of COLMAP's tables."""

_OF_CAMERAS = "cameras", "rigs", "rig_sensors", "images", "frames", "frame_data", "pose_priors"
_OF_FEATURES = "keypoints", "descriptors"
_OF_PAIRS = "matches", "two_view_geometries"


def on_cluster(
    workers: parallel.Workers, step: Step, database: Path, chunks: Sequence[Sequence[Any]]
) -> Iterator[Sequence[Any]]:
    """Do a step on chunks of photos' names, or of pairs of them, and yield each once what was found is in the
    database. Raises UserError as `parallel.run` does."""
    with TemporaryDirectory(dir=database.parent) as folder:
        # The workers read a copy, since files that change can't be read safely over a network.
        copy = Path(folder) / database.name
        shutil.copyfile(database, copy)
        for chunk, rows in parallel.run(workers, _Share(step, copy), chunks, "cpu"):
            with closing(sqlite3.connect(database)) as db, db:
                _add(db, rows)
            yield chunk


@dataclass(frozen=True)
class _Share:
    """A worker's share of a step."""

    step: Step
    database: Path

    def __call__(self, device: str) -> Callable[[Sequence[Any]], Rows]:
        """Start a worker."""
        return self._found

    def _found(self, chunk: Sequence[Any]) -> Rows:
        """Do the step for a chunk in a new database, and return the rows that it adds."""
        pairs = not isinstance(chunk[0], str)
        with TemporaryDirectory() as folder:
            part = Path(folder) / "database.db"
            load_pycolmap().Database.open(part).close()
            address = f"{self.database.absolute().as_uri()}?immutable=1"
            with closing(sqlite3.connect(address, uri=True)) as whole:
                given = _read(whole, _OF_CAMERAS)
                if pairs:
                    names = {name for pair in chunk for name in pair}
                    given |= _read(whole, _OF_FEATURES, names)
            with closing(sqlite3.connect(part)) as db, db:
                _add(db, given)
            self.step(part, chunk, 1)
            with closing(sqlite3.connect(part)) as db:
                return _read(db, _OF_PAIRS if pairs else _OF_FEATURES)


def _read(db: sqlite3.Connection, tables: Sequence[str], names: Collection[str] | None = None) -> Rows:
    """Read tables, or their rows of the photos with these names."""
    if names is None:
        return {table: db.execute(f"select * from {table}").fetchall() for table in tables}
    numbers = [number for number, name in db.execute("select image_id, name from images") if name in names]
    wanted = ", ".join(map(str, numbers))
    read = "select * from {} where image_id in ({})"
    return {table: db.execute(read.format(table, wanted)).fetchall() for table in tables}


def _add(db: sqlite3.Connection, rows: Rows) -> None:
    """Add rows to tables, or replace those that an interrupted step left."""
    for table, added in rows.items():
        if added:
            db.executemany(f"insert or replace into {table} values ({', '.join('?' * len(added[0]))})", added)
