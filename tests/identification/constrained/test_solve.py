"""Squares under bounds and equalities against scipy, closed forms and their own optimality."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize
from support.constrained import solve

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    LinearEquality,
    equal,
    non_negative,
)
from elastocal.identification.linear_solver import solve_weighted

NAMES = tuple("abcdef")
# Parameters of the sizes that an arm has: compliances of 1e-7 beside lengths of 1e-3.
SIZES = np.array([1e-7, 3e-7, 1e-6, 1e-3, 1e-3, 2e-4])


def problem(seed: int, rows: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(rows, 6)) @ (np.eye(6) + 0.5 * rng.normal(size=(6, 6))) / SIZES
    return B, B @ (SIZES * rng.normal(size=6)) + rng.normal(size=rows)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.max(np.abs(found - expected) / SIZES))


@pytest.mark.parametrize("seed", range(20))
def test_non_negative_is_nnls(seed):
    B, y = problem(seed)
    found = solve(B, y, NAMES, non_negative(*NAMES))
    z, _ = optimize.nnls(B * SIZES, y)
    assert relative(found.x, SIZES * z) < 1e-12
    assert {a.names[0] for a in found.active} == {NAMES[i] for i in np.flatnonzero(z == 0)}
    assert found.kkt < 1e-13


@pytest.mark.parametrize("seed", range(20))
def test_bounds_are_lsq_linear(seed):
    B, y = problem(seed)
    lower, upper = -0.4 * SIZES, 0.7 * SIZES
    bounds = Constraints(tuple(Bounds(*b) for b in zip(NAMES, lower, upper, strict=True)))
    found = solve(B, y, NAMES, bounds)
    expected = optimize.lsq_linear(B * SIZES, y, (-0.4, 0.7), method="bvls", tol=1e-15).x
    assert relative(found.x, SIZES * expected) < 1e-11
    assert ((found.x >= lower) & (found.x <= upper)).all()
    for a in found.active:
        assert a.value in (lower[NAMES.index(a.names[0])], upper[NAMES.index(a.names[0])])
        assert (a.multiplier > 0) == (a.kind == "lower")


def test_equalities_are_the_closed_form():
    B, y = problem(1)
    A = np.array([[1.0, -2.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]])
    b = np.array([1e-7, 2e-3])
    found = solve(
        B, y, NAMES,
        Constraints(equalities=(
            LinearEquality({"a": 1.0, "b": -2.0}, 1e-7),
            LinearEquality({"d": 1.0, "e": 1.0, "f": 1.0}, 2e-3, label="length"),
        )),
    )  # fmt: skip
    # The KKT system of the problem in units of SIZES, solved as it stands.
    J, C = B * SIZES, A * SIZES / np.array([[1e-7], [1e-3]])
    K = np.block([[J.T @ J, C.T], [C, np.zeros((2, 2))]])
    expected = np.linalg.solve(K, np.concatenate([J.T @ y, b / [1e-7, 1e-3]]))
    assert relative(found.x, SIZES * expected[:6]) < 1e-11
    assert [a.label for a in found.active] == ["a - 2·b = 1e-07", "length"]
    # ∇rss = Aᵀλ: the closed form's multiplier is that of half the gradient with the other sign.
    np.testing.assert_allclose(
        [a.multiplier for a in found.active], -2 * expected[6:] / [1e-7, 1e-3], rtol=1e-8
    )
    np.testing.assert_allclose(A @ found.cofactor, 0, atol=1e-13 * 1e-3)


def test_bounds_and_equalities_together_are_slsqp():
    B, y = problem(5)
    stated = non_negative(*NAMES) + equal("d", "e") + Constraints((Bounds("f", upper=1e-4),))
    found = solve(B, y, NAMES, stated)
    J = B * SIZES
    reference = optimize.minimize(
        lambda z: np.sum((J @ z - y) ** 2), np.full(6, 0.1), method="SLSQP",
        jac=lambda z: 2 * J.T @ (J @ z - y), tol=1e-14, options={"maxiter": 500},
        bounds=[(0, None)] * 5 + [(0, 0.5)],
        constraints={"type": "eq", "fun": lambda z: z[3] - z[4]},
    )  # fmt: skip
    assert found.objective <= reference.fun * (1 + 1e-12)
    assert relative(found.x, SIZES * reference.x) < 1e-5
    assert found.kkt < 1e-13


def test_without_constraints_it_is_least_squares():
    B, y = problem(2)
    found, expected = solve(B, y, NAMES), solve_weighted(B, y)
    assert relative(found.x, expected.x) < 1e-13
    np.testing.assert_allclose(found.cofactor, expected.cofactor, rtol=1e-11)
    assert found.active == () and found.objective == pytest.approx(expected.rss, rel=1e-13)


def test_fixing_the_active_parameters_changes_nothing():
    B, y = problem(3)
    found = solve(B, y, NAMES, non_negative(*NAMES))
    free = found.x > 0
    assert 0 < free.sum() < 6
    rest = solve_weighted(B[:, free], y)
    np.testing.assert_allclose(found.x[free], rest.x, rtol=1e-11)
    np.testing.assert_allclose(found.cofactor[np.ix_(free, free)], rest.cofactor, rtol=1e-10)
    assert (found.cofactor[~free] == 0).all()


@pytest.mark.parametrize("seed", [0, 3, 7])
def test_a_multiplier_is_the_price_of_its_bound(seed):
    B, y = problem(seed)

    def stated(value: float, name: str = "") -> Constraints:
        bounds = tuple(Bounds(n, value if n == name else 0.0) for n in NAMES)
        return Constraints(bounds) + Constraints(
            equalities=(LinearEquality({"d": 1.0, "e": 1.0}, 1e-3 + value * (name == "sum")),)
        )

    found = solve(B, y, NAMES, stated(0.0))
    assert len(found.active) > 1
    for a in found.active:
        name = "sum" if a.kind == "equality" else a.names[0]
        step = 1e-5 * SIZES[NAMES.index(a.names[0])]
        up, down = (solve(B, y, NAMES, stated(s * step, name)).objective for s in (1, -1))
        assert a.multiplier == pytest.approx((up - down) / (2 * step), rel=1e-4)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.integers(-12, 12), min_size=6, max_size=6))
def test_units_do_not_matter(seed, exponents):
    B, y = problem(seed)
    unit = 2.0 ** np.array(exponents)
    one = solve(B, y, NAMES, non_negative(*NAMES))
    other = solve(B / unit, y, NAMES, non_negative(*NAMES))
    assert relative(other.x / unit, one.x) < 1e-11
    assert [a.label for a in one.active] == [a.label for a in other.active]


def test_a_bound_far_from_the_data_loses_no_digits():
    B, y = problem(4)
    far = 1e4 * SIZES[0]
    found = solve(B, y, NAMES, Constraints((Bounds("a", lower=far),)))
    rest = solve_weighted(B[:, 1:], y - B[:, 0] * far)
    assert found.x[0] == far
    np.testing.assert_allclose(found.x[1:], rest.x, rtol=1e-11)


def test_contradicting_constraints_are_named_and_no_others():
    B, y = problem(0)
    stated = non_negative(*NAMES) + Constraints(
        (Bounds("c", upper=1.0),),
        (
            LinearEquality({"a": 1.0, "b": 1.0}, -1e-7, label="sum of drives"),
            LinearEquality({"d": 1.0, "e": -1.0}),
        ),
    )
    with pytest.raises(InputError, match="contradict") as error:
        solve(B, y, NAMES, stated)
    message = str(error.value)
    for guilty in ("sum of drives", "lower bound of a", "lower bound of b"):
        assert guilty in message
    for innocent in ("d - e", "bound of c", "bound of f"):
        assert innocent not in message


def test_contradicting_equalities_are_named():
    B, y = problem(0)
    stated = Constraints(equalities=(
        LinearEquality({"a": 1.0, "b": 1.0}, 1e-7), LinearEquality({"a": 2.0, "b": 2.0}, 5e-7),
        LinearEquality({"f": 1.0}, 0.0),
    ))  # fmt: skip
    with pytest.raises(InputError, match=r"'a \+ b = 1e-07', '2·a \+ 2·b = 5e-07' together"):
        solve(B, y, NAMES, stated)


def test_repeated_equalities_are_one():
    B, y = problem(0)
    once, twice = (
        solve(B, y, NAMES, Constraints(equalities=(LinearEquality({"a": k}, k * 1e-7),)))
        for k in (1.0, 3.0)
    )
    both = equal("a", "b") + equal("b", "a")
    assert relative(once.x, twice.x) < 1e-13
    single = solve(B, y, NAMES, equal("a", "b"))
    assert relative(solve(B, y, NAMES, both).x, single.x) < 1e-13


def test_all_parameters_fixed_leaves_the_residual():
    B, y = problem(0)
    stated = Constraints(tuple(Bounds(n, s, s) for n, s in zip(NAMES, SIZES, strict=True)))
    found = solve(B, y, NAMES, stated)
    np.testing.assert_allclose(found.x, SIZES, rtol=1e-13)
    np.testing.assert_allclose(found.residual, y - B @ SIZES, atol=1e-11)
    assert (found.cofactor == 0).all() and np.isnan(found.prior_share).all()


def test_what_nothing_determines_is_named_and_an_equality_can_determine_it():
    B, y = problem(0)
    B[:, 1] = 2 * B[:, 0]
    with pytest.raises(InsufficientDataError, match="do not determine a, b:"):
        solve(B, y, NAMES, non_negative(*NAMES))
    found = solve(B, y, NAMES, equal("a", "b"))
    merged = solve_weighted(np.column_stack([B[:, 0] + B[:, 1], B[:, 2:]]), y)
    np.testing.assert_allclose(found.x[1:], merged.x, rtol=1e-10)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"loss": "l1"}, "'squares' or 'huber'"),
        ({"size": 0}, "at least one row"),
    ],
)
def test_bad_input_is_refused(change, says):
    B, y = problem(0)
    arguments = {"B": B, "y": y, "names": NAMES} | change
    with pytest.raises(InputError, match=says):
        solve(**arguments)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_constraints_without_room_are_solved_or_refused_but_never_wrong(seed):
    # a + b = 0 with a, b ≥ 0 pins both at zero from two sides.
    B, y = problem(seed)
    stated = non_negative("a", "b") + Constraints(
        equalities=(LinearEquality({"a": 1.0, "b": 1.0}, 0.0),)
    )
    try:
        found = solve(B, y, NAMES, stated)
    except ElastocalError:
        return
    rest = solve_weighted(B[:, 2:], y)
    assert relative(found.x, np.concatenate([[0.0, 0.0], rest.x])) < 1e-5
    assert found.kkt < 1e-6
