"""Relaxation and exchange on small pools: beside a cone solver, and beside all plans there are."""

from dataclasses import replace
from itertools import combinations, product

import cvxpy as cp
import numpy as np
import pytest

from elastocal.messages import InsufficientDataError
from elastocal.planning.criteria import CRITERIA, CriterionInputs
from elastocal.planning.relaxation import DesignProblem, exact_plan, exchange, relax, sized_plans

FIVE = ("test_pose", "D", "E", "G", "O5")


def problem_of(name, seed, N=12, n=4, p=5, prior=0.0):
    """n poses of N candidates in two groups, three readings each."""
    rng = np.random.default_rng(seed)
    blocks = rng.normal(size=(N, 3, p)) * np.logspace(-0.5, 0.5, p)
    A = rng.normal(size=(6, 3, p))
    criterion = CRITERIA[name].of(CriterionInputs(name, p, np.arange(p), A, n_poses=n))
    group, shares = np.arange(N) % 2, np.array([n - n // 2, n // 2])
    return DesignProblem(blocks, prior * np.eye(p), group, shares, criterion)


def all_values(problem):
    parts = [
        list(combinations(np.flatnonzero(problem.group == g), share))
        for g, share in enumerate(problem.shares)
    ]
    return np.array([problem.value(np.array(sum(plan, ()))) for plan in product(*parts)])


def by_cone(problem, name):
    """The relaxed optimum by clarabel (Boyd & Vandenberghe, Convex Optimization, ch. 7.5)."""
    A, one = problem.products.reshape(-1, *problem.prior.shape), problem.criterion
    w = cp.Variable(len(A), nonneg=True)
    p = A.shape[1]
    M = problem.prior + cp.reshape(A.reshape(len(A), -1).T @ w, (p, p), order="C")
    limits = [w <= 1]
    limits += [cp.sum(w[problem.group == g]) == s for g, s in enumerate(problem.shares)]
    if name == "D":
        goal = cp.Maximize(cp.log_det(M))
    elif name == "E":
        goal = cp.Maximize(cp.lambda_min(M))
    elif name == "O5":
        X = cp.Variable((p, p), symmetric=True)
        limits.append(cp.bmat([[M, X], [X, np.eye(p)]]) >> 0)
        goal = cp.Minimize(cp.matrix_frac(np.eye(p), X))
    else:
        F = one.F if name == "G" else one.F[None]
        goal = cp.Minimize(cp.maximum(*[sum(cp.matrix_frac(f, M) for f in F_t) for F_t in F]) if
                           len(F) > 1 else sum(cp.matrix_frac(f, M) for f in F[0]))  # fmt: skip
    found = cp.Problem(goal, limits).solve(solver=cp.CLARABEL)
    of = {"D": lambda v: np.exp(-v / p), "E": lambda v: 1 / v, "O5": lambda v: (v / p) ** 2}
    return of.get(name, lambda v: v)(found)


@pytest.mark.parametrize("name", FIVE)
@pytest.mark.parametrize("prior", [0.0, 0.5])
def test_the_relaxed_optimum_is_that_of_a_cone_solver(name, prior):
    for seed in range(2):
        problem = problem_of(name, seed, N=30, n=7, prior=prior)
        found = relax(problem.balanced(), 1e-5)
        expected = by_cone(problem, name)
        assert [found.value, found.bound] == pytest.approx([expected] * 2, rel=1e-4)
        assert found.bound <= expected * (1 + 1e-7) and found.gap < 1e-4
        shares = np.bincount(problem.group, found.weights)
        np.testing.assert_allclose(shares, problem.shares, rtol=1e-6)
        assert (found.weights >= 0).all() and (found.weights <= 1 + 1e-9).all()


@pytest.mark.parametrize("name", FIVE)
def test_no_plan_is_better_than_the_bound_and_the_search_finds_the_best(name):
    for seed in range(2):
        problem = problem_of(name, seed, prior=0.2 * (seed % 2))
        values = all_values(problem)
        turned = problem.balanced()
        relaxed = relax(turned)
        assert relaxed.bound <= values.min() * (1 + 1e-8)
        plan, value = exact_plan(turned, relaxed, starts=20)
        assert value == pytest.approx(values.min(), rel=1e-6)
        assert problem.value(plan) == pytest.approx(value, rel=1e-6)


def test_an_exchange_ends_where_no_single_pose_has_a_better_one():
    problem = problem_of("test_pose", 4, N=40, n=6).balanced()
    rng = np.random.default_rng(0)
    for _ in range(3):
        plan, value = exchange(problem, problem.random(rng))
        for k, out in enumerate(plan):
            for into in np.flatnonzero(problem.group == problem.group[out]):
                if into not in plan:
                    other = plan.copy()
                    other[k] = into
                    assert problem.value(other) >= value * (1 - 1e-8)


def test_the_same_plan_in_parameters_of_any_scale():
    problem = problem_of("test_pose", 5, N=40, n=6)
    S = np.diag(np.logspace(-6, 6, 5))
    other = replace(problem, blocks=problem.blocks @ S, criterion=problem.criterion.turned(S))
    first, second = (exact_plan(t, relax(t))[0] for t in (problem.balanced(), other.balanced()))
    assert first.tolist() == second.tolist()


def test_too_few_poses_and_pools_that_leave_something_open_are_refused():
    problem = problem_of("D", 0, n=1)
    problem.blocks[:, 2] = problem.blocks[:, 1]  # as where markers sit on one body
    with pytest.raises(InsufficientDataError, match=r"1 pose of 3 readings .*at least 3 poses"):
        problem.check_enough()
    problem = problem_of("D", 0)
    problem.blocks[..., 4] = problem.blocks[..., 0]
    with pytest.raises(InsufficientDataError, match="do not determine the 5 parameters"):
        problem.balanced()


def test_sizes_fall_with_the_number_of_poses_and_bounds_lie_below():
    def of(n):
        return problem_of("test_pose", 6, N=40, n=n)

    found = sized_plans(of, [6, 4, 9], 0, lambda message: None)
    values = [value for value, _ in found.values()]
    assert list(found) == [4, 6, 9] and values == sorted(values, reverse=True)
    assert all(bound <= value for value, bound in found.values())
