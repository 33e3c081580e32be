"""The model: nominal chain plus effects, and its regressor B for a whole table at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell, EffectChoice
from elastocal.errors import ElastocalError
from elastocal.manipulator import rigid
from elastocal.manipulator.arm import Arm
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.choice import choose_effects, load_chain
from elastocal.manipulator.equilibrium import Equilibrium
from elastocal.manipulator.inputs import row_inputs
from elastocal.manipulator.observation import Observations, observe
from elastocal.manipulator.parameter import Parameter
from elastocal.manipulator.tape import Tape
from elastocal.measurements import Measurements


@dataclass(frozen=True)
class Regression:
    """B (rows, parameters) = ∂prediction/∂parameters, prediction (rows,) and what was observed.

    Rows are observations × components in the table's order; units are m (and rad) per unit of
    the parameter.
    """

    B: Array
    prediction: Array
    observations: Observations

    @property
    def residual(self) -> Array:
        """Observed minus predicted (rows,)."""
        return self.observations.value - self.prediction


class Model:
    """p_i = h(q_i, f_i, …; X) for a chain with effects; CasADi differentiates it exactly.

    `parameters` are those of all active effects, in order; `nominal` their nominal values.
    """

    def __init__(self, chain: Chain, cell: Cell) -> None:
        self.chain, self.cell = chain, cell
        self.observe = cell.model.observe
        arm = Arm(chain, cell)
        chosen = choose_effects(chain, cell)
        parameters: list[Parameter] = []
        symbols: list[ca.SX] = []
        bound = []
        for effect, place in chosen:
            own = {}
            for spec in effect.parameters(place, chain, cell):
                own[spec.key] = ca.SX.sym(f"{place}.{spec.key}")
                symbols.append(own[spec.key])
                parameters.append(
                    Parameter(f"{place}.{spec.key}", effect.name, place, spec.unit,
                              spec.nominal, spec.typical, spec.lower, spec.upper)
                )  # fmt: skip
            bound.append((effect, place, own))
        for effect, place, own in bound:
            effect.shape(arm, place, own)
        arm.assemble()
        for effect, place, own in bound:
            effect.load(arm, place, own)
        for effect, place, own in bound:
            effect.read(arm, place, own)
        self.parameters = tuple(parameters)
        self._p = ca.vertcat(ca.SX.zeros(0, 1), *symbols)
        self._arm = arm
        self._reading = self._expression()
        self._tapes: dict[tuple[str, tuple[int, ...]], Tape] = {}

    @classmethod
    def from_cell(cls, cell: Cell, marker_names: tuple[str, ...] = ()) -> Model:
        """Load the cell's robot and switch its effects on.

        `marker_names` are the table's markers where the cell lists none.
        """
        if not cell.tool.markers:
            names = marker_names or ("M1",)
            tool = replace(cell.tool, markers={name: np.zeros(3) for name in names})
            cell = replace(cell, tool=tool)
        return cls(load_chain(cell), cell)

    def with_effects(self, effects: tuple[EffectChoice, ...]) -> Model:
        """The same arm with another choice of effects."""
        spec = replace(self.cell.model, effects=effects)
        return Model(self.chain, replace(self.cell, model=spec))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def nominal(self) -> Array:
        return np.array([p.nominal for p in self.parameters])

    def sizes(self, B: Array) -> Array:
        """Typical deviation (parameters,) of each parameter, in its unit.

        Where none is known beforehand, the deviation that moves the readings behind `B` by 1 mm.
        """
        largest = np.abs(B).max(axis=0, initial=0.0)
        moved = np.divide(1e-3, largest, out=np.ones(len(largest)), where=largest > 0)
        given = [p.typical for p in self.parameters]
        return np.array([m if s is None else s for s, m in zip(given, moved, strict=True)])

    # --- expressions -----------------------------------------------------------------------

    def _expression(self) -> ca.SX:
        """The reading of one row (3, 6 or 1 components) as an expression."""
        arm = self._arm
        if self.observe == "distance":
            return arm.reading["distance"]
        if self.observe == "pose":
            measured = rigid.rotation_from_vector(arm.input("rotation", 3))
            relative = measured.T @ arm.reading["rotation"]
            return ca.vertcat(arm.reading["position"], rigid.vector_from_rotation(relative))
        return arm.reading["position"]

    @cached_property
    def _linear(self) -> bool:
        """Deflections by eq. (3)."""
        return bool(self._arm.springs) and self.cell.model.deflection_model == "linear"

    @cached_property
    def _implicit(self) -> bool:
        """Deflections by the equilibrium F(θ) = 0."""
        return bool(self._arm.springs) and not self._linear

    @cached_property
    def _residual(self) -> ca.SX:
        arm = self._arm
        return arm.theta - arm.deflection_laws(arm.generalised_forces())

    def _linearised(self, expression: ca.SX) -> ca.SX:
        """Eq. (3): h(0) + ∂h/∂θ · law(τ(0)), loads and lever arms of the undeflected pose."""
        theta = self._arm.theta
        rest = ca.SX.zeros(theta.shape[0], 1)
        deflection = ca.substitute(theta - self._residual, theta, rest)
        slope = ca.substitute(ca.jacobian(expression, theta), theta, rest)
        return ca.substitute(expression, theta, rest) + slope @ deflection

    @cached_property
    def _equilibrium(self) -> Equilibrium:
        inputs = list(self._arm.inputs.values())
        return Equilibrium(inputs, self._p, self._arm.theta, self._residual)

    def _tape(self, name: str, columns: tuple[int, ...] = ()) -> Tape:
        """Tapes are built on first use: "reading", "slopes", "B" (of `columns`), "flange"."""
        if (name, columns) not in self._tapes:
            self._tapes[name, columns] = self._build_tape(name, list(columns))
        return self._tapes[name, columns]

    def _build_tape(self, name: str, columns: list[int]) -> Tape:
        arm, p, theta = self._arm, self._p, self._arm.theta
        inputs = [*arm.inputs.values(), p, theta]
        if name == "flange":
            T = ca.vec(arm.T_tracker_flange)
            return Tape(inputs, [ca.reshape(self._linearised(T) if self._linear else T, 4, 4)])
        h = self._linearised(self._reading) if self._linear else self._reading
        if name == "reading":
            return Tape(inputs, [h])
        if name == "slopes":
            return Tape(inputs, [ca.jacobian(h, theta), ca.jacobian(self._residual, theta)])
        if not self._implicit:
            return Tape(inputs, [h, ca.jacobian(h, p)[:, columns]])
        # Adjoint of the equilibrium: with λ = F_θ⁻ᵀ h_θᵀ the total derivative of component c is
        # the partial one of h_c − λ_cᵀ F, a few reverse sweeps instead of all of ∂F/∂X.
        adjoint = ca.SX.sym("adjoint", h.shape[0], theta.shape[0])
        lagrangian = h - adjoint @ self._residual
        return Tape([*inputs, ca.vec(adjoint.T)], [h, ca.jacobian(lagrangian, p)[:, columns]])

    # --- evaluation ------------------------------------------------------------------------

    def deflection(self, table: Measurements, x: Array | None = None) -> NDArray:
        """Elastic deflections θ (n_rows, springs) at equilibrium; NaN where none is found."""
        x = self.nominal if x is None else np.asarray(x)
        return self._settle(row_inputs(self._arm, table), x)

    def _settle(self, inputs: list[NDArray], x: NDArray) -> NDArray:
        if not self._implicit:
            return np.zeros((len(inputs[0]), len(self._arm.springs)), dtype=x.dtype)
        return self._equilibrium.solve(inputs, x)

    def _rows(
        self, table: Measurements, x: NDArray, columns: tuple[int, ...]
    ) -> tuple[NDArray, NDArray]:
        """Reading (n_rows, size) and B (n_rows, size, columns) of every table row."""
        inputs = row_inputs(self._arm, table)
        theta = self._settle(inputs, x)
        if not self._implicit:
            h, B = self._tape("B", columns)(*inputs, x, theta)
            return h[..., 0], B
        h_theta, F_theta = self._tape("slopes")(*inputs, x, theta)
        F_theta[~np.isfinite(theta).all(axis=1)] = np.eye(F_theta.shape[1])
        adjoint = np.linalg.solve(F_theta.transpose(0, 2, 1), h_theta.transpose(0, 2, 1))
        adjoint = adjoint.transpose(0, 2, 1).reshape(len(theta), -1)
        h, B = self._tape("B", columns)(*inputs, x, theta, adjoint)
        return h[..., 0], B

    def predict(
        self,
        table: Measurements,
        x: Array | None = None,
        observations: Observations | None = None,
    ) -> NDArray:
        """Predicted observations (rows,) at parameter values x (default nominal).

        `observations` spares pairing the table anew.  Rows without an equilibrium are NaN.
        """
        x = self.nominal if x is None else np.asarray(x)
        inputs = row_inputs(self._arm, table)
        h = self._tape("reading")(*inputs, x, self._settle(inputs, x))[0][..., 0]
        return (observations or observe(table, self.observe)).apply(h).ravel()

    def regressor(
        self,
        table: Measurements,
        x: Array | None = None,
        columns: NDArray | None = None,
        observations: Observations | None = None,
    ) -> Regression:
        """B_i = ∂prediction/∂X stacked over the whole table (eq. 4), and the prediction.

        `columns` selects parameters by index (default all).  Raises InputError where the table
        lacks a column the model needs, ElastocalError where a pose has no static equilibrium.
        """
        x = self.nominal if x is None else np.asarray(x)
        chosen = tuple(range(len(x))) if columns is None else tuple(int(c) for c in columns)
        seen = observations or observe(table, self.observe)
        h, B = self._rows(table, x, chosen)
        bad = np.flatnonzero(~np.isfinite(h).all(axis=1))
        if len(bad):
            raise ElastocalError(
                f"{table.source}, line {table.row[bad[0]]}: no static equilibrium under this load "
                f"({len(bad)} rows); the compliances are too large for the force: check force_*_N "
                "and [model.nominal] joint_compliance, which is in rad/(N m)"
            )
        prediction = seen.apply(h).ravel()
        return Regression(seen.apply(B).reshape(len(prediction), -1), prediction, seen)

    def flange_poses(self, table: Measurements, x: Array | None = None) -> NDArray:
        """T_tracker_flange (n_rows, 4, 4) at parameter values x, deflections included."""
        x = self.nominal if x is None else np.asarray(x)
        inputs = row_inputs(self._arm, table)
        return self._tape("flange")(*inputs, x, self._settle(inputs, x))[0]


def rigid_model(model: Model) -> Model:
    """The nominal arm with no effect and its base at the data's origin, for registration."""
    nominal = replace(model.cell.model.nominal, base_position=None, base_rotation=None)
    spec = replace(
        model.cell.model, effects=(), observe="position", nominal=nominal, link_gravity=False
    )
    return Model(model.chain, replace(model.cell, model=spec))
