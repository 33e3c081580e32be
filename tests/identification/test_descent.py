"""Levenberg–Marquardt turns back where there is no prediction."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from elastocal.errors import ElastocalError
from elastocal.identification.least_squares import Problem, fit
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Regression
from elastocal.model.observations import Observations


class Reciprocal:
    """1/x, which has no value below zero, in the place of an arm."""

    shrunk = np.zeros(1, dtype=bool)

    def regressor(self, table, x, columns, observed):
        if x[0] <= 0:
            raise ElastocalError("no equilibrium")
        return Regression(np.array([[-1 / x[0] ** 2]]), 1 / x, observed)


def test_descent_turns_back_where_there_is_no_prediction():
    """The full step from 3 towards 1/x = 2 leads below zero."""
    one, table = np.ones(1), SimpleNamespace(source="data")
    row = Observations("distance", 2 * one, sparse.eye_array(1, format="csr"), np.arange(1), table)
    problem = Problem(Reciprocal(), row, Weights("none", None, False, ""), 3 * one, np.arange(1))
    found = fit(problem, problem.free, 3 * one, one, tolerance=1e-12)
    assert found.converged and found.x[0] == pytest.approx(0.5, rel=1e-9)
