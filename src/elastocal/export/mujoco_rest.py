"""Where MuJoCo's arm of an exported MJCF comes to rest: the check that the file says the same.

At rest the generalised force r(x) = passive + actuator − bias of all joints x is zero.  Newton's
method on C r, C the compliances, so that soft and stiff joints are found alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from elastocal.errors import ElastocalError, InputError
from elastocal.manipulator.chain import Array

MAX_STEPS = 30
TOLERANCE = 1e-12  # last step, rad or m
DIFFERENCE_STEP = 1e-6  # rad or m


class MujocoRest:
    """An exported MJCF in MuJoCo.  Raises InputError where MuJoCo is missing or refuses it."""

    def __init__(self, mjcf: str) -> None:
        try:
            import mujoco
        except ImportError:
            raise InputError(
                "the check needs MuJoCo, which is not installed; run: pip install elastocal[mujoco]"
            ) from None
        self._mujoco = mujoco
        try:
            self.model = mujoco.MjModel.from_xml_string(mjcf)
        except ValueError as error:
            raise InputError(f"MuJoCo refuses the exported MJCF: {error}") from None
        self._data = mujoco.MjData(self.model)
        self._drives = [k for k in range(self.model.nu) if self._is_drive(k)]
        self._driven = [
            int(self.model.jnt_dofadr[self.model.actuator_trnid[k, 0]]) for k in self._drives
        ]
        stiffness = np.array(self.model.jnt_stiffness, dtype=float).reshape(self.model.nv, -1)[:, 0]
        stiffness[self._driven] = self.model.actuator_gainprm[self._drives, 0]
        self._compliance = 1.0 / stiffness

    def _is_drive(self, k: int) -> bool:
        return bool(self.model.actuator_trntype[k] == self._mujoco.mjtTrn.mjTRN_JOINT)

    def settle(self, q: Array, force: Array) -> Any:
        """MuJoCo's data (frames, sites) at rest, commanded to q (n,) under `force` (3,) N.

        Raises ElastocalError where no rest is found.
        """
        control = np.zeros(self.model.nu)
        control[self._drives] = q
        for axis, value in zip("xyz", force, strict=True):
            control[self.model.actuator(f"load_{axis}").id] = value
        self._data.ctrl[:] = control
        x = np.zeros(self.model.nv)
        x[self._driven] = q
        for _ in range(MAX_STEPS):
            r = self._residual(x)
            slope = np.column_stack([self._slope(x, j) for j in range(len(x))])
            step = np.linalg.solve(slope, r)
            x = x - step
            if not np.isfinite(x).all():
                break
            if np.max(np.abs(step)) < TOLERANCE:
                self._residual(x)
                return self._data
        raise ElastocalError(f"MuJoCo finds no rest of the exported arm near q = {q.tolist()}")

    def sites(self, q: Array, force: Array, names: Sequence[str]) -> Array:
        """Positions (len(names), 3) in m in the MJCF's world, at rest."""
        data = self.settle(q, force)
        return np.array([data.site(name).xpos.copy() for name in names])

    def _residual(self, x: Array) -> Array:
        data = self._data
        data.qpos[:] = x
        data.qvel[:] = 0.0
        self._mujoco.mj_fwdPosition(self.model, data)
        self._mujoco.mj_fwdVelocity(self.model, data)
        self._mujoco.mj_fwdActuation(self.model, data)
        force = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
        return np.asarray(self._compliance * force)

    def _slope(self, x: Array, j: int) -> Array:
        h = np.zeros(len(x))
        h[j] = DIFFERENCE_STEP
        return (self._residual(x + h) - self._residual(x - h)) / (2 * DIFFERENCE_STEP)
