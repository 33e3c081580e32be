"""Where the calibrated arm puts its tool, as a function of the commanded joints."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.compensation.levels import share_of_levels
from elastocal.compensation.point import ToolPoint
from elastocal.compensation.total import Total
from elastocal.manipulator import rigid
from elastocal.manipulator.calibrated import CalibratedArm
from elastocal.manipulator.chain import Array
from elastocal.manipulator.inputs import row_inputs
from elastocal.manipulator.reaching import ARM_LENGTH
from elastocal.manipulator.symbolic import SymbolicArm
from elastocal.manipulator.tape import Tape
from elastocal.measurements import Measurements

LEVEL = "level:"


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
            q[:, int(name.removeprefix("joint")) - 1] = values[0]
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
        levels = self.cell.model.compliance_levels
        found = []
        for name, values in zip(self._symbolic.arm.inputs, rows, strict=True):
            if name == "q":
                values = q
            elif name.startswith(LEVEL):
                joint = name.removeprefix(LEVEL)
                i = int(joint.removeprefix("joint")) - 1
                values = share_of_levels(q[:, i], np.array(levels[joint]))
            found.append(values)
        return found

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
    def _markers(self) -> Total:
        own = self._symbolic.arm
        places = [rigid.point(own.T_tracker_flange, place) for place in own.markers.values()]
        return Total(self._symbolic, ca.vertcat(*places), self._symbolic.p)

    def marker_sensitivity(self, rows: list[NDArray], q: Array) -> Array:
        """(n, 3 markers, parameters) = d(all markers' positions)/dX in m per unit."""
        places, slope = self._markers(self._at(rows, q), self.x)
        slope[~np.isfinite(places).all(axis=1)] = np.nan
        return slope

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
    def _frames(self) -> Tape:
        own = self._symbolic.arm
        inputs = [*own.inputs.values(), self._symbolic.p]
        return Tape(inputs, [own.T_tracker_base, self._place, self._turn], self._symbolic.backend)

    def frames(self, rows: list[NDArray]) -> tuple[Array, Array, Array]:
        """T_tracker_base (n, 4, 4) as identified, with the drift that the rows' time asks for;
        the point (n, 3) m and the tool's rotation (n, 3, 3) in the flange frame."""
        n = len(rows[0])
        T, place, turn = self._frames(*rows, self.x)
        shape = (n, *T.shape[1:])
        return (
            np.broadcast_to(T, shape),
            np.broadcast_to(place[..., 0], (n, 3)),
            np.broadcast_to(turn, (n, 3, 3)),
        )
