"""Levenberg–Marquardt on triangles: it arrives, within bounds, and says when it has not."""

import numpy as np
import pytest

from elastocal.errors import ElastocalError
from elastocal.identification.least_squares import SumOfSquares, descend
from elastocal.identification.weighted_problem import Evaluation, RFactor


def objective_of(residual, jacobian, p, tie=np.inf):
    def evaluate(u):
        e = residual(u)
        if not np.isfinite(e).all():
            raise ElastocalError("no equilibrium")
        return Evaluation(e, RFactor.of(-jacobian(u), e))

    return SumOfSquares(evaluate, np.eye(p) / tie, np.zeros(p))


def test_descent_turns_back_where_there_is_no_prediction():
    """1/u − 2 has none below zero, where the full step from 3 leads."""

    def residual(u):
        return np.array([1 / u[0] - 2.0, 0.0]) if u[0] > 0 else np.array([np.nan, 0.0])

    def slope(u):
        return np.array([[-1 / u[0] ** 2], [0.0]])

    found = descend(objective_of(residual, slope, 1), np.array([3.0]), 1e-12, 99)
    assert found.converged and found.u[0] == pytest.approx(0.5, rel=1e-9)


def test_descent_with_ties_is_the_minimum():
    rng = np.random.default_rng(4)
    A, y = rng.normal(size=(30, 4)), rng.normal(size=30) * 4
    objective = objective_of(lambda u: y - A @ u, lambda u: -A, 4, tie=0.5)
    found = descend(objective, np.zeros(4), 1e-12, 20)
    expected = np.linalg.lstsq(np.vstack([A, 2 * np.eye(4)]), np.append(y, np.zeros(4)))[0]
    np.testing.assert_allclose(found.u, expected, atol=1e-9)
