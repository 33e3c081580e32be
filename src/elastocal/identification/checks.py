"""Checks of a table beside a fit: is it of this robot, is every reading one of its own, is it
upright?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import linalg, special
from scipy.spatial.transform import Rotation

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, InsufficientDataError, option
from elastocal.measurements import Measurements, visits
from elastocal.model.chain import joint_limits
from elastocal.model.effects.placements import BaseFrame
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.text import did_you_mean, listed
from elastocal.units import Array, BoolArray, IntArray

# Does the table fit the robot?  Checked once, before anything is fitted.

# Readings and nominal arm may differ this much in extent (a long tool, few joints moving)
# before a wrong unit is the likelier cause.
EXTENT_FACTOR = 30.0
SMALL_ANGLE = np.radians(2 * np.pi)  # what a full turn in rad reads as in degrees
LIMIT_SLACK = np.radians(0.5)  # controllers overshoot soft limits by a little
SAME = 1e-9
SOME = 2**14  # readings that are enough to tell their unit


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
    if len(table) > SOME:  # some of many readings tell it as well
        table = table.take(np.linspace(0, len(table) - 1, SOME).astype(np.int64))
    reach = _reach(model, table)
    extent = float(np.linalg.norm(np.ptp(np.asarray(table.position), axis=0)))
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
    return float(np.linalg.norm(np.ptp(model.rigid.flange_poses(table)[:, :3, 3], axis=0)))


def fixed_and_free(model: Model, fixed: tuple[str, ...]) -> IntArray:
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
            f"{model.cell.path or model.cell.name}: nothing is left to identify; choose "
            f"effects with parameters in [model] effects, or hold fewer by {option('fixed')}"
        )
    return free


def ordinary(model: Model, free: IntArray) -> IntArray:
    """Those of the parameters `free` that no smooth function consists of.

    Raises InputError where there are none.
    """
    found = free[~model.shrunk[free]]
    if not len(found):
        raise InputError(
            "nothing but smooth functions is left to identify; add base_frame and "
            "marker_position to [model] effects, or free some parameters"
        )
    return found


def check_enough(model: Model, observed: Observations, scaled: Array) -> None:
    """Refuse when the equations are too few for the minimal set; `scaled`: B
    (rows, free) in typical sizes, or its R."""
    rows = len(observed.value)
    kept = linalg.qr(scaled, mode="r", pivoting=True)[0]
    diagonal = np.abs(np.diag(kept))
    rank = int((diagonal > 1e-7 * diagonal.max(initial=0.0)).sum())
    if rank < rows:
        return
    lacking = -(-(rank + 1) // observed.size)
    raise InsufficientDataError(
        f"{observed.table.source}: {rows} equations from {len(observed.lead)} readings cannot "
        f"determine the model's {scaled.shape[1]} parameters and their uncertainty; measure more "
        f"poses (more than {max(lacking, -(-scaled.shape[1] // observed.size))} readings) or fit "
        "fewer effects"
    )


# Readings that are copies of others.
#
# A repeat differs from its first reading by the noise.  It agrees to the last digit only where
# that is rounded more coarsely than the noise, and then more often in one coordinate than in all.

NO_FINER = 1e-7  # m; readings with more digits than this agree in all of them by no chance
ROUNDS = 20  # of the equation for P
COPIED = 0.01  # p-value below which equal readings are too many for rounding


def copied(observed: Observations) -> BoolArray:
    """Observations (N,) that repeat an earlier one to the last digit: joint values, load, marker
    and reading, whatever they are called.

    Where readings are rounded, those of one pose, load and marker that differ tell how often a
    coordinate agrees by rounding (with half a reading more of either kind): of pairs that differ
    somewhere, a share s_a = (p_a - P)/(1 - P) agrees in coordinate a, P the product of all p_a.
    Equal readings that are no more frequent than P explains are true repeats.
    """
    table, n = observed.table, len(observed.lead)
    value, own = observed.value.reshape(n, observed.size), observed.lead
    if observed.kind == "pose" and table.rotation is not None:  # its value has zeros there
        value = np.hstack([value[:, :3], table.rotation[own]])
    said = [table.q, table.force, table.marker[:, None]]
    said += [] if table.torque is None else [table.torque]
    found = np.zeros(n, dtype=bool)
    # Sorting whole rows takes long, and most tables have none to look at.
    ordered = np.sort(value[:, 0])
    alike = np.flatnonzero(np.isin(value[:, 0], ordered[1:][ordered[1:] == ordered[:-1]]))
    if not len(alike):
        return found
    key = np.column_stack(said)[own]
    _, first = np.unique(np.hstack([key[alike], value[alike]]), axis=0, return_index=True)
    found[np.delete(alike, first)] = True
    if not found.any():
        return found
    steps = value[:, :3] / NO_FINER
    if np.abs(steps - np.round(steps)).max() > 1e-3:
        return found
    _, start, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    others = np.flatnonzero(start[group] != np.arange(n))
    same = value[others] == value[start[group[others]]]
    differing = same[~same.all(axis=1)]
    partly = (differing.sum(axis=0) + 0.5) / (len(differing) + 1)
    share = 0.0
    for _ in range(ROUNDS):
        share = float(np.prod(partly * (1 - share) + share))
    # A reading with k others before it is like one of them with probability 1 - (1 - P)^k.
    before = np.arange(int(np.bincount(group).max()))
    alike_by_chance = np.cumsum(1 - (1 - share) ** before)[np.bincount(group) - 1]
    chance = special.gammainc(int(found.sum()), float(alike_by_chance.sum()))
    return found & bool(chance < COPIED)


# Markers that are no readings of their own: copies of another one, points of a solved body.

FEWEST_VISITS = 3  # in which two markers have to agree: two may by chance of a fixed arm
# Scatter of the distance of two markers (m) that no instrument is below which reads each for
# itself; software of motion capture moves a rigid body to all its markers and writes that.
SOLVED = 2e-6
CLEARLY_LESS = 10.0  # times the scatter, from which the readings' error is not that of the points


def without_copies(table: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """The table without markers that repeat another one's readings to the last digit, and a
    sentence for each."""
    if table.position is None or len(table.marker_names) < 2:
        return table, ()
    points, told = _by_visit(table), []
    copies: set[int] = set()
    for a, b in combinations(range(len(table.marker_names)), 2):
        both = np.isfinite(points[:, [a, b], 0]).all(axis=1)
        if a in copies or both.sum() < FEWEST_VISITS:
            continue
        if (points[both, a] == points[both, b]).all():
            copies.add(b)
            one, other = table.marker_names[a], table.marker_names[b]
            told.append(
                f"marker {other} has the readings of {one} in all {both.sum()} visits: it was left "
                f"out. Look for the column that was copied, and bring the readings of {other}"
            )
    if not copies:
        return table, ()
    return table.take(~np.isin(table.marker, list(copies))), tuple(told)


def solved_body(table: Measurements, error: float) -> str | None:
    """That three or more markers are points of one solved body, where they are; `error` (m) is the
    rms of a reading's residual per axis."""
    if table.position is None or len(table.marker_names) < 3:
        return None
    points = _by_visit(table)
    points = points[np.isfinite(points[:, :, 0]).sum(axis=1) >= 3]
    if len(points) < FEWEST_VISITS:
        return None
    pairs = np.array(list(combinations(range(points.shape[1]), 2)))
    apart = np.linalg.norm(points[:, pairs[:, 0]] - points[:, pairs[:, 1]], axis=2)
    used = np.isfinite(apart).sum(axis=0) >= FEWEST_VISITS
    if not used.any():
        return None
    scatter = float(np.sqrt(np.nanvar(apart[:, used], axis=0).max()))
    if scatter > SOLVED or error < CLEARLY_LESS * scatter:
        return None
    names = [table.marker_names[m] for m in np.unique(pairs[used])]
    within = max(scatter * 1e6, 0.01)
    return (
        f"markers {listed(names)} keep their distances to within {within:.2g} µm: they are "
        "points of one solved rigid body. A visit carries its pose, six independent "
        f"numbers and not {3 * len(names)}: import the body's pose and set [model] observe = "
        '"pose", or keep one marker'
    )


def _by_visit(table: Measurements) -> Array:
    """Positions (visits, markers, 3) of the first reading of each; NaN where there is none."""
    assert table.position is not None
    visit = visits(table)
    out = np.full((int(visit.max(initial=-1)) + 1, len(table.marker_names), 3), np.nan)
    out[visit[::-1], table.marker[::-1]] = table.position[::-1]
    return out


# Which way is down: whether the arm stands in the readings' frame as the cell says it does.

# Floors, pedestals and trackers are levelled to a degree; what is farther off is another frame.
FALLEN = np.radians(20.0)
AXES = ("x", "y", "z")


def as_placed(model: Model, x: Array) -> Cell:
    """The model's cell with the base turned as it is at x (parameters,)."""
    vector = [v for p, v in zip(model.parameters, x, strict=True)
              if p.effect == BaseFrame.name and p.unit == "rad"]  # fmt: skip
    if len(vector) != 3:
        return model.cell
    turned = Rotation.from_rotvec(vector).as_matrix()
    nominal = replace(model.cell.model.nominal, base_rotation=turned)
    return replace(model.cell, model=replace(model.cell.model, nominal=nominal))


@dataclass(frozen=True)
class Fallen:
    """An arm whose base lies `angle` rad from how the cell mounts it; `up` (3,) is the direction
    in the readings' frame that is up where it stands as the cell says."""

    angle: float
    up: Array

    @property
    def axis(self) -> str | None:
        """The axis that points up, "−y" say; None where none does within FALLEN."""
        k = int(np.argmax(np.abs(self.up)))
        near = np.arccos(min(abs(self.up[k]), 1.0)) <= FALLEN
        return ("−" if self.up[k] < 0 else "") + AXES[k] if near else None

    @property
    def turn(self) -> Array:
        """R (3, 3) from the readings' frame to one whose z is that axis."""
        k, eye = int(np.argmax(np.abs(self.up))), np.eye(3)
        if k == 2:  # at most half a turn about x
            return eye if self.up[k] > 0 else np.diag([1.0, -1.0, -1.0])
        axis, across = np.sign(self.up[k]) * eye[k], eye[(k + 1) % 3]
        return np.round(np.stack([across, np.cross(axis, across), axis]))

    def turned(self, table: Measurements) -> Measurements:
        """The table in that frame; forces stay, which are down by the cell's own word."""
        R, rotation, sigma = self.turn, table.rotation, table.sigma
        if rotation is not None:
            rotation = (Rotation.from_matrix(R) * Rotation.from_rotvec(rotation)).as_rotvec()
        if sigma is not None and table.sigma_frame == "cartesian":
            sigma = sigma @ np.abs(R).T
        position = None if table.position is None else table.position @ R.T
        return replace(table, position=position, rotation=rotation, sigma=sigma)

    def __str__(self) -> str:
        text = (
            f"the fitted base lies {np.degrees(self.angle):.0f}° from how the cell mounts it, and "
            "weights and loads act along −z of the readings' frame"
        )
        if self.axis is None:
            return f"{text}. State how the arm is mounted, [model.nominal] base_rpy_deg"
        # What the table's x, y, z would have to be: "x, −z, y".
        columns = ", ".join(("−" if row.sum() < 0 else "") + AXES[int(np.argmax(np.abs(row)))]
                            for row in self.turn)  # fmt: skip
        return (
            f"{text}. If it is mounted as stated, {self.axis} of that frame points up: write the "
            f"columns {columns} as x, y, z; else state [model.nominal] base_rpy_deg"
        )


def fallen(model: Model, x: Array) -> Fallen | None:
    """The arm at x (parameters,), where its base lies far from upright; None where it does not, or
    no base was fitted."""
    placed = as_placed(model, x)
    if placed is model.cell:
        return None
    stated, found = (c.model.nominal.base_rotation for c in (model.cell, placed))
    mounted = np.eye(3) if stated is None else np.asarray(stated)
    up = np.asarray(found) @ mounted.T[:, 2]
    angle = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    return Fallen(angle, up) if angle > FALLEN else None
