"""Commanded joints that put the real tool at its targets: targets, the nominal command of each, its
error, the command near it that undoes it; with uncertainty and notices, as files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from elastocal import measurements, messages
from elastocal.above import DataFrame, Result
from elastocal.identification.prediction import Uncertainty, uncertainty_at
from elastocal.identification.start import check_limits
from elastocal.measurements import Measurements, in_file_units, joint_columns, with_moves
from elastocal.messages import InputError, length, listed, option, plain, require, rounded, some
from elastocal.model import calibrated, rigid
from elastocal.model.calibrated import CalibratedArm, CalibratedTool, ToolPoint
from elastocal.model.chain import Chain, joint_index, joint_limits
from elastocal.model.manipulator import smooth_groups
from elastocal.model.rigid import BoundedSearch, Postures, Reaching, inverse_kinematics
from elastocal.tables import column, csv_text
from elastocal.units import Array, BoolArray, IntArray, pose_at

Frame = Literal["base", "tracker"]
FRAMES: tuple[Frame, ...] = ("base", "tracker")


def check_frame(frame: str) -> None:
    told = f"takes {' or '.join(FRAMES)}; found {messages.quoted(frame)}"
    require(frame in FRAMES, f"{option('frame')} {told}")


@dataclass(frozen=True)
class Targets:
    """n targets; `table` holds their force (n, 3) N and circumstances, one row each.  `position`
    (n, 3) m and `rotation` (n, 3, 3) of the tool, and the forces, stand in `frame`; rotation None:
    any.  `q` (n, joints) is the nominal command, None where it is to be found; without a position
    the tool is to be where the nominal arm has it at q.  The arm goes from row to row where they
    are a `path`; else nobody knows how it comes to each."""

    table: Measurements
    frame: Frame
    position: Array | None
    rotation: Array | None
    q: Array | None
    path: bool = True

    def __len__(self) -> int:
        return len(self.table)

    def moved(self, q: Array, force: Array) -> Measurements:
        """The table with its forces (n, 3) N and the arm's last move to each row at q (n, joints).
        Joints of which no move is known came from neither side."""
        table = replace(self.table, force=force)
        return with_moves(replace(table, q=q)).from_neither_side() if self.path else table


def read_targets(
    path: str | Path | DataFrame, joint_kinds: tuple[str, ...], frame: Frame,
    force: Array | None = None,
) -> Targets:  # fmt: skip
    """Targets of a CSV or Parquet file or a data frame whose columns are those of the measurement
    table: x_mm, y_mm, z_mm with rx_deg … or qw … where the rotation is prescribed, or q1_deg …
    alone, or both: joints are then the nominal command to start from.  force_x_N … and
    circumstances (time_s, approach_1, temperature_C, torque_1_Nm) as far as the model needs them;
    `force` (3,) N acts where the table states none."""
    table = measurements.read_measurements(path, joint_kinds=joint_kinds, observe="targets")
    q = table.q if table.q.shape[1] else None
    placed, turned = table.position is not None, table.rotation is not None
    extra = "; a rotation alone is no target" * (turned and q is None)
    for wrong, told in (
        (not placed and (turned or q is None),
         "the columns x_mm,y_mm,z_mm are missing; a target needs its position, or the nominal "
         f"command q1_deg … alone{extra}"),
        (not placed and frame != "base",
         "targets by q1_deg … alone are where the nominal arm has the tool, which stands in the "
         f"base frame; leave {option('frame', 'tracker')} away, or give x_mm,y_mm,z_mm"),
        (len(table.marker_names) > 1,
         f"targets of the markers {', '.join(table.marker_names[:4])} … in one table; the point of "
         f"the tool is chosen by {option('point')}: split the table by marker"),
        (force is not None and table.force.any(),
         f"the table has forces of its own; leave {option('load')} away or drop them"),
    ):  # fmt: skip
        require(not wrong, f"{table.source}: {told}")
    if force is not None:
        table = replace(table, force=np.tile(force, (len(table), 1)))
    turn = None if table.rotation is None else Rotation.from_rotvec(table.rotation).as_matrix()
    return Targets(table, frame, table.position, turn, q)


def one_target(text: str, frame: Frame, force: Array | None = None) -> Targets:
    """The target "x,y,z" in mm, or "x,y,z,rx,ry,rz" with a rotation vector in degrees."""
    what = "x,y,z in mm, or x,y,z,rx,ry,rz in mm and degrees (rotation vector)"
    values = calibrated.numbers(option("target"), text, (3, 6), what)
    vector = np.radians(values[None, 3:])
    rotation = Rotation.from_rotvec(vector).as_matrix() if vector.size else None
    return targets_at(option("target"), values[None, :3] / 1e3, rotation, frame, force)


def targets_at(
    source: str, position: Array | None, rotation: Array | None, frame: Frame,
    force: Array | None = None, q: Array | None = None,
) -> Targets:  # fmt: skip
    """Targets that no table states, all under one `force` (3,) N; errors name `source`."""
    n = next(len(given) for given in (position, q) if given is not None)
    table = Measurements.of_poses(source, np.zeros((n, 0)), np.zeros(3) if force is None else force)
    return Targets(table, frame, position, rotation, q)


STEP = 0.1  # rad or m between neighbours that count as one smooth piece
LARGE = np.radians(20.0)  # a step beyond which another posture may be nearer
LONGEST_PIECE = 256  # rows solved at once


def nominal_path(
    chain: Chain, position: Array, rotation: Array | None, point: Array,
    limits: tuple[Array, Array], near: Array | None, seed: int = 0,
) -> tuple[Array, BoolArray]:  # fmt: skip
    """Nominal joints (n, joints) that bring `point` (3,) of the flange to places (n, 3) m along a
    path, `rotation` (n, 3, 3) of the flange or None for any, in the base frame; and whether each is
    reached (n,): where not, the nearest posture stands there.  The first place is reached in the
    posture nearest to `near` (default: the middle of the joint ranges), every other from the one
    before it, so that neighbouring places have neighbouring joints.  Where that fails, or takes a
    large step, the nearest of many postures is taken."""
    n = len(position)
    q, reached = np.zeros((n, chain.n_joints)), np.zeros(n, dtype=bool)
    task = Reaching(chain, position, rotation, point, None, *limits)
    first, length, last, begun = 0, 1, near, 0
    ahead, leaps = None, 1  # postures of the places from `begun` on: leaps mostly come together
    while first < n:
        good = 0
        if first and last is not None:  # the next places, smoothly from the last posture
            rows = np.arange(first, min(first + length, n))
            found = task.solve(np.tile(last, (len(rows), 1)), rows)[0]
            errors = np.column_stack(task.errors(found, rows))
            steps = np.abs(np.diff(np.vstack([last, found]), axis=0)).max(axis=1)
            fits = (errors <= rigid.TOLERANCE).all(axis=1)
            fits &= steps <= np.where(rows == first, LARGE, STEP)
            good = len(rows) if fits.all() else int(np.argmin(fits))
            q[first : first + good], reached[first : first + good] = found[:good], True
            length = min(2 * length, LONGEST_PIECE) if good == len(rows) else max(good, 1)
        if not good:  # the place from anywhere
            if ahead is None or first >= begun + len(ahead.q):
                leaps = leaps if ahead is None else min(2 * leaps, LONGEST_PIECE)
                begun, some = first, slice(first, first + leaps)
                turned = None if rotation is None else rotation[some]
                ahead = inverse_kinematics(
                    chain, position[some], limits, rotation=turned, point=point, near=last,
                    seed=seed,
                )  # fmt: skip
            q[first], reached[first] = _nearest(task, chain, ahead, first - begun, first, last)
            good = 1
        first += good
        last = q[first - 1] if reached[first - 1] else last
    return q, reached


def _nearest(
    task: Reaching, chain: Chain, found: Postures, k: int, place: int, near: Array | None
) -> tuple[Array, bool]:
    q, good = found.q[k], found.reached[k]
    if near is None or not good.any():
        return q[0], bool(good[0])
    q = task.unwound(q[good], near)
    q = q[np.argmin(np.linalg.norm(q - near, axis=1))][None]
    if chain.n_joints > (6 if task.oriented else 3):  # joints leave a choice
        q = task.nearest(q, np.array([place]), near)
    return q[0], True


def jumps(task: Reaching, q: Array, usable: BoolArray) -> IntArray:
    """Rows (of the `usable`) whose joints leave those of the row before by much more than the
    tool's motion asks for: than the step of least norm J⁺r at either end; steps below 20° never
    count."""
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        return np.zeros(0, dtype=np.int64)
    before, after = rows[:-1], rows[1:]
    step = q[after] - q[before]
    asked = np.zeros(len(step))
    for ends, target in ((before, after), (after, before)):
        r, J = task.residual(q[ends], target)
        least = (np.linalg.pinv(J, rcond=1e-6) @ r[..., None])[..., 0]
        asked = np.maximum(asked, np.linalg.norm(least, axis=1))
    large = np.abs(step).max(axis=1) > LARGE
    return np.asarray(after[large & (np.linalg.norm(step, axis=1) > 3 * asked)])


TOLERANCE = 1e-8  # m and rad within which a target counts as reached


class Commanding(BoundedSearch):
    """r(q) of the calibrated tool against its goals (n, 4, 4), of which positions alone count
    unless `oriented`, searched within the joint limits.  Its steps have the least norm, so that
    from nominal commands, from which those wanted are a few milliradians away, an arm with more
    joints than the task has equations stays next to them."""

    def __init__(
        self, tool: CalibratedTool, rows: list[NDArray], goals: Array, oriented: bool,
        lower: Array, upper: Array,
    ) -> None:  # fmt: skip
        super().__init__(lower, upper)
        self.tool, self.rows, self.goals, self.oriented = tool, rows, goals, oriented

    def residual(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        rows, goals = [values[target] for values in self.rows], self.goals[target]
        rotation = goals[:, :3, :3] if self.oriented else None
        return self.tool.errors(rows, q, goals[:, :3, 3], rotation)

    def misses(self, q: Array, target: IntArray) -> Array:
        """Distance in m and angle in rad (R, 2) from the goals; NaN without an equilibrium."""
        r = self.residual(q, target)[0]
        turn = np.linalg.norm(r[:, 3:], axis=1) / rigid.ARM_LENGTH
        return np.column_stack([np.linalg.norm(r[:, :3], axis=1), turn])

    def commands(self, nominal: Array, target: IntArray) -> tuple[Array, Array]:
        q = self.solve(nominal, target)[0]
        return q, self.misses(q, target)


REACHED, LIMIT, NO_EQUILIBRIUM, NOT_REACHED = "reached", "limit", "no equilibrium", "not reached"


@dataclass(frozen=True, repr=False, eq=False)
class Compensation(Result):
    """Commands that put the tool at n targets.

    Attributes:
        q: The new commands (n, joints), in rad or m.
        nominal: The nominal ones (n, joints).
        before: Predicted distance (n,) in m of the tool from its target at the nominal command;
            NaN without a static equilibrium.
        after: The same at the new command.
        turn: (n, 2), the same two for the rotation, in rad.
        status: (n,), of "reached", "limit", "no equilibrium" and "not reached".
        uncertainty: Of the tool's position, NaN where a row is not reached.
        turn_uncertainty: Of its rotation where targets are `oriented`, else None.
        warnings: What to know before one runs the commands, in sentences.
        targets: The targets as given.
        point: The tool's point.
        goals: The tool's poses (n, 4, 4) in the data's frame, positions alone unless `oriented`.
        force: (n, 3) in N, in the data's frame.
        T_data_base, T_flange_tool: (n, 4, 4).
        nominal_miss: (n,) in m, how far the nominal arm is from the target at the nominal command.
        chain: The nominal chain.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv")
        >>> commands = ec.compensate(fit.arm, [1.8, 0.0, 0.9], load=[0, 0, -2600])
        >>> commands.q.shape, commands.status
        ((1, 6), ('reached',))
        >>> commands.save("commands.csv")
    """

    chain: Chain
    targets: Targets
    point: ToolPoint
    q: Array
    nominal: Array
    before: Array
    after: Array
    turn: Array
    status: tuple[str, ...]
    goals: Array
    oriented: bool
    force: Array
    T_data_base: Array
    T_flange_tool: Array
    nominal_miss: Array
    uncertainty: Uncertainty
    turn_uncertainty: Uncertainty | None
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"<Compensation {self.chain.name}: {int(self.reached.sum())} of {len(self)} targets "
            "reached>"
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def reached(self) -> BoolArray:
        return np.array([status == REACHED for status in self.status])


def compensate(
    arm: CalibratedArm, targets: Targets, point: ToolPoint, near: Array | None = None,
    seed: int = 0, progress: Callable[[str], None] = lambda message: None,
) -> Compensation:  # fmt: skip
    """Targets in the base frame are taken to the data's frame by the base frame as identified.  The
    nominal command is the table's, or the nominal arm's inverse kinematics along the path, the
    first place in the posture nearest to `near` (joints,).  The new command solves the calibrated
    model for the target within the joint limits, nearest to the nominal one where joints or a free
    rotation leave a choice."""
    arm, of_one_campaign = calibrated.lasting(arm)
    tool = CalibratedTool(arm, point)
    chain, limits = tool.chain, joint_limits(tool.cell, tool.chain)
    T, placed = tool.frames(tool.rows(targets.table))
    force, q = targets.table.force, targets.q
    if targets.position is not None:
        _check_unit(targets, targets.position, chain, T)
        goals, oriented = pose_at(targets.position, targets.rotation), targets.rotation is not None
    else:
        assert q is not None  # read_targets: positions or joints
        # Fewer than six joints cannot keep the rotation too.
        goals, oriented = rigid.nominal_flanges(chain, q) @ placed, chain.n_joints >= 6
    if targets.frame == "base":
        goals, force = T @ goals, np.einsum("nij,nj->ni", T[:, :3, :3], force)
    aimed = np.linalg.inv(T) @ goals
    flange = (aimed @ np.linalg.inv(placed))[:, :3, :3] if oriented else None
    position, place = aimed[:, :3, 3], placed[0, :3, 3]
    task = Reaching(chain, position, flange, place, None, *limits)
    if q is None:
        progress("nominal commands")
        nominal = nominal_path(chain, position, flange, place, limits, near, seed)[0]
    else:
        check_limits(arm.model, replace(targets.table, q=q))
        nominal = np.clip(q, *limits)
    progress("commands")
    every = np.arange(len(targets))
    rows = tool.rows(targets.moved(nominal, force))
    search = Commanding(tool, rows, goals, oriented, *limits)
    q, after = search.commands(nominal, every)
    lost = np.flatnonzero(~_is_reached(after))
    if targets.q is None and len(lost):
        progress(f"other postures for {len(lost)} points")
        turned = None if flange is None else flange[lost]
        others = inverse_kinematics(
            chain, position[lost], limits, rotation=turned, point=place, seed=seed
        )
        nominal[lost] = _other_postures(search, others.q, lost, nominal[lost])
        q[lost], after[lost] = search.commands(nominal[lost], lost)
    search.rows = tool.rows(targets.moved(q, force))
    if not all(map(np.array_equal, rows, search.rows)):  # moves of the commands themselves
        q, after = search.commands(q, every)
    before, reached = search.misses(nominal, every), _is_reached(after)
    progress("uncertainty")
    sure = _uncertainty(tool, search.rows, q, reached)
    of_turn = _uncertainty(tool, search.rows, q, reached, turns=True) if oriented else None
    result = Compensation(
        chain, targets, point, q, nominal, before[:, 0], after[:, 0],
        np.column_stack([before[:, 1], after[:, 1]]), _status(search, after, nominal), goals,
        oriented, force, T, placed, task.errors(nominal, every)[0], sure, of_turn, (),
    )  # fmt: skip
    told = [*arm.doubted, *_of_loads(arm, result), *_of_places(arm, result)]
    if targets.path or targets.q is None:  # not of a grid of joints
        # Joints alone say themselves how far to move.
        turned = jumps(task, q, reached & (targets.position is not None))
        told = [*_of_joints(result, limits, turned), *told]
    if of_one_campaign:
        told.append(
            f"The {listed(of_one_campaign, 4)} {'is' if len(of_one_campaign) == 1 else 'are'} of "
            "one campaign and no part of these commands."
        )
    return replace(result, warnings=tuple(told))


NOWHERE = 100.0  # of the reach nearer to the origin, or as many reaches away: no tool works there


def _check_unit(targets: Targets, position: Array, chain: Chain, T: Array) -> None:
    """Raise InputError where all targets lie at the origin of their frame or far beyond the arm,
    and 1000 times as far, or as near, within its reach (twice, for tool and a rail)."""
    reach, far = rigid.reach_of(chain), np.linalg.norm(position, axis=1)
    for out, factor, told in (
        (far < reach / NOWHERE, 1e3, "small; are they in m where mm are asked for?"),
        (far > reach * NOWHERE, 1e-3, "large; are they in mm where m are asked for?"),
    ):
        meant = factor * position
        if targets.frame == "tracker":
            meant = np.einsum("nji,nj->ni", T[:, :3, :3], meant - T[:, :3, 3])
        if far.any() and (out & (np.linalg.norm(meant, axis=1) < 2 * reach)).all():
            raise InputError(
                f"{targets.table.source}: wrong unit? All targets ({len(far)}) lie up to "
                f"{rounded(1e3 * far.max(), 4)} mm from the origin of the {targets.frame} frame, "
                f"and the arm reaches {rounded(1e3 * reach, 4)} mm: the numbers seem 1000 times "
                f"too {told}"
            )


def _is_reached(missed: Array) -> BoolArray:
    return np.asarray((missed <= TOLERANCE).all(axis=1))


def _other_postures(search: Commanding, q: Array, lost: IntArray, nominal: Array) -> Array:
    """Nominal commands (lost, joints) in one of the postures q (lost, K, joints) where the
    calibrated arm reaches the target from one: the nearest to the old command."""
    n, count, joints = q.shape
    missed = search.commands(q.reshape(n * count, joints), np.repeat(lost, count))[1]
    good = _is_reached(missed).reshape(n, count)
    far = np.linalg.norm(q - nominal[:, None], axis=2)
    chosen = q[np.arange(n), np.where(good, far, np.inf).argmin(axis=1)]
    return np.where(good.any(axis=1, keepdims=True), chosen, nominal)


def _status(search: Commanding, missed: Array, nominal: Array) -> tuple[str, ...]:
    reached, lost = _is_reached(missed), ~np.isfinite(missed[:, 0])
    status = np.where(reached, REACHED, np.where(lost, NO_EQUILIBRIUM, NOT_REACHED)).astype(object)
    left = np.flatnonzero(~reached & ~lost)
    if len(left):
        free = copy(search)
        free.lower, free.upper = np.tile([[-np.inf], [np.inf]], nominal.shape[1])
        status[left[_is_reached(free.commands(nominal[left], left)[1])]] = LIMIT
    return tuple(status)


def _uncertainty(
    tool: CalibratedTool, rows: list[NDArray], q: Array, reached: BoolArray, turns: bool = False
) -> Uncertainty:
    some = uncertainty_at(tool, [values[reached] for values in rows], q[reached], turns)
    at = np.where(reached, np.cumsum(reached) - 1, -1)  # -1: the row of NaN behind them
    known = some.covariance, some.total, some.unknown
    of_all = [np.concatenate([v, np.full((1, *v.shape[1:]), np.nan)])[at] for v in known]
    return Uncertainty(of_all[0], of_all[1], of_all[2], some.blamed)


# Of commands that are right but that somebody should look at.
AT_LIMIT = 1e-4  # rad or m; a controller stops before it
FAR = 0.05  # m: a nominal command this far from its target belongs to another frame or tool
LARGE_CORRECTION = np.radians(2.0)  # rad (or m) of a joint
LEVEL_SLACK = 0.01  # rad or m
WORTH_TELLING = 10e-6  # m or rad
UNLIKELY = 0.01  # probability, were the targets drawn as the poses measured


def _of_joints(c: Compensation, limits: tuple[Array, Array], jumps: IntArray) -> Iterator[str]:
    """What the joints of rows that are reached give reason to say; `jumps`: the rows at which the
    solution branch changes."""
    targets, q, kinds = c.targets, c.q, c.chain.kinds
    held = ((q <= limits[0] + AT_LIMIT) | (q >= limits[1] - AT_LIMIT)) & c.reached[:, None]
    for joint, at in enumerate(held.T, start=1):
        told = f"joint {joint} stands at its limit; the target is reached by the other joints"
        yield from _told(targets, at, told)
    for i in jumps[:1]:
        j = int(np.abs(q[i] - q[i - 1]).argmax())
        size = np.abs(q[i, j] - q[i - 1, j])
        by = f"{np.degrees(size):.0f}°" if kinds[j] == "revolute" else f"{size * 1e3:.0f} mm"
        yield (
            f"{_rows(targets, jumps)}: the solution branch changes (joint {j + 1} moves by {by} to "
            f"line {targets.table.row[i]}, much more than the tool's motion asks for); where the "
            "rows are a path, move it away from limits and singular postures, or give q1_deg … of "
            "one posture throughout"
        )
    change = np.abs(q - c.nominal)[:, c.chain.turning].max(axis=1, initial=0.0)
    large = c.reached & (change > LARGE_CORRECTION)
    most = np.degrees(change[large].max(initial=0.0))
    told = f"a joint is corrected by up to {most:.1f}°, as beside a singular posture; check that"
    yield from _told(targets, large, f"{told} the path may be moved there")
    if targets.q is not None and targets.position is not None:
        far = c.before > FAR
        most = c.before[far].max(initial=0.0) * 1e3
        told = f"the nominal command q1_deg … puts the tool up to {most:.0f} mm from its target;"
        remedy = f"check {option('frame')}, {option('point')} and units"
        yield from _told(targets, far, f"{told} {remedy}")


def _of_loads(arm: CalibratedArm, c: Compensation) -> Iterator[str]:
    spec, targets = arm.model.cell.model, c.targets
    acts = targets.table.force.any() or spec.link_gravity or spec.torque != "computed"
    if arm.elastic and not acts:
        yield (
            f"{targets.table.source}: no load is stated, so no compliance is compensated; where "
            f"the tool carries one, give {option('load')} or force_x_N, force_y_N, force_z_N"
        )
    if arm.model.observe == "deflection":
        told = "the readings are deflections: std_um and within95_um are of what the load moves the"
        yield f"{told} tool by; where the unloaded arm is, robot file and cell say"
    if told := arm.untried(targets.table.force):
        yield f"{targets.table.source}: {told}"
    where = "[model.compliance_levels], where the compliance of the nearest level is assumed"
    for name, values in spec.compliance_levels.items():
        angle = c.q[:, joint_index(name)]
        off = (angle < min(values) - LEVEL_SLACK) | (angle > max(values) + LEVEL_SLACK)
        yield from _told(targets, off & c.reached, f"{name} stands beyond its levels in {where}")


def _of_places(arm: CalibratedArm, c: Compensation) -> Iterator[str]:
    sure, turn, reached = c.uncertainty, c.turn_uncertainty, c.reached
    if (rms := _open(sure, reached)) is not None:
        yield (
            f"The data do not determine {listed(sure.blamed, 4)}, on which the place of "
            f"this point depends: typical deviations would move it by {length(rms)} rms, "
            "which within95_um counts and std_um leaves out; "
            + f"choose a marker that was fitted ({option('point')}), or " * (not c.point.marker)
            + "measure what is missing"
        )
    if turn is not None and (rms := _open(turn, reached)) is not None:
        yield (
            f"The data do not determine {listed(turn.blamed, 4)}, on which the tool's rotation "
            f"depends: typical deviations of them would turn it by {rounded(rms * 1e6)} µrad rms, "
            "which std_rotation_urad leaves out; where rotations matter, measure full poses or "
            "further markers"
        )
    known = np.isin(arm.model.names, arm.determined)
    for group in smooth_groups(arm.model):
        if not group.follows or group.whole_turn or not known[group.columns].any():
            continue
        angle = c.q[:, group.joint]
        out = reached & ((angle < group.low) | (angle > group.high))
        low, high = np.degrees([group.low, group.high])
        yield from _told(
            c.targets, out,
            f"{group.follows} stands outside {low:.1f}° to {high:.1f}°, where the {group.name} was "
            "measured; there it ends, the arm is that of the model without it, and the uncertainty "
            "grows to its whole size",
        )  # fmt: skip
    if (shown := arm.shown) is None or arm.model.observe == "distance":
        return
    far, n = reached & (sure.std > shown.most), int(reached.sum())
    if shown.chance(int(far.sum()), n) >= UNLIKELY:
        return
    surest = sure.std.copy()
    surest[far] = _std_of_markers(arm, c, far)
    outside = far & (surest > shown.most)
    outside &= shown.chance(int(outside.sum()), n) < UNLIKELY
    several = "these targets are" if outside.sum() > 1 else "this target is"
    there = f"{several} outside the measured poses", "measure poses there"
    if arm.model.observe == "deflection":
        more = f"identify without the geometry that they are to tell ({option('fix')})"
        there = "deflections hardly tell where the tool is", more
    for which, std, told, remedy in (
        (far & ~outside, sure.std, f"where the {c.point.told} lies on the tool is hardly known",
         f"measure a marker there, or choose a marker that was fitted ({option('point')})"),
        (outside, surest, *there),
    ):  # fmt: skip
        most, at_poses = length(std[which].max(initial=0.0)), length(shown.most)
        sizes = f"(standard deviation {most} at most, at measured poses {at_poses})"
        yield from _told(c.targets, which, f"{told} {sizes}; {remedy}")


def _open(sure: Uncertainty, reached: BoolArray) -> float | None:
    """Rms of what parameters left open would do, where it is more than all that is known of."""
    rms, known = (float(np.sqrt((v[reached] ** 2).sum() / max(reached.sum(), 1)))
                  for v in (sure.unknown, sure.std))  # fmt: skip
    return rms if rms > max(WORTH_TELLING, known) else None


MARKERS_ASKED = 3  # of those on one tool one is as good as another


def _std_of_markers(arm: CalibratedArm, c: Compensation, rows: BoolArray) -> Array:
    """Standard deviation (k,) in m at the given rows of the marker that is known best there: what
    the arm's pose alone leaves unknown."""
    found = np.full(int(rows.sum()), np.inf)
    for name in list(arm.model.cell.tool.markers)[:MARKERS_ASKED]:
        tool = CalibratedTool(arm, calibrated.tool_point(arm.model.cell, name))
        values = tool.rows(c.targets.moved(c.q, c.force))
        found = np.minimum(found, uncertainty_at(tool, [v[rows] for v in values], c.q[rows]).std)
    return found


def _told(targets: Targets, which: BoolArray, told: str) -> Iterator[str]:
    if which.any():
        yield f"{_rows(targets, np.flatnonzero(which))}: {told}"


def _rows(targets: Targets, rows: IntArray) -> str:
    """ "targets.csv, line 7 and 3 more"."""
    table = targets.table
    return some((f"{table.source}, line {table.row[row]}" for row in rows), 1)


SCHEMA = "elastocal/compensation/1"
DIGITS = 9  # of degrees and mm: 9e-12 rad and 5e-13 m
NAMED = 8  # rows that a message names


def check_reached(result: Compensation) -> None:
    table = result.targets.table
    rows, other = [f"line {line}" for line in table.row], f"another posture ({option('near')})"
    remedies = {
        "limit": f"joint limits prevent it: widen [limits], move the target, or start from {other}",
        "not reached": f"out of reach, or near a singular posture: move it, or start from {other}",
        "no equilibrium": "no static equilibrium under this load: check force_*_N",
    }
    check_status(f"{table.source}: %d of %d targets", rows, result.status, REACHED, remedies)


def check_status(
    what: str, rows: Sequence[str], status: Sequence[str], good: str, remedies: Mapping[str, str]
) -> None:
    lost = [(row, s) for row, s in zip(rows, status, strict=True) if s != good]
    if not lost:
        return
    # Why is told of each where the reasons differ.
    kinds = dict.fromkeys(s for _, s in lost)
    same = len(kinds) == 1
    named = some((row if same else f"{row} ({s})" for row, s in lost), NAMED)
    why = "; ".join(remedies[k] if same else f"{k}: {remedies[k]}" for k in kinds)
    others = f"; {option('partial', True)} writes the others" * (len(lost) < len(status))
    raise messages.InsufficientDataError(
        f"{what % (len(lost), len(status))} are not reached: {named}{': ' if same else '. '}{why}. "
        f"Nothing was written{others}"
    )


def commands_csv(result: Compensation) -> str:
    """One row per target, empty where it is not reached.  Forces stand in the data's frame, as in
    every plan, so that `simulate` can read the table."""
    held, kinds = np.where(result.reached[:, None], 1.0, np.nan), result.chain.kinds
    blocks = [(joint_columns(kinds), held * in_file_units(result.q, kinds), f".{DIGITS}f")]
    table = result.targets.table
    if result.force.any():
        blocks.append((["force_x_N", "force_y_N", "force_z_N"], result.force, ".9g"))
    for name in ("time", "approach", "temperature", "torque"):
        if (values := getattr(table, name)) is not None:
            units = measurements.families(kinds)[name].units
            heads = [column(stem, of[0]) for stem, of in units.items()]
            blocks.append((heads, values.reshape(len(table), -1), ".12g"))
    change = held * in_file_units(result.q - result.nominal, kinds)
    blocks.append((joint_columns(kinds, "correction_"), change, f".{DIGITS}f"))
    errors = np.column_stack([result.before, result.after]) * 1e6
    blocks.append((["error_before_um", "error_after_um"], errors, ".4g"))
    if result.oriented:
        heads = ["error_rotation_before_urad", "error_rotation_after_urad"]
        blocks.append((heads, result.turn * 1e6, ".4g"))
    sure = np.column_stack([result.uncertainty.std, result.uncertainty.within]) * 1e6
    blocks.append((["std_um", "within95_um"], sure, ".4g"))
    if (turn := result.turn_uncertainty) is not None:
        blocks.append((["std_rotation_urad"], turn.std[:, None] * 1e6, ".4g"))
    labels = [table.configuration_labels[code] for code in table.configuration]
    return table_csv(blocks, result.status, configuration=labels)


def table_csv(
    blocks: Sequence[tuple[list[str], Array, str]], status: Sequence[str], **texts: Sequence[str]
) -> str:
    """Columns of texts, of numbers (headers, values (n, headers), format; NaN is left empty), and
    the status."""
    header = [*texts, *(head for heads, _, _ in blocks for head in heads), "status"]
    rows = []
    for i, told in enumerate(status):
        both = [(value, form) for _, values, form in blocks for value in values[i]]
        cells = (format(v, f"z{form}") if np.isfinite(v) else "" for v, form in both)
        rows.append([*(text[i] for text in texts.values()), *cells, told])
    return csv_text(header, rows)


def summary(result: Compensation, commands: bool) -> dict[str, Any]:
    good, kinds = result.reached, result.chain.kinds
    names = joint_columns(kinds)
    change = in_file_units(result.q - result.nominal, kinds)
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "targets": result.targets.table.source,
        "frame": result.targets.frame,
        "point": result.point.told,
        "n": len(good),
        "reached": int(good.sum()),
        "error_before_um": spread(result.before[good]),
        "error_after_um": spread(result.after[good]),
        "std_um": spread(result.uncertainty.std[good]),
        "within95_um": spread(result.uncertainty.within[good]),
        "largest_correction": dict(
            zip(names, plain(np.abs(change[good]).max(axis=0, initial=-np.inf)), strict=True)
        ),
        "not_reached": [
            {"line": int(result.targets.table.row[i]), "status": result.status[i],
             "nearest_um": plain(result.after[i] * 1e6)}
            for i in np.flatnonzero(~good)
        ],
        "undetermined": list(result.uncertainty.blamed),
        "warnings": list(result.warnings),
    }  # fmt: skip
    if (turn := result.turn_uncertainty) is not None:
        content["std_rotation_urad"] = spread(turn.std[good])
    if commands:
        q = in_file_units(result.q, kinds)
        content["commands"] = [
            {"status": status}
            | (dict(zip(names, map(float, q[i]), strict=True)) if status == REACHED else {})
            for i, status in enumerate(result.status)
        ]
    return content


def spread(values: Array) -> dict[str, float | None]:
    """Of values in m (rad), in µm (µrad)."""
    known = values[np.isfinite(values)] * 1e6
    if not len(known):
        return dict.fromkeys(("rms", "p95", "max"))
    sizes = np.sqrt(np.mean(known**2)), np.quantile(known, 0.95), known.max()
    return dict(zip(("rms", "p95", "max"), map(float, sizes), strict=True))
