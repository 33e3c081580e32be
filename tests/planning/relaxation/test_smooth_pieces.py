"""The pieces that Newton's method sees are the criteria, with right derivatives."""

import numpy as np
import pytest
from planning.relaxation.pools import ROBUST, criterion_of, random_problem

from elastocal.planning import CandidatePool, pieces_of

SMOOTH = ("test_pose", "D", "A", "c", "O5")
CASES = [
    *((name, 1, "none", nuisance) for name in (*SMOOTH, "G") for nuisance in (0, 2)),
    *((name, 3, robust, 1) for name in ("test_pose", "D", "O5") for robust in ROBUST),
    ("G", 3, "worst", 0),
]


@pytest.mark.parametrize(("name", "scenarios", "robust", "nuisance"), CASES)
def test_their_maximum_is_the_criterion(name, scenarios, robust, nuisance):
    problem = random_problem(
        name, n=9, p=4, scenarios=scenarios, robust=robust, nuisance=nuisance, prior=0.1
    )
    pieces = pieces_of(problem.criterion, scenarios)
    M = problem.information(np.linspace(0.1, 1.0, 9))
    value = float(problem.criterion.value(M))
    assert pieces.at(M).values.max() == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("name", "scenarios", "robust", "nuisance"), CASES)
def test_derivatives_by_differences(name, scenarios, robust, nuisance):
    problem = random_problem(
        name, n=9, p=4, scenarios=scenarios, robust=robust, nuisance=nuisance, prior=0.1
    )
    pieces = pieces_of(problem.criterion, scenarios)
    task = CandidatePool(problem).restricted(np.arange(9))
    w = np.linspace(0.1, 1.0, 9)

    def at(weights):
        return pieces.at(task.information(weights))

    h, steps = 1e-5, np.eye(9)
    here = at(w)
    mu = np.linspace(1.0, 2.0, len(here.values))
    logs = [np.log(at(w + h * e).values) - np.log(at(w - h * e).values) for e in steps]
    slopes = here.slopes(task.A)
    np.testing.assert_allclose(slopes, -np.stack(logs, 1) / (2 * h), rtol=1e-7, atol=1e-9)
    second = [at(w - h * e).slopes(task.A) - at(w + h * e).slopes(task.A) for e in steps]
    H = here.hessian(task.A, mu, slopes)
    np.testing.assert_allclose(H, mu @ np.stack(second) / (2 * h), rtol=1e-6, atol=1e-7)
    assert np.linalg.eigvalsh(H)[0] >= -1e-9 * np.linalg.eigvalsh(H)[-1]


@pytest.mark.parametrize(("name", "scenarios", "robust", "nuisance"), CASES)
def test_weighted_pieces_lie_below_the_criterion(name, scenarios, robust, nuisance):
    """v²/⟨G, M'⟩ of their tangent is at most Φ(M') for any M'."""
    problem = random_problem(
        name, n=30, p=4, scenarios=scenarios, robust=robust, nuisance=nuisance, prior=0.1
    )
    pieces = pieces_of(problem.criterion, scenarios)
    rng = np.random.default_rng(1)
    local = pieces.at(problem.information(rng.exponential(size=30)))
    tangent = local.tangent(rng.exponential(size=len(local.values)))
    for _ in range(30):
        M = problem.information(rng.exponential(size=30) ** 3)
        assert tangent.value**2 / np.sum(tangent.G * M) <= problem.criterion.value(M) * (1 + 1e-12)


@pytest.mark.parametrize(
    ("name", "scenarios", "robust"),
    [("E", 1, "none"), ("O3", 2, "worst"), ("G", 2, "average")],
)
def test_what_has_no_pieces(name, scenarios, robust):
    assert pieces_of(criterion_of(name, 4, scenarios, robust), scenarios) is None


def test_softened_criteria_are_not_taken_for_their_limit():
    for criterion in (criterion_of("G", 4), criterion_of("D", 4, 2, "worst")):
        assert pieces_of(criterion.softened(8.0), 2) is None
