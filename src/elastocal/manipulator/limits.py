"""Joint limits: the robot's own, narrowed by the cell's."""

from __future__ import annotations

import numpy as np

from elastocal.cell import Array, Cell
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain


def joint_limits(cell: Cell, chain: Chain) -> tuple[Array, Array]:
    """Lower and upper joint limits (n,) in rad or m, infinite where there is none.

    Raises InputError where the cell limits a joint that the robot does not have, or leaves a
    joint no range at all.
    """
    lower = np.array([joint.lower for joint in chain.joints])
    upper = np.array([joint.upper for joint in chain.joints])
    for name, (low, high) in cell.limits.items():
        i = joint_index(cell, chain, name, "[limits]")
        lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
        if lower[i] >= upper[i]:
            raise InputError(
                f"{cell.path or cell.name}: [limits] {name} leaves no range inside the robot's "
                "own limits"
            )
    return lower, upper


def finite_ranges(
    chain: Chain, lower: Array, upper: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Ranges (n,) to draw joint values from: the limits, and where there are none, a turn (2 m
    for a prismatic joint) from the one limit, or about `near` (n,), by default about zero."""
    half = np.where([kind == "revolute" for kind in chain.kinds], np.pi, 1.0)
    centre = np.zeros(len(lower)) if near is None else near
    low = np.where(np.isfinite(upper), upper - 2 * half, centre - half)
    low = np.where(np.isfinite(lower), lower, low)
    return low, np.where(np.isfinite(upper), upper, low + 2 * half)


def joint_index(cell: Cell, chain: Chain, name: str, where: str) -> int:
    """0-based index of "jointN", which the table `where` of the cell names.

    Raises InputError where the robot has no such joint.
    """
    i = int(name.removeprefix("joint")) - 1
    if i >= chain.n_joints:
        raise InputError(
            f"{cell.path or cell.name}: {where} names {name}, but robot '{chain.name}' has "
            f"{chain.n_joints} joints"
        )
    return i
