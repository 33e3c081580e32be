"""Effects beside those that poses are chosen for: what the model may lack, and what time shows.

**In doubt.** The model is given every effect of the catalogue that poses and loads can show, at
every place; each parameter of them has mean 0 and variance π s², π the probability that the effect
is missing and s its typical size.  Of what is known beforehand the best linear estimate asks these
two moments only (Goldstein & Wooff 2007, Bayes Linear Statistics, ch. 3), so that

    tr(C M⁻¹),   M = diag(0, 1/(π s²)) + Σ_i B_iᵀ Σ_i⁻¹ B_i

is the mean square error at the test poses of one who reckons with what may be missing
(DuMouchel & Jones 1994, Technometrics 36, 37–47, there with D and π = 1).

**Scheduled.** The order says when each reading is made and from where each joint came, so that B
holds the columns of drift, warming and hysteresis too.  More parameters never lower Φ: the
certificate's bound holds for them as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from elastocal.cell.arm_description import EffectChoice
from elastocal.errors import InsufficientDataError
from elastocal.identification.knowledge import GaussianPrior
from elastocal.identification.start import fixed_and_free
from elastocal.measurements import STILL
from elastocal.model.arm import usual_sizes
from elastocal.model.effects.catalogue import CATALOGUE, SOMETHING
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.execution import Execution
from elastocal.planning.information import (
    PoseInformation,
    marker_sigmas,
    minimal_set,
    observed_weights,
)
from elastocal.planning.plan import Doubt, Gain, Plan, Scheduled, predicted, remaining_rms
from elastocal.planning.setup import Known, Setup, known_before
from elastocal.planning.test_poses import TargetPoses, known_rows, on_kept
from elastocal.simulation.simulate import expand_plan, simulate
from elastocal.units import Array

POSES = 100  # that show how far
SHOWN = 1.0  # standard deviation from 0 that all of these poses together would give it at least
# What a pose has only once it stands in an order.
OPEN = frozenset({"time", "temperature", "approach"})

Place = tuple[str, str]  # an effect and where it acts


def in_doubt(
    model: Model, known: Known, q: Array, probability: Mapping[Place, float] | None = None
) -> tuple[Model, Known, dict[Place, float]]:
    """The model with all that it may lack, what is known of it, and the places that count, with
    their probability: the prior of the parameters that it then has more, sized at some of the poses
    q (N, n).  Those that these do not show are held: no plan would lower what they add at the test
    poses.

    `probability` that an effect is missing at a place, where more is known of it than its share of
    SOMETHING; places that it does not name are not in doubt.
    """
    places = missing(model)
    if probability is None:
        of_each = Counter(name for name, _ in places)
        probability = {key: SOMETHING / (len(of_each) * of_each[key[0]]) for key in places}
    places = [key for key in places if probability.get(key, 0.0) > 0]
    if not places:
        return model, known, {}
    whole = model.with_effects((*model.cell.model.effects, *(EffectChoice(*key) for key in places)))
    every = np.arange(len(whole.parameters))
    information = PoseInformation(whole, whole.nominal, every, np.ones(len(every)))
    table = information.rows(q[:: -(-len(q) // POSES)])
    added = np.flatnonzero(~np.isin(whole.names, model.names))
    observed = observe(table, whole.observe)
    B = whole.regressor(table, whole.nominal, added, observed).B
    specs = [whole.parameters[k] for k in added]
    std = np.sqrt([probability[p.effect, p.where] for p in specs]) * usual_sizes(specs, B)
    whitened = observed_weights(whole, observed, whole.nominal).apply(B)
    shown = np.linalg.norm(whitened * std, axis=0) >= SHOWN
    unseen = tuple(p.name for p, seen in zip(specs, shown, strict=True) if not seen)
    prior, own = known.prior, [p for p, seen in zip(specs, shown, strict=True) if seen]
    names, mean = [p.name for p in own], [p.nominal for p in own]
    covariance = np.diag(std[shown] ** 2)
    if prior is not None:
        names, mean = [*prior.names, *names], [*prior.mean, *mean]
        covariance = linalg.block_diag(prior.covariance, covariance)
    both = GaussianPrior(tuple(names), np.array(mean), covariance) if names else None
    kept = {(p.effect, p.where): probability[p.effect, p.where] for p in own}
    return whole, replace(known, fixed=(*known.fixed, *unseen), prior=both), kept


def missing(model: Model) -> list[Place]:
    """Effects and places of the catalogue that the model lacks, but for what it needs an order of
    the poses to see, a search for the effect's constants, or belongs to the instrument."""
    chain, cell = model.chain, model.cell
    active = {(p.effect, p.where) for p in model.parameters}
    stated = cell.model.nominal.settings
    return [
        (name, where)
        for name, effect in CATALOGUE.items()
        if effect.may_be_missing(cell) and not effect.of_the_measurement
        if OPEN.isdisjoint(effect.needed(cell))
        for where in effect.places(chain, cell)
        if (name, where) not in active and effect.parameters(where, chain, cell)
        if all(
            s.default is not None or s.key in stated.get(where, {})
            for s in effect.settings(where, chain, cell)
        )
    ]  # fmt: skip


def gain_of(
    setup: Setup, known: Known, after: Array, places: Mapping[Place, float], seed: int
) -> Gain | None:
    """What a plan that leads to the information `after` (p, p) adds to the measurements done;
    effects at `places` are in doubt.  None without any measured, or without test poses."""
    done, information = known.done, setup.information
    if done is None or setup.target_rows is None:
        return None
    columns, sizes = information.columns, information.sizes
    at = [information.model.parameters[c] for c in columns]
    prior = known.prior
    variance = dict(zip(prior.names, np.diag(prior.covariance), strict=True)) if prior else {}
    doubts = []
    for place, p in places.items():
        own = np.array([k for k, a in enumerate(at) if (a.effect, a.where) == place], dtype=int)
        known_of = sizes[own] ** 2 / np.array([variance[at[k].name] for k in own])
        doubts.append(Doubt(p, own, (1 - p) * known_of))
    return Gain.of(setup.target_rows, setup.prior, after, doubts, done.pull[columns] * sizes, seed)


def clocked(execution: Execution) -> Execution:
    """With the time of each stop, in s from the beginning to the middle of its readings, and the
    sign of each joint's last motion on the way to it, 0 where it has not moved yet."""
    motion, now, stops = execution.motion, 0.0, []
    last = execution.stops[0].q if motion.home is None else motion.home
    sign = np.zeros(len(last), dtype=np.int64)
    for stop in execution.stops:
        for q in (*stop.via, stop.q):
            step = q - last
            sign = np.where(np.abs(step) > STILL, np.sign(step), sign).astype(np.int64)
            last = q
        now += stop.travel + (0.0 if stop.change_after is None else motion.load_change)
        came = sign if stop.approach is None else stop.approach
        stops.append(replace(stop, time=now + motion.dwell / 2, approach=came))
        now += motion.dwell
    return replace(execution, stops=tuple(stops))


@dataclass(frozen=True)
class ScheduledEffects:
    """The model `whole` with its effects of time and approach, of which `without` lacks some."""

    whole: Model
    without: Model

    def promised(self, plan: Plan, targets: TargetPoses, known: Known) -> Plan:
        """The plan with times and sides, and what it promises of all parameters."""
        model, spec = self.whole, self.whole.cell.design
        plan = replace(plan, model=model, execution=clocked(plan.execution))
        rows = expand_plan(plan.table(), tuple(model.cell.tool.markers), spec.repeats)
        x = model.nominal
        table = marker_sigmas(model.cell, simulate(model, rows, x, 0, noise=False))
        observed = observe(table, model.observe)
        at = model.regressor(table, x, None, observed)
        sizes = model.sizes(at.B)
        B = observed_weights(model, observed, x).apply(at.B) * sizes
        prior, stated = known_before(model, known, sizes)
        found = minimal_set(model, B, fixed_and_free(model, known.fixed), sizes, prior, stated)
        kept = found.columns
        M = B[:, kept].T @ B[:, kept] + prior[np.ix_(kept, kept)]
        own = np.isin([model.names[c] for c in kept], self.without.names)
        shown = predicted(model, found, M, len(B))
        names = dict.fromkeys(
            p.effect for p in model.parameters if p.name not in self.without.names
        )
        try:
            A = on_kept(model, known_rows(model, model, targets, x, found)[0], found)
        except InsufficientDataError:
            return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), None, None))
        weight = np.sqrt(targets.weight)[:, None, None]
        R = np.asarray((weight * A).reshape(-1, A.shape[-1]))
        errors = remaining_rms(R, M), remaining_rms(R[:, own], M[np.ix_(own, own)])
        return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), *errors))
