"""Which further poses would tell the rivals of a diagnosis apart, and how surely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import count, islice
from typing import Any

import numpy as np

from elastocal.diagnosis.baseline import Baseline, NoiseValues, fit_baseline, thinned
from elastocal.diagnosis.diagnosis import Diagnosis, ExtraPlan
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.hypotheses import with_keys, with_recorded_drivers
from elastocal.diagnosis.rivals import (
    APART_AT_LAST,
    Discrimination,
    RivalSet,
    Suspects,
    as_diagnosed,
    check_open,
    inseparable,
    pairs_of,
    together,
    with_neighbours,
)
from elastocal.errors import InsufficientDataError, option, require
from elastocal.measurements import Measurements, visits, with_moves
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.candidates import draw
from elastocal.planning.execution import nearest_first
from elastocal.planning.feasibility import Feasibility
from elastocal.planning.moves import travel_times
from elastocal.simulation import simulate
from elastocal.text import counted, rounded
from elastocal.units import Array, BoolArray, Progress

# What may be measured next: poses in all load states, from either side, at once or later.

CANDIDATES, FEWEST_POSES = 256, 64
NEWTON = 1.0  # forces are told apart to this
RARE = 0.1  # share of the visits below which a load state is not asked for again


@dataclass(frozen=True)
class VisitPool:
    """N candidates, each one pose with its side of approach and moment, in all load states.

    `q` (N, n); `approach` (N, n) of ±1 and `time` (N,) s where the table has them; `forces`
    (L, 3) N.  `table` holds their rows: candidate by candidate, load by load, marker by marker,
    with the readings that the fitted model expects; those `hidden` (rows,) the tracker cannot make.
    """

    q: Array
    approach: Array | None
    time: Array | None
    forces: Array
    table: Measurements
    hidden: BoolArray

    def __len__(self) -> int:
        return len(self.q)


def draw_pool(
    model: Model, x: Array, table: Measurements, *, sides: bool, waits: bool, most: int, seed: int
) -> VisitPool:
    """Candidates that the cell's rules allow, after the campaign of `table`.

    Some CANDIDATES, or `most` where memory is short, of FEWEST_POSES poses at least.  With
    `sides` every pose comes twice, each joint from either side; with `waits` twice too: at once
    and after as long as the campaign took.  Both only where the table has such a column.

    Raises InsufficientDataError where no pose is feasible.
    """
    sides, waits = sides and table.approach is not None, waits and table.time is not None
    rng = np.random.default_rng(seed)
    forces = load_forces(table)
    n = max(min(CANDIDATES, most) // (1 + sides) // (1 + waits), FEWEST_POSES)
    cell, chain = model.cell, model.chain
    if cell.model.compliance_levels and not cell.design.levels:
        # A joint whose compliance is known at its levels only can be nowhere else.
        spec = replace(cell.design, levels=cell.model.compliance_levels)
        cell = replace(cell, design=spec)
    q = draw(Feasibility(cell, chain), forces, n, seed).q
    approach = time = None
    if table.approach is not None:
        approach = rng.choice([-1.0, 1.0], q.shape)
        if sides:
            q, approach = np.concatenate([q, q]), np.concatenate([approach, -approach])
    if table.time is not None:
        begin, step = table.time.max() + time_step(table), np.ptp(table.time)
        time = np.full(len(q), begin)
        if waits:
            q, time = np.concatenate([q, q]), np.concatenate([time, time + step])
            approach = None if approach is None else np.tile(approach, (2, 1))
    return visit_pool_of(model, x, table, q, approach, time, forces)


def visit_pool_of(
    model: Model, x: Array, table: Measurements, q: Array, approach: Array | None,
    time: Array | None, forces: Array,
) -> VisitPool:  # fmt: skip
    """The pool of these candidates, read as the model at `x` would be."""
    n, L, M = len(q), len(forces), len(table.marker_names)
    candidate = np.repeat(np.arange(n), L * M)
    known = len(table.configuration_labels)
    rows = replace(
        table.take(np.zeros(len(candidate), dtype=np.int64)),
        row=np.zeros(len(candidate), dtype=np.int64),  # no line of any file
        q=q[candidate],
        configuration=known + candidate,
        configuration_labels=table.configuration_labels + tuple(f"candidate {i}" for i in range(n)),
        repeat=np.zeros(len(candidate), dtype=np.int64),
        marker=np.tile(np.arange(M), n * L),
        force=forces[np.tile(np.repeat(np.arange(L), M), n)],
        approach=None if approach is None else approach[candidate],
        time=None if time is None else time[candidate],
    )
    if table.temperature is not None:
        rows = replace(rows, temperature=np.full(len(rows), np.median(table.temperature)))
    if table.move is not None:
        rows = with_moves(rows)  # from one candidate to the next, as good as any order
    read = simulate(model, rows, x, 0, noise=False)
    return VisitPool(q, approach, time, forces, read, _hidden(model, q, forces, table.marker_names))


def _hidden(model: Model, q: Array, forces: Array, markers: tuple[str, ...]) -> BoolArray:
    """(N·L·M,): the tracker does not see the marker of pose q (N, n) under that of `forces` (L, 3),
    or for deflections under another of them."""
    seen, stated = Feasibility(model.cell, model.chain).seen, list(model.cell.tool.markers)
    if seen is None:
        return np.zeros(len(q) * len(forces) * len(markers), dtype=bool)
    own = [stated.index(name) for name in markers]
    hidden = np.stack([~seen(q, force)[:, own] for force in forces], axis=1)
    if model.observe == "deflection":
        hidden |= hidden.any(axis=1, keepdims=True)
    return hidden.ravel()


def load_forces(table: Measurements) -> Array:
    """The table's usual load states (L, 3) N; the mean load where every visit has its own."""
    _, first = np.unique(visits(table), return_index=True)
    force = table.force[first]
    _, group, count = np.unique(
        np.round(force / NEWTON), axis=0, return_inverse=True, return_counts=True
    )
    usual = np.flatnonzero(count >= RARE * len(force))
    loaded, group = np.any(force != 0, axis=1), group.ravel()
    if not len(usual) or (loaded.any() and not loaded[np.isin(group, usual)].any()):
        return np.array([force[part].mean(axis=0) for part in (~loaded, loaded) if part.any()])
    means = [force[group == k].mean(axis=0) for k in usual]
    return np.array(sorted(means, key=lambda f: float(np.linalg.norm(f))))


def time_step(table: Measurements) -> float:
    assert table.time is not None
    moments = np.unique(table.time)
    return float(np.median(np.diff(moments))) if len(moments) > 1 else 0.0


def joined(first: Measurements, second: Measurements) -> Measurements:
    """Both tables' rows; the second's labels hold for both, its columns are the first's.

    How the arm came to each visit follows from the order of them all.
    """
    first, known = replace(first, move=None, direction=None), first.move is not None
    arrays: dict[str, Any] = {
        f.name: np.concatenate([value, getattr(second, f.name)])
        if isinstance(value, np.ndarray) else value
        for f in fields(first)
        if isinstance(value := getattr(first, f.name), np.ndarray) or value is None
    }  # fmt: skip
    table = replace(second, source=first.source, **arrays)
    return with_moves(table) if known else table


def with_pool(
    base: Baseline, pool: VisitPool, suspects: Suspects
) -> tuple[DiagnosisData, DiagnosisData, NoiseValues]:
    """Columns of the data so far and of the pool at the fit, of the data alone, and the noise that
    the diagnosis found; faulty readings and those of markers that are not seen left out.

    Candidates are read as precisely as the same marker was on average.
    """
    table = base.observed.table
    observed = observe(joined(table, pool.table), base.model.observe)
    n, stated, marker = len(base.observed.lead), base.covariance, table.marker[base.observed.lead]
    usual = {k: stated[marker == k].mean(axis=0) for k in np.unique(marker).tolist()}
    later = observed.table.marker[observed.lead[n:]].tolist()
    planned = np.array([usual.get(k, stated.mean(axis=0)) for k in later])
    both = replace(
        base, observed=observed, stated=np.concatenate([stated, planned]), planned=len(later),
        residual=np.concatenate([base.residual, np.zeros(observed.size * len(later))]),
    )  # fmt: skip
    dataset, noise = as_diagnosed(diagnosis_data_of(both, suspects.hypotheses), suspects.diagnosis)
    hidden = np.concatenate([np.zeros(len(table), dtype=bool), pool.hidden])[observed.lead]
    dataset = dataset.without(dataset.data.faulty | hidden)
    return dataset, dataset.without((np.arange(len(hidden)) >= n) | dataset.data.faulty), noise


def discriminations_of(
    base: Baseline, pool: VisitPool, suspects: Suspects, seed: int
) -> list[Discrimination]:
    dataset, so_far, noise = with_pool(base, pool, suspects)
    sets = [*suspects.sets, *([suspects.unknown_set(so_far, noise)] if suspects.unknown else [])]
    return [
        Discrimination(dataset, so_far, noise, len(pool), s, np.random.default_rng(seed))
        for s in sets
    ]


# The fewest candidates that tell the rivals apart: greedy addition, then exchange.
#
# The design module's criteria are functions of one information matrix, convex and homogeneous of
# degree −1, which its bounds rest on.  Distances of rivals are neither: they start from data in
# hand, and a pair's distance is a difference of two informations.  So this search is its own: one
# candidate more at a time until they are enough, each then exchanged for the best other until none
# helps, and what has become needless left out.

ENOUGH = 0.97  # probability of the right answer from which no further pose is asked for
ROUNDS = 3  # of exchange, at most
WORTH = 1e-3  # relative fall of the error that an exchange is made for
RANDOM_DRAWS = 32  # of as many candidates, whose mean a plan is compared with


def fewest(tasks: Sequence[Discrimination], most: int, enough: float = ENOUGH) -> list[int]:
    """Candidates, at most `most`, with which the right one is named with a probability of
    `enough`; `most` where fewer do not reach it."""
    chosen: list[int] = []
    while len(chosen) < min(most, len(tasks[0].pool)):
        chosen.append(_best(tasks, chosen)[0])
        if expected(tasks, chosen) >= enough:
            break
    _exchange(tasks, chosen)
    while len(chosen) > 1 and expected(tasks, chosen) >= enough:
        fewer = min(
            (chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))),
            key=lambda left: _error(tasks, left),
        )
        _exchange(tasks, fewer)
        if expected(tasks, fewer) < enough:
            break
        chosen = fewer
    return chosen


def expected(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> float:
    """Probability that the right one of every set is named after the chosen visits."""
    each = [c.probability(c.squared(chosen)) for c in tasks]
    return float(np.prod(each))


def _best(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> tuple[int, float]:
    """The candidate not chosen yet that lowers the error most, and the error with it."""
    error = np.array(sum(c.error_bound(c.squared_with_each(chosen)) for c in tasks))
    error[list(chosen)] = np.inf
    best = int(np.argmin(error))
    return best, float(error[best])


def _error(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> float:
    return sum(float(c.error_bound(c.squared(chosen))) for c in tasks)


def _exchange(tasks: Sequence[Discrimination], chosen: list[int]) -> None:
    for _ in range(ROUNDS if len(chosen) > 1 else 0):
        before = list(chosen)
        for k, own in enumerate(before):
            best, error = _best(tasks, chosen[:k] + chosen[k + 1 :])
            if best != own and error < (1 - WORTH) * _error(tasks, chosen):
                chosen[k] = best
        if chosen == before:
            break


# The extra visits as one would make them: a short way through the poses, all loads at each.


def measuring_order(pool: VisitPool, chosen: Sequence[int], table: Measurements) -> Measurements:
    """One row per visit of the chosen candidates, after the campaign of `table`.

    What is to be measured later comes later; otherwise the nearest pose in joint space is next.
    A pose is measured in all load states before the arm moves on, so that what drifts does not
    pass for an effect of the load.
    """
    left, order, at = np.array(chosen), list[int](), table.q[-1]
    for moment in [None] if pool.time is None else np.unique(pool.time[left]):
        due = left if pool.time is None else left[pool.time[left] == moment]
        travel = travel_times(np.vstack([at, pool.q[due]]), None)
        order += due[np.array(nearest_first(travel)) - 1].tolist()
        at = pool.q[order[-1]]
    L, markers = len(pool.forces), len(table.marker_names)
    first_rows = [(k * L + load) * markers for k in order for load in range(L)]
    taken = set(table.configuration_labels)
    names = (name for k in count(1) if (name := f"extra{k}") not in taken)
    rows = pool.table.take(np.array(first_rows))
    time = rows.time
    if time is not None:
        # Each group of visits begins when it should and takes as long as visits usually do.
        begun = np.searchsorted(time, time, side="left")
        time = time + (np.arange(len(rows)) - begun) * time_step(table)
    return replace(
        rows, source="extra poses", row=np.arange(len(rows)) + 2,
        configuration=np.repeat(np.arange(len(order)), L),
        configuration_labels=tuple(islice(names, len(order))),
        position=None, rotation=None, distance=None, torque=None, sigma=None, temperature=None,
        time=time,
    )  # fmt: skip


# What to do besides measuring the extra poses, in words.


def inseparable_advice(group: Sequence[str], distance: float, tried: int) -> str:
    """`distance`: how far apart neighbours among the group are at most."""
    names = " and ".join([", ".join(group[:-1]), group[-1]])
    near = f"they would be {distance:.1f} standard deviations apart"
    if len(group) > 2:
        near = f"each would be within {distance:.1f} standard deviations of another of them"
    return f"no pose separates {names}: measured in all {tried} poses that were tried {near}"


def recording_advice(sets: Sequence[RivalSet]) -> list[str]:
    """What the extra visits must keep to, because rivals depend on it."""
    out = []
    if any(s.depends_on("approach") for s in sets):
        out.append("come to each extra pose with every joint from the side that the plan states")
    if any(s.depends_on("time") for s in sets):
        out.append(
            "leave arm and tracker as they are until the extra poses are measured, and record "
            "their times on the same clock"
        )
    return out


# What a plan can aim at, and from which probability it goes without saying that one is at work.
MOST_CERTAIN, MOSTLY = 0.99, 0.9
NUMBERS = 20_000_000  # of the configurations' covariances that are held at once
GAIN = 0.02  # of probability that a horizontal pull is worth mentioning for


def plan_extra(
    model: Model,
    table: Measurements,
    diagnosis: Diagnosis,
    *,
    most: int = 10,
    seed: int = 0,
    progress: Progress = lambda message: None,
) -> ExtraPlan:
    """The fewest extra poses, at most `most`, that tell the rivals of an open verdict apart.

    `diagnosis` of `table` under `model`, its verdict ambiguous or unknown_effect.  The rivals are
    the sets that it calls indistinguishable, or what the unknown effect may be.  Candidates are
    feasible poses of the cell in the table's load states, after the campaign; their distances come
    from the columns of the fitted arm with all fitted parameters free (see `Discrimination`).

    Raises InputError for a verdict that leaves no rivals, or fewer than one pose.
    """
    check_open(diagnosis)
    require(most >= 1, f"extra poses: at least one has to be allowed; found {most}")
    notes: list[str] = []
    if model.cell.model.torque == "measured":
        model = with_keys(model, torque="computed")
        notes.append("torques of poses not measured yet are computed from load and weights")
    table, _ = thinned(table)
    model = with_recorded_drivers(model, table, diagnosis)
    suspects = Suspects(model, table, diagnosis)
    progress("extra poses: fitting the model as it is")
    base = fit_baseline(model, table, seed)
    progress("extra poses: what else the rivals may be")
    suspects.sets = with_neighbours(base, suspects)
    progress("extra poses: drawing candidates")
    C, M = base.blocks.member.shape
    room = max(NUMBERS // (M * base.observed.size) ** 2 - C, 0)
    try:
        pool = draw_pool(model, base.x, table, **suspects.matters, most=room, seed=seed)
    except InsufficientDataError as error:
        return _nothing(suspects.sets, suspects, (str(error),))
    return _chosen(base, pool, suspects, most, seed, notes, progress)


def _chosen(
    base: Baseline, pool: VisitPool, suspects: Suspects, most: int, seed: int, notes: list[str],
    progress: Progress,
) -> ExtraPlan:  # fmt: skip
    progress("extra poses: columns of the candidates")
    tasks = discriminations_of(base, pool, suspects, seed)
    sets = [c.rivals for c in tasks]
    hopeless = inseparable(tasks)
    groups = tuple(group for c in tasks for group in together(c))
    for group in groups:
        near = max(d for pair, d in hopeless.items() if {*pair} <= {*group})
        notes.append(inseparable_advice(group, near, len(pool)))
    effects = [name.partition(":")[0] for pair in hopeless for name in pair]
    notes += dict.fromkeys(remedy for e in effects if (remedy := effect_of(e).remedy))
    covered = suspects.covered
    if covered < MOSTLY:
        notes.append(
            f"with probability {1 - covered:.2f} none of these rivals is at work (noise alone: "
            f"{suspects.diagnosis.probability_nothing:.2f}), which the probabilities count with: "
            "measure more poses of any kind first"
        )
    # More poses may make up for a small doubt whether the right one is among the rivals.
    enough = ENOUGH / covered if covered * MOST_CERTAIN >= ENOUGH else ENOUGH
    # Where what can be told apart is told apart already, only what cannot be is left.
    worthwhile = any(np.ptp(c.classes) > 0 for c in tasks) and expected(tasks, ()) < enough
    progress("extra poses: choosing")
    chosen = fewest(tasks, most, enough) if worthwhile else []
    after = expected(tasks, chosen)
    if after < enough or hopeless:
        progress("extra poses: what a horizontal pull would add")
        if after < enough:
            reachable = covered * expected(tasks, range(len(pool)))
            notes.append(
                f"with {counted(len(chosen), 'pose')} the probability is {covered * after:.2f} "
                f"only; many more would reach {reachable:.2f}: allow more poses "
                f"({option('poses')}), or repeat each of them"
            )
        notes += _pull_notes(base, pool, suspects, seed, tasks, hopeless, len(chosen), after)
    nothing = _nothing(sets, suspects, notes)
    found = replace(nothing, pairs=pairs_of(tasks, chosen), inseparable=groups)
    if not worthwhile:
        return found
    rng, n = np.random.default_rng(seed), len(chosen)
    picks = [rng.choice(len(pool), size=n, replace=False).tolist() for _ in range(RANDOM_DRAWS)]
    return replace(
        found,
        plan=measuring_order(pool, chosen, base.observed.table),
        n_poses=n,
        probability_before=covered * expected(tasks, ()),
        probability_after=covered * after,
        probability_random=covered * float(np.mean([expected(tasks, pick) for pick in picks])),
        separable=True,
        advice=(*recording_advice(sets), *notes),
    )


def _nothing(sets: Sequence[RivalSet], suspects: Suspects, notes: Sequence[str]) -> ExtraPlan:
    likeliest = [float(s.probability.max()) for s in sets]
    p = float(np.prod(likeliest)) if sets else suspects.diagnosis.probability_unknown
    p *= suspects.covered
    names = tuple(dict.fromkeys(name for s in sets for name in s.names))
    return ExtraPlan(False, (), 0, names, (), None, p, p, p, tuple(notes))


def _pull_notes(
    base: Baseline, pool: VisitPool, suspects: Suspects, seed: int,
    tasks: Sequence[Discrimination], hopeless: dict[tuple[str, str], float], n: int, after: float,
) -> list[str]:  # fmt: skip
    """Advice to pull along x and y as well, as hard as by the load, where that helps.

    None without a load, nor for what is unknown: how it takes a pull nobody can say.
    """
    newton, notes = float(np.linalg.norm(pool.forces, axis=1).max()), []
    if newton == 0 or suspects.unknown:
        return []
    forces, table = np.vstack([pool.forces, newton * np.eye(3)[:2]]), base.observed.table
    wide = visit_pool_of(base.model, base.x, table, pool.q, pool.approach, pool.time, forces)
    pulled = discriminations_of(base, wide, suspects, seed)
    # As many readings more under the loads that there are would help too: d² by their number.
    more = len(forces) / len(pool.forces)
    within = pairs_of(pulled, range(len(wide)))
    reach = {(pair.first, pair.second): pair.distance_after for pair in within}
    apart = ", ".join(
        " and ".join(pair) for pair, d in hopeless.items()
        if reach.get(pair, 0.0) > max(APART_AT_LAST, d * math.sqrt(more))
    )  # fmt: skip
    if apart:
        notes.append(
            f"a horizontal pull of {rounded(newton)} N along x and along y, e.g. by a rope over a "
            f"pulley, would separate {apart}: measure poses under it, too"
        )
    if pulled and n:
        for same, c in zip(pulled, tasks, strict=True):
            same.classes = c.classes
        chosen = fewest(pulled, n)
        reached = expected(pulled, chosen)
        as_many = expected(tasks, fewest(tasks, math.ceil(more * n)))
        if reached > max(after, as_many) + GAIN:
            poses = counted(len(chosen), "pose")
            notes.append(
                f"pull horizontally: {poses}, measured also under {rounded(newton)} N along x and "
                "along y, e.g. by a rope over a pulley, would raise the probability from "
                f"{suspects.covered * after:.2f} to {suspects.covered * reached:.2f}"
            )
    return notes
