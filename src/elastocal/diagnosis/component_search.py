"""The search for all components at once, their shares of the gap, and what they are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from elastocal.diagnosis.component_families import (
    catalogue_components,
    fields,
    joint_curves,
    judged_together,
    lines,
)
from elastocal.diagnosis.components import Component, FittedSum, Sizes, fit_sum
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.model_set import ModelSet, packed_columns
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, Projection, project
from elastocal.units import Array, Progress

SEARCHES = 3  # for lines and fields beside what has been found
MOST_FIELDS = 4  # that one search adds


def search_components(
    dataset: DiagnosisData, chosen: ModelSet, progress: Progress = lambda message: None
) -> FittedSum:
    """The most probable sum beside the fitted parameters.

    `chosen` is what the forward search found: its searched constants are tried as they are.
    """
    full = _with_together(dataset)
    data = with_equal_noise(full)
    noise = chosen.noise.of_instrument() if data.stated else _started(data)
    components = [*joint_curves(full), *catalogue_components(full), *_searched(full, chosen)]
    progress(f"sizes of {len(components)} components at once")
    found = fit_sum(data, components, noise)
    for _ in range(SEARCHES):
        progress("lines and fields beside the components")
        more = lines(full, found.data, found.noise, found.components)
        more += fields(full, found.data, found.noise, found.components, MOST_FIELDS)
        if not more:
            break
        start = found.sizes
        for component in more:
            start = start.and_one(component)
        wider = fit_sum(data, [*found.components, *more], found.noise, start)
        if wider.score <= found.score + 0.5:
            break
        found = wider
    return found


def _with_together(dataset: DiagnosisData) -> DiagnosisData:
    """The data with the columns of effects that are judged in the sum alone."""
    base = dataset.base
    more = judged_together(base.model, base.observed.table)
    if not more:
        return dataset
    full = diagnosis_data_of(base, [*dataset.hypotheses, *more])
    return full.without(dataset.data.faulty)


def _searched(dataset: DiagnosisData, chosen: ModelSet) -> list[Component]:
    """What the forward search found at settings of its own."""
    found = []
    for item in chosen.items:
        if item.known and len(item.settings):
            h = item.what
            pairs = zip((s.key for s in h.settings), item.settings.tolist(), strict=True)
            found.append(
                Component("time", h.effect, h.where, packed_columns(dataset, item),
                          settings=tuple(pairs), hypothesis=h)
            )  # fmt: skip
    return found


def with_equal_noise(dataset: DiagnosisData) -> NoisyData:
    """The data; where no noise is stated, with the same variance along all axes.

    Its shape else is that of the residual, which the missing effects make and no instrument.
    """
    data = dataset.data
    if data.stated:
        return data
    size = dataset.blocks.size
    variance = np.diagonal(dataset.base.covariance[0]).copy()
    variance[:3] = variance[:3].mean()
    variance[3:] = variance[3:].mean() if size > 3 else 0.0
    equal = np.tile(np.diag(variance[:size]), (dataset.blocks.n, 1, 1))
    return replace(data, covariance=dataset.blocks.pack_square(equal))


def _started(data: NoisyData) -> NoiseValues:
    return replace(NoiseValues.usual(data.G.shape[2]).of_instrument(), factor=0.3)


# How large each component is: posterior draws of what it does to the markers.

DRAWS = 400


@dataclass(frozen=True)
class Shares:
    """Of each component: `share` of the gap's mean square (draws, K), and `square` in m² (draws,
    K) per reading, once the fitted parameters have followed; `total` (draws,) of all together."""

    share: Array
    square: Array
    total: Array


def shares_of(found: FittedSum, rng: np.random.Generator) -> Shares:
    """Draws of the components' sizes from the posterior.

    What geometry takes up is no part of the gap: with Q the projection off the fitted columns X,
    at equal weights, a component C w leaves |Q C w|², and its share is that over |Q Σ C w|².
    """
    data = found.data
    at = project(data, found.noise)
    p = data.X.shape[2] - sum(c.width for c in found.components)
    draws = at.beta[:, None] + at.beta_deviation.T @ rng.normal(size=(len(at.beta), DRAWS))
    position = _position_rows(data)
    X = data.masked(data.X)[position]
    size = np.linalg.norm(X[:, :p], axis=0)
    Q, R = linalg.qr(X[:, :p] / np.maximum(size, 1e-300), mode="economic", pivoting=False)
    keep = np.abs(np.diag(R)) > 1e-9
    Q = Q[:, keep]
    C = X[:, p:] - Q @ (Q.T @ X[:, p:])
    readings = len(X) / min(data.blocks.size, 3)
    G = C.T @ C / readings
    squares, w = [], draws[p:]
    for span in found.spans:
        own = slice(span.start - p, span.stop - p)
        squares.append(np.einsum("kd,kl,ld->d", w[own], G[own, own], w[own], optimize=True))
    total = np.einsum("kd,kd->d", w, G @ w)
    square = np.array(squares).T
    return Shares(square / np.maximum(total, 1e-300)[:, None], square, total)


def _position_rows(data: NoisyData) -> Array:
    """Rows (C, m) that count and are positions (or distances)."""
    size = data.blocks.size
    of_size = np.arange(data.r.shape[1]) % size < 3
    return ~data.left_out & of_size[None, :]
