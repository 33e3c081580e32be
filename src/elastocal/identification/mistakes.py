"""Mistakes that are often made with a table of readings, found by undoing each.

Units, signs, swapped columns, shifted rows: whether the nominal arm, its base and markers fitted,
explains the readings at all, and what would have to be otherwise for it to do so.  A calibration
whose residuals no arm could have ends here, with the likely cause.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import special

from elastocal.cell.arm_description import ModelSpec, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InsufficientDataError
from elastocal.identification.start import RegistrationProblem, any_matrix, register
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
from elastocal.model.effects.base import index
from elastocal.model.effects.compliances import (
    RATED_WIND_UP,
    JointCompliance,
    rated_torque,
    weight_torque,
)
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray

FEWEST_POSES = 8  # base (6) and a marker (3) from fewer fit anything
POOR = 0.03  # m: no nominal arm is this wrong, wrong signs and units are far more
BETTER = 5.0  # a correction must reduce the error by this factor to be named
FARTHEST = 1e5  # m; beyond it no fit is worth its overflows, and plausibility speaks
SAMPLE = 80
CONFIRMED = 2  # corrections that are tried in earnest


@dataclass(frozen=True)
class NominalFit:
    """Median distance `error` (m) of the readings from the nominal arm with base and markers
    fitted; `warning` names what would make them fit, "" where they do; `mended`: a mistake undone
    makes them."""

    error: float
    warning: str
    mended: bool = False


def nominal_fit(
    chain: Chain, cell: Cell, table: Measurements, spherical: bool = False
) -> NominalFit | None:
    """How well readings fit the nominal arm, and which mistake undone would mend it; None where
    they hold no positions, too few poses, or numbers beyond all measure.

    `spherical`: positions were read as distance and angles, which invites mistakes of their own.
    """
    poses = len(np.unique(table.q, axis=0))
    if table.position is None or poses < FEWEST_POSES or np.abs(table.position).max() > FARTHEST:
        return None
    # The nominal arm without effects, its markers at the flange.
    tool = Tool(cell.tool.load_point, {name: np.zeros(3) for name in table.marker_names})
    rigid = Model.assembled(chain, replace(cell, tool=tool, model=ModelSpec()))
    light = np.flatnonzero(~np.any(table.force != 0, axis=1))
    rows = light if len(light) >= FEWEST_POSES else np.arange(len(table))
    if len(rows) > SAMPLE:
        rows = np.sort(np.random.default_rng(0).choice(rows, SAMPLE, replace=False))
    used = table.take(rows)
    error = _error(rigid, used)
    if error <= POOR:
        return NominalFit(error, "")
    # A registration takes time; the linear one, exact where the base is a rotation, chooses.
    guesses = sorted(
        _corrections(used, spherical), key=lambda guess: _linear_error(rigid, guess[1])
    )
    tried = [(_error(rigid, changed), words) for words, changed in guesses[:CONFIRMED]]
    best, words = min(tried, key=lambda t: t[0])
    said = f"the readings fit the nominal arm only to {error * 1e3:.3g} mm"
    if best < error / BETTER:
        told = f"{said}; {words} they would fit to {best * 1e3:.3g} mm"
        return NominalFit(error, told, best <= POOR)
    return NominalFit(
        error,
        f"{said}, and neither another unit, sign or coupling of a joint nor a shift by one pose "
        "mends that: check the robot of the cell, offsets of joints, and which joint values belong "
        "to which point",
    )


def _problem_of(model: Model, table: Measurements) -> RegistrationProblem:
    T = model.rigid.flange_poses(table)
    return RegistrationProblem(
        T[:, :3, :3], T[:, :3, 3], np.asarray(table.position), table.marker,
        np.zeros((len(table.marker_names), 3)), np.ones(len(table.marker_names), dtype=bool),
        True, np.eye(3), np.zeros(3),
    )  # fmt: skip


def _error(model: Model, table: Measurements) -> float:
    return register(_problem_of(model, table)).error


def _linear_error(model: Model, table: Measurements) -> float:
    """Rms of the registration by any matrix in the place of a rotation.

    Infinite where that is none at all: it mirrors, or its scale is off by a quarter.
    """
    matrix, left = any_matrix(_problem_of(model, table))
    return left if 0.75**3 < np.linalg.det(matrix) < 1.25**3 else np.inf


def _placed(model: Model, table: Measurements) -> bool:
    """Whether positions, if there are any, agree with the nominal arm at first sight."""
    if table.position is None or np.abs(table.position).max() > FARTHEST:
        return True
    return _linear_error(model, table.take(np.arange(min(len(table), SAMPLE)))) <= POOR


def _corrections(table: Measurements, spherical: bool) -> Iterator[tuple[str, Measurements]]:
    """Mistakes that are often made, each undone."""
    other = partial(replace, table)
    position = np.asarray(table.position)
    for factor, words in (
        (1e-3, "mm read as m"), (1e3, "m read as mm"), (25.4, "inches read as mm"),
        (1 / 25.4, "mm read as inches"),
    ):  # fmt: skip
        yield f"if positions were {words}", other(position=position * factor)
    # The base is fitted: every swap of two axes and every turned sign is the same mirror image.
    mirrored = position[:, [1, 0, 2]]
    if spherical:
        yield (
            "with azimuths counted the other way (azimuth = … in [[source]])",
            other(position=mirrored),
        )
        level = np.hypot(*position[:, :2].T)
        turned = np.where(level > 0, position[:, 2] / np.where(level > 0, level, 1.0), 0.0)
        yield (
            "with zenith angles read as elevations or the other way round",
            other(position=np.column_stack([position[:, :2] * turned[:, None], level])),
        )
    yield (
        "with two columns of the positions swapped, or the sign of one turned round (now they "
        "make a left-handed frame),",
        other(position=mirrored),
    )
    yield "if joints were degrees read as radians", other(q=np.radians(table.q))
    yield "if joints were radians read as degrees", other(q=np.degrees(table.q))
    n = table.q.shape[1]
    for j in range(n):
        q = table.q.copy()
        q[:, j] *= -1
        yield f"with the sign of joint {j + 1} turned round", other(q=q)
    for factor in (1.0, -1.0):
        if n >= 3:
            q = table.q.copy()
            q[:, 2] += factor * q[:, 1]
            yield f"with coupling {{ joint = 3, of = 2, factor = {factor:g} }}", other(q=q)
    for j in range(n):
        for degrees in (90, -90, 180):
            q = table.q.copy()
            q[:, j] += np.radians(degrees)
            yield f"with offset_deg {degrees} at joint {j + 1}", other(q=q)
    visit = np.cumsum(np.r_[0, np.any(np.diff(table.q, axis=0) != 0, axis=1)])
    poses = np.array([table.q[visit == v][0] for v in range(visit.max() + 1)])
    for shift, words in ((1, "earlier"), (-1, "later")):
        yield (
            f"with the joint values of one pose {words}",
            other(q=np.roll(poses, shift, axis=0)[visit]),
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


# Loads in another unit.
#
# Deflections tell compliance times load: loads that are too small by a factor make every
# compliance too large by it, without a trace in the residual.

KILOGRAMS = 9.80665  # N, the weight of one


def load_ratio(model: Model, known: dict[str, float]) -> tuple[float, str] | None:
    """Geometric mean of the joints' compliances over what they should be about, and by what;
    None where nothing says it.

    `known` (SI) are values by parameter name.  They should be those that the cell states, else
    what winds each revolute joint up by RATED_WIND_UP at its rated torque, by the links' weights.
    """
    given, rated = [], []
    for p in model.parameters:
        value = known.get(p.name, 0.0)
        if p.effect != JointCompliance.name or value <= 0:
            continue
        i = index(p.where)
        if p.nominal > 0:
            given.append(value / p.nominal)
        elif model.chain.kinds[i] == "revolute" and weight_torque(model.chain, i) > 0:
            torque = rated_torque(model.chain, model.cell, i)
            rated.append(value * (torque or 0.0) / RATED_WIND_UP)
    for ratios, by in ((given, CELL), (rated, WEIGHTS)):
        if ratios:
            return float(np.exp(np.mean(np.log(ratios)))), by
    return None


CELL, WEIGHTS = "the cell's nominal compliances", "the weights of the links"


# What no arm can be.

# Median of what a fitted model leaves, over the length of the arm.  Arms as they come from a
# factory err by a thousandth of it, those of hobbyists by a hundredth; wrong columns by a third.
POOREST = 0.05
LARGEST = 10.0  # a fitted length, over that of the arm and the distance of the readings


def refuse_nonsense(
    model: Model, observed: Observations, x: Array, residual: Array, every: Measurements
) -> None:
    """Raise InsufficientDataError, with the likely cause, where a fit is none of this robot.

    `x` (parameters,) and `residual` (N·size,) of the fit in SI units; `every` reading is looked at
    for the cause, since few may be left in `observed`.  Deflections are small whatever the mistake:
    there positions that a mistake undone makes fit are enough.
    """
    parts = residual.reshape(-1, observed.size)[:, :3]
    error = float(np.median(np.linalg.norm(parts, axis=1))) if len(parts) else 0.0
    frames = [*(joint.placement for joint in model.chain.joints), model.chain.flange_placement]
    table = observed.table
    sliding = np.array([joint.kind == "prismatic" for joint in model.chain.joints], dtype=bool)
    tool = max((np.linalg.norm(m) for m in model.cell.tool.markers.values()), default=0.0)
    length = float(sum(np.linalg.norm(frame[:3, 3]) for frame in frames) + tool)
    length += float(np.ptp(table.q[:, sliding], axis=0).sum()) if len(table) else 0.0
    far = 0.0 if table.position is None else float(np.abs(table.position).max())
    lengths = np.array([p.unit == "m" for p in model.parameters], dtype=bool)
    beyond = np.flatnonzero(lengths & ~(np.abs(x) <= LARGEST * (length + far)))
    sane = np.isfinite(error) and error <= POOREST * length and not len(beyond)
    if sane and (observed.kind != "deflection" or _placed(model, every)):
        return
    fit = nominal_fit(model.chain, model.cell, every)
    if sane:
        if fit is not None and fit.mended:
            raise InsufficientDataError(
                f"{table.source}: no deflections of this arm: {fit.warning}"
            )
        return
    what = f"after the fit the readings are {error:.3g} m (median) from the model"
    if len(beyond):
        k = int(beyond[0])
        what += f", whose {model.parameters[k].name} is {x[k]:.3g} m"
    cause = fit.warning if fit is not None and fit.warning else (
        "check the units and the order of the columns, which joint values belong to which point, "
        "and whether the cell describes this robot"
    )  # fmt: skip
    raise InsufficientDataError(
        f"{table.source}: {what}, which no arm of {length:.3g} m could be; {cause}"
    )
