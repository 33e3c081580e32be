"""What the symbolic arm asks of a table row, as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import InputError, option
from elastocal.manipulator.arm import Arm
from elastocal.measurements import Measurements

COLUMNS = {
    "q": "q1_deg …",
    "force": "force_x_N …",
    "torque": "torque_1_Nm …",
    "rotation": "rx_deg … or qw …",
    "time": "time_s or time_min",
    "approach": "approach_1 …",
    "temperature": "temperature_C",
}
# A row belongs to a level of a split joint when it is this close to it (rad or m).
LEVEL_TOLERANCE = 0.01


def row_inputs(arm: Arm, table: Measurements) -> list[NDArray]:
    """One (n, size) array per input the arm declared, in its order.

    Raises InputError where the table lacks a column, or a row lies at none of a joint's levels.
    """
    codes = _marker_codes(arm, table)
    return [_one(arm, table, name, codes) for name in arm.inputs]


def _one(arm: Arm, table: Measurements, name: str, marker: NDArray) -> NDArray:
    if name == "marker":
        return _one_hot(marker, len(arm.markers))
    if name.startswith("level:"):
        return _levels(arm, table, name.removeprefix("level:"))
    value = getattr(table, name)
    if value is None:
        raise InputError(
            f"{table.source}: the model needs the column {COLUMNS[name]}, which the table lacks"
        )
    return value[:, None] if value.ndim == 1 else value


def _one_hot(codes: NDArray, size: int) -> NDArray:
    return np.eye(size)[codes]


def _marker_codes(arm: Arm, table: Measurements) -> NDArray:
    known = {name: k for k, name in enumerate(arm.markers)}
    missing = [name for name in table.marker_names if name not in known]
    if missing:
        used = {table.marker_names[k] for k in np.unique(table.marker)}
        if used & set(missing):
            raise InputError(
                f"{table.source}: marker '{sorted(used & set(missing))[0]}' is not one of the "
                f"cell's markers: {', '.join(known)}"
            )
    return np.array([known.get(name, 0) for name in table.marker_names])[table.marker]


def _levels(arm: Arm, table: Measurements, joint: str) -> NDArray:
    levels = np.array(arm.cell.model.compliance_levels[joint])
    q = table.q[:, int(joint.removeprefix("joint")) - 1]
    distance = np.abs(q[:, None] - levels[None, :])
    nearest = distance.argmin(axis=1)
    off = distance.min(axis=1) > LEVEL_TOLERANCE
    if off.any():
        i = int(np.flatnonzero(off)[0])
        raise InputError(
            f"{table.source}, line {table.row[i]}: {joint} stands at {np.degrees(q[i]):.3f}°, "
            "which is none of its levels in [model.compliance_levels]; add the level or drop the "
            "row"
        )
    return _one_hot(nearest, len(levels))


def given_force(load: ArrayLike | None) -> NDArray[np.float64] | None:
    """The option `load` as a force (3,) in N, None where it is not given.

    Raises InputError unless it is three finite numbers.
    """
    if load is None:
        return None
    try:
        force = np.asarray(load, dtype=float)
    except (TypeError, ValueError):
        force = np.zeros(0)
    if force.shape != (3,) or not np.isfinite(force).all():
        found = " ".join(f"{v:g}" for v in force) if force.ndim == 1 and len(force) else load
        raise InputError(f"{option('load')} takes three finite numbers in N; found {found}")
    return force
