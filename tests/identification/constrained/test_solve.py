"""Squares under bounds, equalities and matrices: scipy, closed forms, and their own optimality."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize
from support.constrained import breach, equal, non_negative, solve

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    LinearEquality,
    SemidefiniteMatrix,
)

NAMES = tuple("abcdef")
# Parameters of the sizes that an arm has: compliances of 1e-7 beside lengths of 1e-3.
SIZES = np.array([1e-7, 3e-7, 1e-6, 1e-3, 1e-3, 2e-4])
FULL = (("a", "d", "e"), ("d", "b", "f"), ("e", "f", "c"))


def problem(seed: int, rows: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(rows, 6)) @ (np.eye(6) + 0.5 * rng.normal(size=(6, 6))) / SIZES
    return B, B @ (SIZES * rng.normal(size=6)) + rng.normal(size=rows)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.max(np.abs(found - expected) / SIZES))


def matrix(entries, label: str = "K") -> Constraints:
    """A matrix inequality on parameters in units of SIZES."""
    rows = tuple(
        tuple({n: 1 / SIZES[NAMES.index(n)]} if isinstance(n, str) else n for n in row)
        for row in entries
    )
    return Constraints(matrices=(SemidefiniteMatrix(label, rows),))


def value(x: np.ndarray) -> np.ndarray:
    """The matrix FULL at x."""
    a, b, c, d, e, f = x / SIZES
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


@pytest.mark.parametrize("seed", range(3))
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


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10_000), st.lists(st.sampled_from([-np.inf, -1.0, 0.0]), min_size=6, max_size=6),
    st.lists(st.sampled_from([0.3, 1.0, np.inf]), min_size=6, max_size=6),
    st.integers(0, 3), st.sampled_from([1.0, 1e-3]),
)  # fmt: skip
def test_a_minimum_satisfies_karush_kuhn_tucker(seed, lower, upper, equalities, noise):
    rng = np.random.default_rng(seed)
    B, y = problem(seed)
    y = noise * y
    lower, upper = np.array(lower), np.array(upper)
    # Some point inside satisfies the equalities, so that there is a minimum.
    inside = rng.uniform(np.maximum(lower, -2), np.minimum(upper, 2))
    factors = rng.normal(size=(equalities, 6))
    stated = Constraints(
        tuple(map(Bounds, NAMES, lower * SIZES, upper * SIZES)),
        tuple(
            LinearEquality(dict(zip(NAMES, row / SIZES, strict=True)), float(row @ inside), f"{k}")
            for k, row in enumerate(factors)
        ),
    )  # fmt: skip
    found = solve(B, y, NAMES, stated)
    assert breach(B, y, stated.resolve(NAMES), found) < 1e-9 * np.linalg.norm(B * SIZES)
    assert found.objective == pytest.approx(np.sum((y - B @ found.x) ** 2), rel=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.integers(-12, 12), min_size=6, max_size=6))
def test_units_do_not_matter(seed, exponents):
    B, y = problem(seed)
    unit = 2.0 ** np.array(exponents)
    one = solve(B, y, NAMES, non_negative(*NAMES))
    other = solve(B / unit, y, NAMES, non_negative(*NAMES))
    assert relative(other.x / unit, one.x) < 1e-11
    assert [a.label for a in one.active] == [a.label for a in other.active]


def test_prices_are_what_moving_the_constraints_costs():
    B, y = problem(3)

    def stated(value: float, name: str = "") -> Constraints:
        bounds = tuple(Bounds(n, value if n == name else 0.0) for n in NAMES[:3])
        t = value * (name == "K")
        K = (({"d": 1e3, "": -t}, {"f": 1e3}), ({"f": 1e3}, {"e": 1e3, "": -t}))
        total = LinearEquality({"d": 1.0, "e": 1.0}, 1e-3 + value * (name == "sum"))
        return Constraints(bounds, (total,), (SemidefiniteMatrix("K", K),))

    found = solve(B, y, NAMES, stated(0.0))
    assert {a.kind for a in found.active} == {"lower", "equality", "semidefinite"}
    for a in found.active:
        name = {"equality": "sum", "semidefinite": "K"}.get(a.kind, a.names[0])
        step = 1e-5 * (1.0 if name == "K" else SIZES[NAMES.index(a.names[0])])
        up, down = (solve(B, y, NAMES, stated(s * step, name)).objective for s in (1, -1))
        assert a.multiplier == pytest.approx((up - down) / (2 * step), rel=1e-3)


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


def test_what_nothing_determines_is_named_and_an_equality_can_determine_it():
    B, y = problem(0)
    B[:, 1] = 2 * B[:, 0]
    with pytest.raises(InsufficientDataError, match="do not determine a, b:"):
        solve(B, y, NAMES, non_negative(*NAMES))
    assert relative(*np.repeat(solve(B, y, NAMES, equal("a", "b")).x[None, :1], 2, axis=0)) == 0


@pytest.mark.parametrize("seed", range(2))
def test_a_semidefinite_fit_is_the_best_factor(seed):
    # Random truth is indefinite: the constraint binds, with a null space of one or two.
    B, y = problem(seed)
    found = solve(B, y, NAMES, matrix(FULL))
    values = np.linalg.eigvalsh(value(found.x))
    assert values[0] > -1e-8 * max(values[-1], 1)
    assert [a.kind for a in found.active] == ["semidefinite"] and found.active[0].multiplier > 0

    def residual(factor):
        L = np.zeros((3, 3))
        L[np.tril_indices(3)] = factor
        M = L @ L.T
        z = np.array([M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2]])
        return B @ (SIZES * z) - y

    fits = [
        optimize.least_squares(
            residual, np.random.default_rng(k).normal(size=6), xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        for k in range(3)
    ]
    best = 2 * min(f.cost for f in fits)
    assert best * (1 - 1e-6) <= found.objective <= best * (1 + 1e-9)
