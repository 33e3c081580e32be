"""Candidate poses that the cell allows, drawn within limits and levels or brought; those that stay;
test poses, where position must be right, and how the parameters move the tool there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell
from elastocal.cell_tables import EffectChoice, TargetBox, TargetPath, TargetPose
from elastocal.identification.prediction import NewPoses, moves
from elastocal.measurements import (
    NUMBERED,
    Measurements,
    columns_of,
    families,
    read_measurements,
    rotation_column,
)
from elastocal.messages import (
    InputError,
    InsufficientDataError,
    check_known,
    listed,
    option,
    quoted,
    require,
    rounded,
    wish,
)
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.chain import (
    Chain,
    beyond_limits,
    check_posture,
    finite_ranges,
    joint_index,
    joint_limits,
    told,
)
from elastocal.model.effects.base import LEVEL_TOLERANCE
from elastocal.model.effects.catalogue import choose_effects
from elastocal.model.effects.geometry import MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.model.rigid import Postures, inverse_kinematics
from elastocal.planning.collision import data_base
from elastocal.planning.feasibility import CandidateCounts, Feasibility, Struck
from elastocal.planning.information import Estimable, plan_forces
from elastocal.tables import NO_UNIT, Columns, Family, read_table
from elastocal.units import Array, BoolArray, IntArray, Progress


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
        turns = chain.kinds[joint_index(joint)] == "revolute"
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
    """About `n` candidates feasible under all `forces` (L, 3) N, equally many per level:
    Owen-scrambled Sobol points (Owen 1998; scipy.stats.qmc) over the joint ranges, one sequence per
    level, filtered chunk by chunk until there are enough, or TRIES per candidate wanted.  The
    result depends on `seed` only, not on `jobs`, the number of processes (−1: all cores)."""
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
    ok, removed = own[verdict.ok], verdict.counts.removed_by | {NO_LEVEL: len(q) - len(own)}
    told = f"{table.source}: {len(q) - len(ok)} of {len(q)} poses are refused, by the rule that "
    told = f"{told}each breaks first: {named}" if named else ""
    if not len(ok):
        levels = "bring poses at the levels of [design.levels], or drop these"
        raise InsufficientDataError(f"{told}; {rules.advice(verdict) if len(own) else levels}")
    new = ok
    if pins is not None and len(pins.q):
        new = ok[np.abs(q[ok, None] - pins.q[None]).max(axis=2).min(axis=1) >= LEVEL_SLACK]
    found = Candidates(q[new], group[new], CandidateCounts(len(q), len(ok), removed))
    return found, [names[k] for k in new], told


def sobol(dimension: int, seed: int | np.random.Generator) -> Any:
    """A number is another seed to the scrambled sequence than a generator made of that."""
    from scipy.stats import qmc  # slow to import, and identify needs this module

    return qmc.Sobol(dimension, seed=seed)


def points(space: JointSpace, group: int, stream: np.random.SeedSequence) -> Iterator[Array]:
    free, rng = len(space.lower) - (space.held is not None), np.random.default_rng(stream)
    drawn = sobol(free, rng)
    while True:
        yield space.poses(drawn.random(CHUNK), group)


def _check(rules: Feasibility, forces: Array, group: int, q: Array) -> Candidates:
    verdict = rules.under(q, forces)
    kept = q[verdict.ok]
    return Candidates(kept, np.full(len(kept), group), verdict.counts)


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


DEFAULT = 15  # poses, as in Table 2 of Klimchik et al. 2013


def shares_of(cell: Cell, n_poses: int | None = None, asked: str = "") -> IntArray:
    """Poses (L,) per level of [design.levels], (1,) without, `n_poses` in all, as the option
    `asked` says, or as the cell says; what does not divide evenly goes to the first levels."""
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
    """InputError where fewer were asked for than a level has poses, `shares` (L,);
    InsufficientDataError where too few are feasible, or brought and not `refused`."""
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
        require(not clash, f"{table.source}: kept twice: pose {listed(clash)}")
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
    return read_measurements(path, joint_kinds=model.chain.kinds, observe="plan")


def plan_and_names(text: str | Path) -> tuple[Path, tuple[str, ...]]:
    """ "plan.csv:3,7": a plan's file, and the poses named behind it."""
    path, colon, names = str(text).rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in names.split(",") if name.strip())


def _poses(table: Measurements) -> dict[str, int]:
    """Pose → its first row.  "7+" and "7-", the sides from which pose 7 is approached, are one;
    reference visits, "7r1", are none of the plan's own."""
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


TAKEN = ("q", "position", "rotation", "quaternion", "force")
WEIGHT = Family("weight", "weights", {"weight": NO_UNIT})
MOST_POSES = 10_000
Spec = TargetPose | TargetPath | TargetBox | None


def _columns(source: str, header: Sequence[str], joint_kinds: Sequence[str]) -> Columns:
    in_joints = any((m := NUMBERED.fullmatch(text)) and m[1] == "q" for text in header)
    kinds = joint_kinds if in_joints else ()
    every = columns_of(source, header, kinds, "plan", extra=(WEIGHT,))
    columns = {n: cs for n, cs in every.items() if n in (*TAKEN, WEIGHT.name)}
    for name, family in every.items():
        if name not in columns and name != "configuration":
            raise InputError(
                f"{source}: column {quoted(family[0].header)} has no meaning in a path; drop it, "
                "or start its name with '#', '_' or 'note' to have it ignored"
            )
    others = [columns[name][0].header for name in TAKEN[1:4] if in_joints and name in columns]
    if others:
        raise InputError(
            f"{source}: {columns['q'][0].header} … and {others[0]} … say the same in two ways; "
            "keep the joints or the positions"
        )
    if not in_joints and "position" not in columns:
        joints = next(iter(families(joint_kinds)["q"].units), "q1")
        raise InputError(
            f"{source}: the columns {joints}_deg … or x_mm,y_mm,z_mm are missing; a path needs "
            f"the joints or the positions of its poses; found {listed(header, 12)}"
        )
    return columns


# Where the user states none: fewer, and the plan serves just these, and harms what is between them.
DEFAULT_COUNT = 100
ELSEWHERE = 200  # postures that stand for all of the joint ranges
APART = 1  # added to the seed: not the postures that are drawn as test poses
# Postures among which the default test poses are sought where a cell has rules, so many at a time.
DRAWN, LOT = 4096, 512


@dataclass(frozen=True)
class TargetPoses(NewPoses):
    """Of `point` (T, 3) m in the flange frame, `stated` (T,) by the user or else the default."""

    point: Array
    stated: BoolArray

    @classmethod
    def together(cls, groups: Sequence[TargetPoses], source: str) -> TargetPoses:
        q, force, weight, point, stated = (
            np.concatenate([getattr(group, name) for group in groups])
            for name in ("q", "force", "weight", "point", "stated")
        )
        weight = weight / weight.max()  # so that no sum overflows
        return cls(q, force, weight / weight.sum(), source, point, stated)

    def rows(self, arm: CalibratedArm, observed: Observations) -> tuple[Array, Array]:
        """As a plan counts (`known_rows`), of what this arm was identified from."""
        if not self.stated.any() and fitted_markers(arm.model):
            return super().rows(arm, observed)
        A, left = prediction_rows(arm.model, self, arm.x), arm.left
        if left is not None and fitted_markers(arm.model):
            lost = moves(arm, A[self.stated])[1][..., np.isin(left.names, left.redundant)]
            with suppress(InsufficientDataError):  # fewer than three markers hold no point
                A = prediction_rows(arm.model, self, arm.x, carried=True) if lost.any() else A
        return A.reshape(-1, 3, A.shape[-1]), np.repeat(self.weight, A.shape[1] // 3)


def test_poses(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses:
    """[[design.test_pose]], [design.test_path] and [design.test_box] together, or 100 poses drawn
    over the joint limits.  A pose without a force of its own is taken under each of the design's
    loads that is not zero, which share its weight.  Places are reached by the posture nearest to
    home, or the middle of the joint ranges, that the rules allow."""
    spec, of = cell.design, _Sources(cell, chain, feasibility, seed)
    groups = []
    for k, pose in enumerate(spec.test_poses):
        unit = "deg" if pose.degrees else "si"
        key = wish("test_poses", f"{cell.source}: key q_{unit} of [[design.test_pose]]")
        check_posture(cell, chain, f"{key} no. {k + 1}", pose.q, pose.degrees)
        groups.append(of.poses(pose.q[None], "", pose, weight=np.array([pose.weight])))
    sources = [f"{len(groups)} of [[design.test_pose]]"] if groups else []
    groups += [] if spec.test_path is None else [of.path(spec.test_path)]
    groups += [] if spec.test_box is None else [of.box(spec.test_box)]
    groups = groups or [of.drawn(DEFAULT_COUNT)]
    return TargetPoses.together(
        groups, ", ".join([*sources, *(g.source for g in groups if g.source)])
    )


def at_work(cell: Cell, chain: Chain) -> Feasibility:
    """The rules where the arm works: the tracker need not see it there."""
    workspace = replace(cell.workspace, visibility=None, load=None)
    return Feasibility(replace(cell, workspace=workspace), chain)


def used_poses(cell: Cell, chain: Chain) -> TargetPoses | None:
    """The test poses of the cell's plans, where the arm will be used; None where it has none."""
    rules = None
    if cell.design.test_path is not None or cell.design.test_box is not None:
        with suppress(InputError):  # shapes that are not there, of which nobody else asks
            rules = at_work(cell, chain)
    return test_poses(cell, chain, rules) if cell.design.states_test_poses else None


def everywhere(
    cell: Cell, chain: Chain, feasibility: Feasibility | None = None, seed: int = 0
) -> TargetPoses | None:
    """Postures drawn over the joint limits that the rules allow, under each of the cell's loads:
    what an arm may be used for besides the test poses.  None where none was found."""
    with suppress(InsufficientDataError):
        group = _Sources(cell, chain, feasibility, seed + APART).drawn(ELSEWHERE)
        return TargetPoses.together([group], "")
    return None


# Postures per place; many where the work cell allows none of few.
FEW, MANY = 16, 256
WRONG_UNIT = 1e5  # mm


@dataclass(frozen=True)
class _Sources:
    cell: Cell
    chain: Chain
    rules: Feasibility | None
    seed: int

    @property
    def loads(self) -> Array:
        """(L, 3) N: of the design's loads those that are not zero, or zero alone."""
        loads = self.cell.design.loads
        loaded = np.zeros((0, 3)) if loads is None else loads[(loads != 0).any(axis=1)]
        return loaded if len(loaded) else np.zeros((1, 3))

    def under(self, n: int, spec: Spec, own: Array | None) -> Array:
        """Forces (L, n, 3) of n poses: their own (n, 3), else that of the spec, else each load."""
        stated = None if spec is None else spec.force
        loads = self.loads[:, None] if stated is None else stated[None, None]
        return np.broadcast_to(loads, (len(loads), n, 3)) if own is None else own[None]

    def point(self, spec: Spec = None) -> Array:
        tool = self.cell.tool
        if spec is not None and spec.point is not None:
            return spec.point
        if tool.load_point.any() or not tool.markers:
            return tool.load_point
        return np.asarray(np.mean(list(tool.markers.values()), axis=0))

    def poses(
        self, q: Array, source: str, spec: Spec = None, force: Array | None = None,
        weight: Array | None = None,
    ) -> TargetPoses:  # fmt: skip
        """Each `under` its forces, which share its `weight` (n,)."""
        under = self.under(len(q), spec, force)
        each, n = len(under), len(under) * len(q)
        return TargetPoses(
            np.repeat(q, each, axis=0),
            under.swapaxes(0, 1).reshape(n, 3),
            np.repeat((np.ones(len(q)) if weight is None else weight) / each, each),
            source,
            np.broadcast_to(self.point(spec), (n, 3)),
            np.full(n, spec is not None and spec.point is not None),
        )

    def path(self, spec: TargetPath) -> TargetPoses:
        """q1_deg … for all joints, or x_mm, y_mm, z_mm with rx_deg … or qw … where the rotation is
        prescribed; force_x_N … and weight may be added."""
        file = str(spec.file)
        raw = read_table(spec.file, lambda header: _columns(file, header, self.chain.kinds))
        columns, n, weight = raw.columns, len(raw.row), raw.si(WEIGHT.name)
        require(
            n <= MOST_POSES,
            f"{raw.source}: {n} poses; a path takes at most {MOST_POSES}; thin it out: "
            "neighbouring poses say the same",
        )
        if weight is not None:
            raw.check(WEIGHT.name, weight > 0, "a weight must be positive")
            weight = weight[:, 0]
        force, q, position = raw.si("force"), raw.si("q"), raw.si("position")
        turn, source = rotation_column(raw), f"{n} of {spec.file.name}"
        if q is not None and (beyond := beyond_limits(self.cell, self.chain, q)) is not None:
            rows, joint, why = beyond
            where = raw.where(int(rows[0]), columns["q"][joint].header)
            raise InputError(f"{where}: {why}; correct the path or the limits")
        if q is None:
            assert position is not None  # _columns: joints or positions
            rotation = None if turn is None else Rotation.from_rotvec(turn).as_matrix()
            headers = ", ".join(column.header for column in columns["position"])
            lines = [f"{raw.noun} {number}" for number in raw.row]
            q, more = self.reached(
                position, rotation, spec, force,
                lambda t: f"{raw.source}, {lines[t]}, columns {headers}: the place", lines,
            )  # fmt: skip
            source += more
        return self.poses(q, source, spec, force, weight)

    def box(self, box: TargetBox) -> TargetPoses:
        position = box.lower + (box.upper - box.lower) * self.drawn_in(3, box.count)
        turned = box.rotation
        rotation = None if turned is None else np.broadcast_to(turned, (box.count, 3, 3))

        where = f"{self.cell.source}: [design.test_box]: the place"
        q, more = self.reached(
            position, rotation, box, None,
            lambda t: "{} [{:.3f}, {:.3f}, {:.3f}] m in it".format(where, *position[t]),
            remedy=f"make the box smaller, {'' if turned is None else 'leave out rpy_deg, '}",
        )  # fmt: skip
        return self.poses(q, f"{box.count} in [design.test_box]{more}", box)

    def reached(
        self, position: Array, rotation: Array | None, spec: TargetPath | TargetBox,
        force: Array | None, place_of: Callable[[int], str],
        lines: Sequence[str] = (), remedy: str = "",
    ) -> tuple[Array, str]:  # fmt: skip
        """Postures (T, n) with the point at places (T, 3) m of the data's frame, the flange at
        `rotation` (T, 3, 3), None for any, each the first one found that the rules allow `under`
        all its forces; where they allow none of many, the first, and what to say of it."""
        cell, stuck = self.cell, np.arange(len(position))
        q = np.zeros((len(position), self.chain.n_joints))
        for count in (FEW, MANY):
            found = inverse_kinematics(
                self.chain, position[stuck], joint_limits(cell, self.chain),
                rotation=None if rotation is None else rotation[stuck], point=self.point(spec),
                T_data_base=data_base(cell), near=cell.design.motion.home, postures=count,
                seed=self.seed,
            )  # fmt: skip
            if count == FEW:
                for t in found.out_of_reach[:1]:
                    raise InputError(self._far(found, int(t), place_of(int(t)), remedy))
                q = found.q[:, 0].copy()
            if self.rules is None:
                return q, ""
            T, K, n = found.q.shape
            allowed = found.reached.copy()
            for load in self.under(len(position), spec, force):
                each = np.repeat(load[stuck], K, axis=0)
                allowed &= self.rules.check(found.q.reshape(T * K, n), each, False).ok.reshape(T, K)
            some = allowed.any(axis=1)
            q[stuck[some]] = found.q[some, allowed[some].argmax(axis=1)]
            stuck = stuck[~some]
            if not len(stuck):
                return q, ""
        which = f": {listed(lines[int(t)] for t in stuck)}" if lines else ""
        return q, f" ({len(stuck)} of them in no posture that the work cell allows{which})"

    def _far(self, found: Postures, t: int, at: str, remedy: str) -> str:
        distance, turn = found.miss[t, 0] * 1e3, np.degrees(found.turn[t, 0])
        # A place missed by this much is given in another unit than its column says.
        near = f"{rounded(distance, 4)} mm" + ", wrong unit?" * bool(distance >= WRONG_UNIT)
        also = f" and {rounded(turn)}° from its rotation" if turn > 0.01 else ""
        check = "check base_position_m and base_rpy_deg of [model.nominal], and [limits]"
        if self.cell.model.nominal.base_position is None:
            check = (
                "state where the arm stands in the data's frame ([model.nominal] base_position_m, "
                "base_rpy_deg)"
            )
        return (
            f"{at} is out of reach, the arm gets no nearer than {near}{also} "
            f"({len(found.out_of_reach)} of {len(found.q)} places); {remedy}move it, or {check}"
        )

    def drawn(self, most: int) -> TargetPoses:
        cell, chain, rules = self.cell, self.chain, self.rules
        low, high = finite_ranges(chain, *joint_limits(cell, chain))
        count = most if rules is None else DRAWN
        q = low + (high - low) * self.drawn_in(chain.n_joints, count)
        for name, levels in cell.model.compliance_levels.items():
            # Elsewhere the model has no compliance for that joint.
            q[:, joint_index(name)] = np.resize(levels, count)
        if rules is not None:
            found = [q[:0]]
            for part in np.split(q, range(LOT, count, LOT)):
                found.append(part[rules.under(part, self.loads).ok])
                if sum(map(len, found)) >= most:
                    break
            if not any(map(len, found)):
                raise InsufficientDataError(
                    f"{cell.source}: the cell states no test poses, and its rules allow no posture "
                    f"drawn over the joint limits: {rules.advice(rules.every(q, self.loads))}; or "
                    "state [[design.test_pose]]"
                )
            q = np.concatenate(found)[:most]
        return self.poses(q, f"{len(q)} drawn over the joint limits (the cell states none)")

    def drawn_in(self, dimension: int, count: int) -> Array:
        drawn = sobol(dimension, self.seed).random_base2(int(np.ceil(np.log2(count))))
        return np.asarray(drawn[:count])


def prediction_rows(model: Model, targets: TargetPoses, x: Array, carried: bool = False) -> Array:
    """A (T, r, parameters): ∂(position at the test pose)/∂X in m per unit, at arm values x.

    The position is that of the test point under load in the data's frame, as the instrument reads
    it: where it distorts, no plan could tell where the tool is besides, as its scale and the arm's
    lengths move readings in the same way.  Where the markers' own places are fitted and no point
    was stated, it is that of the M markers, each divided by √M, as only they can be known.  A
    stated point may be `carried` by the markers, as a body that they are fixed to, instead of the
    flange.  Deflections are calibrated for: there it is what the load moves the point by.
    """
    if model.observe == "deflection":
        placed = model.specified(replace(model.cell.model, observe="position"))
        unloaded = replace(targets, force=np.zeros_like(targets.force))
        A = prediction_rows(placed, targets, x, carried)
        return A - prediction_rows(placed, unloaded, x, carried)
    by_marker = ~targets.stated & fitted_markers(model)
    bodies = targets.stated & carried
    lone = ~by_marker & ~bodies
    own, T = len(model.cell.tool.markers), len(targets.q)
    points, code = np.unique(targets.point[lone], axis=0, return_inverse=True)
    arm = _with_points(model, points)

    def table(which: BoolArray, marker: IntArray) -> Measurements:
        pose = np.repeat(np.flatnonzero(which), len(marker) // which.sum())
        n, names = len(pose), tuple(arm.cell.tool.markers)
        # The arm as it is at first, its joints come from either side.
        return Measurements.of_poses(
            "test poses", targets.q[pose], targets.force[pose], marker=marker, marker_names=names,
            position=np.zeros((n, 3)), rotation=np.zeros((n, 3)), time=np.zeros(n),
            approach=np.zeros((n, targets.q.shape[1])),
        )  # fmt: skip

    A = np.zeros((T, own if by_marker.any() else 1, 3, len(model.parameters)))
    if lone.any():
        rows = arm.regressor(table(lone, own + code.ravel()), x).B
        A[lone, 0] = rows.reshape(lone.sum(), 3, -1)
    for which in (by_marker, bodies):
        if not which.any():
            continue
        every = table(which, np.tile(np.arange(own), which.sum()))
        B = arm.regressor(every, x).B.reshape(which.sum(), own, 3, -1)
        if which is by_marker:
            A[which] = B / np.sqrt(own)
        else:
            R = arm.flange_poses(every, x)[::own, None, :3, :3]
            J = R @ _carrying(model.cell, targets.point[which]) @ R.swapaxes(-1, -2)
            A[which, 0] = np.einsum("tmij,tmjp->tip", J, B)
    return A.reshape(T, -1, len(model.parameters))


def fitted_markers(model: Model) -> bool:
    return any(p.effect == MarkerPosition.name for p in model.parameters)


def _carrying(cell: Cell, point: Array) -> Array:
    """J (T, M, 3, 3): δp_t = Σ_m J_tm δ_m of points p (T, 3) on the body that M markers are fixed
    to, whose motion is the least-squares one of theirs, with r from the markers' mean c: δp = mean
    δ + ω × (p − c),  (Σ |r|² 1 − r rᵀ) ω = Σ r_m × δ_m."""
    places = np.array(list(cell.tool.markers.values()))
    r = places - places.mean(axis=0)
    inertia = (r**2).sum() * np.eye(3) - r.T @ r
    if len(places) < 3 or np.linalg.matrix_rank(inertia, tol=1e-6 * np.trace(inertia)) < 3:
        raise InsufficientDataError(
            f"{cell.source}: point_m of the test poses is not known where the places of "
            "the markers are fitted, as fewer than three, or three in line, hold no point; leave "
            "out point_m, so that the markers themselves count, or measure a third marker"
        )
    cross = np.cross(np.eye(3)[None], (point - places.mean(axis=0))[:, None])  # [s]×
    turned = np.linalg.inv(inertia) @ np.cross(np.eye(3)[None], -r[:, None])
    return np.eye(3) / len(places) + cross[:, None] @ turned[None]


def _with_points(model: Model, points: Array) -> Model:
    cell = model.cell
    # Effects act where they do on the model as it is, without the test points.
    active = choose_effects(model.chain, cell)
    effects = tuple(EffectChoice(effect.name, where) for effect, where in active)
    spec = replace(cell.model, effects=effects, observe="position")
    named = {f"test point {k + 1}": point for k, point in enumerate(points)}
    tool = replace(cell.tool, markers=cell.tool.markers | named)
    return Model.assembled(model.chain, replace(cell, model=spec, tool=tool))


def known_rows(
    at_work: Model, targets: TargetPoses, x: Array, found: Estimable
) -> tuple[Array, tuple[str, ...]]:
    """`prediction_rows` of the arm `at_work`, and what to say of them: where the markers' places
    are fitted and the readings cannot tell where the flange is, points that are stated are taken to
    be fixed to the markers."""
    cell, chain = at_work.cell, at_work.chain
    for joint, levels in cell.model.compliance_levels.items():
        j = joint_index(joint)
        off = np.abs(targets.q[:, [j]] - np.array(levels)).min(axis=1) > LEVEL_TOLERANCE
        if off.any():
            k = int(off.argmax())
            raise InputError(
                f"{cell.source}: test pose {k + 1}: {joint} at "
                f"{told(chain, j, targets.q[k, j])} is none of its levels in "
                f"[model.compliance_levels], {listed([told(chain, j, v) for v in levels])}; "
                "elsewhere its compliance is not known: state test poses at these, or add the level"
            )
    rows = prediction_rows(at_work, targets, x)
    stated = rows[targets.stated]
    if not len(stated) or not fitted_markers(found.model) or not found.unpredictable(stated):
        return rows, ()
    fixed = (
        "point_m of the test poses is taken to be fixed to the markers as they stand in the cell: "
        "their places are fitted, and the readings cannot tell where the flange is"
    )
    return prediction_rows(at_work, targets, x, carried=True), (fixed,)
