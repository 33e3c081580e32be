"""Positions from what a tracker reads: distance, azimuth, and zenith angle or elevation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.importing.records import Records
from elastocal.importing.units import convert
from elastocal.text import listed

Array = NDArray[np.float64]

HEIGHT = ("zenith", "elevation")
SPHERICAL = ("range", "azimuth", *HEIGHT)


def is_spherical(records: Records) -> bool:
    """Does the file give any spherical coordinate?"""
    return any(stem in records.numbers for stem in SPHERICAL)


def with_positions(records: Records, clockwise: bool = False) -> Records:
    """The records with x, y, z in the unit of the range, where the file has spherical coordinates.

    With range d, azimuth α and zenith angle ζ (π/2 − elevation), in a right-handed frame with z up
    and x at azimuth zero:

        x = d sin ζ cos α,   y = d sin ζ sin α,   z = d cos ζ

    α counts counterclockwise seen from above; where `clockwise`, as theodolites count, y has the
    other sign.  Readings in the second face, ζ beyond 180° with α turned by 180°, come out right.
    Raises InputError where a coordinate is missing, given twice, or beyond what can be read.
    """
    if not is_spherical(records):
        return records
    height = _height(records)
    numbers, units = dict(records.numbers), dict(records.units)
    d = numbers.pop("range")
    alpha = np.radians(convert(numbers.pop("azimuth"), units["azimuth"], "deg"))
    angle = convert(numbers.pop(height), units[height], "deg")
    _check(records, d, height, angle)
    zeta = np.radians(angle if height == "zenith" else 90.0 - angle)
    level = d * np.sin(zeta)
    y = level * np.sin(alpha)
    numbers |= {"x": level * np.cos(alpha), "y": -y if clockwise else y, "z": d * np.cos(zeta)}
    unit = units["range"]
    kept = {stem: u for stem, u in units.items() if stem not in SPHERICAL}
    return replace(records, numbers=numbers, units=kept | dict.fromkeys("xyz", unit))


def _height(records: Records) -> str:
    """Which of zenith and elevation the file has, all else being there too."""
    found = [stem for stem in SPHERICAL if stem in records.numbers]
    both = [stem for stem in "xyz" if stem in records.numbers]
    if both:
        raise InputError(
            f"{records.source}: positions are mapped twice, as {listed(both)} and as "
            f"{listed(found)}; keep one of the two in [source.columns]"
        )
    heights = [stem for stem in HEIGHT if stem in found]
    if len(heights) == 2:
        raise InputError(
            f"{records.source}: both zenith and elevation are mapped; keep the one that the file "
            "gives (a level line has zenith 90° and elevation 0°)"
        )
    missing = [stem for stem in ("range", "azimuth") if stem not in found]
    missing += [] if heights else ["zenith or elevation"]
    if missing:
        raise InputError(
            f"{records.source}: {listed(found)} without {listed(missing)}; map range_mm, "
            "azimuth_deg, and zenith_deg or elevation_deg in [source.columns]"
        )
    return heights[0]


def _check(records: Records, d: Array, height: str, angle: Array) -> None:
    """Refuse distances and angles that no tracker reads; `angle` (n,) in degrees."""
    if not (d > 0).all():
        i = int(np.argmin(d > 0))
        raise InputError(
            f"{records.where(i)}: a range of {d[i]:g} {records.units['range']}; a distance is "
            "positive: correct the line, or the column of range in [source.columns]"
        )
    low, high, other = (0.0, 360.0, "elevation") if height == "zenith" else (-90.0, 90.0, "zenith")
    off = (angle < low) | (angle > high)
    if off.any():
        i = int(np.argmax(off))
        raise InputError(
            f"{records.where(i)}: {height} of {angle[i]:.6g}°, which lies beyond {low:g}° to "
            f"{high:g}°; is it an angle of another unit, or {other}_{records.units[height]}?"
        )
