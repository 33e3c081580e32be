"""A set of additions to the model, with the noise that goes with it and its evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from elastocal.diagnosis.columns import is_driven
from elastocal.diagnosis.evidence import SCALES
from elastocal.diagnosis.generic import Generic
from elastocal.diagnosis.gram import Grams, scales_of
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.noise import NoiseValues, NoisyData, log_prior
from elastocal.diagnosis.noise_fit import fit_noise
from elastocal.diagnosis.projection import Projection, Weighted, project
from elastocal.diagnosis.scene import Scene

Array = NDArray[np.float64]

REFINED_ROUNDS = 3  # of settings that depend on each other


@dataclass(frozen=True)
class Item:
    """One addition: a hypothesis at its settings, or a block without a name.

    `log_prior` is the log of its prior odds, the search over its settings included.
    """

    what: Hypothesis | Generic
    settings: Array
    log_prior: float

    @property
    def known(self) -> bool:
        return isinstance(self.what, Hypothesis)

    @property
    def label(self) -> str:
        return self.what.label

    @property
    def scales(self) -> Array:
        return scales_of(self.what) if isinstance(self.what, Hypothesis) else SCALES

    @property
    def width(self) -> int:
        """Number of columns."""
        if isinstance(self.what, Hypothesis):
            return len(self.what.parameters)
        if self.what.columns is not None:
            return self.what.columns.shape[2]
        assert self.what.drive is not None
        return self.what.drive.shape[3]

    def same_as(self, other: Item) -> bool:
        return self.what is other.what


@dataclass(frozen=True)
class ModelSet:
    """Additions `items` to the fitted model, noise fitted beside them, and the log posterior.

    `score` = log evidence at the fitted noise, sizes mixed, + log prior of noise and items.
    `data` holds the items' columns at the best of their scales, `scales` (items,).
    """

    items: tuple[Item, ...]
    noise: NoiseValues
    data: NoisyData
    score: float
    scales: tuple[float, ...]

    @cached_property
    def at(self) -> Projection:
        return project(self.data, self.noise)

    @property
    def unknown(self) -> bool:
        return any(not item.known for item in self.items)

    @property
    def spans(self) -> tuple[slice, ...]:
        """Where each item's coefficients stand among those of the data, last of all."""
        return spans_of(self.items, self.data.X.shape[2])

    def without(self, k: int) -> tuple[Item, ...]:
        return self.items[:k] + self.items[k + 1 :]


def spans_of(items: tuple[Item, ...], total: int) -> tuple[slice, ...]:
    """Where the coefficients of `items` stand, the last of `total`."""
    ends = total - sum(item.width for item in items) + np.cumsum([i.width for i in items])
    return tuple(
        slice(int(end) - item.width, int(end)) for item, end in zip(items, ends, strict=True)
    )


def packed_columns(scene: Scene, item: Item) -> Array:
    """Columns (C, m, k) of an item, scaled to its typical sizes."""
    what = item.what
    if isinstance(what, Hypothesis):
        return scene.packed(what, item.settings)
    if what.columns is not None:
        return what.columns
    assert what.entry is not None and what.drive is not None
    E = scene.entry(what.entry)  # (C, m, d)
    drive = np.einsum("cmv,cvdk->cmdk", scene.places.one_hot, what.drive)
    return np.einsum("cmd,cmdk->cmk", E, drive)


def fit_set(scene: Scene, items: tuple[Item, ...], start: NoiseValues | None = None) -> ModelSet:
    """Fit the noise beside the items, twice where their best scale is not the typical one."""
    scales, noise = tuple(1.0 for _ in items), start
    joined = with_items(scene, items, scales)

    def at(scales: tuple[float, ...]) -> NoisyData:
        return replace(joined, precision=_precision(scene.data, items, scales))

    for _ in range(2):
        noise = fit_noise(at(scales), noise)
        weighted = Weighted.of(joined, noise)
        best, mixed = _mixed_scales(scene.data, weighted, items, scales)
        if best == scales:
            break
        scales = best
    assert noise is not None
    data = at(scales)
    mixed += _within_bounds(items, weighted.projection(data.precision))
    prior = sum(item.log_prior for item in items) - 0.5 * log_prior(scene.data.stated, noise)[0]
    return ModelSet(items, noise, data, mixed + prior, scales)


def _precision(data: NoisyData, items: tuple[Item, ...], scales: tuple[float, ...]) -> Array:
    """Of the coefficients of the data's columns and of the items'."""
    own = [np.full(item.width, 1 / s**2) for item, s in zip(items, scales, strict=True)]
    return np.concatenate([data.precision, *own])


def _within_bounds(items: tuple[Item, ...], at: Projection) -> float:
    """Σ log 2Φ(mean/deviation) over parameters that cannot be below their nominal zero.

    A compliance's size prior is one half of the Gaussian; the evidence gains or loses by the
    posterior's share of that half, each parameter taken by itself.
    """
    bounded = [
        isinstance(item.what, Hypothesis)
        and any(p.lower == p.nominal for p in item.what.parameters)
        for item in items
    ]
    if not any(bounded):
        return 0.0
    z = at.beta / np.linalg.norm(at.beta_deviation, axis=0)
    total = 0.0
    for item, span in zip(items, spans_of(items, len(z)), strict=True):
        if isinstance(item.what, Hypothesis):
            for p, share in zip(item.what.parameters, log_ndtr(z[span]), strict=True):
                total += float(np.log(2) + share) if p.lower == p.nominal else 0.0
    return total


def _mixed_scales(
    data: NoisyData, weighted: Weighted, items: tuple[Item, ...], scales: tuple[float, ...]
) -> tuple[tuple[float, ...], float]:
    """The best scale of each item, the others' at theirs, and the evidence with scales mixed.

    Scales of different items hardly depend on each other: the log of each one's mean over its
    scales, less its best, adds up.  Only the prior differs from scale to scale: `weighted`, the
    data with the items' columns, stays.
    """
    if not items:
        return scales, weighted.marginal(data.precision)
    spent = 0.0
    for k, item in enumerate(items):
        trials = [(*scales[:k], float(s), *scales[k + 1 :]) for s in item.scales]
        each = np.array([weighted.marginal(_precision(data, items, t)) for t in trials])
        scales, top = trials[int(np.argmax(each))], float(each.max())
        spent += float(logsumexp(each)) - np.log(len(each)) - top
    return scales, top + spent


def refine(scene: Scene, chosen: ModelSet, k: int) -> ModelSet:
    """Item k's settings refined between the grid's points, at the set's noise.

    One setting after the other; where there are several, they go round REFINED_ROUNDS times.
    """
    item = chosen.items[k]
    what = item.what
    if not isinstance(what, Hypothesis) or not is_driven(what) or not what.settings:
        return chosen
    data = beside(scene, chosen, k)
    grams = Grams(scene, data, project(data, chosen.noise))
    grid = scene.grids[what.name, what.where]

    def evidence(tried: Array) -> Array:
        return grams.of_hypothesis(what, tried).evidence(item.scales)

    settings, searched = item.settings, False
    widths = grid.step[grid.nearest(settings)]
    for _ in range(1 if len(settings) == 1 else REFINED_ROUNDS):
        for s, setting in enumerate(what.settings):
            if setting.kind == "change_time":
                trial = scene.moments[np.abs(scene.moments - settings[s]) <= widths[s]]
                if len(trial) <= 1 or len(scene.moments) == len(np.unique(grid.values[:, s])):
                    continue
                settings = _best_along(settings, s, trial, evidence)
            else:
                for width in widths[s] / 8.0 ** np.arange(3):
                    trial = settings[s] + np.linspace(-width, width, 21)
                    trial = np.clip(trial, setting.lower, setting.upper)
                    settings = _best_along(settings, s, trial, evidence)
            searched = True
    if not searched:
        return chosen
    refined = replace(item, settings=settings)
    return fit_set(scene, (*chosen.items[:k], refined, *chosen.items[k + 1 :]), chosen.noise)


def _best_along(settings: Array, s: int, trial: Array, evidence: Callable[[Array], Array]) -> Array:
    """The settings with number s at the best of the values `trial`, the others held."""
    tried = np.repeat(settings[None], len(trial), axis=0)
    tried[:, s] = trial
    return np.asarray(tried[int(np.argmax(evidence(tried)))])


def with_items(scene: Scene, items: tuple[Item, ...], scales: tuple[float, ...]) -> NoisyData:
    """The scene's data with the items' columns at the given scales."""
    if not items:
        return scene.data
    columns = np.concatenate([packed_columns(scene, item) for item in items], axis=2)
    p = len(scene.data.precision)
    return scene.data.with_columns(columns, _precision(scene.data, items, scales)[p:])


def beside(scene: Scene, chosen: ModelSet, k: int) -> NoisyData:
    """The set's data without item k."""
    return with_items(scene, chosen.without(k), chosen.scales[:k] + chosen.scales[k + 1 :])
