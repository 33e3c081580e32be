"""Squares under bounds, equalities and matrices: optimality, closed forms, a whole arm."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    LinearEquality,
    Minimum,
    SemidefiniteMatrix,
    System,
    minimise,
)
from elastocal.messages import InputError, InsufficientDataError

NONE = Constraints()


def solve(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints = NONE
) -> Minimum:
    return minimise(B, y, stated.resolve(names))


def breach(B: np.ndarray, y: np.ndarray, system: System, found: Minimum) -> float:
    """What of the conditions of Karush, Kuhn and Tucker a fit of bounds and equalities breaks.

    The largest of: a violated constraint, a price of the wrong sign, and a slope of the sum of
    squares that no price explains, each in units of the parameters' own standard deviations.
    """
    unit = 1 / np.linalg.norm(B, axis=0)
    x = found.x / unit
    missed = np.abs(system.A @ found.x - system.b) / np.maximum(
        np.linalg.norm(system.A * unit, axis=1), 1e-300
    )
    parts = [system.lower / unit - x, x - system.upper / unit, missed]
    slope = 2 * unit * (B.T @ (B @ found.x - y))
    for a in found.active:
        if a.kind == "equality":
            row = system.A[system.equality_labels.index(a.label)]
        else:
            row = np.eye(len(x))[system.names.index(a.names[0])]
            parts.append(np.array([-a.multiplier if a.kind == "lower" else a.multiplier]) * unit)
        slope = slope - a.multiplier * row * unit
    parts.append(np.abs(slope))
    return float(max(np.max(part, initial=0.0) for part in parts))


NAMES = tuple("abcdef")
# Parameters of the sizes that an arm has: compliances of 1e-7 beside lengths of 1e-3.
SIZES = np.array([1e-7, 3e-7, 1e-6, 1e-3, 1e-3, 2e-4])
NON_NEGATIVE = Constraints(tuple(Bounds(name, lower=0.0) for name in NAMES))


def problem(seed: int, rows: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(rows, 6)) @ (np.eye(6) + 0.5 * rng.normal(size=(6, 6))) / SIZES
    return B, B @ (SIZES * rng.normal(size=6)) + rng.normal(size=rows)


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
    stated = NON_NEGATIVE + Constraints(
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
        solve(B, y, NAMES, NON_NEGATIVE)
    equal = LinearEquality({"a": 1.0, "b": -1.0})
    found = solve(B, y, NAMES, Constraints(equalities=(equal,))).x
    assert found[0] == pytest.approx(found[1], rel=1e-12)


def test_an_impossible_covariance_of_a_prior_is_refused():
    for covariance, says in (
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.eye(3), "2 × 2 covariance"),
        (np.diag([1.0, np.nan]), "finite"),
    ):
        with pytest.raises(InputError, match=says):
            GaussianPrior(("a", "b"), np.zeros(2), covariance)
