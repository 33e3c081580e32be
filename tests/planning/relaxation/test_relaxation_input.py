"""What the relaxation refuses, and the cases with nothing to choose."""

from dataclasses import replace

import numpy as np
import pytest
from planning.relaxation.pools import random_problem

from elastocal.errors import InputError, InsufficientDataError
from elastocal.planning import relax


@pytest.mark.parametrize("name", ["test_pose", "D", "E"])
@pytest.mark.parametrize("method", ["first-order", "conic"])
def test_a_pool_that_does_not_see_a_parameter(name, method):
    problem = random_problem(name)
    blocks = problem.blocks.copy()
    blocks[..., 1] = 2 * blocks[..., 0]
    with pytest.raises(InsufficientDataError, match="all 60 candidate poses together"):
        relax(replace(problem, blocks=blocks), method=method)


def test_prior_knowledge_makes_up_for_it():
    problem = random_problem("D", prior=0.5)
    blocks = problem.blocks.copy()
    blocks[..., 1] = 0.0
    assert relax(replace(problem, blocks=blocks)).gap <= 1e-6


def test_prior_alone():
    """Candidates that measure nothing leave Φ and its bound at the prior's."""
    problem = random_problem("test_pose", prior=2.0)
    problem = replace(problem, blocks=np.zeros_like(problem.blocks))
    relaxed = relax(problem)
    expected = float(problem.criterion.value(problem.prior))
    assert relaxed.value == pytest.approx(expected, rel=1e-12)
    assert relaxed.bound == pytest.approx(expected, rel=1e-6)


def test_shares_that_take_everything():
    problem = random_problem("test_pose", n=6, shares=(6, 6), most=2)
    relaxed = relax(problem)
    np.testing.assert_array_equal(relaxed.weights, 2.0)
    assert relaxed.bound == pytest.approx(relaxed.value, rel=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "simplex"}, "simplex.*first-order"),
        ({"tolerance": 0.0}, "tolerance is 0"),
        ({"start": np.ones(3)}, r"shape \(3,\)"),
        ({"start": -np.ones(60)}, "negative"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(InputError, match=message):
        relax(random_problem(), **options)


def test_progress_tells_the_gap():
    lines: list[str] = []
    relaxed = relax(random_problem(), progress=lines.append)
    assert len(lines) == relaxed.iterations
    assert f"{relaxed.history[-1].gap:.1e}" in lines[-1]
