"""Which further poses would tell the rivals of a diagnosis apart, and how surely."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import Baseline, fit_baseline
from elastocal.diagnosis.recorded_drivers import with_recorded_drivers
from elastocal.diagnosis.result import Diagnosis
from elastocal.diagnosis.separate import advice
from elastocal.diagnosis.separate.contest import Contest
from elastocal.diagnosis.separate.judged import contests_of, judged, pairs_of, together
from elastocal.diagnosis.separate.neighbours import with_neighbours
from elastocal.diagnosis.separate.order import measuring_order
from elastocal.diagnosis.separate.pool import Pool, draw_pool, pool_of
from elastocal.diagnosis.separate.result import ExtraPlan
from elastocal.diagnosis.separate.rivals import RivalSet, Suspects, check_open
from elastocal.diagnosis.separate.search import ENOUGH, expected, expected_of_random, fewest
from elastocal.diagnosis.thin import thinned
from elastocal.errors import InsufficientDataError, require
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Array = NDArray[np.float64]
Progress = Callable[[str], None]

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
    feasible poses of the cell in the table's load states, after the campaign; their distances
    come from the columns of the fitted arm with all fitted parameters free (see
    `contest`).

    Raises InputError for a verdict that leaves no rivals, or fewer than one pose.
    """
    check_open(diagnosis)
    require(most >= 1, f"extra poses: at least one has to be allowed; found {most}")
    notes: list[str] = []
    if model.cell.model.torque == "measured":
        spec = replace(model.cell.model, torque="computed")
        model = Model.assembled(model.chain, replace(model.cell, model=spec))
        notes.append("torques of poses not measured yet are computed from load and weights")
    table, _ = thinned(table)
    model = with_recorded_drivers(model, table, diagnosis)
    suspects = Suspects(model, table, diagnosis)
    progress("extra poses: fitting the model as it is")
    base = fit_baseline(model, table, seed)
    progress("extra poses: what else the rivals may be")
    suspects = suspects.with_sets(with_neighbours(base, diagnosis, suspects.sets, suspects.known))
    progress("extra poses: drawing candidates")
    try:
        pool = draw_pool(
            model, base.x, table, sides=suspects.sides_matter, waits=suspects.waiting_matters,
            most=_room(base), seed=seed,
        )  # fmt: skip
    except InsufficientDataError as error:
        return _nothing(suspects.sets, suspects, (str(error),))
    return _chosen(base, pool, suspects, most, seed, notes, progress)


def _chosen(
    base: Baseline, pool: Pool, suspects: Suspects, most: int, seed: int, notes: list[str],
    progress: Progress,
) -> ExtraPlan:  # fmt: skip
    """The plan from this pool, `notes` and what there is to say of it as its advice."""
    progress("extra poses: columns of the candidates")
    drawn = contests_of(base, pool, suspects, seed)
    sets = [c.rivals for c in drawn]
    contests, hopeless = judged(drawn)
    groups = tuple(group for c in contests for group in together(c))
    for group in groups:
        near = max(d for pair, d in hopeless.items() if {*pair} <= {*group})
        notes.append(advice.inseparable_advice(group, near, len(pool)))
    notes += advice.other_means(list(hopeless))
    covered = suspects.covered
    if covered < MOSTLY:
        notes.append(advice.none_of_them(1 - covered, suspects.diagnosis.probability_nothing))
    # More poses may make up for a small doubt whether the right one is among the rivals.
    enough = ENOUGH / covered if covered * MOST_CERTAIN >= ENOUGH else ENOUGH
    # Where what can be told apart is told apart already, only what cannot be is left.
    worthwhile = any(c.open for c in contests) and expected(contests, ()) < enough
    progress("extra poses: choosing")
    chosen = fewest(contests, most, enough) if worthwhile else []
    after = expected(contests, chosen)
    if after < enough or hopeless:
        progress("extra poses: what a horizontal pull would add")
        if after < enough:
            reachable = covered * expected(contests, range(len(pool)))
            notes.append(advice.too_few_advice(len(chosen), covered * after, reachable))
        pulled = _pulled(base, pool, suspects, seed)
        n, newton = len(chosen), _newton(pool)
        notes += _pull_notes(contests, hopeless, pulled, n, after, newton, covered)
    if not worthwhile:
        nothing = _nothing(sets, suspects, tuple(notes))
        return replace(nothing, pairs=pairs_of(contests, chosen), inseparable=groups)
    rng = np.random.default_rng(seed)
    return ExtraPlan(
        rivals=_names(sets),
        pairs=pairs_of(contests, chosen),
        plan=measuring_order(pool, chosen, base.seen.table),
        n_poses=len(chosen),
        probability_before=covered * expected(contests, ()),
        probability_after=covered * after,
        probability_random=covered * expected_of_random(contests, len(chosen), rng),
        separable=True,
        inseparable=groups,
        advice=(*advice.recording_advice(sets), *notes),
    )


def _room(base: Baseline) -> int:
    """How many candidates fit into memory beside the data."""
    C, M = base.blocks.member.shape
    return max(NUMBERS // (M * base.seen.size) ** 2 - C, 0)


def _nothing(sets: Sequence[RivalSet], suspects: Suspects, notes: tuple[str, ...]) -> ExtraPlan:
    """No pose helps: the right one is named as often as the likeliest is right."""
    likeliest = [float(s.probability.max()) for s in sets]
    p = float(np.prod(likeliest)) if sets else suspects.diagnosis.probability_unknown
    p *= suspects.covered
    return ExtraPlan(_names(sets), (), None, 0, p, p, p, False, (), notes)


def _names(sets: Sequence[RivalSet]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for s in sets for name in s.names))


def _newton(pool: Pool) -> float:
    return float(np.linalg.norm(pool.forces, axis=1).max())


def _pulled(base: Baseline, pool: Pool, suspects: Suspects, seed: int) -> list[Contest]:
    """The contests with every candidate also pulled along x and y as hard as its load pulls.

    None without a load, nor for what is unknown: how it takes a pull nobody can say.
    """
    if _newton(pool) == 0 or suspects.unknown:
        return []
    forces = np.vstack([pool.forces, _newton(pool) * np.eye(3)[:2]])
    table = base.seen.table
    wide = pool_of(base.model, base.x, table, pool.q, pool.approach, pool.time, forces)
    return contests_of(base, wide, suspects, seed)


def _pull_notes(
    contests: Sequence[Contest], hopeless: dict[tuple[str, str], float],
    pulled: Sequence[Contest], n: int, after: float, newton: float, covered: float,
) -> list[str]:  # fmt: skip
    """Advice to pull sideways, where that helps."""
    still = judged(pulled)[1] if pulled else hopeless
    helped = [pair for pair in hopeless if pair not in still]
    notes = [advice.pull_separates(helped, newton)] if helped else []
    if pulled and n:
        alike = [p.in_classes(c.classes) for p, c in zip(pulled, contests, strict=True)]
        chosen = fewest(alike, n)
        reached = expected(alike, chosen)
        if reached > after + GAIN:
            notes.append(
                advice.pull_advice(len(chosen), newton, covered * after, covered * reached)
            )
    return notes
