"""The rules that a cell states, in the order of checking: cheap ones first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.design.feasibility.bodies import Body
from elastocal.design.feasibility.contact_rules import KeepApart, LineOfSight
from elastocal.design.feasibility.frames import Kinematics, Poses
from elastocal.design.feasibility.load import StaticTorque, rope_angle
from elastocal.design.feasibility.pairs import RULES, Pair
from elastocal.design.feasibility.rules import Bound, Rule
from elastocal.design.feasibility.sight import incidence, marker_positions
from elastocal.errors import InputError
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.limits import joint_limits

Array = NDArray[np.float64]


def rule_book(
    cell: Cell,
    chain: Chain,
    kinematics: Kinematics,
    bodies: Sequence[Body],
    pairs: Sequence[Pair],
) -> tuple[Rule, ...]:
    """All rules of the cell.  Raises InputError where they do not fit the robot."""
    return (
        _joints(cell, chain),
        *_seen(cell),
        *_load(cell, chain),
        *(
            KeepApart(rule, kinematics, own)
            for rule in RULES
            if (own := [pair for pair in pairs if pair.rule == rule])
        ),
        *_line_of_sight(cell, kinematics, bodies),
    )


def _joints(cell: Cell, chain: Chain) -> Rule:
    lower, upper = joint_limits(cell, chain)
    labels = tuple(f"joint{i + 1}" for i in range(chain.n_joints))
    units = tuple("°" if kind == "revolute" else "m" for kind in chain.kinds)
    return Bound("joint_limits", lambda p: p.q, lower, upper, labels, "a limit", units)


def _seen(cell: Cell) -> Iterator[Rule]:
    sight, eye = cell.workspace.visibility, cell.tracker.position
    if sight is None:
        return
    if not cell.tool.markers:
        raise InputError(
            f"{cell.path or cell.name}: [workspace.visibility] needs the markers; give "
            "[tool.markers_m]"
        )
    names, markers = tuple(cell.tool.markers), list(cell.tool.markers.values())
    near, far = sight.range

    def distance(poses: Poses) -> Array:
        return np.asarray(np.linalg.norm(marker_positions(poses, markers) - eye, axis=2))

    if near > 0 or np.isfinite(far):
        low, high = np.full(len(names), near), np.full(len(names), far)
        yield Bound("range", distance, low, high, names, "a range_m", ("m",))
    seen = tuple(name for name in names if name in sight.normals)
    if sight.max_incidence is not None and seen:
        at, axes = [cell.tool.markers[name] for name in seen], [sight.normals[n] for n in seen]
        low, high = np.zeros(len(seen)), np.full(len(seen), sight.max_incidence)
        yield Bound(
            "incidence", lambda p: incidence(p, at, axes, eye), low, high, seen,
            "a max_incidence_deg", ("°",),
        )  # fmt: skip


def _load(cell: Cell, chain: Chain) -> Iterator[Rule]:
    load = cell.workspace.load
    if load is not None and load.max_angle is not None and load.rope_axis is not None:
        axis = load.rope_axis

        def angle(poses: Poses) -> Array:
            return np.where(poses.loaded, rope_angle(poses, axis), 0.0)[:, None]

        low, high = np.zeros(1), np.array([load.max_angle])
        yield Bound("rope_angle", angle, low, high, ("the rope",), "a max_angle_deg", ("°",))
    if cell.workspace.torque_limits:
        bound = np.array(cell.workspace.torque_limits)
        if len(bound) != chain.n_joints:
            raise InputError(
                f"{cell.path or cell.name}: [workspace] torque_limits_Nm has {len(bound)} values, "
                f"but robot '{chain.name}' has {chain.n_joints} joints"
            )
        torque, labels = (
            StaticTorque(cell, chain),
            tuple(f"joint{i + 1}" for i in range(len(bound))),
        )
        yield Bound(
            "torque", lambda p: np.abs(torque(p)), np.zeros(len(bound)), bound, labels,
            "a torque_limits_Nm", ("N m",),
        )  # fmt: skip


def _line_of_sight(cell: Cell, kinematics: Kinematics, bodies: Sequence[Body]) -> Iterator[Rule]:
    sight = cell.workspace.visibility
    if sight is not None and sight.line_of_sight:
        yield LineOfSight(
            kinematics, bodies, cell.tracker.position, sight.beam_radius, cell.tool.markers
        )
