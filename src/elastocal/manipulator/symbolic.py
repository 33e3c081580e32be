"""The symbolic arm: effects applied to the chain, its expressions, and their tapes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import casadi as ca

from elastocal.cell import Cell
from elastocal.errors import require
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.backend import BackendReport
from elastocal.manipulator.chain import Chain
from elastocal.manipulator.choice import choose_effects, set_constants
from elastocal.manipulator.effects.base import Effect
from elastocal.manipulator.equilibrium import Equilibrium
from elastocal.manipulator.parameter import Parameter
from elastocal.manipulator.tape import Tape


class SymbolicArm:
    """h(inputs, X, θ) and F(inputs, X, θ) = θ − law(τ) of one row, as CasADi expressions.

    `parameters` are those of all active effects, in order; `arm.inputs` what a row must give.
    `extra` effects with their places act besides those that the cell chooses.  `backend` is that
    of its tapes.
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
        self._tapes: dict[tuple[str, tuple[int, ...]], Tape] = {}

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
        """What evaluated each tape last, by the tape's name and number of columns."""
        reports = {
            f"{name}[{len(columns)}]" if columns else name: tape.report
            for (name, columns), tape in self._tapes.items()
        }
        if "equilibrium" in self.__dict__:  # built: a cached property
            reports["equilibrium"] = self.equilibrium.report
        return reports

    def tape(self, name: str, columns: tuple[int, ...] = ()) -> Tape:
        """Tapes are built on first use: "reading", "slopes", "B" (of `columns`), "frames"."""
        if (name, columns) not in self._tapes:
            self._tapes[name, columns] = self._build_tape(name, list(columns))
        return self._tapes[name, columns]

    def _build_tape(self, name: str, columns: list[int]) -> Tape:
        arm, p, theta = self.arm, self.p, self.arm.theta
        inputs = [*arm.inputs.values(), p, theta]
        if name == "frames":
            frames = [arm.T_tracker_flange, arm.reading["position"], arm.reading["rotation"]]
            if self._linear:
                frames = [ca.reshape(self._linearised(ca.vec(f)), *f.shape) for f in frames]
            return Tape(inputs, frames, self.backend)
        h = self._settled_reading
        if name == "reading":
            return Tape(inputs, [h], self.backend)
        if name == "slopes":
            return Tape(inputs, [ca.jacobian(h, theta)], self.backend)
        whole = self._tapes.get(("B", tuple(range(len(self.parameters)))))
        adjoint, B = self._derivative
        more = [ca.vec(adjoint.T)] if self.implicit else []
        return Tape([*inputs, *more], [h, B[:, columns]], self.backend, whole, columns)

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
