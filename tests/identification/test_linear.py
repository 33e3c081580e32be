"""The linear solver against rational arithmetic, its invariances, rank loss and bad input."""

from fractions import Fraction

import numpy as np
import pytest

from elastocal.identification import linear_solver
from elastocal.identification.linear_solver import least_norm, solve_weighted


def rational_solution(B, y, w):
    """x, (B^T W^2 B)^-1, rss of the given doubles in exact rational arithmetic, then rounded."""
    rows = [[Fraction(v) * Fraction(wi) for v in row] for row, wi in zip(B, w, strict=True)]
    right = [Fraction(v) * Fraction(wi) for v, wi in zip(y, w, strict=True)]
    p = B.shape[1]
    table = [
        [sum(r[i] * r[j] for r in rows) for j in range(p)]
        + [Fraction(int(i == j)) for j in range(p)]
        + [sum(r[i] * v for r, v in zip(rows, right, strict=True))]
        for i in range(p)
    ]
    for i in range(p):
        table[i] = [v / table[i][i] for v in table[i]]
        for k in range(p):
            if k != i:
                factor = table[k][i]
                table[k] = [a - factor * b for a, b in zip(table[k], table[i], strict=True)]
    x = [line[-1] for line in table]
    rss = sum(
        (v - sum(a * b for a, b in zip(r, x, strict=True))) ** 2
        for r, v in zip(rows, right, strict=True)
    )
    inverse = np.array([[float(v) for v in line[p : 2 * p]] for line in table])
    return np.array([float(v) for v in x]), inverse, float(rss)


def std(solution):
    return np.sqrt(np.diag(solution.covariance()))


def random_problem(seed, m=30, p=6):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(m, p)), rng.normal(size=m), rng.uniform(0.1, 10, m)


def polynomial_problem(seed, degree=8, residual=1e6):
    """Ill conditioned (about 1e5 after scaling), residual far above the signal."""
    rng = np.random.default_rng(seed)
    B = np.vander(rng.uniform(0, 5, 25), degree, increasing=True)
    return B, B.sum(axis=1) + residual * rng.normal(size=25), rng.uniform(0.01, 100, 25)


def nearly_dependent_problem(seed, gap=1e-11):
    B, y, w = random_problem(seed, m=20, p=5)
    B[:, 2] = B[:, 0] - B[:, 4] + gap * B[:, 2]
    return B, y, w


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("problem", [random_problem, polynomial_problem, nearly_dependent_problem])
def test_equals_rational_arithmetic(problem, seed):
    """But for the digits that the condition number κ of the scaled columns costs, in units of the
    standard deviation where the residual is far above the signal."""
    B, y, w = problem(seed)
    x, cofactor, rss = rational_solution(B, y, w)
    solution = solve_weighted(B, y, w)
    A = B * w[:, None]
    lost = 100 * np.finfo(float).eps * np.linalg.cond(A / np.linalg.norm(A, axis=0))
    sizes = np.sqrt(np.diag(cofactor))
    of_noise = sizes * np.sqrt(rss / solution.dof)
    assert solution.kept.size == B.shape[1]
    assert (np.abs(solution.x - x) <= lost * (np.abs(x) + of_noise)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(solution.cofactor)), sizes, rtol=lost)
    np.testing.assert_allclose(
        solution.cofactor / np.outer(sizes, sizes), cofactor / np.outer(sizes, sizes), rtol=0,
        atol=2 * lost,
    )  # fmt: skip
    assert solution.rss == pytest.approx(rss, rel=lost)


@pytest.mark.parametrize("power", [-150, -12, 3, 12, 150])
def test_column_units_do_not_matter(power):
    B, y, w = random_problem(4)
    B[:, 5] = B[:, 0] + B[:, 1]
    units = 10.0 ** (power * np.array([0, 1, 0, -1, 0.5, 1]))
    plain = solve_weighted(B, y, w)
    scaled = solve_weighted(B * units, y, w)
    assert plain.kept.size == scaled.kept.size == 5
    if power in (-12, 3, 12):  # which of the dependent columns goes may be a matter of rounding
        assert set(scaled.dropped) <= {0, 1, 5}
    np.testing.assert_allclose(scaled.residual, plain.residual, atol=1e-12)
    B, units = B[:, :5], units[:5]
    plain, scaled = solve_weighted(B, y, w), solve_weighted(B * units, y, w)
    np.testing.assert_allclose(scaled.x * units, plain.x, rtol=1e-13)
    np.testing.assert_allclose(std(scaled) * units, std(plain), rtol=1e-13)


def test_rank_loss_is_reported_and_the_rest_is_solved():
    B, y, w = random_problem(5)
    B[:, 3] = 2 * B[:, 1] - B[:, 4]
    solution = solve_weighted(B, y, w)
    assert solution.kept.size == 5 and solution.dof == 25
    (lost,) = solution.dropped
    assert lost in (1, 3, 4)
    assert sorted([*solution.kept, lost]) == list(range(6))
    assert solution.x[lost] == 0
    assert np.isnan(std(solution)[lost]) and np.isfinite(std(solution)[solution.kept]).all()
    covariance = solution.covariance()
    assert np.isnan(covariance[lost]).all() and np.isnan(covariance[:, lost]).all()
    rest = solve_weighted(B[:, solution.kept], y, w)
    np.testing.assert_allclose(solution.x[solution.kept], rest.x, rtol=1e-13)
    np.testing.assert_allclose(solution.cofactor, rest.cofactor, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("shape", [(9, 4), (4, 9), (6, 6)])
def test_least_norm_where_divide_and_conquer_does_not_converge(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """Full rank or not, the solution of least norm, by whichever of LAPACK's two ways."""
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=shape), rng.normal(size=(shape[0], 2))
    A[:, 1] = 2 * A[:, 0]
    expected = np.linalg.pinv(A, rcond=1e-12) @ b
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)
    lstsq = linear_solver.linalg.lstsq

    def failing(*arguments, lapack_driver=None, **options):
        if lapack_driver is None:
            raise linear_solver.linalg.LinAlgError("SVD did not converge")
        return lstsq(*arguments, lapack_driver=lapack_driver, **options)

    monkeypatch.setattr(linear_solver.linalg, "lstsq", failing)
    np.testing.assert_allclose(least_norm(A, b, cond=1e-12), expected, atol=1e-12)
