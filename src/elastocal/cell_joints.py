"""Keys of the cell file that name a joint and a unit: joint2_deg, joint3_mm."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from elastocal.cell_keys import dotted
from elastocal.errors import InputError
from elastocal.text import did_you_mean
from elastocal.units import to_si

JOINT_UNITS = ("deg", "rad", "m", "mm")
JOINT_KEY = re.compile(r"(joint[1-9][0-9]{0,2})(?:_(deg|rad|mm|m))?", re.ASCII)


def joint_values(
    path: Path,
    above: tuple[str, ...],
    table: Mapping[str, Sequence[float]],
    others: tuple[str, ...] = (),
) -> dict[str, tuple[float, ...]]:
    """Values in SI units per joint name, from keys such as joint2_deg of the table `above`.

    `others`: further keys of that table, which a misspelt one may have been meant for.

    Raises InputError for other keys, missing units, and a joint given in two units.
    """
    values: dict[str, tuple[float, ...]] = {}
    for key, numbers in table.items():
        match = JOINT_KEY.fullmatch(key)
        joint, unit = match.groups() if match else (None, None)
        if joint is None or unit is None:
            valid = [f"joint{i}_{u}" for i in range(1, 10) for u in JOINT_UNITS] + [*others]
            names = " or ".join(f"{joint}_{u}" for u in JOINT_UNITS)
            hint = did_you_mean(key, valid) if joint is None else f"; missing unit: {names}"
            raise InputError(
                f"{path}: unknown key {dotted((*above, key))}{hint}; [{dotted(above)}] takes "
                "keys such as joint1_deg or joint1_rad, for a prismatic joint joint3_m or joint3_mm"
            )
        if joint in values:
            raise InputError(
                f"{path}: [{dotted(above)}] gives {joint} in two units; keep one of them"
            )
        values[joint] = tuple(to_si(float(v), unit) for v in numbers)
    return values
