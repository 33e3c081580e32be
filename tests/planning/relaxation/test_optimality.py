"""The relaxed weights satisfy the equivalence theorem and are the optima known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.relaxation.pools import (
    DISTINCT,
    ROBUST,
    diagonal_problem,
    even_weights,
    random_problem,
    repeated,
)

from elastocal.planning import DesignProblem, make_criterion, relax
from elastocal.planning import selection as selection_module


def sums_of(problem, weights):
    return np.bincount(problem.group, weights, minlength=len(problem.shares))


@pytest.mark.parametrize("prior", [0.0, 1.0])
@pytest.mark.parametrize("name", ["test_pose", "D", "A", "c", "O5"])
def test_equivalence_theorem(name, prior):
    """No candidate that could take more weight has a larger d than one that could give some."""
    problem = random_problem(name, n=200, prior=prior, shares=(4, 2), seed=1)
    relaxed = relax(problem, tolerance=1e-9)
    w = relaxed.weights
    gradient = problem.criterion.gradient(problem.information(w))
    d = problem.sensitivity(gradient.G)
    for level in range(2):
        of_level = problem.group == level
        least_taken = d[of_level & (w > 1e-3)].min()
        best_to_add = d[of_level & (w < 1 - 1e-3)].max()
        assert best_to_add <= least_taken * (1 + 1e-4)
    # Euler's identity ⟨G, M⟩ = Φ.
    assert w @ d + np.sum(gradient.G * problem.prior) == pytest.approx(gradient.value)


def test_d_optimal_quadratic_regression():
    """One third each at −1, 0 and 1 (Smith 1918)."""
    x = np.linspace(-1, 1, 201)
    problem = DesignProblem(
        blocks=np.stack([np.ones_like(x), x, x**2], axis=1)[None, :, None, :],
        prior=np.zeros((1, 3, 3)),
        group=np.zeros(201, dtype=np.int64),
        shares=np.array([3]),
        criterion=make_criterion("D", parameters=3, interest=np.arange(3)),
        most=3,
    )
    relaxed = relax(problem, tolerance=1e-9)
    np.testing.assert_allclose(relaxed.weights[[0, 100, 200]], 1.0, atol=1e-3)
    assert relaxed.value == pytest.approx(4 ** (-1 / 3), rel=1e-8)


@settings(deadline=None, max_examples=30)
@given(sizes=st.lists(st.floats(0.1, 10.0), min_size=2, max_size=6), share=st.integers(1, 20))
def test_a_optimal_weights_of_separate_parameters(sizes, share):
    """Σ 1/(w_i a_i) is least for w_i ∝ a_i^{−1/2}."""
    sizes = np.array(sizes)
    relaxed = relax(diagonal_problem("A", sizes, share, most=share), tolerance=1e-8)
    expected = (sizes**-0.5).sum() ** 2 / share
    assert relaxed.value == pytest.approx(expected, rel=1e-7)
    assert relaxed.bound <= expected * (1 + 1e-12)


@pytest.mark.parametrize("name", ["E", "G"])
def test_the_largest_variance_is_least_where_all_are_equal(name):
    sizes = np.array([1.0, 2.0, 4.0, 0.5])
    relaxed = relax(diagonal_problem(name, sizes, 5, most=5))
    assert relaxed.value == pytest.approx((1 / sizes).sum() / 5, rel=1e-6)
    np.testing.assert_allclose(relaxed.weights, 5 / sizes / (1 / sizes).sum(), rtol=1e-4)


def test_the_box_binds_where_it_must():
    """w = most for the weakest parameter, the rest as without it: shares as a^{−1/2}."""
    relaxed = relax(diagonal_problem("A", np.array([0.01, 1.0, 4.0]), 4, most=2), tolerance=1e-9)
    np.testing.assert_allclose(relaxed.weights, [2.0, 4 / 3, 2 / 3], rtol=1e-3)


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 10_000),
    name=st.sampled_from(["test_pose", "D", "A", "G", "c", "O5"]),
    shares=st.lists(st.integers(0, 9), min_size=1, max_size=4).filter(lambda s: sum(s) > 3),
    most=st.integers(1, 4),
    prior=st.sampled_from([1e-6, 1e-2, 1.0, 1e3]),
)
def test_any_shares_and_priors_end_within_the_gap(seed, name, shares, most, prior):
    problem = random_problem(
        name, n=40, shares=tuple(shares), most=most, prior=prior, seed=seed, r=1 + seed % 3
    )
    relaxed = relax(problem)
    assert relaxed.gap <= 1e-5
    np.testing.assert_allclose(sums_of(problem, relaxed.weights), shares, atol=1e-9)
    assert (relaxed.weights >= 0).all()
    assert (relaxed.weights <= most * (1 + 1e-12)).all()
    value = problem.criterion.value(problem.information(relaxed.weights))
    assert relaxed.value == pytest.approx(float(value), rel=1e-9)


@pytest.mark.parametrize("name", DISTINCT)
def test_candidates_listed_twice_change_nothing(name):
    problem = random_problem(name, most=5)
    assert relax(repeated(problem)).value == pytest.approx(relax(problem).value, rel=2e-6)


@pytest.mark.parametrize("robust", ROBUST)
def test_starts_do_not_matter(robust):
    problem = random_problem("D", scenarios=3, robust=robust, seed=5)
    expected = relax(problem)
    single = np.zeros(problem.n_candidates)
    single[0] = 1.0
    for start in (single, expected.weights, even_weights(problem)):
        assert relax(problem, start=start).value == pytest.approx(expected.value, rel=2e-6)


def test_the_worst_case_is_never_better_than_the_average():
    average, worst = (
        relax(random_problem("test_pose", scenarios=4, robust=robust)) for robust in ROBUST
    )
    assert worst.bound >= average.value * (1 - 2e-6)


@pytest.mark.parametrize("method", ["first-order", "conic"])
@pytest.mark.parametrize("name", ["c", "A"])
def test_a_nuisance_parameter_that_few_candidates_see(name, method):
    """No weight is drawn to them, and yet M must stay regular."""
    problem = random_problem(name, n=1000, p=4, nuisance=1, shares=(4, 4), seed=6)
    blocks = problem.blocks.copy()
    blocks[..., 0] = 0.0
    blocks[:, 500] = [[1.0, 0.0, 0.0, 0.0], [0.0] * 4]
    criterion = problem.criterion
    if name == "c":
        combination = np.array([0.0, 1.0, -1.0, 0.5])
        criterion = make_criterion(
            "c", parameters=4, interest=np.arange(4), combination=combination, unit="m"
        )
    relaxed = relax(replace(problem, blocks=blocks, criterion=criterion), method=method)
    assert relaxed.gap <= 1e-5
    assert relaxed.weights[500] > 0.0


def test_pools_too_large_to_pack_give_the_same(monkeypatch):
    problem = random_problem("test_pose", scenarios=2, robust="average")
    packed = relax(problem)
    monkeypatch.setattr(selection_module, "PACKED_BYTES", 0)
    plain = relax(replace(problem))
    assert plain.value == pytest.approx(packed.value, rel=1e-9)
    assert plain.bound == pytest.approx(packed.bound, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", DISTINCT)
def test_twenty_thousand_candidates(name):
    problem = random_problem(
        name, n=20_000, r=9, p=20, shares=(3,) * 5, scenarios=2, robust="worst"
    )
    relaxed = relax(problem)
    assert relaxed.gap <= 1e-6
    np.testing.assert_allclose(sums_of(problem, relaxed.weights), 3, atol=1e-9)
