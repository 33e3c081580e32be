"""The relaxed weights satisfy the equivalence theorem and are the optima known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from planning.relaxation.pools import (
    random_problem,
)

from elastocal.planning.criteria import make_criterion
from elastocal.planning.relaxation import relax
from elastocal.planning.selection import DesignProblem


@pytest.mark.parametrize("prior", [0.0, 1.0])
@pytest.mark.parametrize("name", ["test_pose", "D", "A", "c", "O5"])
def test_equivalence_theorem(name, prior):
    """No candidate that could take more weight has a larger d than one that could give some."""
    problem = random_problem(name, n=200, prior=prior, shares=(4, 2), seed=1)
    relaxed = relax(problem, tolerance=1e-9)
    w = relaxed.weights
    gradient = problem.criterion.gradient(problem.information(w))
    d = problem.sensitivity(gradient.G)
    for level in range(2):
        of_level = problem.group == level
        least_taken = d[of_level & (w > 1e-3)].min()
        best_to_add = d[of_level & (w < 1 - 1e-3)].max()
        assert best_to_add <= least_taken * (1 + 1e-4)
    # Euler's identity ⟨G, M⟩ = Φ.
    assert w @ d + np.sum(gradient.G * problem.prior) == pytest.approx(gradient.value)


def test_d_optimal_quadratic_regression():
    """One third each at −1, 0 and 1 (Smith 1918)."""
    x = np.linspace(-1, 1, 201)
    problem = DesignProblem(
        blocks=np.stack([np.ones_like(x), x, x**2], axis=1)[None, :, None, :],
        prior=np.zeros((1, 3, 3)),
        group=np.zeros(201, dtype=np.int64),
        shares=np.array([3]),
        criterion=make_criterion("D", parameters=3, interest=np.arange(3)),
        most=3,
    )
    relaxed = relax(problem, tolerance=1e-9)
    np.testing.assert_allclose(relaxed.weights[[0, 100, 200]], 1.0, atol=1e-3)
    assert relaxed.value == pytest.approx(4 ** (-1 / 3), rel=1e-8)


@pytest.mark.parametrize("method", ["first-order", "conic"])
@pytest.mark.parametrize("name", ["c", "A"])
def test_a_nuisance_parameter_that_few_candidates_see(name, method):
    """No weight is drawn to them, and yet M must stay regular."""
    problem = random_problem(name, n=1000, p=4, nuisance=1, shares=(4, 4), seed=6)
    blocks = problem.blocks.copy()
    blocks[..., 0] = 0.0
    blocks[:, 500] = [[1.0, 0.0, 0.0, 0.0], [0.0] * 4]
    criterion = problem.criterion
    if name == "c":
        combination = np.array([0.0, 1.0, -1.0, 0.5])
        criterion = make_criterion(
            "c", parameters=4, interest=np.arange(4), combination=combination, unit="m"
        )
    relaxed = relax(replace(problem, blocks=blocks, criterion=criterion), method=method)
    assert relaxed.gap <= 1e-5
    assert relaxed.weights[500] > 0.0
