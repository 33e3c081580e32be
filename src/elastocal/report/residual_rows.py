"""Residuals by direction, marker, load and configuration, as a table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.residual_groups import groupings
from elastocal.manipulator.observation import Observations
from elastocal.report.page import Table
from elastocal.report.residuals import Residuals
from elastocal.report.units import significant
from elastocal.report.words import printable

HEADS = ("readings of", "number", "mean", "rms", "largest", "unit")
MOST_CONFIGURATIONS = 200
Rows = list[tuple[str, ...]]


def residual_table(seen: Observations, residuals: Residuals) -> Table:
    """Mean, rms and largest residual of every direction, marker, load state and configuration.

    Of a direction they are signed; else lengths of the 3-D residual, and of its mean vector.
    """
    rows: Rows = []
    groups: dict[int, str] = {0: "direction"}
    for name, unit, value in zip(
        residuals.components, residuals.units, residuals.value.T, strict=True
    ):
        largest = value[np.argmax(np.abs(value))]
        rows.append((name, str(len(value)), _signed(value.mean()), _size(value), _signed(largest),
                     unit))  # fmt: skip
    part = residuals.value[:, : residuals.positions]
    every = np.ones(len(seen.value), dtype=bool)
    for labels in groupings(seen, every):
        if labels.by == "component":
            continue
        code = labels.code[:: seen.size]
        groups[len(rows)] = labels.by
        rows += _group_rows(part, code, labels.names[:MOST_CONFIGURATIONS])
    return Table(HEADS, rows, words=(0, 5), groups=groups)


def _group_rows(part: NDArray[np.float64], code: NDArray[np.int64], names: tuple[str, ...]) -> Rows:
    rows: Rows = []
    for k, name in enumerate(names):
        own = part[code == k]
        sizes = np.linalg.norm(own, axis=1)
        mean = float(np.linalg.norm(own.mean(axis=0)))
        rows.append((printable(name), str(len(own)), significant(mean), _size(sizes),
                     significant(float(sizes.max())), "µm"))  # fmt: skip
    return rows


def _size(values: NDArray[np.float64]) -> str:
    return significant(float(np.sqrt((values**2).mean())))


def _signed(value: float) -> str:
    return f"{'−' if value < 0 else '+'}{significant(abs(float(value)))}"
