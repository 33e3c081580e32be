"""Correction tables: what a controller adds to its nominal targets, on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal import compensation as single
from elastocal.measurements import in_file_units, joint_columns
from elastocal.messages import listed, option, require, rounded
from elastocal.model import calibrated
from elastocal.model.calibrated import CalibratedArm, CalibratedTool, Conditions, ToolPoint, numbers
from elastocal.model.chain import check_posture, finite_ranges, joint_limits
from elastocal.model.effects.base import COLUMNS
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.rigid import Reaching, nominal_flanges
from elastocal.units import Array, BoolArray, pose_at

LEAST_STEP = 1e-9  # m between levels
MOST_POINTS = 200_000
BETWEEN = 512  # points between those of the grid, on which interpolation is measured
EXACT, FIRST_ORDER = "exact", "first order"
ASIDE = np.radians(30.0)  # or m: from a singular posture to one half as good as the best (sin 30°)
TRIED = 20  # points, at most
HELPS = 0.25  # of them, as other joints may stand at singular levels too
NOMINAL_MISS = 1e-5  # m


@dataclass(frozen=True)
class CorrectionGrid:
    """Levels of each joint (rad or m), or of x, y, z (m, base frame) with one `rotation` (3, 3) of
    the tool, None for any."""

    axes: tuple[Array, ...]
    joints: bool
    rotation: Array | None = None

    def points(self) -> Array:
        """(N, axes), neighbours one step apart, so that a posture can be followed through."""
        points = self.axes[0][:, None]
        for axis in self.axes[1:]:
            turns = [axis if i % 2 == 0 else axis[::-1] for i in range(len(points))]
            points = np.column_stack([np.repeat(points, len(axis), axis=0), np.concatenate(turns)])
        return points


@dataclass(frozen=True)
class CorrectionTable:
    """`correction` (N, 6) m and rad to add to nominal targets at grid `points` (N, axes), whose
    commands are `made`: position (dx, dy, dz) and rotation vector (drx, dry, drz) along the axes of
    the base frame, so that the target becomes p + d, exp([dr]×) R.  NaN where there is none;
    `status` (N,) says why, and which are EXACT or FIRST_ORDER.  `before` and `between` (M, 2) m and
    rad: errors of the tool at M points between the grid's, without the table and with the
    correction interpolated in it.  `warnings` are sentences."""

    grid: CorrectionGrid
    points: Array
    made: single.Compensation
    correction: Array
    status: tuple[str, ...]
    before: Array
    between: Array
    warnings: tuple[str, ...]


def _axes(low: Array, high: Array, counts: tuple[int, ...], what: str) -> tuple[Array, ...]:
    """`counts` levels (one number for all) from low to high (n,); of one level the middle."""
    n, told = len(low), ",".join(map(str, counts))
    fits = len(counts) in (1, n) and min(counts) >= 1
    require(fits, f"{option('grid')} takes {what}, 1 or more; found '{told}'")
    counts = counts * n if len(counts) == 1 else counts
    size = math.prod(counts)
    require(
        size <= MOST_POINTS,
        f"{option('grid', told)}: {size:,} points, and {MOST_POINTS:,} is the most; give fewer "
        "levels to the joints that matter least (1 holds one in the middle)",
    )
    return tuple(
        np.linspace(a, b, k) if k > 1 else np.array([(a + b) / 2])
        for a, b, k in zip(low, high, counts, strict=True)
    )


def correction_table(
    arm: CalibratedArm, grid: CorrectionGrid, point: ToolPoint, force: Array | None = None,
    near: Array | None = None, seed: int = 0,
    progress: Callable[[str], None] = lambda message: None, frame: single.Frame = "base",
) -> CorrectionTable:  # fmt: skip
    """The correction of every grid point under one `force` (3,) N, which stands in `frame`.  The
    command q_c that puts the calibrated tool at the nominal target is, for the controller's nominal
    arm, the target T_nominal(q_c): the correction is what lies between the two (EXACT).  Beside
    singular postures and limits, where q_c is far from the nominal command or beyond reach, it is
    the tool's error there with its sign changed (FIRST_ORDER)."""
    from scipy.interpolate import RegularGridInterpolator
    from scipy.stats import qmc

    kept, points = calibrated.lasting(arm)[0], grid.points()
    sided, tool = _sided(kept), CalibratedTool(kept, point)
    if force is not None and frame == "tracker":
        ((T, *_), _) = tool.frames(tool.rows(_targets(arm, grid, points[:1], None).table))
        force = T[:3, :3].T @ force
    progress(f"{len(points)} grid points")
    result = single.compensate(arm, _targets(arm, grid, points, force), point, near, seed, progress)
    correction, status = _corrections(tool, result)
    before = between = np.zeros((0, 2))
    if any(len(axis) > 1 for axis in grid.axes):
        progress("between the grid points")
        low, high = (np.array([axis[k] for axis in grid.axes]) for k in (0, -1))
        some = low + (high - low) * qmc.Sobol(len(low), scramble=True, seed=seed).random(BETWEEN)
        if not grid.joints:  # as a path, in the posture of the grid
            some = some[np.argsort(some[:, 0])]
            near = result.nominal[0]
        check = single.compensate(arm, _targets(arm, grid, some, force), point, near, seed)
        wide = [k for k, axis in enumerate(grid.axes) if len(axis) > 1]
        values = correction[np.lexsort(points.T[::-1])]
        values = values.reshape(*(len(grid.axes[k]) for k in wide), 6)
        follow = RegularGridInterpolator([grid.axes[k] for k in wide], values)
        before, between = _with_table(tool, check, follow(some[:, wide]))
    told = (*result.warnings, *sided)
    if status.count(EXACT) < len(status) / 2:
        told = (*told, _mostly_inexact(kept, grid, status, point, force, seed))
    without, with_it = (single.spread(off[:, 0])["rms"] or 0.0 for off in (before, between))
    if with_it > max(without, 1.0):  # µm
        worse = "between the grid points the tool is farther off with the table than without it"
        finer = f"give more levels by {option('grid')}, or narrow [limits]"
        told = (*told, f"{worse}; do not use it: {finer}")
    return CorrectionTable(grid, points, result, correction, status, before, between, told)


def _sided(arm: CalibratedArm) -> tuple[str, ...]:
    """That the direction of the last motion is left out, where it counts.  Raises InputError where
    an effect of the arm follows what else a table of corrections cannot know."""
    sided: tuple[str, ...] = ()
    for name, needs in calibrated.unstated_needs(arm, Conditions()).items():
        columns = listed(COLUMNS[need] for need in needs)
        told = f"{option('table')}: corrections hold at any time, and {name} follows {columns}"
        remedy = "give a table of targets with that column, or identify without the effect"
        require(not needs, f"{told}; {remedy}")
        if "approach" in CATALOGUE[name].needed(arm.model.cell):
            sided = ("the corrections are those between both directions of a joint's last motion",)
    return sided


def _mostly_inexact(
    arm: CalibratedArm, grid: CorrectionGrid, status: tuple[str, ...], point: ToolPoint,
    force: Array | None, seed: int,
) -> str:  # fmt: skip
    """Some of the points are tried again away from the joint limits, and then with one joint moved,
    to see what helps."""
    told = f"only {status.count(EXACT)} of {len(status)} grid points are exact: for most others "
    chain, beyond = arm.model.chain, "the command is out of the joint limits"
    if grid.joints:
        tool = CalibratedTool(arm, point)

        def exact(q: Array) -> BoolArray:
            tried = single.compensate(arm, _targets(arm, grid, q, force), point, None, seed)
            return np.array(_corrections(tool, tried)[1]) == EXACT

        some = np.flatnonzero([s != EXACT for s in status])
        low, high = finite_ranges(chain, *joint_limits(arm.model.cell, chain))
        aside = np.minimum(ASIDE, (high - low) / 4)
        inside = np.clip(grid.points()[some[:: -(-len(some) // TRIED)]], low + aside, high - aside)
        helped = exact(inside)
        if helped.mean() > 0.5:
            return f"{told}{beyond}, where the grid ends; first order is all there is"
        q, heads = inside[~helped], joint_columns(chain.kinds)
        levels = in_file_units(q[:1], chain.kinds)[0]
        singular = [
            heads[k] + (f" = {rounded(levels[k], 4)}" if len(axis) == 1 else "")
            for k, axis in enumerate(grid.axes)
            if exact(q + aside[k] * np.eye(len(heads))[k]).mean() > HELPS
        ]
        if singular:
            return (
                f"{told}the posture is singular by the levels of {listed(singular)}; give other "
                f"levels, for a joint in its middle 2 or more, by {option('grid')}"
            )
    most = f"{np.degrees(single.LARGE_CORRECTION):.0f}°"
    return (
        f"{told}{beyond}, or a joint would turn by more than {most}, as beside singular postures; "
        f"choose other levels by {option('grid')}"
    )


def _targets(
    arm: CalibratedArm, grid: CorrectionGrid, points: Array, force: Array | None
) -> single.Targets:
    n = len(points)
    turned = None if grid.rotation is None else np.tile(grid.rotation, (n, 1, 1))
    place, q = (None, points) if grid.joints else (points, None)
    targets = single.targets_at(option("table"), place, turned, "base", force, q)
    line = np.argsort(np.lexsort(points.T[::-1])) + 2  # of each in the file, below its header
    # In time the base alone may move, and the targets with it.
    side = np.zeros((n, arm.model.chain.n_joints))
    table = replace(targets.table, row=line, time=np.zeros(n), approach=side)
    return replace(targets, table=table, path=False)


def _corrections(
    tool: CalibratedTool, result: single.Compensation
) -> tuple[Array, tuple[str, ...]]:
    aimed = np.linalg.inv(result.T_data_base) @ result.goals
    nominal = nominal_flanges(tool.chain, result.q) @ result.T_flange_tool
    exact = _between(aimed, nominal, result.oriented)
    first_order = _between(_achieved(tool, result, result.nominal), aimed, result.oriented)
    step = np.abs(result.q - result.nominal).max(axis=1)
    close = result.reached & (step <= single.LARGE_CORRECTION)
    # A nominal command that misses its own target is none that a correction could start from.
    usable = np.isfinite(first_order).all(axis=1) & (result.nominal_miss <= NOMINAL_MISS)
    correction = np.where(close[:, None], exact, first_order)
    correction[~(close | usable)] = np.nan
    status = np.where(close, EXACT, np.where(usable, FIRST_ORDER, result.status))
    return correction, tuple(status.tolist())


def _achieved(tool: CalibratedTool, result: single.Compensation, q: Array) -> Array:
    """Where the tool is (n, 4, 4) in the base frame when commanded to q."""
    rows = tool.rows(result.targets.moved(q, result.force))
    return np.linalg.inv(result.T_data_base) @ pose_at(*tool.poses(rows, q))


def _between(one: Array, other: Array, oriented: bool) -> Array:
    """(n, 6) between poses (n, 4, 4): p' − p, and the rotation vector of R' Rᵀ if `oriented`."""
    turned = np.zeros((len(one), 3))
    if oriented:
        change = other[:, :3, :3] @ one[:, :3, :3].transpose(0, 2, 1)
        good = np.isfinite(change).all(axis=(1, 2))
        turned[good] = Rotation.from_matrix(change[good]).as_rotvec()
    return np.hstack([other[:, :3, 3] - one[:, :3, 3], turned])


def _with_table(
    tool: CalibratedTool, check: single.Compensation, correction: Array
) -> tuple[Array, Array]:
    """Errors (M, 2) of the tool at the nominal commands, and at those of the corrected targets."""
    aimed = np.linalg.inv(check.T_data_base) @ check.goals
    usable = np.isfinite(correction).all(axis=1) & (check.nominal_miss <= NOMINAL_MISS)
    known, flange = np.flatnonzero(usable), None
    moved = aimed[known, :3, 3] + correction[known, :3]
    if check.oriented:
        turned = Rotation.from_rotvec(correction[known, 3:]).as_matrix() @ aimed[known, :3, :3]
        flange = turned @ check.T_flange_tool[known, :3, :3].transpose(0, 2, 1)
    wide, place = np.full(tool.chain.n_joints, np.inf), check.T_flange_tool[0, :3, 3]
    controller = Reaching(tool.chain, moved, flange, place, None, -wide, wide)
    q = check.nominal.copy()
    q[known] = controller.solve(q[known], np.arange(len(known)))[0]
    off = (_between(_achieved(tool, check, joints), aimed, check.oriented)[known]
           for joints in (check.nominal, q))  # fmt: skip
    before, after = (np.linalg.norm(each.reshape(-1, 2, 3), axis=2) for each in off)
    return before, after


def posture_of(arm: CalibratedArm, text: str | None) -> Array | None:
    if text is None:
        return None
    chain, n = arm.model.chain, arm.model.chain.n_joints
    values = numbers(option("near"), text, (n,), f"{n} numbers, one per joint, in degrees (or mm)")
    values = values / in_file_units(np.ones(n), chain.kinds)
    check_posture(arm.model.cell, chain, option("near"), values, degrees=False)
    return values


def grid_of(
    arm: CalibratedArm, counts: tuple[int, ...], box: str | None, rotation: str | None
) -> CorrectionGrid:
    """Levels of each joint over its limits, or of x, y and z in a box."""
    chain = arm.model.chain
    if box is None:
        ends = finite_ranges(chain, *joint_limits(arm.model.cell, chain))
        what = f"one number, or one per joint ({chain.n_joints})"
        return CorrectionGrid(_axes(*ends, counts, what), True)
    corners = numbers(option("box"), box, (6,), "x0,y0,z0,x1,y1,z1 in mm in the base frame") / 1e3
    lower, upper = corners[:3], corners[3:]
    turned = None
    if rotation is not None:
        what = "a rotation vector rx,ry,rz in degrees"
        vector = numbers(option("rotation"), rotation, (3,), what)
        turned = Rotation.from_rotvec(np.radians(vector)).as_matrix()
    told = f"{option('box')} takes the lower corner first: x0,y0,z0,x1,y1,z1 with x0 <= x1 …"
    require(bool((lower <= upper).all()), told)
    axes = _axes(lower, upper, counts, "one number, or one each for x, y and z")
    flat = [name for name, axis in zip("xyz", axes, strict=True)
            if len(axis) > 1 and axis[-1] - axis[0] < LEAST_STEP * len(axis)]  # fmt: skip
    require(
        not flat,
        f"{option('box')}: both corners have the same {' and '.join(flat)}; give a box, or one "
        f"level there by {option('grid')}",
    )
    return CorrectionGrid(axes, False, turned)


def summary_and_csv(found: CorrectionTable, partial: bool) -> tuple[dict[str, Any], str]:
    """Refused where points are not reached and `partial` does not allow for that."""
    kinds, sure = found.made.chain.kinds, found.made.uncertainty
    heads, points = ["x_mm", "y_mm", "z_mm"], found.points * 1e3
    if found.grid.joints:
        heads, points = joint_columns(kinds), in_file_units(found.points, kinds)
    known = np.isfinite(found.correction).all(axis=1)
    # A grid point has no line in any file of the user's: it is named by where it lies.
    named = [f"({', '.join(f'{v:.5g}' for v in p + 0.0)})" for p in points]
    what = f"{option('table')}: %d of %d grid points ({', '.join(heads)})"
    box, near, rotation = (option(name) for name in ("box", "near", "rotation"))
    remedies = {
        "limit": f"joint limits prevent it: widen [limits], or give a smaller {box} or another "
        f"{near}",
        "not reached": f"out of reach, or beside a singular posture: give a smaller {box}, another "
        f"{rotation} or another {near}",
        "no equilibrium": f"no static equilibrium under this load: check {option('load')}",
    }
    if not partial:
        status = np.where(known, EXACT, found.status).tolist()
        single.check_status(what, named, status, EXACT, remedies)
    order = np.lexsort(found.points.T[::-1])
    moved, turned = found.correction[order, :3] * 1e3, np.degrees(found.correction[order, 3:])
    blocks = [(heads, points[order], ".9g"), (["dx_mm", "dy_mm", "dz_mm"], moved, ".7f")]
    if found.made.oriented:
        blocks.append((["drx_deg", "dry_deg", "drz_deg"], turned, ".7f"))
    content: dict[str, Any] = {
        "points": len(found.status),
        "exact": found.status.count(EXACT),
        "first_order": found.status.count(FIRST_ORDER),
        "levels": [len(axis) for axis in found.grid.axes],
        "checked_between": len(found.between),
        "error_without_um": single.spread(found.before[:, 0]),
        "error_with_um": single.spread(found.between[:, 0]),
        "std_um": single.spread(sure.std),
        "within95_um": single.spread(sure.within),
        "warnings": list(found.warnings),
    }
    if found.made.oriented:
        content["rotation_without_urad"] = single.spread(found.before[:, 1])
        content["rotation_with_urad"] = single.spread(found.between[:, 1])
    return content, single.table_csv(blocks, [found.status[i] for i in order])
