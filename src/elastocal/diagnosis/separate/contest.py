"""How far apart rivals are, and how probably the right one is named, after any set of visits.

With W's nuisance columns X (prior precision Λ) and rival b's columns C_b (as large as the verdict
lets a rival be, s_b) eliminated, the signal C_a γ of rival a keeps the squared length

    d²_ab(γ) = min_{β, η} |C_a γ − X β − C_b η|²_V⁻¹ + |β|²_Λ + |η|²/s_b² = γᵀ D_ab γ,
    D_ab = S_aa − S_ab (S_bb + I/s_b²)⁻¹ S_ba,

with S the Schur complement of the nuisance in the Gram matrix and the smallest over the starts
from which b is sought: the T-criterion (Atkinson and Fedorov 1975), and twice the
Kullback-Leibler distance (López-Fidalgo et al. 2007).  γ is what the data so far leave of it:
draws from its posterior.  If a is the truth, further visits that raise d² by δ² move the log odds
of a over b from where they stand, L_ab, by N(δ²/2, δ²), so that b wins with probability
Φ(−(L_ab + δ²/2)/δ).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from elastocal.diagnosis.alike import PLAUSIBLE
from elastocal.diagnosis.evidence import evidence_of
from elastocal.diagnosis.separate.rivals import RivalSet
from elastocal.diagnosis.separate.rows import Rows, eliminated
from elastocal.diagnosis.verdict import ALIKE, ALIKE_PROBABILITY

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DRAWS = 32  # of each sign


@dataclass(frozen=True)
class Contest:
    """One set of rivals with everything that judges a choice of candidates.

    `draws`: γ (draws, k) of each rival; `before` (rivals, rivals, draws) d² in the data so far;
    `classes` (rivals,): those with the same number are not asked to be told apart.
    """

    rivals: RivalSet
    rows: Rows
    draws: tuple[Array, ...]
    before: Array
    classes: IntArray

    @classmethod
    def of(cls, rivals: RivalSet, rows: Rows, rng: np.random.Generator) -> Contest:
        draws = _posterior_draws(rivals, rows, rng)
        n = len(draws)
        start = cls(rivals, rows, draws, np.zeros((n, n, 2 * DRAWS)), np.arange(n))
        S = eliminated(rows.gram, rows.nuisance)[0]
        return replace(start, before=start._squared(S[None])[0])

    def in_classes(self, classes: IntArray) -> Contest:
        """The same judged by telling these classes (rivals,) apart."""
        return replace(self, classes=classes)

    @property
    def open(self) -> bool:
        """Whether there is anything to tell apart."""
        return bool(np.any(self.classes != self.classes[0]))

    def gram(self, chosen: Sequence[int]) -> Array:
        """Gram matrix (w, w) of the data so far and the chosen candidates."""
        H = self.rows.pool[list(chosen)].reshape(-1, len(self.rows.gram))
        return self.rows.gram + H.T @ H

    def squared(self, gram: Array) -> Array:
        """d² (rivals, rivals, draws) of every ordered pair; zero of a rival with itself."""
        return self._squared(eliminated(gram, self.rows.nuisance)[0][None])[0]

    def squared_with_each(self, gram: Array) -> Array:
        """d² (N, rivals, rivals, draws) with each candidate added to the visits behind `gram`.

        A candidate's few rows H = [H_X, H_R] change S by EᵀK⁻¹E with E = H_R − H_X M⁻¹ M_XR and
        K = I + H_X M⁻¹ H_Xᵀ (Woodbury), which spares an elimination for each.
        """
        p = self.rows.nuisance
        S, inverse = eliminated(gram, p)
        H = self.rows.pool
        through = H[:, :, :p] @ inverse
        E = H[:, :, p:] - through @ gram[:p, p:]
        K = np.eye(H.shape[1]) + through @ H[:, :, :p].transpose(0, 2, 1)
        return self._squared(S + E.transpose(0, 2, 1) @ np.linalg.solve(K, E))

    def _squared(self, S: Array) -> Array:
        n, p = len(self.draws), self.rows.nuisance
        out = np.zeros((len(S), n, n, 2 * DRAWS))
        for a, b in permutations(range(n), 2):
            truth, g = self.rows.groups[a], self.draws[a]
            of_a = slice(truth.start - p, truth.stop - p)
            size = PLAUSIBLE * self.rivals.rivals[b].scales.max()
            nearest = np.full((len(S), len(g)), np.inf)
            for rival in self.rows.imitations[b]:
                of_b = slice(rival.start - p, rival.stop - p)
                tie = np.eye(rival.stop - rival.start) / size**2
                taken = np.linalg.solve(S[:, of_b, of_b] + tie, S[:, of_b, of_a])
                D = S[:, of_a, of_a] - S[:, of_a, of_b] @ taken
                nearest = np.minimum(nearest, ((g @ D) * g).sum(axis=2))
            out[:, a, b] = np.maximum(nearest, 0.0)
        return out

    def gained(self, squared: Array) -> Array:
        """δ² (…, rivals, rivals, draws): what the visits add to the data so far."""
        return np.maximum(squared - self.before, 0.0)

    def error_bound(self, squared: Array) -> Array:
        """(…,) Σ_ab √(p_a p_b) E exp(−δ²_ab/8): Chernoff's bound of the pairs' errors, whose
        largest term is that of the closest pair, and which is smooth where Φ is flat."""
        p = self.rivals.probability
        other = self.classes[:, None] != self.classes[None, :]
        weight = np.sqrt(p[:, None] * p[None, :]) * other
        bound = np.exp(-self.gained(squared) / 8).mean(axis=-1)
        return np.asarray((weight * bound).sum(axis=(-2, -1)))

    def probability(self, squared: Array) -> Array:
        """(…,) probability of naming the right class, averaged over truth and its size.

        By the union bound over the truth's rival classes, each as dangerous as its strongest
        member; not below what naming the likeliest so far gives, which nobody has to give up.
        While a pair is as near as the verdict calls alike, no odds name one of the two with more
        than ALIKE_PROBABILITY.
        """
        p = self.rivals.probability
        odds = np.log(np.bincount(self.classes, p)[self.classes])
        L = (odds[:, None] - odds[None, :])[..., None]
        delta = np.sqrt(np.maximum(self.gained(squared), 1e-12))
        beaten = norm.cdf(-(L + delta**2 / 2) / delta)
        alike = squared < ALIKE**2
        beaten = np.where(alike, np.maximum(beaten, 1 - ALIKE_PROBABILITY), beaten)
        lost = np.zeros(beaten.shape[:-2] + beaten.shape[-1:])
        for k in np.unique(self.classes):
            strongest = beaten[..., self.classes == k, :].max(axis=-2)
            lost += strongest * (self.classes != k)[:, None]
        named = (np.maximum(1 - lost, 0.0).mean(axis=-1) * p).sum(axis=-1)
        return np.maximum(named, self.so_far)

    @property
    def so_far(self) -> float:
        """Probability that the class of the likeliest rival is right."""
        p = self.rivals.probability
        return float(p[self.classes == self.classes[int(np.argmax(p))]].sum())

    def distances(self, squared: Array) -> Array:
        """d (rivals, rivals) of each unordered pair: the median size's, the nearer way round."""
        d = np.sqrt(np.median(squared, axis=-1))
        return np.minimum(d, d.T)


def _posterior_draws(rivals: RivalSet, rows: Rows, rng: np.random.Generator) -> tuple[Array, ...]:
    """γ (2·DRAWS, k) of each rival as if it were the truth, antithetic about its estimate.

    γ | data ~ N(mean, A⁻¹), A = S_aa + I/s², at the scale s of the size prior that explains the
    data best.
    """
    p = rows.nuisance
    whole = np.column_stack([rows.gram, rows.response])
    whole = np.vstack([whole, np.append(rows.response, 0.0)])
    S = eliminated(whole, p)[0]
    out = []
    for item, g in zip(rivals.rivals, rows.groups, strict=True):
        of = slice(g.start - p, g.stop - p)
        lam, U = np.linalg.eigh(S[of, of])
        lam = np.maximum(lam, 0.0)
        beta = U.T @ S[of, -1]
        each = [evidence_of(lam[None], beta[None], np.array([s]))[0] for s in item.scales]
        precision = lam + 1 / item.scales[int(np.argmax(each))] ** 2
        z = rng.normal(size=(DRAWS, len(lam))) / np.sqrt(precision)
        out.append((beta / precision + np.concatenate([z, -z])) @ U.T)
    return tuple(out)
