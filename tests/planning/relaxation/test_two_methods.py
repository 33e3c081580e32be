"""The Newton master and the conic program, written independently, agree."""

import pytest
from planning.relaxation.pools import NAMES, ROBUST, random_problem

from elastocal.planning import relaxation as relaxation_module
from elastocal.planning.relaxation import relax


def assert_agreement(problem):
    conic, first = relax(problem, method="conic"), relax(problem, method="first-order")
    assert first.value == pytest.approx(conic.value, rel=2e-6)
    # Each bound holds for the other's weights.
    assert max(first.bound, conic.bound) <= min(first.value, conic.value) * (1 + 1e-12)
    assert first.gap <= 1e-6
    assert conic.gap <= 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_one_scenario(name):
    assert_agreement(random_problem(name, n=80, prior=0.1))


@pytest.mark.parametrize("name", ["A", "D", "E", "O5"])
def test_nuisance_parameters(name):
    assert_agreement(random_problem(name, n=80, p=5, nuisance=2))


@pytest.mark.parametrize("robust", ROBUST)
@pytest.mark.parametrize("name", ["test_pose", "D", "E", "G", "O5"])
def test_scenarios(name, robust):
    assert_agreement(random_problem(name, n=60, scenarios=3, robust=robust, seed=2))


def test_the_conic_solver_generates_columns_for_large_pools(monkeypatch):
    problem = random_problem("E", n=600, r=3, p=5)
    whole = relax(problem, method="conic")
    monkeypatch.setattr(relaxation_module, "DIRECT", 100)
    part = relax(problem, method="conic")
    assert part.history[0].support < 100 < whole.history[0].support
    assert part.value == pytest.approx(whole.value, rel=2e-6)
    assert part.gap <= 1e-6
