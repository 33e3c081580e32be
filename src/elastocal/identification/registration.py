"""A start from nothing: where base and markers are, from the nominal arm and the readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

SAMPLE = 400  # readings used: a start needs no more
SWEEPS = 60


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
    rough = [_descend(problem, R, sweeps=6) for R in starts]
    best = sorted(rough, key=lambda r: r.error)[:4]
    return min((_descend(problem, r.rotation, SWEEPS, r) for r in best), key=lambda r: r.error)


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
    # rcond: a direction the poses do not show stays at zero instead of running away.
    x = np.linalg.lstsq(A, (target * w).ravel(), rcond=1e-6)[0]
    translation = x[:3] if problem.free_base else problem.base_translation
    found = fixed.copy()
    found[problem.free_markers] = x[3 if problem.free_base else 0 :].reshape(-1, 3)
    return np.asarray(translation, dtype=float), found


def _rotation_between(body: Array, points: Array, weight: Array) -> Array:
    """Weighted Kabsch: R minimising Σ w |p − R b − t|²."""
    w = weight / weight.sum()
    b, p = body - w @ body, points - w @ points
    U, _, Vt = np.linalg.svd((p * w[:, None]).T @ b)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


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
