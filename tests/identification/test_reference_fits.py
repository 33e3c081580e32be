"""The fit of an arm on NIST's nonlinear and linear reference sets, and the published least squares;
a profile interval against Fieller's set; a descent that turns back.

Data and certified values: NIST Statistical Reference Datasets, nonlinear and linear least squares,
https://www.itl.nist.gov/div898/strd/.  Both starts that NIST gives are used, the first of which is
far off.  The models are written in CasADi, as those of arms are, and stand in the fit in the place
of an arm.  nist/NAME.csv holds the observations (y, then the predictors), nist/certified.json the
powers of the predictors (0: constant term) and what is certified.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy import sparse, stats

from elastocal.identification.knowledge import Bounds, Constraints
from elastocal.identification.knowledge_fit import KnownFit, profile_end
from elastocal.identification.published import ols
from elastocal.identification.weighted_problem import PriorRows, Problem, Weights, fit
from elastocal.messages import ElastocalError
from elastocal.model.manipulator import Regression
from elastocal.model.observations import Observations

FOLDER = Path(__file__).parent / "nist"
SETS = json.loads((FOLDER / "nonlinear.json").read_text(encoding="utf-8"))
LINEAR = json.loads((FOLDER / "certified.json").read_text(encoding="utf-8"))
MODELS = {
    "Misra1a": lambda b, x: b[0] * (1 - ca.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "BoxBOD": lambda b, x: b[0] * (1 - ca.exp(-b[1] * x)),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * ca.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * ca.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat42": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Thurber": lambda b, x: (
        (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3)
        / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)
    ),
}  # fmt: skip


class AnyModel:
    """What a fit asks of an arm: predictions and B, both from one CasADi function."""

    def __init__(self, function, n, x):
        b, at = ca.SX.sym("b", n), ca.SX.sym("x", len(x))
        y = function(b, at)
        self.f = ca.Function("f", [b, at], [y, ca.jacobian(y, b)])
        self.at, self.parameters, self.shrunk = x, [None] * n, np.zeros(n, dtype=bool)
        self.names = tuple(f"b{k}" for k in range(n))

    def kept_regressor(self, observed, x, columns):
        y, J = (np.asarray(v) for v in self.f(x, self.at))
        return Regression(J[:, columns], y.ravel(), observed)

    def predict(self, table, x, observed):
        return np.asarray(self.f(x, self.at)[0]).ravel()


def digits(value, certified):
    value, certified = np.atleast_1d(value), np.atleast_1d(certified)
    return float(np.min(-np.log10(np.maximum(np.abs(value / certified - 1), 1e-17))))


TABLE = SimpleNamespace(source="data")


def fitted(model, y, start, sizes, sigma=None, known=None):
    """The fit from a start, and the standard deviations of its parameters."""
    n, p = len(y), len(start)
    observed = Observations("distance", y, sparse.csr_array(np.eye(n)), np.arange(n), TABLE)
    whiten = None if sigma is None else sparse.csr_array(np.eye(n) / sigma)
    weights = Weights("test", whiten, sigma is not None, "")
    problem = Problem(model, observed, weights, start, np.arange(p), sizes)
    steps = {"max_steps": 2000, "tolerance": 1e-13, "known": known}
    found = fit(problem, problem.free, start, **steps)
    variance = found.whitened @ found.whitened / max(n - p, 1)
    return found, np.sqrt(variance) * np.linalg.norm(found.r_factor.half, axis=1)


@pytest.mark.parametrize("start", [0, 1], ids=["far", "near"])
@pytest.mark.parametrize("name", sorted(SETS))
def test_certified_values(name, start):
    given = SETS[name]
    x, y = np.array(given["x"]), np.array(given["y"])
    begin = np.array(given["starts"][start], dtype=float)
    found, std = fitted(AnyModel(MODELS[name], len(begin), x), y, begin, np.abs(begin))
    assert found.converged
    assert digits(found.residual @ found.residual, given["rss"]) > 9
    assert digits(found.x, given["b"]) > 5.5
    assert digits(std, given["std"]) > 5.5


# Filip's powers have a condition of 5e9; the residual of Wampler4 is 1e5 times its signal, that of
# Wampler5 1e7 times, and ordinary precision loses as many digits of x: no arm is so.
DIGITS = {"Filip": 7, "Wampler4": 7, "Wampler5": 5}
EXACT_FIT = {"Wampler1", "Wampler2"}


def read(name):
    certified = LINEAR[name]
    table = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)
    y, predictors = table[:, 0], table[:, 1:]
    columns = [np.ones((y.size, 1))] if 0 in certified["powers"] else []
    columns += [predictors**k for k in certified["powers"] if k > 0]
    return np.hstack(columns), y, certified


@pytest.mark.parametrize("name", sorted(LINEAR))
def test_certified_values_of_the_published_equation(name):
    B, y, certified = read(name)
    found, x = ols(B, y), np.array(certified["x"])
    needed = DIGITS.get(name, 9)
    assert digits(found.x, x) >= needed
    if name in EXACT_FIT:
        assert np.all(found.std < 1e-9 * x)
    else:
        needed = 7 if name == "Filip" else 9
        assert digits(found.std, certified["std"]) >= needed
        dof = len(y) - len(x)
        residual_std = np.sqrt(found.residual @ found.residual / dof)
        assert digits(residual_std, certified["residual_std"]) >= needed


@pytest.mark.parametrize("name", sorted(LINEAR))
def test_linear_sets_through_the_fit_under_noise_that_was_estimated(name):
    """One weight for all rows costs no digits, whatever its size."""
    B, y, given = read(name)
    certified = np.array(given["x"])
    model = AnyModel(lambda b, _: ca.DM(B) @ b, len(certified), y)
    sigma = 0.7 * given["residual_std"] or 1
    found, _ = fitted(model, y, np.zeros(len(certified)), np.abs(certified), sigma)
    assert digits(found.x, certified) > DIGITS.get(name, 9)


class Reciprocal(AnyModel):
    """1/x, which has no value below zero."""

    def kept_regressor(self, observed, x, columns):
        if x[0] <= 0:
            raise ElastocalError("no equilibrium")
        return super().kept_regressor(observed, x, columns)


def test_descent_turns_back_where_there_is_no_prediction():
    """The full step from 3 towards 1/x = 2 leads below zero."""
    model = Reciprocal(lambda b, _: 1 / b, 1, np.ones(1))
    found, _ = fitted(model, np.array([2.0]), np.array([3.0]), np.ones(1))
    assert found.converged and found.x[0] == pytest.approx(0.5, rel=1e-9)


# The profile interval of where a line crosses zero is Fieller's set (1954), in closed form.

X = np.linspace(-1, 2, 12)
F = stats.f.ppf(0.95, 1, 10)


def line(seed, slope):
    return 0.8 + slope * X + 0.3 * np.random.default_rng(seed).normal(size=12)


def profile(y, constraints=()):
    """θ of y = b (x − θ), and the ends of its 95 % interval."""
    (b1, b0), (rss,), *_ = np.polyfit(X, y, 1, full=True)
    model, start = AnyModel(lambda b, x: b[1] * (x - b[0]), 2, X), np.array([-b0 / b1, b1])
    sigma = float(np.sqrt(rss / 10))
    system = Constraints(constraints).resolve(model.names)
    known = PriorRows(np.zeros((0, 2)), np.zeros(0), system)
    found = KnownFit(fitted(model, y, start, np.ones(2), known=known)[0], known, sigma)
    return found.fit.x[0], [profile_end(found, 0, F * sigma**2, side) for side in (-1, 1)]


def fieller(y):
    """(b₀ + θ b₁)² ≤ F (v₀₀ + 2θ v₀₁ + θ² v₁₁)"""
    B = np.column_stack([np.ones(12), X])
    (b0, b1), (rss,), *_ = np.linalg.lstsq(B, y)
    v = np.linalg.inv(B.T @ B) * F * rss / 10
    return np.sort(np.roots([b1**2 - v[1, 1], 2 * (b0 * b1 - v[0, 1]), b0**2 - v[0, 0]]))


def test_equals_fieller():
    y = line(3, 0.8)
    theta, ends = profile(y)
    np.testing.assert_allclose(ends, fieller(y), rtol=1e-5)
    assert not np.isclose(sum(ends) / 2, theta, rtol=0.02)


def test_a_flat_side_is_unbounded():
    """A slope that may be zero: the set is the outside of its roots."""
    y = line(1, 0.12)
    theta, ends = profile(y)
    roots = fieller(y)
    assert np.iscomplexobj(roots) or theta < roots[0] or theta > roots[1]
    assert np.isinf(ends).any()


def test_bounds_end_the_interval():
    y = line(3, 0.8)
    low = fieller(y)[0] / 2 + profile(y)[0] / 2
    _, ends = profile(y, (Bounds("b0", low),))
    assert ends == pytest.approx([low, fieller(y)[1]], rel=1e-5)
