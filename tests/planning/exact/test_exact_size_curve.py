"""Criterion against number of poses: falls by construction, and the fewest that meet a target."""

from dataclasses import replace

import numpy as np
import pytest
from small_pools import all_plans, all_values, random_problem

from elastocal.errors import InputError, InsufficientDataError
from elastocal.planning import (
    DesignProblem,
    DeterminantCriterion,
    Exchanged,
    make_criterion,
    size_curve,
)
from elastocal.planning import exact_plan as module


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


def test_the_curve_falls_even_where_the_search_for_the_larger_plan_finds_nothing(monkeypatch):
    """With random plans and no exchange, only the extension of the smaller plan keeps order."""

    def lame(pool, k, seed, begun=None):
        rng = np.random.default_rng(pool.problem.n_poses)
        chosen = module.random_plan(pool.problem, rng) if begun is None else begun
        M = pool.problem.prior + pool.problem.sum_of(chosen)
        return k, module.Exchanged(pool.kept[chosen], float(pool.problem.criterion.value(M)), 0)

    def unmoved(problem, chosen):
        M = problem.prior + problem.sum_of(chosen)
        return Exchanged(chosen, float(problem.criterion.value(M)), 0)

    monkeypatch.setattr(module, "_start", lame)
    monkeypatch.setattr(module, "exchange", unmoved)
    points = size_curve(problem_of(seed=4), range(4, 12), starts=1).points
    assert (np.diff([p.value for p in points]) < 0).all()


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


def test_a_target_out_of_reach_leaves_the_best_there_is():
    of = problem_of()
    found = size_curve(of, (), 1e-9, between=(2, 8), starts=2)
    assert found.smallest is None and found.excluded == 8
    assert found.points[-1].n_poses == 8


def test_numbers_and_target_may_come_together():
    of = problem_of()
    curve = size_curve(of, [4, 12], starts=2)
    target = float(np.sqrt(curve.points[0].value * curve.points[1].value))
    found = size_curve(of, [4, 12], target, between=(2, 14), starts=2)
    assert {4, 12} <= {p.n_poses for p in found.points}
    values = {p.n_poses: p.value for p in found.points}
    assert values[found.smallest] <= target
    fewer = [n for n in values if n < found.smallest]
    assert all(values[n] > target for n in fewer)
    assert found.smallest - 1 in (*fewer, found.excluded)


def test_too_few_equations_for_the_range_say_so():
    with pytest.raises(InsufficientDataError, match="fewer equations than parameters"):
        size_curve(problem_of(p=9), (), 1.0, between=(1, 4))


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


def test_random_problems_are_what_they_say():
    """The pools that this folder's tests rest on: all plans, each once, and none else."""
    problem = replace(random_problem("D", 2), shares=np.array([2]), group=np.zeros(10, dtype=int),
                      blocks=random_problem("D", 2).blocks[:, :10], most=2)  # fmt: skip
    plans = all_plans(problem)
    assert len(plans) == 10 * 11 // 2
    assert len({tuple(p) for p in plans.tolist()}) == len(plans)
