"""Marginal likelihood of groups of columns in closed form, and priors fixed before any data."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from elastocal.diagnosis.baseline import Blocks
from elastocal.diagnosis.diagnosis import SMALLEST_P
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic
from elastocal.diagnosis.hypotheses import NO_SETTINGS, SCALES, EntryKey, Hypothesis
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, Projection, project
from elastocal.model.effects.catalogue import SOMETHING
from elastocal.model.evaluate import ahead
from elastocal.units import Array

# Marginal likelihood of a group of columns in closed form.
#
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
    """V groups of K columns: eigenvalues `lam` (V, K) of A, `beta` (V, K) = Uᵀb, and `flips`
    (V, K, F): β of residuals whose configurations had their signs flipped, F = 0 unless asked
    for."""

    lam: Array
    beta: Array
    flips: Array

    @property
    def distance(self) -> Array:
        """d (V,): what the group's typical size moves the data, √tr A, in standard deviations."""
        return np.sqrt(self.lam.sum(axis=1))

    def explained(self, scale: float) -> Array:
        """What each group takes off eᵀPe, its coefficients γ charged with |γ|²/scale² (V,)."""
        squared = scale**2
        return np.asarray((squared * self.beta**2 / (1 + squared * self.lam)).sum(axis=1))

    def evidence(self, scales: Array = SCALES) -> Array:
        """Log evidence (V,) over the model without the group."""
        return evidence_of(self.lam, self.beta, scales)

    def flipped(self, log_prior: Array, scales: Array = SCALES) -> Array:
        """Log evidence (W, F) of the residuals with flipped signs: of W hypotheses, whose V/W
        groups stand one after the other and are weighed by `log_prior` (W, V/W)."""
        each = at_scales(self.lam, self.flips, scales)
        each = each.reshape(*log_prior.shape, *each.shape[1:])
        each += (log_prior - np.log(len(scales)))[:, :, None, None]
        top = each.max(axis=(1, 2))
        each -= top[:, None, None]
        return np.asarray(top + np.log(np.exp(each, out=each).sum(axis=(1, 2))))


# Beyond the flips the tail of a log evidence: e nats more are at most exp(−e) times as frequent,
# since the evidence's ratio has the mean 1 under the noise (Markov's inequality); where the flips
# spread more widely than that, as they do about a noise that does not fit, their own mean excess
# counts.  Of the n largest, whose mean excess over the next one is m, the next is predicted to
# exceed it by y with probability (1 + y/nm)^−n: the exponential tail, its scale not known better
# than n excesses tell (a tail as in Knijnenburg et al. 2009, Bioinformatics 25, of shape zero).

TAIL = 0.25  # share of the flips that shows it


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


def evidence_of(lam: Array, beta: Array, scales: Array) -> Array:
    """Log evidence (V,) from eigenvalues and β (V, K); mixed over `scales` (S,)."""
    return log_sum(at_scales(lam, beta[..., None], scales)[..., 0]) - np.log(len(scales))


def at_scales(lam: Array, beta: Array, scales: Array) -> Array:
    """Log evidence (V, S, F) at each of the scales, from eigenvalues (V, K) and β (V, K, F)."""
    squared = scales[:, None] ** 2
    shrunk = squared * lam[:, None, :]
    each = (0.5 * squared / (1 + shrunk)) @ np.square(beta)
    each -= 0.5 * np.log1p(shrunk).sum(axis=2)[:, :, None]
    return np.asarray(each)


def log_sum(values: Array, axis: int = -1) -> Array:
    top = values.max(axis=axis, keepdims=True)
    return np.asarray(np.log(np.exp(values - top).sum(axis=axis)) + top.squeeze(axis))


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
    for k, same in of_width.items():
        of, A, b = (np.array(each) for each in zip(*same, strict=True))
        found = spectrum(A, b, np.zeros((len(b), k, 0)))
        np.maximum.at(best, of, found.evidence(scales))
    return best.tolist()


def spectrum(A: Array, b: Array, flips: Array) -> Spectrum:
    """Of Gram matrices A (V, K, K), b (V, K) and those of flipped residuals (V, K, F)."""
    lam, U = np.linalg.eigh(A)
    back = U.transpose(0, 2, 1)
    beta, flips = (back @ b[..., None])[..., 0], back @ flips
    # Rounding leaves a tiny β along directions that P removes altogether.
    gone = lam <= 1e-9 * np.abs(lam).max(axis=1, keepdims=True, initial=1e-300)
    flips[gone] = 0.0
    return Spectrum(np.where(gone, 0.0, lam), np.where(gone, 0.0, beta), flips)


# Prior probabilities, fixed before any data: nothing, something unknown, or a known effect.

# SOMETHING that anything is missing; of that a twentieth that the catalogue lacks it.
# A second effect beside a first is rarer.
UNKNOWN, ANOTHER = 0.05, 0.2


def log_prior_odds(
    hypotheses: Sequence[Hypothesis], blocks: Sequence[Generic], something: float = SOMETHING
) -> Array:
    """Log prior odds against nothing, of each hypothesis and then of each block.

    Effects are equally probable, and so are the places of one effect; kinds of blocks are equally
    probable, and so are the blocks of one kind.
    """
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


@dataclass(frozen=True)
class EntrySums:
    """Of one entry under one noise: `local` (C, v, d, v, d), `H` (p, C, v, d), `b` (C, v, d).

    `flip` (C, v, d) and `h` (F, p) are of the residual that is flipped by `signs` (F, C).
    """

    local: Array
    H: Array
    b: Array
    signs: Array
    flip: Array
    h: Array

    @classmethod
    def of(cls, E: Array, blocks: Blocks, at: Projection, flips: Flips | None = None) -> EntrySums:
        """E (C, m, d): the entry's packed columns, zero in rows that do not count."""
        C, m, d = E.shape
        v = blocks.in_visit.shape[2]
        wide = (blocks.in_visit[:, :, :, None] * E[:, :, None, :]).reshape(C, m, v * d)
        local = wide.transpose(0, 2, 1) @ (at.inverse @ wide)
        H = np.ascontiguousarray((at.H.transpose(0, 2, 1) @ wide).transpose(1, 0, 2))  # (p, C, v·d)
        b = np.einsum("cmk,cm->ck", wide, at.u)
        signs, u, h = _flipped(at, flips)
        flip = np.einsum("cmk,cm->ck", wide, u)
        return cls(
            local.reshape(C, v, d, v, d), H.reshape(-1, C, v, d),
            b.reshape(C, v, d), signs, flip.reshape(C, v, d), h,
        )._by_fewest  # fmt: skip

    @property
    def _by_fewest(self) -> EntrySums:
        """The same by no more rows of H than it has columns: only HᵀH and hH count."""
        H = self.H.reshape(len(self.H), -1)
        if len(H) <= H.shape[1]:
            return self
        Q, R = np.linalg.qr(H)
        return replace(self, H=R.reshape(-1, *self.H.shape[1:]), h=self.h @ Q)

    @cached_property
    def _of_configurations(self) -> EntrySums:
        """The same for directions that do not differ within a configuration: v = 1."""
        return replace(
            self, local=self.local.sum(axis=(1, 3), keepdims=True),
            H=self.H.sum(axis=2, keepdims=True), b=self.b.sum(axis=1, keepdims=True),
            flip=self.flip.sum(axis=1, keepdims=True),
        )._by_fewest  # fmt: skip

    def each(
        self, n: int, width: int, directions: Callable[[slice], Array], threads: int = 1
    ) -> Spectrum:
        """Spectrum of n groups, for so many of which at a time `directions` are asked as are HELD
        numbers, of `width` columns each."""
        step = max(1, HELD // (self.b.size * width))
        D = (directions(slice(k, k + step)) for k in range(0, n, step))
        parts = zip(
            *((s.lam, s.beta, s.flips) for s in ahead(self.driven, D, threads)), strict=True
        )
        return Spectrum(*map(np.concatenate, parts))

    def driven(self, D: Array) -> Spectrum:
        """Spectrum of the groups with directions D (C, v, d, V, k), or (C, 1, d, V, k) where they
        are the same in all visits of a configuration."""
        if D.shape[1] < self.b.shape[1]:
            return self._of_configurations.driven(D)
        C, v, d, V, k = D.shape
        n = v * d
        flat = D.reshape(C, n, V * k)
        local = self.local.reshape(C, n, n)
        moved = local * flat if n == 1 else local @ flat
        Z = self.H.reshape(-1, C * n) @ flat.reshape(C * n, V * k)
        A = _each_with_each(flat.reshape(-1, V, k), moved.reshape(-1, V, k))
        A -= _each_with_each(Z.reshape(-1, V, k), Z.reshape(-1, V, k))
        b = self.b.ravel() @ flat.reshape(C * n, V * k)
        flips = np.zeros((V * k, len(self.signs)))
        if flips.size:
            own = np.einsum("ci,cig->cg", self.flip.reshape(C, n), flat)
            flips = own.T @ self.signs.T - Z.T @ self.h.T
        return spectrum(A, b.reshape(V, k), flips.reshape(V, k, -1))


def _each_with_each(a: Array, b: Array) -> Array:
    """Σ_r a_rvk b_rvl (V, K, K) of a and b (R, V, K)."""
    return np.asarray(a.transpose(1, 2, 0) @ b.transpose(1, 0, 2))


def _flipped(at: Projection, flips: Flips | None) -> tuple[Array, Array, Array]:
    """The signs (F, C), V⁻¹e (C, m), which they flip, and Σ_c signs (Hᵀe)_c (F, p)."""
    if flips is None:
        return np.zeros((0, len(at.u))), np.zeros_like(at.u), np.zeros((0, at.H.shape[2]))
    signs, e = flips[0], flips[1][..., None]
    h = (at.H.transpose(0, 2, 1) @ e)[..., 0]
    return signs, (at.inverse @ e)[..., 0], signs @ h


def direct(C: Array, at: Projection, flips: Flips | None = None) -> Spectrum:
    """Spectrum of one group of packed columns C (blocks, m, k), zero in rows that do not count."""
    k = C.shape[2]
    A = C.reshape(-1, k).T @ (at.inverse @ C).reshape(-1, k)
    Z = at.H.reshape(-1, at.H.shape[2]).T @ C.reshape(-1, k)
    b = np.einsum("cmk,cm->k", C, at.u)
    signs, u, h = _flipped(at, flips)
    flipped = signs @ np.einsum("cmk,cm->ck", C, u) - h @ Z
    return spectrum((A - Z.T @ Z)[None], b[None], flipped.T[None])


# Numbers of regressor directions that are held at a time: with more of them the sums over thousands
# of visits wait for memory.
HELD = 300_000


@dataclass
class Grams:
    """Spectra against `data` under the noise of its projection `at`, and against `flips`, where
    these are given."""

    dataset: DiagnosisData
    data: NoisyData
    at: Projection
    flips: Flips | None = None
    _entries: dict[EntryKey, EntrySums] = field(init=False, default_factory=dict)

    def entry(self, key: EntryKey) -> EntrySums:
        if key not in self._entries:
            E = self.data.masked(self.dataset.entry(key))
            self._entries[key] = EntrySums.of(E, self.data.blocks, self.at, self.flips)
        return self._entries[key]

    def of(self, h: Hypothesis | Generic, settings: Array | None = None) -> Spectrum:
        """A block, or a hypothesis at every one of the `settings` (G, …), by default those of the
        search."""
        if isinstance(h, Generic):
            return self._of_blocks([h])
        if not h.driven:
            columns = self.data.masked(self.dataset.packed(h))
            return direct(columns, self.at, self.flips)
        tried = self.dataset.grids[h.key].values if settings is None else settings
        sums, dataset = self.entry(h.entry_key(self.dataset.base.model)), self.dataset
        return sums.each(
            len(tried), h.width, lambda some: dataset.direction(h, tried[some]), self.data.threads
        )

    def of_each(
        self, whats: Sequence[Hypothesis | Generic]
    ) -> Iterator[tuple[Sequence[int], Spectrum]]:
        """Numbers of hypotheses or blocks and their spectra: a hypothesis by itself, at all of its
        settings; blocks that move one entry by as many functions together, since hundreds of small
        products cost a call each."""
        alike = defaultdict[Hashable, list[int]](list)
        for n, what in enumerate(whats):
            moved = what.entry if isinstance(what, Generic) else None
            alike[n if moved is None else (moved, what.width)].append(n)
        for members in alike.values():
            blocks = [what for n in members if isinstance(what := whats[n], Generic)]
            yield members, self._of_blocks(blocks) if blocks else self.of(whats[members[0]])

    def _of_blocks(self, blocks: Sequence[Generic]) -> Spectrum:
        """Of blocks that move one entry by as many functions, or of one block."""
        entry, columns = blocks[0].entry, blocks[0].columns
        if entry is None:
            assert columns is not None
            return direct(self.data.masked(columns), self.at, self.flips)
        functions = [b.direction for b in blocks if b.direction is not None]
        return self.entry(entry).each(
            len(blocks), blocks[0].width, lambda some: np.stack(functions[some], axis=3),
            self.data.threads,
        )  # fmt: skip


@dataclass(frozen=True)
class Scored:
    """Evidence of one hypothesis or block over the model without it (nats).

    `settings` are its best ones, `best` the evidence at them without the prior of the search;
    `distance` is d of its typical size there, in standard deviations.
    """

    evidence: float
    best: float
    settings: Array
    distance: float


@dataclass(frozen=True)
class Scan:
    """Everything scored under one noise: hypotheses, then blocks, and the odds of all together.

    `odds` is the log of the mean evidence over catalogue and blocks, weighted by prior,
    `flipped` (F,) the same for residuals whose configurations had their signs flipped;
    `covariate_odds` the largest evidence among the blocks of a covariate, and its flips;
    `marginal` the log marginal likelihood of the data beside which they were scored.
    """

    scored: tuple[Scored, ...]
    odds: float
    flipped: Array
    covariate_odds: dict[str, float]
    covariate_flips: dict[str, Array]
    marginal: float
    noise: NoiseValues


def scan(
    dataset: DiagnosisData, generic: list[Generic], prior: Array, data: NoisyData,
    noise: NoiseValues, flips: Flips | None = None,
) -> Scan:  # fmt: skip
    """Score all hypotheses and blocks, of log odds `prior`, beside the columns in `data`."""
    grams = Grams(dataset, data, project(data, noise), flips)
    whats: tuple[Hypothesis | Generic, ...] = (*dataset.hypotheses, *generic)
    found: dict[int, Scored] = {}
    F = 0 if flips is None else len(flips[0])
    flipped = np.empty((len(whats), F))
    for members, spectra in grams.of_each(whats):
        scales = whats[members[0]].scales
        # A hypothesis has all of its settings, of several blocks each has one.
        grids = [dataset.grids.get(whats[n].key, NO_SETTINGS) for n in members]
        each, spans = spectra.evidence(scales), np.arange(len(spectra.lam)).reshape(len(grids), -1)
        flipped[list(members)] = spectra.flipped(np.stack([g.log_prior for g in grids]), scales)
        for n, own, grid in zip(members, spans, grids, strict=True):
            weighed = each[own] + grid.log_prior
            k = int(np.argmax(weighed))
            best, d = float(each[own[k]]), float(spectra.distance[own[k]])
            found[n] = Scored(float(log_sum(weighed)), best, grid.values[k], d)
    scored = tuple(found[n] for n in range(len(whats)))
    of_covariate = defaultdict[str, list[int]](list)
    for n, block in enumerate(generic, start=len(dataset.hypotheses)):
        of_covariate[block.covariate].append(n)
    total, by_covariate = float(logsumexp(prior)), of_covariate.items()
    return Scan(
        scored, float(log_sum(prior + [s.evidence for s in scored])) - total,
        log_sum(prior[:, None] + flipped, axis=0) - total,
        {c: max(scored[n].evidence for n in own) for c, own in by_covariate},
        {c: flipped[own].max(axis=0) for c, own in by_covariate if F},
        grams.at.marginal, noise,
    )  # fmt: skip
