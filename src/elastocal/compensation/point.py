"""Which point of the tool shall be at the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.cell import Array, Cell
from elastocal.errors import InputError, option
from elastocal.text import did_you_mean, listed


@dataclass(frozen=True)
class ToolPoint:
    """`place` (3,) m in the flange frame; with `marker`, the identified place of that marker."""

    place: Array
    marker: str | None
    told: str


def tool_point(cell: Cell, text: str | None) -> ToolPoint:
    """The point that `text` names: a marker, or "x,y,z" in m in the flange frame.

    Without a text the cell's `load_point_m`, or where that is not stated its only marker.
    Raises InputError for an unknown marker, and where the cell leaves the choice open.
    """
    markers = cell.tool.markers
    if text is None:
        if cell.tool.load_point.any():
            return ToolPoint(cell.tool.load_point, None, "load point")
        if len(markers) == 1:
            return _marker(cell, next(iter(markers)))
        raise InputError(
            f"{cell.path or cell.name}: which point of the tool shall be at the targets? Give "
            f"{option('point')} with a marker ({listed(markers)}) or with x,y,z in m in the flange "
            "frame, or state [tool] load_point_m"
        )
    if text in markers:
        return _marker(cell, text)
    parts = text.split(",")
    if len(parts) == 1:
        raise InputError(
            f"{option('point')}: '{text}' is no marker of the cell{did_you_mean(text, markers)}; "
            f"its markers: {listed(markers)}; or give x,y,z in m in the flange frame"
        )
    place = numbers(option("point"), text, (3,), "x,y,z in m in the flange frame")
    if np.abs(place).max() > 10:
        raise InputError(
            f"{option('point')}: '{text}' is more than 10 m from the flange; give x,y,z in m"
        )
    return ToolPoint(place, None, f"point {text} m in the flange frame")


def _marker(cell: Cell, name: str) -> ToolPoint:
    return ToolPoint(cell.tool.markers[name], name, f"marker {name}")


def numbers(option: str, text: str, counts: tuple[int, ...], what: str) -> Array:
    """The numbers of an option like "1,2,3"; InputError where they are others than `what`."""
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.full(1, np.nan)
    if len(values) not in counts or not np.isfinite(values).all():
        raise InputError(f"{option} takes {what}; found '{text}'")
    return values
