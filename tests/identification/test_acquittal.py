"""One step to the fit of the others acquits a clean table, and never where a new fit would not."""

from dataclasses import replace

import numpy as np
import pytest
from support.calibration import GEOMETRY, measured
from support.parts import SIGMA, arm, faulty_of, solved

from elastocal.identification import outliers
from elastocal.identification.outliers import find_faulty, verdict
from elastocal.identification.solve import solve
from elastocal.identification.weighted_problem import weights_for
from elastocal.model.observations import subset


def solved_with(faults, size, seed, poses=60):
    """An arm whose first `faults` readings are off by normal errors of `size` sigmas more."""
    model, plan, truth, rng = arm(GEOMETRY, seed, poses)
    table = measured(model, plan, truth, SIGMA, rng)
    table.position[:faults] += rng.normal(size=(faults, 3)) * SIGMA * size
    return solved(model, table)


def refitting(solution, log):
    """A refit to the good observations that writes down how many there were."""
    problem = solution.problem

    def refit(good):
        log.append(int(good.sum()))
        observed = subset(problem.observations, good)
        weights = weights_for(observed, problem.model.cell.tracker)
        return solve(replace(problem, observations=observed, weights=weights), try_wider=False)

    return refit


def test_suspects_of_a_clean_table_are_acquitted_without_a_new_fit():
    log = []
    for seed in range(6):
        solution = solved_with(0, 0, seed, 20)
        faulty, fitted = find_faulty(solution, refitting(solution, log))
        assert not faulty.any() and fitted is solution
        assert outliers._suspects(solution).any() and not log


@pytest.mark.parametrize(("faults", "size"), [(1, 3.0), (2, 6.0), (4, 4.0), (3, 30.0)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_verdict_is_that_of_new_fits(faults, size, seed):
    solution = solved_with(faults, size, seed)
    full = verdict(solution, refitting(solution, []), ~outliers._suspects(solution))
    faulty, fitted = faulty_of(solution)
    np.testing.assert_array_equal(faulty, full[0])
    np.testing.assert_array_equal(fitted.fit.x, full[1].fit.x)
    assert fitted.fit.problem.observations.size == 3 and len(fitted.fit.whitened) % 3 == 0


def test_a_gross_error_is_never_acquitted():
    solution, log = solved_with(1, 100.0, 4), []
    faulty, fitted = find_faulty(solution, refitting(solution, log))
    assert log and faulty[0] and len(fitted.fit.whitened) == 3 * log[-1]


def test_as_many_good_equations_as_parameters_acquit_nobody():
    """Nothing is left over to judge by; the fit to the others has to say what it makes of that."""
    solution = solved_with(0, 0, 1, 20)
    good = np.zeros(20, dtype=bool)
    good[: len(solution.reduction.kept) // 3] = True
    assert 3 * good.sum() <= len(solution.reduction.kept)
    assert outliers._acquitted(solution, good) is None
