"""Writes a table of measurements as the canonical CSV: SI units, every digit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastocal.errors import InputError
from elastocal.files import atomic_writer
from elastocal.labels import is_label
from elastocal.measurement_columns import families
from elastocal.measurements import Measurements
from elastocal.nearest import quoted


def write_measurements(
    measurements: Measurements, path: str | Path, joint_kinds: Sequence[str] | None = None
) -> None:
    """Write the table to a CSV that reads back bit for bit; whole or not at all.

    `joint_kinds`: "revolute" (default for all joints) or "prismatic", which decides q1_rad or
    q1_m.  Raises InputError where the folder is missing or not writable, and for values or
    labels that no table can hold (NaN, infinite, control characters).
    """
    for names in (measurements.configuration_labels, measurements.marker_names):
        _check_labels(names)
    kinds = joint_kinds or ("revolute",) * measurements.q.shape[1]
    frame = measurements.to_dataframe(kinds)
    meaning = {
        header: family.meaning
        for family in families(kinds).values()
        for stem in family.units
        for header in family.columns(stem)
    }
    for header in frame.select_dtypes("number"):
        if not np.isfinite(frame[header].to_numpy()).all():
            raise InputError(f"{path}: the {meaning[header]} to write are not all finite")
    # Without a float format pandas writes the shortest digits (17 at most) that read back exactly.
    with atomic_writer(path) as handle:
        frame.to_csv(handle, index=False, lineterminator="\n")


def _check_labels(names: Sequence[str]) -> None:
    for name in names:
        if not is_label(name):
            raise InputError(
                f"label {quoted(name)} cannot stand in a table; use one line without blanks at "
                "its ends"
            )
