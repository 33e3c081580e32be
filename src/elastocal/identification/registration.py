"""A start from nothing: where base and markers are, from the nominal arm and the readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

SAMPLE = 400  # readings used: a start needs no more
ROUGH_SWEEPS, SWEEPS = 6, 60
FINALISTS = 4
RCOND = 1e-6  # a direction the poses do not show stays at zero instead of running away


@dataclass(frozen=True)
class Registration:
    """T_tracker_base as rotation (3, 3) and translation (3,), `markers` (M, 3) in the flange
    frame, and the median distance `error` in m of readings from the nominal arm."""

    rotation: Array
    translation: Array
    markers: Array
    error: float


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
    marker: NDArray[np.int64]
    start_markers: Array
    free_markers: NDArray[np.bool_]
    free_base: bool
    base_rotation: Array
    base_translation: Array


def register(problem: RegistrationProblem, seed: int = 0) -> Registration:
    """Robust alternating registration from several starts; the best by median distance wins.

    Starts: the base turned as the linear (non-orthogonal) solution says, as a fit with the
    start markers says, and as the 24 rotations of a cube, so that any attitude is near one.
    """
    n = len(problem.points)
    if n > SAMPLE:
        chosen = np.random.default_rng(seed).choice(n, SAMPLE, replace=False)
        problem = _subset(problem, chosen)
    if not problem.free_base:
        return _descend(problem, problem.base_rotation, sweeps=3)
    starts = [_linear_rotation(problem), _kabsch_rotation(problem, problem.start_markers)]
    starts += list(Rotation.create_group("O").as_matrix())
    # All starts together show which ones lead where; those are gone through again with all digits.
    nearest = np.argsort(_errors(problem, np.array(starts)), kind="stable")[:FINALISTS]
    best = [_descend(problem, starts[k], ROUGH_SWEEPS) for k in nearest]
    return min((_descend(problem, r.rotation, SWEEPS, r) for r in best), key=lambda r: r.error)


def _errors(problem: RegistrationProblem, rotation: Array) -> Array:
    """Median distances (starts,) after a few sweeps of `_descend` from every `rotation`
    (starts, 3, 3), all of them together."""
    weight = np.ones((len(rotation), len(problem.points)))
    for sweep in range(ROUGH_SWEEPS + 1):
        translation, markers = _linear_parts(problem, rotation, weight)
        turned = np.einsum("nij,snj->sni", problem.flange_rotation, markers[:, problem.marker])
        body = turned + problem.flange_position
        if sweep < ROUGH_SWEEPS:
            rotation = _rotation_between(body, problem.points, weight)
        predicted = body @ rotation.transpose(0, 2, 1) + translation[:, None]
        distance = np.linalg.norm(problem.points - predicted, axis=2)
        error = np.median(distance, axis=1)
        weight = 1.0 / np.maximum(distance, np.maximum(error, 1e-9)[:, None])
    return np.asarray(error, dtype=np.float64)


def _linear_parts(problem: RegistrationProblem, R: Array, weight: Array) -> tuple[Array, Array]:
    """As `_linear_part` with a free base, for every rotation R (s, 3, 3) and weight (s, n).

    With u = Rᵀt the equations u + R_i m = Rᵀp − t_i have one matrix for all rotations, of
    orthogonal blocks.  Its normal equations cost half the digits, which a search can spare.
    """
    turn, code = problem.flange_rotation, problem.marker
    free = np.flatnonzero(problem.free_markers)
    fixed = problem.start_markers * ~problem.free_markers[:, None]
    y = problem.points @ R - _body_points(problem, fixed)
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
        right[:, at] = np.einsum("nij,sni->sj", turn[here], w[..., None] * y[:, here])
    values, vectors = np.linalg.eigh(normal)
    shown = values > RCOND**2 * values[:, -1:]
    along = (right[:, None] @ vectors)[:, 0] / np.where(shown, values, np.inf)
    x = (vectors @ along[..., None])[..., 0]
    markers = np.broadcast_to(fixed, (len(R), *fixed.shape)).copy()
    markers[:, free] = x[:, 3:].reshape(len(R), -1, 3)
    return (R @ x[:, :3, None])[..., 0], markers


def _subset(problem: RegistrationProblem, rows: NDArray) -> RegistrationProblem:
    return RegistrationProblem(
        problem.flange_rotation[rows], problem.flange_position[rows], problem.points[rows],
        problem.marker[rows], problem.start_markers, problem.free_markers, problem.free_base,
        problem.base_rotation, problem.base_translation,
    )  # fmt: skip


def _descend(
    problem: RegistrationProblem, rotation: Array, sweeps: int, start: Registration | None = None
) -> Registration:
    """Alternate between translation and markers (linear) and rotation (Kabsch), reweighted
    by distance so that a share of wrong readings does not pull the start."""
    translation = problem.base_translation if start is None else start.translation
    markers = problem.start_markers.copy() if start is None else start.markers
    weight = np.ones(len(problem.points))
    error = np.inf
    for _ in range(sweeps):
        translation, markers = _linear_part(problem, rotation, markers, weight)
        if problem.free_base:
            body = _body_points(problem, markers)
            rotation = _rotation_between(body, problem.points, weight)
        distance = _distance(problem, rotation, translation, markers)
        previous, error = error, float(np.median(distance))
        weight = 1.0 / np.maximum(distance, max(error, 1e-9))
        if abs(previous - error) <= 1e-6 * error:
            break
    translation, markers = _linear_part(problem, rotation, markers, weight)
    distance = _distance(problem, rotation, translation, markers)
    return Registration(rotation, translation, markers, float(np.median(distance)))


def _body_points(problem: RegistrationProblem, markers: Array) -> Array:
    turned = np.einsum("nij,nj->ni", problem.flange_rotation, markers[problem.marker])
    return turned + problem.flange_position


def _distance(problem: RegistrationProblem, R: Array, t: Array, markers: Array) -> Array:
    return np.linalg.norm(problem.points - _body_points(problem, markers) @ R.T - t, axis=1)


def _linear_part(
    problem: RegistrationProblem, R: Array, markers: Array, weight: Array
) -> tuple[Array, Array]:
    """Base translation and free markers at a fixed base rotation, by weighted least squares."""
    n, M = len(problem.points), len(markers)
    fixed = markers * ~problem.free_markers[:, None]
    target = problem.points - _body_points(problem, fixed) @ R.T
    columns = [np.tile(np.eye(3), (n, 1, 1))] if problem.free_base else []
    for c in range(M):
        if problem.free_markers[c]:
            columns.append((problem.marker == c)[:, None, None] * (R @ problem.flange_rotation))
    if not problem.free_base:
        target = target - problem.base_translation
    if not columns:
        return problem.base_translation, fixed
    w = np.sqrt(weight)[:, None]
    A = (np.concatenate(columns, axis=2) * w[..., None]).reshape(3 * n, -1)
    x = np.linalg.lstsq(A, (target * w).ravel(), rcond=RCOND)[0]
    translation = x[:3] if problem.free_base else problem.base_translation
    found = fixed.copy()
    found[problem.free_markers] = x[3 if problem.free_base else 0 :].reshape(-1, 3)
    return np.asarray(translation, dtype=float), found


def _rotation_between(body: Array, points: Array, weight: Array) -> Array:
    """Weighted Kabsch: R (…, 3, 3) minimising Σ w |p − R b − t|², `body` (…, n, 3)."""
    w = (weight / weight.sum(axis=-1, keepdims=True))[..., None, :]
    b, p = body - w @ body, points - w @ points
    U, _, Vt = np.linalg.svd((p.swapaxes(-1, -2) * w) @ b)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt, dtype=np.float64)


def _kabsch_rotation(problem: RegistrationProblem, markers: Array) -> Array:
    return _rotation_between(
        _body_points(problem, markers), problem.points, np.ones(len(problem.points))
    )


def _linear_rotation(problem: RegistrationProblem) -> Array:
    """Rotation nearest to the matrix A in A p + s − R_i m = t_i, all unknowns free at once."""
    n, M = len(problem.points), len(problem.start_markers)
    A = np.zeros((n, 3, 12 + 3 * M))
    for k in range(3):
        A[:, k, 3 * k : 3 * k + 3] = problem.points
        A[:, k, 9 + k] = 1.0
    for c in range(M):
        here = (problem.marker == c)[:, None, None]
        A[:, :, 12 + 3 * c : 15 + 3 * c] = -(here * problem.flange_rotation)
    x = np.linalg.lstsq(A.reshape(3 * n, -1), problem.flange_position.ravel(), rcond=1e-9)[0]
    U, _, Vt = np.linalg.svd(x[:9].reshape(3, 3).T)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
