"""The keys of [source.columns]: columns of the measurement table, and texts about a row."""

from __future__ import annotations

import re
from dataclasses import dataclass

from elastocal.errors import InputError
from elastocal.importing.units import FACTORS
from elastocal.text import did_you_mean, listed, quoted

TEXTS = ("name", "configuration", "marker", "repeat", "load", "time_text", "joint#")
AUTO = "auto"
_QUANTITIES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("x", "y", "z", "distance", "range"), ("length",)),
    **dict.fromkeys(("azimuth", "zenith", "elevation"), ("angle",)),
    **dict.fromkeys(("sigma_x", "sigma_y", "sigma_z"), ("length",)),
    **dict.fromkeys(("sigma_range", "sigma_azimuth", "sigma_elevation"), ("length",)),
    **dict.fromkeys(("rx", "ry", "rz"), ("angle",)),
    **dict.fromkeys(("qw", "qx", "qy", "qz"), ("number",)),
    **dict.fromkeys(("force_x", "force_y", "force_z"), ("force",)),
    "time": ("time",),
    "temperature": ("temperature",),
    "q#": ("angle", "length"),
    "torque_#": ("torque", "force"),
    "approach_#": ("number",),
}
_NUMBERED = re.compile(r"(q|torque_|approach_|joint)([1-9]\d?|#)((?:_[A-Za-z]+)?)")


@dataclass(frozen=True)
class Target:
    """A column to fill: `stem` ("x", "q3", "q#"), `unit` ("" where there is none, or "auto")."""

    key: str
    stem: str
    unit: str
    is_text: bool = False

    @property
    def quantities(self) -> tuple[str, ...]:
        return quantities_of(self.stem)

    @property
    def is_template(self) -> bool:
        """q#: one column for each joint."""
        return self.stem.endswith("#")

    def numbered(self, i: int) -> Target:
        """The column of joint i (from 1) of a template."""
        return Target(
            self.key.replace("#", str(i)), f"{self.stem[:-1]}{i}", self.unit, self.is_text
        )


def quantities_of(stem: str) -> tuple[str, ...]:
    """What the numbers of a column measure."""
    return _QUANTITIES[re.sub(r"^(q|torque_|approach_)\d+$", r"\1#", stem)]


def target_of(where: str, key: str) -> Target:
    """What a key of [source.columns] means.

    Raises InputError for an unknown column, a missing unit and a unit that it cannot have.
    """
    numbered = _NUMBERED.fullmatch(key)
    if numbered:
        family, number, tail = numbered.groups()
        if family == "joint" and not tail:
            return Target(key, key, "", is_text=True)
        stem, unit, general = f"{family}{number}", tail[1:], f"{family}#"
    else:
        if key in TEXTS:
            return Target(key, key, "", is_text=True)
        stem, unit = key, ""
        if key not in _QUANTITIES:
            stem, _, unit = key.rpartition("_")
        general = stem
    if general not in _QUANTITIES:
        valid = [*TEXTS, *_ways()]
        raise InputError(
            f"{where}: unknown column {quoted(key)}{did_you_mean(key, valid)}; columns are "
            f"{listed(valid, 40)}"
        )
    units = [u for quantity in _QUANTITIES[general] for u in FACTORS[quantity]]
    if unit == AUTO and units != [""]:
        return Target(key, stem, AUTO)
    if unit not in units:
        ways = listed(f"{stem}_{u}" if u else stem for u in units)
        what = f"the unit {unit} is not one of its" if unit else "has no unit"
        raise InputError(f"{where}: column {quoted(key)}: {what}; write {ways}")
    return Target(key, stem, unit)


def _ways() -> list[str]:
    return [
        f"{stem}_{next(iter(FACTORS[q[0]]))}".rstrip("_") if q[0] != "number" else stem
        for stem, q in _QUANTITIES.items()
    ]
