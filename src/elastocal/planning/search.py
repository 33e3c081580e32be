"""The search for a plan: relaxation, few starts, all poses polished at once, the bound; on disk
where it stands, so that an interrupted run goes on where it was.

What a polish or an ascent finds joins the pool, on which the relaxation runs again: so the bound
on the pool is one on what was found between its candidates too.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from elastocal import __version__
from elastocal.files import atomic_write, open_input
from elastocal.messages import InsufficientDataError, require
from elastocal.model.chain import finite_ranges, joint_limits
from elastocal.model.effects.catalogue import configuration_rows
from elastocal.planning.criteria import TangentBound, inverse
from elastocal.planning.execution import Alias, Execution, at_stops, schedule
from elastocal.planning.feasibility import Feasibility, Roadmap, Unreachable
from elastocal.planning.plan import Certificate
from elastocal.planning.poses import CHUNK, JointSpace, draw, points
from elastocal.planning.relaxation import DesignProblem, best_of, exact_plan, exchange, relax
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.units import Array, BoolArray, IntArray, Progress

State = Mapping[str, Any]  # arrays and numbers, which become arrays
KEY = "elastocal"  # the array that says of which design a file is


def key_of(files: Iterable[Path], **options: object) -> str:
    """Of everything that a design depends on: input files, options, the version."""
    digest = hashlib.sha256(__version__.encode())
    for path in files:
        with open_input(path, "input file") as handle:
            digest.update(path.name.encode(errors="surrogateescape") + b"\0")
            digest.update(hashlib.file_digest(handle, "sha256").digest())  # type: ignore[arg-type]
    digest.update(json.dumps(options, sort_keys=True, default=str).encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """What the stages of a design have finished, `kept` as arrays STAGE/NAME and in a file beside
    its output; nowhere if `path` is None.  `prefix`: of one of several plans that the design
    searches."""

    path: Path | None = None
    prefix: str = ""
    kept: dict[str, NDArray] = field(default_factory=dict)

    @classmethod
    def beside(cls, output: Path, key: str) -> Checkpoint:
        """In the file `OUTPUT.resume`, which other input or options begin anew, once they have
        something to keep.  Raises InputError where something else has that name."""
        path, kept = output.with_name(output.name + ".resume"), {KEY: np.array(key)}
        if path.exists():
            saved: dict[str, NDArray] = {}
            failures = OSError, ValueError, EOFError, zipfile.BadZipFile
            with suppress(*failures), open(path, "rb") as file, np.load(file) as arrays:
                saved = dict(arrays)
            require(
                KEY in saved,
                f"{path} is not elastocal's, which keeps there where a design stands; move it "
                "elsewhere, or name another -o",
            )
            kept = saved if str(saved[KEY]) == key else kept
        return cls(path, kept=kept)

    @property
    def begun(self) -> bool:
        return len(self.kept) > 1

    def finished(self, stage: str, make: Callable[[], State]) -> Mapping[str, NDArray]:
        """What was kept of a stage, or else, kept now, what `make` returns, as arrays."""
        name = f"{self.prefix}{stage}/"
        own = {at.removeprefix(name): kept for at, kept in self.kept.items() if at.startswith(name)}
        if own:
            return own
        made = {at: np.asarray(value) for at, value in make().items()}
        if self.path is None:
            return made
        self.kept.update({name + at: value for at, value in made.items()})
        text = io.BytesIO()
        np.savez(text, allow_pickle=False, **self.kept)
        atomic_write(self.path, text.getvalue())
        return made

    def clear(self) -> None:
        if self.path is not None and self.begun:
            self.path.unlink(missing_ok=True)


# Poses off the pool: a plan polished all at once, and what the continuum could still gain.
#
#     min log Φ(prior + Σ_i B(q_i)ᵀB(q_i))   over q_1 … q_n, their levels and joint limits
#
# by L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995) with the exact adjoint of B.  Poses go as far towards
# the end of a search as the cell's own rules allow; those that a rule stopped are then sought in
# smaller boxes around where they stand.  B is that of simplified deflections, so every end is
# evaluated exactly.

ORDER = 30.0  # of the power means that stand for a criterion's kinks while poses move
LEAST_GAIN = 1e-8  # relative improvement of Φ that counts as one
# Shares of the way from a start to where its search ended that are tried, the rules permitting.
STEPS = (1.0, 0.9, 0.7, 0.4, 0.15)
# Half widths in rad or m of the boxes in which a round's poses are sought that a rule stopped.
REACHES = (np.inf, 0.5, 0.25, 0.1)
# Of log Φ: a step that gains less is the last one; and of the last polish.
GAINS, FINEST = 3e-6, 1e-8
POLISHING, CLIMBING = 150, 60  # iterations at most
MEMORY = 20  # steps that L-BFGS-B remembers

# Blocks (k, r, p) of k poses → f and ∂f/∂B.
Goal = Callable[[Array], tuple[float, Array]]


@dataclass
class Searches:
    setup: Setup
    space: JointSpace
    checker: Feasibility
    reached: Callable[[Array], BoolArray] | None = None  # by moves, once that is asked
    _rows: dict[int, tuple[ca.Function, ca.Function]] = field(default_factory=dict)

    def feasible(self, q: Array) -> BoolArray:
        ok = self.checker.under(q, self.setup.information.forces).ok
        if self.reached is not None:
            ok[ok] = self.reached(q[ok])
        return ok

    def rows(self, q: Array, level: int) -> tuple[ca.Function, ca.Function]:
        if level not in self._rows:
            info = self.setup.information
            arm, template = info.model.symbolic, info.rows(q[None])
            self._rows[level] = configuration_rows(arm, template, info.columns)
        return self._rows[level]

    def moved(
        self, goal: Goal, T: Array, lot: FeasiblePool, most: int, gains: float,
        kept: Callable[[Array], Array],
    ) -> None:  # fmt: skip
        """Poses moved, round after round, from those of the lot to the end of a search, or as far
        towards it as rules allow, as long as there are some that these stop.  Of where a round
        brought them (k, n), `kept` tells those that the next one begins with."""
        search, q, held = JointSearch(self, T, lot), lot.q, np.zeros(len(lot), dtype=bool)
        found = [self.space.bounds(int(g)) for g in lot.group]
        lower, upper = np.array([low for low, _ in found]), np.array([high for _, high in found])
        for reach in REACHES:
            away = np.where(held, reach, np.inf)[:, None]
            bounds = np.clip(q - away, lower, upper), np.clip(q + away, lower, upper)
            end = search.end(goal, q, *bounds, most, gains)
            part = np.where((q != end).any(axis=1), 0.0, 1.0)
            left = np.flatnonzero(part == 0)
            for step in STEPS:
                ok = self.feasible(q[left] + step * (end[left] - q[left]))
                part[left[ok]] = step
                left = left[~ok]
            q, held = kept(q + part[:, None] * (end - q)), part < 1
            if not held.any():
                return


class JointSearch:
    """min f(B(q_1) … B(q_k)) inside bounds, over all poses of a `lot` at once.  B is that of the
    parameters z, y = T z, whitened by the noise of the lot; what is not read of a pose has next to
    no weight by that."""

    def __init__(self, searches: Searches, T: Array, lot: FeasiblePool) -> None:
        self.info, self.T, self.maps = searches.setup.information, T, []
        self.whitener = inverse(self.info.noise(lot.q, lot.readings)[1])
        # B differs where a joint's compliance is split by level.
        kinds = lot.group if self.info.model.cell.model.compliance_levels else 0 * lot.group
        for kind in np.unique(kinds):
            own = np.flatnonzero(kinds == kind)
            B, adjoint = searches.rows(lot.q[own[0]], int(kind))
            self.maps.append((own, B.map(len(own)), adjoint.map(len(own))))

    def end(
        self, goal: Goal, q: Array, lower: Array, upper: Array, most: int, gains: float
    ) -> Array:
        """Where the search from q (k, n) ends, or stood when f could not be evaluated any more (no
        equilibrium, singular information)."""
        best, least = q, np.inf

        def f(flat: Array) -> tuple[float, Array]:
            nonlocal best, least
            at = flat.reshape(q.shape)
            value, W = goal(self.blocks(at))
            if value < least:
                best, least = at.copy(), value
            return value, self.slope(at, W).ravel()

        bounds = np.column_stack([lower.ravel(), upper.ravel()])
        how = {"maxiter": most, "ftol": gains, "gtol": 0.0, "maxcor": MEMORY}
        with suppress(RuntimeError, np.linalg.LinAlgError):
            minimize(f, q.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=how)
        return best

    def blocks(self, q: Array) -> Array:
        found = np.empty((*self.whitener.shape[:2], len(self.T)))
        for own, B, _ in self.maps:
            raw = B(q[own].T, np.tile(self.info.x[:, None], len(own))).full()
            found[own] = raw.reshape(len(raw), len(own), -1).swapaxes(0, 1)
        return np.asarray(self.whitener @ found * self.info.sizes @ self.T)

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (k, n) of ⟨W, blocks(q)⟩, W (k, r, p)."""
        total = np.empty_like(q)
        raw = self.whitener.swapaxes(-1, -2) @ W @ self.T.T * self.info.sizes
        for own, _, adjoint in self.maps:
            weights = raw[own].swapaxes(0, 1).reshape(raw.shape[1], -1)
            x = np.tile(self.info.x[:, None], len(own))
            total[own] = adjoint(q[own].T, x, weights).full().T
        return total


def polish(
    problem: DesignProblem, searches: Searches, T: Array, plan: FeasiblePool, fine: bool = False
) -> Array:
    """The plan's poses (k, n) moved to a local optimum of Φ, `problem` being that of the parameters
    z, y = T z; `fine`: until nothing is gained any more."""
    criterion = problem.criterion
    smooth = criterion.softened(ORDER)

    def covariance_of(B: Array) -> Array:
        B = B.reshape(-1, B.shape[-1])
        return inverse(problem.prior + B.T @ B)

    def value(B: Array) -> float:
        return float(criterion.value(covariance_of(B)))

    def goal(B: Array) -> tuple[float, Array]:
        V = covariance_of(B)
        now, C = smooth.slope(V)
        return float(np.log(now / phi)), -2 / now * B @ (V @ C @ V)

    q, B = plan.q.copy(), plan.blocks @ T
    phi = value(B)

    def kept(z: Array) -> Array:
        """The poses z all together, or else one by one, where they gain."""
        nonlocal phi
        moved = searches.setup.information.blocks(z, plan.readings) @ T
        for own in (slice(None), *range(len(q))):
            was = B[own].copy()
            B[own] = moved[own]
            if (found := value(B)) < phi * (1 - LEAST_GAIN):
                q[own], phi = z[own], found
            else:
                B[own] = was
        return q

    searches.moved(goal, T, plan, POLISHING, FINEST if fine else GAINS, kept)
    return q


# How much better a plan could be with poses that are not in the pool: an estimate.
#
# On the continuum of feasible poses the tangent at (Φ, G) bounds every plan's value by
#
#     Φ(plan) ≥ Φ² / (⟨G, prior⟩ + Σ_l n_l max_{q∈l} d(q)),   d(q) = tr(B(q) G B(q)ᵀ)
#
# as in `relaxation`, without its box, since one continuous pose may repeat.  d has many local
# maxima and rules cut the space up, so the global one is sought, not proved: new Sobol points,
# then local ascents from the best of them and of the pool.

POINTS = 4096  # new poses per group
STARTS = 6  # ascents per group
LOT, LOTS = 256, 16  # of the best new points that are checked for feasibility at a time, at most
APART = 0.2  # rad or m between starts in at least one joint
EXCESS = 1e-6  # over the pool's largest d, relative, that counts as one


def estimate(
    problem: DesignProblem, tangent: TangentBound, searches: Searches, T: Array,
    pool: FeasiblePool, seed: int = 0, progress: Progress = lambda message: None,
) -> dict[str, Any]:  # fmt: skip
    """The largest d on the continuum per group, for the tangent (Φ, G) of the optimum of the `pool`
    with its `problem`; every maximum is evaluated exactly and passed by the cell's rules.  `bound`
    on Φ from it: an estimate, as a larger d may have been missed.  `q`, `group` and `readings` of
    feasible poses whose d exceeds all of the pool's, by `searched` new points and `ascents` local
    searches."""

    def price(lot: FeasiblePool) -> Array:
        B = lot.blocks @ T
        return np.asarray(((B @ tangent.G) * B).sum(axis=(1, 2)))

    def goal(B: Array) -> tuple[float, Array]:
        """Uphill in d(q), of each pose in its own unit."""
        priced = B @ tangent.G / unit[:, None, None]
        return -float((priced * B).sum()), -2 * priced

    setup, d = searches.setup, problem.prices(tangent.G)
    streams = np.random.SeedSequence(seed).spawn(len(problem.shares))
    levels, starts, lots = np.flatnonzero(problem.shares).tolist(), [], []
    chunks = -(-POINTS // CHUNK)
    for group in levels:
        progress(f"searching the continuum, level {group + 1} of {len(problem.shares)}")
        q = np.concatenate([*islice(points(searches.space, group, streams[group]), chunks)])
        new = setup.pool(q, np.full(len(q), group))
        order, good = np.argsort(-price(new), kind="stable"), np.zeros(0, dtype=np.int64)
        for part in np.split(order[: LOT * LOTS], LOTS):
            good = np.append(good, part[searches.feasible(new.q[part])])
            if len(distinct(new.q[good], STARTS)) == STARTS:
                break
        lots.append(new.take(good))
        both = FeasiblePool.join([lots[-1], pool.take(problem.group == group)])
        order = np.argsort(-price(both), kind="stable")
        starts.append(both.take(order[distinct(both.q[order], STARTS)]))
    begun = FeasiblePool.join(starts)
    unit = price(begun)

    def kept(here: Array) -> Array:
        lots.append(setup.pool(here, begun.group, begun.readings))
        return here

    searches.moved(goal, T, begun, CLIMBING, EXCESS, kept)
    every, largest, better = FeasiblePool.join(lots), np.zeros(len(problem.shares)), []
    values = price(every)
    for group in levels:
        top = d[problem.group == group].max()
        own = np.flatnonzero((every.group == group) & (values > top * (1 + EXCESS)))
        own = own[np.argsort(-values[own], kind="stable")]
        better.append(own[distinct(every.q[own], len(own))])
        largest[group] = max(top, values[own].max(initial=0.0))
    bound = tangent.bound(problem.prior, float(problem.shares @ largest))
    found, searched = every.take(np.concatenate(better)), len(levels) * CHUNK * chunks
    poses = {"q": found.q, "group": found.group, "readings": found.readings}
    return poses | {"bound": bound, "searched": searched, "ascents": len(begun)}


def distinct(q: Array, count: int) -> IntArray:
    """Indices of the first `count` poses of q (N, n) that lie `APART` from those before."""
    chosen: list[int] = []
    for i, pose in enumerate(q):
        if len(chosen) < count and all(np.abs(pose - q[k]).max() > APART for k in chosen):
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)


POOL = 2000  # candidates where nobody asks for a number
CLOSE, FINE = 1e-3, 1e-4  # gap of the relaxations that lead to the next one, and of the last
# Of Φ: by less do starts differ that end alike, and mirrored poses, which rounding tells apart.
SAME = 1e-4
NEAR = 0.97  # of the bound on the pool: a continuum as near as that is not searched again
REFINED = 3  # times at most
ROUND = 1000  # added to the seed of each of them, beyond the rounds that belong to the effort


@dataclass(frozen=True)
class SearchEffort:
    """`starts` of the search, each polished, and `rounds` in which the continuum is searched for
    poses that the pool lacks.  Without starts the plan is one of the pool's candidates, the best of
    so many `exchanges`."""

    starts: int
    rounds: int
    exchanges: int = 1


EFFORTS = {
    "quick": SearchEffort(starts=5, rounds=0),
    "normal": SearchEffort(starts=8, rounds=2),
    "thorough": SearchEffort(starts=40, rounds=4),
    "batch": SearchEffort(starts=0, rounds=0, exchanges=4),
}


class Search:
    """What a plan is sought with: the setup, whose parameters y = T z are balanced, and the `pool`,
    which grows by what polish and ascents find, from index `first` on.  Then the plan, as indices
    `chosen` (k,) into it, its Φ `value` and `certificate`."""

    chosen: IntArray
    value: float
    certificate: Certificate

    def __init__(
        self, pool: FeasiblePool, searches: Searches, shares: IntArray, effort: SearchEffort,
        seed: int, checkpoint: Checkpoint, progress: Progress,
    ) -> None:  # fmt: skip
        self.setup, self.searches, self.shares = searches.setup, searches, shares
        self.effort, self.seed, self.pool, self.first = effort, seed, pool, len(pool)
        self.checkpoint, self.progress = checkpoint, progress
        whole = self.setup.problem(pool, shares)
        whole.check_enough()
        self.T = whole.balancing()
        self._of: tuple[FeasiblePool, DesignProblem] | None = None

    @property
    def problem(self) -> DesignProblem:
        if self._of is None or self._of[0] is not self.pool:
            self._of = self.pool, self.setup.problem(self.pool, self.shares).balanced(self.T)
        return self._of[1]

    def value_of(self, chosen: IntArray) -> float:
        return self.setup.problem(self.pool, self.shares).value(chosen)

    def whole(self, chosen: IntArray) -> tuple[FeasiblePool, IntArray]:
        """The pool with the poses that stay at its end, and the plan with them, in the order of the
        levels; of a level these come first."""
        pool, chosen = self.pool, np.sort(chosen)
        if (pinned := self.setup.pinned) is not None:
            pool = FeasiblePool.join([pool, pinned])
            chosen = np.append(np.arange(len(self.pool), len(pool)), chosen)
        return pool, chosen[np.argsort(pool.group[chosen], kind="stable")]

    def exchange(self, chosen: IntArray) -> None:
        """The bounds hold for another plan (k,), as a plan's own poses, where they are new, are
        those that the continuum's is about."""
        self.chosen, self.value = chosen, self.value_of(chosen)
        self.certificate = self.certificate.of(self.value)

    def select(self) -> Search:
        effort, seed = self.effort, self.seed
        self.progress(f"relaxation over {self.first} candidates")
        self.relaxed = relax(self.problem, CLOSE if effort.starts else FINE)
        best, ends = self._started()
        continuum = []
        for k in range(effort.rounds):
            self._relax()
            if self.problem.criterion.certifiable:
                continuum.append(self._widened(k + 1))
            self._relax()
            # One begun from the plan, one from the relaxation.
            plans = [exact_plan(self.problem, self.relaxed, warm=w, starts=1) for w in (best, None)]
            for name, (plan, _) in zip((f"warm{k}", f"anew{k}"), plans, strict=True):
                best = self._better(best, self.polished(plan, name))
        if effort.starts:
            self._relax(CLOSE if effort.rounds else FINE)
            mixed, _ = exact_plan(self.problem, self.relaxed, warm=best, seed=seed)
            best = self._better(best, mixed)
        if effort.rounds:
            best = self.polished(best, "last", fine=True)
        self.chosen, self.value = best, self.value_of(best)
        self.setup.problem(self.pool, self.shares).check_determined(self.value)
        pool = self.pool
        self.certificate = self._certificate(self.value, ends, continuum)
        self.pool = pool  # what the plan was chosen from: not what the bound was sought by
        return self

    def _started(self) -> tuple[IntArray, list[float]]:
        """From exchange, from roundings and random plans in turn, each polished; and where these
        ended."""
        problem, relaxed, effort, seed = self.problem, self.relaxed, self.effort, self.seed
        rng, least, ends = np.random.default_rng(seed), np.inf, list[float]()
        best = begun = self.checkpoint.finished(
            "exchange",
            lambda: {"chosen": exact_plan(problem, relaxed, starts=effort.exchanges, seed=seed)[0]},
        )["chosen"]
        for k in range(effort.starts):
            if k:
                begun = problem.random(rng) if k % 2 else problem.rounded(relaxed.weights, rng)
            end = self.polished(begun, f"start{k}")
            ends.append(self.value_of(end))
            so_far = f"best so far {problem.criterion.told(min(ends))}"
            self.progress(f"start {k + 1} of {effort.starts}: {so_far}")
            if ends[-1] < least * (1 - SAME):
                best, least = end, ends[-1]
        return best, ends

    def polished(self, chosen: IntArray, name: str, fine: bool = False) -> IntArray:
        """The plan (k,) polished; poses that moved join the pool."""
        plan = self.pool.take(chosen)
        q = self.checkpoint.finished(
            name, lambda: {"q": polish(self.problem, self.searches, self.T, plan, fine)}
        )["q"]
        moved, now = (q != plan.q).any(axis=1), chosen.copy()
        now[moved] = len(self.pool) + np.arange(moved.sum())
        self._join(q[moved], plan.group[moved], plan.readings[moved])
        return now

    def _join(self, q: Array, group: IntArray, readings: IntArray) -> None:
        if len(q):
            self.pool = FeasiblePool.join([self.pool, self.setup.pool(q, group, readings)])

    def _better(self, best: IntArray, other: IntArray) -> IntArray:
        return other if self.value_of(other) < self.value_of(best) * (1 - SAME) else best

    def _relax(self, gap: float = CLOSE) -> None:
        were = self.relaxed.weights
        start = np.concatenate([were, np.zeros(len(self.pool) - len(were))])
        self.relaxed = relax(self.problem, gap, start)

    def _widened(self, k: int) -> State:
        asked = self.problem, self.relaxed.tangent, self.searches, self.T, self.pool, self.seed + k
        found = self.checkpoint.finished(f"continuum{k}", lambda: estimate(*asked, self.progress))
        self._join(found["q"], found["group"], found["readings"])
        return found

    def _certificate(self, value: float, ends: list[float], continuum: list[State]) -> Certificate:
        own = Certificate(len(self.pool), starts=tuple(map(self.setup.criterion.figure, ends)))
        if not self.problem.criterion.certifiable:
            return own
        if len(self.relaxed.weights) < len(self.pool):
            self._relax(FINE)
        own = replace(own, bound_pool=self.relaxed.bound).of(value)
        if not self.effort.starts:
            return own
        # The tangent of the pool's optimum says little of poses far better than the pool's: they
        # join it, and that of the new optimum says more.
        for k in range(1 + REFINED):
            continuum = [*continuum, self._widened((k + 1) * ROUND)]
            new = continuum[-1]
            if new["bound"] >= NEAR * self.relaxed.bound or not len(new["q"]) or k == REFINED:
                break
            self._relax()
        searched, ascents = (int(sum(c[n] for c in continuum)) for n in ("searched", "ascents"))
        beyond = min(float(new["bound"]), own.bound_pool or np.inf)
        return replace(own, bound_continuum=beyond, searched=searched, ascents=ascents).of(value)


# The order of a plan that moves can follow; poses that none reaches are replaced, and polished.

ROUNDING = 1e-9  # of the largest number of the blocks: rounding
TRIED = 6  # poses of the hub one of which a pose put into a plan must be able to reach
LIKELY = 400  # candidates that gain most, of which that is found out
VIA = 200  # poses through which a blocked move may go
REPLACED = 10  # times at most


def ordered(search: Search) -> tuple[Execution, Alias | None, list[str]]:
    """The execution of a search's plan, what a shift of its readings does, and warnings.  Poses
    that no chain of free moves reaches are replaced by the best others, unless they are pinned, and
    all then polished again, as far as moves reach them there."""
    order = _Ordering(search)
    execution, alias = order.reachable()
    if not order.gone:
        return execution, alias, []
    if search.effort.starts:
        search.searches.reached = order.reached
        chosen = search.polished(search.chosen, "replaced")
        with suppress(Unreachable):
            if search.value_of(chosen) < search.value:
                execution, alias = order.put(chosen)
                search.exchange(chosen)
    told = f"no free move reaches some better poses, which were left out: {order.gone}"
    return execution, alias, [f"{told}; the certificate's bound counts such poses"]


class _Ordering:
    """The plan of a `search` put in order; `gone` poses of it were unreachable so far.  Blocked
    moves may go through the `hub` (k, n): home, and poses of the pool, which free moves join."""

    def __init__(self, search: Search) -> None:
        self.search, self.gone, pool = search, 0, search.pool
        self.rules = search.searches.checker
        self.loaded = bool(np.any(self.rules.cell.design.loads))
        self.hub = pool.q[:: max(len(pool) // VIA, 1)]

    def reachable(self) -> tuple[Execution, Alias | None]:
        for k in range(REPLACED):
            try:
                return self.put(self.search.chosen)
            except Unreachable as error:
                if k == 0:
                    self._unwind()
                else:
                    self._replace(error)
        return self.put(self.search.chosen)

    def put(self, chosen: IntArray) -> tuple[Execution, Alias | None]:
        search, rules, setup = self.search, self.rules, self.search.setup
        pool, chosen = search.whole(chosen)
        q, blocks, readings = pool.q[chosen], pool.blocks[chosen], pool.readings[chosen]
        M = setup.gathered(blocks)
        alias = Alias.of(setup.information, q, blocks, M, setup.target_rows, readings)
        execution = schedule(
            q, at_stops(rules.cell), rules, loads=setup.information.forces, read=readings > 0,
            limits=joint_limits(rules.cell, rules.chain), via=self.hub, alias=alias,
            paired=rules.cell.model.observe == "deflection",
            seed=search.seed, progress=search.progress,
        )  # fmt: skip
        return execution, alias

    def _unwind(self) -> None:
        """The same postures, whole turns nearer to home, or to the middle of the joint ranges: to
        the same posture a turn on there is often no way.  Poses whose information would be another
        are left as they are."""
        rules, pool = self.rules, self.search.pool
        chain, home = rules.chain, rules.cell.design.motion.home
        lower, upper = finite_ranges(chain, *joint_limits(rules.cell, chain))
        near = (lower + upper) / 2 if home is None else home
        q = pool.q - 2 * np.pi * chain.turning * np.round((pool.q - near) / (2 * np.pi))
        q = np.where((q >= lower) & (q <= upper), q, pool.q)
        off = np.abs(self.search.setup.information.blocks(q, pool.readings) - pool.blocks)
        same = off.max(axis=(1, 2)) <= ROUNDING * np.abs(pool.blocks).max()
        self.search.pool = pool = replace(pool, q=np.where(same[:, None], q, pool.q))
        self.hub = pool.q[:: max(len(pool) // VIA, 1)]
        if len(pool) < VIA:  # as where the candidates are poses that were brought
            with suppress(InsufficientDataError):
                forces = self.search.setup.information.forces
                self.hub = np.vstack([self.hub, draw(rules, forces, VIA, self.search.seed).q])

    def _replace(self, error: Unreachable) -> None:
        """In the place of the poses that cannot be reached, and by exchange in that of others, come
        the best that a free move joins to the hub, looked for among the LIKELY candidates of a
        level at a time, as long as these better the plan."""
        search, pool, plan = self.search, self.search.pool, self.search.chosen
        problem, gone = search.problem, search.whole(plan)[1][error.poses]
        if (gone >= len(pool)).any():
            raise error
        self.gone += len(gone)
        search.progress(f"{self.gone} poses that no free move reaches are replaced by others")
        left = now = np.setdiff1d(plan, gone)
        self.hub = self._joined(np.vstack([self.hub, pool.q[now]]))
        new, least = np.setdiff1d(np.arange(len(pool)), plan), np.inf
        while len(new):
            _, worth = problem.worth(inverse(problem.information(now)))
            tried = new[
                best_of(worth[new], problem.group[new], np.full(len(problem.shares), LIKELY))
            ]
            new = np.setdiff1d(new, tried)
            left = np.union1d(left, tried[self.reached(pool.q[tried])])
            part = problem.restricted(left)
            if (np.bincount(part.group, minlength=len(problem.shares)) < problem.shares).any():
                continue
            chosen, value = exchange(part, part.fitted(np.searchsorted(left, now)))
            if value > least * (1 - CLOSE):
                break
            now, least = left[chosen], value
        if np.isinf(least):
            raise error
        search.exchange(now)

    def _joined(self, q: Array) -> Array:
        motion = self.rules.cell.design.motion
        points = q if motion.home is None else np.vstack([motion.home, q])
        roadmap = Roadmap(points, motion.speed, self.loaded, self.rules)
        parts = roadmap.parts(list(range(len(points))))
        return points[parts[0] if motion.home is None else next(p for p in parts if 0 in p)]

    def reached(self, q: Array) -> BoolArray:
        next_to = np.argsort(np.abs(q[:, None] - self.hub).max(axis=2), axis=1)
        alone = np.arange(len(q))
        for k in range(min(TRIED, len(self.hub))):
            there = self.hub[next_to[alone, k]]
            alone = alone[~self.rules.paths_free(q[alone], there, self.loaded)]
        return ~np.isin(np.arange(len(q)), alone)
