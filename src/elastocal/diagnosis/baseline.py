"""The calibrated arm before any further effect, and what its readings look like beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.blocks import Blocks
from elastocal.errors import InputError
from elastocal.identification.chunked import residual_at
from elastocal.identification.fit import Fit
from elastocal.identification.noise import Weights, stated_covariance, weights_for
from elastocal.identification.selection import Problem
from elastocal.identification.solve import PLACING, is_placed, sizes_and_check, tied_fit
from elastocal.identification.start import start_values
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations, observe
from elastocal.measurements import Measurements
from elastocal.tracker_noise import available_noise

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Baseline:
    """The cell's own model fitted to the table, all parameters weakly tied to their start.

    `x` (parameters,) is the fit, `sizes` typical deviations, `nominal` (rows,) the residual of
    the nominal arm with only base and markers placed, NaN where the fit began elsewhere.
    `stated` (N, size, size) is the noise that cell or table state, None where they state none.
    The last `planned` of the N observations are candidates not yet measured: their residual is
    zero and says nothing about what may be at work.
    """

    model: Model
    seen: Observations
    x: Array
    sizes: Array
    residual: Array
    nominal: Array
    stated: Array | None
    planned: int = 0

    @property
    def n_measured(self) -> int:
        """Observations that were measured; they come first."""
        return len(self.seen.lead) - self.planned

    @property
    def blocks(self) -> Blocks:
        """Readings by configuration; a visit is a configuration, repeat and load state."""
        table, lead = self.seen.table, self.seen.lead
        return Blocks.of(table.configuration[lead], visits(table)[lead], self.seen.size)


def visits(table: Measurements) -> Labels:
    """Number (n,) of each row's visit: its configuration, repeat and force."""
    force = np.round(table.force, 6)
    key = np.column_stack([table.configuration, table.repeat, force])
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def fit_baseline(
    model: Model, table: Measurements, seed: int = 0, x0: Array | None = None
) -> Baseline:
    """Fit the cell's own effects; every parameter stays, held by a weak tie where data do not.

    `x0` (parameters,) spares the search for a start.
    """
    seen = observe(table, model.observe)
    free = np.arange(len(model.parameters))
    weights = weights_for(seen, model.cell.tracker, "auto")
    started = x0 is not None
    if x0 is None:
        x0 = start_values(model, table, seed)
    problem = Problem(model, seen, weights, x0, free, False)
    sizes = sizes_and_check(problem)
    placed, nominal = free[is_placed(model)], None
    if len(placed) and not started:
        base = tied_fit(replace(problem, free=placed), sizes, PLACING)
        problem, nominal = replace(problem, x0=base.x), base.residual
    found: Fit | None = tied_fit(problem, sizes, PLACING) if len(free) else None
    x = x0 if found is None else found.x
    residual = residual_at(model, problem.parts, x) if found is None else found.residual
    if nominal is None:
        unknown = np.full_like(residual, np.nan)
        nominal = unknown if started else residual_at(model, problem.parts, problem.x0)
    return Baseline(model, seen, x, sizes, residual, nominal, _stated(seen, model, weights))


def _stated(seen: Observations, model: Model, weights: Weights) -> Array | None:
    """Stated covariance (N, size, size) of each observation, None where none is stated."""
    if weights.kind == "none":
        return None
    kind = available_noise(seen.table, model.cell.tracker)
    try:
        rows = stated_covariance(seen, model.cell.tracker, kind)[0]
    except InputError:
        return None
    squared = seen.combine.power(2)
    return np.asarray(squared @ rows.reshape(len(rows), -1)).reshape(-1, seen.size, seen.size)
