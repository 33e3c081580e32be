"""The static equilibrium of all poses at once, and the exact derivative through it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.model.evaluate import BackendReport, BatchFunction, row_blocks

MAX_STEPS = 30
LARGEST = 0.5  # rad or m
# F_θ written out whole takes about half of F's instructions for every spring.  Beyond this many,
# one derivative along a direction is evaluated in every direction first: with 56 springs and the
# whole catalogue 15 000 instructions instead of 174 000, which are made and evaluated on a small
# table in a fraction of the time.  A row takes twice as long, so that after ROWS_THAT_PAY rows
# F_θ is written out after all; counted and not timed, so that nothing depends on the clock.
LARGEST_JACOBIAN = 60_000
ROWS_THAT_PAY = 2000
AT_A_TIME = 16_384  # rows × directions evaluated together
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
        self._symbols, self._expression = [*inputs, p, theta], residual
        self._backend, self._rows = backend, 0
        self._value = BatchFunction(self._symbols, [residual], backend)
        self._large = self._value.n_instructions * self.size / 2 > LARGEST_JACOBIAN
        self._last = self._value

    @cached_property
    def _whole(self) -> BatchFunction:
        """F and F_θ."""
        outputs = [self._expression, ca.jacobian(self._expression, self._symbols[-1])]
        return BatchFunction(self._symbols, outputs, self._backend)

    @cached_property
    def _along(self) -> BatchFunction:
        """F_θ·d in a direction d, a further input."""
        direction = ca.SX.sym("direction", self.size)
        slope = ca.jtimes(self._expression, self._symbols[-1], direction)
        return BatchFunction([*self._symbols, direction], [slope], self._backend)

    @property
    def report(self) -> BackendReport:
        """What evaluated F and F_θ last."""
        return self._last.report

    def _residual(
        self, inputs: Sequence[NDArray], p: NDArray, theta: NDArray
    ) -> tuple[NDArray, NDArray]:
        """F (n, size, 1) and F_θ (n, size, size)."""
        self._rows += len(theta)
        if not self._large or self._rows > ROWS_THAT_PAY:
            self._last = self._whole
            F, F_theta = self._whole(*inputs, p, theta)
            return F, F_theta
        self._last = self._along
        (F,) = self._value(*inputs, p, theta)
        F_theta = np.empty((len(theta), self.size, self.size), dtype=F.dtype)
        for block in row_blocks(len(theta), max(AT_A_TIME // self.size, 1)):
            n = block.stop - block.start
            rows = [np.repeat(a[block], self.size, axis=0) for a in (*inputs, theta)]
            (slope,) = self._along(*rows[:-1], p, rows[-1], np.tile(np.eye(self.size), (n, 1)))
            F_theta[block] = slope.reshape(n, self.size, self.size).transpose(0, 2, 1)
        return F, F_theta

    def solve(self, inputs: Sequence[NDArray], p: NDArray) -> tuple[NDArray, NDArray]:
        """θ (n, size) by Newton's method on all rows, and F_θ (n, size, size) there.

        Rows that do not settle become NaN, with F_θ = 1 so that it can still be solved with.
        """
        theta = self._stationary(inputs, p, len(inputs[0]))
        with np.errstate(invalid="ignore"):
            theta[(np.abs(theta.real) > LARGEST).any(axis=1)] = np.nan
        F_theta = self._residual(inputs, p, theta)[1]
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
            F, F_theta = self._residual(rows, p, theta[active])
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
