"""Effects that the model may lack, as parameters with a prior: what a robust plan shows as well.

The model is given every effect of the catalogue that poses and loads can show, at every place; each
parameter of them has mean 0 and variance π s², π the probability that the effect is missing and s
its typical size.  Of what is known beforehand the best linear estimate asks these two moments only
(Goldstein & Wooff 2007, Bayes Linear Statistics, ch. 3), so that

    tr(C M⁻¹),   M = diag(0, 1/(π s²)) + Σ_i B_iᵀ Σ_i⁻¹ B_i

is the mean square error at the test poses of one who reckons with what may be missing; who judges
every effect by its evidence does no worse.  A plan that makes it small determines the model's own
parameters, and tells the effects from them and from each other as far as the test poses ask for it.

Source: DuMouchel & Jones 1994, Technometrics 36, 37–47, there with D and π = 1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import linalg

from elastocal.cell.arm_description import EffectChoice
from elastocal.identification.knowledge import GaussianPrior
from elastocal.model.arm import usual_sizes
from elastocal.model.effects.catalogue import CATALOGUE, SOMETHING
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.information import PoseInformation, observed_weights
from elastocal.planning.plan import Doubt, Gain
from elastocal.planning.setup import Known, Setup
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
