"""Forces of the load states that a mapping names."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.importing.pool import Pool
from elastocal.importing.schema import LoadTable
from elastocal.nearest import did_you_mean, listed, quoted

GRAVITY = 9.80665  # m/s², standard
UNLOADED = ("none", "unloaded", "0")


def forces_of(
    where: str, points: Pool, loads: Mapping[str, NDArray[np.float64] | LoadTable] | None
) -> NDArray[np.float64] | None:
    """(n, 3) N in the tracker's frame (z up) for each point; None where no load is told.

    A mass m hangs straight down: force (0, 0, -9.80665 m).  The names none, unloaded and 0 mean no
    force unless [loads] says otherwise.  Raises InputError for a load that [loads] does not have,
    and where loads are told both by name and in columns.
    """
    named = points.labels.get("load")
    if named is None:
        if loads and "force_x" not in points.numbers:
            raise InputError(
                f"{where}: [loads] names {listed(loads)}, but no file says which load it belongs "
                "to; give load in [[source]], or a group (?P<load>…) in a pattern"
            )
        return None
    if "force_x" in points.numbers:
        raise InputError(
            f"{points.files[0]}: the load is told by name and in columns force_x …; keep one"
        )
    known = {name: np.zeros(3) for name in UNLOADED}
    for name, stated in (loads or {}).items():
        down = stated.mass_kg * GRAVITY if isinstance(stated, LoadTable) else 0.0
        known[name] = np.array(
            [0.0, 0.0, -down] if isinstance(stated, LoadTable) else list(stated), dtype=float
        ) + 0.0  # no -0.0  # fmt: skip
    for i, name in enumerate(named):
        if name not in known:
            raise InputError(
                f"{points.where(i)}: load {quoted(name)} is not in [loads] of {where}"
                f"{did_you_mean(name, known)}; there are {listed(known)}: add "
                f"{name} = [0, 0, -1000] in N, or {name} = {{ mass_kg = 100 }}"
            )
    return np.array([known[name] for name in named])
