"""The visits of the arm behind each reading, and a course in time as a sum of waves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import special

from elastocal.measurements import Measurements, visits
from elastocal.model.effects.base import JointMotion
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.units import Array, BoolArray, IntArray

# The visits behind each reading: what a joint that settles elsewhere there, or a base that has
# drifted by then, would do to it.

# Correlation times of a drift that are tried, as shares of the campaign; whether there is any is
# tested with the first.
LASTING = (0.2, 0.1, 0.4, 0.05, 0.8)
LONGEST = max(LASTING)
FEWEST_BLOCKS, MOST_BLOCKS = 5, 10  # of time


@dataclass(frozen=True)
class VisitRecord:
    """The rows of the table behind each of N readings: m of them, one but for deflections.

    `visit` (N, m) numbers the arm's visits to a pose (−1: no such row), `motion` (N, m, size,
    joints) is ∂(reading)/∂q there, `share` (N, m) the row's factor in the reading, `place` (N, m)
    its time as a share of the campaign's `span` in s; where the table has no times (`timed`), the
    order of the rows stands for them.  `turning` (joints,) says which joints are revolute.  No
    drift of the noise is looked for (`drifts`) where the model itself has what changes with time,
    and, unless the cell states one, where readings follow each other from pose to neighbouring
    pose: they err alike because of what the model lacks, and a drift in its place would leave the
    base as uncertain as it is large.  `lasting`: the correlation times of a drift that may be, as
    shares of the span; the cell's own alone, where it states a drift and the table has times.
    """

    visit: IntArray
    motion: Array
    share: Array
    place: Array
    turning: BoolArray
    timed: bool
    span: float
    drifts: bool = True
    lasting: tuple[float, ...] = LASTING

    def take(self, chosen: BoolArray | IntArray) -> VisitRecord:
        """That of the `chosen` readings."""
        names = ("visit", "motion", "share", "place")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    @cached_property
    def n_visits(self) -> int:
        return len(np.unique(self.visit[self.visit >= 0]))

    @property
    def per_visit(self) -> float:
        """Readings to a visit, at the median.  A single one tells the joints' scatter from its own
        noise by nothing but how both change from pose to pose, as the model's own errors do."""
        return float(np.median(np.unique(self.visit[self.visit >= 0], return_counts=True)[1]))

    def waves(self, lasting: float) -> Array:
        """Loadings (N, k) on independent deviations of variance 1, which add up to a random course
        of correlation exp(−|t − t′|/`lasting`), times as shares of the span."""
        return np.asarray(np.einsum("nm,nmk->nk", self.share, self._each(lasting)))

    def faster(self, lasting: float) -> Array:
        """Loadings (N, m) on what the waves leave of the course's variance at each row's time."""
        left = 1 - (self._each(lasting) ** 2).sum(axis=2)
        return self.share * np.sqrt(np.maximum(left, 0.0))

    def blocks(self, configuration: IntArray, lasting: float) -> IntArray:
        """Blocks (N,) of whole configurations that follow each other in time, as long as what
        drifts is `lasting`, if that makes neither too few nor too many."""
        number = int(np.clip(round(1 / lasting), FEWEST_BLOCKS, MOST_BLOCKS))
        _, code = np.unique(configuration, return_inverse=True)
        when = np.bincount(code, self.place[:, 0]) / np.bincount(code)
        rank = np.argsort(np.argsort(when, kind="stable"))
        return np.asarray((rank * min(number, len(when)) // len(when))[code], dtype=np.int64)

    def _each(self, lasting: float) -> Array:
        return course_waves(self.place.ravel(), lasting).reshape(*self.place.shape, -1)


def visit_record(model: Model, observed: Observations, x: Array) -> VisitRecord | None:
    """The visits of the observations of a fit at x (parameters,); None for an arm that no joint
    moves."""
    table, n = observed.table, len(observed.lead)
    if not model.chain.n_joints:
        return None
    combine = observed.combine
    count = np.diff(combine.indptr)
    m = int(count.max(initial=1))
    place = np.arange(m) < count[:, None]
    row, share = np.zeros((n, m), dtype=np.int64), np.zeros((n, m))
    row[place], share[place] = combine.indices, combine.data
    moved = _joint_motion(model, table, x)[row] * share[:, :, None, None]
    when, span, timed = _when(table)
    turning = np.array([kind != "prismatic" for kind in model.chain.kinds])
    visit = np.where(place, visits(table)[row], -1)
    noise = model.cell.noise
    stated = noise.drift > 0
    drifts = stated or in_random_order(table.take(np.argsort(when, kind="stable")))
    lasting = (noise.lasting / span,) if stated and timed else LASTING
    return VisitRecord(visit, moved, share, when[row], turning, timed, span, drifts, lasting)


SYSTEMATIC = 0.01


def in_random_order(table: Measurements) -> bool:
    """Whether poses that follow each other in the table are no nearer than chance allows at 1 %.

    Σ |q_i+1 − q_i|² / Σ |q_i − q̄|² has the mean 2 and the variance 4 (n − 2)/(n² − 1) for each
    joint (von Neumann 1941), poses that only the load or a repeat tells apart counted once.
    """
    moves = np.abs(np.diff(table.q, axis=0)).max(axis=1, initial=0.0) > 0
    q = table.q[np.concatenate([[True], moves])] if len(table) else table.q
    n, spread = len(q), q.std(axis=0)
    q = q[:, spread > 0] / spread[spread > 0]
    if n < 3 or not q.shape[1]:
        return False
    ratio = (np.diff(q, axis=0) ** 2).sum(axis=0) / n
    deviation = np.sqrt(4 * (n - 2) / (n**2 - 1) / q.shape[1])
    return bool(ratio.mean() - 2 > special.ndtri(SYSTEMATIC) * deviation)


def _joint_motion(model: Model, table: Measurements, x: Array) -> Array:
    """∂(reading)/∂q (rows, size, joints) of the nominal arm, base and markers where x has them."""
    moving = model.moving
    at = dict(zip(model.names, x.tolist(), strict=True))
    here = np.array([at.get(p.name, p.nominal) for p in moving.parameters])
    joints = np.flatnonzero([p.effect == JointMotion.name for p in moving.parameters])
    return moving.regressor(table, here, joints).B.reshape(len(table), -1, len(joints))


def _when(table: Measurements) -> tuple[Array, float, bool]:
    """Time (rows,) of each row as a share of the campaign, its length, and whether it was recorded:
    without times the visits, in the order of the rows, take equally long."""
    if table.time is not None and np.isfinite(table.time).all() and np.ptp(table.time) > 0:
        span = float(np.ptp(table.time))
        return (table.time - table.time.min()) / span, span, True
    _, first, visit = np.unique(visits(table), return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))[visit.ravel()].astype(float)
    span = max(float(order.max(initial=0.0)), 1.0)
    return order / span, span, False


# A course in time as a sum of waves.
#
# The eigenfunctions φ of the correlation exp(−|t − t′|/lasting) on [0, 1], of eigenvalues λ
# (Karhunen and Loève; Ghanem and Spanos 1991, section 2.3), on the middles of GRID intervals and
# from there by √λ φ(t) = ∫ exp(−|t − s|/lasting) φ(s) ds/√λ (Nyström).  Those left out are what
# changes faster than the k-th wave: noise of single visits, of the same variance
# (`VisitRecord.faster`).  Without it a long course and a deviation of each configuration look more
# likely than the short course that there is.

GRID, MOST_WAVES = 400, 20
# Of the variance.  A course that lasts longer than the campaign is nearly a constant, which the
# base takes over, and varies about it by little more than the inverse of how much longer.
LEFT = 0.03


def course_waves(t: Array, lasting: float) -> Array:
    """Waves (n, k) at t (n,) in 0 … 1, their products summing to nearly exp(−|t − t′|/lasting)."""
    middles, loading = _eigenfunctions(lasting)
    return np.asarray(np.exp(-np.abs(t[:, None] - middles) / lasting) @ loading)


@lru_cache(maxsize=16)
def _eigenfunctions(lasting: float) -> tuple[Array, Array]:
    middles = (np.arange(GRID) + 0.5) / GRID
    value, vector = np.linalg.eigh(np.exp(-np.abs(middles[:, None] - middles) / lasting) / GRID)
    value, vector = value[::-1], vector[:, ::-1]
    left = 1 - np.cumsum(value)
    k = int(np.argmax(left < LEFT * min(1 / lasting, 1.0))) + 1
    own = slice(0, min(k, MOST_WAVES))
    return middles, vector[:, own] / np.sqrt(GRID * value[own])
