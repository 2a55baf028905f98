"""Labels of the procedural landmark: parts, elements, and the six benchmark categories."""

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
    "clutter",  # lookalikes on the building that belong to no category: niches, chimneys
    "tree",
    "person",
    "car",
    "house",
    "lamp",
)
ELEMENTS = ("none", "window", "portal")
CATEGORIES = ("windows", "portals", "domes", "towers", "spires", "minarets")

SMALLEST_POSITIVE = 1e-3
"""Smallest share of a photo that an annotator would have outlined: 173 pixels of 480×360."""

BUILDING_PARTS = ("wall", "roof", "dome", "tower", "spire", "minaret", "column", "clutter")
"""Parts of the landmark itself, without its surroundings."""

PART = {name: index for index, name in enumerate(PARTS)}
ELEMENT = {name: index for index, name in enumerate(ELEMENTS)}


def category_masks(
    parts: UInt8[Array, "h w"], elements: UInt8[Array, "h w"]
) -> dict[str, Bool[Array, "h w"]]:
    """Compute the mask of each benchmark category, {category: mask}, empty masks included.

    Masks overlap. The mask of a part includes its windows and portals: a window in a tower counts for
    "windows" and for "towers", because an annotator who outlines a tower does not cut its windows out. Only
    the landmark's own windows and portals count. Those of surrounding houses have no element.
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
    """Compute the mask of the landmark itself, without sky, ground, houses, trees and passers-by."""
    first, last = PART[BUILDING_PARTS[0]], PART[BUILDING_PARTS[-1]]
    return (parts >= first) & (parts <= last)
