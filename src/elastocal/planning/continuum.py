"""How much better a plan could be with poses that are not in the pool: an estimate.

On the continuum of feasible poses the tangent at (Φ, G) bounds every plan's value by

    Φ(plan) ≥ Φ² / (⟨G, prior⟩ + Σ_l n_l max_{q∈l} d(q)),   d(q) = Σ_s tr(B_s(q) G_s B_s(q)ᵀ)

as in `selection`, without its box, since one continuous pose may repeat.  d has many local
maxima and rules cut the space up, so the global one is sought, not proved: new Sobol points,
then local ascents from the best of them and of the pool.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import require
from elastocal.planning.candidates import CHUNK, sobol
from elastocal.planning.criterion import Gradient
from elastocal.planning.polish import Searches, Sensitivity, distinct, search_all, trials
from elastocal.planning.selection import DesignProblem
from elastocal.units import Array, IntArray, Progress

LOT = 256  # of the best new points that are checked for feasibility at a time
LOTS = 16  # at most
LEAST_GAIN = 1e-6  # relative excess over the pool's largest d that counts as one


@dataclass(frozen=True)
class Continuum:
    """`largest` (L,): the largest d found per group, and `bound`, the bound on Φ it amounts to.

    An estimate from above: a larger d may have been missed, and then no plan is held to `bound`.
    `q` (k, n), `load` (k,), `group` (k,): feasible poses found whose d exceeds all of the pool's;
    adding them to the pool and choosing anew closes the gap.  Effort: `searched` new points
    evaluated, `checked` of them for feasibility, `ascents` local searches.
    """

    largest: Array
    bound: float
    q: Array
    load: IntArray
    group: IntArray
    searched: int
    checked: int
    ascents: int


def estimate(
    problem: DesignProblem,
    tangent: Gradient,
    searches: Searches,
    q: Array,
    load: IntArray,
    *,
    points: int = 8 * CHUNK,
    starts: int = 6,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = lambda message: None,
) -> Continuum:
    """The largest d on the continuum per group, for the tangent (Φ, G) of the pool's optimum.

    `q` (N, n), `load` (N,): the problem's candidates.  Per group and load state `points` new
    poses (rounded up to chunks) are evaluated at once, feasibility only of the best; IPOPT climbs
    from the `starts` best poses, new or of the pool, that lie apart.  Every maximum is
    evaluated exactly and passed by the cell's own rules.  The result depends on `seed`, not on
    `jobs`, the number of processes.

    Raises InputError where points < 1 or starts < 1.
    """
    require(points >= 1 and starts >= 1, "the search of the continuum needs points and starts")
    pool_d = problem.sensitivity(tangent.G)
    search = _Search(searches, tangent.G, points, starts, jobs)
    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    largest = np.zeros(len(problem.shares))
    found: list[_Poses] = []
    for group in np.flatnonzero(problem.shares).tolist():
        progress(f"searching the continuum, level {group + 1} of {len(largest)}")
        own = problem.group == group
        largest[group] = pool_d[own].max()
        for state in np.unique(load[own]).tolist():
            here = own & (load == state)
            pool = _Poses(q[here], pool_d[here], state, group)
            found.append(search.run(pool, streams[group]).above(largest[group]))
        best = [poses.d.max(initial=0.0) for poses in found if poses.group == group]
        largest[group] = max(largest[group], *best)
    reach = float(np.sum(tangent.G * problem.prior)) + float(problem.shares @ largest)
    return Continuum(
        largest,
        tangent.value**2 / reach,
        np.concatenate([poses.q for poses in found]),
        np.concatenate([np.full(len(poses.q), poses.load) for poses in found]),
        np.concatenate([np.full(len(poses.q), poses.group) for poses in found]),
        search.searched,
        search.checked,
        search.ascents,
    )


@dataclass(frozen=True)
class _Poses:
    """Poses of one group and load state with their d."""

    q: Array
    d: Array
    load: int
    group: int

    def with_these(self, q: Array, d: Array) -> _Poses:
        return replace(self, q=np.vstack([self.q, q]), d=np.append(self.d, d))

    def take(self, index: NDArray) -> _Poses:
        return replace(self, q=self.q[index], d=self.d[index])

    def ranked(self) -> _Poses:
        """Best first."""
        return self.take(np.argsort(-self.d, kind="stable"))

    def above(self, value: float) -> _Poses:
        """The poses with d > value, best first, of those that lie close together only one."""
        better = self.take(self.d > value * (1 + LEAST_GAIN)).ranked()
        return better.take(distinct(better.q, len(better.q)))


@dataclass
class _Search:
    """New points and ascents for one G; counts its effort."""

    searches: Searches
    G: Array
    points: int
    starts: int
    jobs: int
    searched: int = 0
    checked: int = 0
    ascents: int = 0

    def run(self, pool: _Poses, stream: np.random.SeedSequence) -> _Poses:
        """Feasible poses found, new ones and where ascents ended."""
        drawn = self._drawn(pool, stream)
        first = pool.with_these(drawn.q, drawn.d).ranked()
        first = first.take(distinct(first.q, self.starts))
        tasks = [
            (self.searches.at(q, pool.load, pool.group), Sensitivity(self.G, d), q[None])
            for q, d in zip(first.q, first.d, strict=True)
        ]
        self.ascents += len(tasks)
        q = trials(first.q, search_all(tasks, self.jobs))
        d = self._sensitivity(q, pool.load)
        # An ascent counts if it rose; what it started from is feasible already.
        rose = d > np.tile(first.d, len(q) // len(first.d))
        q, d = q[rose], d[rose]
        ok = self.searches.feasible(q, pool.load)
        return drawn.with_these(q[ok], d[ok])

    def _drawn(self, pool: _Poses, stream: np.random.SeedSequence) -> _Poses:
        """The best feasible of `points` Sobol points."""
        chunks = islice(sobol(self.searches.space, pool.group, stream), -(-self.points // CHUNK))
        q = np.concatenate(list(chunks))
        ranked = replace(pool, q=q, d=self._sensitivity(q, pool.load)).ranked()
        self.searched += len(q)
        found = ranked.take(np.arange(0))
        for lot in range(LOTS):
            part = ranked.take(np.arange(lot * LOT, min((lot + 1) * LOT, len(q))))
            ok = self.searches.feasible(part.q, pool.load)
            self.checked += len(part.q)
            found = found.with_these(part.q[ok], part.d[ok])
            if len(distinct(found.q, self.starts)) == self.starts:
                break
        return found

    def _sensitivity(self, q: Array, load: int) -> Array:
        """d (N,) of poses q (N, n), a chunk's blocks at a time."""
        d = np.empty(len(q))
        for start in range(0, len(q), CHUNK):
            B = self.searches.blocks(q[start : start + CHUNK], load)
            d[start : start + CHUNK] = np.einsum("snri,sij,snrj->n", B, self.G, B, optimize=True)
        return d
