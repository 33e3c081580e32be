"""Whitened columns of the campaign so far and of every candidate, for one set of rivals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, packed_columns
from elastocal.diagnosis.noise import NoiseValues, covariance
from elastocal.diagnosis.result import Diagnosis
from elastocal.diagnosis.scene import Scene, scene_of
from elastocal.diagnosis.separate.noise import left_out, noise_found
from elastocal.diagnosis.separate.pool import Pool, joined
from elastocal.diagnosis.separate.rivals import RivalSet
from elastocal.diagnosis.separate.settings import imitations
from elastocal.diagnosis.separate.starts import columns_of_starts
from elastocal.manipulator.observation import observe

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Campaign:
    """Data so far and pool in one scene, whose first `measured` configurations are the data.

    `noise` is what the diagnosis found.
    """

    scene: Scene
    measured: int
    noise: NoiseValues

    @property
    def so_far(self) -> Scene:
        """The scene in which only the data so far count."""
        blocks = self.scene.blocks
        later = np.zeros(blocks.n, dtype=bool)
        members = blocks.member[self.measured :]
        later[members[members < blocks.n]] = True
        return replace(self.scene, data=self.scene.data.without(later | self.scene.data.faulty))


def campaign_of(
    base: Baseline, pool: Pool, hypotheses: list[Hypothesis], diagnosis: Diagnosis
) -> Campaign:
    """Columns of the data so far and of the pool at the fit, faulty readings left out.

    Candidates are read as precisely as the same marker was on average.
    """
    table = base.seen.table
    seen = observe(joined(table, pool.table), base.model.observe)
    n, size = len(base.seen.lead), seen.size
    stated = base.stated
    if stated is None:
        spread = base.residual.reshape(n, size).var(axis=0)
        stated = np.tile(np.diag(np.maximum(spread, 1e-18)), (n, 1, 1))
    marker = table.marker[base.seen.lead]
    usual = np.zeros((len(table.marker_names), size, size))
    usual[:] = stated.mean(axis=0)
    for k in np.unique(marker):
        usual[k] = stated[marker == k].mean(axis=0)
    later = seen.table.marker[seen.lead[n:]]
    whole = replace(
        base, seen=seen, stated=np.concatenate([stated, usual[later]]),
        residual=np.concatenate([base.residual, np.zeros(size * len(later))]), planned=len(later),
    )  # fmt: skip
    measured = len(np.unique(table.configuration[base.seen.lead]))
    scene = scene_of(whole, hypotheses).without(left_out(whole, diagnosis))
    return Campaign(scene, measured, noise_found(diagnosis))


@dataclass(frozen=True)
class Rows:
    """Whitened rows of one set of rivals.

    `gram` (w, w) = Wᵀ V⁻¹ W of the data so far, with the nuisance's prior precision; `pool`
    (N, m, w) = V^−½ W of each candidate; `response` (w,) = Wᵀ V⁻¹ r.  Columns W: the `nuisance`
    first ones are those of the fitted parameters and of the effects beside the rivals, then each
    rival's own, at `groups`, and at `imitations` those with which it may imitate others instead:
    at other settings or about other starts, each by itself.
    """

    gram: Array
    pool: Array
    response: Array
    nuisance: int
    groups: tuple[slice, ...]
    imitations: tuple[tuple[slice, ...], ...]


def rows_of(campaign: Campaign, contest: RivalSet) -> Rows:
    """Whiten the columns of `contest` by V = covariance of each configuration."""
    scene, data = campaign.scene, campaign.scene.data
    searched = imitations(campaign.so_far, campaign.noise, contest)
    beside = [_scaled(scene, item) for item in contest.beside]
    others = [
        [*(packed_columns(scene, i) for i in items), *columns_of_starts(scene, rival)]
        for rival, items in zip(contest.rivals, searched, strict=True)
    ]
    own = [packed_columns(scene, rival) for rival in contest.rivals]
    own = [data.masked(C) for C in [*own, *chain.from_iterable(others)]]
    nuisance = data.X.shape[2] + sum(C.shape[2] for C in beside)
    ends = nuisance + np.cumsum([0, *(C.shape[2] for C in own)])
    spans = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    W = np.concatenate(
        [data.masked(data.X), *beside, *own, data.masked(data.r)[:, :, None]], axis=2
    )
    white = np.linalg.solve(np.linalg.cholesky(covariance(data, campaign.noise)), W)
    so_far = white[: campaign.measured].reshape(-1, W.shape[2])
    gram = so_far.T @ so_far
    fitted = data.X.shape[2]
    gram[:fitted, :fitted] += np.diag(data.precision)
    gram[fitted:nuisance, fitted:nuisance] += np.eye(nuisance - fitted)
    n = len(contest.rivals)
    rest = iter(spans[n:])
    by = [tuple(islice(rest, len(each))) or (spans[b],) for b, each in enumerate(others)]
    return Rows(
        gram[:-1, :-1], white[campaign.measured :, :, :-1], gram[:-1, -1], nuisance,
        tuple(spans[:n]), tuple(by),
    )  # fmt: skip


def _scaled(scene: Scene, item: Item) -> Array:
    """Columns (C, m, k) of an item beside, per widest size of its prior."""
    return scene.data.masked(packed_columns(scene, item)) * float(item.scales.max())


def eliminated(gram: Array, nuisance: int) -> tuple[Array, Array]:
    """Schur complement of the nuisance in gram (w, w), and its inverse Gram (p, p)."""
    factor = linalg.cho_factor(gram[:nuisance, :nuisance])
    inverse = linalg.cho_solve(factor, np.eye(nuisance))
    cross = gram[:nuisance, nuisance:]
    return gram[nuisance:, nuisance:] - cross.T @ inverse @ cross, inverse
