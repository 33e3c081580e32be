"""The vocabulary of the measurement table: families of columns and their units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from elastocal.units import ANGLE, LENGTH, TIME

NO_UNIT = ("",)
# Seen in other people's tables: they make a name such as x_cm a wrong unit, not a typing error.
OTHER_UNITS = frozenset(
    ("cm", "km", "nm", "inch", "in", "mrad", "urad", "grad", "turn", "rev", "kN", "kg", "mNm",
     "kNm", "h", "ms", "us", "K", "F", "mm", "m", "um", "deg", "rad", "N", "Nm", "s", "min", "C")
)  # fmt: skip


@dataclass(frozen=True)
class Family:
    """Columns that belong together: all of them or none.

    `units`: stem → the units it may be written in; stems with the same choice share one unit.
    """

    name: str
    meaning: str
    units: Mapping[str, tuple[str, ...]]
    is_label: bool = False

    def columns(self, stem: str) -> tuple[str, ...]:
        """Every way to write the column `stem`."""
        return tuple(column(stem, unit) for unit in self.units[stem])


def column(stem: str, unit: str) -> str:
    """The header of a column: x_mm, or approach_1 where there is no unit."""
    return f"{stem}_{unit}" if unit else stem


def families(joint_kinds: Sequence[str]) -> dict[str, Family]:
    """Every family of columns for a robot with these joints ("revolute" or "prismatic")."""
    numbered = list(enumerate(joint_kinds, start=1))

    def per_joint(stem: str, revolute: tuple[str, ...], prismatic: tuple[str, ...]) -> dict:
        return {
            stem.format(i): prismatic if kind == "prismatic" else revolute for i, kind in numbered
        }

    def same(units: tuple[str, ...], *stems: str) -> dict[str, tuple[str, ...]]:
        return dict.fromkeys(stems, units)

    known = (
        Family("configuration", "configuration", same(NO_UNIT, "configuration"), is_label=True),
        Family("repeat", "repeat", same(NO_UNIT, "repeat")),
        Family("marker", "marker", same(NO_UNIT, "marker"), is_label=True),
        Family("q", "joint positions", per_joint("q{}", ANGLE, LENGTH[:2])),
        Family("force", "forces", same(("N",), "force_x", "force_y", "force_z")),
        Family("position", "positions", same(LENGTH, "x", "y", "z")),
        Family("rotation", "rotation vector", same(ANGLE, "rx", "ry", "rz")),
        Family("quaternion", "quaternion", same(NO_UNIT, "qw", "qx", "qy", "qz")),
        Family("distance", "distances", same(LENGTH[:2], "distance")),
        Family("torque", "joint torques", per_joint("torque_{}", ("Nm",), ("N",))),
        Family(
            "sigma_cartesian",
            "Cartesian sigmas",
            same(("um", "mm", "m"), "sigma_x", "sigma_y", "sigma_z"),
        ),
        Family(
            "sigma_polar",
            "polar sigmas",
            same(("um", "mm", "m"), "sigma_range", "sigma_azimuth", "sigma_elevation"),
        ),
        Family("time", "time", same(TIME, "time")),
        Family("approach", "approach directions", per_joint("approach_{}", NO_UNIT, NO_UNIT)),
        Family("temperature", "temperature", same(("C",), "temperature")),
    )
    return {family.name: family for family in known}
