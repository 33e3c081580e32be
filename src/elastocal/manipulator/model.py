"""The model: nominal chain plus effects, and its regressor B for a whole table at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell, EffectChoice
from elastocal.errors import ElastocalError
from elastocal.manipulator.backend import summary
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.choice import load_chain
from elastocal.manipulator.effects.base import Effect
from elastocal.manipulator.inputs import row_inputs
from elastocal.manipulator.observation import Observations, observe
from elastocal.manipulator.symbolic import SymbolicArm
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
    `extra` effects with their places act besides those that the cell chooses.  `backend` is
    "auto", "numpy" or "compiled"; None follows `set_default_backend` and ELASTOCAL_BACKEND.
    """

    def __init__(
        self,
        chain: Chain,
        cell: Cell,
        extra: Sequence[tuple[Effect, str]] = (),
        backend: str | None = None,
    ) -> None:
        self.chain, self.cell = chain, cell
        self.observe = cell.model.observe
        self._symbolic = SymbolicArm(chain, cell, extra, backend)
        self.parameters = self._symbolic.parameters

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
        return Model(self.chain, replace(self.cell, model=spec), backend=self._symbolic.backend)

    @cached_property
    def rigid(self) -> Model:
        """The nominal arm with no effect and its base at the data's origin, for registration."""
        spec = self.cell.model
        nominal = replace(spec.nominal, base_position=None, base_rotation=None)
        spec = replace(spec, effects=(), observe="position", nominal=nominal, link_gravity=False)
        return Model(self.chain, replace(self.cell, model=spec), backend=self._symbolic.backend)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    def meant_by(self, name: str) -> list[int]:
        """Indices of the parameters that a parameter's, place's or effect's name stands for."""
        return [i for i, p in enumerate(self.parameters) if name in (p.name, p.where, p.effect)]

    @property
    def all_names(self) -> list[str]:
        """Every name that `meant_by` understands."""
        return sorted({v for p in self.parameters for v in (p.name, p.where, p.effect)})

    def backend_report(self) -> str:
        """What evaluates this model, for reports: engine, compiler, cached or not, threads."""
        return summary(self._symbolic.backend_reports.values())

    @property
    def nominal(self) -> Array:
        return np.array([p.nominal for p in self.parameters])

    def sizes(self, B: Array) -> Array:
        """Typical deviation (parameters,) of each parameter, in its unit.

        Where none is known beforehand, one size for all parameters of that effect: ten times the
        deviation that moves the readings behind `B` by 1 mm at the place they show most (a
        wrist is about ten times as soft as a shoulder).
        """
        largest = np.abs(B).max(axis=0, initial=0.0)
        moved = np.divide(1e-3, largest, out=np.full(len(largest), np.inf), where=largest > 0)
        common: dict[tuple[str, str], float] = {}
        for p, m in zip(self.parameters, moved, strict=True):
            common[p.effect, p.unit] = min(common.get((p.effect, p.unit), np.inf), 10 * m)
        common = {key: size if np.isfinite(size) else 1.0 for key, size in common.items()}
        return np.array(
            [common[p.effect, p.unit] if p.typical is None else p.typical for p in self.parameters]
        )

    def deflection(self, table: Measurements, x: Array | None = None) -> NDArray:
        """Elastic deflections θ (n_rows, springs) at equilibrium; NaN where none is found."""
        x = self.nominal if x is None else np.asarray(x)
        return self._settle(row_inputs(self._symbolic.arm, table), x)

    def _settle(self, inputs: list[NDArray], x: NDArray) -> NDArray:
        if not self._symbolic.implicit:
            return np.zeros((len(inputs[0]), len(self._symbolic.arm.springs)), dtype=x.dtype)
        return self._symbolic.equilibrium.solve(inputs, x)[0]

    def _rows(
        self, table: Measurements, x: NDArray, columns: tuple[int, ...]
    ) -> tuple[NDArray, NDArray]:
        """Reading (n_rows, size) and B (n_rows, size, columns) of every table row."""
        inputs = row_inputs(self._symbolic.arm, table)
        if not self._symbolic.implicit:
            h, B = self._symbolic.tape("B", columns)(*inputs, x, self._settle(inputs, x))
            return h[..., 0], B
        theta, F_theta = self._symbolic.equilibrium.solve(inputs, x)
        h_theta = self._symbolic.tape("slopes")(*inputs, x, theta)[0]
        adjoint = np.linalg.solve(F_theta.transpose(0, 2, 1), h_theta.transpose(0, 2, 1))
        adjoint = adjoint.transpose(0, 2, 1).reshape(len(theta), -1)
        h, B = self._symbolic.tape("B", columns)(*inputs, x, theta, adjoint)
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
        inputs = row_inputs(self._symbolic.arm, table)
        h = self._symbolic.tape("reading")(*inputs, x, self._settle(inputs, x))[0][..., 0]
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
        return self._frames(table, x)[0]

    def target_poses(self, table: Measurements, x: Array | None = None) -> tuple[NDArray, NDArray]:
        """Rotation (n_rows, 3, 3) and position (n_rows, 3) of each row's marker as the tracker
        would report them, whatever the model observes.  Rows without an equilibrium are NaN."""
        _, position, rotation = self._frames(table, x)
        return rotation, position[..., 0]

    def _frames(self, table: Measurements, x: Array | None) -> list[NDArray]:
        x = self.nominal if x is None else np.asarray(x)
        inputs = row_inputs(self._symbolic.arm, table)
        return self._symbolic.tape("frames")(*inputs, x, self._settle(inputs, x))
