"""Units of file columns and keys, and their way to SI."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float64])

# Divisors for the small units: 0.1 mm / 1000 is the float nearest to 0.0001 m, 0.1 mm * 1e-3
# need not be.
_MULTIPLY = {"deg": math.pi / 180.0, "deg_per_s": math.pi / 180.0, "min": 60.0}
_DIVIDE = {"mm": 1e3, "um": 1e6, "urad": 1e6, "ppm": 1e6}
_SI = {"", "si", "m", "rad", "N", "Nm", "s", "C"}

LENGTH = ("mm", "m", "um")
ANGLE = ("deg", "rad")
TIME = ("s", "min")


def to_si(value: Value, unit: str) -> Value:
    """A number or array in `unit` as SI (m, rad, rad/s, N, N m, s, 1); °C stays °C.

    Raises KeyError for a unit not known here, which is a mistake of the program.
    """
    if unit in _MULTIPLY:
        return value * _MULTIPLY[unit]
    if unit in _DIVIDE:
        return value / _DIVIDE[unit]
    if unit not in _SI:
        raise KeyError(unit)
    return value
