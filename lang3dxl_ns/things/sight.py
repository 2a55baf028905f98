"""Left, right and ahead of the one who looks at things."""

from __future__ import annotations

import numpy as np

from lang3dxl_ns.query.scene import Scene
from lang3dxl_ns.things.find import up_of
from lang3dxl_ns.things.grammar import Sight
from lang3dxl_ns.things.thing import Thing


def sight_of(scene: Scene, things: list[Thing], photo: str | None = None) -> Sight:
    """Return the directions of a photo's viewer; by default of the photo that shows most of the things."""
    names = [sighting.photo for thing in things for sighting in thing.sightings]
    if photo is None and names:
        photo = max(sorted(set(names)), key=names.count)
    shown = scene.overview if photo is None else scene.file.photo(photo)
    up = up_of(scene)
    ahead = -np.array(shown.camera_to_world)[:, 2]
    ahead = ahead - up * (ahead @ up)
    ahead /= max(np.linalg.norm(ahead), 1e-9)
    return Sight(np.cross(ahead, up), up, ahead)
