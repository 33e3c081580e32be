"""Which further poses would tell the rivals of a diagnosis apart, and how surely."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from typing import Any

import numpy as np

from elastocal.diagnosis.baseline import SHARED, SMALLEST_NOISE, Baseline, NoiseValues, fit_baseline
from elastocal.diagnosis.diagnosis import Diagnosis, ExtraPlan
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.hypotheses import possible
from elastocal.diagnosis.rivals import (
    APART_AT_LAST,
    Discrimination,
    RivalSet,
    covered,
    named_sets,
    rival_sets,
)
from elastocal.measurements import Measurements, visits, with_moves
from elastocal.messages import InsufficientDataError, counted, option, rounded, together
from elastocal.model.effects.catalogue import CATALOGUE, effect_of
from elastocal.model.observations import observe
from elastocal.planning.execution import nearest_first
from elastocal.planning.feasibility import Feasibility, travel_times
from elastocal.planning.poses import draw
from elastocal.simulation import simulate
from elastocal.units import Array, BoolArray, Progress

CANDIDATES = 256
NEWTON = 1.0  # forces are told apart to this
RARE = 0.1  # share of the visits below which a load state is not asked for again


@dataclass(frozen=True)
class VisitPool:
    """N candidates, each one pose with its side of approach and moment, in all load states.  `q`
    (N, n); `approach` (N, n) of ±1 and `time` (N,) s where the table has them; `forces` (L, 3) N.
    `table` holds the campaign's rows and then theirs, by candidate, load and marker, with the
    readings that the fitted model expects; those `hidden` (rows,) the tracker cannot make."""

    q: Array
    approach: Array | None
    time: Array | None
    forces: Array
    table: Measurements
    hidden: BoolArray

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def of(
        cls, base: Baseline, q: Array, approach: Array | None, time: Array | None, forces: Array
    ) -> VisitPool:
        campaign, n, L = base.observed.table, len(q), len(forces)
        begun, M, labels = len(campaign), len(campaign.marker_names), campaign.configuration_labels
        of, warm = np.repeat(np.arange(n), L * M), campaign.temperature
        table = replace(
            campaign.take(np.append(np.arange(begun), np.zeros(len(of), dtype=np.int64))),
            configuration_labels=labels + tuple(f"candidate {i}" for i in range(n)),
        )

        def plan(**columns: Any) -> None:
            for name, values in columns.items():
                if (column := getattr(table, name)) is not None:
                    column[begun:] = values

        plan(
            row=campaign.row.max() + 1, q=q[of], configuration=len(labels) + of, repeat=0,
            marker=np.resize(np.arange(M), len(of)),
            force=np.resize(np.repeat(forces, M, axis=0), (len(of), 3)),
            approach=None if approach is None else approach[of],
            time=None if time is None else time[of],
            temperature=None if warm is None else np.median(warm),
        )  # fmt: skip
        if table.move is not None:  # which follows from the order of them all
            table = with_moves(table)
        read = simulate(base.model, table.take(slice(begun, None)), base.x, 0, noise=False)
        plan(position=read.position, rotation=read.rotation, distance=read.distance)
        hidden = np.append(np.zeros(begun, dtype=bool), _hidden(base, q, forces))
        return cls(q, approach, time, forces, table, hidden)


def draw_pool(base: Baseline, diagnosis: Diagnosis, seed: int) -> VisitPool:
    """Candidates that the cell's rules allow, after the campaign, each joint from any side; where a
    rival relaxes with time some at once and others after as long as the campaign took.  Sides and
    moments only where the table has them.  Raises InsufficientDataError if no pose is feasible."""
    table, cell, rng = base.observed.table, base.model.cell, np.random.default_rng(seed)
    # A joint whose compliance is known at its levels only can be nowhere else.
    spec = replace(cell.design, levels=cell.design.levels or cell.model.compliance_levels)
    rules, forces = Feasibility(replace(cell, design=spec), base.model.chain), load_forces(table)
    q = draw(rules, forces, CANDIDATES, seed).q
    approach = None if table.approach is None else rng.choice([-1.0, 1.0], q.shape)
    named = (CATALOGUE[name] for keys in named_sets(diagnosis) for name, _ in keys)
    kinds = [setting.kind for effect in named for setting in effect.constants]
    waits, time = diagnosis.verdict == "unknown_effect" or "time_constant" in kinds, None
    if table.time is not None:
        later = np.ptp(table.time) * rng.integers(1 + waits, size=len(q))
        time = table.time.max() + time_step(table) + later
    return VisitPool.of(base, q, approach, time, forces)


def _hidden(base: Baseline, q: Array, forces: Array) -> BoolArray:
    """(N·L·M,): the tracker does not see the marker of pose q (N, n) under that of `forces` (L, 3),
    or for deflections under another of them."""
    model, markers = base.model, base.observed.table.marker_names
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
    force, kinds = table.force[first], np.round(table.force[first] / NEWTON)
    _, group, count = np.unique(kinds, axis=0, return_inverse=True, return_counts=True)
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


def discriminations(
    base: Baseline, pool: VisitPool, diagnosis: Diagnosis, seed: int,
    sets: Sequence[RivalSet] = (),
) -> list[Discrimination]:  # fmt: skip
    """Of all `sets` of rivals, by default those of the diagnosis, under the noise that it found;
    its faulty readings and those of markers that are not seen are left out.  Candidates are read as
    precisely as the same marker was on average."""
    observed = observe(pool.table, base.model.observe)
    n, stated, marker = len(base.observed.lead), base.covariance, pool.table.marker[observed.lead]
    usual = {k: stated[marker[:n] == k].mean(axis=0) for k in np.unique(marker[:n]).tolist()}
    planned = [usual.get(k, stated.mean(axis=0)) for k in marker[n:].tolist()]
    both = replace(
        base, observed=observed, stated=np.array([*stated, *planned]), planned=len(planned),
        residual=np.append(base.residual, np.zeros(observed.size * len(planned))),
    )  # fmt: skip
    tried = {(c.effect, c.where) for c in diagnosis.candidates}
    every = (h for h in possible(base.model, base.observed.table)[0] if h.key in tried)
    dataset, found = diagnosis_data_of(both, list(every)), diagnosis.noise
    joint = np.maximum(found.repeatability, SMALLEST_NOISE)
    shared = np.array(found.shared_by_joint or [found.shared] * len(joint))
    if not shared.any():  # nor told apart where no configuration is visited twice
        shared, joint = np.full_like(joint, SHARED), joint / np.hypot(1.0, SHARED)
    noise = NoiseValues(found.stated_factor, joint, shared)
    faulty = np.isin(pool.table.row[observed.lead], [f.line for f in found.faulty])
    dataset = dataset.without(faulty | pool.hidden[observed.lead])
    so_far = dataset.without(dataset.data.faulty | (np.arange(len(observed.lead)) >= n))
    return [
        Discrimination(dataset, so_far, noise, len(pool), s, np.random.default_rng(seed))
        for s in sets or rival_sets(so_far, noise, diagnosis)
    ]


# The design module's criteria are functions of one information matrix, convex and homogeneous of
# degree −1, which its bounds rest on.  Distances of rivals are neither: they start from data in
# hand, and a pair's distance is a difference of two informations.  So this choice is its own.

ENOUGH = 0.97  # probability of the right answer from which no further pose is asked for
RANDOM_DRAWS = 32  # of as many candidates, whose mean a plan is compared with


def fewest(tasks: Sequence[Discrimination], most: int, enough: float = ENOUGH) -> list[int]:
    """Candidates, at most `most`, with which the right one is named with a probability of
    `enough`; `most` where fewer do not reach it."""
    chosen: list[int] = []
    while len(chosen) < min(most, len(tasks[0].pool)):
        error = np.sum([c.errors_with_each(chosen) for c in tasks], axis=0)
        error[chosen] = np.inf
        chosen.append(int(np.argmin(error)))
        if expected(tasks, chosen) >= enough:
            break
    return chosen


def expected(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> float:
    """Probability that the right one of every set is named after the chosen visits."""
    return math.prod(c.probability(c.squared(chosen)) for c in tasks)


def measuring_order(pool: VisitPool, chosen: Sequence[int], table: Measurements) -> Measurements:
    """One row per visit of the chosen candidates, after the campaign of `table`: what is to be
    measured later comes later, otherwise the nearest pose in joint space is next.  All load states
    of a pose come before the arm moves on, so that no drift passes for an effect of the load."""
    left, order, at = np.array(chosen), list[int](), table.q[-1]
    for moment in [None] if pool.time is None else np.unique(pool.time[left]):
        due = left if pool.time is None else left[pool.time[left] == moment]
        travel = travel_times(np.vstack([at, pool.q[due]]), None)
        order += due[np.array(nearest_first(travel)) - 1].tolist()
        at = pool.q[order[-1]]
    L, markers = len(pool.forces), len(table.marker_names)
    first_rows = [len(table) + (k * L + load) * markers for k in order for load in range(L)]
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


# What a plan can aim at, and from which probability it goes without saying that one is at work.
MOST_CERTAIN, MOSTLY = 0.99, 0.9
GAIN = 0.02  # of probability that a horizontal pull is worth mentioning for


def plan_extra(
    diagnosis: Diagnosis, most: int, seed: int = 0, progress: Progress = lambda message: None
) -> ExtraPlan:
    """The fewest extra poses, at most `most`, that tell the rivals of an open verdict apart.  The
    rivals are the sets that the diagnosis calls indistinguishable, or what the unknown effect may
    be.  Candidates are feasible poses of the cell in the table's load states, after the campaign;
    their distances come from the columns of the fitted arm with all fitted parameters free (see
    `Discrimination`)."""
    base, advice, none = diagnosis.calibrated, list[str](), ""
    assert base is not None
    if base.model.cell.model.torque == "measured":
        computed = base.model.specified(replace(base.model.cell.model, torque="computed"))
        base = fit_baseline(computed, base.observed.table, seed)
        advice.append("torques of poses not measured yet are computed from load and weights")
    progress("extra poses: drawing candidates")
    try:
        pool = draw_pool(base, diagnosis, seed)
    except InsufficientDataError as error:
        nowhere = np.zeros((0, base.model.chain.n_joints))
        pool, none = VisitPool.of(base, nowhere, None, None, np.zeros((1, 3))), str(error)
    progress("extra poses: what the rivals may be, and columns of the candidates")
    tasks = discriminations(base, pool, diagnosis, seed)
    sets = [c.rivals for c in tasks]
    share = covered(sets, diagnosis)
    # More poses may make up for a small doubt whether the right one is among the rivals.
    enough = ENOUGH / share if share * MOST_CERTAIN >= ENOUGH else ENOUGH
    # Where what can be told apart is told apart already, only what cannot be is left.
    useful = any(np.ptp(c.classes) > 0 for c in tasks) and expected(tasks, ()) < enough
    progress("extra poses: choosing")
    chosen = fewest(tasks, most, enough) if useful and not none else []
    if not none:
        advice += _advice(tasks, chosen, enough, share, diagnosis)
        progress("extra poses: what a horizontal pull would add")
        advice += _of_pulls(base, pool, tasks, chosen, enough, share, diagnosis, seed)
    likeliest = [float(s.probability.max()) for s in sets] or [diagnosis.probability_unknown]
    before = after = by_chance = share * math.prod(likeliest)
    if chosen:
        rng, n, N = np.random.default_rng(seed), len(chosen), len(pool)
        picks = [rng.choice(N, size=n, replace=False).tolist() for _ in range(RANDOM_DRAWS)]
        before, after = (share * expected(tasks, some) for some in ((), chosen))
        by_chance = share * float(np.mean([expected(tasks, pick) for pick in picks]))
    return ExtraPlan(
        separable=bool(chosen),
        inseparable=tuple(names for c in tasks for names in c.inseparable),
        n_poses=len(chosen),
        rivals=tuple(dict.fromkeys(name for s in sets for name in s.names)),
        pairs=tuple(pair for c in tasks for pair in c.pairs(chosen)),
        plan=measuring_order(pool, chosen, base.observed.table) if chosen else None,
        probability_before=before,
        probability_after=after,
        probability_random=by_chance,
        advice=(none,) if none else tuple(advice),
    )


def _advice(
    tasks: Sequence[Discrimination], chosen: Sequence[int], enough: float, share: float,
    diagnosis: Diagnosis,
) -> Iterator[str]:  # fmt: skip
    sets, N = [c.rivals for c in tasks], len(tasks[0].pool) if tasks else 0
    if chosen and any(s.depends_on("approach") for s in sets):
        yield "come to each extra pose with every joint from the side that the plan states"
    if chosen and any(s.depends_on("time") for s in sets):
        yield (
            "leave arm and tracker as they are until the extra poses are measured, and record "
            "their times on the same clock"
        )
    groups = {names: d for c in tasks for names, d in c.inseparable.items()}
    for names, d in groups.items():
        near = f"they would be {d:.1f} standard deviations apart"
        if len(names) > 2:
            near = f"each would be within {d:.1f} standard deviations of another of them"
        alike = f"no pose separates {together(names)}, which count as one"
        yield f"{alike}: measured in all {N} poses that were tried {near}"
    effects = dict.fromkeys(name.partition(":")[0] for names in groups for name in names)
    yield from dict.fromkeys(remedy for e in effects if (remedy := effect_of(e).remedy))
    if share < MOSTLY:
        yield (
            f"with probability {1 - share:.2f} none of these rivals is at work (noise alone: "
            f"{diagnosis.probability_nothing:.2f}), which the probabilities count with: "
            "measure more poses of any kind first"
        )
    if (after := expected(tasks, chosen)) < enough:
        reachable = share * expected(tasks, range(N))
        yield (
            f"with {counted(len(chosen), 'pose')} the probability is {share * after:.2f} "
            f"only; many more would reach {reachable:.2f}: allow more poses "
            f"({option('poses')}), or repeat each of them"
        )


def _of_pulls(
    base: Baseline, pool: VisitPool, tasks: Sequence[Discrimination], chosen: Sequence[int],
    enough: float, share: float, diagnosis: Diagnosis, seed: int,
) -> Iterator[str]:  # fmt: skip
    """Advice to pull along x and y as well, as hard as by the load, where that helps: not without a
    load, nor for what is unknown, as nobody can say how it takes a pull."""
    newton, after = float(np.linalg.norm(pool.forces, axis=1).max()), expected(tasks, chosen)
    settled = after >= enough and not any(c.inseparable for c in tasks)
    if newton == 0 or settled or diagnosis.verdict == "unknown_effect":
        return
    forces = np.vstack([pool.forces, newton * np.eye(3)[:2]])
    wide = VisitPool.of(base, pool.q, pool.approach, pool.time, forces)
    pulled = discriminations(base, wide, diagnosis, seed, [c.rivals for c in tasks])
    # As many readings more under the loads that there are would help too: d² by their number.
    more, apart = len(forces) / len(pool.forces), list[str]()
    for c, wider in zip(tasks, pulled, strict=True):
        news = wider.apart > np.maximum(APART_AT_LAST, c.apart * math.sqrt(more))
        pairs = np.argwhere(np.triu((c.apart < APART_AT_LAST) & news, 1))
        apart += [" and ".join(c.rivals.names[k] for k in pair) for pair in pairs]
        wider.classes = c.classes
    by = f"{rounded(newton)} N along x and"
    if apart:
        yield (
            f"a horizontal pull of {by} along y, e.g. by a rope over a pulley, would separate "
            f"{', '.join(apart)}: measure poses under it, too"
        )
    if chosen:
        under = fewest(pulled, len(chosen))
        reached = expected(pulled, under)
        as_many = expected(tasks, fewest(tasks, math.ceil(more * len(chosen))))
        if reached > max(after, as_many) + GAIN:
            yield (
                f"pull horizontally: {counted(len(under), 'pose')}, measured also under {by} "
                "along y, e.g. by a rope over a pulley, would raise the probability from "
                f"{share * after:.2f} to {share * reached:.2f}"
            )
