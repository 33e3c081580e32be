"""Minima of the error in reaching a target, from many postures at once.

Minimise ½‖r(q)‖² within the joint limits, r the position error of the point in m and, where the
flange's rotation is prescribed, its error in rad times ARM_LENGTH.  Levenberg–Marquardt,

    (JᵀJ + λI) δq = −Jᵀr,   λ = μ · ½‖r‖²

(Levenberg 1944; λ in proportion to ‖r‖² keeps quadratic convergence where J loses rank, Yamashita
and Fukushima 2001), joints at a limit that would leave it held (projected gradient, Bertsekas
1982).  λ makes the steps those of minimum norm, so that arms with more joints than the task has
equations need nothing special.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator import rigid
from elastocal.manipulator.chain import Array, Chain
from elastocal.manipulator.tape import Tape

IntArray = NDArray[np.int64]

TOLERANCE = 1e-6  # m and rad within which a target counts as reached
ARM_LENGTH = 0.5  # m that make an error in rad comparable with one in m
FARTHEST = 1e6  # m; targets beyond are taken as this far, so that no square overflows
REACHED = (TOLERANCE * ARM_LENGTH) ** 2 / 2  # ½‖r‖² of a target within the tolerance
CONVERGED = 1e-22  # ½‖r‖²; a hundredth of a nanometre
MOST_STEPS = 60
STUCK = 1e8  # μ at which no step helps any more: a minimum that does not reach the target
PATIENCE, STALLED = 8, 0.9  # a start is given up where 8 steps leave more than 0.9 of ½‖r‖²
SMALLEST_DAMPING = 1e-10  # of tr(JᵀJ), so that redundant arms leave the matrix invertible
NULL_STEPS = 40
NEAR_ENOUGH = 1e-5  # rad or m; a null-space step that gains less is the last


class BoundedSearch:
    """The solver on rows of (posture, target index), for any r(q) and J(q); `lower` and `upper`
    (n,) are the joint limits in rad or m."""

    def __init__(self, lower: Array, upper: Array) -> None:
        self.lower, self.upper = lower, upper

    def residual(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        """r (R, m) and J (R, m, n) of postures q (R, n) for the targets (R,)."""
        raise NotImplementedError

    def solve(self, q: Array, target: IntArray, steps: int = MOST_STEPS) -> tuple[Array, Array]:
        """Postures (R, n) at minima of ½‖r‖² and those minima (R,), from starts q (R, n)."""
        q = q.copy()
        r, J = self.residual(q, target)
        cost = (r**2).sum(axis=1) / 2
        damping, before = np.ones(len(q)), cost.copy()
        for k in range(steps):
            if k % PATIENCE == PATIENCE - 1:
                damping[cost > STALLED * before] = STUCK
                before = cost.copy()
            rows = np.flatnonzero((cost > CONVERGED) & (damping < STUCK))
            if not len(rows):
                break
            step = self._step(q[rows], r[rows], J[rows], damping[rows] * cost[rows])
            trial = np.clip(q[rows] + step, self.lower, self.upper)
            r_trial, J_trial = self.residual(trial, target[rows])
            value = (r_trial**2).sum(axis=1) / 2
            better = value < cost[rows]
            damping[rows] *= np.where(better, 0.2, 8.0)
            won = rows[better]
            q[won], r[won], J[won] = trial[better], r_trial[better], J_trial[better]
            cost[won] = value[better]
        return q, cost

    def _step(self, q: Array, r: Array, J: Array, damping: Array) -> Array:
        gradient = np.einsum("rmi,rm->ri", J, r)
        J = J * self._free(q, -gradient)[:, None, :]
        gradient = np.einsum("rmi,rm->ri", J, r)
        H = J.transpose(0, 2, 1) @ J
        i = np.arange(q.shape[1])
        trace = H[:, i, i].sum(axis=1)
        least = SMALLEST_DAMPING * np.where(trace > 0, trace, 1.0)
        H[:, i, i] += np.maximum(damping, least)[:, None]
        return -np.linalg.solve(H, gradient[..., None])[..., 0]

    def _free(self, q: Array, direction: Array) -> NDArray[np.bool_]:
        """(R, n) whether a joint may move in that direction: not out of a limit it stands at."""
        held = ((q <= self.lower) & (direction < 0)) | ((q >= self.upper) & (direction > 0))
        return ~held


class Reaching(BoundedSearch):
    """r(q) and J(q) of all targets for the nominal chain."""

    def __init__(
        self,
        chain: Chain,
        position: Array,
        rotation: Array | None,
        point: Array | None,
        T_data_base: Array | None,
        lower: Array,
        upper: Array,
    ) -> None:
        super().__init__(lower, upper)
        self.goal = np.clip(position, -FARTHEST, FARTHEST)
        q = ca.SX.sym("q", chain.n_joints)
        T = rigid.constant(np.eye(4) if T_data_base is None else T_data_base)
        T = T @ rigid.nominal_flange(chain, q)
        value = rigid.point(T, np.zeros(3) if point is None else point)
        self.oriented = rotation is not None
        if rotation is not None:
            # ‖R − R₀‖² = 8 sin²(θ/2) → 2θ²: smooth at every θ, which a rotation vector is not.
            scale = ARM_LENGTH / np.sqrt(2)
            value = ca.vertcat(value, scale * ca.vec(T[:3, :3]))
            turned = np.broadcast_to(rotation, (len(self.goal), 3, 3))
            by_column = turned.transpose(0, 2, 1).reshape(len(self.goal), 9)
            self.goal = np.hstack([self.goal, scale * by_column])
        self._tape = Tape([q], [value, ca.jacobian(value, q)])

    def residual(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        """r (R, m) and J (R, m, n) of postures q (R, n) for the targets (R,)."""
        value, J = self._tape(q)
        return value[..., 0] - self.goal[target], J

    @property
    def equations(self) -> int:
        """Number of independent equations: an arm with more joints has a choice."""
        return 6 if self.oriented else 3

    def errors(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        """Distance in m and angle in rad (R,) from the targets."""
        r = self.residual(q, target)[0]
        if not self.oriented:
            return np.linalg.norm(r, axis=1), np.zeros(len(r))
        sine = np.linalg.norm(r[:, 3:], axis=1) / (2 * ARM_LENGTH)
        return np.linalg.norm(r[:, :3], axis=1), 2 * np.arcsin(np.minimum(sine, 1.0))

    def nearest(self, q: Array, target: IntArray, near: Array) -> Array:
        """Postures (R, n) that still reach the targets, moved towards `near` (n,).

        Steps along (I − J⁺J)(near − q), then back onto the target; a step counts only if the
        distance falls, so that the result is never farther off than q.
        """
        q, rate = q.copy(), np.ones(len(q))
        for _ in range(NULL_STEPS):
            rows = np.flatnonzero(rate > 1e-3)
            if not len(rows):
                break
            wish = near - q[rows]
            J = self.residual(q[rows], target[rows])[1]
            along = _in_null_space(J, wish)
            J = J * self._free(q[rows], along)[:, None, :]
            along = _in_null_space(J, wish * self._free(q[rows], along))
            trial = np.clip(q[rows] + rate[rows, None] * along, self.lower, self.upper)
            trial, cost = self.solve(trial, target[rows], steps=8)
            gain = np.linalg.norm(wish, axis=1) - np.linalg.norm(near - trial, axis=1)
            better = (gain > 0) & (cost <= CONVERGED)
            rate[rows] = np.where(better, np.minimum(2 * rate[rows], 1.0), rate[rows] / 4)
            rate[rows[better & (gain < NEAR_ENOUGH)]] = 0.0
            q[rows[better]] = trial[better]
        return q


def _in_null_space(J: Array, v: Array) -> Array:
    """(I − J⁺J) v for J (R, m, n) and v (R, n)."""
    return np.asarray(v - (np.linalg.pinv(J, rcond=1e-6) @ (J @ v[..., None]))[..., 0])
