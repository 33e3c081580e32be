"""The symbolic arm: effects applied to the chain, its expressions, and B of a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell.work_cell import Cell
from elastocal.errors import require
from elastocal.measurements import Measurements
from elastocal.model import rigid
from elastocal.model.arm import Arm, Parameter, row_inputs
from elastocal.model.chain import Chain
from elastocal.model.choice import choose_effects, set_constants
from elastocal.model.effects.base import Effect
from elastocal.model.equilibrium import Equilibrium
from elastocal.model.evaluate import BackendReport, BatchFunction
from elastocal.model.observations import observe

# The symbolic arm: effects applied to the chain, its expressions, and functions of tables.


class SymbolicArm:
    """h(inputs, X, θ) and F(inputs, X, θ) = θ − law(τ) of one row, as CasADi expressions.

    `parameters` are those of all active effects, in order; `arm.inputs` what a row must give.
    `extra` effects with their places act besides those that the cell chooses.  `backend` is that
    of its functions.
    """

    def __init__(
        self,
        chain: Chain,
        cell: Cell,
        extra: Sequence[tuple[Effect, str]] = (),
        backend: str | None = None,
    ) -> None:
        arm = Arm(chain, cell)
        chosen = [*choose_effects(chain, cell), *extra]
        parameters: list[Parameter] = []
        symbols: list[ca.SX] = []
        bound = []
        for effect, place in chosen:
            own = set_constants(effect, place, chain, cell)
            for spec in effect.parameters(place, chain, cell):
                own[spec.key] = ca.SX.sym(f"{place}.{spec.key}")
                symbols.append(own[spec.key])
                parameters.append(
                    Parameter(f"{place}.{spec.key}", effect.name, place, spec.unit,
                              spec.nominal, spec.typical, spec.lower, spec.upper)
                )  # fmt: skip
            bound.append((effect, place, own))
        _check_names(parameters, cell)
        for effect, place, own in bound:
            effect.shape(arm, place, own)
        arm.assemble()
        for effect, place, own in bound:
            effect.load(arm, place, own)
        for effect, place, own in bound:
            effect.read(arm, place, own)
        self.arm = arm
        self.backend = backend
        self.parameters = tuple(parameters)
        self.p = ca.vertcat(ca.SX.zeros(0, 1), *symbols)
        self._reading = self._expression(cell.model.observe)
        self._linear_model = cell.model.deflection_model == "linear"
        self._functions: dict[tuple[str, tuple[int, ...]], BatchFunction] = {}

    def _expression(self, observe: str) -> ca.SX:
        """The reading of one row (3, 6 or 1 components) as an expression."""
        arm = self.arm
        if observe == "distance":
            return arm.reading["distance"]
        if observe == "pose":
            measured = rigid.rotation_from_vector(arm.input("rotation", 3))
            relative = measured.T @ arm.reading["rotation"]
            return ca.vertcat(arm.reading["position"], rigid.vector_from_rotation(relative))
        return arm.reading["position"]

    @cached_property
    def _linear(self) -> bool:
        """Deflections by eq. (3)."""
        return bool(self.arm.springs) and self._linear_model

    @cached_property
    def implicit(self) -> bool:
        """Deflections by the equilibrium F(θ) = 0."""
        return bool(self.arm.springs) and not self._linear

    @cached_property
    def residual(self) -> ca.SX:
        """F = θ − law(τ(θ)) (springs,), zero at the equilibrium."""
        arm = self.arm
        return arm.theta - arm.deflection_laws(arm.generalised_forces())

    def _linearised(self, expression: ca.SX) -> ca.SX:
        """Eq. (3): h(0) + ∂h/∂θ · law(τ(0)), loads and lever arms of the undeflected pose."""
        theta = self.arm.theta
        rest = ca.SX.zeros(theta.shape[0], 1)
        deflection = ca.substitute(theta - self.residual, theta, rest)
        slope = ca.substitute(ca.jacobian(expression, theta), theta, rest)
        return ca.substitute(expression, theta, rest) + slope @ deflection

    def explicit(self, expression: ca.SX, steps: int) -> ca.SX:
        """`expression` of inputs, X and θ as one of inputs and X alone.

        Deflections by eq. (3) where the model is linear, else after `steps` fixed-point steps
        θ ← law(τ(θ)) from rest, each of which divides the error by the ratio of a joint's
        stiffness to the change of the load's torque with its angle (a hundred and more).
        """
        if self._linear:
            return ca.reshape(self._linearised(ca.vec(expression)), *expression.shape)
        theta = self.arm.theta
        if not self.implicit:
            return expression
        law = theta - self.residual
        settled = ca.SX.zeros(theta.shape[0], 1)
        for _ in range(steps):
            settled = ca.substitute(law, theta, settled)
        return ca.substitute(expression, theta, settled)

    @property
    def reading(self) -> ca.SX:
        """The reading h of one row (3, 6 or 1 components) in inputs, X and θ."""
        return self._reading

    @cached_property
    def equilibrium(self) -> Equilibrium:
        inputs = list(self.arm.inputs.values())
        return Equilibrium(inputs, self.p, self.arm.theta, self.residual, self.backend)

    @property
    def backend_reports(self) -> dict[str, BackendReport]:
        """What evaluated each function last, by its name and number of columns."""
        reports = {
            f"{name}[{len(columns)}]" if columns else name: function.report
            for (name, columns), function in self._functions.items()
        }
        if "equilibrium" in self.__dict__:  # built: a cached property
            reports["equilibrium"] = self.equilibrium.report
        return reports

    def function(self, name: str, columns: tuple[int, ...] = ()) -> BatchFunction:
        """Built on first use: "reading", "slopes", "B" (of `columns`), "frames"."""
        if (name, columns) not in self._functions:
            self._functions[name, columns] = self._build(name, list(columns))
        return self._functions[name, columns]

    def _build(self, name: str, columns: list[int]) -> BatchFunction:
        arm, p, theta = self.arm, self.p, self.arm.theta
        inputs = [*arm.inputs.values(), p, theta]
        if name == "frames":
            frames = [arm.T_tracker_flange, arm.reading["position"], arm.reading["rotation"]]
            if self._linear:
                frames = [ca.reshape(self._linearised(ca.vec(f)), *f.shape) for f in frames]
            return BatchFunction(inputs, frames, self.backend)
        h = self._settled_reading
        if name == "reading":
            return BatchFunction(inputs, [h], self.backend)
        if name == "slopes":
            return BatchFunction(inputs, [ca.jacobian(h, theta)], self.backend)
        wider = self._functions.get(("B", tuple(range(len(self.parameters)))))
        adjoint, B = self._derivative
        more = [ca.vec(adjoint.T)] if self.implicit else []
        return BatchFunction([*inputs, *more], [h, B[:, columns]], self.backend, wider, columns)

    @cached_property
    def _settled_reading(self) -> ca.SX:
        """The reading, by eq. (3) where the model is linear, else in X and θ."""
        return self._linearised(self._reading) if self._linear else self._reading

    @cached_property
    def _derivative(self) -> tuple[ca.SX, ca.SX]:
        """Symbols λ (components, springs), none without an equilibrium, and B of every column.

        Adjoint of the equilibrium: with λ = F_θ⁻ᵀ h_θᵀ the total derivative of component c is the
        partial one of h_c − λ_cᵀ F, a few reverse sweeps instead of all of ∂F/∂X.
        """
        h = self._settled_reading
        adjoint = ca.SX.sym("adjoint", h.shape[0], self.arm.theta.shape[0] if self.implicit else 0)
        lagrangian = h - adjoint @ self.residual if self.implicit else h
        return adjoint, ca.jacobian(lagrangian, self.p)


def _check_names(parameters: Sequence[Parameter], cell: Cell) -> None:
    """InputError where two effects call a parameter at a place alike."""
    known: dict[str, Parameter] = {}
    for p in parameters:
        other = known.setdefault(p.name, p)
        require(
            other is p,
            f"{cell.path or cell.name}: the effects {other.effect} and {p.effect} both have a "
            f"parameter '{p.name}'; give the one that you registered a key of its own",
        )


# B of one whole configuration as a CasADi expression of its joint angles, for optimisation.

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
    observed = observe(template, arm.cell.model.observe)
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
        for line in (observed.combine[[k]] for k in range(observed.combine.shape[0]))
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
