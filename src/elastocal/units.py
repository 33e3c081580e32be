"""Types of arrays, units of file columns and keys on their way to SI, angles of rotations."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Value = TypeVar("Value", float, NDArray[np.float64])

# Factor and divisor: 0.1 mm / 1000 is the float nearest to 0.0001 m, 0.1 mm * 1e-3 need not be.
_TO_SI = {
    **dict.fromkeys(("deg", "deg_per_s"), (math.pi / 180.0, 1.0)), "min": (60.0, 1.0),
    "mm": (1.0, 1e3), **dict.fromkeys(("um", "urad", "ppm"), (1.0, 1e6)),
    **dict.fromkeys(("", "si", "m", "rad", "N", "Nm", "s", "C", "kg"), (1.0, 1.0)),
}  # fmt: skip

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
    "mass": {"kg": 1.0},
    "number": {"": 1.0},
}
_ZERO = {"K": -273.15, "F": -160 / 9}  # °C at the zero of the scale
_ALIASES = {
    "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm", "meter": "m",
    "meters": "m", "metre": "m", "metres": "m", "micron": "um", "microns": "um", "µm": "um",
    "μm": "um", "inch": "in", "inches": "in", "°": "deg", "degree": "deg", "degrees": "deg",
    "radian": "rad", "radians": "rad", "sec": "s", "seconds": "s", "n": "N", "nm": "Nm",
    "n·m": "Nm", "n m": "Nm", "°c": "C", "°f": "F", "kn": "kN", "msec": "ms", "µs": "us",
}  # fmt: skip
_BRACKETED = re.compile(r"[\[(]([^\[\]()]++)[\])]$")
_TAILED = re.compile(r"(?:[_/,.]|(?<!\s) )\s*+([A-Za-zµμ°]+)$")


def microns(metres: float | None) -> float | None:
    """Metres as µm for JSON, which has no infinity: None where there is no number."""
    return None if metres is None or not math.isfinite(metres) else metres * 1e6


def pose_at(position: ArrayLike, rotation: Array | None = None) -> Array:
    """T (…, 4, 4) of positions (…, 3) in m and rotations (…, 3, 3), None for none."""
    T = np.tile(np.eye(4), (*np.shape(position)[:-1], 1, 1))
    T[..., :3, 3] = position
    if rotation is not None:
        T[..., :3, :3] = rotation
    return T


def rotation_from_rpy(rpy: Sequence[float] | Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), (3, 3), of angles in rad: the URDF's convention."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


def rpy_from_rotation(R: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad with R = Rz(yaw) Ry(pitch) Rx(roll).  Yaw is taken first and undone
    in the other two, so that all three are exact to rounding at pitch = ±π/2 as well, where the
    textbook formula divides 0 by 0."""
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return roll, pitch, yaw


def to_si(value: Value, unit: str) -> Value:
    """m, rad, rad/s, N, N m, s, 1; °C stays °C."""
    factor, divisor = _TO_SI[unit]
    return value * factor / divisor


def quantities(unit: str) -> tuple[str, ...]:
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


# SI unit → (factor, unit shown).
SHOWN = {
    "m": (1e3, "mm"),
    "rad": (1e3, "mrad"),
    "1": (1e6, "ppm"),
    "rad/(N*m)": (1e6, "µrad/(N·m)"),
    "m/N": (1e6, "µm/N"),
    "N/m": (1e-3, "N/mm"),
    "N*m/rad": (1e-3, "kN·m/rad"),
    "m/s": (3.6e9, "µm/h"),
    "rad/s": (3.6e9, "µrad/h"),
    "1/K": (1e6, "ppm/K"),
    "1/m": (1e6, "µm/m²"),
}


def display(value: float, unit: str) -> tuple[float, str]:
    """As people read it: 2.87e-7, "rad/(N*m)" → 0.287, "µrad/(N·m)".  A unit that is not listed
    keeps its value, written with proper symbols."""
    if unit in SHOWN:
        factor, text = SHOWN[unit]
        return value * factor, text
    return value, unit.replace("*", "·").replace("^2", "²").replace("^3", "³")
