"""Files of things: a catalog with relations, a table, COCO labels, numbered outlines, and splats."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import find_objects

from lang3dxl_ns.common.console import tracked
from lang3dxl_ns.common.files import slugs, write_atomically
from lang3dxl_ns.files.coco import OURS, CocoLabels
from lang3dxl_ns.files.glb import encode_glb
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.query.match import save_picture
from lang3dxl_ns.query.negatives import singulars
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.things.find import Things, heights_of, up_of
from lang3dxl_ns.things.grammar import Sight, best_photo, holds, sight_of
from lang3dxl_ns.things.outlines import held, numbered, outlined
from lang3dxl_ns.things.pieces import LEAST
from lang3dxl_ns.things.thing import Thing

SIDES = {"left": "left_of", "right": "right_of", "above": "above", "below": "below"}
SIDES |= {"front": "in_front_of", "behind": "behind"}
"""Names in the catalog of the relations between neighbors."""
COLUMNS = (
    *("number", "word", "id", "score", "views", "x", "y", "z", "width", "depth", "height"),
    *("photo", "width_m", "depth_m", "height_m"),
)
"""Columns of things.csv: center and size in world units, the best photo, and the size in meters if known."""


def each_word_once(answers: Sequence[Things]) -> list[Things]:
    """Leave out words that an earlier one is the plural or singular of: they name the same things."""
    forms = [{*singulars(one.word.lower())} for one in answers]
    return [one for k, one in enumerate(answers) if not any(forms[k] & other for other in forms[:k])]


def table(scene: Scene, answers: Sequence[Things]) -> list[str]:
    """Format a table of things: number, word, id, size, score and the photo that shows it best."""
    place = scene.file.georeference
    unit, scale = ("units", 1.0) if place is None else ("m", place.meters)
    rows = [("number", "word", "id", f"width × depth × height, {unit}", "score", "best photo")]
    for _, number, thing in numbered(answers):
        size = " × ".join(f"{side:.3g}" for side in scale * thing.size)
        rows.append((str(number), thing.word, str(thing.id), size, f"{thing.score:.2f}", thing.best_photo))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def write_catalog(scene: Scene, answers: Sequence[Things], folder: Path) -> None:
    """Write things.json (boxes, sizes, scores, photos, and the scene graph: what is in what, and neighbors),
    things.csv and instances.json (COCO labels of all photos)."""
    things, place, up = [thing for _, _, thing in numbered(answers)], scene.file.georeference, up_of(scene)
    graph = _relations(things, sight_of(scene, things))
    words = [{"word": one.word, "count": len(one.things), "least": one.least, "most": one.most,
              "caution": one.caution, "things": [thing.id for thing in one.things]}
             for one in answers]  # fmt: skip
    ground, top = heights_of(scene).tolist()
    unit = 1 / max(top - ground, 1e-9) if place is None else place.meters
    sizes = {one.name: np.divide(one.file_size, (one.lens.width, one.lens.height)) for one in scene.photos}
    zooms = {name: np.tile(zoom, 2) for name, zoom in sizes.items()}
    rows, listed = io.StringIO(), []
    lines = csv.writer(rows, lineterminator="\n")
    lines.writerow(COLUMNS)
    for _, number, thing in numbered(answers):
        meters = None if place is None else (place.meters * thing.size).round(2).tolist()
        above = round(unit * (float(thing.center @ up) - ground), 3)
        boxes = [np.rint(one.box * zooms[one.photo]).astype(int).tolist() for one in thing.sightings]
        seen = [{"photo": one.photo, "box": box} for one, box in zip(thing.sightings, boxes, strict=True)]
        more = {"meters": meters, "above_ground": above, "photos": seen}
        listed.append({"number": number, **thing.as_json(), **more})
        told = number, _cell(thing.word), thing.id, round(thing.score, 3), thing.views
        box = *thing.center.round(4).tolist(), *thing.size.round(4).tolist()
        lines.writerow([*told, *box, _cell(thing.best_photo), *(meters or [""] * 3)])
    content: dict[str, Any] = {"info": OURS, "words": words, "things": listed, "relations": graph}
    content |= {"heights": [ground, top], "up": up.tolist(), "unit": None if place is None else asdict(place)}
    write_atomically(folder / "things.json", json.dumps(content, indent=1) + "\n")
    write_atomically(folder / "things.csv", rows.getvalue())
    write_atomically(folder / "instances.json", json.dumps(coco(scene, answers)) + "\n")


def _cell(text: str) -> str:
    """Quote a text of which spreadsheets would make a formula: names may be a stranger's."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def _relations(things: Sequence[Thing], view: Sight) -> list[list[int | str]]:
    """List the smaller things that are in larger ones, and for each thing its nearest neighbor to the left,
    right, above, below, in front and behind, as that photo's viewer sees it that shows most of the things."""
    pairs = [(a, b) for a in things for b in things if a.size.prod() < b.size.prod()]
    inside = {(a.id, b.id) for a, b in pairs if holds(a, "in", b, view)}
    graph: list[list[int | str]] = [[a, "in", b] for a, b in sorted(inside)]
    for other in things:
        apart = [a for a in things if a.id != other.id and not {(a.id, other.id), (other.id, a.id)} & inside]
        near = sorted(apart, key=lambda thing: float(np.linalg.norm(thing.center - other.center)))
        for relation, name in SIDES.items():
            first = next((a for a in near if holds(a, relation, other, view)), None)
            graph += [[first.id, name, other.id]] if first else []
    return graph


def coco(scene: Scene, answers: Sequence[Things]) -> dict[str, Any]:
    """Label all things in all photos that show six pixels of them, in pixels of the photos' files, as COCO's
    content."""
    labels = CocoLabels([one.word for one in answers])
    for photo in tracked(scene.photos, "labels of photos"):
        labels.add_photo(photo.name, photo.file_size)
        maps = held(scene.splats, photo.camera, [one.things for one in answers])
        for category, (one, numbers) in enumerate(zip(answers, maps, strict=True), start=1):
            zoom = np.divide(photo.file_size[::-1], numbers.shape)
            places = find_objects(numbers, len(one.things))
            for number, (thing, place) in enumerate(zip(one.things, places, strict=True), start=1):
                if place is None or (mask := numbers[place] == number).sum() < LEAST:
                    continue
                ends = np.array([(side.start, side.stop) for side in place])
                (top, left), (bottom, right) = np.rint(zoom * ends.T).astype(int).tolist()
                part = Image.fromarray(mask).resize((right - left, bottom - top), Image.Resampling.NEAREST)
                where, told = (slice(top, bottom), slice(left, right)), {"thing": thing.id}
                labels.add_label(category, np.asarray(part), where, **told, score=round(thing.score, 3))
    return labels.content


def write_picture(scene: Scene, answers: Sequence[Things], path: Path) -> None:
    """Draw numbered outlines on the rendering of `best_photo`."""
    taken = best_photo(scene, [thing for _, _, thing in numbered(answers)])
    view = scene.render(taken.name, 2 * max(taken.camera.width, taken.camera.height))
    save_picture(outlined(scene.splats, answers, view.rendering), path)


def write_things(scene: Scene, answers: Sequence[Things], folder: Path) -> list[Path]:
    """Write a splat file for each thing, named by word and id, and scene.glb with the ids of all as features;
    return their paths, the latter's first."""
    baked, things = scene.baked(), [thing for _, _, thing in numbered(answers)]
    files = [folder / "scene.glb"]
    write_atomically(files[0], encode_glb(baked, things=things, place=scene.file.georeference))
    words = dict(zip((one.word for one in answers), slugs([one.word for one in answers]), strict=True))
    for thing in things:
        rows = torch.from_numpy(np.sort(thing.rows)).to(scene.device)
        files.append(folder / f"{words[thing.word]}-{thing.id}.ply")
        write_splats(files[-1], baked.select(rows))
    return files
