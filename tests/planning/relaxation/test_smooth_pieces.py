"""The pieces that Newton's method sees are the criteria, with right derivatives."""

import numpy as np
import pytest
from planning.relaxation.pools import ROBUST, random_problem

from elastocal.planning import CandidatePool, pieces_of

SMOOTH = ("test_pose", "D", "A", "c", "O5")
CASES = [
    *((name, 1, "none", nuisance) for name in (*SMOOTH, "G") for nuisance in (0, 2)),
    *((name, 3, robust, 1) for name in ("test_pose", "D", "O5") for robust in ROBUST),
    ("G", 3, "worst", 0),
]


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
