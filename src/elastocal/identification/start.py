"""Before the first fit: does the table fit the robot, and where do base and markers start?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from elastocal.errors import InputError, InsufficientDataError, option
from elastocal.identification.joint_maps import linear_fits
from elastocal.measurements import Measurements
from elastocal.model.chain import joint_limits
from elastocal.model.effects.placements import BaseFrame, DistanceSensor, MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.text import did_you_mean
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


# A start from nothing: where base and markers are, from the nominal arm and the readings.

SAMPLE = 400  # readings used: a start needs no more
ROUGH_SWEEPS, SWEEPS = 6, 60
FINALISTS = 4
SETTLED = 1e-6  # change of the median distance, relative, with which the sweeps end
RCOND = 1e-6  # a direction the poses do not show stays at zero instead of running away


@dataclass(frozen=True)
class Registration:
    """T_tracker_base as rotation (3, 3) and translation (3,), `markers` (M, 3) in the flange
    frame, and the median distance `error` in m of readings from the nominal arm."""

    rotation: Array
    translation: Array
    markers: Array
    error: float

    def places(self, turn: Array, position: Array, marker: IntArray) -> Array:
        """Where flanges at `turn` (n, 3, 3) and `position` (n, 3) have each `marker` (n,)."""
        body = np.einsum("nij,nj->ni", turn, self.markers[marker]) + position
        return np.asarray(body @ self.rotation.T + self.translation)


@dataclass(frozen=True)
class RegistrationProblem:
    """Find R_b, t_b, m with p_i = R_b (R_i m_c(i) + t_i) + t_b.

    `flange_rotation` (n, 3, 3) and `flange_position` (n, 3): nominal flange poses in the base
    frame; `points` (n, 3) readings; `marker` (n,) codes into `start_markers` (M, 3).
    `free_markers` (M,) says which marker positions are unknown, `free_base` whether the base is;
    a known base is (`base_rotation`, `base_translation`).
    """

    flange_rotation: Array
    flange_position: Array
    points: Array
    marker: IntArray
    start_markers: Array
    free_markers: BoolArray
    free_base: bool
    base_rotation: Array
    base_translation: Array


def nominal_problem(model: Model, table: Measurements) -> RegistrationProblem:
    """Base and all markers free, of the nominal arm and positions."""
    T = model.rigid.flange_poses(table)
    return RegistrationProblem(
        T[:, :3, :3], T[:, :3, 3], np.asarray(table.position), table.marker,
        np.zeros((len(table.marker_names), 3)), np.ones(len(table.marker_names), dtype=bool),
        True, np.eye(3), np.zeros(3),
    )  # fmt: skip


def register(problem: RegistrationProblem, seed: int = 0) -> Registration:
    """Robust alternating registration from several starts; the best by median distance wins.

    Starts: the base turned as the linear (non-orthogonal) solution says, as a fit with the
    start markers says, and as the 24 rotations of a cube, so that any attitude is near one.
    """
    n = len(problem.points)
    if n > SAMPLE:
        chosen = np.random.default_rng(seed).choice(n, SAMPLE, replace=False)
        of_rows = ("flange_rotation", "flange_position", "points", "marker")
        problem = replace(problem, **{name: getattr(problem, name)[chosen] for name in of_rows})
    starts = problem.base_rotation[None]
    if problem.free_base:
        flange = np.zeros((len(problem.points), 4, 4))
        flange[:, :3, :3], flange[:, :3, 3] = problem.flange_rotation, problem.flange_position
        linear = linear_fits(flange[None], problem.points, problem.marker).matrix[0]
        U, _, Vt = np.linalg.svd(linear.T)
        body = _body_points(problem, problem.start_markers)
        starts = np.stack([
            U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt,
            _rotation_between(body, problem.points, np.ones(len(body))),
            *Rotation.create_group("O").as_matrix(),
        ])  # fmt: skip
    rough = _descended(problem, starts, np.ones((len(starts), len(problem.points))), ROUGH_SWEEPS)
    # A few sweeps show which starts lead where; the others need not be gone through to the end.
    nearest = np.argsort(rough[3], kind="stable")[:FINALISTS]
    rotation, translation, markers, error, _ = _descended(
        problem, rough[0][nearest], rough[4][nearest], SWEEPS
    )
    best = int(np.argmin(error))
    return Registration(rotation[best], translation[best], markers[best], float(error[best]))


def _descended(
    problem: RegistrationProblem, rotation: Array, weight: Array, sweeps: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Rotations, translations, markers, median distances and weights after `sweeps` from every
    `rotation` (s, 3, 3) and `weight` (s, n), all of them together.

    Translation and markers (linear) and rotation (Kabsch) in turn, reweighted by distance so that
    a share of wrong readings does not pull the start.
    """
    translation, markers = _linear_parts(problem, rotation, weight)
    error = np.full(len(rotation), np.inf)
    for _ in range(sweeps):
        if problem.free_base:
            body = _body_points(problem, markers)
            rotation = _rotation_between(body, problem.points, weight)
        translation, markers = _linear_parts(problem, rotation, weight)
        predicted = _body_points(problem, markers) @ rotation.swapaxes(1, 2) + translation[:, None]
        distance = np.linalg.norm(problem.points - predicted, axis=2)
        previous, error = error, np.median(distance, axis=1)
        weight = 1.0 / np.maximum(distance, np.maximum(error, 1e-9)[:, None])
        if (np.abs(previous - error) <= SETTLED * error).all():
            break
    return rotation, translation, markers, error, weight


def _linear_parts(problem: RegistrationProblem, R: Array, weight: Array) -> tuple[Array, Array]:
    """Translation (s, 3) and markers (s, M, 3) for every rotation R (s, 3, 3) and weight (s, n).

    With u = Rᵀt the equations u + R_i m = Rᵀp − t_i have one matrix for all rotations, of
    orthogonal blocks.  Its normal equations cost half the digits, which a start can spare.
    """
    turn, code = problem.flange_rotation, problem.marker
    free = np.flatnonzero(problem.free_markers)
    fixed = problem.start_markers * ~problem.free_markers[:, None]
    known = np.zeros(3) if problem.free_base else problem.base_translation
    y = (problem.points - known) @ R - _body_points(problem, fixed)
    size = 3 + 3 * len(free)
    normal, right = np.zeros((len(R), size, size)), np.empty((len(R), size))
    own = np.arange(3)
    normal[:, own, own] = weight.sum(axis=1)[:, None]
    right[:, :3] = (weight[..., None] * y).sum(axis=1)
    for k, c in enumerate(free):
        here, at = code == c, slice(3 + 3 * k, 6 + 3 * k)
        w = weight[:, here]
        cross = (w @ turn[here].reshape(-1, 9)).reshape(-1, 3, 3)
        normal[:, :3, at], normal[:, at, :3] = cross, cross.transpose(0, 2, 1)
        normal[:, 3 + 3 * k + own, 3 + 3 * k + own] = w.sum(axis=1)[:, None]
        weighted = (w[..., None] * y[:, here]).reshape(len(R), -1)
        right[:, at] = weighted @ turn[here].reshape(-1, 3)
    sought = slice(0 if problem.free_base else 3, size)
    values, vectors = np.linalg.eigh(normal[:, sought, sought])
    shown = values > RCOND**2 * values[:, -1:]
    along = (right[:, None, sought] @ vectors)[:, 0] / np.where(shown, values, np.inf)
    x = np.zeros((len(R), size))
    x[:, sought] = (vectors @ along[..., None])[..., 0]
    markers = np.broadcast_to(fixed, (len(R), *fixed.shape)).copy()
    markers[:, free] = x[:, 3:].reshape(len(R), -1, 3)
    return known + (R @ x[:, :3, None])[..., 0], markers


def _body_points(problem: RegistrationProblem, markers: Array) -> Array:
    """Where `markers` (…, M, 3) are read (…, n, 3) in the base frame."""
    turn, code = problem.flange_rotation, problem.marker
    out = np.empty((*markers.shape[:-2], *problem.flange_position.shape))
    for k in range(markers.shape[-2]):
        here = code == k
        turned = markers[..., k, :] @ turn[here].reshape(-1, 3).T
        out[..., here, :] = (
            turned.reshape(*turned.shape[:-1], -1, 3) + problem.flange_position[here]
        )
    return out


def _rotation_between(body: Array, points: Array, weight: Array) -> Array:
    """Weighted Kabsch: R (…, 3, 3) minimising Σ w |p − R b − t|², `body` (…, n, 3)."""
    w = (weight / weight.sum(axis=-1, keepdims=True))[..., None, :]
    b, p = body - w @ body, points - w @ points
    U, _, Vt = np.linalg.svd((p.swapaxes(-1, -2) * w) @ b)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt, dtype=np.float64)


# Starting values found from the data: base, markers and target orientation, or cable geometry.

DISTANCE_STARTS = 64
DISTANCE_SAMPLE = 300


def start_values(
    model: Model, table: Measurements, seed: int = 0, free: IntArray | None = None
) -> Array:
    """Parameter values (parameters,) near the data: nominal, but base, markers and cable placed.

    Only parameters that are active in the model and among `free` (default all) are moved.
    Positions are registered to the nominal arm; distances are fitted by a robust multi-start.
    """
    x = model.nominal.copy()
    movable = set(range(len(x)) if free is None else free.tolist())
    if model.observe == "distance":
        return _distance_start(model, table, x, seed, movable)
    if table.position is None:
        return x
    places = {
        p.where
        for i, p in enumerate(model.parameters)
        if i in movable and p.effect in (BaseFrame.name, MarkerPosition.name)
    }
    if not places:
        return x
    names = list(model.cell.tool.markers)
    codes = np.array([names.index(m) for m in table.marker_names])[table.marker]
    # Deflected readings would pull the start; unloaded ones serve alone where they are enough
    # and show every marker.
    light = ~np.any(table.force != 0, axis=1)
    enough = light.sum() >= 12 and np.array_equal(np.unique(codes[light]), np.unique(codes))
    rows = np.flatnonzero(light) if enough else np.arange(len(table))
    if len(rows) > SAMPLE:
        rows = np.random.default_rng(seed).choice(rows, SAMPLE, replace=False)
    T = model.rigid.flange_poses(table.take(rows))
    nominal = model.cell.model.nominal
    problem = RegistrationProblem(
        T[:, :3, :3], T[:, :3, 3], table.position[rows], codes[rows],
        np.array([model.cell.tool.markers[m] for m in names]),
        np.array([f"marker:{m}" in places for m in names]),
        "base" in places,
        np.eye(3) if nominal.base_rotation is None else nominal.base_rotation,
        np.zeros(3) if nominal.base_position is None else nominal.base_position,
    )  # fmt: skip
    found = register(problem, seed)
    values = dict(zip(("base.x", "base.y", "base.z"), found.translation, strict=True))
    vector = Rotation.from_matrix(found.rotation).as_rotvec()
    values |= dict(zip(("base.rx", "base.ry", "base.rz"), vector, strict=True))
    for name, position in zip(names, found.markers, strict=True):
        values |= {f"marker:{name}.{k}": v for k, v in zip("xyz", position, strict=True)}
    if model.observe == "pose" and table.rotation is not None:
        values |= _target_rotations(found.rotation, T, table.take(rows), codes[rows], names)
    for i, parameter in enumerate(model.parameters):
        if parameter.name in values and i in movable:
            x[i] = values[parameter.name]
    return x


def _target_rotations(
    base: Array, T: Array, table: Measurements, codes: NDArray, names: list[str]
) -> dict[str, float]:
    measured = Rotation.from_rotvec(np.asarray(table.rotation))
    relative = Rotation.from_matrix(base @ T[:, :3, :3]).inv() * measured
    values: dict[str, float] = {}
    for c, name in enumerate(names):
        if (codes == c).any():
            vector = relative[codes == c].mean().as_rotvec()
            values |= {f"marker:{name}.r{k}": v for k, v in zip("xyz", vector, strict=True)}
    return values


def _distance_start(
    model: Model, table: Measurements, x: Array, seed: int, movable: set[int]
) -> Array:
    """Anchor, offset and attachment by robust least squares from many anchors.

    A distance tells the side of the robot on which the anchor lies only through all poses
    together, so anchors are tried on a sphere around the poses; the best robust cost wins.
    """
    from scipy.stats import qmc  # slow to import, seldom asked for

    columns = np.array(
        [i for i, p in enumerate(model.parameters)
         if i in movable and p.effect in (DistanceSensor.name, MarkerPosition.name)]
    )  # fmt: skip
    if not len(columns):
        return x
    rng = np.random.default_rng(seed)
    if len(table) > DISTANCE_SAMPLE:
        table = table.take(np.sort(rng.choice(len(table), DISTANCE_SAMPLE, replace=False)))
    distance = np.asarray(table.distance)
    centre = model.rigid.flange_poses(table)[:, :3, 3].mean(axis=0)
    anchor = [i for i in columns if "anchor" in model.parameters[i].name]
    directions = qmc.Sobol(3, rng=seed).random(DISTANCE_STARTS) * 2 - 1
    best, best_cost = x, np.inf
    given = model.cell.tracker.anchor is not None

    def values(z: Array) -> Array:
        y = x.copy()
        y[columns] = z
        return y

    def residual(z: Array) -> Array:
        return model.predict(table, values(z)) - distance

    def jacobian(z: Array) -> Array:
        return model.regressor(table, values(z), columns).B

    for k, direction in enumerate(directions):
        trial = x.copy()
        if anchor and not (given and k == 0):
            unit = direction / np.linalg.norm(direction)
            trial[anchor] = centre + unit * np.median(distance)
        found = least_squares(
            residual, trial[columns], jacobian, loss="soft_l1", f_scale=2e-3, max_nfev=60
        )
        if found.cost < best_cost:
            best, best_cost = values(found.x), found.cost
    return best
