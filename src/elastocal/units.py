"""Types of arrays, and units of file columns and keys on their way to SI."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float64])

# Divisors for the small units: 0.1 mm / 1000 is the float nearest to 0.0001 m, 0.1 mm * 1e-3
# need not be.
_MULTIPLY = {"deg": math.pi / 180.0, "deg_per_s": math.pi / 180.0, "min": 60.0}
_DIVIDE = {"mm": 1e3, "um": 1e6, "urad": 1e6, "ppm": 1e6}
_SI = {"", "si", "m", "rad", "N", "Nm", "s", "C", "kg"}

# The types that every room passes on: arrays of numbers, and who is told of progress.
Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Progress = Callable[[str], None]

LENGTH = ("mm", "m", "um")
ANGLE = ("deg", "rad")
TIME = ("s", "min")

# Quantity → unit → what one of it is in the first unit of its row.
FACTORS: dict[str, dict[str, float]] = {
    "length": {"mm": 1.0, "m": 1000.0, "um": 1e-3, "cm": 10.0, "in": 25.4},
    "angle": {"deg": 1.0, "rad": 180 / math.pi, "mrad": 0.18 / math.pi, "gon": 0.9, "rev": 360.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "force": {"N": 1.0, "kN": 1000.0},
    "torque": {"Nm": 1.0, "kNm": 1000.0, "Nmm": 1e-3},
    "temperature": {"C": 1.0, "K": 1.0, "F": 5 / 9},
    "number": {"": 1.0},
}
_ZERO = {"K": -273.15, "F": -160 / 9}  # °C at the zero of the scale
_ALIASES = {
    "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "micron": "um", "microns": "um",
    "µm": "um", "μm": "um", "inch": "in", "inches": "in", "°": "deg", "degree": "deg",
    "degrees": "deg", "radian": "rad", "radians": "rad", "sec": "s", "seconds": "s", "n": "N",
    "nm": "Nm", "n·m": "Nm", "n m": "Nm", "°c": "C", "kn": "kN", "msec": "ms", "µs": "us",
}  # fmt: skip
_BRACKETED = re.compile(r"[\[(]([^\[\]()]++)[\])]$")
_TAILED = re.compile(r"(?:[_/,.]|(?<!\s) )\s*+([A-Za-zµμ°]+)$")


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


def quantities(unit: str) -> tuple[str, ...]:
    """The quantities that have this unit."""
    return tuple(name for name, units in FACTORS.items() if unit in units)


def convert(values: NDArray[np.float64], unit: str, to: str) -> NDArray[np.float64]:
    """`values` in another unit of the same quantity; the same digits where both are one unit."""
    if unit == to:
        return values
    (quantity,) = set(quantities(unit)) & set(quantities(to))
    factors = FACTORS[quantity]
    return values * (factors[unit] / factors[to]) + (_ZERO.get(unit, 0.0) - _ZERO.get(to, 0.0))


def known_unit(text: str) -> str | None:
    """The unit that a word of a header means: "Millimeters" is mm; None for no unit."""
    word = text.strip()
    if any(word in units for units in FACTORS.values()) and word:
        return word
    return _ALIASES.get(word.lower()) or (word.lower() if quantities(word.lower()) else None)


def split_unit(header: str) -> tuple[str, str | None]:
    """("X", "mm") for "X [mm]", "X (mm)", "X_mm" and "X, mm"; (header, None) without a unit."""
    header = header.strip()
    for pattern in (_BRACKETED, _TAILED):
        found = pattern.search(header)
        unit = known_unit(found[1]) if found else None
        if found and unit is not None and header[: found.start()].strip():
            return header[: found.start()].strip(), unit
    return header, None
