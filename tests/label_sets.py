"""Toy ground truth in each layout, for tests.

from label_sets import write_holyscenes, write_plain, write_labels
"""

import json

import numpy as np
from PIL import Image


def write_holyscenes(folder, category, number, mask, quality=75):
    """A mask black on white, as JPEG, and a copy of its photo."""
    (folder / category).mkdir(parents=True, exist_ok=True)
    gray = np.where(mask, np.uint8(0), np.uint8(255))
    Image.fromarray(gray).save(folder / category / f"{number}-gt.jpg", quality=quality)
    Image.fromarray(gray).save(folder / category / f"{number}-img.jpg")


def write_plain(folder, prompt, photo, mask):
    """A mask white on black."""
    path = folder / prompt / f"{photo}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask.astype(np.uint8) * 255).save(path)


def box_object(category, left, top, right, bottom):
    """An object that fills its box."""
    corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
    return {"category": category, "bbox": [left, top, right, bottom], "segmentation": corners}


def write_labels(folder, photo, objects, width=60, height=40, **changes):
    """Labels of a photo as LangSplat has them; `changes` replace parts of `info`."""
    folder.mkdir(parents=True, exist_ok=True)
    info = {"name": f"{photo}.jpg", "width": width, "height": height} | changes
    path = folder / f"{photo}.json"
    path.write_text(json.dumps({"info": info, "objects": objects}))
    return path
