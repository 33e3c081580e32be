"""What setting far readings apart makes of an estimate, where the noise has heavy tails."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from elastocal.identification.outliers import FALSE_ALARM
from elastocal.units import Array


def rejection_point(values: int, dof: ArrayLike = np.inf, level: float = FALSE_ALARM) -> Array:
    """How many standard deviations off a reading's component lies that is set apart: beyond what t
    on `dof` degrees of freedom makes of a table of so many `values`, at a `level` for the whole
    table (Bonferroni)."""
    return np.asarray(-special.stdtrit(dof, level / values / 2))


# What setting readings apart makes of an estimate.
#
# Σ B_iᵀ ψ(r_i) = 0 with ψ(r) = r where all components of a reading are within c standard deviations
# of those kept, else 0, is an M-estimate: of the covariance
#
#     E[ψ²] / E[ψ']² · (BᵀB)⁻¹,    E[ψ'] = −∫ ψ f' dr = E[ψ · (ν + 1) r / (ν a² + r²)]
#
# (Huber 1964, Ann. Math. Stat. 35, 73), for noise of the density f, Student's t of scale a; ψ
# jumps, hence the second form.  None can have less than 1/I = a² (ν + 3)/(ν + 1).

NODES, STEPS = 200, 50


@dataclass(frozen=True)
class TrimmedNoise:
    """Noise of variance one of which far readings are set apart: the standard deviation `sigma` and
    the `excess_kurtosis` of what is kept, and the `variance` of an estimate over that by least
    squares of normal noise of variance one."""

    sigma: float
    excess_kurtosis: float
    variance: float


@lru_cache(maxsize=256)
def kept_of(dof: float, values: int, size: int) -> TrimmedNoise:
    """What `rejection_point` keeps of a table of so many `values`, `size` independent components to
    a reading, whose noise is Student's t on `dof` > 2 degrees of freedom."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    squared_scale = 1 - 2 / dof
    constant = special.gammaln((dof + 1) / 2) - special.gammaln(dof / 2)
    constant -= 0.5 * np.log(dof * np.pi * squared_scale)
    point, sigma = float(rejection_point(values)), 1.0
    for _ in range(STEPS):
        reach = point * sigma
        r = reach * (nodes + 1) / 2
        log_f = constant - (dof + 1) / 2 * np.log1p(r**2 / (dof * squared_scale))
        f = reach * weights * np.exp(log_f)  # both sides of zero
        share, second = float(f.sum()), float(f @ r**2)
        sigma = float(np.sqrt(second / share))
    slope = float(f @ (r**2 * (dof + 1) / (dof * squared_scale + r**2)))
    others = share ** (size - 1)  # the reading's other components are near as well
    kurtosis = float(f @ r**4) / share / sigma**4 - 3
    return TrimmedNoise(sigma, kurtosis, second / (slope**2 * others))
