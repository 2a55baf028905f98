"""What a pixel of the procedural landmark shows: a part and an element, and the six benchmark categories."""

from __future__ import annotations

from jaxtyping import Bool, UInt8
from numpy import ndarray as Array

PARTS = (
    "sky",
    "ground",
    "wall",
    "roof",
    "dome",
    "tower",
    "spire",
    "minaret",
    "column",
    "clutter",  # on the building and like a category without being one: niches, chimneys
    "tree",
    "person",
    "car",
    "house",
    "lamp",
)
ELEMENTS = ("none", "window", "portal")
CATEGORIES = ("windows", "portals", "domes", "towers", "spires", "minarets")

SMALLEST_POSITIVE = 1e-3
"""Share of a photo: less of a category than this (173 pixels of 480×360) nobody would have outlined."""

BUILDING_PARTS = ("wall", "roof", "dome", "tower", "spire", "minaret", "column", "clutter")
"""The parts of the landmark itself; the rest is its surroundings."""

PART = {name: index for index, name in enumerate(PARTS)}
ELEMENT = {name: index for index, name in enumerate(ELEMENTS)}


def category_masks(
    parts: UInt8[Array, "h w"], elements: UInt8[Array, "h w"]
) -> dict[str, Bool[Array, "h w"]]:
    """Where each benchmark category is: {category: mask}, empty masks included.

    Masks overlap. The truth of a part includes the windows and portals on it: a window in a tower counts for
    "windows" and for "towers", as an annotator who outlines a tower doesn't cut its windows out. Windows and
    portals are the landmark's own; those of houses around it have no element.
    """
    return {
        "windows": elements == ELEMENT["window"],
        "portals": elements == ELEMENT["portal"],
        "domes": parts == PART["dome"],
        "towers": parts == PART["tower"],
        "spires": parts == PART["spire"],
        "minarets": parts == PART["minaret"],
    }


def building_mask(parts: UInt8[Array, "h w"]) -> Bool[Array, "h w"]:
    """Where the landmark itself is, without sky, ground, houses, trees and passers-by."""
    first, last = PART[BUILDING_PARTS[0]], PART[BUILDING_PARTS[-1]]
    return (parts >= first) & (parts <= last)
