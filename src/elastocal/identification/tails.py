"""Heavy tails: which readings set apart are mistakes and which the far end of the noise itself, and
what setting readings apart makes of an estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from elastocal.identification.outliers import FALSE_ALARM
from elastocal.units import Array, BoolArray


def rejection_point(values: int, dof: ArrayLike = np.inf, level: float = FALSE_ALARM) -> Array:
    """How many standard deviations off a reading's component lies that is set apart: beyond what t
    on `dof` degrees of freedom makes of a table of so many `values`, at a `level` for the whole
    table (Bonferroni)."""
    return np.asarray(-special.stdtrit(dof, level / values / 2))


# A mistake, or the noise's own tail?
#
# Readings beyond the rejection point are no part of the fit either way.  What the next reading may
# do is another question: where the noise is Student's t, one in a hundred lies out there, and an
# error that leaves them out flatters.  The kept ones say which it is.  Their standardised errors z,
# |z| ≤ c, are those of a truncated t,
#
#     f(z) = t_ν(z/s)/s / P(|t_ν| ≤ c/s),
#
# of which the normal distribution is the limit 1/ν → 0, at the end of its range: twice the gain in
# log-likelihood is then half zero and half χ² with one degree of freedom (Chernoff 1954, Ann. Math.
# Stat. 25, 573).  Where the normal is rejected, a reading set apart belongs to the noise if the t
# found lets one of a table lie as far out; it then joins those that ν and s are found from.

NOT_NORMAL = 0.01  # p-value below which the tails are not those of normal noise
ROUNDS = 12
FEWEST = 50  # values of which a shape is asked
MOST = 20_000  # values that it is found from
INVERSES = np.log(1e-3), np.log(2.0)  # log 1/ν: from practically normal to wilder than Cauchy
SCALES = np.log(0.05), np.log(5.0)  # log s


@dataclass(frozen=True)
class Tails:
    """Student's t that the errors of readings follow: `dof`, `scale` in standard deviations of
    those kept, and the p-value `p` of normal noise.  `counted` (k,) says which of the readings set
    apart are its own far end; the others are mistakes."""

    dof: float
    scale: float
    p: float
    counted: BoolArray

    def to_json(self) -> dict[str, Any]:
        return {
            "dof": self.dof, "scale": self.scale, "p": self.p,
            "set_apart": len(self.counted), "counted": int(self.counted.sum()),
        }  # fmt: skip


def tails_of(kept: Array, apart: Array) -> Tails | None:
    """The tails of readings of which those in `kept` (n, size) had a part in the fit and those in
    `apart` (k, size) had none, by their errors under the fit to the others in units of the noise
    found; None where these are as normal noise makes them, or too few to say."""
    kept = np.abs(kept)
    values = kept.size + apart.size
    if kept.size < FEWEST:
        return None
    limit = max(float(rejection_point(values)), float(kept.max()))
    found = _fitted(kept.ravel(), limit)
    if found.p >= NOT_NORMAL:
        return None
    farthest = np.abs(apart).max(axis=1, initial=0.0)
    p, counted = found.p, np.zeros(len(apart), dtype=bool)
    for _ in range(ROUNDS):
        reach = found.scale * float(rejection_point(values, found.dof))
        more = counted | (farthest < reach)
        if np.array_equal(more, counted):
            break
        counted = more
        joined = np.concatenate([kept.ravel(), np.abs(apart[counted]).ravel()])
        found = _fitted(joined, max(limit, reach))
    return replace(found, p=p, counted=counted)


def _fitted(z: Array, limit: float) -> Tails:
    """The most likely t of the sizes z (n,), which are cut off at `limit`."""
    z = z[:: len(z) // MOST + 1]
    squared = z**2

    def of_scale(inverse: float) -> tuple[float, float]:
        """−ℓ and log s, at the scale that is the most likely with 1/ν = `inverse`."""
        found = optimize.minimize_scalar(
            lambda log: _cost(squared, limit, inverse, log), bounds=SCALES, method="bounded"
        )
        return float(found.fun), float(found.x)

    normal, _ = of_scale(0.0)
    best = optimize.minimize_scalar(
        lambda log: of_scale(np.exp(log))[0], bounds=INVERSES, method="bounded"
    )
    log_inverse, cost = float(best.x), float(best.fun)
    scale = np.exp(of_scale(np.exp(log_inverse))[1])
    gain = 2 * max(normal - cost, 0.0)
    p = 0.5 * float(special.chdtrc(1, gain)) if gain > 0 else 1.0
    return Tails(float(np.exp(-log_inverse)), float(scale), p, np.zeros(0, dtype=bool))


def _cost(squared: Array, limit: float, inverse: float, log_scale: float) -> float:
    """−ℓ of sizes with these squares (n,), but for a constant."""
    scale = np.exp(log_scale)
    if inverse == 0:
        each = squared / (2 * scale**2) + 0.5 * np.log(2 * np.pi)
        inside = special.erf(limit / scale / np.sqrt(2))
    else:
        dof = 1 / inverse
        each = (dof + 1) / 2 * np.log1p(squared / (dof * scale**2))
        each += special.gammaln(dof / 2) - special.gammaln((dof + 1) / 2)
        each += 0.5 * np.log(dof * np.pi)
        inside = 1 - 2 * special.stdtr(dof, -limit / scale)
    return float(each.sum() + len(squared) * (log_scale + np.log(max(inside, 1e-300))))


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
