"""Lack of fit: do configurations scatter more than repeats of one configuration?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.manipulator.observation import Observations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LackOfFit:
    """F = (SS_between / dof_between) / (SS_pure / dof_pure), its p-value, and both dofs."""

    F: float
    p: float
    dof_between: int
    dof_pure: int


def lack_of_fit(seen: Observations, whitened: Array, n_parameters: int) -> LackOfFit | None:
    """F-test of the residual between configurations against pure error from repeats.

    Repeats are observations of the same configuration, marker and force.  Within them the
    whitened residual (rows,) scatters by pure error, SS_pure with Σ (repeats − 1) · size degrees
    of freedom; what is left of the residual sum of squares lies between them (Draper and Smith
    1998, section 2.1).  None where nothing is repeated, or no degree of freedom is left.
    """
    table, size = seen.table, seen.size
    key = np.column_stack(
        [table.configuration, table.marker, np.round(table.force, 6)],
    )[seen.lead]
    _, group, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    dof_pure = int((count - 1).sum()) * size
    dof_between = len(whitened) - n_parameters - dof_pure
    if dof_pure < 1 or dof_between < 1:
        return None
    residual = whitened.reshape(-1, size)
    mean = np.zeros((len(count), size))
    np.add.at(mean, group, residual)
    mean /= count[:, None]
    pure = float(((residual - mean[group]) ** 2).sum())
    between = max(float((residual**2).sum()) - pure, 0.0)
    if pure <= 0:
        return None
    F = (between / dof_between) / (pure / dof_pure)
    return LackOfFit(F, float(stats.f.sf(F, dof_between, dof_pure)), dof_between, dof_pure)
