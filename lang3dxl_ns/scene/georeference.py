"""Meters, up and north of a scene, from the GPS positions that phones and drones write into photos.

Photos taken on foot lie nearly on a line or in a plane, and their altitudes are off by many meters. So up
comes from the cameras, and GPS gives what is left: scale and heading.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray as Array
from PIL import ExifTags

from lang3dxl_ns.common.checks import expect, is_coordinate
from lang3dxl_ns.common.pictures import NoPictureError, open_picture
from lang3dxl_ns.scene.frame import turned_to

LEAST_PHOTOS = 3
"""Number of photos that must agree on a position."""
GPS_ERROR = 5.0
"""Usual horizontal error of a phone's GPS in meters."""
LARGEST_UNCERTAINTY = 0.25
"""Relative uncertainty of the scale above which GPS tells nothing."""
_TAGS = ExifTags.GPS


@dataclass(frozen=True)
class Georeference:
    """Meters and directions of a scene's frame."""

    meters: float
    """Length of the frame's unit in meters."""
    up: tuple[float, float, float]
    """Unit vector in the frame."""
    north: tuple[float, float, float]
    """Unit vector in the frame, perpendicular to `up`."""
    uncertainty: float
    """Relative standard deviation of `meters`."""
    photos: int
    """Number of photos whose positions agree."""

    def __str__(self) -> str:
        size = f"1 unit is {self.meters:.3g} m ± {self.uncertainty:.0%}"
        return f"{size}, by the GPS positions of {self.photos} photos"


def georeference_from_json(content: dict[str, Any]) -> Georeference:
    """Build a georeference from a JSON object. Raises ValueError, KeyError or TypeError for anything else."""
    found = Georeference(**{**content, "up": tuple(content["up"]), "north": tuple(content["north"])})
    for number in (found.meters, found.uncertainty):
        expect(is_coordinate(number) and number > 0, f"its meters are {number!r}")
    for axis in (found.up, found.north):
        known = len(axis) == 3 and all(is_coordinate(value) for value in axis)
        expect(known and abs(math.hypot(*axis) - 1) < 1e-3, f"a direction is {axis!r}")
    expect(abs(np.dot(found.up, found.north)) < 1e-3, "its north points up")
    expect(isinstance(found.photos, int), f"it has GPS of {found.photos!r} photos")
    return found


def gps_position(photo: Path) -> tuple[float, float, float] | None:
    """Read a photo's latitude and longitude in degrees and altitude in meters (0 if unknown) from EXIF.
    The result is None if they are missing or impossible."""
    try:
        with open_picture(photo) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(tags[_TAGS.GPSLatitude], tags[_TAGS.GPSLatitudeRef], "S")
        longitude = _degrees(tags[_TAGS.GPSLongitude], tags[_TAGS.GPSLongitudeRef], "W")
        altitude = float(tags.get(_TAGS.GPSAltitude, 0.0))
        below = tags.get(_TAGS.GPSAltitudeRef, b"\0") in (b"\1", 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError, IndexError, OSError, NoPictureError):
        return None
    # Phones without reception write exact zeros, an island off Africa that nobody photographs.
    known = (latitude, longitude) != (0.0, 0.0) and abs(latitude) <= 90 and abs(longitude) <= 180
    altitude = -altitude if below else altitude
    return (latitude, longitude, altitude if np.isfinite(altitude) else 0.0) if known else None


def georeference(
    centers: Float64[Array, "n 3"],
    up: Float64[Array, "3"],
    positions: Sequence[tuple[float, float, float] | None],
) -> Georeference | None:
    """Find meters and north of a frame by a robust fit of its cameras to their GPS positions.

    The fit is the similarity of the plane (scale, heading, shift) on which most cameras are within 2.5 usual
    errors of GPS of their positions.

    Args:
        centers: camera centers in the scene's frame.
        up: direction of up in the same frame, of any length.
        positions: latitude and longitude in degrees and altitude in meters of each camera; None if unknown.

    Returns:
        The georeference; None if under three photos agree, or if they are so close together that the error of
        GPS leaves the scale uncertain by more than a quarter.
    """
    import cv2

    known = [i for i, position in enumerate(positions) if position is not None]
    if len(known) < LEAST_PHOTOS:
        return None
    east, north, unit_up = turned_to(up, (0, 0, 1))
    plan = (centers[known] - centers[known].mean(axis=0)) @ np.stack([east, north], axis=1)
    places = local_meters([p for p in positions if p is not None])[:, :2].copy()
    fit, chosen = cv2.estimateAffinePartial2D(plan, places, ransacReprojThreshold=2.5 * GPS_ERROR)
    if fit is None or np.count_nonzero(chosen) < LEAST_PHOTOS:
        return None
    agree, factor = chosen[:, 0] > 0, complex(fit[0, 0], fit[1, 0])
    rest = np.linalg.norm(places - plan @ fit[:, :2].T - fit[:, 2], axis=1)[agree]
    # Positions of a walk share some of their error, so a small residual doesn't make GPS exact.
    error = max(float(np.sqrt((rest**2).mean())), GPS_ERROR / 2)
    spread = places[agree] - places[agree].mean(axis=0)
    uncertainty = error / max(float(np.sqrt((spread**2).sum())), 1e-9)
    if uncertainty > LARGEST_UNCERTAINTY or factor == 0:
        return None
    heading = 1j / (factor / abs(factor))  # the plan's direction that points north
    axis = heading.real * east + heading.imag * north
    return Georeference(
        float(abs(factor)), tuple(unit_up.tolist()), tuple(axis.tolist()), uncertainty, int(agree.sum())
    )


def local_meters(positions: Iterable[tuple[float, float, float]]) -> Float64[Array, "n 3"]:
    """Convert latitudes and longitudes in degrees and altitudes in meters (WGS 84) to meters east, north and
    up of their median."""
    from lang3dxl_ns.scene.colmap import load_pycolmap

    degrees = np.array(list(positions), dtype=np.float64)
    middle = np.median(degrees, axis=0)
    if np.ptp(degrees[:, 1]) > 180:  # on both sides of the date line
        degrees[:, 1] %= 360
        middle = np.median(degrees, axis=0)
    pycolmap = load_pycolmap()
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    meters: Float64[Array, "n 3"] = earth.ellipsoid_to_enu(degrees, *middle)
    return meters


def _degrees(parts: Sequence[float], side: str, negative: str) -> float:
    whole, minutes, seconds = (float(part) for part in parts)
    value = whole + minutes / 60 + seconds / 3600
    if not np.isfinite(value):
        raise ValueError(f"{value} degrees")
    return -value if side == negative else value
