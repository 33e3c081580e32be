"""Reads the measurement table: CSV or Parquet → one checked, frozen table in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from elastocal.csv_source import read_csv
from elastocal.errors import InputError
from elastocal.labels import Labels
from elastocal.measurement_header import Layout, layout_of
from elastocal.measurements import Array, IntArray, Measurements
from elastocal.nearest import did_you_mean, listed, quoted
from elastocal.parquet_source import read_parquet
from elastocal.raw_table import RawTable
from elastocal.rotation_vector import rotation_vector
from elastocal.units import to_si

DEFAULT_MARKER = "M1"
QUATERNION_NORM_TOLERANCE = 1e-3
LARGEST_EXACT_INTEGER = 2.0**53


def read_measurements(
    path: str | Path,
    *,
    joint_kinds: tuple[str, ...],
    marker_names: tuple[str, ...] = (),
    observe: str = "position",
) -> Measurements:
    """The measurements of a CSV or Parquet (.parquet, .pq) file, in SI units.

    `joint_kinds`: "revolute" or "prismatic" per joint of the robot; `marker_names`: the cell's
    markers, () if it names none; `observe`: "position", "deflection", "pose" or "distance",
    which decides the columns that must be there, or "plan" or "targets", which ask for none.
    Quaternions become rotation vectors.

    Raises InputError that names file, line, column and the offending text.
    """

    def choose(header: Sequence[str]) -> Layout:
        return layout_of(str(path), header, joint_kinds, observe)

    read = read_parquet if Path(path).suffix.lower() in (".parquet", ".pq") else read_csv
    raw = read(path, choose)
    n = len(raw.row)
    marker = _marker(raw, marker_names)
    configuration = raw.labels.get("configuration")
    if configuration is None:
        configuration = Labels(np.arange(n), tuple(str(i) for i in range(1, n + 1)))
    force, torque, sigma = si_columns(raw, "force"), si_columns(raw, "torque"), _sigma(raw)
    q, time, temperature = (
        si_columns(raw, "q"),
        si_columns(raw, "time"),
        si_columns(raw, "temperature"),
    )
    distance = si_columns(raw, "distance")
    if distance is not None:
        _check(raw, "distance", distance > 0, "a distance must be positive")
    approach = si_columns(raw, "approach")
    if approach is not None:
        good = np.isin(approach, (-1.0, 0.0, 1.0))
        _check(raw, "approach", good, "an approach direction is -1, 0 or 1")
    table = Measurements(
        source=str(path),
        row=raw.row,
        q=np.zeros((n, 0)) if q is None else q,
        configuration=configuration.codes,
        configuration_labels=configuration.names,
        repeat=_repeat(raw),
        marker=marker.codes,
        marker_names=marker.names,
        force=np.zeros((n, 3)) if force is None else force,
        position=si_columns(raw, "position"),
        rotation=rotation_column(raw),
        distance=None if distance is None else distance[:, 0],
        torque=torque,
        sigma=sigma,
        sigma_frame="polar" if "sigma_polar" in raw.layout.columns else "cartesian",
        time=None if time is None else time[:, 0],
        approach=approach,
        temperature=None if temperature is None else temperature[:, 0],
    )
    if observe != "targets":  # a path may pass a place twice
        _check_duplicates(raw, table)
    return table


def read_plan(path: str | Path, *, joint_kinds: tuple[str, ...]) -> Measurements:
    """The poses of a plan: configuration, q1_deg …, and forces where the plan states them.

    `level` and `order`, which a designed plan has, are passed over.  Errors as for measurements.
    """
    return read_measurements(path, joint_kinds=joint_kinds, observe="plan")


def si_columns(raw: RawTable, family: str) -> Array | None:
    """The columns of a family side by side (n, k) in SI units, None where the file has none."""
    if family not in raw.layout.columns:
        return None
    with np.errstate(over="ignore"):
        values = np.column_stack(
            [to_si(raw.numbers[c.header], c.unit) for c in raw.layout.columns[family]]
        )
    _check(raw, family, np.isfinite(values), "too large to be a number here")
    return values


def _check(raw: RawTable, family: str, good: np.ndarray, rule: str) -> None:
    """Raises InputError with `rule` for the first cell of a family (n, k) that is not good."""
    if good.all():
        return
    i, k = (int(v) for v in np.argwhere(~good)[0])
    header = raw.layout.columns[family][k].header
    raise InputError(
        f"{raw.where(i, header)}: {rule}; found {raw.numbers[header][i]:.6g}; correct or drop "
        f"the {raw.noun}"
    )


def _sigma(raw: RawTable) -> Array | None:
    for family in ("sigma_cartesian", "sigma_polar"):
        sigma = si_columns(raw, family)
        if sigma is not None:
            _check(raw, family, sigma > 0, "a standard deviation must be positive")
            return sigma
    return None


def _repeat(raw: RawTable) -> IntArray:
    repeat = si_columns(raw, "repeat")
    if repeat is None:
        return np.zeros(len(raw.row), dtype=np.int64)
    whole = (repeat == np.round(repeat)) & (np.abs(repeat) <= LARGEST_EXACT_INTEGER)
    _check(raw, "repeat", whole, "a repeat is a whole number")
    return repeat[:, 0].astype(np.int64)


def rotation_column(raw: RawTable) -> Array | None:
    """Rotation vectors (n, 3) in rad from rx … or the quaternion, None where there is neither."""
    quaternion = si_columns(raw, "quaternion")
    if quaternion is None:
        return si_columns(raw, "rotation")
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    off = ~(np.abs(norm - 1.0) <= QUATERNION_NORM_TOLERANCE)
    if off.any():
        i = int(np.argmax(off))
        raise InputError(
            f"{raw.where(i, 'qw')}: the quaternion's norm is {norm[i]:.6g}, not 1; check the "
            "order qw, qx, qy, qz and the digits"
        )
    return rotation_vector(quaternion)


def _marker(raw: RawTable, known: tuple[str, ...]) -> Labels:
    labels = raw.labels.get("marker")
    if labels is None:
        if len(known) > 1:
            raise InputError(
                f"{raw.source}: no marker column, but the cell has the markers {listed(known)}; "
                "add a column marker that says which one each row measures"
            )
        return Labels(np.zeros(len(raw.row), dtype=np.int64), known or (DEFAULT_MARKER,))
    if not known:
        return labels
    for code, name in enumerate(labels.names):
        if name not in known:
            i = int(np.argmax(labels.codes == code))
            raise InputError(
                f"{raw.where(i, 'marker')}: {quoted(name)} is no marker of the cell"
                f"{did_you_mean(name, known)}; its markers: {listed(known)}"
            )
    return Labels(np.array([known.index(name) for name in labels.names])[labels.codes], known)


def _check_duplicates(raw: RawTable, table: Measurements) -> None:
    import pandas as pd

    if "configuration" in raw.labels:
        key = [table.configuration, table.repeat, table.marker, *table.force.T]
        what = "the same configuration, repeat, marker and force"
    else:
        key = [*raw.numbers.values(), *(labels.codes for labels in raw.labels.values())]
        what = "the same values in all columns"
    # Adding zero makes -0.0 and 0.0 the same key.
    frame = pd.DataFrame({k: values + 0 for k, values in enumerate(key)}, copy=False)
    repeated = frame.duplicated().to_numpy()
    if repeated.any():
        i = int(np.argmax(repeated))
        same = np.logical_and.reduce([values == values[i] for values in key])
        first = int(np.argmax(same))
        raise InputError(
            f"{raw.source}: {raw.noun}s {raw.row[first]} and {raw.row[i]} have {what}; drop one, "
            "or number true repetitions in a `repeat` column"
        )
