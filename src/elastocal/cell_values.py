"""Values of the cell file that need more than a unit: rotations, directions, lengths, names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from elastocal.cell_keys import header, place
from elastocal.errors import InputError, require
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import to_si

Array = NDArray[np.float64]


def rotation_from_rpy(rpy_deg: Sequence[float]) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(rpy_deg)), np.sin(np.radians(rpy_deg))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return about_z @ about_y @ about_x


def direction(path: Path, key: str, vector: Sequence[float]) -> Array:
    """A vector (3,) at unit length; raises InputError that names `key` where it is zero."""
    largest = np.abs(vector).max()
    require(largest > 0, f"{path}: key {key} is zero; give a direction, as in [0, 0, 1]")
    # First by the largest entry, whose square cannot overflow or vanish.
    scaled = np.array(vector) / largest
    return np.asarray(scaled / np.linalg.norm(scaled))


def vector(values: Sequence[float] | None) -> Array | None:
    """A list of numbers as an array, None as None."""
    return None if values is None else np.array(values, dtype=float)


def in_one_unit(
    path: Path,
    table: BaseModel,
    above: tuple[str | int, ...],
    stem: str,
    units: Mapping[str, str],
) -> tuple[Array, str] | None:
    """The SI value(s) and the suffix of the one key `stem`_suffix that is given, None for none.

    `units`: suffix → unit.  Raises InputError where two keys are given.
    """
    given = [unit for unit in units if getattr(table, f"{stem}_{unit}") is not None]
    if not given:
        return None
    if len(given) > 1:
        keys = " and ".join(place(*above, f"{stem}_{unit}") for unit in given)
        raise InputError(f"{path}: {keys} say the same in two units; keep one of them")
    value = np.array(getattr(table, f"{stem}_{given[0]}"), dtype=float)
    return to_si(value, units[given[0]]), given[0]


def check_markers(
    path: Path, above: tuple[str, ...], names: Iterable[str], markers: tuple[str, ...]
) -> None:
    """Raises InputError for the first of `names`, keys of the table `above`, that is no marker."""
    for name in names:
        require(
            name in markers,
            f"{path}: {header(above)} names {quoted(name)}, which is no marker of the cell"
            f"{did_you_mean(name, markers)}; [tool.markers_m] has {listed(markers) or 'none'}",
        )
