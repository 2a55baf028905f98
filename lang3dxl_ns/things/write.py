"""Files of things: a catalog with relations, a table, COCO instances, numbered outlines, and splats."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray as Array
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from lang3dxl_ns.common.files import make_folder, slugs, write_atomically
from lang3dxl_ns.files.glb import encode_glb
from lang3dxl_ns.files.splat_file import write_splats
from lang3dxl_ns.query.heat_maps import PROMPT_COLORS
from lang3dxl_ns.query.match import as_bytes, save_picture
from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.rendering import Rendering
from lang3dxl_ns.scene.camera import in_camera_frame
from lang3dxl_ns.things.find import Things, heights_of, up_of
from lang3dxl_ns.things.grammar import Sight, holds, sight_of
from lang3dxl_ns.things.thing import Thing

SIDES = {"left": "left_of", "right": "right_of", "above": "above", "below": "below"}
SIDES |= {"front": "in_front_of", "behind": "behind"}
"""Names in the catalog of the relations between neighbors."""
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))


def write_catalog(scene: Scene, answers: Sequence[Things], folder: Path) -> None:
    """Write things.json (boxes, sizes, scores, photos, and the scene graph: what is in what, and neighbors),
    things.csv and instances.json (COCO boxes in all photos)."""
    make_folder(folder)
    things = _each_once(answers)
    graph = _relations(things, sight_of(scene, things))
    words = [{"word": one.word, "count": len(one.things), "least": one.least, "most": one.most,
              "caution": one.caution, "things": [thing.id for thing in one.things]}
             for one in answers]  # fmt: skip
    place = scene.file.georeference
    meters = [None if place is None else (place.meters * t.size).round(2).tolist() for t in things]
    listed = [t.as_json() | {"meters": size} for t, size in zip(things, meters, strict=True)]
    (ground, top), up = heights_of(scene).tolist(), up_of(scene)
    unit = 1 / max(top - ground, 1e-9) if place is None else place.meters
    for thing, told in zip(things, listed, strict=True):
        told["above_ground"] = round(unit * (float(thing.center @ up) - ground), 3)
    content = {"words": words, "things": listed, "relations": graph, "heights": [ground, top]}
    content |= {"up": up.tolist(), "unit": None if place is None else asdict(place)}
    write_atomically(folder / "things.json", json.dumps(content, indent=1) + "\n")
    rows = io.StringIO()
    rows.write("id,word,score,views,x,y,z,width,depth,height,photo,width_m,depth_m,height_m\n")
    table = csv.writer(rows, lineterminator="\n")
    for thing, size in zip(things, meters, strict=True):
        seen = thing.sightings[0].photo if thing.sightings else ""
        numbers = [*thing.center.round(4).tolist(), *thing.size.round(4).tolist(), seen, *(size or [""] * 3)]
        table.writerow([thing.id, thing.word, round(thing.score, 3), thing.views, *numbers])
    write_atomically(folder / "things.csv", rows.getvalue())
    write_atomically(folder / "instances.json", json.dumps(coco(scene, answers)) + "\n")


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
    """Return the boxes of all things in all photos that show them, as COCO instances."""
    numbers = {photo.name: i + 1 for i, photo in enumerate(scene.photos)}
    images = [{"id": numbers[photo.name], "file_name": photo.name, "width": photo.camera.width,
               "height": photo.camera.height} for photo in scene.photos]  # fmt: skip
    categories = [{"id": i + 1, "name": one.word} for i, one in enumerate(answers)]
    boxes = [(i + 1, thing, sighting) for i, one in enumerate(answers) for thing in one.things
             for sighting in thing.sightings]  # fmt: skip
    labels = []
    for number, (category, thing, sighting) in enumerate(boxes, 1):
        left, top, right, bottom = sighting.box
        size = right - left, bottom - top
        labels.append({"id": number, "image_id": numbers[sighting.photo], "category_id": category,
                       "bbox": [left, top, *size], "area": size[0] * size[1], "iscrowd": 0,
                       "score": round(thing.score, 3), "thing": thing.id})  # fmt: skip
    return {"images": images, "categories": categories, "annotations": labels}


def write_picture(scene: Scene, answers: Sequence[Things], path: Path) -> None:
    """Draw numbered outlines on the rendering of the photo that shows most of the things."""
    names = [shown.photo for one in answers for thing in one.things for shown in thing.sightings]
    if names:
        photo = max(sorted(set(names)), key=names.count)
        camera = scene.file.photo(photo).camera
        view = scene.render(photo, 2 * max(camera.width, camera.height))
        save_picture(outlined(view.rendering, answers), path)


def outlined(rendering: Rendering, answers: Sequence[Things]) -> UInt8[Array, "h w 3"]:
    """Draw each thing's box in its word's color, numbered, unless it lies over its size behind the view."""
    picture, camera = Image.fromarray(as_bytes(rendering.rgb)), rendering.camera
    pen, lens, depth = ImageDraw.Draw(picture), camera.intrinsics.cpu().numpy(), rendering.depth.cpu().numpy()
    numbered = [(i, n, thing) for i, one in enumerate(answers) for n, thing in enumerate(one.things, 1)]
    for which, number, thing in numbered:
        places = np.vstack([thing.center, thing.center + (_CORNERS * thing.size) @ thing.axes])
        seen = in_camera_frame(camera, torch.from_numpy(places)).cpu().numpy()
        if seen[:, 2].min() < 1e-2 * thing.size.max():
            continue  # beside the camera or behind it
        pixels = (seen / seen[:, 2:]) @ lens[:2].T
        x, y = pixels[0].astype(int)
        inside = 0 <= x < camera.width and 0 <= y < camera.height
        if inside and seen[0, 2] < depth[y, x] + thing.size.max():
            around = pixels[1:][ConvexHull(pixels[1:], qhull_options="QJ").vertices]
            color = PROMPT_COLORS[which % len(PROMPT_COLORS)]
            pen.polygon(around.ravel().tolist(), outline=color, width=2)
            pen.text((x, y), str(number), color, anchor="mm", stroke_width=1, stroke_fill="white")
    return np.asarray(picture)


def write_things(scene: Scene, answers: Sequence[Things], folder: Path, look: str | None = None) -> int:
    """Write a splat file for each thing, named by word and id, and scene.glb with the ids of all as features;
    return how many things were written."""
    make_folder(folder)
    baked, things = scene.baked(look), _each_once(answers)
    write_atomically(folder / "scene.glb", encode_glb(baked, things=things, place=scene.file.georeference))
    words = dict(zip((one.word for one in answers), slugs([one.word for one in answers]), strict=True))
    for thing in things:
        rows = torch.from_numpy(np.sort(thing.rows)).to(scene.device)
        write_splats(folder / f"{words[thing.word]}-{thing.id}.ply", baked.select(rows))
    return len(things)


def _each_once(answers: Sequence[Things]) -> list[Thing]:
    first: dict[int, Thing] = {}
    for thing in (thing for one in answers for thing in one.things):
        first.setdefault(thing.id, thing)
    return list(first.values())
