"""The backlash model of an arm's gears: whether play follows load alone, or load and last motion.

A gear whose friction is small swings into the middle of its play, or onto the flank that any
load pushes it to; one that is stiff in its bearings stays where the last motion left it until the
load exceeds the friction.  Both are met, and the wrong one leaves most of the effect standing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import expit, ndtr

from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import columns_alone, with_keys
from elastocal.diagnosis.model_set import Item, ModelSet, fit_set
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, Projection, project
from elastocal.model.effects.play import Backlash
from elastocal.model.manipulator import Model
from elastocal.units import Array

EFFECT, BY_LOAD, BY_BOTH = Backlash.name, "load", "load_and_approach"
ALIKE = 1e-3  # nats: the rounding of two fits must not choose between models that predict the same


def with_likelier_backlash_model(dataset: DiagnosisData) -> DiagnosisData:
    """The data under the backlash model that its readings make likelier.

    Where no side of approach is recorded, the cell has play already, or no reading tells the two
    apart, it stays as it is.
    """
    model, noise = dataset.base.model, dataset.noise
    play = [h for h in dataset.hypotheses if h.name == EFFECT]
    if model.cell.model.play_side != BY_BOTH or not play:
        return dataset
    other = replace(dataset.base, model=under_other_backlash_model(model))
    columns = replace(dataset.columns, base=other, rows=dataset.columns.rows.copy())
    for h, own in zip(play, columns_alone(other, play), strict=True):
        columns.rows[:, :, columns.places[h.key]] = own
    # Of the fitted parameters none is of play: their columns are those they were.
    under_other = dataset.changed(base=other, columns=columns)
    here, there = (_likeliest(d, noise) for d in (dataset, under_other))
    if there.score <= here.score + ALIKE:
        return dataset.changed(other_backlash=doubt(here, there))
    return under_other.changed(other_backlash=doubt(there, here))


def under_other_backlash_model(model: Model) -> Model:
    """The model with play under the backlash model that it does not have."""
    by_load = model.cell.model.play_side == BY_LOAD
    return with_keys(model, play_side=BY_BOTH if by_load else BY_LOAD)


def _likeliest(dataset: DiagnosisData, noise: NoiseValues) -> ModelSet:
    """Play in the joint where it is likeliest, the noise fitted beside it."""
    play = [h for h in dataset.hypotheses if h.name == EFFECT]
    grams = Grams(dataset, dataset.data, project(dataset.data, noise))
    evidence = [float(grams.of(h).evidence(h.scales).max()) for h in play]
    likeliest = play[int(np.argmax(evidence))]
    return fit_set(dataset, (Item(likeliest, np.zeros(0), 0.0),), noise)


def doubt(better: ModelSet, other: ModelSet) -> float:
    """Probability of the less likely model: the larger of 1/(1 + exp Σ d) and Φ(−Σ d / √Σ d²).

    d (configurations,) is what each adds to the log likelihood ratio under the noise of `better`.
    Both models idealise what happens in the dead zone, so that one or two configurations there may
    speak loudly for the wrong one; by the test of Vuong (1989, Econometrica 57) for models of which
    none is quite true, their ratio counts against its own scatter.
    """
    others = _squares(other.data, project(other.data, better.noise))
    d = (others - _squares(better.data, better.at)) / 2
    odds, scatter = max(float(d.sum()), 0.0), max(float(np.linalg.norm(d)), 1e-300)
    return float(max(expit(-odds), ndtr(-odds / scatter)))


def _squares(data: NoisyData, at: Projection) -> Array:
    """eᵀV⁻¹e of each configuration (C,) with what the fit leaves, e = r − Xβ."""
    left = data.masked(data.r - data.X @ at.beta)
    return np.asarray((left * at.u).sum(axis=1))
