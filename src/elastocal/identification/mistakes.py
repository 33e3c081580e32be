"""Mistakes that are often made with a table of readings: each an alternative reading of it.

Units, signs, swapped columns, shifted rows: with base and markers fitted, the nominal arm is far
from the readings as they stand, and near them as an alternative reads them.  Of n readings whose
errors have one unknown size, that is a likelihood ratio of 3n log(far/near).  A calibration whose
residuals no arm could have ends here, with the likely cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain as chain_of
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
import scipy  # whose `spatial` loads where rotations were read

from elastocal.cell import Cell
from elastocal.cell_tables import Convention, ModelSpec, Tool
from elastocal.identification.faulty_readings import FEWEST_POSES, MOST, exchanged, in_one_frame
from elastocal.identification.outliers import named_runs
from elastocal.identification.result import AT_BOUND, Calibration, Estimate, Finding, made
from elastocal.identification.solve import far_off
from elastocal.identification.start import (
    FITS,
    OF_A_TARGET,
    OF_A_UNIT,
    SCALED,
    LinearFits,
    Registration,
)
from elastocal.measurements import Measurements
from elastocal.messages import ElastocalError, InsufficientDataError, length, listed, rounded
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Parameter, index
from elastocal.model.effects.geometry import (
    JointOffset,
    LinkGeometry,
    MarkerOrientation,
    TrackerDistortion,
)
from elastocal.model.effects.statics import (
    RATED_WIND_UP,
    JointCompliance,
    rated_torque,
    usual_over_stated_mass,
    weight_torque,
)
from elastocal.model.manipulator import Model, load_chain
from elastocal.model.observations import Observations
from elastocal.model.rigid import nominal_flanges
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

# What an alternative must bring the error down by.  Of 8 readings it is a likelihood ratio of 38
# nats, against 8 for the choice among all the alternatives.
BETTER = 5.0
FARTHEST = 1e5  # m; beyond it no fit is worth its overflows, and plausibility speaks
SAMPLE = 80
CONFIRMED = 6  # alternatives of joints and positions that are tried in earnest


# The table as it would read without a mistake, after words that say what is otherwise, {} being
# what it then fits to.
Alternative = tuple[str, Measurements]


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
    they hold no positions, too few poses, or numbers beyond all measure.  `spherical`: positions
    were read as distance and angles, which invites mistakes of their own."""
    poses = len(np.unique(table.q, axis=0))
    if table.position is None or poses < FEWEST_POSES or np.abs(table.position).max() > FARTHEST:
        return None
    rigid = _rigid(chain, cell, table)
    error, far = _errors(rigid, table)
    if len(table.marker_names) > 1:
        mixed = exchanged(Model.assembled(chain, replace(cell, model=ModelSpec())), table)
        if mixed is not None:
            return NominalFit(error, mixed[2].removesuffix("."), True)
    if far <= FITS:
        return NominalFit(error, rotations_off(rigid, table, "the nominal arm"))
    near, best = far, ""
    # The simplest that mends it, else what does most.
    of_columns = _of_columns(chain, _some(table), spherical)
    others = chain_of(_of_frames(table), of_columns, _of_rows(rigid, table))
    of_arm = ((rigid, *other) for other in others)
    for arm, words, other in chain_of(_of_robots(cell, table), of_arm):
        left = _errors(arm, other)[1]
        if left < near:
            near, best = left, words.format(length(left))
        if near <= FITS:
            break
    better = near < far / BETTER
    if not better:
        best = (
            "and neither another unit or scale, signs, couplings, offsets or an exchange of "
            "columns, one or two of them, nor rows that have shifted mend that: check the robot of "
            "the cell, offsets of joints, and which joint values belong to which point"
        )
    said = f"the readings fit the nominal arm only to {length(far)}"
    return NominalFit(error, f"{said}{';' if better else ','} {best}", better and near <= FITS)


def likely_mistake(model: Model, table: Measurements) -> str:
    """The mistake that, undone, makes readings fit the nominal arm; "" where there is none."""
    fit = nominal_fit(model.chain, model.cell, table)
    return fit.warning if fit is not None and fit.mended else ""


def _rigid(chain: Chain, cell: Cell, table: Measurements) -> Model:
    """The nominal arm without effects, its markers at the flange."""
    tool = Tool(cell.tool.load_point, {name: np.zeros(3) for name in table.marker_names})
    return Model.assembled(chain, replace(cell, tool=tool, model=ModelSpec()))


def _of_robots(cell: Cell, table: Measurements) -> Iterator[tuple[Model, str, Measurements]]:
    if cell.robot.dh is None:
        return
    convention: Convention = "modified" if cell.robot.dh_convention == "standard" else "standard"
    with suppress(ElastocalError):  # a table of the one may be none of the other
        chain = load_chain(replace(cell, robot=replace(cell.robot, dh_convention=convention)))
        told = f'with [robot] dh_convention = "{convention}" they would fit to {{}}'
        yield _rigid(chain, cell, table), told, table


def _of_frames(table: Measurements) -> Iterator[Alternative]:
    if table.rotation is None:
        return
    turn = scipy.spatial.transform.Rotation.from_rotvec(np.asarray(table.rotation)).inv()
    told = "turned round, from poses of the tracker in the target's axes to those of the target in "
    told += "the tracker's, they would fit to {}"
    yield told, replace(table, position=-turn.apply(table.position), rotation=turn.as_rotvec())


def _some(table: Measurements) -> Measurements:
    light = np.flatnonzero(~np.any(table.force != 0, axis=1))
    rows = light if len(light) >= FEWEST_POSES else np.arange(len(table))
    if len(rows) > SAMPLE:
        rows = np.sort(np.random.default_rng(0).choice(rows, SAMPLE, replace=False))
    return table.take(rows)


def _errors(model: Model, table: Measurements) -> tuple[float, float]:
    """Distance (m) from the nominal arm that half of the readings keep to, and that MOST do."""
    table = _some(table)
    found = Registration.of(model, table)
    place = found.places(model.rigid.flange_poses(table), table.marker)
    distance = np.linalg.norm(np.asarray(table.position) - place, axis=1)
    return found.error, float(np.percentile(distance, MOST))


# What rx, ry, rz or qw, qx, qy, qz may hold other than the rotation that they are read as.
EULER = {"xyz": "the fixed x, y and z", "XYZ": "the moving x, y and z",
         "zyx": "the fixed z, y and x", "ZYX": "the moving z, y and x",
         "ZYZ": "the moving z, y and z"}  # fmt: skip


def _meant(raw: Array) -> Iterator[tuple[str, Rotation]]:
    """Rotation vectors `raw` (n, 3) as they may be meant, after words that say how."""
    Rotation = scipy.spatial.transform.Rotation
    x, y, z, w = (read := Rotation.from_rotvec(raw)).as_quat().T
    other = Rotation.from_quat(np.column_stack([w, x, y, z]))
    yield "qw, qx, qy, qz hold x, y, z, w", other
    yield "qx, qy, qz, qw hold w, x, y, z", Rotation.from_quat(np.column_stack([y, z, w, x]))
    yield "they turn the tracker's axes into the target's (transpose them)", read.inv()
    yield "qw, qx, qy, qz hold x, y, z, w of the inverse rotation", other.inv()
    for sequence, axes in EULER.items():
        told = f"rx, ry, rz are Euler angles about {axes} axes, and no rotation vector"
        yield told, Rotation.from_euler(sequence, raw)


def _turned(arm: Rotation, read: Rotation, marker: IntArray) -> Array:
    """Angles (n,) in rad of rotations from the arm's, each target mounted as on average."""
    mounted = arm.inv() * read
    of = [mounted[marker == m] for m in np.unique(marker)]
    return np.concatenate([(turn.mean().inv() * turn).magnitude() for turn in of])


def rotations_off(model: Model, table: Measurements, of: str, turned: Array | None = None) -> str:
    """What rotations that are the angles `turned` (n,) in rad from those `of` an arm let suspect;
    `model`: the nominal arm, from whose rotations they are where None."""
    if table.rotation is None:
        return ""
    table = _some(table)
    found, flange = Registration.of(model, table), model.rigid.flange_poses(table)
    Rotation = scipy.spatial.transform.Rotation
    arm, raw = Rotation.from_matrix(found.rotation @ flange[:, :3, :3]), np.asarray(table.rotation)
    off, read = partial(_turned, arm, marker=table.marker), Rotation.from_rotvec(raw)
    angle = float(np.median(off(read) if turned is None else turned))
    if angle <= POOREST:
        return ""
    words = f"the rotations are {rounded(np.degrees(angle))}° (median) from {of}; "
    least = min(POOREST, angle / BETTER)
    if np.median(off(read)) < least:
        return f"{words}the target is mounted at an angle: fit marker_orientation"
    for told, meant in _meant(raw):
        if np.median(off(meant)) < least:
            return f"{words}most likely {told}: with that they fit"
    # R = C A M with A the arm's turns the relative rotations about C times the same axes.
    rows = np.argsort(table.marker, kind="stable")
    steps = [(r[rows[1:]] * r[rows[:-1]].inv()).as_rotvec() for r in (read, arm)]
    other, _ = Rotation.align_vectors(*steps)
    if np.median(_turned(other * arm, read, table.marker)) < least:
        axis = listed([f"{v:g}" for v in np.round(other.as_rotvec(degrees=True)) + 0.0])
        return f"{words}they stand in other axes than the positions, turned by ({axis})° from these"
    return (
        f"{words}check the order of qw, qx, qy, qz (rx, ry, rz are a rotation vector, not Euler "
        "angles), and that they turn the target's axes into the tracker's"
    )


# Joint values as a controller may count them.  Its c become the model's q by signs, offsets, an
# exchange of columns, and a coupling of neighbouring joints (Fanuc displays joint 3 against the
# floor), as `[joints]` of a mapping has it:
#
#     q = (1 + κ E_{j,j±1}) (D P c + o),  D a matrix of signs, P an exchange of two columns.

MOST_SIGNS = 7  # joints of which every choice of signs is tried; of more, up to two
TURNS = (90, -90, 180)
TURNED = "with the sign of"
MIRRORED = (
    "with two columns of the positions swapped, or the sign of one turned round (now they make a "
    "left-handed frame),"
)
NO_WORSE = 1.5


@dataclass(frozen=True)
class JointMap:
    """q = c · matrixᵀ + offset (joints,), of so many `mistakes` in `words`; of two that do the same
    (half a turn of joint 4 and a sign of joint 5) an offset counts a little more."""

    words: tuple[str, ...]
    matrix: Array
    offset: Array | float = 0.0
    mistakes: float = 1.0

    def of(self, c: Array) -> Array:
        return c @ self.matrix.T + self.offset

    def after(self, first: JointMap) -> JointMap:
        return JointMap(
            first.words + self.words, self.matrix @ first.matrix,
            self.matrix @ np.broadcast_to(first.offset, len(self.matrix)) + self.offset,
            first.mistakes + self.mistakes,
        )  # fmt: skip


def joint_maps(chain: Chain) -> list[JointMap]:
    n, kinds, eye = chain.n_joints, chain.kinds, np.eye(chain.n_joints)
    signs, couplings, others = list[JointMap](), list[JointMap](), list[JointMap]()
    most = n if n <= MOST_SIGNS else 2
    for turned in chain_of(*(combinations(range(n), k) for k in range(1, most + 1))):
        names = f"joint{'s' * (len(turned) > 1)} {listed([str(j + 1) for j in turned])}"
        D = np.diag(np.where(np.isin(np.arange(n), turned), -1.0, 1.0))
        told = f"{TURNED} {names} turned round"
        signs.append(JointMap((told,), D, mistakes=len(turned)))
    for j in range(1, n):
        for factor in (1.0, -1.0) if kinds[j] == kinds[j - 1] else ():
            told = f"with coupling {{ joint = {j + 1}, of = {j}, factor = {factor:g} }}"
            couplings.append(JointMap((told,), eye + factor * np.outer(eye[j], eye[j - 1])))
    turning = chain.turning
    for factor, told in ((np.pi / 180, "degrees read as radians"),
                         (180 / np.pi, "radians read as degrees")):  # fmt: skip
        scale = np.diag(np.where(turning, factor, 1.0))
        others.append(JointMap((f"if joints were {told}",), scale))
    for j, degrees in product(np.flatnonzero(turning).tolist(), TURNS):
        told = f"with offset_deg {degrees} at joint {j + 1}"
        others.append(JointMap((told,), eye, np.radians(degrees) * eye[j], 1.1))
    for a, b in combinations(range(n), 2):
        order = np.arange(n)
        order[[a, b]] = b, a
        told = f"with the columns of joints {a + 1} and {b + 1} exchanged"
        others.append(JointMap((told,), eye[order]))
    pairs = [
        *product(signs, couplings), *combinations(couplings, 2), *combinations(others, 2),
        *product(others, (*signs[:n], *couplings)),
    ]  # fmt: skip
    none = JointMap((), eye, mistakes=0)
    return [none, *signs, *couplings, *others, *(b.after(a) for a, b in pairs)]


UNITS = ((1e-3, "mm read as m"), (1e3, "m read as mm"), (25.4, "inches read as mm"),
         (1 / 25.4, "mm read as inches"))  # fmt: skip
SCALE = "one scale of all lengths, as of a tag, a scale bar or a unit of another size"
ANOTHER = f"most likely the cell describes another robot, else {SCALE}"


FACTORS = np.exp(np.linspace(-1.5, 1.5, 151))  # so near each other that one of them fits


def _geared(chain: Chain, table: Measurements) -> Iterator[JointMap]:
    """Each revolute joint with its values times the factor, or a full unit, that suits it best."""
    eye = np.eye(chain.n_joints)

    def left(j: int, factors: Array) -> Array:
        q = table.q + (factors[:, None, None] - 1) * table.q[:, j, None] * eye[j]
        flange = nominal_flanges(chain, q.reshape(-1, q.shape[2]))
        flange = flange.reshape(*q.shape[:2], 4, 4)
        return LinearFits(flange, np.asarray(table.position), table.marker).left

    for j in np.flatnonzero(chain.turning & (np.ptp(table.q, axis=0) > 0)).tolist():
        tried = np.concatenate([FACTORS, -FACTORS, [np.pi / 180, 180 / np.pi]])
        best = float(tried[np.argmin(left(j, tried))])
        for step in (2e-2, 5e-3, 1e-3):
            near = best * (1 + step * np.linspace(-1, 1, 9))
            best = float(near[np.argmin(left(j, near))])
        told = f"with the values of joint {j + 1} times {rounded(best, 4)} (unit or gear ratio)"
        yield JointMap((told,), eye + (best - 1) * np.outer(eye[j], eye[j]), mistakes=1.3)


def _of_columns(chain: Chain, table: Measurements, spherical: bool) -> Iterator[Alternative]:
    position = np.asarray(table.position)
    maps = [*joint_maps(chain), *_geared(chain, table)]
    q = np.stack([joint_map.of(table.q) for joint_map in maps])
    flange = nominal_flanges(chain, q.reshape(-1, q.shape[2])).reshape(*q.shape[:2], 4, 4)
    points: list[tuple[Array, tuple[str, ...]]] = [(position, ())]
    if spherical:
        level = np.hypot(*position[:, :2].T)
        turned = np.where(level > 0, position[:, 2] / np.where(level > 0, level, 1.0), 0.0)
        swapped = np.column_stack([position[:, :2] * turned[:, None], level])
        points += [(swapped, ("with zenith angles read as elevations or the other way round",))]
    found: list[tuple[float, float, list[str], Measurements]] = []
    for place, of_angles in points:
        fits = LinearFits(flange, place, table.marker)
        for k in np.flatnonzero(np.isfinite(fits.left)):
            undone, more = _of_positions(place, fits, int(k), spherical)
            words = [*maps[k].words, *of_angles, *more]
            # To mirror the frame beside turned signs is no simpler than to turn others.
            count = maps[k].mistakes + len(more) + (0 < len(more) < len(words))
            if words:
                other = replace(table, q=q[k], position=undone)
                found.append((float(fits.left[k]), count, words, other))
    found.sort(key=lambda one: one[0])
    likely = [one for one in found if one[0] <= FITS] or found[:2]
    likely.sort(key=lambda one: one[1])  # of equally many mistakes the better fit stays first
    for left, _, words, other in likely[:CONFIRMED]:
        told = " and ".join(words)
        if words == [MIRRORED]:
            # So does an arm that has a plane of symmetry where joints turn the other way round.
            alike = (w[0] for fit, _, w, _ in likely if len(w) == 1 and fit < NO_WORSE * left)
            told += next((f" or {one}" for one in alike if one.startswith(TURNED)), "")
        told = told.replace("{", "{{").replace("}", "}}")
        yield f"{told} they would fit to {{}}", other


def _of_positions(
    position: Array, fits: LinearFits, k: int, spherical: bool
) -> tuple[Array, list[str]]:
    words, scale = [], float(fits.scale[k])
    # The base is fitted: every swap of two axes and every turned sign is the same mirror image.
    if fits.determinant[k] < 0:
        position = position[:, [1, 0, 2]]
        words.append(
            "with azimuths counted the other way (azimuth = … in [[source]])"
            if spherical
            else MIRRORED
        )
    unit = next((u for u in UNITS if abs(scale / u[0] - 1) < OF_A_UNIT), None)
    if unit is not None:
        return position * unit[0], [f"if positions were {unit[1]}", *words]
    if abs(scale - 1) > SCALED:
        cause = ANOTHER if abs(scale - 1) > OF_A_TARGET else SCALE
        words.append(f"with all positions {rounded(scale, 4)} times as far apart ({cause})")
        return position * scale, words
    return position, words


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
FEWEST = 4  # visits to a block, on average
MOST_ROWS = 20_000


def _of_rows(model: Model, table: Measurements) -> Iterator[Alternative]:
    visit = np.cumsum(np.r_[0, np.any(np.diff(table.q, axis=0) != 0, axis=1)])
    visits, rows = int(visit[-1]) + 1, np.arange(len(table))
    if visits < BLOCK or len(table) > MOST_ROWS:
        return
    if moved_on := in_one_frame(model, table, visit):
        yield moved_on
    most = FARTHEST_ROW * max(round(len(table) / visits), 1)
    shifts, flange = np.arange(-most, most + 1), nominal_flanges(model.chain, table.q)
    to = rows[:, None] + shifts
    beyond, to = (to < 0) | (to >= len(rows)), np.clip(to, 0, len(rows) - 1)
    windows, last = [], visits - BLOCK
    for first in np.unique(np.linspace(0, last, min(WINDOWS, last + 1)).astype(int)):
        some = np.flatnonzero((visit >= first) & (visit < first + BLOCK))
        own = shifts[(some[0] + shifts >= 0) & (some[-1] + shifts < len(table))]
        at = some + own[:, None]
        fits = LinearFits(flange[at], np.asarray(table.position)[some], table.marker[at])
        windows += [(left > NEAR / 2, abs(s), left, first, some, int(s))
                    for s, left in zip(own.tolist(), fits.left.tolist(), strict=True)]  # fmt: skip
    windows.sort(key=lambda one: one[:4])
    placed = (Registration.of(model, _moved(table, *one[4:])) for one in windows[:PLACED])
    found = next((one for one in placed if one.error <= NEAR / 2), None)
    if found is None:
        return
    for _ in range(3):
        off = np.asarray(table.position)[:, None] - found.places(flange, table.marker)[to]
        distance = np.where(beyond, np.inf, np.linalg.norm(off, axis=2))
        path = _path(distance / np.clip(6 * found.error, NEAREST, NEAR))
        moved = shifts[path]
        inside = np.flatnonzero(~beyond[rows, path])
        slipped = _moved(table, inside, moved[inside])
        found = Registration.of(model, slipped)
    starts = np.flatnonzero(np.r_[True, np.diff(moved) != 0])
    if len(starts) * FEWEST > visits or not moved.any():
        return
    good = distance[rows, path] <= NEAR
    later = visit[to[rows, path]] - visit
    blocks = [(b, np.unique(later[b[good[b]]])) for b in np.split(rows, starts[1:])]
    yield _slipped_words(table, moved, blocks), slipped


def _moved(table: Measurements, rows: IntArray, shift: IntArray | int) -> Measurements:
    return replace(
        table.take(rows), q=table.q[rows + shift], marker=table.marker[rows + shift]
    )  # fmt: skip


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


def _slipped_words(
    table: Measurements, moved: IntArray, blocks: list[tuple[IntArray, IntArray]]
) -> str:
    """ "configurations 1 to 20 fit the nominal arm to 1 mm; from 21 on the points belong to joint
    values one later, from 27 two later", of blocks of rows with the visits that they are off by."""
    by_rows = any(len(visits) != 1 for _, visits in blocks)
    what, line, unit = ("", "line ", "row") if by_rows else ("configurations ", "", "pose")
    label = (
        table.row if by_rows else np.array(table.configuration_labels)[table.configuration]
    )  # fmt: skip
    fits, later = list[str](), list[str]()
    for rows, visits in blocks:
        shift = int(moved[rows[0]] if by_rows else visits[0])
        side = "later" if shift > 0 else "earlier"
        size = {1: "one", 2: "two"}.get(abs(shift), str(abs(shift)))
        several = f"{size} {unit}{'s' * (abs(shift) > 1)}"
        if len(blocks) == 1:
            return f"with the joint values of {several} {side} they would fit to {{}}"
        first, last = label[rows[[0, -1]]]
        if shift:
            on = "" if later else " on the points belong to joint values"
            later.append(f"from {line}{first}{on} {several if by_rows else size} {side}")
        else:
            fits.append(
                f"{line}{first} {'and later' if rows[-1] == len(table) - 1 else f'to {last}'}"
            )
    own = f"{what}{listed(fits)} fit the nominal arm to {{}}; " if fits else ""
    return f"{own}{listed(later)}"


# What a fitted model may leave, over the length of the arm: the median and rms of the readings,
# and all but one in five, those set apart among them.  Arms as they come from a factory err by a
# thousandth of it, those of hobbyists by a hundredth; wrong columns by a third.
POOREST, FEW = 0.05, 0.2
LARGEST = 10.0  # a fitted length, over that of the arm and the distance of the readings


def _placed(model: Model, table: Measurements) -> bool:
    if table.position is None or np.abs(table.position).max() > FARTHEST:
        return True
    some = table.take(np.arange(min(len(table), SAMPLE)))
    flange = model.rigid.flange_poses(some)
    found = LinearFits(flange[None], np.asarray(some.position), some.marker)
    rigid = found.determinant[0] > 0 and abs(found.scale[0] - 1) < OF_A_UNIT
    return bool(rigid and found.left[0] <= FITS)


def refuse_nonsense(
    model: Model, observed: Observations, x: Array, residual: Array, every: Measurements,
    apart: Observations | None = None,
) -> None:  # fmt: skip
    """Raise InsufficientDataError, with the likely cause, where a fit is none of this robot.
    `apart` are the readings that it left out; `every` reading is looked at for the cause, since few
    may be left in `observed`.  Deflections are small whatever the mistake: there positions that a
    mistake undone makes fit are enough."""
    left, n = [residual], len(observed.lead)
    if apart is not None:
        left.append(apart.value - model.predict(apart.table, x, apart))
    errors = np.concatenate(left).reshape(-1, observed.size)
    off, turned = (np.linalg.norm(e, axis=1) for e in (errors[:, :3], errors[:, 3:]))
    table, length = observed.table, length_of(model, observed.table)
    share = float((off > POOREST * length).mean())
    with np.errstate(over="ignore"):  # median and rms of those fitted, and of all
        fitted, every_off = (
            (float(np.median(e)), float(np.sqrt((e**2).mean()))) for e in (off[:n], off)
        )
    reach = 0.0 if table.position is None else float(np.abs(table.position).max())
    beyond = [(p.name, v) for p, v in zip(model.parameters, x, strict=True)
              if p.unit == "m" and not abs(v) <= LARGEST * (length + reach)]  # fmt: skip
    # A joint whose values were not recorded may move the markers by less than that.
    most = FITS if (every.q == every.q[0]).all(axis=0).any() else np.inf
    sane = max(fitted) <= min(POOREST * length, most) and share <= FEW and not beyond
    if turned.size and np.median(turned) > POOREST and (sane or _placed(model, every)):
        rigid = _rigid(model.chain, model.cell, every)
        wrong = rotations_off(rigid, every, "the model", turned)
        raise InsufficientDataError(f"{table.source}: after the fit {wrong}")
    if sane and (observed.kind != "deflection" or _placed(model, every)):
        return
    fit = nominal_fit(model.chain, model.cell, every)
    if sane:
        if fit is not None and fit.mended:
            raise InsufficientDataError(
                f"{table.source}: no deflections of this arm: {fit.warning}"
            )
        return
    # Of those set apart too: beside them the few that fit say nothing.
    error, rms = every_off
    many = f", {share:.0%} of them more than {rounded(POOREST * length, 2)} m," * (share > FEW)
    cause = ""
    if many and (fit is None or not fit.mended):  # a part of the table may be wrong by itself
        parts = [each.table.row[each.lead] for each in (observed, apart) if each is not None]
        far = np.unique(np.concatenate(parts)[off > POOREST * length])
        if cause := likely_mistake(model, every.take(np.isin(every.row, far))):
            cause = f"of lines {listed(named_runs(far.tolist()), 4)} alone {cause}"
    value = f", whose {beyond[0][0]} is {rounded(beyond[0][1])} m" if beyond else ""
    raise InsufficientDataError(
        f"{table.source}: after the fit the readings are {rounded(error)} m (median) and "
        f"{rounded(rms)} m (rms){many} from the model{value}, which no arm of {rounded(length)} m "
        f"could be; {cause or _cause(every, fit)}"
    )


def length_of(model: Model, table: Measurements) -> float:
    """Of the arm stretched out, with its tool and the ways of its slides, in m."""
    frames = [*(joint.placement for joint in model.chain.joints), model.chain.flange_placement]
    sliding = np.array([joint.kind == "prismatic" for joint in model.chain.joints], dtype=bool)
    tool = max((np.linalg.norm(m) for m in model.cell.tool.markers.values()), default=0.0)
    length = float(sum(np.linalg.norm(frame[:3, 3]) for frame in frames) + tool)
    return length + (float(np.ptp(table.q[:, sliding], axis=0).sum()) if len(table) else 0.0)


def _cause(every: Measurements, fit: NominalFit | None) -> str:
    columns = [] if every.position is None else list(zip("xyz", every.position.T, strict=True))
    columns += [(f"q{j + 1}", values) for j, values in enumerate(every.q.T)]
    same = [name for name, values in columns if (values == values[0]).all()]
    if same and (fit is None or not fit.mended):
        one = "column {} holds" if len(same) == 1 else "columns {} hold"
        return f"{one.format(listed(same))} one value in all {len(every)} rows: was it recorded?"
    if fit is not None and fit.warning:
        return fit.warning
    return (
        "check the units and the order of the columns, which joint values belong to which point, "
        "and whether the cell describes this robot"
    )


# Loads in another unit.
#
# Deflections tell compliance times load: loads that are too small by a factor make every
# compliance too large by it, without a trace in the residual.

# Factor to which the compliances of an arm are known before: those of the KR 270 are 0.8 times what
# its links' weights let expect, and 1.5 times what its length does.
EXPECTED_TO = 2.0
SURELY = 5.0  # standard deviations beyond a physical bound, by which no estimate errs by chance
# In N, what force columns may hold, and what they may hold where the compliances are too small.
LOAD_UNITS = ((9.80665, "kilograms", "newtons times 9.81"), (1e3, "kilonewtons", "millinewtons"))
_note, _care, _poor = (partial(made, s) for s in ("note", "care", "poor"))


def load_unit(result: Calibration) -> Iterator[Finding]:
    """Are all compliances too large, or too small, about as another unit of the loads makes them?

    What they should be about is what the cell states, else what winds each revolute joint up by
    RATED_WIND_UP at its rated torque, by the links' weights: a rule of thumb, worth a look, and no
    more.  The median of the ratios has to be that factor to within EXPECTED_TO.
    """
    model, chain = result.model, result.model.chain
    known = {e.name: e.value for e in result.ordinary if e.value is not None}
    # Turned round, the loads may be in another unit as well: then the sizes tell.
    known |= {p.name: abs(e.held) for p, e in impossible(result)}
    given, rated, heavier = list[float](), list[float](), usual_over_stated_mass(chain)
    for p in model.parameters if result.observations.table.force.any() else ():
        value = known.get(p.name, 0.0)
        if p.effect != JointCompliance.name or value <= 0:
            continue
        i = index(p.where)
        if p.nominal > 0:
            given.append(value / p.nominal)
        elif chain.kinds[i] == "revolute" and weight_torque(chain, i) > 0:
            torque = rated_torque(chain, model.cell, i) or 0.0
            rated.append(value * heavier * torque / RATED_WIND_UP)
    if not (ratios := given or rated):
        return
    ratio, by = float(np.median(ratios)), "the cell's nominal compliances"
    if not given:
        by = "the weights of the links" if heavier == 1 else "the length of the arm"
    off = abs(math.log(ratio))
    near = [u for u in LOAD_UNITS if abs(off - math.log(u[0])) <= math.log(EXPECTED_TO)]
    if not near:
        return
    ((factor, *units),) = near
    unit, undo = (units[0], "multiply") if ratio > 1 else (units[1], "divide")
    remedy = (
        f"Check the unit of the loads: the compliances are {rounded(ratio, 2)} times those "
        f"expected from {by}, as where the force columns hold {unit}. If so, {undo} force_x_N, "
        f"force_y_N and force_z_N by {rounded(factor)}."
    )
    yield (_care if given else _note)("load_unit", remedy, ratio=ratio, by=by, unit=unit)


def impossible(result: Calibration) -> list[tuple[Parameter, Estimate]]:
    return [
        (p, e)
        for p, e in zip(result.model.parameters, result.estimates, strict=True)
        if e.limits is not None
        and max(p.lower - e.held, e.held - p.upper) > SURELY / 1.96 * np.ptp(e.limits) / 2
    ]


TURN_ROUND = (
    "Check the sign of the force columns: where z points up, force_z_N of a hanging load is "
    "negative. Turn the sign round in the table if it is wrong (torque columns too), and identify "
    "again."
)


def impossible_values(result: Calibration) -> Iterator[Finding]:
    """Where most compliances are among them, no missing effect explains it, but loads in the
    opposite direction do, and no load is compensated rightly."""
    if not (found := impossible(result)):
        return
    springs = [p for p in result.model.parameters if p.effect == JointCompliance.name]
    turned = [p for p, _ in found if p.effect == JointCompliance.name]
    signs = 2 * len(turned) > len(springs) and bool(result.observations.table.force.any())
    parameters, estimates = zip(*found, strict=True)
    yield (_poor if signs else _care)(
        "impossible_values", TURN_ROUND if signs else AT_BOUND,
        parameters=tuple(p.name for p in parameters), values=tuple(e.held for e in estimates),
        units=tuple(p.unit for p in parameters),
        likely="the sign of the force columns" if signs else "",
    )  # fmt: skip


# Values far from nominal: a joint to remaster, a robot file of another arm, a missing effect.
#
# How large a value is says nothing by itself.  Where the noise explains what is left and held-out
# poses agree, the value is what the arm has; where much is left, a value that no arm has stands in
# for what the model lacks.

# Beyond it the points hardly move, as of a tip that touches one, or do so otherwise.
LARGEST_SCALE = 3.0
NEARLY = 0.1  # share of the square that a scale leaves of what it explains
SOME = 400  # readings that are enough for it
# What the nominal arm states and a first cell fits.  Base and markers are guesses, and any other
# effect is in the cell because someone named it: their sizes are findings, no evidence.
STATED_BY_FILE = (JointOffset.name, LinkGeometry.name, JointCompliance.name)


def far_values(result: Calibration, explained: bool, lacking: str) -> Iterator[Finding]:
    """Values whose whole interval lies more than FAR typical deviations from nominal, of a
    combination all that it may hold; doubted unless the noise explains the residual
    (`explained`)."""
    ends = {e.name: e.ci95 for e in result.estimates if e.ci95 is not None}
    typical = {p.name: p.typical or 0.0 for p in result.model.parameters}
    for c in result.combinations:
        name = next(iter(c.terms))
        ends[name] = c.ci95
        typical[name] = math.hypot(*(share * typical[n] for n, share in c.terms.items()))
    half = {name: (high - low) / 2 for name, (low, high) in ends.items()}
    far = [
        (p, x - p.nominal, times)
        for p, x in zip(result.model.parameters, result.x.tolist(), strict=True)
        if p.effect in STATED_BY_FILE and p.typical and p.name in half
        and (times := far_off(x - p.nominal, half[p.name], typical[p.name]))
    ]  # fmt: skip
    if zeros := [(p, off) for p, off, _ in far if p.effect == JointOffset.name]:
        told = [f"{p.where.replace('joint', 'joint ')} is off by {_size(off, p.unit)} (known to "
                f"{_size(half[p.name], p.unit)})" for p, off in zeros]  # fmt: skip
        turned = zeros[-1][0].where == f"joint{result.model.chain.n_joints}"
        turned &= result.observations.kind == "pose"
        turned &= MarkerOrientation.name not in {p.effect for p in result.model.parameters}
        yield _note(
            "joint_zero",
            f"The zero of {listed(told)}: remaster it, or command the arm by this calibration."
            + " Where the target is mounted at an angle, fit marker_orientation." * turned,
            joints=tuple(p.where for p, _ in zeros), values=tuple(v for _, v in zeros),
            units=tuple(p.unit for p, _ in zeros), ci95_half=tuple(half[p.name] for p, _ in zeros),
        )  # fmt: skip
    if (scale := scale_of(result)) is not None:
        other = abs(scale - 1) > OF_A_TARGET
        likely = "another robot" if other else "a scale error"
        remedy = (
            "Check that the cell describes the robot that was measured ([robot]): no target or "
            "scale bar is wrong by so much."
            if other
            else "Look for what scales the readings: the size stated of a tag or scale bar, or a "
            f"unit. Multiplied by {rounded(1 / scale, 4)} they have the robot's file's lengths."
        )
        yield _care("scale", remedy, readings_over_file=scale, likely=likely)
        return
    others = sorted((f for f in far if f[0].effect != JointOffset.name), key=lambda f: -f[2])
    if others:
        told = [f"{p.name} by {_size(off, p.unit)} ({_size(half[p.name], p.unit)})"
                for p, off, _ in others]  # fmt: skip
        last, loaded = f"link{result.model.chain.n_joints}", result.observations.table.force.any()
        of_load = loaded and all(p.where == last and p.unit == "m" for p, *_ in others)
        compare = (
            "Check where the load acts ([tool] load_point_m) and the last link, which looks alike"
            if of_load
            else "The arm is not the one of the robot's file: compare its lengths and angles with "
            "the data sheet"
        ) + f" (off, and known to: {listed(told, 3)})."
        yield (_note if explained else _care)(
            "far_from_nominal" if explained else "unheard_of",
            compare if explained else lacking,
            parameters=tuple(p.name for p, *_ in others),
            typical_sizes=tuple(times for *_, times in others),
            values=tuple(off + p.nominal for p, off, _ in others),
            units=tuple(p.unit for p, *_ in others), readings_set_apart=len(result.excluded),
        )  # fmt: skip


def scale_of(result: Calibration) -> float | None:
    """By what factor all lengths that were read exceed those of the nominal arm; None where no such
    scale shows.

    The linear map A of the readings onto the nominal arm is a rotation with a scale where that is
    wrong.  One that takes nine tenths of the square away, differs less between directions than from
    one, and is larger than any arm's lengths err together, is one of the readings.
    """
    table = result.observations.table
    own = any(p.effect == TrackerDistortion.name for p in result.model.parameters)
    if table.position is None or own:
        return None
    extent = float(np.linalg.norm(np.ptp(table.position, axis=0)))
    if not SCALED * extent / 10 < result.nominal_rms < math.inf:
        return None
    table = table.take(result.observations.lead[:: max(len(result.observations.lead) // SOME, 1)])
    if len(np.unique(table.q, axis=0)) < FEWEST_POSES:
        return None
    flange = result.model.rigid.flange_poses(table)
    found = LinearFits(flange[None], np.asarray(table.position), table.marker)
    if not 3 * found.left[0] ** 2 < NEARLY * result.nominal_rms**2:
        return None
    size, scale = np.linalg.svd(found.matrix[0], compute_uv=False), float(found.scale[0])
    alike = found.determinant[0] > 0 and size[0] - size[-1] < abs(scale - 1)
    some = 1 / LARGEST_SCALE < scale < LARGEST_SCALE and abs(scale - 1) > SCALED
    return 1 / scale if alike and some else None


def _size(value: float, unit: str) -> str:
    number, unit = {"m": (value * 1e3, " mm"), "rad": (math.degrees(value), "°")}.get(
        unit, (value, f" {unit}")
    )
    return f"{abs(number):.{2 if abs(number) < 10 else 3}g}{unit}"
