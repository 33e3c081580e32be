"""The static equilibrium of all poses at once, and the exact derivative through it."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend import BackendReport
from elastocal.manipulator.tape import Tape

MAX_STEPS = 30
LARGEST = 0.5  # rad or m
TOLERANCE = 1e-14  # rad (m for prismatic springs); Newton converges quadratically past it


class Equilibrium:
    """Deflections θ with F(θ) = θ − law(τ(θ)) = 0, τ = −∂V/∂θ at the deflected pose.

    Written with compliances, so a rigid joint (k = 0) needs no special case.  Only a stable
    equilibrium with deflections below LARGEST counts: beyond that no arm is elastic any more.
    """

    def __init__(
        self,
        inputs: Sequence[ca.SX],
        p: ca.SX,
        theta: ca.SX,
        residual: ca.SX,
        backend: str | None = None,
    ) -> None:
        self.size = theta.shape[0]
        jacobian = ca.jacobian(residual, theta)
        self._tape = Tape([*inputs, p, theta], [residual, jacobian], backend)

    @property
    def report(self) -> BackendReport:
        """What evaluated F and F_θ last."""
        return self._tape.report

    def solve(self, inputs: Sequence[NDArray], p: NDArray) -> tuple[NDArray, NDArray]:
        """θ (n, size) by Newton's method on all rows, and F_θ (n, size, size) there.

        Rows that do not settle become NaN, with F_θ = 1 so that it can still be solved with.
        """
        theta = self._stationary(inputs, p, len(inputs[0]))
        with np.errstate(invalid="ignore"):
            theta[(np.abs(theta.real) > LARGEST).any(axis=1)] = np.nan
        F_theta = self._tape(*inputs, p, theta)[1]
        theta[self._unstable(F_theta.real)] = np.nan
        F_theta[~np.isfinite(theta).all(axis=1)] = np.eye(self.size)
        return theta, F_theta

    def _unstable(self, F_theta: NDArray) -> NDArray:
        """Indices of the rows whose stationary point is no minimum of the potential."""
        # F_θ = 1 − C·H with the potential's Hessian H: stable while its eigenvalues are positive,
        # which they are wherever C·H is small; only soft poses need the eigenvalues themselves.
        soft = np.abs(F_theta - np.eye(self.size)).sum(axis=2).max(axis=1) >= 1
        rows = np.flatnonzero(soft & np.isfinite(F_theta).all(axis=(1, 2)))
        if not len(rows):
            return rows
        return rows[np.linalg.eigvals(F_theta[rows]).real.min(axis=1) <= 0]

    def _stationary(self, inputs: Sequence[NDArray], p: NDArray, n: int) -> NDArray:
        theta = np.zeros((n, self.size), dtype=np.result_type(np.float64, p, *inputs))
        active = np.arange(n)
        for _ in range(MAX_STEPS):
            rows = [a[active] for a in inputs]
            F, F_theta = self._tape(*rows, p, theta[active])
            finite = np.isfinite(F_theta).all(axis=(1, 2)) & np.isfinite(F[..., 0]).all(axis=1)
            theta[active[~finite]] = np.nan
            active, F, F_theta = active[finite], F[finite], F_theta[finite]
            if not len(active):
                return theta
            try:
                step = np.linalg.solve(F_theta, F)[..., 0]
            except np.linalg.LinAlgError:  # a pose at the verge of buckling
                theta[active] = np.nan
                return theta
            theta[active] -= step
            settled = np.abs(step).max(axis=1) <= TOLERANCE + 1e-12 * np.abs(theta[active]).max(1)
            active = active[~settled]
            if not len(active):
                return theta
        theta[active] = np.nan
        return theta
