"""Mistakes that are often made with a table of readings, found by undoing each.

Units, signs, swapped columns, shifted rows: whether the nominal arm, its base and markers fitted,
explains the readings at all, and what would have to be otherwise for it to do so.  A calibration
whose residuals no arm could have ends here, with the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from elastocal.cell.arm_description import ModelSpec, Tool
from elastocal.cell.work_cell import Cell
from elastocal.errors import InsufficientDataError
from elastocal.identification.start import (
    OF_A_TARGET,
    SCALED,
    LinearFits,
    Registration,
    linear_fits,
    nominal_problem,
    register,
)
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
from elastocal.model.effects.base import index
from elastocal.model.effects.compliances import (
    RATED_WIND_UP,
    JointCompliance,
    rated_torque,
    weight_torque,
)
from elastocal.model.effects.placements import link_ends
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.text import listed
from elastocal.units import Array, IntArray

# Readings that have slipped against the joint values beside them, from some rows on.
#
# A reading that is missing lets all later ones close up.  Row r then holds the reading of row
# r + s_r with s_r constant in blocks.  A block that is long enough places base and markers; then
#
#     minimise  Σ_r min(|p_r − x(q_{r+s_r})| / τ, 1) + λ · (number of changes of s)
#
# over all s is a shortest path through rows and shifts (Viterbi 1967), and base and markers follow
# from all rows again.

NEAR, NEAREST = 0.06, 0.005  # m: τ is six times the error of a block, within these
CHANGE = 1.5  # λ: a block is there from two rows on, and one stray row makes none
FARTHEST_ROW = 6  # visits that readings are looked for away from their row
BLOCK, WINDOWS = 8, 16  # visits that place base and markers, and how many such blocks are tried
PLACED = 6  # of these, tried in earnest
FITS = 0.8  # share of the rows that must fit, so that it is an explanation
FEWEST = 4  # visits to a block, on average
MOST_ROWS = 20_000
Place = Callable[[Measurements], Registration]


@dataclass(frozen=True)
class Slipped:
    """Blocks of rows, each by its first row and the shift of its readings in rows and in visits
    (None where it differs), and the median distance `error` in m of readings from the nominal arm
    then."""

    starts: tuple[int, ...]
    rows: tuple[int, ...]
    visits: tuple[int | None, ...]
    error: float


def slipped(chain: Chain, table: Measurements, place: Place) -> Slipped | None:
    """Where readings slipped, in the order of the rows; None where no few shifts explain them.

    `place` finds base and markers by a table.
    """
    visit = np.cumsum(np.r_[0, np.any(np.diff(table.q, axis=0) != 0, axis=1)])
    visits = int(visit[-1]) + 1
    if visits < BLOCK or len(table) > MOST_ROWS:
        return None
    most = FARTHEST_ROW * max(round(len(table) / visits), 1)
    shifts = np.arange(-most, most + 1)
    flange, rows = nominal_flanges(chain, table.q), np.arange(len(table))
    for block, s in _blocks(table, flange, visit, shifts):
        found = place(_moved(table, block, s))
        if found.error <= NEAR / 2:
            break
    else:
        return None
    path = np.zeros(0, dtype=np.int64)
    for _ in range(3):
        distance = _distances(found, table, flange, shifts)
        path = _path(distance / np.clip(6 * found.error, NEAREST, NEAR))
        moved = shifts[path]
        inside = (rows + moved >= 0) & (rows + moved < len(rows))
        found = place(_moved(table, rows[inside], moved[inside]))
    own, moved = distance[rows, path], shifts[path]
    starts = np.flatnonzero(np.r_[True, np.diff(moved) != 0])
    good = own <= NEAR
    if good.mean() < FITS or len(starts) * FEWEST > visits or not moved.any():
        return None
    later = visit[np.clip(rows + moved, 0, len(rows) - 1)] - visit
    blocks = np.split(rows, starts[1:])
    by_visits = [np.unique(later[b[good[b]]]) for b in blocks]
    return Slipped(
        tuple(starts.tolist()), tuple(moved[starts].tolist()),
        tuple(int(v[0]) if len(v) == 1 else None for v in by_visits), float(np.median(own)),
    )  # fmt: skip


def _moved(table: Measurements, rows: IntArray, shift: IntArray | int) -> Measurements:
    """These rows with the joint values and markers of the rows `shift` further on."""
    return replace(
        table.take(rows), q=table.q[rows + shift], marker=table.marker[rows + shift]
    )  # fmt: skip


def _blocks(
    table: Measurements, flange: Array, visit: IntArray, shifts: IntArray
) -> list[tuple[IntArray, int]]:
    """Blocks of rows and shifts with which they fit best, those of small shifts first."""
    found = []
    last = int(visit[-1]) + 1 - BLOCK
    for first in np.unique(np.linspace(0, last, min(WINDOWS, last + 1)).astype(int)):
        rows = np.flatnonzero((visit >= first) & (visit < first + BLOCK))
        own = shifts[(rows[0] + shifts >= 0) & (rows[-1] + shifts < len(table))]
        at = rows + own[:, None]
        fits = linear_fits(flange[at], np.asarray(table.position)[rows], table.marker[at])
        found += [(left > NEAR / 2, abs(s), left, first, rows, int(s))
                  for s, left in zip(own.tolist(), fits.left.tolist(), strict=True)]  # fmt: skip
    found.sort(key=lambda one: one[:4])
    return [(rows, s) for *_, rows, s in found[:PLACED]]


def _distances(found: Registration, table: Measurements, flange: Array, shifts: IntArray) -> Array:
    """Distance (n, shifts) in m of every reading from the nominal place of the row that many
    further on; infinite beyond the table."""
    place = found.places(flange[:, :3, :3], flange[:, :3, 3], table.marker)
    n, points = len(table), np.asarray(table.position)
    distance = np.full((n, len(shifts)), np.inf)
    for k, s in enumerate(shifts):
        low, high = max(0, -s), min(n, n - s)
        if low < high:
            off = points[low:high] - place[low + s : high + s]
            distance[low:high, k] = np.linalg.norm(off, axis=1)
    return distance


def _path(cost: Array) -> IntArray:
    """Number (n,) of the shift of each row on the cheapest path, each cost (n, shifts) up to 1."""
    cost = np.minimum(cost, 1.0)
    total, came = cost[0], np.zeros(cost.shape, dtype=np.int64)
    own = np.arange(cost.shape[1])
    for r in range(1, len(cost)):
        best = int(total.argmin())
        changes = total[best] + CHANGE < total
        came[r] = np.where(changes, best, own)
        total = np.where(changes, total[best] + CHANGE, total) + cost[r]
    path = np.empty(len(cost), dtype=np.int64)
    path[-1] = int(total.argmin())
    for r in range(len(cost) - 1, 0, -1):
        path[r - 1] = came[r, path[r]]
    return path


# Joint values as a controller may count them.  Its c become the model's q by signs, offsets, an
# exchange of columns, and a coupling of neighbouring joints (Fanuc displays joint 3 against the
# floor), as `[joints]` of a mapping has it:
#
#     q = (1 + κ E_{j,j±1}) (D P c + o),  D a matrix of signs, P an exchange of two columns.

MOST_SIGNS = 7  # joints of which every choice of signs is tried; of more, up to two
TURNS = (90, -90, 180)


@dataclass(frozen=True)
class JointMap:
    """q = c · matrixᵀ + offset (joints,), of so many `mistakes` in `words`; of two that do the same
    (half a turn of joint 4 and a sign of joint 5) an offset counts a little more."""

    matrix: Array
    offset: Array
    words: tuple[str, ...]
    mistakes: float

    def of(self, c: Array) -> Array:
        return c @ self.matrix.T + self.offset

    def after(self, first: JointMap) -> JointMap:
        """This map of what `first` gives."""
        return JointMap(
            self.matrix @ first.matrix, self.matrix @ first.offset + self.offset,
            first.words + self.words, first.mistakes + self.mistakes,
        )  # fmt: skip


def joint_maps(chain: Chain) -> list[JointMap]:
    """Single mistakes, all signs with each coupling, and pairs of the others."""
    n = chain.n_joints
    none = JointMap(np.eye(n), np.zeros(n), (), 0)
    signs, couplings, others = list(_signs(n)), list(_couplings(chain)), list(_others(chain))
    found = [none, *signs, *couplings, *others]
    found += [coupling.after(sign) for sign in signs for coupling in couplings]
    found += [b.after(a) for a, b in combinations(couplings, 2)]
    found += [b.after(a) for a, b in combinations(others, 2)]
    single = [sign for sign in signs if sign.mistakes == 1]
    found += [b.after(a) for a in others for b in (*single, *couplings)]
    return found


def _signs(n: int) -> Iterator[JointMap]:
    for k in range(1, (n if n <= MOST_SIGNS else 2) + 1):
        for turned in combinations(range(n), k):
            D = np.eye(n)
            D[turned, turned] = -1.0
            names = listed([str(j + 1) for j in turned])
            joints = "joint" if k == 1 else "joints"
            words = f"with the sign of {joints} {names} turned round"
            yield JointMap(D, np.zeros(n), (words,), k)


def _couplings(chain: Chain) -> Iterator[JointMap]:
    n = chain.n_joints
    for j in range(1, n):
        for factor in (1.0, -1.0) if chain.kinds[j] == chain.kinds[j - 1] else ():
            C = np.eye(n)
            C[j, j - 1] = factor
            words = f"with coupling {{ joint = {j + 1}, of = {j}, factor = {factor:g} }}"
            yield JointMap(C, np.zeros(n), (words,), 1)


def _others(chain: Chain) -> Iterator[JointMap]:
    n = chain.n_joints
    turning = np.array([kind == "revolute" for kind in chain.kinds])
    for factor, words in ((np.pi / 180, "degrees read as radians"),
                          (180 / np.pi, "radians read as degrees")):  # fmt: skip
        unit = np.diag(np.where(turning, factor, 1.0))
        yield JointMap(unit, np.zeros(n), (f"if joints were {words}",), 1)
    for j in np.flatnonzero(turning):
        for degrees in TURNS:
            offset = np.radians(degrees) * (np.arange(n) == j)
            yield JointMap(np.eye(n), offset, (f"with offset_deg {degrees} at joint {j + 1}",), 1.1)
    for first, second in combinations(range(n), 2):
        order = np.arange(n)
        order[[first, second]] = second, first
        words = f"with the columns of joints {first + 1} and {second + 1} exchanged"
        yield JointMap(np.eye(n)[order], np.zeros(n), (words,), 1)


# Which of these, and which units, would make the readings fit the nominal arm.

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
        cause = ANOTHER if abs(scale - 1) > OF_A_TARGET else SCALE
        words.append(f"with all positions {scale:.4g} times as far apart ({cause})")
        return position * scale, words
    return position, words


SCALE = "one scale of all lengths, as of a tag, a scale bar or a unit of another size"
ANOTHER = f"most likely the cell describes another robot, else {SCALE}"


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


# Loads in another unit.
#
# Deflections tell compliance times load: loads that are too small by a factor make every
# compliance too large by it, without a trace in the residual.

KILOGRAMS = 9.80665  # N, the weight of one


def load_ratio(model: Model, known: dict[str, float]) -> tuple[float, str] | None:
    """Median of the joints' compliances over what they should be about, and by what; None where
    nothing says it.

    `known` (SI) are values by parameter name.  They should be those that the cell states, else
    what winds each revolute joint up by RATED_WIND_UP at its rated torque, by the links' weights.
    """
    given, rated = [], []
    heavier = _usual_over_stated_mass(model.chain)
    for p in model.parameters:
        value = known.get(p.name, 0.0)
        if p.effect != JointCompliance.name or value <= 0:
            continue
        i = index(p.where)
        if p.nominal > 0:
            given.append(value / p.nominal)
        elif model.chain.kinds[i] == "revolute" and weight_torque(model.chain, i) > 0:
            torque = rated_torque(model.chain, model.cell, i) or 0.0
            rated.append(value * heavier * torque / RATED_WIND_UP)
    for ratios, by in ((given, CELL), (rated, WEIGHTS if heavier == 1 else LENGTH)):
        if ratios:
            return float(np.median(ratios)), by
    return None


CELL, WEIGHTS = "the cell's nominal compliances", "the weights of the links"
LENGTH = "the length of the arm"
# kg/m³, mass of the links over the cube of the arm's length: 9 (UR5, Panda), 33 (KR 270), 40
# (KR 120).  Files of robots often state 1 or 2 kg for every link, which no arm of that size has.
USUAL_MASS, OF_ANY_ARM = 30.0, 10.0


def _usual_over_stated_mass(chain: Chain) -> float:
    """What the masses are to be multiplied by; 1 where an arm of this length may have them."""
    mass = sum(body.mass for body in chain.masses)
    usual = USUAL_MASS * float(sum(np.linalg.norm(T[:3, 3]) for T in link_ends(chain))) ** 3
    alike = usual <= OF_ANY_ARM * mass and mass <= OF_ANY_ARM * usual
    return 1.0 if alike or mass == 0 else usual / mass


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
