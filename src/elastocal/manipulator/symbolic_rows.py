"""B of one whole configuration as a CasADi expression of its joint angles, for optimisation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator import rigid
from elastocal.manipulator.inputs import row_inputs
from elastocal.manipulator.observation import observe
from elastocal.manipulator.symbolic import SymbolicArm
from elastocal.measurements import Measurements

# Fixed-point steps to the equilibrium.  Under 280 kg on a KR 270 they leave 2·10⁻⁴ of a column.
STEPS = 2


@dataclass(frozen=True)
class ConfigurationRows:
    """B (rows, columns) = ∂prediction/∂X of one configuration, all its markers and load states.

    `q` (n,) and `x` (parameters,) are its symbols; rows and their order are those of
    `Model.regressor` on the table of that configuration.  Deflections are explicit functions of
    q and X: eq. (3) for a linear model, `STEPS` fixed-point steps for the equilibrium.
    """

    q: ca.SX
    x: ca.SX
    B: ca.SX

    @cached_property
    def function(self) -> ca.Function:
        """(q, x) → B."""
        return ca.Function("B", [self.q, self.x], [self.B], {"cse": True})

    @cached_property
    def adjoint(self) -> ca.Function:
        """(q, x, W) → ∇_q Σ_ij W_ij B_ij (n,), one reverse sweep, for W (rows, columns)."""
        W = ca.SX.sym("W", *self.B.shape)
        gradient = ca.gradient(ca.dot(W, self.B), self.q)
        return ca.Function("adjoint", [self.q, self.x, W], [gradient], {"cse": True})


def configuration_rows(
    symbolic: SymbolicArm, template: Measurements, columns: NDArray[np.int64], steps: int = STEPS
) -> ConfigurationRows:
    """B of the configuration whose rows `template` lists, as a function of q and X.

    The template gives everything but q: markers, forces, the level of a split joint, time.  Where
    poses are observed, the rotation is taken as measured without error, as in planning.

    Raises InputError where the template lacks a column the model needs.
    """
    arm = symbolic.arm
    seen = observe(template, arm.cell.model.observe)
    row = _row(symbolic, list(columns), steps)
    q = ca.SX.sym("q", arm.chain.n_joints)
    x = ca.SX.sym("x", len(symbolic.parameters))
    given = dict(zip(arm.inputs, row_inputs(arm, template), strict=True))
    rows = []
    for i in range(len(template)):
        own = [q if name == "q" else ca.SX(ca.DM(value[i])) for name, value in given.items()]
        rows.append(row(*own, x))
    combined = [
        sum((float(w) * rows[i] for i, w in zip(line.indices, line.data, strict=True)), ca.SX(0))
        for line in (seen.combine[[k]] for k in range(seen.combine.shape[0]))
    ]
    return ConfigurationRows(q, x, ca.vertcat(*combined))


def _row(symbolic: SymbolicArm, columns: list[int], steps: int) -> ca.Function:
    """(inputs …, X) → B of one table row (size, columns)."""
    arm, p = symbolic.arm, symbolic.p
    B = ca.jacobian(symbolic.explicit(symbolic.reading, steps), p)[:, columns]
    if arm.cell.model.observe == "pose":
        # Substituted after differentiation: the measured rotation is data, not a prediction.
        predicted = symbolic.explicit(arm.reading["rotation"], steps)
        B = ca.substitute(B, arm.inputs["rotation"], rigid.vector_from_rotation(predicted))
    return ca.Function("row", [*arm.inputs.values(), p], [B], {"cse": True})
