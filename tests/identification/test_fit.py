"""A whole table's fit: one evaluation per point, and B at the rows that its problem has."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.parts import positions, solved

from elastocal.errors import ElastocalError
from elastocal.identification.least_squares import fit
from elastocal.identification.weighted_problem import part_of


def test_residual_and_B_of_a_point_come_from_one_evaluation(monkeypatch):
    """No prediction without B, and no point of the descent twice in turn."""
    model, table = positions()
    solution = solved(model, table)
    kept, points = solution.reduction.kept, []
    problem = solution.problem.fit_of(kept, solution.problem.x0, solution.sizes)
    regressor = type(model).regressor

    def counted(self, table, x, columns, observations):
        points.append(x.copy())
        return regressor(self, table, x, columns, observations)

    monkeypatch.setattr(type(model), "predict", None)
    monkeypatch.setattr(type(model), "regressor", counted)
    found = fit(problem)
    assert found.converged and len(points) > 2
    assert not any(np.array_equal(a, b) for a, b in pairwise(points))


def test_B_follows_the_rows_of_the_problem():
    """A fit that is handed on with readings left out has the B of those that are left."""
    model, table = positions()
    solution = solved(model, table)
    problem = solution.fit.problem
    few = part_of(problem.observations, problem.weights, np.arange(20))
    own = replace(problem, observations=few.observations, weights=few.weights, cut=None)
    shorter = replace(solution.fit, problem=own)
    assert shorter.B.shape == (60, len(problem.columns))
    np.testing.assert_array_equal(shorter.B, solution.fit.B[:60])


def test_a_start_without_finite_predictions_names_the_table(monkeypatch):
    """Where a length overflows B may be finite and the prediction not."""
    model, table = positions()
    problem = solved(model, table).fit.problem
    regressor = type(model).regressor

    def overflowed(*given):
        at = regressor(*given)
        return replace(at, prediction=np.full_like(at.prediction, np.inf))

    monkeypatch.setattr(type(model), "regressor", overflowed)
    with pytest.raises(ElastocalError, match=f"^{table.source}: .* no finite numbers"):
        fit(problem)
