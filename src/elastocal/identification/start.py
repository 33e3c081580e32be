"""Before the first fit: where base and markers are, from the nominal arm and the readings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy  # whose `optimize` loads where it is used: it takes as long as a small fit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from elastocal.measurements import Measurements
from elastocal.model.effects.placements import BaseFrame, DistanceSensor, MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.units import Array, BoolArray, IntArray

# The linear map of readings onto the nominal arm.  With G_i m + t_i the nominal place of a marker
# m, the readings p_i fit where A p_i + s = G_i m + t_i has a solution: linear in A (3, 3), s and m.
# Of such an A, det says whether the frame of the readings is mirrored and by what scale they are
# too short.

UNSKEWED = 1.25  # largest over smallest singular value of an A that may be a rotation and a scale
TOGETHER = 2**18  # rows at a time
DIGITS = 1e-12
# A tag, a target or a scale bar is wrong by a few per cent at most; another robot by any factor.
OF_A_TARGET = 0.05
SCALED = 0.005  # no arm's lengths are this far off together, relatively: the readings' are


@dataclass(frozen=True)
class LinearFits:
    """Of K joint tables: A (K, 3, 3), and the rms (K,) in m that is left in each component,
    infinite where A is no rotation with a scale."""

    matrix: Array
    left: Array

    @property
    def determinant(self) -> Array:
        return np.linalg.det(self.matrix)

    @property
    def scale(self) -> Array:
        """By what the readings (K,) are to be multiplied."""
        return np.cbrt(np.abs(self.determinant))


def linear_fits(flange: Array, points: Array, marker: IntArray) -> LinearFits:
    """Fits of readings `points` (n, 3) of `marker` (n,) or (K, n) to flanges (K, n, 4, 4)."""
    marker = np.broadcast_to(marker, flange.shape[:2])
    markers = int(marker.max()) + 1
    step = max(TOGETHER // max(flange.shape[1], 1), 1)
    # Rows are components of a reading, one after the other; A and s are the same for all tables
    # and are fitted along by an orthonormal basis.
    Q, R = np.linalg.qr(np.hstack([points - points.mean(axis=0), np.ones((len(points), 1))]))
    back = np.linalg.pinv(R)[:3]
    parts = []
    for k in range(0, len(flange), step):
        T, own = flange[k : k + step], marker[k : k + step, :, None] == np.arange(markers)
        G = (T[..., :3, None, :3] * own[:, :, None, :, None]).reshape(*T.shape[:2], 3, -1)
        parts.append(_linear_fits(np.concatenate([G, T[..., :3, 3:]], axis=3), Q, back))
    return LinearFits(*(np.concatenate(some) for some in zip(*parts, strict=True)))


def _linear_fits(G: Array, Q: Array, back: Array) -> tuple[Array, Array]:
    along = np.einsum("na,knrm->karm", Q, G)
    off = (G - np.einsum("na,karm->knrm", Q, along)).reshape(len(G), -1, G.shape[3])
    X, y = off[..., :-1], off[..., -1:]
    Xt = X.transpose(0, 2, 1)
    m = -np.linalg.pinv(Xt @ X, rcond=DIGITS, hermitian=True) @ (Xt @ y)
    left = np.sqrt(((X @ m + y) ** 2).mean(axis=(1, 2)))
    A = back @ (along[..., -1] + np.einsum("karm,km->kar", along[..., :-1], m[..., 0]))
    size = np.linalg.svd(A, compute_uv=False)
    left[~(size[:, 0] <= UNSKEWED * size[:, -1])] = np.inf
    return A, left


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
        if len(table) > SAMPLE:
            chosen = np.random.default_rng(seed).choice(len(table), SAMPLE, replace=False)
            table = table.take(np.sort(chosen))
        return _distance_start(model, table, x, movable)
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


def _distance_start(model: Model, table: Measurements, x: Array, movable: set[int]) -> Array:
    """Anchor, offset and attachment by robust least squares.

    With p the nominal flange, d the reading, a the anchor and o the offset, |p − a| = d − o is
    linear in a, o and |a|² − o².  Which side of the robot the anchor is on shows only in all poses
    together: mirror images of that solution are tried too, and the best robust cost wins.
    """
    columns = np.array(
        [i for i, p in enumerate(model.parameters)
         if i in movable and p.effect in (DistanceSensor.name, MarkerPosition.name)]
    )  # fmt: skip
    if not len(columns):
        return x
    d, place = np.asarray(table.distance), model.rigid.flange_poses(table)[:, :3, 3]
    anchor = [i for i in columns if "anchor" in model.parameters[i].name]
    starts = [x]
    if anchor:
        centre = place.mean(axis=0)
        p, ones = place - centre, np.ones(len(d))
        linear = np.column_stack([-2 * p, -2 * d, ones])
        found = np.linalg.lstsq(linear, d**2 - (p**2).sum(axis=1))[0][:3]
        axes = np.linalg.svd(p, full_matrices=False)[2]
        for side in product((1, -1), repeat=3):
            trial = x.copy()
            trial[anchor] = centre + axes.T @ (side * (axes @ found))
            starts.append(trial)

    def values(z: Array) -> Array:
        y = x.copy()
        y[columns] = z
        return y

    tried = [
        scipy.optimize.least_squares(
            lambda z: model.predict(table, values(z)) - d, start[columns],
            lambda z: model.regressor(table, values(z), columns).B,
            loss="soft_l1", f_scale=2e-3, max_nfev=60,
        )
        for start in starts
    ]  # fmt: skip
    return values(min(tried, key=lambda one: float(one.cost)).x)
