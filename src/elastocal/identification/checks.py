"""Does the table fit the robot?  Checked once, before anything is fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import InputError, InsufficientDataError, option
from elastocal.manipulator.limits import joint_limits
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations
from elastocal.measurements import Measurements
from elastocal.text import did_you_mean

Array = NDArray[np.float64]

# Readings and nominal arm may differ this much in extent (a long tool, few joints moving)
# before a wrong unit is the likelier cause.
EXTENT_FACTOR = 30.0
SMALL_ANGLE = np.radians(2 * np.pi)  # what a full turn in rad reads as in degrees
LIMIT_SLACK = np.radians(0.5)  # controllers overshoot soft limits by a little
SAME = 1e-9
PIECE = 2**15  # rows whose flange poses are computed at a time


def check_table(model: Model, table: Measurements) -> None:
    """A table to fit: as any table, and more than one pose.

    Raises InputError that names file, line, joint and remedy; InsufficientDataError where all
    rows hold the same pose.
    """
    check_rows(model, table)
    if (table.q == table.q[:1]).all():
        raise InsufficientDataError(
            f"{table.source}: all {len(table)} rows hold the same pose; measure at different "
            "joint angles (at least as many poses as a third of the parameters)"
        )


def check_rows(model: Model, table: Measurements) -> None:
    """Any table: finite numbers, joint count, joint limits, units; InputError otherwise."""
    n = model.chain.n_joints
    if table.q.shape[1] != n:
        raise InputError(
            f"{table.source} has {table.q.shape[1]} joint columns, but robot "
            f"'{model.chain.name}' has {n} joints"
        )
    for name in ("q", "position", "rotation", "distance", "force", "torque", "sigma"):
        values = getattr(table, name)
        if values is not None and not np.isfinite(values).all():
            k = int(np.argwhere(~np.isfinite(values))[0][0])
            raise InputError(f"{table.source}, line {table.row[k]}: {name} is not finite")
    check_limits(model, table)
    _check_units(model, table)


def check_limits(model: Model, table: Measurements) -> None:
    """Joint values within the limits of robot and cell; InputError names line, joint and remedy."""
    revolute = np.array([k == "revolute" for k in model.chain.kinds])
    wound = np.abs(table.q[:, revolute]) > 4 * np.pi
    if wound.any():
        i = int(np.flatnonzero(wound.any(axis=1))[0])
        raise InputError(
            f"{table.source}, line {table.row[i]}: a joint stands at "
            f"{np.abs(table.q[i]).max():.4g} rad, more than two turns "
            f"({int(wound.any(axis=1).sum())} lines); these are probably degrees in a column "
            "named …_rad: rename it to …_deg"
        )
    lower, upper = joint_limits(model.cell, model.chain)
    beyond = (table.q < lower - LIMIT_SLACK) | (table.q > upper + LIMIT_SLACK)
    if beyond.any():
        i, j = (int(v) for v in np.argwhere(beyond)[0])
        unit, factor = ("°", 180 / np.pi) if revolute[j] else (" m", 1.0)
        share = beyond.any(axis=1).mean()
        hint = (
            "; most lines are beyond: probably degrees given as radians (or the reverse), or "
            "another robot"
            if share > 0.5
            else "; correct the line or the limits"
        )
        raise InputError(
            f"{table.source}, line {table.row[i]}: joint{j + 1} ({model.chain.joints[j].name}) at "
            f"{table.q[i, j] * factor:.4g}{unit} is beyond its limits "
            f"[{lower[j] * factor:.4g}, {upper[j] * factor:.4g}]{unit} "
            f"({int(beyond.any(axis=1).sum())} of {len(table)} lines){hint}"
        )


def _check_units(model: Model, table: Measurements) -> None:
    """Compare the extent of the readings with that of the nominal arm at the same joints."""
    if table.position is None:
        return
    reach = _reach(model, table)
    extent = float(np.linalg.norm(np.ptp(table.position, axis=0)))
    if reach < SAME or extent < SAME:
        return
    ratio = extent / reach
    if _looks_like_radians(model, table, ratio, extent):
        cause = "the joint angles are probably radians in columns named …_deg: rename to …_rad"
    elif ratio > EXTENT_FACTOR:
        cause = "the positions are probably millimetres in columns named …_m: rename to …_mm"
    elif ratio < 1 / EXTENT_FACTOR:
        cause = "the positions are probably metres in columns named …_mm: rename to …_m"
    else:
        return
    raise InputError(
        f"{table.source}: the readings extend over {extent * 1e3:.4g} mm, but the nominal arm's "
        f"flange moves over {reach * 1e3:.4g} mm at these joint values; {cause}"
    )


def _looks_like_radians(model: Model, table: Measurements, ratio: float, extent: float) -> bool:
    """Radians read as degrees: the arm hardly moves, and turned back it moves as measured."""
    if ratio < 3 or "prismatic" in model.chain.kinds or np.abs(table.q).max() > SMALL_ANGLE:
        return False
    return 1 / 3 < extent / _reach(model, replace(table, q=np.degrees(table.q))) < 3


def _reach(model: Model, table: Measurements) -> float:
    """Diagonal of the box in m that the nominal arm's flange moves in."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    # Poses are large and extrema are not: a piece of the table at a time.
    for start in range(0, len(table), PIECE):
        piece = table.take(np.arange(start, min(start + PIECE, len(table))))
        flange = model.rigid.flange_poses(piece)[:, :3, 3]
        low, high = np.minimum(low, flange.min(axis=0)), np.maximum(high, flange.max(axis=0))
    return float(np.linalg.norm(high - low))


def fixed_and_free(model: Model, fixed: tuple[str, ...]) -> NDArray[np.int64]:
    """Indices of the parameters to fit; `fixed` names parameters, places or effects to hold.

    Raises InputError for a name that is none of these, or when nothing is left.
    """
    held = set()
    for name in fixed:
        match = model.meant_by(name)
        if not match:
            raise InputError(
                f"{option('fixed', name)}: the model has no such parameter, place or effect"
                f"{did_you_mean(name, model.all_names)}"
            )
        held |= set(match)
    free = np.array([i for i in range(len(model.parameters)) if i not in held], dtype=np.int64)
    if not len(free):
        raise InputError(
            "nothing is left to identify: choose effects with parameters in [model] effects"
        )
    return free


def check_enough(model: Model, seen: Observations, scaled: Array) -> None:
    """Refuse when the equations are too few for the minimal set; `scaled`: B
    (rows, free) in typical sizes, or its R."""
    rows = len(seen.value)
    kept = linalg.qr(scaled, mode="r", pivoting=True)[0]
    diagonal = np.abs(np.diag(kept))
    rank = int((diagonal > 1e-7 * diagonal.max(initial=0.0)).sum())
    if rank < rows:
        return
    lacking = -(-(rank + 1) // seen.size)
    raise InsufficientDataError(
        f"{seen.table.source}: {rows} equations from {len(seen.lead)} readings cannot determine "
        f"the model's {scaled.shape[1]} parameters and their uncertainty; measure more poses "
        f"(more than {max(lacking, -(-scaled.shape[1] // seen.size))} readings) or fit fewer "
        "effects"
    )
