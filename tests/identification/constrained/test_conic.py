"""Huber losses and semidefinite matrices against independent solutions and their optimality."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import optimize
from support.constrained import solve

from elastocal.errors import InputError
from elastocal.identification.constrained_solver import ConstrainedObjective, ResidualLoss
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    LinearEquality,
    SemidefiniteMatrix,
    non_negative,
)
from elastocal.identification.robust import huber

NAMES = tuple("abcdef")
UNIT = np.array([1e-7, 1e-7, 1e-7, 1e-3, 1e-3, 1e-3])
FULL = SemidefiniteMatrix("K", (("a", "d", "e"), ("d", "b", "f"), ("e", "f", "c")))
PLANE = SemidefiniteMatrix("K", (("a", "b"), ("b", "c")))


def problem(seed: int, truth=None, rows: int = 90, outliers: int = 0):
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(rows, 6)) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6))) / UNIT
    x = UNIT * (rng.normal(size=6) if truth is None else np.asarray(truth))
    y = B @ x + rng.normal(size=rows)
    y[: 3 * outliers] += 40 * rng.normal(size=3 * outliers)
    return B, y


def matrix(x: np.ndarray) -> np.ndarray:
    """The matrix FULL of the parameters in units of UNIT."""
    a, b, c, d, e, f = x / UNIT
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


# FULL mixes units on purpose, as a 6 × 6 base compliance does; rescaled to one for comparison.
SCALED = Constraints(
    matrices=(
        SemidefiniteMatrix(
            "K",
            tuple(
                tuple({name: 1 / UNIT[NAMES.index(name)]} for name in row) for row in FULL.entries
            ),
        ),
    )
)


@pytest.mark.parametrize("size", [1, 3])
def test_huber_without_constraints_solves_its_equations(size):
    B, y = problem(1, outliers=5)
    found = solve(B, y, NAMES, loss="huber", size=size)
    r = (y - B @ found.x).reshape(-1, size)
    d, k = np.linalg.norm(r, axis=1), huber(size).c
    assert (d > k).sum() >= 5
    psi = (r * np.minimum(1, k / d)[:, None]).ravel()
    assert np.abs(B.T @ psi / np.linalg.norm(B, axis=0)).max() < 1e-11 * np.linalg.norm(y)
    assert found.kkt < 1e-13


def test_huber_by_row_is_statsmodels():
    B, y = problem(2, outliers=5)
    c = huber(1).c
    rlm = sm.RLM(y, B * UNIT, M=sm.robust.norms.HuberT(c)).fit(tol=1e-13, maxiter=500)
    found = solve(B, y, NAMES, loss="huber", sigma=rlm.scale)
    np.testing.assert_allclose(found.x / UNIT, rlm.params, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("size", [1, 3])
def test_constrained_huber_is_a_bounded_smooth_minimum(size):
    B, y = problem(3, truth=[1, -0.2, 0.5, -0.3, 2, 0.0], outliers=5)
    found = solve(B, y, NAMES, non_negative(*NAMES), loss="huber", size=size)
    J, k = B * UNIT, huber(size).c

    def cost(z):
        d = np.linalg.norm((y - J @ z).reshape(-1, size), axis=1)
        w = np.repeat(np.minimum(1, k / d), size)
        rho = np.where(d <= k, d**2, 2 * k * d - k**2).sum()
        return rho, -2 * J.T @ (w * (y - J @ z))

    reference = optimize.minimize(
        cost, np.ones(6), jac=True, method="L-BFGS-B", bounds=[(0, None)] * 6,
        options={"ftol": 1e-16, "gtol": 1e-9, "maxiter": 2000},
    )  # fmt: skip
    assert found.objective <= reference.fun * (1 + 1e-12)
    np.testing.assert_allclose(found.x / UNIT, reference.x, atol=1e-5)
    active = {a.names[0] for a in found.active}
    assert active == {NAMES[i] for i in np.flatnonzero(found.x == 0)} >= {"b", "d"}
    assert found.kkt < 1e-13


def test_huber_resists_what_squares_do_not():
    truth = UNIT * np.array([1.0, 2.0, 0.0, 0.5, 1.0, 1.0])
    clean_B, _ = problem(4)
    noise = np.random.default_rng(40).normal(size=90)
    spoilt = noise.copy()
    spoilt[:9] += 300.0
    far = {
        loss: np.linalg.norm(
            (solve(clean_B, clean_B @ truth + spoilt, NAMES, non_negative(*NAMES),
                               loss=loss, size=3).x - truth) / UNIT
        )
        for loss in ("squares", "huber")
    }  # fmt: skip
    assert far["huber"] < 0.2 * far["squares"]


@pytest.mark.parametrize("size", [1, 3])
def test_half_the_hessian_is_the_derivative_of_half_the_gradient(size):
    B, y = problem(5, outliers=5)
    objective = ConstrainedObjective(
        B * UNIT, y, np.eye(6)[:2], np.ones(2), ResidualLoss(1.5, size)
    )
    x = np.full(6, 0.3)
    K = objective.root(x)
    step = 1e-6
    numeric = np.column_stack(
        [
            (objective.half_gradient(x + step * e) - objective.half_gradient(x - step * e))
            / (2 * step)
            for e in np.eye(6)
        ]
    )
    np.testing.assert_allclose(K.T @ K, numeric, rtol=1e-6, atol=1e-6)
    gradient = [
        (objective.value(x + step * e) - objective.value(x - step * e)) / (4 * step)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(objective.half_gradient(x), gradient, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_semidefinite_fit_is_the_best_factor(seed):
    # Random truth is indefinite: the constraint binds, with a null space of one or two.
    B, y = problem(seed)
    found = solve(B, y, NAMES, SCALED)
    K = matrix(found.x)
    values = np.linalg.eigvalsh(K)
    assert values[0] > -1e-12 * max(values[-1], 1)
    assert found.kkt < 1e-11
    assert [a.kind for a in found.active] == ["semidefinite"]
    assert found.active[0].multiplier > 0

    def residual(factor):
        L = np.zeros((3, 3))
        L[np.tril_indices(3)] = factor
        M = L @ L.T
        z = np.array([M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2]])
        return B @ (UNIT * z) - y

    fits = [
        optimize.least_squares(
            residual, np.random.default_rng(k).normal(size=6), xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        for k in range(3)
    ]
    best = 2 * min(f.cost for f in fits)
    assert found.objective <= best * (1 + 1e-12)
    assert found.objective >= best * (1 - 1e-6)


def test_semidefinite_fit_beats_the_projection_of_the_free_fit():
    B, y = problem(1)
    free = solve(B, y, NAMES)
    values, vectors = np.linalg.eigh(matrix(free.x))
    assert values[0] < 0
    P = (vectors * np.maximum(values, 0)) @ vectors.T
    projected = UNIT * np.array([P[0, 0], P[1, 1], P[2, 2], P[0, 1], P[0, 2], P[1, 2]])
    found = solve(B, y, NAMES, SCALED)
    assert free.objective < found.objective < np.sum((y - B @ projected) ** 2)


def test_a_matrix_the_data_agree_with_changes_nothing():
    B, y = problem(0, truth=[3, 3, 3, 0.5, 0.5, 0.5])
    free, found = solve(B, y, NAMES), solve(B, y, NAMES, SCALED)
    np.testing.assert_allclose(found.x, free.x, rtol=1e-13)
    assert found.active == ()


def test_a_diagonal_matrix_is_bounds():
    B, y = problem(7)
    diagonal = SemidefiniteMatrix("D", (("a", 0, 0), (0, "b", 0), (0, 0, "c")))
    as_matrix = solve(B, y, NAMES, Constraints(matrices=(diagonal,)))
    as_bounds = solve(B, y, NAMES, non_negative("a", "b", "c"))
    assert as_bounds.active
    np.testing.assert_allclose(as_matrix.x / UNIT, as_bounds.x / UNIT, atol=1e-10)
    assert as_matrix.active[0].multiplier == pytest.approx(
        sum(a.multiplier for a in as_bounds.active), rel=1e-8
    )


def test_the_multiplier_of_a_matrix_is_the_price_of_a_larger_smallest_eigenvalue():
    B, y = problem(2)

    def shifted(t: float) -> Constraints:
        entries = (({"a": 1.0, "": -t}, "b"), ("b", {"c": 1.0, "": -t}))
        return Constraints(matrices=(SemidefiniteMatrix("K", entries),))

    found = solve(B, y, NAMES, shifted(0.0))
    (active,) = found.active
    up, down = (solve(B, y, NAMES, shifted(s * 1e-11)).objective for s in (1, -1))
    assert active.multiplier == pytest.approx((up - down) / 2e-11, rel=1e-3)
    assert active.names == ("a", "b", "c")


def test_all_kinds_of_constraints_at_once_satisfy_kkt():
    B, y = problem(3)
    stated = SCALED + Constraints(
        (Bounds("a", upper=0.5e-7), Bounds("f", lower=1e-4)),
        (LinearEquality({"b": 1.0, "c": -1.0}),),
    )
    for loss in ("squares", "huber"):
        found = solve(B, y, NAMES, stated, loss=loss, size=3)
        assert found.kkt < 1e-9
        assert found.x[0] <= 0.5e-7 and found.x[5] >= 1e-4
        assert found.x[1] == pytest.approx(found.x[2], rel=1e-12, abs=1e-20)
        assert np.linalg.eigvalsh(matrix(found.x))[0] > -1e-10


def test_contradicting_matrix_is_named():
    B, y = problem(0)
    stated = Constraints((Bounds("d", lower=0.0),), (LinearEquality({"a": 1.0, "c": 1.0}, -1e-7),))
    stated += Constraints(matrices=(PLANE,))
    with pytest.raises(InputError, match="contradict") as error:
        solve(B, y, NAMES, stated)
    assert "'K'" in str(error.value) and "a + c" in str(error.value)
    assert "bound of d" not in str(error.value)


AXES = ("x", "y", "z", "rx", "ry", "rz")
PAIRS = tuple(combinations_with_replacement(range(6), 2))
BASE_NAMES = tuple(f"base.{AXES[i]}" + (AXES[j] if j != i else "") for i, j in PAIRS)
# m/N, rad/(N m) and what couples them, as a pedestal has.
DIAGONAL = np.array([1e-8] * 3 + [1e-7] * 3)


@pytest.mark.parametrize("noise", [1.0, 1e-3, 0.0])
@pytest.mark.parametrize("rank", [1, 3, 5])
@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_a_six_by_six_base_compliance_on_the_boundary(noise, rank, loss):
    # A stiff pedestal is soft in a few directions only: the true matrix is singular.
    rng = np.random.default_rng(rank)
    F = rng.normal(size=(6, rank)) * np.sqrt(DIAGONAL)[:, None]
    truth = np.array([(F @ F.T)[i, j] for i, j in PAIRS])
    sizes = np.array([np.sqrt(DIAGONAL[i] * DIAGONAL[j]) for i, j in PAIRS])
    entries = [[""] * 6 for _ in range(6)]
    for name, (i, j) in zip(BASE_NAMES, PAIRS, strict=True):
        entries[i][j] = entries[j][i] = name
    B = rng.normal(size=(300, 21)) / sizes * 3
    y = B @ truth + noise * rng.normal(size=300)
    stated = Constraints(matrices=(SemidefiniteMatrix("base", tuple(map(tuple, entries))),))
    found = solve(B, y, BASE_NAMES, stated, loss=loss, size=3)
    assert found.kkt < 1e-9
    K = np.zeros((6, 6))
    for value, (i, j) in zip(found.x, PAIRS, strict=True):
        K[i, j] = K[j, i] = value / np.sqrt(DIAGONAL[i] * DIAGONAL[j])
    assert np.linalg.eigvalsh(K)[0] > -1e-12
    # Free estimates have a standard deviation of noise/(3 √300) each; 6 of these for 21 of them.
    assert np.abs((found.x - truth) / sizes).max() < 6 * noise / (3 * 300**0.5) + 1e-13


def test_a_fit_follows_the_units_of_its_matrix():
    B, y = problem(2)
    one = solve(B, y, NAMES, Constraints(matrices=(PLANE,)))
    scaled = {n: {n: 1e6} for n in "abc"}
    K = SemidefiniteMatrix("K", ((scaled["a"], scaled["b"]), (scaled["b"], scaled["c"])))
    other = solve(B, y, NAMES, Constraints(matrices=(K,)))
    np.testing.assert_allclose(other.x / UNIT, one.x / UNIT, atol=1e-11)
    assert other.active[0].multiplier == pytest.approx(one.active[0].multiplier * 1e-6, rel=1e-8)
