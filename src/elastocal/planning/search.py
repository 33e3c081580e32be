"""Choosing the poses: options, checkpoint, relaxation, exchange, polish and order."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from elastocal import __version__
from elastocal.errors import require
from elastocal.files import atomic_write_bytes
from elastocal.identification.knowledge import GaussianPrior
from elastocal.measurements import Measurements
from elastocal.model.chain import joint_limits
from elastocal.planning.continuum import Continuum, estimate
from elastocal.planning.exact_plan import exact_plan
from elastocal.planning.execution import Execution, schedule
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import Blockers, Unreachable
from elastocal.planning.plan import Certificate
from elastocal.planning.polish import Searches, polish
from elastocal.planning.relaxation import Relaxed, relax
from elastocal.planning.selection_problem import efficiency
from elastocal.planning.setup import FeasiblePool, Setup
from elastocal.text import did_you_mean, listed
from elastocal.units import IntArray, Progress

# How a plan is searched for; what it is to be stands in the cell's [design].

Effort = Literal["quick", "normal", "thorough"]


@dataclass(frozen=True)
class DesignSearch:
    """`rounds` of polishing and of poses from the continuum added to the pool; `starts` of the
    exchange; fresh `points` per level and `ascents` when the continuum is searched."""

    rounds: int
    starts: int
    points: int
    ascents: int


EFFORTS: dict[str, DesignSearch] = {
    "quick": DesignSearch(rounds=0, starts=4, points=4096, ascents=2),
    "normal": DesignSearch(rounds=1, starts=10, points=16_384, ascents=4),
    "thorough": DesignSearch(rounds=3, starts=30, points=65_536, ascents=10),
}


@dataclass(frozen=True)
class DesignOptions:
    """`fixed`: parameters, places or effects held; `prior`: what is known of parameters;
    `done`: measurements that the plan adds to; `curve`: numbers of poses to compare; `notes`:
    sentences on how these came about, for the plan's warnings."""

    effort: Effort = "normal"
    seed: int = 0
    jobs: int = 1
    fixed: tuple[str, ...] = ()
    prior: GaussianPrior | None = None
    done: Measurements | None = None
    curve: tuple[int, ...] = field(default=())
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        efforts = get_args(Effort)
        require(
            self.effort in efforts,
            f"effort '{self.effort}' is unknown{did_you_mean(self.effort, efforts)}; there are "
            f"{listed(efforts)}",
        )
        require(self.seed >= 0, f"the seed must not be negative, found {self.seed}")
        require(
            self.jobs == -1 or self.jobs >= 1,
            f"jobs takes a number of processes, or -1 for all cores; found {self.jobs}",
        )
        require(
            all(n >= 1 for n in self.curve), f"a curve takes numbers of poses, found {self.curve}"
        )


# Where a design stands, on disk: an interrupted run goes on where it was.

State = Mapping[str, NDArray]


def key_of(files: Iterable[Path], **options: object) -> str:
    """A hash of everything a design depends on: input files, options, the version."""
    digest = hashlib.sha256(__version__.encode())
    for path in files:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    digest.update(json.dumps(options, sort_keys=True, default=str).encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Stage:
    """What one stage of a design has finished so far; nowhere kept if `path` is None.

    `check` is called before anything is kept: it raises where the work was interrupted.
    """

    path: Path | None
    check: Callable[[], None] = lambda: None

    def load(self) -> dict[str, NDArray] | None:
        """What was saved last, None if nothing (readable) was."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as saved:
                return {name: saved[name] for name in saved.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, state: State) -> None:
        """Keep `state`, whole or not at all."""
        self.check()
        if self.path is None:
            return
        text = io.BytesIO()
        np.savez(text, allow_pickle=False, **{k: np.asarray(v) for k, v in state.items()})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(self.path, text.getvalue())


@dataclass(frozen=True)
class Checkpoint:
    """The stages of one design, in a folder beside its output; nowhere if `folder` is None."""

    folder: Path | None = None
    check: Callable[[], None] = lambda: None

    @classmethod
    def beside(cls, output: Path, key: str, check: Callable[[], None] = lambda: None) -> Checkpoint:
        """In the folder `OUTPUT.resume`, apart from what other input or options left there.

        Nothing is written, nor anything of another design thrown away, before a stage is saved.
        """
        return cls(output.with_name(output.name + ".resume") / key[:32], check)

    @property
    def begun(self) -> bool:
        """Is there anything to go on from?"""
        return self.folder is not None and any(self.folder.glob("*.npz"))

    def stage(self, name: str) -> Stage:
        path = None if self.folder is None else self.folder / f"{name}.npz"
        return Stage(path, self.check)

    def drop(self) -> None:
        """This design ends without a plan: nothing to resume, but perhaps of another one."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            with suppress(OSError):
                self.folder.parent.rmdir()

    def clear(self) -> None:
        """The output is written: nothing to resume, whatever else was begun for it."""
        if self.folder is not None:
            shutil.rmtree(self.folder.parent, ignore_errors=True)


# Choosing the poses: relaxation, exchange, polish, and new candidates from the continuum.


@dataclass(frozen=True)
class Selection:
    """The plan as indices `chosen` (k,) into the `pool`, which has grown; Φ `value`.

    From index `first` on the pool holds what came from local searches and the continuum.
    """

    pool: FeasiblePool
    chosen: IntArray
    value: float
    certificate: Certificate
    first: int

    @property
    def polished(self) -> int:
        """Poses of the plan that are not candidates of the first pool."""
        return int((self.chosen >= self.first).sum())

    def without(self, lost: IntArray, setup: Setup, shares: IntArray) -> Selection:
        """The best plan found without the candidates `lost`, from what is left of this one.

        The bounds hold: those of a pool are those of every part of it.
        """
        kept = np.setdiff1d(np.arange(len(self.pool)), lost)
        pool = self.pool.take(kept)
        left = np.searchsorted(kept, np.setdiff1d(self.chosen, lost))
        found = exact_plan(setup.problem(pool, shares), warm=left, starts=1)
        c = self.certificate
        worse = self.value / found.value
        certificate = replace(
            c,
            pool=len(pool),
            efficiency_pool=None if c.efficiency_pool is None else c.efficiency_pool * worse,
            efficiency_continuum=None
            if c.efficiency_continuum is None
            else c.efficiency_continuum * worse,
        )
        first = self.first - int((lost < self.first).sum())
        return Selection(pool, found.chosen, found.value, certificate, first)


def select(
    setup: Setup,
    pool: FeasiblePool,
    shares: IntArray,
    searches: Searches,
    options: DesignOptions,
    checkpoint: Checkpoint,
    progress: Progress,
    begun: IntArray | None = None,
) -> Selection:
    """The best plan found and its certificates, never worse than the plan `begun`, if given.

    In each round the exact plan is polished off the pool and the continuum is searched for poses
    of larger sensitivity; both join the pool, on which relaxation and exchange run again.  So the
    plan is never worse than that of the first pool, and the bound on the pool is that of the
    grown one.
    """
    first = len(pool)
    search = _Rounds(setup, searches, shares, options, checkpoint, progress)
    relaxed = search.relax(pool)
    chosen = search.exchange(pool, relaxed, begun, 0)
    effort = EFFORTS[options.effort]
    for k in range(1, effort.rounds + 1):
        grown, chosen = search.polish(pool, chosen, k)
        pool = search.widen(grown, relaxed, k)
        relaxed = search.relax(pool)
        chosen = search.exchange(pool, relaxed, chosen, k)
    value = float(setup.criterion.value(setup.gathered(pool.blocks[:, chosen])))
    certificate = search.certificate(pool, relaxed, value)
    return Selection(pool, chosen, value, certificate, first)


@dataclass(frozen=True)
class _Rounds:
    """One step of a round each; what is finished is taken from the checkpoint."""

    setup: Setup
    searches: Searches
    shares: IntArray
    options: DesignOptions
    checkpoint: Checkpoint
    progress: Progress

    def relax(self, pool: FeasiblePool) -> Relaxed | None:
        """The relaxed optimum on the pool; None for a criterion without a bound."""
        if not self.setup.criterion.certifiable:
            return None
        self.progress(f"relaxation over {len(pool)} candidates")
        return relax(self.setup.problem(pool, self.shares), progress=self.progress)

    def exchange(
        self, pool: FeasiblePool, relaxed: Relaxed | None, warm: IntArray | None, k: int
    ) -> IntArray:
        found = exact_plan(
            self.setup.problem(pool, self.shares),
            relaxed_weights=None if relaxed is None else relaxed.weights,
            tangent=None if relaxed is None else relaxed.tangent,
            warm=warm,
            starts=EFFORTS[self.options.effort].starts,
            seed=self.options.seed,
            jobs=self.options.jobs,
            checkpoint=self.checkpoint.stage(f"exchange{k}"),
            progress=self.progress,
        )
        return found.chosen

    def polish(self, pool: FeasiblePool, chosen: IntArray, k: int) -> tuple[FeasiblePool, IntArray]:
        """The pool with the polished poses, and the polished plan in it."""
        stage = self.checkpoint.stage(f"polish{k}")
        state = stage.load()
        if state is None:
            problem = self.setup.problem(pool, self.shares)
            done = polish(
                problem, self.searches, pool.q, pool.load, chosen,
                jobs=self.options.jobs, progress=self.progress,
            )  # fmt: skip
            state = {"q": done.q, "moved": done.moved}
            stage.save(state)
        q, moved = state["q"], state["moved"]
        if not moved.any():
            return pool, chosen
        fresh = chosen[moved]
        grown = pool.joined(self.setup.pool(q[moved], pool.load[fresh], pool.group[fresh]))
        now = chosen.copy()
        now[moved] = np.arange(len(pool), len(grown))
        return grown, now

    def widen(self, pool: FeasiblePool, relaxed: Relaxed | None, k: int) -> FeasiblePool:
        """The pool with the poses of the continuum that the relaxed optimum lacks."""
        if relaxed is None:
            return pool
        stage = self.checkpoint.stage(f"continuum{k}")
        state = stage.load()
        if state is None:
            found = self._continuum(pool, relaxed, k)
            state = {"q": found.q, "load": found.load, "group": found.group}
            stage.save(state)
        if not len(state["q"]):
            return pool
        return pool.joined(self.setup.pool(state["q"], state["load"], state["group"]))

    def _continuum(self, pool: FeasiblePool, relaxed: Relaxed, k: int) -> Continuum:
        effort = EFFORTS[self.options.effort]
        # The pool may have grown since: candidates added later have weight 0.
        problem = self.setup.problem(pool, self.shares)
        return estimate(
            problem, relaxed.tangent, self.searches, pool.q, pool.load,
            points=effort.points, starts=effort.ascents, seed=self.options.seed + k,
            jobs=self.options.jobs, progress=self.progress,
        )  # fmt: skip

    def certificate(self, pool: FeasiblePool, relaxed: Relaxed | None, value: float) -> Certificate:
        if relaxed is None:
            return Certificate(len(pool), None, None)
        found = self._continuum(pool, relaxed, 0)
        return Certificate(
            pool=len(pool),
            bound_pool=relaxed.bound,
            efficiency_pool=efficiency(value, relaxed.bound),
            bound_continuum=found.bound,
            efficiency_continuum=efficiency(value, min(found.bound, relaxed.bound)),
            searched=found.searched,
            ascents=found.ascents,
        )


# The order of execution of a selection, and what becomes of poses that no move reaches.

MOST_REPLACED = 50  # poses that cannot be reached, before that is said instead
VIA = 200  # candidates through which a blocked move may go


def ordered(
    setup: Setup,
    found: Selection,
    shares: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
) -> tuple[Selection, Execution, list[str]]:
    """The selection in the order of its levels, its execution, and warnings.

    Poses that no chain of free moves reaches are replaced by the best others.  Raises
    InsufficientDataError where that does not end.
    """
    lost = 0
    while True:
        # In the order of levels, so that the table reads like Table 2.
        chosen = found.chosen[np.lexsort((found.chosen, found.pool.group[found.chosen]))]
        try:
            execution = _execution(setup, found.pool, chosen, feasibility, seed, progress)
        except Unreachable as error:
            if lost >= MOST_REPLACED:
                raise
            lost += len(error.poses)
            found = found.without(np.unique(chosen[error.poses]), setup, shares)
            continue
        return replace(found, chosen=chosen), execution, _warnings(lost, execution)


def _execution(
    setup: Setup,
    pool: FeasiblePool,
    chosen: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
) -> Execution:
    cell, states = feasibility.cell, setup.information.states
    return schedule(
        pool.q[chosen], cell.design.motion, feasibility,
        loads=states.forces,
        load=pool.load[chosen] if states.chosen else None,
        limits=joint_limits(cell, feasibility.chain),
        via=pool.q[:: max(len(pool) // VIA, 1)],
        blockers=Blockers(feasibility),
        seed=seed, progress=progress,
    )  # fmt: skip


def _warnings(lost: int, execution: Execution) -> list[str]:
    warnings = []
    if lost:
        warnings.append(f"{lost} better poses were left out, as no free move reaches them")
    if execution.one_sided:
        told = ", ".join(str(k + 1) for k in execution.one_sided)
        warnings.append(f"approached from one side only, as the other is blocked: {told}")
    return warnings
