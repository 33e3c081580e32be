"""Squares under bounds, equalities and matrices: optimality, closed forms, a whole arm."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize, sparse, stats
from support.calibration import measured, with_values
from support.cells import SLANTED, TABLE_2, kr270_cell, table_of

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.constrained import Minimum, Reduced, minimise
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    LinearEquality,
    SemidefiniteMatrix,
    System,
    physical_constraints,
)
from elastocal.identification.least_squares import KnownFit, PriorRows, Problem, fit, profile_end
from elastocal.identification.weighted_problem import Weights
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

NONE = Constraints()
CHI2 = float(stats.chi2.ppf(0.95, 1))


def non_negative(*names: str) -> Constraints:
    return Constraints(tuple(Bounds(name, lower=0.0) for name in names))


def equal(first: str, other: str) -> Constraints:
    return Constraints(equalities=(LinearEquality({first: 1.0, other: -1.0}),))


def solve(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints = NONE
) -> Minimum:
    """The least |y − B x|² under the constraints."""
    return minimise(B, y, stated.resolve(names))


def ends(
    B: np.ndarray, y: np.ndarray, names: Sequence[str], stated: Constraints, name: str,
    rise: float = CHI2,
) -> tuple[float, float]:  # fmt: skip
    """The profile interval of one parameter for rows of unit noise, by default of 95 %."""
    reduced, index = Reduced.of(B, y, stated.resolve(names)), names.index(name)
    best = reduced.minimum()
    low, high = (float(reduced.farthest(index, best, rise, side)[index]) for side in (-1, 1))
    return low, high


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
FULL = (("a", "d", "e"), ("d", "b", "f"), ("e", "f", "c"))


def problem(seed: int, rows: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(rows, 6)) @ (np.eye(6) + 0.5 * rng.normal(size=(6, 6))) / SIZES
    return B, B @ (SIZES * rng.normal(size=6)) + rng.normal(size=rows)


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
    found = solve(B, y, NAMES, equal("a", "b")).x
    assert found[0] == pytest.approx(found[1], rel=1e-12)


def test_a_semidefinite_fit_is_the_best_factor():
    # Random truth is indefinite: the constraint binds, with a null space of one or two.
    B, y = problem(0)
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


# Intervals.

THREE = np.array([1e-7, 1e-6, 1e-3])
RNG = np.random.default_rng(3)
J = RNG.normal(size=(30, 3)) @ np.array([[1, 0.6, 0], [0, 1, 0.4], [0, 0, 1]]) / THREE
COFACTOR = np.linalg.inv(J.T @ J * np.outer(THREE, THREE)) * np.outer(THREE, THREE)
STD = np.sqrt(np.diag(COFACTOR))
NOISE = RNG.normal(size=30)


def readings(*truth_in_std: float) -> np.ndarray:
    return J @ (STD * truth_in_std) + NOISE


def test_one_bound_in_closed_form():
    # With one bound S(v) = rss + (v − x̂)²/V still, and Ŝ is its value at the bound.
    y = readings(-2.0, 5.0, 5.0)
    free = THREE * np.linalg.lstsq(J * THREE, y)[0]
    assert free[0] < 0
    low, high = ends(J, y, NAMES[:3], non_negative("a"), "a")
    assert low == 0.0
    upper = free[0] + np.sqrt(CHI2 * STD[0] ** 2 + free[0] ** 2)
    assert high == pytest.approx(upper, abs=1e-7 * STD[0])


# A whole arm: the KR 270 at the poses of Table 2, nonlinear equilibrium.

SIGMA = 2e-4  # m, of a deflection: coarse, so that a stiff bearing is lost in the noise
BEARING_X, BEARING_Y = "joint2.off_axis_compliance_x", "joint2.off_axis_compliance_y"


@lru_cache
def arm() -> Model:
    return Model(
        kr270_cell(("joint_compliance", "off_axis_compliance:joint2"), observe="deflection")
    )


def of_arm(seed: int, **values: float) -> tuple:
    """Readings of the arm with stiff bearings unless `values` say otherwise, start at nominal."""
    model = arm()
    truth = with_values(model, {"joint3.compliance": 5e-7} | values)
    rng = np.random.default_rng(seed)
    table = measured(model, table_of(TABLE_2, SLANTED, both=True), truth, SIGMA / 2**0.5, rng)
    observed = observe(table, "deflection")
    whiten = sparse.csr_array(sparse.eye_array(len(observed.value)) / SIGMA)
    sizes = model.sizes(model.regressor(table, model.nominal, None, observed).B)
    columns = np.arange(len(model.names))
    weights = Weights("axis", whiten, True, "")
    stated = Problem(model, observed, weights, model.nominal, columns)
    return stated, columns, model.nominal, sizes


def fitted(stated: tuple, constraints: Constraints = NONE, prior=None) -> KnownFit:
    problem, columns, x, _ = stated
    known = PriorRows.stated(problem.model.names, columns, x, constraints, prior, 1.0)
    return KnownFit(fit(*stated, known=known), known, 1.0)


@lru_cache
def negative_bearing() -> tuple:
    """A problem whose unconstrained estimate of BEARING_X is negative."""
    found = of_arm(0)
    assert fit(*found).x[arm().names.index(BEARING_X)] < 0
    return found


def test_a_coupled_matrix_binds_and_the_fit_stays_inside():
    # Bearing compliances as a matrix with a known coupling: x·y ≥ coupling² keeps both positive.
    stated = negative_bearing()
    coupling = 2e-8
    K = SemidefiniteMatrix("bearing", ((BEARING_X, coupling), (coupling, BEARING_Y)))
    found = fitted(stated, Constraints(matrices=(K,)))
    x, y = (found.fit.x[arm().names.index(n)] for n in (BEARING_X, BEARING_Y))
    assert x > 0 and y > 0
    assert x * y == pytest.approx(coupling**2, rel=1e-6)
    assert found.fit.converged
    free = fit(*stated)
    assert found.objective > free.whitened @ free.whitened


@pytest.mark.parametrize("name", [BEARING_X, "joint3.compliance"])
def test_ends_of_a_profile_are_where_the_objective_has_risen_as_far_as_allowed(name):
    stated, physics = negative_bearing(), physical_constraints(arm())
    found, i = fitted(stated, physics), arm().names.index(name)
    for side in (-1, 1):
        end = profile_end(found, i, 3.84, side)
        if name == BEARING_X and side < 0:
            assert end == 0
            continue
        assert side * (end - found.fit.x[i]) > 0
        at_end = Constraints((Bounds(name, end, end),))
        rise = fitted(stated, physics + at_end).objective - found.objective
        assert rise == pytest.approx(3.84, abs=1e-5)


@pytest.mark.parametrize(
    ("covariance", "says"),
    [
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.diag([1.0, 0.0]), "not positive definite"),
        (np.eye(3), "2 × 2 covariance"),
        (np.diag([1.0, np.nan]), "finite"),
    ],
)
def test_an_impossible_covariance_of_a_prior_is_refused(covariance, says):
    with pytest.raises(InputError, match=says):
        GaussianPrior(("a", "b"), np.zeros(2), covariance)
