"""Candidate poses: drawn within limits and levels or brought, which the cell allows; which stay."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from elastocal.cell import Cell
from elastocal.measurements import Measurements, read_measurements
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    check_known,
    listed,
    option,
    quoted,
    require,
    wish,
)
from elastocal.model.chain import Chain, finite_ranges, joint_index, joint_limits, told
from elastocal.model.manipulator import Model
from elastocal.planning.feasibility import Feasibility, Struck
from elastocal.planning.information import plan_forces
from elastocal.planning.plan import CandidateCounts
from elastocal.units import Array, IntArray, Progress

# Where poses may lie: joint ranges, and one joint that may be held at fixed levels.


@dataclass(frozen=True)
class JointSpace:
    """`lower`, `upper` (n,) in rad or m, both finite; joint `held` (0-based) only takes `levels`,
    each a group of poses."""

    lower: Array
    upper: Array
    held: int | None = None
    levels: tuple[float, ...] = ()

    @property
    def n_groups(self) -> int:
        return max(len(self.levels), 1)

    def bounds(self, group: int) -> tuple[Array, Array]:
        lower, upper = self.lower.copy(), self.upper.copy()
        if self.held is not None:
            lower[self.held] = upper[self.held] = self.levels[group]
        return lower, upper

    def poses(self, unit: Array, group: int) -> Array:
        """Poses (N, n) of points (N, free joints) of the unit cube."""
        lower, upper = self.bounds(group)
        free = [i for i in range(len(lower)) if i != self.held]
        q = np.tile(lower, (len(unit), 1))
        q[:, free] += unit * (upper - lower)[free]
        return q

    def nearest_level(self, q: Array) -> tuple[IntArray, Array]:
        """The group of each pose q (N, n), and how far in rad or m it is from its level."""
        if self.held is None:
            return np.zeros(len(q), dtype=np.int64), np.zeros(len(q))
        away = np.abs(q[:, [self.held]] - np.array(self.levels))
        return away.argmin(axis=1), away.min(axis=1)


def joint_space(cell: Cell, chain: Chain) -> JointSpace:
    lower, upper = finite_ranges(chain, *joint_limits(cell, chain))
    wanted = cell.design.levels
    for joint, levels in cell.model.compliance_levels.items():
        if joint in wanted:
            continue
        i = joint_index(joint)
        turns = chain.kinds[i] == "revolute"
        stated = ", ".join(f"{math.degrees(v) if turns else v:.6g}" for v in levels)
        instead = f" instead of {next(iter(wanted))}" if wanted else ""
        raise InputError(
            f"{cell.source}: [model.compliance_levels] has {joint} at levels, and the "
            f"plan must keep to them; add [design.levels] {joint}_{'deg' if turns else 'm'} = "
            f"[{stated}]{instead}"
        )
    if not wanted:
        return JointSpace(lower, upper)
    ((name, levels),) = wanted.items()
    return JointSpace(lower, upper, joint_index(name), levels)


# Candidate poses: scrambled Sobol points within the limits that the cell allows.

CHUNK = 2048  # a power of two, so that every chunk is balanced over the joint space
GIVE_UP = 32 * CHUNK  # tries after which a group without any feasible pose counts as empty
PER_TASK = 4  # chunks that a process checks at a time
TRIES = 200  # per pose wanted, at most


class Candidates(NamedTuple):
    """Feasible poses q (N, n), their `group` (N,), the level of the held joint, and how many were
    tried for them."""

    q: Array
    group: IntArray
    counts: CandidateCounts

    @classmethod
    def join(cls, lots: Sequence[Candidates]) -> Candidates:
        q, group, counts = zip(*lots, strict=True)
        rules = {r: sum(c.removed_by.get(r, 0) for c in counts) for r in counts[0].removed_by}
        whole = CandidateCounts(
            sum(c.tried for c in counts), sum(c.feasible for c in counts), rules
        )
        return cls(np.concatenate(q), np.concatenate(group), whole)


def draw(
    rules: Feasibility, forces: Array, n: int, seed: int, jobs: int = 1,
    progress: Progress = lambda message: None,
) -> Candidates:  # fmt: skip
    """About `n` candidates feasible under all `forces` (L, 3) N, equally many per level.

    Owen-scrambled Sobol points (Owen 1998; scipy.stats.qmc) over the joint ranges, one sequence
    per level, filtered chunk by chunk until there are enough, or TRIES per candidate wanted.  The
    result depends on `seed` only, not on `jobs`, the number of processes (−1: all cores).
    """
    cell, chain = rules.cell, rules.chain
    space = joint_space(cell, chain)
    groups = space.n_groups
    require(n >= groups, f"{n} candidates are too few for {groups} levels; ask for more")
    drawn: list[Candidates] = []
    for group, stream in enumerate(np.random.SeedSequence(seed).spawn(groups)):
        progress(f"drawing candidates, level {group + 1} of {groups}")
        wanted, lots, count = n // groups + (group < n % groups), list[Candidates](), 0
        for lot in _checked(rules, forces, group, points(space, group, stream), jobs):
            lots.append(lot)
            count += len(lot.q)
            if count >= wanted or len(lots) * CHUNK >= max(TRIES * wanted if count else 0, GIVE_UP):
                break
        if not count:
            some = np.concatenate([*islice(points(space, group, stream), PER_TASK)])
            at, j = "", space.held
            if j is not None:
                at = f" with joint{j + 1} at {told(chain, j, space.levels[group])}"
            raise InsufficientDataError(
                f"{cell.source}: no feasible pose found{at}; "
                f"{rules.advice(rules.every(some, forces))}"
            )
        q, own, counts = Candidates.join(lots)
        drawn.append(Candidates(q[:wanted], own[:wanted], counts))
    return Candidates.join(drawn)


LEVEL_SLACK = 1e-6  # rad or m by which a file's digits may miss a level
NO_LEVEL = "level"  # the rule that a pose brought along breaks where it stands at none


def brought(
    rules: Feasibility, forces: Array, table: Measurements, pins: Pins | None
) -> tuple[Candidates, list[str], str]:
    """The poses of a table that the cell allows, but for those that stay anyhow, the name of each,
    and which are refused.  A pose that stands in several rows is one."""
    space = joint_space(rules.cell, rules.chain)
    q, first = np.unique(np.round(table.q, 9), axis=0, return_index=True)
    order = np.argsort(first, kind="stable")
    q = table.q[first[order]].copy()
    names = [table.configuration_labels[k] for k in table.configuration[first[order]]]
    group, off = space.nearest_level(q)
    if space.held is not None:
        q[:, space.held] = np.array(space.levels)[group]
    own = np.flatnonzero(off <= LEVEL_SLACK)
    own = own[np.argsort(group[own], kind="stable")]
    verdict = rules.under(q[own], forces)
    refused = {NO_LEVEL: [names[k] for k in np.flatnonzero(off > LEVEL_SLACK)]}
    for k, broken in zip(own[~verdict.ok], verdict.broken[~verdict.ok], strict=True):
        rule = verdict.rules[int(broken.argmax())].replace("_", " ")
        refused.setdefault(rule, []).append(names[k])
    named = "; ".join(f"{rule} ({listed(by)})" for rule, by in refused.items() if by)
    ok, removed = own[verdict.ok], verdict.removed_by | {NO_LEVEL: len(q) - len(own)}
    told = f"{table.source}: {len(q) - len(ok)} of {len(q)} poses are refused, by the rule that "
    told = f"{told}each breaks first: {named}" if named else ""
    if not len(ok):
        levels = "bring poses at the levels of [design.levels], or drop these"
        raise InsufficientDataError(f"{told}; {rules.advice(verdict) if len(own) else levels}")
    new = ok
    if pins is not None and len(pins.q):
        near = np.abs(q[ok, None] - pins.q[None]).max(axis=2).min(axis=1) < LEVEL_SLACK
        new = ok[~near]
    found = Candidates(q[new], group[new], CandidateCounts(len(q), len(ok), removed))
    return found, [names[k] for k in new], told


def sobol(dimension: int, seed: int | np.random.Generator) -> Any:
    """A scrambled Sobol sequence of points of the unit cube; a number is another seed to it than a
    generator made of that."""
    from scipy.stats import qmc  # slow to import, and identify needs this module

    return qmc.Sobol(dimension, seed=seed)


def points(space: JointSpace, group: int, stream: np.random.SeedSequence) -> Iterator[Array]:
    """Chunks (CHUNK, n) of an endless sequence of poses of a group."""
    free, rng = len(space.lower) - (space.held is not None), np.random.default_rng(stream)
    drawn = sobol(free, rng)
    while True:
        yield space.poses(drawn.random(CHUNK), group)


def _check(rules: Feasibility, forces: Array, group: int, q: Array) -> Candidates:
    verdict = rules.under(q, forces)
    n = int(verdict.ok.sum())
    counts = CandidateCounts(len(q), n, verdict.removed_by)
    return Candidates(q[verdict.ok], np.full(n, group), counts)


def _checked(
    rules: Feasibility, forces: Array, group: int, chunks: Iterator[Array], jobs: int
) -> Iterator[Candidates]:
    if jobs == 1:
        yield from (_check(rules, forces, group, q) for q in chunks)
    from joblib import Parallel, delayed, effective_n_jobs

    with Parallel(n_jobs=jobs, batch_size=PER_TASK) as pool:
        while True:
            wave = islice(chunks, PER_TASK * effective_n_jobs(jobs))
            yield from pool([delayed(_check)(rules, forces, group, q) for q in wave])


# How many poses a plan has at each level.

DEFAULT = 15  # poses, as in Table 2 of Klimchik et al. 2013


def shares_of(cell: Cell, n_poses: int | None = None, asked: str = "") -> IntArray:
    """Poses (L,) per level of [design.levels], (1,) without, `n_poses` in all, as the option
    `asked` says, or as the cell says; what does not divide evenly goes to the first levels.

    Raises InputError where these are fewer than the levels."""
    spec, where = cell.design, f"{cell.source}: [design]"
    levels = sum(map(len, spec.levels.values())) or 1
    if spec.per_level and n_poses is None:
        each = spec.per_level * levels if len(spec.per_level) == 1 else spec.per_level
        require(
            len(each) == levels,
            f"{wish('per_level', f'{where} poses_per_level')} has {len(each)} numbers, but there "
            f"are {levels if spec.levels else 'no'} levels; give one number per level, and the "
            f"levels by {option('levels')} or [design.levels]",
        )
        return np.array(each, dtype=np.int64)
    total = n_poses or spec.poses or DEFAULT
    told = f"{where} asks for {total} poses at {levels} levels; ask for {levels}"
    if asked:
        told = f"{option(asked, total)}: {cell.source} has {levels} levels, each with a pose; "
        told += f"ask for {levels} poses"
    require(not 0 < total < levels, f"{told} at least, or drop levels")
    return np.array([total // levels + (k < total % levels) for k in range(levels)], dtype=np.int64)


def check_available(cell: Cell, available: IntArray, shares: IntArray, refused: str) -> None:
    """Raise where a level has fewer candidates, `available` (L,), than poses: InputError where too
    few were asked for, InsufficientDataError where too few are feasible, or brought and not
    `refused`."""
    short = np.flatnonzero(available < shares)
    if not len(short):
        return
    k, drawn = int(short[0]), cell.design.candidates or int(available.sum())
    level = f" takes {shares[k]} at level {k + 1} of {next(iter(cell.design.levels), '')}"
    where = f"{cell.source}: a plan of {int(shares.sum())} poses"
    where += level if len(shares) > 1 else ""
    if (taught := cell.design.taught) is not None:
        raise InsufficientDataError(
            f"{where}, but of the poses of {taught} the cell allows {available[k]} there"
            f"{f' ({refused})' * bool(refused)}; bring more, draw others beside them (candidates = "
            f'["{taught.name}", 500]), or plan fewer'
        )
    asked = drawn // len(shares) + (k < drawn % len(shares))
    require(
        asked >= shares[k],
        f"{where}, but {drawn} candidates leave {asked} to choose from; ask for more "
        f"({option('candidates')}, or [design] candidates)",
    )
    raise InsufficientDataError(
        f"{where}, but only {available[k]} feasible candidates were found; plan fewer poses, or "
        "relax the limits or the rules of [workspace]"
    )


@dataclass(frozen=True)
class Pins:
    """Poses that stay, `names` (k,) and `q` (k, n); those `struck` (m, n), near which no other may
    come.  `taken`: all names that these plans have."""

    names: tuple[str, ...]
    q: Array
    struck: Array
    taken: tuple[str, ...]

    def placed(self, rules: Feasibility) -> IntArray:
        """The level (k,) of each pose that stays."""
        cell, space = rules.cell, joint_space(rules.cell, rules.chain)
        group, off = space.nearest_level(self.q)
        verdict = rules.every(self.q, plan_forces(cell))
        # That it stands near one struck out is the user's choice.
        broken = verdict.broken & (np.array(verdict.rules) != Struck.name)
        for k, label in enumerate(self.names):
            where = f"{cell.source}: pose {quoted(label)}, which is to be kept,"
            joint = next(iter(cell.design.levels), "")
            require(off[k] < LEVEL_SLACK, f"{where} is at no level of {joint}")
            require(
                not broken[k].any(),
                f"{where} breaks {verdict.rules[int(broken[k].argmax())]}; strike it "
                f"({option('strike')}), or relax the rule in the cell",
            )
        return group


def read_pins(
    cell: Cell, model: Model, keep: str | Path | None, strike: str | Path | None, sized: bool
) -> tuple[Cell, Pins]:
    """What stays and what is struck, as in "plan.csv:3,7" (all stay, where none is named), of which
    plan all others stay; and the cell, which asks for as many poses as the plan had of which poses
    are struck, unless it is `sized`."""
    kept: dict[str, Array] = {}
    struck: list[Array] = []
    taken: dict[str, None] = {}
    for text, stays in ((keep, True), (strike, False)):
        if text is None:
            continue
        path, named = plan_and_names(text)
        table = poses_of(model, path)
        own = {name: table.q[row] for name, row in _poses(table).items()}
        for name in named:
            check_known(name, own, f"{table.source}: there is no pose {quoted(name)}")
        require(bool(named) or stays, f"{option('strike')} takes poses, as in plan.csv:3,7")
        left = [name for name in own if not named or (name in named) == stays]
        clash = [name for name in left if name in kept]
        require(not clash, f"{table.source}: pose {listed(clash)} is to be kept twice")
        kept |= {name: own[name] for name in left}
        taken |= dict.fromkeys(own)
        if not stays:
            struck += [own[name] for name in named]
            if not sized and cell.design.target is None and len(own) != shares_of(cell).sum():
                cell = replace(cell, design=replace(cell.design, poses=len(own), per_level=()))
    n, q = model.chain.n_joints, list(kept.values())
    at, away = (np.array(lot).reshape(-1, n) for lot in (q, struck))
    return cell, Pins(tuple(kept), at, away, tuple(taken))


def poses_of(model: Model, path: Path) -> Measurements:
    """The poses of a table, whichever markers its rows are of."""
    return read_measurements(path, joint_kinds=model.chain.kinds, observe="plan")


def plan_and_names(text: str | Path) -> tuple[Path, tuple[str, ...]]:
    """ "plan.csv:3,7": a plan's file, and the poses named behind it."""
    path, colon, names = str(text).rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in names.split(",") if name.strip())


def _poses(table: Measurements) -> dict[str, int]:
    """Pose → its first row, in the order of the table.

    "7+" and "7-", the sides from which pose 7 is approached, are one; reference visits, "7r1",
    are none of the plan's own."""
    labels = table.configuration_labels
    found: dict[str, int] = {}
    for row, configuration in enumerate(table.configuration):
        name = labels[configuration]
        if name[-1] in "+-" and name[:-1] + "+" in labels and name[:-1] + "-" in labels:
            name = name[:-1]
        again = name.rpartition("r")
        if not (again[2].isdigit() and again[0] in found):
            found.setdefault(name, row)
    return found
