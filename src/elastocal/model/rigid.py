"""Rigid motions as CasADi expressions, the only place where kinematics is written down, and their
inverse: joints that bring a point of the flange to its target, from many postures.

Expressions take and return CasADi `SX` (or numbers, which CasADi promotes): homogeneous transforms
(4, 4), rotations (3, 3), vectors (3, 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.model.chain import MIN_JOINTS, Chain, finite_ranges
from elastocal.model.evaluate import BatchFunction
from elastocal.units import Array, IntArray

# Added under square roots so that rotation-vector formulas are smooth at zero;
# far below the rounding of any angle met in practice (1e-15 rad).
TINY = 1e-30


def rotation_from_vector(r: Any) -> ca.SX:
    """exp([r]×) for a rotation vector r (3,) in rad, smooth at r = 0."""
    r = ca.SX(r)
    angle = ca.sqrt(ca.sumsqr(r) + TINY)
    half = ca.sin(angle / 2) / angle
    k = ca.skew(r)
    return ca.SX.eye(3) + ca.sin(angle) / angle * k + 2 * half**2 * (k @ k)


def vector_from_rotation(R: Any) -> ca.SX:
    """Rotation vector of R, smooth at R = I, for angles up to and including π."""
    R = ca.SX(R)
    trace = ca.trace(R)
    # Quaternion (w, x, y, z) times 4 times its largest member (Shepperd 1978): no case divides
    # by a small number.
    skewed = ca.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    best, largest = ca.vertcat(1 + trace, skewed), trace
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        members = [skewed[i], 0, 0, 0]
        members[1 + i] = 1 + 2 * R[i, i] - trace
        members[1 + j] = R[i, j] + R[j, i]
        members[1 + k] = R[i, k] + R[k, i]
        best = ca.if_else(R[i, i] > largest, ca.vertcat(*members), best)
        largest = ca.fmax(largest, R[i, i])
    unit = best / ca.sqrt(ca.sumsqr(best))
    unit = ca.if_else(unit[0] < 0, -unit, unit)
    s = ca.sqrt(ca.sumsqr(unit[1:]) + TINY)
    return 2 * ca.atan2(s, unit[0]) / s * unit[1:]


def transform(rotation: Any = None, translation: Any = None) -> ca.SX:
    T = ca.SX.eye(4)
    if rotation is not None:
        T[:3, :3] = rotation
    if translation is not None:
        T[:3, 3] = translation
    return T


def constant(T: Any) -> ca.SX:
    """A numeric matrix as SX with exact zeros dropped, so that products stay small."""
    return ca.SX(ca.sparsify(ca.DM(np.asarray(T, dtype=float))))


def joint_motion(kind: str, axis: Any, value: Any) -> ca.SX:
    """Motion of a revolute or prismatic joint by `value` (rad or m) along its unit axis."""
    a = np.asarray(axis, dtype=float)
    if kind == "prismatic":
        return transform(translation=ca.SX(ca.DM(a)) * value)
    along, across, about = _turning(*a.tolist())
    return transform(rotation=along + ca.cos(value) * across + ca.sin(value) * about)


@lru_cache
def _turning(*axis: float) -> tuple[ca.SX, ca.SX, ca.SX]:
    """aaᵀ, 1 − aaᵀ and [a]× of a unit axis, of which an arm has few."""
    along = np.outer(axis, axis)
    return constant(along), constant(np.eye(3) - along), constant(ca.skew(ca.DM(axis)))


def moved(kind: str, axis: Any, value: float) -> Array:
    """`joint_motion` of a number (4, 4)."""
    return np.asarray(ca.DM(joint_motion(kind, axis, value)).full())


def point(T: ca.SX, p: Any) -> ca.SX:
    return T[:3, :3] @ ca.SX(p) + T[:3, 3]


def nominal_frames(chain: Chain, q: ca.SX, base: ca.SX) -> list[ca.SX]:
    """(4, 4) of each joint of the nominal chain after its motion, at joint values q (n,), and of
    the flange, where `base` (4, 4) is that of the chain's base."""
    frames = [base]
    for i, joint in enumerate(chain.joints):
        motion = joint_motion(joint.kind, joint.axis, q[i])
        frames.append(frames[-1] @ constant(joint.placement) @ motion)
    return [*frames[1:], frames[-1] @ constant(chain.flange_placement)]


def nominal_flanges(chain: Chain, q: Array) -> Array:
    """T_base_flange (n, 4, 4) of the nominal chain at q (n, joints)."""
    symbol = ca.SX.sym("q", chain.n_joints)
    flange = nominal_frames(chain, symbol, ca.SX.eye(4))[-1]
    return np.asarray(BatchFunction([symbol], [flange])(q)[0])


def drawn_joints(chain: Chain) -> tuple[Array, Array, Array]:
    """Ends (joints,) of the joints' ranges, and 500 poses (500, joints) drawn between them."""
    limits = [np.array([getattr(j, end) for j in chain.joints]) for end in ("lower", "upper")]
    low, high = finite_ranges(chain, *limits)
    return low, high, np.random.default_rng(0).uniform(low, high, (500, chain.n_joints))


def origin_heights(chain: Chain) -> Array:
    """The height (poses, joints) in m of each joint's origin above the base, of drawn poses."""
    symbol, base = ca.SX.sym("q", chain.n_joints), ca.SX.eye(4)
    placed = zip([base, *nominal_frames(chain, symbol, base)], chain.joints, strict=False)
    origins = ca.horzcat(*(point(T, joint.placement[:3, 3]) for T, joint in placed))
    heights = BatchFunction([symbol], [origins[2, :]])(drawn_joints(chain)[2])[0]
    return np.asarray(heights).reshape(-1, chain.n_joints)


def reach_of(chain: Chain) -> float:
    """How far the flange gets from the first axis that turns, where the second is, in m: the
    largest of 500 drawn poses.  What carries an arm, as a rail, stands still: a slide before it, or
    several before as many joints as an arm has; a gantry's slides move."""
    low, high, q = drawn_joints(chain)
    turning = [i for i, kind in enumerate(chain.kinds) if kind == "revolute"]
    first = turning[0] if turning else 0
    if first > 1 and chain.n_joints - first < MIN_JOINTS:
        first = 0
    q[:, :first] = (low + high)[:first] / 2
    symbol, base = ca.SX.sym("q", chain.n_joints), ca.SX.eye(4)
    frames = [base, *nominal_frames(chain, symbol, base)]
    # A slide, where none turns, starts from where it stands at zero.
    joint = chain.joints[first]
    start = point(frames[first], joint.placement[:3, 3])
    if len(turning) > 1 and first == turning[0]:  # files put its frame anywhere along its axis
        axis = frames[first][:3, :3] @ (joint.placement[:3, :3] @ joint.axis)
        second = chain.joints[turning[1]].placement[:3, 3]
        start += axis * ca.dot(axis, point(frames[turning[1]], second) - start)
    reach = ca.norm_2(frames[-1][:3, 3] - start)
    return float(BatchFunction([symbol], [reach])(q)[0].max())


# Of the KR 270 of the demo, in m and N, from which loads are guessed by the fourth power of the
# reach: small arms carry less for their size, and longer ones are no stronger.
REACH, LOAD = 2.9, 2600.0


def suitable_load(reach: float) -> float:
    """A load in N for an arm of this `reach` in m, with one digit, as guesses have."""
    return max(float(f"{LOAD * min(reach / REACH, 1.0) ** 4:.1g}"), 5.0)


# Inverse kinematics: minima of the error in reaching a target, from many postures at once.
#
# Minimise ½‖r(q)‖² within the joint limits, r the position error of the point in m and, where the
# flange's rotation is prescribed, its error in rad times ARM_LENGTH.  Levenberg–Marquardt,
#
#     (JᵀJ + λI) δq = −Jᵀr,   λ = μ · ½‖r‖²
#
# (Levenberg 1944; λ in proportion to ‖r‖² keeps quadratic convergence where J loses rank, Yamashita
# and Fukushima 2001), joints at a limit that would leave it held (projected gradient, Bertsekas
# 1982).  λ makes the steps those of minimum norm, so that arms with more joints than the task has
# equations need nothing special.

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
        self, chain: Chain, position: Array, rotation: Array | None, place: Array | None,
        T_data_base: Array | None, lower: Array, upper: Array,
    ) -> None:  # fmt: skip
        super().__init__(lower, upper)
        self.turning = chain.turning
        self.goal = np.clip(position, -FARTHEST, FARTHEST)
        q = ca.SX.sym("q", chain.n_joints)
        base = constant(np.eye(4) if T_data_base is None else T_data_base)
        T = nominal_frames(chain, q, base)[-1]
        value = point(T, np.zeros(3) if place is None else place)
        self.oriented = rotation is not None
        if rotation is not None:
            # ‖R − R₀‖² = 8 sin²(θ/2) → 2θ²: smooth at every θ, which a rotation vector is not.
            scale = ARM_LENGTH / np.sqrt(2)
            value = ca.vertcat(value, scale * ca.vec(T[:3, :3]))
            turned = np.broadcast_to(rotation, (len(self.goal), 3, 3))
            by_column = turned.transpose(0, 2, 1).reshape(len(self.goal), 9)
            self.goal = np.hstack([self.goal, scale * by_column])
        self._evaluate = BatchFunction([q], [value, ca.jacobian(value, q)])

    def residual(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        value, J = self._evaluate(q)
        return value[..., 0] - self.goal[target], J

    def unwound(self, q: Array, near: Array) -> Array:
        """The same postures with revolute joints turned back by whole turns, as near as allowed."""
        turn = 2 * np.pi
        turns = np.where(self.turning, np.round((near - q) / turn), 0.0)
        # Rounded inwards a little less, so that a joint at its limit stays where it is.
        fewest = np.ceil((self.lower - q) / turn - 1e-12)
        most = np.floor((self.upper - q) / turn + 1e-12)
        return np.clip(q + turn * np.clip(turns, fewest, most), self.lower, self.upper)

    def errors(self, q: Array, target: IntArray) -> tuple[Array, Array]:
        """Distance in m and angle in rad (R,) from the targets."""
        r = self.residual(q, target)[0]
        if not self.oriented:
            return np.linalg.norm(r, axis=1), np.zeros(len(r))
        sine = np.linalg.norm(r[:, 3:], axis=1) / (2 * ARM_LENGTH)
        return np.linalg.norm(r[:, :3], axis=1), 2 * np.arcsin(np.minimum(sine, 1.0))

    def nearest(self, q: Array, target: IntArray, near: Array) -> Array:
        """Postures (R, n) that still reach the targets, moved towards `near` (n,): steps along
        (I − J⁺J)(near − q), then back onto the target; a step counts only if the distance falls, so
        that the result is never farther off than q."""
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


# From many starts over the joint ranges (scrambled Sobol points), with all targets as one batch.

ROUNDS = (1, 1, 2, 4)  # starts per posture told; the later ones for targets missed by the first
PULLED = 4  # of them, how many are moved within their null space
BLOCK = 10_000  # starts at a time, which bounds the memory


@dataclass(frozen=True)
class Postures:
    """For T targets K postures each, reached ones first, the nearest to `near` of all first.  `q`
    (T, K, n) rad or m; `miss` (T, K) m and `turn` (T, K) rad: what is left of the errors in
    position and rotation (zero where none is prescribed)."""

    q: Array
    miss: Array
    turn: Array

    @property
    def reached(self) -> NDArray[np.bool_]:
        return (self.miss <= TOLERANCE) & (self.turn <= TOLERANCE)

    @property
    def out_of_reach(self) -> IntArray:
        """Indices of the targets that no posture reaches; miss[t, 0] says how near it got."""
        return np.flatnonzero(~self.reached.any(axis=1))


def inverse_kinematics(
    chain: Chain, position: Array, limits: tuple[Array, Array], *, rotation: Array | None = None,
    point: Array | None = None, T_data_base: Array | None = None, near: Array | None = None,
    postures: int = 16, seed: int = 0,
) -> Postures:  # fmt: skip
    """Postures of the nominal chain that bring `point` to `position` (T, 3) m in the data frame.

    `limits`: lower and upper (n,) rad or m, infinite where there is none; `rotation` (3, 3) or
    (T, 3, 3) of the flange in the data frame, None for any; `point` (3,) m in the flange frame;
    `near` (n,): the posture to stay near, by default the middle of the ranges; `postures`: K, a
    power of two.  Where joints or the free rotation leave a choice, the first posture is moved to
    the nearest one; the others stand where the solver met them, so that there is a choice.
    """
    from scipy.stats import qmc  # slow to import, seldom asked for

    lower, upper = limits
    task = Reaching(chain, position, rotation, point, T_data_base, lower, upper)
    low, high = finite_ranges(chain, lower, upper, near)
    near = (low + high) / 2 if near is None else np.clip(near, lower, upper)
    sobol = qmc.Sobol(chain.n_joints, scramble=True, seed=seed)
    starts = [low + (high - low) * sobol.random_base2(int(np.log2(postures * n))) for n in ROUNDS]
    starts[0] = np.vstack([near, starts[0]])
    size = max(BLOCK // postures, 1)
    blocks = [
        _postures(task, np.arange(first, min(first + size, len(position))), starts, near)
        for first in range(0, len(position), size)
    ]
    q = np.concatenate(blocks)
    target = np.repeat(np.arange(len(position)), postures)
    miss, turn = task.errors(q.reshape(len(target), -1), target)
    return Postures(q, miss.reshape(-1, postures), turn.reshape(-1, postures))


def _postures(task: Reaching, targets: IntArray, starts: list[Array], near: Array) -> Array:
    T, K, n = len(targets), len(starts[-1]) // ROUNDS[-1], len(near)
    q, cost = np.zeros((T, K, n)), np.full((T, K), np.inf)
    left = np.arange(T)
    for some in starts:
        every, of = np.tile(some, (len(left), 1)), np.repeat(targets[left], len(some))
        found, value = task.solve(every, of)
        found = task.unwound(found, near).reshape(len(left), -1, n)
        found = np.concatenate([q[left], found], axis=1)
        value = np.concatenate([cost[left], value.reshape(len(left), -1)], axis=1)
        order = _best_first(value, found, near)[:, :K]
        q[left] = np.take_along_axis(found, order[:, :, None], axis=1)
        cost[left] = np.take_along_axis(value, order, axis=1)
        left = left[cost[left, 0] > REACHED]
        if not len(left):
            break
    pulled = cost[:, :PULLED] <= REACHED
    target = targets[np.nonzero(pulled)[0]]
    q[:, :PULLED][pulled] = task.nearest(q[:, :PULLED][pulled], target, near)
    return np.take_along_axis(q, _best_first(cost, q, near)[:, :, None], axis=1)


def _best_first(cost: Array, q: Array, near: Array) -> IntArray:
    """Order of postures (T, K): reached before missed, then by distance from `near` or cost."""
    reached = cost <= REACHED
    distance = np.linalg.norm(q - near, axis=2)
    return np.lexsort((np.where(reached, distance, cost), ~reached), axis=1)
