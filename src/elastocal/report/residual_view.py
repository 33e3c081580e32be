"""Residuals by observation, by configuration and by group, for tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.residuals import groupings
from elastocal.model.observations import COMPONENTS, Observations
from elastocal.report.blocks import ShownTable
from elastocal.report.formatting import significant
from elastocal.text import printable
from elastocal.units import Array

MOST_DRAWN = 5000  # observations; figures of larger tables show a random choice of them


@dataclass(frozen=True)
class Residuals:
    """Residuals (observations, components) in µm (µrad for rotations) and where they belong.

    `pose` (observations,) counts configurations from 0 in the table's order, `labels` names
    them; `marker` indexes `markers`; `q` (observations, joints) in rad or m; `shown` are the
    observations to draw, all or a random choice.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    pose: NDArray[np.int64]
    labels: tuple[str, ...]
    marker: NDArray[np.int64]
    markers: tuple[str, ...]
    q: Array
    shown: NDArray[np.int64]

    @property
    def positions(self) -> int:
        """How many components are lengths; they come first."""
        return self.units.count("µm")


def residuals_by(observed: Observations, residual: Array) -> Residuals:
    """Residuals (rows,) in m (rad) by observation."""
    table = observed.table
    value = residual.reshape(-1, observed.size) * 1e6
    names = COMPONENTS[observed.kind]
    codes, first, pose = np.unique(observed.configuration, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.argsort(order)
    used, marker = np.unique(table.marker[observed.lead], return_inverse=True)
    n = len(value)
    shown = np.arange(n)
    if n > MOST_DRAWN:
        shown = np.sort(np.random.default_rng(0).choice(n, MOST_DRAWN, replace=False))
    return Residuals(
        components=names,
        units=tuple("µrad" if name.startswith("r") else "µm" for name in names),
        value=value,
        pose=place[pose],
        labels=tuple(table.configuration_labels[codes[k]] for k in order),
        marker=marker,
        markers=tuple(table.marker_names[k] for k in used),
        q=table.q[observed.lead],
        shown=shown,
    )


def reach(values: Array) -> float:
    """Half height of an axis: all values, or 8 robust deviations where some lie far beyond."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size) or size.max() == 0:
        return 1.0
    robust = 8 * 1.4826 * float(np.median(size))
    largest = 1.08 * float(size.max())
    return robust if 0 < robust < largest / 1.5 else largest


def running_mean(x: Array, y: Array, bins: int = 12) -> tuple[Array, Array, Array]:
    """Mean x, mean y and its standard error in bins of equally many x.

    Where x takes few different values, each is a bin.
    """
    order = np.argsort(x, kind="stable")
    steps = np.flatnonzero(np.diff(x[order]) > 1e-9 * (np.abs(x).max(initial=0.0) + 1e-300)) + 1
    if len(steps) >= 1.5 * bins:
        parts = np.array_split(order, min(bins, max(len(x) // 8, 1)))
    else:
        parts = np.split(order, steps)
    parts = [p for p in parts if len(p) > 1]
    middle = np.array([x[p].mean() for p in parts])
    mean = np.array([y[p].mean() for p in parts])
    error = np.array([y[p].std(ddof=1) / np.sqrt(len(p)) for p in parts])
    return middle, mean, error


OF_RESIDUALS = (
    "Of a direction, mean and largest are signed. Of all others the length of the 3-D residual is "
    "given, and the mean is the length of the mean vector: near the rms, the residual is a common "
    "shift; near zero, it is scatter."
)
HEADS = ("readings of", "number", "mean", "rms", "largest", "unit")
MOST_CONFIGURATIONS = 200
Rows = list[tuple[str, ...]]


def residual_table(observed: Observations, residuals: Residuals) -> ShownTable:
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
    every = np.ones(len(observed.value), dtype=bool)
    for by, code, names in groupings(observed, every):
        if by != "component":
            groups[len(rows)] = by
            rows += _group_rows(part, code[:: observed.size], tuple(names[:MOST_CONFIGURATIONS]))
    return ShownTable(HEADS, rows, (0, 5), groups, title="Residuals", note=OF_RESIDUALS)


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
    return f"{'-' if value < 0 else '+'}{significant(abs(float(value)))}"
