"""Marginal likelihood of groups of columns in closed form, and priors fixed before any data."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.special import logsumexp

from elastocal.diagnosis.baseline import Blocks, NoiseValues, NoisyData, Projection, project
from elastocal.diagnosis.diagnosis import SMALLEST_P
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic
from elastocal.diagnosis.hypotheses import ANY_SCALES, NO_SETTINGS, SCALES, EntryKey, Hypothesis
from elastocal.model.evaluate import ahead, row_blocks
from elastocal.units import Array

# With columns C scaled to their typical sizes, γ ~ N(0, s² I) and everything else integrated out,
#
#     log ev(s) = −½ log|I + s²A| + ½ s² bᵀ(I + s²A)⁻¹ b,   A = CᵀPC,   b = CᵀPr,
#
# over the model without the group; s is mixed over SCALES with equal weights (a size prior with
# heavier tails than one Gaussian).  In the eigenvectors U of A, with β = Uᵀb:
#
#     log ev(s) = ½ Σ_k [s²β_k² / (1 + s²λ_k) − log(1 + s²λ_k)].


@dataclass(frozen=True)
class Spectrum:
    """V groups of K columns: eigenvalues `lam` (V, K) of A, and `beta` (V, K, T) = Uᵀb of T
    residuals, the readings' own first, then those whose configurations had their signs flipped."""

    lam: Array
    beta: Array

    @classmethod
    def of(cls, A: Array, b: Array) -> Spectrum:
        """Of Gram matrices A (V, K, K) and b (V, K, T)."""
        lam, U = np.linalg.eigh(A)
        # Rounding leaves a tiny β along directions that P removes altogether.
        seen = lam > 1e-9 * np.abs(lam).max(axis=1, keepdims=True, initial=1e-300)
        beta = U.transpose(0, 2, 1) @ b
        beta[~seen] = 0.0
        return cls(lam * seen, beta)

    def explained(self, scale: float) -> Array:
        """What each group takes off eᵀPe, its coefficients γ charged with |γ|²/scale² (V,)."""
        squared = scale**2
        return np.asarray((squared * self.beta[..., 0] ** 2 / (1 + squared * self.lam)).sum(axis=1))

    def evidence(self, scales: Array = SCALES) -> Array:
        """Log evidence (V,) of the readings over the model without the group."""
        each = at_scales(self.lam, self.beta[..., :1], scales)[..., 0]
        return log_sum(each, axis=1) - np.log(len(scales))

    def mixed(self, scales: Array, log_prior: Array) -> tuple[Array, Array]:
        """Log evidence of each residual (T,) by all groups, of prior probabilities (V,), and of the
        readings' by each group with its prior (V,)."""
        of_all, own = list[Array](), list[Array]()
        for some in row_blocks(len(self.lam), AT_ONCE):
            each = at_scales(self.lam[some], self.beta[some], scales)
            each += (log_prior[some] - np.log(len(scales)))[:, None, None]
            of_all.append(log_sum(each.reshape(-1, each.shape[2]), axis=0))
            own.append(log_sum(each[..., 0]))
        return reduce(np.logaddexp, of_all), np.concatenate(own)


# Beyond the flips the tail of a log evidence: e nats more are at most exp(−e) times as frequent,
# since the evidence's ratio has the mean 1 under the noise (Markov's inequality); where the flips
# spread more widely than that, as they do about a noise that does not fit, their own mean excess
# counts.  Of the n largest, whose mean excess over the next one is m, the next is predicted to
# exceed it by y with probability (1 + y/nm)^−n: the exponential tail, its scale not known better
# than n excesses tell (a tail as in Knijnenburg et al. 2009, Bioinformatics 25, of shape zero).

TAIL = 0.25  # share of the flips that shows it
AT_ONCE = 128  # groups whose evidence of as many flips stays in cache


def exceedance(flipped: Array, observed: float) -> float:
    """p-value of the log evidence `observed` among what the flips (F,) yield, itself counted as
    one of them; where none of them reaches it, by their tail, SMALLEST_P at least."""
    beyond, F = int((flipped >= observed).sum()), len(flipped)
    counted = (1 + beyond) / (1 + F)
    n = int(TAIL * F)
    if beyond or not n:
        return counted
    top = np.sort(flipped)[-n - 1 :]
    mean = max(float((top[1:] - top[0]).mean()), 1.0)
    by_tail = n / (1 + F) * (1 + (observed - float(top[0])) / (n * mean)) ** -n
    return max(min(counted, by_tail), SMALLEST_P)


def at_scales(lam: Array, beta: Array, scales: Array) -> Array:
    """Log evidence (V, S, F) at each of the scales, from eigenvalues (V, K) and β (V, K, F)."""
    squared = scales[:, None] ** 2
    shrunk = squared * lam[:, None, :]
    each = (0.5 * squared / (1 + shrunk)) @ np.square(beta)
    each -= 0.5 * np.log1p(shrunk).sum(axis=2)[:, :, None]
    return np.asarray(each)


def log_sum(values: Array, axis: int = -1) -> Array:
    top = values.max(axis=axis, keepdims=True)
    each = values - top
    return np.asarray(np.log(np.exp(each, out=each).sum(axis=axis)) + top.squeeze(axis))


def evidence_of_groups(
    groups: Sequence[tuple[Array, Array]], scales: Array, scalings: Sequence[Array] | None = None
) -> list[float]:
    """Log evidence of each group of columns by its A (k, k) and b (k,), times its `scalings`
    (L, k) where given, at the best of these."""
    # Those of one width at once: hundreds of tiny decompositions cost a call each.
    of_width = defaultdict[int, list[tuple[int, Array, Array]]](list)
    for n, (A, b) in enumerate(groups):
        for d in np.ones((1, len(b))) if scalings is None else scalings[n]:
            of_width[len(b)].append((n, A * d * d[:, None], b * d))
    best = np.full(len(groups), -np.inf)
    for same in of_width.values():
        of, A, b = (np.array(each) for each in zip(*same, strict=True))
        np.maximum.at(best, of, Spectrum.of(A, b[..., None]).evidence(scales))
    return best.tolist()


# Probability that anything is missing; of that a twentieth that the catalogue lacks it, else it is
# each effect in equal shares, at each of its places.  A second effect beside a first is rarer.
SOMETHING, UNKNOWN, ANOTHER = 0.5, 0.05, 0.2


def log_prior_odds(
    hypotheses: Sequence[Hypothesis], blocks: Sequence[Generic], something: float = SOMETHING
) -> Array:
    """Log prior odds against nothing, of each hypothesis and then of each block.  Effects are
    equally probable, and so are the places of one effect; kinds of blocks are equally probable, and
    so are the blocks of one kind."""
    shares: list[float] = []
    for names, whole in (
        ([h.name for h in hypotheses], 1 - UNKNOWN), ([g.kind for g in blocks], UNKNOWN),
    ):  # fmt: skip
        count = Counter(names)
        shares += [1 / (len(count) * count[name]) * whole for name in names]
    return np.asarray(np.log(something / (1 - something) * np.array(shares)))


# Gram matrices of regressor directions at an entry of the chain, without forming columns.
#
# Columns of a driven group are C = E ∘ D: the entry's columns E (N, size, d), the same motion in
# all readings of a visit, times the visit's regressor direction D (d, k).  So
#
#     CᵀV⁻¹C = Σ_blocks Σ_{v,w} D_vᵀ (E_vᵀV⁻¹E_w) D_w,
#     HᵀC = Σ_v (H_vᵀE_v) D_v,   CᵀPr = Σ_v D_vᵀ E_vᵀu
#
# and a search over thousands of directions costs a few products of matrices, all of them at once.
# Where D is the same in all visits of a configuration, the sums over visits come first.


# Signs (F, C) of ±1 by which the configurations of a residual (C, m) are flipped.  It scatters as
# the noise does and holds no effect that has been found; everything that is tried is scored against
# it beside the same columns as against the readings.
Flips = tuple[Array, Array]


class SignedResiduals(NamedTuple):
    """T residuals that differ by the `signs` (T, C) of their configurations: P times one is s V⁻¹e
    − H h, with `of` V⁻¹e (C, m), or its products (C, …) with an entry's motions, and h (T, p)."""

    signs: Array
    of: Array
    h: Array

    def along(self, columns: Array, Z: Array) -> Array:
        """b (g, T) of columns (C, n, g), Z (p, g) = Hᵀ of them; `of` is (C, n)."""
        own = np.einsum("cn,cng->gc", self.of.reshape(columns.shape[:2]), columns)
        return own @ self.signs.T - Z.T @ self.h.T


def residuals_of(at: Projection, flips: Flips | None = None) -> tuple[SignedResiduals, ...]:
    """The readings', which is P r already, and the flipped ones where they are asked for."""
    C, _, p = at.H.shape
    own = SignedResiduals(np.ones((1, C)), at.u, np.zeros((1, p)))
    if flips is None:
        return (own,)
    signs, e = flips[0], flips[1][..., None]
    h = signs @ (at.H.transpose(0, 2, 1) @ e)[..., 0]
    return own, SignedResiduals(signs, (at.inverse @ e)[..., 0], h)


@dataclass(frozen=True)
class EntrySums:
    """Of one entry under one noise: `local` (C, v, d, v, d), `H` (p, C, v, d), and the residuals
    `of` its motions (C, v, d)."""

    local: Array
    H: Array
    residuals: tuple[SignedResiduals, ...]

    @classmethod
    def of(
        cls, E: Array, blocks: Blocks, at: Projection, residuals: Sequence[SignedResiduals]
    ) -> EntrySums:
        """E (C, m, d): the entry's packed columns, zero in rows that do not count."""
        C, m, d = E.shape
        v = blocks.in_visit.shape[2]
        wide = (blocks.in_visit[:, :, :, None] * E[:, :, None, :]).reshape(C, m, v * d)
        local = wide.transpose(0, 2, 1) @ (at.inverse @ wide)
        H = np.ascontiguousarray((at.H.transpose(0, 2, 1) @ wide).transpose(1, 0, 2))  # (p, C, v·d)
        own = (r._replace(of=np.einsum("cmk,cm->ck", wide, r.of)) for r in residuals)
        return cls(
            local.reshape(C, v, d, v, d), H.reshape(-1, C, v, d),
            tuple(r._replace(of=r.of.reshape(C, v, d)) for r in own),
        )._by_fewest  # fmt: skip

    @property
    def _by_fewest(self) -> EntrySums:
        """The same by no more rows of H than it has columns: only HᵀH and hH count."""
        H = self.H.reshape(len(self.H), -1)
        if len(H) <= H.shape[1]:
            return self
        Q, R = np.linalg.qr(H)
        turned = tuple(r._replace(h=r.h @ Q) for r in self.residuals)
        return replace(self, H=R.reshape(-1, *self.H.shape[1:]), residuals=turned)

    @cached_property
    def _of_configurations(self) -> EntrySums:
        return EntrySums(
            self.local.sum(axis=(1, 3), keepdims=True), self.H.sum(axis=2, keepdims=True),
            tuple(r._replace(of=r.of.sum(axis=1, keepdims=True)) for r in self.residuals),
        )._by_fewest  # fmt: skip

    def each(
        self, n: int, width: int, directions: Callable[[slice], Array], threads: int = 1
    ) -> Spectrum:
        """Spectrum of n groups, for so many of which at a time `directions` are asked as are HELD
        numbers, of `width` columns each."""
        step = max(1, HELD // (self.H[0].size * width))
        D = (directions(slice(k, k + step)) for k in range(0, n, step))
        parts = list(ahead(lambda some: Spectrum.of(*self.products(some)), D, threads))
        lam, beta = (np.concatenate([getattr(s, k) for s in parts]) for k in ("lam", "beta"))
        return Spectrum(lam, beta)

    def alike(self, F: Array) -> Spectrum:
        """Spectrum of one group in which all motions follow the same functions F (C, v, f)."""
        (p, _, _, d), (C, v, f) = self.H.shape, F.shape
        k = d * f
        moved = (self.local.transpose(0, 1, 2, 4, 3) @ F[:, None, None]).reshape(C * v, -1)
        A = (F.reshape(-1, f).T @ moved).reshape(f, d, k).swapaxes(0, 1).reshape(k, k)
        Z = (F.reshape(-1, f).T @ self.H.reshape(p, C * v, d)).swapaxes(1, 2).reshape(p, k)
        along = (r.of.swapaxes(1, 2) @ F for r in self.residuals)
        b = [r.signs @ own.reshape(C, k) - r.h @ Z
             for r, own in zip(self.residuals, along, strict=True)]  # fmt: skip
        return Spectrum.of((A - Z.T @ Z)[None], np.concatenate(b).T[None])

    def steps(self, time: Array, moments: Array) -> Spectrum:
        """Spectrum of all motions from each of the `moments` (M,) on, which ascend, visits being at
        `time` (C, v), −∞ where there is none: sums of what comes later, not columns of each."""
        both, step = np.minimum(time[:, :, None], time[:, None]), max(1, HELD // self.H[0].size)
        A = _later(moments, both, self.local.transpose(0, 1, 3, 2, 4))
        for H in (self.H[k : k + step] for k in range(0, len(self.H), step)):
            Z = _later(moments, time, H.transpose(1, 2, 0, 3))
            A -= Z.swapaxes(1, 2) @ Z
        return Spectrum.of(A, _later(moments, time, self.residuals[0].of)[..., None])

    @cached_property
    def _against(self) -> Array:
        """P times the residuals along one motion of each configuration (C, T)."""
        H = self.H.reshape(len(self.H), -1)
        each = ((r.of.reshape(1, -1) * r.signs - r.h @ H).T for r in self.residuals)
        return np.concatenate([*each], axis=1)

    def products(self, D: Array) -> tuple[Array, Array]:
        """A (V, k, k) and b (V, k, T) of the groups with directions D (C, v, d, V, k), or
        (C, 1, d, V, k) where they are the same in all visits of a configuration."""
        if D.shape[1] < self.local.shape[1]:
            return self._of_configurations.products(D)
        C, v, d, V, k = D.shape
        n = v * d
        flat = D.reshape(C, n, V * k)
        local = self.local.reshape(C, n, n)
        moved = local * flat if n == 1 else local @ flat
        Z = self.H.reshape(-1, C * n) @ flat.reshape(C * n, V * k)
        A = _each_with_each(flat.reshape(-1, V, k), moved.reshape(-1, V, k))
        A -= _each_with_each(Z.reshape(-1, V, k), Z.reshape(-1, V, k))
        if n == 1:
            return A, (flat[:, 0].T @ self._against).reshape(V, k, -1)
        b = np.concatenate([r.along(flat, Z) for r in self.residuals], axis=1)
        return A, b.reshape(V, k, -1)


def _later(moments: Array, when: Array, values: Array) -> Array:
    """Σ (M, …) of the values (*when.shape, …) that are there from each of the moments on."""
    n, at = when.size, np.searchsorted(moments, when.ravel(), side="right")
    between = sparse.csr_array((np.ones(n), (at, np.arange(n))), shape=(len(moments) + 1, n))
    sums = (between @ values.reshape(n, -1))[:0:-1].cumsum(axis=0)[::-1]
    return np.asarray(sums.reshape(len(moments), *values.shape[when.ndim :]))


def _each_with_each(a: Array, b: Array) -> Array:
    """Σ_r a_rvk b_rvl (V, K, K) of a and b (R, V, K)."""
    return np.asarray(a.transpose(1, 2, 0) @ b.transpose(1, 0, 2))


def direct(C: Array, at: Projection, residuals: Sequence[SignedResiduals] = ()) -> Spectrum:
    """Spectrum of one group of packed columns C (blocks, m, k), zero in rows that do not count."""
    k = C.shape[2]
    A = C.reshape(-1, k).T @ (at.inverse @ C).reshape(-1, k)
    Z = at.H.reshape(-1, at.H.shape[2]).T @ C.reshape(-1, k)
    b = np.concatenate([r.along(C, Z) for r in residuals or residuals_of(at)], axis=1)
    return Spectrum.of((A - Z.T @ Z)[None], b[None])


# Numbers of regressor directions that are held at a time: with more of them the sums over thousands
# of visits wait for memory.
HELD = 100_000


@dataclass
class Grams:
    """Spectra against `data` under the noise of its projection `at`, and against any `flips`."""

    dataset: DiagnosisData
    data: NoisyData
    at: Projection
    flips: Flips | None = None
    _entries: dict[EntryKey, EntrySums] = field(init=False, default_factory=dict)

    @cached_property
    def _residuals(self) -> tuple[SignedResiduals, ...]:
        return residuals_of(self.at, self.flips)

    def entry(self, key: EntryKey) -> EntrySums:
        if key not in self._entries:
            E = self.data.masked(self.dataset.entry(key))
            self._entries[key] = EntrySums.of(E, self.data.blocks, self.at, self._residuals)
        return self._entries[key]

    def of(self, what: Hypothesis | Generic, settings: Array | None = None) -> Spectrum:
        """A block, or a hypothesis at all `settings` (G, …), by default those of the search."""
        dataset = self.dataset
        if isinstance(what, Generic) and what.entry and what.functions is not None:
            return self.entry(what.entry).alike(what.functions)
        if isinstance(what, Generic) or not what.driven:
            return direct(self.data.masked(dataset.packed(what)), self.at, self._residuals)
        tried = dataset.grids[what.key].values if settings is None else settings
        return self.entry(what.entry_key(dataset.base.model)).each(
            len(tried), what.width, lambda some: dataset.direction(what, tried[some]),
            self.data.threads,
        )  # fmt: skip

    def estimates(self, what: Hypothesis, settings: Array, scale: float) -> Array:
        """Posterior means (G, k) of a driven hypothesis at each of the `settings` (G, …), its
        coefficients of this `scale` beforehand."""
        D = self.dataset.direction(what, settings)
        A, b = self.entry(what.entry_key(self.dataset.base.model)).products(D)
        return np.asarray(np.linalg.solve(A + np.eye(what.width) / scale**2, b[..., :1]))[..., 0]


@dataclass(frozen=True)
class Item:
    """One addition: a hypothesis at its settings, or a block without a name.  `log_prior` is the
    log of its prior odds, the search over its settings included."""

    what: Hypothesis | Generic
    settings: Array
    log_prior: float

    @property
    def known(self) -> bool:
        return self.what.known


LARGE = 5.0  # nats by which an effect has to be likelier where it may be of any size


class Scan:
    """Everything scored under one `noise` beside the columns in `data`, where `something` is
    missing with this probability, and the odds of all together.

    `items` are hypotheses, then blocks, each at its best settings, of log posterior `scores` (W,)
    over the model without it, up to what they share; `distance` (W,) is what a typical size moves
    the data there, √tr A, in standard deviations.  `odds` (1 + F,) is the log of the mean evidence
    over catalogue and blocks, weighted by prior, of the readings and of residuals whose
    configurations had their signs flipped, and `covariates` (1 + F,) the largest evidence among the
    blocks of each; `marginal` the log marginal likelihood without them.  `large` says whether an
    effect that may be of any size is likelier to be far larger than usual."""

    def __init__(
        self, dataset: DiagnosisData, generic: list[Generic], something: float, data: NoisyData,
        noise: NoiseValues, flips: Flips | None = None,
    ) -> None:  # fmt: skip
        prior = log_prior_odds(dataset.hypotheses, generic, something)
        grams = Grams(dataset, data, project(data, noise), flips)
        items, distance, rows = list[Item](), list[float](), list[Array]()
        self.large, self.covariates = False, dict[str, Array]()
        whats: tuple[Hypothesis | Generic, ...] = (*dataset.hypotheses, *generic)
        for what, w in zip(whats, prior.tolist(), strict=True):
            grid, spectra = dataset.grids.get(what.key, NO_SETTINGS), grams.of(what)
            evidence, own = spectra.mixed(what.scales, grid.log_prior)
            k = int(np.argmax(own))
            rows.append(evidence)
            # What the search over settings costs stays with the item.
            spent = float(evidence[0] - own[k] + grid.log_prior[k])
            items.append(Item(what, grid.values[k], w + spent))
            distance.append(float(np.sqrt(spectra.lam[k].sum())))
            if isinstance(what, Hypothesis):
                if what.effect.any_size:
                    usual, any_size = (spectra.evidence(s).max() for s in (what.scales, ANY_SCALES))
                    self.large |= bool(any_size > usual + LARGE)
            else:
                largest = self.covariates.get(what.covariate, evidence)
                self.covariates[what.covariate] = np.maximum(largest, evidence)
        scores = prior[:, None] + np.array(rows)
        self.items, self.scores, self.distance = tuple(items), scores[:, 0], np.array(distance)
        self.odds = log_sum(scores, axis=0) - float(logsumexp(prior))
        self.marginal, self.noise = grams.at.marginal, noise

    @property
    def chance(self) -> float:
        return exceedance(self.odds[1:], float(self.odds[0]))
