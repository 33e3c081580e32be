"""The fit of an arm on NIST's nonlinear and linear reference sets, and the published least squares.

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
from scipy import sparse

from elastocal.identification.least_squares import Problem, fit
from elastocal.identification.published import ols
from elastocal.identification.weighted_problem import Weights
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

    def regressor(self, table, x, columns, observed):
        y, J = (np.asarray(v) for v in self.f(x, self.at))
        return Regression(J[:, columns], y.ravel(), observed)

    def predict(self, table, x, observed):
        return np.asarray(self.f(x, self.at)[0]).ravel()


def digits(value, certified):
    value, certified = np.atleast_1d(value), np.atleast_1d(certified)
    return float(np.min(-np.log10(np.maximum(np.abs(value / certified - 1), 1e-17))))


TABLE = SimpleNamespace(source="data")


def fitted(model, y, start, sizes, sigma=None):
    """The fit from a start, and the standard deviations of its parameters."""
    n, p = len(y), len(start)
    observed = Observations("distance", y, sparse.csr_array(np.eye(n)), np.arange(n), TABLE)
    whiten = None if sigma is None else sparse.csr_array(np.eye(n) / sigma)
    weights = Weights("test", whiten, sigma is not None, "")
    problem = Problem(model, observed, weights, start, np.arange(p))
    found = fit(problem, problem.free, start, sizes, max_steps=2000, tolerance=1e-13)
    variance = found.whitened @ found.whitened / (n - p)
    return found, np.sqrt(variance * np.diag(found.cofactor()))


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
    """B, y of the model, certified values."""
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
