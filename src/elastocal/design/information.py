"""From the symbolic model to information: whitened B of any pose, under scenarios of the arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.design.readings import (
    LoadStates,
    marker_sigmas,
    pose_covariance,
    rows_of,
)
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import Observations, observe
from elastocal.measurements import Measurements
from elastocal.simulation.simulate import simulate

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHUNK_NUMBERS = 4_000_000  # numbers of a chunk's regressor held at once


@dataclass(frozen=True)
class PoseInformation:
    """B of poses, whitened by their noise and scaled by the sizes of the parameters.

    `scenarios` (S, parameters): parameter values at which the arm is linearised; `columns` (p,)
    the parameters to be estimated, `sizes` (p,) what one unit of a scaled parameter is.
    """

    model: Model
    states: LoadStates
    scenarios: Array
    columns: IntArray
    sizes: Array

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.model.names[c] for c in self.columns)

    def blocks(self, q: Array, load: IntArray) -> Array:
        """Whitened, scaled B (S, N, r, p) of poses q (N, n) in load states `load` (N,).

        r counts the components of all markers and load states of a pose; W_i B_i with
        W_iᵀ W_i = Σ_i⁻¹ gives a pose's information B_iᵀ Σ_i⁻¹ B_i.  Raises ElastocalError where
        a pose has no static equilibrium.
        """
        per_pose = len(self.model.cell.tool.markers) * len(self.states.forces)
        size = max(CHUNK_NUMBERS // (per_pose * 6 * max(len(self.columns), 20)), 1)
        found = [
            np.stack(
                [self._whitened(q[a : a + size], load[a : a + size], x) for x in self.scenarios]
            )
            for a in range(0, len(q), size)
        ]
        return np.concatenate(found, axis=1)

    def rows(self, q: Array, load: IntArray, x: Array) -> Measurements:
        """The table of these poses as the arm x would be read, without noise."""
        markers = tuple(self.model.cell.tool.markers)
        table = simulate(self.model, rows_of(q, load, self.states, markers), x, 0, noise=False)
        return marker_sigmas(self.model.cell, table)

    def _whitened(self, q: Array, load: IntArray, x: Array) -> Array:
        seen, factor = self._noise(q, load, x)
        at = self.model.regressor(seen.table, x, self.columns, seen)
        B = at.B.reshape(len(q), -1, len(self.columns)) * self.sizes
        return np.asarray(np.linalg.solve(factor, B), dtype=np.float64)

    def whitener(self, q: Array, load: int) -> Array:
        """W (S, r, r) of one pose q (n,): W B is its block before scaling."""
        one = q[None], np.array([load])
        return np.stack([np.linalg.inv(self._noise(*one, x)[1][0]) for x in self.scenarios])

    def _noise(self, q: Array, load: IntArray, x: Array) -> tuple[Observations, Array]:
        """What is read at the poses, and the Cholesky factors (N, r, r) of its covariance."""
        seen = observe(self.rows(q, load, x), self.model.observe)
        covariance = pose_covariance(self.model, seen, len(q), self.states)
        return seen, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
