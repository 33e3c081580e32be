"""Mistakes that are often made with a table of readings, found by undoing each.

Units, signs, swapped columns, shifted rows: whether the nominal arm, its base and markers fitted,
explains the readings at all, and what would have to be otherwise for it to do so.  A calibration
whose residuals no arm could have ends here, with the likely cause.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from elastocal.cell.arm_description import ModelSpec, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InsufficientDataError
from elastocal.identification.far_values import SCALED
from elastocal.identification.joint_maps import LinearFits, joint_maps, linear_fits
from elastocal.identification.shifted_rows import Slipped, slipped
from elastocal.identification.start import nominal_problem, register
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
from elastocal.model.rigid import nominal_flanges
from elastocal.text import listed
from elastocal.units import Array, BoolArray

FEWEST_POSES = 8  # base (6) and a marker (3) from fewer fit anything
POOR = 0.03  # m: no nominal arm is this wrong, wrong signs and units are far more
MOST = 80  # % of the readings, which what they fit to is told of
BETTER = 5.0  # a correction must reduce the error by this factor to be named
FARTHEST = 1e5  # m; beyond it no fit is worth its overflows, and plausibility speaks
SAMPLE = 80
CONFIRMED = 6  # corrections that are tried in earnest
UNITS = ((1e-3, "mm read as m"), (1e3, "m read as mm"), (25.4, "inches read as mm"),
         (1 / 25.4, "mm read as inches"))  # fmt: skip
OF_A_UNIT = 0.25  # a unit in the place of another is told from the arm's length to a quarter


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
    error, far = _errors(rigid, used)
    if far <= POOR:
        return NominalFit(error, "")
    said = f"the readings fit the nominal arm only to {far * 1e3:.3g} mm"
    tried = [(_errors(rigid, changed)[1], words)
             for words, changed in _corrections(chain, used, spherical)]  # fmt: skip
    # The simplest that mends it, else what does most.
    best, words = next((t for t in tried if t[0] <= POOR), min(tried, default=(far, "")))
    if best < far / BETTER:
        return NominalFit(error, f"{said}; {words} they would fit to {best * 1e3:.3g} mm",
                          best <= POOR)  # fmt: skip
    found = slipped(chain, table, lambda some: register(nominal_problem(rigid, some)))
    if found is not None:
        return NominalFit(error, f"{said}; {_slipped_words(table, found)}", True)
    return NominalFit(
        error,
        f"{said}, and neither another unit or scale, signs, couplings, offsets or an exchange of "
        "columns, one or two of them, nor rows that have shifted mend that: check the robot of the "
        "cell, offsets of joints, and which joint values belong to which point",
    )


def _errors(model: Model, table: Measurements) -> tuple[float, float]:
    """Distance (m) from the nominal arm that half of the readings keep to, and that MOST do."""
    problem = nominal_problem(model, table)
    found = register(problem)
    place = found.places(problem.flange_rotation, problem.flange_position, table.marker)
    distance = np.linalg.norm(problem.points - place, axis=1)
    return found.error, float(np.percentile(distance, MOST))


def _placed(model: Model, table: Measurements) -> bool:
    """Whether positions, if there are any, agree with the nominal arm at first sight."""
    if table.position is None or np.abs(table.position).max() > FARTHEST:
        return True
    some = table.take(np.arange(min(len(table), SAMPLE)))
    flange = model.rigid.flange_poses(some)
    found = linear_fits(flange[None], np.asarray(some.position), some.marker)
    rigid = found.determinant[0] > 0 and abs(found.scale[0] - 1) < OF_A_UNIT
    return bool(rigid and found.left[0] <= POOR)


def _corrections(
    chain: Chain, table: Measurements, spherical: bool
) -> Iterator[tuple[str, Measurements]]:
    """Mistakes that are often made, each undone; first those of which few have to be undone."""
    position = np.asarray(table.position)
    maps = joint_maps(chain)
    q = np.stack([joint_map.of(table.q) for joint_map in maps])
    flange = nominal_flanges(chain, q.reshape(-1, q.shape[2])).reshape(*q.shape[:2], 4, 4)
    found: list[tuple[float, float, str, Measurements]] = []
    points = [(position, "")]
    if spherical:
        level = np.hypot(*position[:, :2].T)
        turned = np.where(level > 0, position[:, 2] / np.where(level > 0, level, 1.0), 0.0)
        swapped = np.column_stack([position[:, :2] * turned[:, None], level])
        points += [(swapped, "with zenith angles read as elevations or the other way round")]
    for place, of_angles in points:
        fits = linear_fits(flange, place, table.marker)
        for k in np.flatnonzero(np.isfinite(fits.left)):
            words = [*maps[k].words, *([of_angles] if of_angles else [])]
            undone, more = _of_positions(place, fits, int(k), spherical)
            # To mirror the frame beside turned signs is no simpler than to turn others.
            count = maps[k].mistakes + (len(words) > 0 and len(more) > 0) + len(more)
            words += more
            if words:
                changed = replace(table, q=q[k], position=undone)
                found.append((float(fits.left[k]), count, " and ".join(words), changed))
    found.sort(key=lambda one: one[0])
    likely = [one for one in found if one[0] <= POOR] or found[:2]
    likely.sort(key=lambda one: one[1])  # of equally many mistakes the better fit stays first
    yield from ((words, changed) for _, _, words, changed in likely[:CONFIRMED])


def _of_positions(
    position: Array, fits: LinearFits, k: int, spherical: bool
) -> tuple[Array, list[str]]:
    """The positions as the k-th fit asks for: in which unit, in a right-handed frame."""
    words, scale = [], float(fits.scale[k])
    # The base is fitted: every swap of two axes and every turned sign is the same mirror image.
    if fits.determinant[k] < 0:
        position = position[:, [1, 0, 2]]
        words.append(
            "with azimuths counted the other way (azimuth = … in [[source]])"
            if spherical
            else "with two columns of the positions swapped, or the sign of one turned round (now "
            "they make a left-handed frame),"
        )
    unit = next((u for u in UNITS if abs(scale / u[0] - 1) < OF_A_UNIT), None)
    if unit is not None:
        return position * unit[0], [f"if positions were {unit[1]}", *words]
    if abs(scale - 1) > SCALED:
        words.append(f"with all positions {scale:.4g} times as far apart ({SCALE})")
        return position * scale, words
    return position, words


SCALE = "one scale of all lengths, as of a tag, a scale bar or a unit of another size"


def _slipped_words(table: Measurements, found: Slipped) -> str:
    """ "configurations 1 to 20 fit the nominal arm to 1 mm; from 21 on the points belong to joint
    values one later, from 27 two later" """
    by_rows = None in found.visits
    labels = [
        f"line {table.row[i]}" if by_rows else table.configuration_labels[table.configuration[i]]
        for i in found.starts
    ]
    fits: list[str] = []
    moved: list[str] = []
    for k, (label, rows, visits) in enumerate(zip(labels, found.rows, found.visits, strict=True)):
        shift = rows if by_rows or visits is None else visits
        size = {1: "one", 2: "two"}.get(abs(shift), str(abs(shift)))
        size += "" if not by_rows else " row" if abs(shift) == 1 else " rows"
        side = "later" if shift > 0 else "earlier"
        if shift:
            on = "" if moved else " on the points belong to joint values"
            moved.append(f"from {label}{on} {size} {side}")
        elif k + 1 < len(labels):
            last = found.starts[k + 1] - 1
            end = table.configuration_labels[table.configuration[last]]
            fits.append(f"{label} to {table.row[last] if by_rows else end}")
        else:
            fits.append(f"{label} and later")
    if len(labels) == 1:
        poses = "" if by_rows else " poses" if abs(shift) > 1 else " pose"
        return f"with the joint values of {size}{poses} {side} they would fit to {_mm(found)}"
    what = "" if by_rows else "configurations "
    own = f"{what}{listed(fits)} fit the nominal arm to {_mm(found)}; " if fits else ""
    return f"{own}{listed(moved)}"


def _mm(found: Slipped) -> str:
    return f"{found.error * 1e3:.3g} mm"


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

# What a fitted model may leave, over the length of the arm: the median and rms of the readings,
# and all but one in five, those set apart among them.  Arms as they come from a factory err by a
# thousandth of it, those of hobbyists by a hundredth; wrong columns by a third.
POOREST, FEW = 0.05, 0.2
LARGEST = 10.0  # a fitted length, over that of the arm and the distance of the readings


def refuse_nonsense(
    model: Model, observed: Observations, x: Array, residual: Array, every: Measurements,
    apart: Observations | None = None,
) -> None:  # fmt: skip
    """Raise InsufficientDataError, with the likely cause, where a fit is none of this robot.

    `x` (parameters,) and `residual` (N·size,) of the fit in SI units, `apart` what it left out;
    `every` reading is looked at for the cause, since few may be left in `observed`.  Deflections
    are small whatever the mistake: there positions that a mistake undone makes fit are enough.
    """
    off = np.linalg.norm(residual.reshape(-1, observed.size)[:, :3], axis=1)
    if apart is not None:
        left = apart.value - model.predict(apart.table, x, apart)
        apart_off = np.linalg.norm(left.reshape(-1, apart.size)[:, :3], axis=1)
    with np.errstate(over="ignore"):
        error, rms = (float(np.median(off)), float(np.sqrt((off**2).mean()))) if len(off) else NONE
    table = observed.table
    length = _length(model, table)
    reach = 0.0 if table.position is None else float(np.abs(table.position).max())
    lengths = np.array([p.unit == "m" for p in model.parameters], dtype=bool)
    beyond = np.flatnonzero(lengths & ~(np.abs(x) <= LARGEST * (length + reach)))
    every_off = off if apart is None else np.append(off, apart_off)
    share = float((every_off > POOREST * length).mean()) if len(every_off) else 0.0
    sane = max(error, rms) <= POOREST * length and share <= FEW and not len(beyond)
    if sane and (observed.kind != "deflection" or _placed(model, every)):
        return
    fit = nominal_fit(model.chain, model.cell, every)
    if sane:
        if fit is not None and fit.mended:
            raise InsufficientDataError(
                f"{table.source}: no deflections of this arm: {fit.warning}"
            )
        return
    what = f"after the fit the readings are {error:.3g} m (median) and {rms:.3g} m (rms)"
    if share > FEW:
        what += f", {share:.0%} of them more than {POOREST * length:.2g} m,"
    what += " from the model"
    if len(beyond):
        k = int(beyond[0])
        what += f", whose {model.parameters[k].name} is {x[k]:.3g} m"
    raise InsufficientDataError(
        f"{table.source}: {what}, which no arm of {length:.3g} m could be; {_cause(every, fit)}"
    )


NONE = (0.0, 0.0)


def _length(model: Model, table: Measurements) -> float:
    """Of the arm stretched out, with its tool and the ways of its slides, in m."""
    frames = [*(joint.placement for joint in model.chain.joints), model.chain.flange_placement]
    sliding = np.array([joint.kind == "prismatic" for joint in model.chain.joints], dtype=bool)
    tool = max((np.linalg.norm(m) for m in model.cell.tool.markers.values()), default=0.0)
    length = float(sum(np.linalg.norm(frame[:3, 3]) for frame in frames) + tool)
    return length + (float(np.ptp(table.q[:, sliding], axis=0).sum()) if len(table) else 0.0)


def _cause(every: Measurements, fit: NominalFit | None) -> str:
    if (same := _constant(every)) and (fit is None or not fit.mended):
        return f"{same} in all {len(every)} rows: was it recorded?"
    if fit is not None and fit.warning:
        return fit.warning
    return (
        "check the units and the order of the columns, which joint values belong to which point, "
        "and whether the cell describes this robot"
    )


def _constant(table: Measurements) -> str:
    """The columns of a position that hold one value while the arm moved, and those of joints."""
    columns = [] if table.position is None else list(zip("xyz", table.position.T, strict=True))
    columns += [(f"q{j + 1}", values) for j, values in enumerate(table.q.T)]
    same = [name for name, values in columns if (values == values[0]).all()]
    if not same:
        return ""
    one = len(same) == 1
    return f"{'column' if one else 'columns'} {listed(same)} {'holds' if one else 'hold'} one value"
