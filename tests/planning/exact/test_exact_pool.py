"""What is ruled out is in no better plan; what a plan loses without a pose."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from small_pools import CRITERIA, all_plans, all_values, random_problem

from elastocal.planning.exact_plan import Prices
from elastocal.planning.relaxation import relax


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    name=st.sampled_from(CRITERIA),
    most=st.integers(1, 2),
    prior=st.sampled_from([0.0, 0.3]),
    at=st.sampled_from(["relaxed", "anywhere", "soft"]),
)
def test_bounds_hold_for_every_plan_and_every_candidate_in_it(seed, name, most, prior, at):
    problem = random_problem(name, seed, most=most, prior=prior)
    if at == "relaxed":
        tangent = relax(problem).tangent
    else:
        w = np.random.default_rng(seed).exponential(size=problem.n_candidates)
        criterion = problem.criterion.softened(20.0) if at == "soft" else problem.criterion
        tangent = criterion.gradient(problem.information(w))
    plans = all_plans(problem)
    values = all_values(problem, plans)
    prices = Prices.of(problem, tangent)
    for i in range(problem.n_candidates):
        with_i = (plans == i).any(axis=1)
        if with_i.any():
            assert 1 / values[with_i].min() <= prices.upper[i] * (1 + 1e-9)
    limit = float(np.quantile(values, 0.05))
    better = np.unique(plans[values < limit])
    assert np.isin(better, prices.may_better(limit)).all()
