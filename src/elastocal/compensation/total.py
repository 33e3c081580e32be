"""An expression of the elastic arm and its total derivative, through the equilibrium."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.chain import Array
from elastocal.manipulator.symbolic import SymbolicArm
from elastocal.manipulator.tape import Tape


class Total:
    """y(inputs, X, extra; θ) and dy/dz at the static equilibrium F(inputs, X; θ) = 0.

    dy/dz = ∂y/∂z − ∂y/∂θ F_θ⁻¹ ∂F/∂z, by the adjoint λ = F_θ⁻ᵀ (∂y/∂θ)ᵀ as the partial
    derivative of y − λᵀF.  `y` (m, 1) and `z` (k, 1) are expressions of `arm`, whose tapes follow
    the backend; `extra` are further symbols in y.  Where the model is linear (eq. 3) or rigid,
    y is explicit and nothing is solved.
    """

    def __init__(self, arm: SymbolicArm, y: ca.SX, z: ca.SX, extra: Sequence[ca.SX] = ()) -> None:
        self._arm = arm
        theta = arm.arm.theta
        inputs = [*arm.arm.inputs.values(), *extra, arm.p, theta]
        if not arm.implicit:
            y = arm.explicit(y, 0)
            self._slopes = None
            self._tape = Tape(inputs, [y, ca.jacobian(y, z)], arm.backend)
            return
        adjoint = ca.SX.sym("adjoint", y.shape[0], theta.shape[0])
        lagrangian = y - adjoint @ arm.residual
        self._slopes = Tape(inputs, [ca.jacobian(y, theta)], arm.backend)
        self._tape = Tape(
            [*inputs, ca.vec(adjoint.T)], [y, ca.jacobian(lagrangian, z)], arm.backend
        )

    def __call__(
        self, inputs: list[NDArray], x: Array, extra: Sequence[NDArray] = ()
    ) -> tuple[Array, Array]:
        """y (n, m) and dy/dz (n, m, k) of every row; y is NaN where there is no equilibrium."""
        springs = self._arm.arm.theta.shape[0]
        if self._slopes is None:
            y, slope = self._tape(*inputs, *extra, x, np.zeros((len(inputs[0]), springs)))
            return y[..., 0], slope
        theta, F_theta = self._arm.equilibrium.solve(inputs, x)
        y_theta = self._slopes(*inputs, *extra, x, theta)[0]
        y_theta[~np.isfinite(y_theta).all(axis=(1, 2))] = 0.0
        adjoint = np.linalg.solve(F_theta.transpose(0, 2, 1), y_theta.transpose(0, 2, 1))
        adjoint = adjoint.transpose(0, 2, 1).reshape(len(theta), -1)
        y, slope = self._tape(*inputs, *extra, x, theta, adjoint)
        y[~np.isfinite(theta).all(axis=1)] = np.nan
        return y[..., 0], slope
