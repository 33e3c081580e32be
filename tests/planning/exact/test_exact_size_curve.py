"""Criterion against number of poses: falls by construction, and the fewest that meet a target."""

from dataclasses import replace

import numpy as np
import pytest
from small_pools import all_plans, all_values

from elastocal.errors import InputError
from elastocal.planning.criteria import DeterminantCriterion, make_criterion
from elastocal.planning.exact_plan import size_curve
from elastocal.planning.selection import DesignProblem


def problem_of(name="test_pose", levels=2, p=5, N=14, seed=0):
    rng = np.random.default_rng(seed)
    blocks = rng.normal(size=(1, N, 2, p))
    targets = rng.normal(size=(1, 4, 3, p))
    criterion = make_criterion(name, parameters=p, interest=np.arange(p), A=targets)

    def of(n: int) -> DesignProblem:
        shares = np.array([n // levels + (k < n % levels) for k in range(levels)])
        group = np.arange(N) % levels
        return DesignProblem(blocks, np.zeros((1, p, p)), group, shares, criterion)

    return of


def optimum(problem: DesignProblem) -> float:
    return float(all_values(problem, all_plans(problem)).min())


def test_the_curve_falls_and_stays_above_its_bound():
    points = size_curve(problem_of(), [7, 3, 5, 4, 10], starts=2).points
    assert [p.n_poses for p in points] == [3, 4, 5, 7, 10]
    values = np.array([p.value for p in points])
    assert (np.diff(values) < 0).all()
    assert all(p.bound is not None and p.bound <= p.value * (1 + 1e-9) for p in points)
    assert all(len(p.plan.chosen) == p.n_poses for p in points)


class Unbounded(DeterminantCriterion):
    """D, were no bound known."""

    certifiable = False


@pytest.mark.parametrize("wanted", [5, 6])
@pytest.mark.parametrize("name", ["test_pose", "D", "unbounded"])
def test_the_fewest_poses_are_those_of_brute_force(name, wanted):
    bounded = problem_of("D" if name == "unbounded" else name, levels=1, N=10)
    of = bounded
    if name == "unbounded":

        def of(n):
            return replace(bounded(n), criterion=Unbounded(np.arange(5)))

    best = {n: optimum(of(n)) for n in range(3, 9)}
    target = best[wanted] * 1.001
    found = size_curve(of, (), target, between=(1, 9), starts=2)
    assert found.smallest == min(n for n, value in best.items() if value <= target)
    assert found.excluded < found.smallest
    assert all(best[n] > target for n in range(3, found.excluded + 1))


@pytest.mark.parametrize(
    ("numbers", "options", "named"),
    [
        ((), {}, "numbers of poses or a target"),
        ((), {"target": 1.0, "between": (5, 4)}, "between 5 and 4"),
        ((), {"target": -1.0}, "positive"),
    ],
)
def test_wrong_input_is_named(numbers, options, named):
    with pytest.raises(InputError, match=named):
        size_curve(problem_of(), numbers, **options)
