"""A table of measurements as a data frame with the columns of the canonical CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from elastocal.measurement_columns import column, families

if TYPE_CHECKING:
    import pandas as pd

    from elastocal.measurements import Measurements

SI_UNITS = ("m", "rad", "s", "N", "Nm", "C", "")


def frame_of(table: Measurements, joint_kinds: Sequence[str] | None = None) -> pd.DataFrame:
    """Labels, then every family that the table has, in SI units; one row per reading.

    `joint_kinds`: "revolute" (default for all joints) or "prismatic", which decides q1_rad or
    q1_m.
    """
    import pandas as pd

    known = families(joint_kinds or ("revolute",) * table.q.shape[1])
    blocks: dict[str, np.ndarray | None] = {
        "repeat": table.repeat,
        "q": table.q,
        "force": table.force,
        "position": table.position,
        "rotation": table.rotation,
        "distance": table.distance,
        "torque": table.torque,
        f"sigma_{table.sigma_frame}": table.sigma,
        "time": table.time,
        "approach": None if table.approach is None else table.approach.astype(np.int64),
        "temperature": table.temperature,
    }
    columns: dict[str, object] = {
        "configuration": np.array(table.configuration_labels, dtype=object)[table.configuration],
        "marker": np.array(table.marker_names, dtype=object)[table.marker],
    }
    for name, values in blocks.items():
        if values is None:
            continue
        stems = known[name].units
        for stem, numbers in zip(stems, values.reshape(len(table), len(stems)).T, strict=True):
            unit = next(unit for unit in SI_UNITS if unit in stems[stem])
            columns[column(stem, unit)] = numbers
    return pd.DataFrame(columns, copy=False)
