"""The tool: which point of it is meant, and where the calibrated arm puts it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, option
from elastocal.measurements import Measurements
from elastocal.model import rigid
from elastocal.model.arm import row_inputs
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.effects.base import index
from elastocal.model.evaluate import BatchFunction
from elastocal.model.inverse_kinematics import ARM_LENGTH
from elastocal.model.symbolic import SymbolicArm, Total
from elastocal.text import did_you_mean, listed
from elastocal.units import Array


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
            f"{cell.path or cell.name}: which point of the tool is to be at the targets? Give "
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


def share_of_levels(angle: Array, levels: Array) -> Array:
    """Shares (n, levels) of each level's compliance at joint values `angle` (n,), sum 1.

    Linear between neighbouring levels, the outermost one's beyond them.  A level stands for a
    gravity compensator's effect, which is a smooth function of the joint (Klimchik et al. 2013,
    section 5), so that neighbours say what lies between them.
    """
    order = np.argsort(levels)
    place = np.interp(angle, levels[order], np.arange(len(levels), dtype=float))
    low = np.minimum(place.astype(int), len(levels) - 1)
    high = np.minimum(low + 1, len(levels) - 1)
    share = np.zeros((len(angle), len(levels)))
    rows = np.arange(len(angle))
    share[rows, order[low]] += 1 - (place - low)
    share[rows, order[high]] += place - low
    return share


class CalibratedTool:
    """p(q) and R(q) of the tool's point in the data's frame, at the static equilibrium.

    `arm` is the calibrated arm, `point` the place on its tool.  What the instrument itself
    distorts (`tracker_distortion`) is no part of where the tool is.
    """

    def __init__(self, arm: CalibratedArm, point: ToolPoint) -> None:
        self.calibrated, self.point = arm, point
        self.chain, self.cell = arm.model.chain, arm.model.cell
        self.x = arm.x
        self._symbolic = SymbolicArm(self.chain, self.cell)
        own = self._symbolic.arm
        if point.marker is None:
            place, turn = rigid.constant(point.place), ca.SX.eye(3)
        else:
            place, turn = own.markers[point.marker], own.marker_rotation[point.marker]
        self._place, self._turn = place, turn
        self._position = rigid.point(own.T_tracker_flange, place)
        self._rotation = own.T_tracker_flange[:3, :3] @ turn

    def rows(self, table: Measurements) -> list[NDArray]:
        """What the model asks of the table's rows, one array per input; joints are put in later.

        Raises InputError where the table lacks a column that the model needs.
        """
        n = len(table)
        levels = self.cell.model.compliance_levels
        q = np.zeros((n, self.chain.n_joints))
        for name, values in levels.items():
            # Any level will do here: `_at` says how the commanded joint stands between them.
            q[:, index(name)] = values[0]
        names = tuple(self._symbolic.arm.markers)
        bare = replace(
            table,
            q=q,
            marker=np.zeros(n, dtype=np.int64),
            marker_names=names[:1],
            rotation=np.zeros((n, 3)),
            position=None,
        )
        return row_inputs(self._symbolic.arm, bare)

    def _at(self, rows: list[NDArray], q: Array) -> list[NDArray]:
        """The rows at commanded joints q (n, joints)."""
        found = dict(zip(self._symbolic.arm.inputs, rows, strict=True)) | {"q": q}
        for joint, levels in self.cell.model.compliance_levels.items():
            if f"level:{joint}" in found:
                found[f"level:{joint}"] = share_of_levels(q[:, index(joint)], np.array(levels))
        return list(found.values())

    @cached_property
    def _pose(self) -> Total:
        y = ca.vertcat(self._position, ca.vec(self._rotation))
        return Total(self._symbolic, y, ca.SX.zeros(0, 1))

    def poses(self, rows: list[NDArray], q: Array) -> tuple[Array, Array]:
        """Position (n, 3) m and rotation (n, 3, 3) of the tool; NaN without an equilibrium."""
        y = self._pose(self._at(rows, q), self.x)[0]
        return y[:, :3], y[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)

    @cached_property
    def _sensitivity(self) -> Total:
        return Total(self._symbolic, self._position, self._symbolic.p)

    def sensitivity(self, rows: list[NDArray], q: Array) -> Array:
        """A (n, 3, parameters) = d(position)/dX in m per unit, at commanded joints q."""
        return self._sensitivity(self._at(rows, q), self.x)[1]

    @cached_property
    def _errors(self) -> dict[bool, Total]:
        goal, turned = ca.SX.sym("goal", 3), ca.SX.sym("turned", 9)
        r = self._position - goal
        tilt = rigid.vector_from_rotation(ca.reshape(turned, 3, 3).T @ self._rotation)
        q = self._symbolic.arm.q_commanded
        return {
            False: Total(self._symbolic, r, q, (goal,)),
            True: Total(self._symbolic, ca.vertcat(r, ARM_LENGTH * tilt), q, (goal, turned)),
        }

    def errors(
        self, rows: list[NDArray], q: Array, position: Array, rotation: Array | None
    ) -> tuple[Array, Array]:
        """r (n, 3 or 6) in m and dr/dq: p(q) − p*, and rotation vector of R*ᵀR(q) × ARM_LENGTH.

        `position` (n, 3) m and `rotation` (n, 3, 3), or None for any, are in the data's frame.
        """
        extra = [position]
        if rotation is not None:
            extra.append(rotation.transpose(0, 2, 1).reshape(-1, 9))
        return self._errors[rotation is not None](self._at(rows, q), self.x, extra)

    @cached_property
    def _frames(self) -> BatchFunction:
        own = self._symbolic.arm
        inputs = [*own.inputs.values(), self._symbolic.p]
        return BatchFunction(
            inputs, [own.T_tracker_base, self._place, self._turn], self._symbolic.backend
        )

    def frames(self, rows: list[NDArray]) -> tuple[Array, Array, Array]:
        """T_tracker_base (n, 4, 4) as identified, with the drift that the rows' time asks for;
        the point (n, 3) m and the tool's rotation (n, 3, 3) in the flange frame."""
        T, place, turn = self._frames(*rows, self.x)
        return T, place[..., 0], turn
