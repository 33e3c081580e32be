"""Writes a table of measurements as the canonical CSV: SI units, every digit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastocal.errors import InputError
from elastocal.files import atomic_writer
from elastocal.labels import is_label
from elastocal.measurement_columns import column, families
from elastocal.measurements import Measurements
from elastocal.nearest import quoted

SI_UNITS = ("m", "rad", "s", "N", "Nm", "C", "")


def write_measurements(
    measurements: Measurements, path: str | Path, joint_kinds: Sequence[str] | None = None
) -> None:
    """Write the table to a CSV that reads back bit for bit; whole or not at all.

    `joint_kinds`: "revolute" (default for all joints) or "prismatic", which decides q1_rad or
    q1_m.  Raises InputError where the folder is missing or not writable, and for values or
    labels that no table can hold (NaN, infinite, control characters).
    """
    import pandas as pd

    table = measurements
    kinds = joint_kinds or ("revolute",) * table.q.shape[1]
    known = families(kinds)
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
        "configuration": _labels(table.configuration, table.configuration_labels),
        "marker": _labels(table.marker, table.marker_names),
    }
    for name, values in blocks.items():
        if values is None:
            continue
        if not np.isfinite(values).all():
            raise InputError(f"{path}: the {known[name].meaning} to write are not all finite")
        stems = known[name].units
        for stem, numbers in zip(stems, values.reshape(len(table), len(stems)).T, strict=True):
            unit = next(unit for unit in SI_UNITS if unit in stems[stem])
            columns[column(stem, unit)] = numbers
    # Without a float format pandas writes the shortest digits (17 at most) that read back exactly.
    with atomic_writer(path) as handle:
        pd.DataFrame(columns, copy=False).to_csv(handle, index=False, lineterminator="\n")


def _labels(codes: np.ndarray, names: Sequence[str]) -> np.ndarray:
    for name in names:
        if not is_label(name):
            raise InputError(
                f"label {quoted(name)} cannot stand in a table; use one line without blanks at "
                "its ends"
            )
    return np.array(names, dtype=object)[codes]
