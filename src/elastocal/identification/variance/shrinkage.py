"""Many variances from few readings each: shrink their logarithms towards one another.

Empirical Bayes in the spirit of Smyth 2004 (Stat. Appl. Genet. Mol. Biol. 3, 3), with a lognormal
prior that knows direction and configuration: log θ_ca = μ_a + u_c + v_ca, where u ~ N(0, ω_u) and
v ~ N(0, ω_v).  A sample variance s² on f degrees of freedom has log s² = log θ + ψ(f/2) − log(f/2)
plus scatter of variance ψ'(f/2), from which an analysis of variance finds μ, ω_u and ω_v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.errors import InsufficientDataError
from elastocal.identification.variance.readings import Cells
from elastocal.identification.variance.reml import TINY, LogPrior
from elastocal.identification.variance.structure import Structure

Array = NDArray[np.float64]

FEWEST = 2.0  # degrees of freedom of a group, at the median, below which there is nothing to shrink
NARROWEST = 1e-3  # variance of log θ: equal to within 3 %


def prior_of_groups(structure: Structure, residual: Array) -> LogPrior:
    """Prior of the group variances from the scatter of a group's cells about their own mean.

    `residual` (C, size): cell means less a fit.  What all cells of a group share, an effect of
    its configuration, is taken out with the mean.  Raises InsufficientDataError where the groups
    hold too few readings.
    """
    cells = structure.cells
    size = residual.shape[1]
    K = len(structure.names)
    s2, f = _sample_variances(cells, structure.index, residual, K)
    if np.median(f) < FEWEST or 3 * size > K:
        raise InsufficientDataError(
            "the groups of a configuration and a direction hold too few readings for variances of "
            "their own; repeat readings, or choose another noise model"
        )
    # A lucky group of (near) equal readings says little about its variance, not minus infinity.
    s2 = np.maximum(s2, max(1e-6 * float(np.median(s2)), TINY))
    z = np.log(s2) - special.digamma(f / 2) + np.log(f / 2)
    noise = special.polygamma(1, f / 2)
    table, scatter = z.reshape(-1, size), float(noise.mean())
    configurations = len(table)
    mean = np.average(table, axis=0, weights=1 / noise.reshape(-1, size))
    between = table - mean
    u = between.mean(axis=1)
    within = ((between - u[:, None]) ** 2).sum()
    if size > 1:
        omega_v = float(within / ((configurations - 1) * (size - 1))) - scatter
        omega_u = float((u**2).sum() / (configurations - 1)) - (max(omega_v, 0) + scatter) / size
    else:
        omega_v, omega_u = float((u**2).sum() / (configurations - 1)) - scatter, 0.0
    block = max(omega_u, 0.0) * np.ones((size, size)) + max(omega_v, NARROWEST) * np.eye(size)
    precision = np.kron(np.eye(configurations), np.linalg.inv(block)).astype(np.float64)
    return LogPrior(np.tile(mean, configurations), precision)


def _sample_variances(
    cells: Cells, index: NDArray[np.int64], residual: Array, K: int
) -> tuple[Array, Array]:
    """Variance of a single reading within each group (K,), and its degrees of freedom (K,)."""
    weight = np.repeat(cells.repeats[:, None], residual.shape[1], axis=1).ravel()
    group, e = index.ravel(), residual.ravel()
    mean = np.bincount(group, weight * e, K) / np.bincount(group, weight, K)
    squares = np.bincount(group, weight * (e - mean[group]) ** 2, K)
    squares += np.bincount(group, np.diagonal(cells.scatter, axis1=1, axis2=2).ravel(), K)
    dof = np.bincount(group, weight, K) - 1.0
    return squares / np.maximum(dof, 1.0), np.maximum(dof, 0.5)
