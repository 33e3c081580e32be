"""An estimated covariance of a fit, and the t intervals that follow from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.errors import require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Covariance:
    """Covariance (p, p) of x̂ in the squared units of the parameters, with t degrees of freedom.

    `dof` (p,) belongs to the variance of each parameter on its own: infinite where the variance
    is known, 0 where the estimator cannot tell it (the interval is then unbounded).  The interval
    of a combination Cx needs its own dof: pass B C⁻¹ to the estimator, whose result then refers
    to Cx.
    """

    kind: str
    matrix: Array
    dof: Array
    description: str

    @property
    def std(self) -> Array:
        """Standard deviations (p,); infinite where `dof` is 0."""
        return np.where(self.dof > 0, np.sqrt(np.diag(self.matrix)), np.inf)

    def interval(self, x: Array, level: float = 0.95) -> Array:
        """x_j ± t_{dof_j}((1 + level)/2) · std_j as (p, 2), for the estimate x (p,).

        Raises InputError where x does not match or `level` is not between 0 and 1.
        """
        x = np.asarray(x, dtype=np.float64)
        require(
            x.shape == self.dof.shape,
            f"the covariance is of {self.dof.size} parameters, but x has shape {x.shape}",
        )
        half = t_quantile(level, self.dof) * self.std
        return np.column_stack([x - half, x + half])


def t_quantile(level: float, dof: Array) -> Array:
    """Two-sided quantile of t with `dof`, at any shape: P(|t| ≤ quantile) = level.

    Infinite at dof 0.  Raises InputError unless 0 < level < 1.
    """
    require(0 < level < 1, f"level must lie between 0 and 1, for example 0.95; got {level}")
    known = np.where(dof > 0, dof, 1.0)
    return np.where(dof > 0, stats.t.ppf((1 + level) / 2, known), np.inf)
