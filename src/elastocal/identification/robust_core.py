"""What every robust fit is made of: its linear model, losses, scale and tuning constants."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, optimize, special

from elastocal.errors import InsufficientDataError, require
from elastocal.identification.linear_solver import checked_problem
from elastocal.units import Array

# The linear model of every robust fit: checked input and an orthonormal basis of B.

DEPENDENT = 1e-12  # share of its length off the columns before it, below which a column is none


@dataclass(frozen=True)
class Design:
    """y (rows,) ≈ B (rows, p) x in n observations of `size` consecutive whitened rows.

    B = Q R diag(norm) with orthonormal Q (rows, p).  Solvers work with z = R diag(norm) x, where
    |Q δz| = |δz|: the units of the parameters and their scaling cannot matter.
    """

    B: Array
    y: Array
    size: int
    Q: Array
    R: Array
    norm: Array

    @property
    def n(self) -> int:
        return len(self.y) // self.size

    @property
    def p(self) -> int:
        return self.Q.shape[1]

    @property
    def floor(self) -> float:
        """Smallest scale that rounding of y lets a residual have."""
        return float(np.finfo(float).eps * np.sqrt(np.mean(self.y**2)) + np.finfo(float).tiny)

    def parameters(self, z: Array) -> Array:
        """x (p,) or (p, k) of coordinates z."""
        return (linalg.solve_triangular(self.R, z, check_finite=False).T / self.norm).T

    def coordinates(self, x: Array) -> Array:
        """z (p,) of parameters x (p,)."""
        return self.R @ (self.norm * x)

    def residual(self, z: Array) -> Array:
        """y − Q z (rows,)."""
        return self.y - self.Q @ z

    def rows(self, weights: Array) -> Array:
        """Per-observation weights (n,) repeated for the rows (rows,)."""
        return np.repeat(weights, self.size)

    def weighted_step(self, weights: Array, r: Array) -> Array:
        """δz (p,) minimising Σ w_i |r_i − Q_i δz|².

        Raises InsufficientDataError where the observations that keep a weight do not determine
        every parameter.
        """
        QW = self.Q.T * self.rows(weights)
        gram = QW @ self.Q
        try:
            factor = linalg.cho_factor(gram, check_finite=False)
        except linalg.LinAlgError:
            raise InsufficientDataError(
                "the observations that the loss does not reject do not determine all parameters; "
                "measure more, or fit fewer parameters"
            ) from None
        return np.asarray(linalg.cho_solve(factor, QW @ r, check_finite=False))


def design(B: ArrayLike, y: ArrayLike, size: int) -> Design:
    """Check B (n·size, p) and y (n·size,), and factor B.

    Raises InputError for wrong shapes or values that are not finite, rows that are no multiple
    of `size`, no degree of freedom, or columns that depend on others.
    """
    B, y, _, _ = checked_problem(B, y, None, None)
    m, p = B.shape
    require(
        size >= 1 and m % size == 0,
        f"{m} rows cannot be split into observations of {size} rows; check size",
    )
    require(
        m > p,
        f"{m} rows leave no degree of freedom for {p} parameters; measure more or fit fewer",
    )
    norm = np.linalg.norm(B, axis=0)
    Q, R = linalg.qr(B / np.where(norm > 0, norm, 1.0), mode="economic")
    dependent = np.flatnonzero((np.abs(np.diag(R)) < DEPENDENT) | (norm == 0))
    require(
        not dependent.size,
        f"columns {dependent.tolist()} of B are zero or depend on the columns before them; "
        "drop them first",
    )
    return Design(B, y, size, Q, R, norm)


def lengths(residual: Array, size: int) -> Array:
    """|e_i| (n,) of each observation; for size 1 its absolute value."""
    return np.abs(residual) if size == 1 else np.linalg.norm(residual.reshape(-1, size), axis=1)


# Losses ρ(d) of the length d = |e_i|/σ of an observation's scaled residual.
#
# An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a
# whole: the loss sees its Mahalanobis length, and its rows share one weight.  For size 1 the
# length is |r| and these are the usual losses per row.


@dataclass(frozen=True)
class Loss(ABC):
    """ρ, ψ = ρ′, weight ψ(d)/d and slope ψ′, elementwise; even or odd in d."""

    name: ClassVar[str]
    size: int

    def __post_init__(self) -> None:
        require(self.size >= 1, f"an observation has at least one row; size is {self.size}")

    @property
    def kink(self) -> float | None:
        """Where ψ′ or a derivative of it jumps, if anywhere beyond zero."""
        return None

    @abstractmethod
    def rho(self, d: Array) -> Array:
        """ρ(d), with ρ(0) = 0."""

    @abstractmethod
    def weight(self, d: Array) -> Array:
        """ψ(d)/d, the weight in ψ's estimating equation; not an inverse variance."""

    @abstractmethod
    def slope(self, d: Array) -> Array:
        """ψ′(d)."""

    def psi(self, d: Array) -> Array:
        """ψ(d) = ρ′(d)."""
        return d * self.weight(d)


@dataclass(frozen=True)
class Cut(Loss):
    """A loss that changes its form at d = c."""

    c: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("c", self.c)

    @property
    def kink(self) -> float:
        return self.c


@dataclass(frozen=True)
class Huber(Cut):
    """ρ = d²/2 up to c, c|d| − c²/2 beyond (Huber 1964)."""

    name: ClassVar[str] = "huber"

    def rho(self, d: Array) -> Array:
        a = np.abs(d)
        return np.where(a <= self.c, a**2 / 2, self.c * (a - self.c / 2))

    def weight(self, d: Array) -> Array:
        return self.c / np.maximum(np.abs(d), self.c)

    def slope(self, d: Array) -> Array:
        return (np.abs(d) <= self.c).astype(float)


@dataclass(frozen=True)
class Bisquare(Cut):
    """Tukey's ρ = c²/6 (1 − (1 − (d/c)²)³) up to c, c²/6 beyond (Beaton and Tukey 1974)."""

    name: ClassVar[str] = "tukey"

    @property
    def largest(self) -> float:
        """sup ρ = c²/6."""
        return self.c**2 / 6

    def rho(self, d: Array) -> Array:
        return self.largest * (1 - self._inside(d) ** 3)

    def weight(self, d: Array) -> Array:
        return self._inside(d) ** 2

    def slope(self, d: Array) -> Array:
        inside = self._inside(d)
        return inside * (5 * inside - 4)  # (1 − u²)(1 − 5u²), u = d/c

    def _inside(self, d: Array) -> Array:
        return np.maximum(1 - (d / self.c) ** 2, 0.0)


@dataclass(frozen=True)
class Absolute(Loss):
    """ρ = |d|: least absolute values, or the sum of Euclidean lengths for size > 1."""

    name: ClassVar[str] = "l1"

    def rho(self, d: Array) -> Array:
        return np.abs(d)

    def weight(self, d: Array) -> Array:
        return 1 / np.maximum(np.abs(d), np.finfo(float).tiny)

    def slope(self, d: Array) -> Array:
        return np.zeros_like(d)


@dataclass(frozen=True)
class StudentT(Loss):
    """−log density of the multivariate t: ρ = (ν + size)/2 · log(1 + d²/ν)."""

    name: ClassVar[str] = "student-t"
    nu: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("nu", self.nu)

    def rho(self, d: Array) -> Array:
        return (self.nu + self.size) / 2 * np.log1p(d**2 / self.nu)

    def weight(self, d: Array) -> Array:
        return (self.nu + self.size) / (self.nu + d**2)

    def slope(self, d: Array) -> Array:
        return (self.nu + self.size) * (self.nu - d**2) / (self.nu + d**2) ** 2


def _positive(name: str, value: float) -> None:
    require(0 < value < np.inf, f"{name} must be positive and finite; found {value}")


# Tuning constants for a given efficiency or breakdown point, computed for the dimension.
#
# Under normal noise the scaled length of an observation of `size` rows follows χ(size).  With
# r = e/σ, Ψ(r) = ψ(|r|) r/|r| and J = ∂Ψ/∂r, symmetry gives E J = a·I and E ΨΨᵀ = b·I with
#
#     a = E[ψ′/size + (1 − 1/size) ψ(d)/d],    b = E ψ²/size,
#
# the asymptotic covariance σ² (b/a²)(BᵀB)⁻¹ and the efficiency a²/b (Huber 1981, section 7.6, for
# size 1; Maronna 1976 for vectors).  The constant for 95 % is 1.345 (Huber) or 4.685 (bisquare)
# for size 1 and grows with the dimension: three components at once are seldom all small.

EFFICIENCY = 0.95


def normal_mean(g: Callable[[Array], Array], size: int, kink: float | None = None) -> float:
    """E g(d) for d ~ χ(size), g smooth except perhaps at `kink`."""
    from scipy import integrate  # slow to import, and every fit needs this module

    area = special.gamma(size / 2) * 2 ** (size / 2 - 1)
    end = float(np.sqrt(special.chdtri(size, 1e-17)))
    edges = [0.0, end] if kink is None or not 0 < kink < end else [0.0, kink, end]
    total = 0.0
    for low, high in pairwise(edges):
        part, _ = integrate.quad(
            lambda d: float(g(np.asarray(d))) * d ** (size - 1) * np.exp(-d * d / 2) / area,
            low, high, epsabs=1e-13, epsrel=1e-12,
        )  # fmt: skip
        total += part
    return total


def normal_moments(loss: Loss) -> tuple[float, float]:
    """a and b of the loss at the normal (see above); efficiency is a²/b."""
    share = 1 / loss.size
    a = normal_mean(
        lambda d: share * loss.slope(d) + (1 - share) * loss.weight(d), loss.size, loss.kink
    )
    return a, share * normal_mean(lambda d: loss.psi(d) ** 2, loss.size, loss.kink)


def efficiency(loss: Loss) -> float:
    """Asymptotic efficiency at the normal relative to least squares, scale known."""
    a, b = normal_moments(loss)
    return a**2 / b


@lru_cache
def huber(size: int = 1, efficient: float = EFFICIENCY) -> Huber:
    """Huber's loss with the given efficiency at the normal for observations of `size` rows.

    Raises InputError where not even the L1 limit is that inefficient.
    """
    c = _solve(lambda c: efficiency(Huber(size, c)), efficient, 1e-3)
    return Huber(size, c)


@lru_cache
def bisquare(size: int = 1, efficient: float = EFFICIENCY) -> Bisquare:
    """Tukey's bisquare with the given efficiency at the normal for observations of `size` rows."""
    start = breakdown_bisquare(size).c
    return Bisquare(size, _solve(lambda c: efficiency(Bisquare(size, c)), efficient, start / 2))


@lru_cache
def breakdown_bisquare(size: int = 1, breakdown: float = 0.5) -> Bisquare:
    """Bisquare of the S-estimate with E ρ = breakdown · sup ρ at the normal.

    1.5476 for size 1 and breakdown 50 % (Rousseeuw and Yohai 1984).
    """
    require(0 < breakdown <= 0.5, f"a breakdown point lies in (0, 0.5]; found {breakdown}")

    def share(c: float) -> float:
        loss = Bisquare(size, c)
        return 1 - normal_mean(loss.rho, size, c) / loss.largest

    return Bisquare(size, _solve(share, 1 - breakdown, 1e-2))


def _solve(rising: Callable[[float], float], target: float, low: float) -> float:
    """c with rising(c) = target, from `low` upwards."""
    require(
        rising(low) < target < 1,
        f"an efficiency of {target} is out of reach: it must lie between {rising(low):.3g} and 1",
    )
    high = 2 * low
    while rising(high) < target:
        high *= 2
    return float(optimize.brentq(lambda c: rising(c) - target, low, high, xtol=1e-12, rtol=1e-13))


# Robust scale of the lengths of whitened residuals, consistent at the normal.


@lru_cache
def median_length(size: int) -> float:
    """Median of χ(size); 0.6745 for size 1."""
    return float(np.sqrt(special.chdtri(size, 0.5)))


def median_scale(length: Array, size: int) -> float:
    """σ = med|e_i| / median of χ(size): the MAD about zero for size 1; breakdown 50 %.

    `length` (n,) of the observations' residuals.
    """
    return float(np.median(length)) / median_length(size)


def m_scale(length: Array, loss: Bisquare, p: int = 0) -> float:
    """M-scale of the S-estimate: σ with Σ ρ(|e_i|/σ) = (n − p/size) E ρ.

    `length` (n,); n − p/size counts observations less what the `p` parameters use up, which
    takes most of the small-sample bias away (Maronna and Yohai 2010).  0 where so many lengths
    are zero that every σ > 0 is too large.
    """
    target = expected_rho(loss) * (len(length) - p / loss.size)

    def excess(scale: float) -> float:
        return float(loss.rho(length / scale).sum()) - target

    return _root(excess, length)


@lru_cache
def expected_rho(loss: Bisquare) -> float:
    """E ρ(d) at the normal."""
    return normal_mean(loss.rho, loss.size, loss.c)


def _root(excess: Callable[[float], float], length: Array) -> float:
    """Scale at which the falling `excess` crosses zero, 0 where it is negative throughout."""
    require(bool(length.size), "a scale needs at least one residual")
    largest = float(length.max())
    positive = length[length > 0]
    if not positive.size or excess(float(positive.min()) * 1e-3) <= 0:
        return 0.0
    high = largest
    while excess(high) > 0:
        high *= 2
    low = float(positive.min()) * 1e-3
    return float(optimize.brentq(excess, low, high, xtol=1e-300, rtol=1e-13, maxiter=500))


# The result of every robust linear fit.


@dataclass(frozen=True)
class RobustEstimate:
    """x (p,) with Σ B_iᵀ Ψ(e_i/σ) = 0, its residual (rows,), scale σ and the loss.

    `weights` (n,) are ψ(d)/d of each observation, 1 for what counts in full and 0 for what is
    rejected (unbounded where an L1 fit meets an observation).  They solve the estimating equation
    and are NOT inverse variances; for the covariance see `asymptotic_covariance`.  `optimality`
    says how nearly x is optimal: |Σ Q_iᵀ Ψ| over √Σ|Ψ|² with an orthonormal basis Q of B, or for
    L1 the duality gap relative to the minimum.
    """

    design: Design
    loss: Loss
    x: Array
    residual: Array
    scale: float
    converged: bool
    iterations: int
    optimality: float

    @property
    def distance(self) -> Array:
        """|e_i|/σ (n,)."""
        return lengths(self.residual, self.design.size) / self.scale

    @property
    def weights(self) -> Array:
        return self.loss.weight(self.distance)

    @property
    def objective(self) -> float:
        """Σ ρ(|e_i|/σ)."""
        return float(self.loss.rho(self.distance).sum())


def estimate_at(
    problem: Design, loss: Loss, z: Array, scale: float, converged: bool, iterations: int
) -> RobustEstimate:
    """The estimate at coordinates z; zero |Σ Q_iᵀ Ψ_i| solves its estimating equation."""
    r = problem.residual(z)
    scores = problem.rows(loss.weight(lengths(r, problem.size) / scale)) * r / scale
    size = float(np.linalg.norm(scores))
    optimality = float(np.linalg.norm(problem.Q.T @ scores)) / size if size > 0 else 0.0
    return RobustEstimate(
        problem, loss, problem.parameters(z), r, scale, converged, iterations, optimality
    )
