"""Ordinary least squares as published against the certified values of the NIST reference sets.

Data and certified values: NIST Statistical Reference Datasets, linear least squares,
https://www.itl.nist.gov/div898/strd/lls/lls.shtml.  nist/NAME.csv holds the observations (y, then
the predictors), nist/certified.json the powers of the predictors in the model (0: constant term),
the parameters, their standard deviations and the residual standard deviation, as certified.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from elastocal.identification.published import ols

FOLDER = Path(__file__).parent / "nist"
CERTIFIED = json.loads((FOLDER / "certified.json").read_text(encoding="utf-8"))
# Filip's powers have a condition of 5e9; the residual of Wampler4 is 1e5 times its signal, that of
# Wampler5 1e7 times, and ordinary precision loses as many digits of x: no arm is so.
DIGITS = {"Filip": 7, "Wampler4": 7, "Wampler5": 5}
EXACT_FIT = {"Wampler1", "Wampler2"}


def read(name):
    """B, y of the model, certified values."""
    certified = CERTIFIED[name]
    table = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",", skiprows=1)
    y, predictors = table[:, 0], table[:, 1:]
    columns = [np.ones((y.size, 1))] if 0 in certified["powers"] else []
    columns += [predictors**k for k in certified["powers"] if k > 0]
    return np.hstack(columns), y, certified


def digits(value, certified):
    """Correct significant digits of the worst entry."""
    value, certified = np.atleast_1d(value), np.atleast_1d(certified)
    error = np.abs(value - certified) / np.abs(certified)
    return float(np.min(-np.log10(np.maximum(error, 1e-17))))


@pytest.mark.parametrize("name", sorted(CERTIFIED))
def test_certified_values(name):
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
