"""A constrained fit linearised at its minimum: covariance, shares of the prior, leverage."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.identification.constrained.constraints import Constraints
from elastocal.identification.constrained.nonlinear import ConstrainedFit, fit_system
from elastocal.identification.constrained.objective import Loss
from elastocal.identification.constrained.optimality import active_at, tangent_rows
from elastocal.identification.constrained.polyhedral import equality_space
from elastocal.identification.constrained.prior import GaussianPrior, share_of_prior
from elastocal.identification.constrained.system import System
from elastocal.identification.fit import FitProblem

Array = NDArray[np.float64]

PINNED = 1e-12  # of unit columns: what equalities leave of a parameter that they fix


@dataclass(frozen=True)
class Local:
    """The constrained fit about its minimum x̂ (columns,): Σ ρ + |lack − P δ|² in δ = x − x̂.

    `B` (rows, columns) and `e` (rows,) are the whitened regressor and residual there, `P` (k,
    columns) and `lack` (k,) the prior in units of the noise `sigma` of a whitened row.
    """

    names: tuple[str, ...]
    x: Array
    B: Array
    e: Array
    P: Array
    lack: Array
    loss: Loss
    sigma: float
    system: System

    @classmethod
    def at(
        cls,
        problem: FitProblem,
        found: ConstrainedFit,
        constraints: Constraints,
        prior: GaussianPrior | None,
        loss: Loss,
        sigma: float,
    ) -> Local:
        """About the minimum that `constrained_fit` found."""
        x, p = found.x[found.columns], len(found.columns)
        P, target = (np.zeros((0, p)), np.zeros(0)) if prior is None else prior.rows(found.names)
        return cls(
            found.names, x, problem.weights.apply(found.B), found.whitened, sigma * P,
            sigma * (target - P @ x), loss, sigma, fit_system(problem, constraints),
        )  # fmt: skip

    @cached_property
    def K(self) -> Array:
        """(rows, columns) with KᵀK = half the Hessian of the readings' loss."""
        return self.loss.root(self.B, self.e)

    @cached_property
    def unit(self) -> Array:
        """What makes the columns of K and P together unit length."""
        norms = np.linalg.norm(np.vstack([self.K, self.P]), axis=0)
        return 1 / np.where(norms > 0, norms, 1.0)

    @cached_property
    def variance(self) -> float:
        """κ with cov x̂ = κ (KᵀK)⁻¹ for readings alone.

        σ² for squares; for Huber's loss [Σ|ψ|²/(rows − p)] / mean ψ' (Huber and Ronchetti 2009,
        section 7.6, H2), which the root of the Hessian turns into a covariance.
        """
        if self.loss.quadratic:
            return self.sigma**2
        w = self.loss.weights(self.e)
        psi, near = w * self.e, self.loss.lengths(self.e) <= self.loss.threshold
        slope = np.where(near, 1.0, w[:: self.loss.size] * (1 - 1 / self.loss.size)).mean()
        return float(psi @ psi / max(len(psi) - len(self.x), 1) / slope)

    @cached_property
    def equalities(self) -> Array:
        """Directions (columns, q) in which the equalities let x move."""
        space = equality_space(self.system.A * self.unit, np.zeros(len(self.system.b)))
        return self.unit[:, None] * space.basis

    @cached_property
    def face(self) -> Array:
        """Directions (columns, q) in which all active constraints let x move."""
        inside = self.system.moved(self.x, self.unit)
        zero = np.zeros(len(self.x))
        rows, values = tangent_rows(inside, active_at(inside, zero), zero)
        return self.unit[:, None] * equality_space(rows, values).basis

    @cached_property
    def cofactor(self) -> Array:
        """(NᵀKᵀK N + NᵀPᵀP N)⁻¹ in the directions N that the equalities leave."""
        half = self._half(self.equalities)
        return half.T @ half

    @cached_property
    def on_face(self) -> Array:
        """The same with every active constraint taken for an equality."""
        return self._half_on_face.T @ self._half_on_face

    @property
    def covariance(self) -> Array:
        """Posterior covariance (columns, columns), equalities exact, inequalities left out."""
        by_prior = (self.P @ self.cofactor).T @ (self.P @ self.cofactor)
        return self.variance * (self.cofactor - by_prior) + self.sigma**2 * by_prior

    @property
    def prior_share(self) -> Array:
        """Share (columns,) of each estimate's information that is the prior's; NaN where fixed."""
        return share_of_prior(self.cofactor, self.P)

    @property
    def effective(self) -> float:
        """How many parameters' worth the readings determine: tr(cofactor KᵀK) on the face."""
        return self.face.shape[1] - float(((self._half_on_face @ self.P.T) ** 2).sum())

    @property
    def leverage(self) -> Array:
        """Diagonal (rows,) of K cofactor Kᵀ on the face, at most 1."""
        return np.minimum(((self.K @ self._half_on_face.T) ** 2).sum(axis=1), 1.0)

    @cached_property
    def triangle(self) -> tuple[Array, Array]:
        """R (columns, columns), z (columns,): |z − R x|² is the readings' part, but a constant."""
        p = len(self.x)
        R = linalg.qr(self.K * self.unit, mode="r")[0][:p]
        R = np.vstack([R, np.zeros((p - len(R), p))])
        gradient = self.unit * (self.B.T @ (self.loss.weights(self.e) * self.e))
        z = np.linalg.lstsq(R.T, gradient, rcond=None)[0]
        return R / self.unit, z + R @ (self.x / self.unit)

    @cached_property
    def _half_on_face(self) -> Array:
        return self._half(self.face)

    def _half(self, basis: Array) -> Array:
        """H (q, columns) with HᵀH the cofactor within the basis (columns, q)."""
        rows = np.vstack([self.K, self.P]) @ basis
        R = linalg.qr(rows, mode="r")[0][: basis.shape[1]]
        half = linalg.solve_triangular(R, basis.T, trans="T") if R.size else basis.T
        half[:, np.linalg.norm(half / self.unit, axis=0) <= PINNED] = 0.0
        return np.asarray(half)
