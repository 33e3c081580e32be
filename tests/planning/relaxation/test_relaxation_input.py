"""What the relaxation refuses, and the cases with nothing to choose."""

from dataclasses import replace

import numpy as np
import pytest
from planning.relaxation.pools import random_problem

from elastocal.errors import InputError, InsufficientDataError
from elastocal.planning.relaxation import relax


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
