"""What the figures show: residuals by observation, standardised, and rms by configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.noise import weights_for
from elastocal.identification.residual_summary import ResidualSummary, summarise_residuals
from elastocal.identification.result import Calibration
from elastocal.manipulator.observation import COMPONENTS, Observations

Array = NDArray[np.float64]

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


def residuals_of(result: Calibration) -> Residuals:
    return residuals_by(result.observations, result.residual)


def residuals_by(seen: Observations, residual: Array) -> Residuals:
    """Residuals (rows,) in m (rad) by observation."""
    table = seen.table
    value = residual.reshape(-1, seen.size) * 1e6
    names = COMPONENTS[seen.kind]
    codes, first, pose = np.unique(seen.configuration, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.argsort(order)
    used, marker = np.unique(table.marker[seen.lead], return_inverse=True)
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
        q=table.q[seen.lead],
        shown=shown,
    )


def summary_of(result: Calibration) -> ResidualSummary | None:
    """The result's own summary of its whitened residuals, else one of the standardised ones."""
    own: ResidualSummary | None = getattr(result, "residual_summary", None)
    if own is not None:
        return own
    return summarise_residuals(result.observations, standardised(result), absolute=False)


def standardised(result: Calibration) -> Array:
    """Weighted residuals (rows,) over their standard deviation; unweighted where the result does
    not hold the weights: those of a given matrix or of an estimated noise."""
    seen, kind = result.observations, result.noise["kind"]
    if result.method == "wls" and kind in ("rows", "axis", "polar"):
        whitened = weights_for(seen, result.model.cell.tracker, kind).apply(result.residual)
        return np.asarray(whitened) / result.sigma
    parts = result.residual.reshape(-1, seen.size)
    spread = np.sqrt((parts**2).mean(axis=0))
    if kind == "none":
        spread = np.full(seen.size, result.sigma)
    return (parts / np.where(spread > 0, spread, 1.0)).ravel()


def rms_by_pose(result: Calibration, residuals: Residuals) -> tuple[Array, Array]:
    """Fitted and held-out 3-D rms (configurations,) in µm; infinite where nothing is held out."""
    size = result.observations.size
    count = np.bincount(residuals.pose)
    found = []
    for rows in (result.residual, result.held_out):
        squared = (rows.reshape(-1, size)[:, : residuals.positions] ** 2).sum(axis=1)
        found.append(np.sqrt(np.bincount(residuals.pose, weights=squared) / count) * 1e6)
    return found[0], found[1]


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
