"""Who the rivals are, what may imitate them, and how far apart any visits would put them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, permutations

import numpy as np
from scipy import special
from scipy.sparse.csgraph import connected_components

from elastocal.diagnosis.baseline import NoiseValues, project
from elastocal.diagnosis.diagnosis import Diagnosis, RivalPair
from elastocal.diagnosis.diagnosis_data import UNKNOWN_EFFECT, DiagnosisData, generic_blocks
from elastocal.diagnosis.effect_search import (
    PLAUSIBLE,
    ModelSet,
    distances,
    settings_to_try,
    spans_of,
    with_items,
)
from elastocal.diagnosis.evidence import Grams, Item, at_scales
from elastocal.diagnosis.hypotheses import Hypothesis, StartSearch
from elastocal.diagnosis.verdict import TOO_NEAR, TOO_NEAR_PROBABILITY
from elastocal.units import Array

# A set names three effects at most.  Whichever of them is at work, further poses leave open what
# imitates it, whether it was listed or not; a plan that did not know of it would promise too much.

CHANCE = 0.01
# Alike, or so near (twice the deviate of 0.97, what a plan is to reach) that their evidence
# leaves them a chance; so many at most, those named among them.
NEAR, MOST = 3.76, 10
# An unknown effect is told from the known ones that keep a chance, so many at least and at most,
# as so many blocks at so many places.
FEWEST_KNOWN, MOST_KNOWN, BLOCKS, PLACES = 2, 6, 2, 2
# Probability that a rival keeps, however unlikely it looks so far.  Blocks only approximate what
# is unknown, so that the evidence for them against each other says less.
LEAST_PROBABILITY, LEAST_PROBABILITY_UNKNOWN = 0.01, 0.05

Key = tuple[str, str]


class RivalSet:
    """Items of which one is at work, `beside` other items that are.  `probability` (rivals,) of
    each given that it is one of them, none below the `smallest`."""

    def __init__(
        self, rivals: Sequence[Item], probability: Sequence[float], beside: Sequence[Item],
        smallest: float = LEAST_PROBABILITY,
    ) -> None:  # fmt: skip
        self.rivals, self.beside = tuple(rivals), tuple(beside)
        p = np.maximum(probability, smallest)
        self.probability = p / p.sum()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(item.what.label for item in self.rivals)

    def depends_on(self, column: str) -> bool:
        """Whether a rival needs the table's column: "time" or "approach"."""
        whats = (item.what for item in self.rivals)
        return any(
            column in (w.effect.needs if isinstance(w, Hypothesis) else w.kind) for w in whats
        )


def named_sets(diagnosis: Diagnosis) -> list[list[Key]]:
    """The known effects of each set that the diagnosis calls indistinguishable."""
    named = (
        [(e.effect, e.where) for e in group if e.effect != UNKNOWN_EFFECT]
        for group in diagnosis.indistinguishable
    )
    return [keys for keys in named if len(keys) > 1]


def rival_sets(so_far: DiagnosisData, noise: NoiseValues, diagnosis: Diagnosis) -> list[RivalSet]:
    """The sets that a diagnosis of the data `so_far` names, with what each of their effects may
    also be; and what an unknown effect may be, where there is one."""
    hypotheses, items = {h.key: h for h in so_far.hypotheses}, dict[Key, Item]()
    chance = {(c.effect, c.where): c.probability for c in diagnosis.candidates}
    for c in diagnosis.candidates:
        if h := hypotheses.get((c.effect, c.where)):
            items[h.key] = Item(h, np.array([c.settings[s.key] for s in h.settings]), 0.0)
    found, sets = [(f.effect, f.where) for f in diagnosis.effects], list[RivalSet]()
    # Those named have their probability given that there is something, as others need, too.
    something = max(1 - diagnosis.probability_nothing, 1e-9)
    for keys in named_sets(diagnosis):
        beside = [key for key in found if key not in keys]
        near = dict.fromkeys(items, np.inf)
        for key in keys:
            of_rival = ModelSet(so_far, tuple(items[k] for k in (key, *beside)), noise)
            near |= {k: min(near[k], d) for k, d in distances(so_far, of_rival, 0).items()}
        free = [
            key
            for key, d in sorted(near.items(), key=lambda pair: pair[1])
            if d < TOO_NEAR or (d < NEAR and chance[key] >= CHANCE)
        ]
        free = [key for key in free if key not in (*keys, *beside)][: max(MOST - len(keys), 0)]
        p = [*(chance[key] for key in keys), *(chance[key] / something for key in free)]
        rivals = [items[key] for key in (*keys, *free)]
        sets.append(RivalSet(rivals, p, [items[key] for key in beside]))
    if diagnosis.verdict == "unknown_effect":
        blocks, p = _likely_blocks(so_far, noise, diagnosis)
        free = sorted((k for k in items if k not in found), key=lambda k: -chance[k])[:MOST_KNOWN]
        known = [k for n, k in enumerate(free) if n < FEWEST_KNOWN or chance[k] >= CHANCE]
        rivals, p = blocks + [items[k] for k in known], p + [chance[k] for k in known]
        sets.append(RivalSet(rivals, p, [items[k] for k in found], LEAST_PROBABILITY_UNKNOWN))
    return sets


def _likely_blocks(
    so_far: DiagnosisData, noise: NoiseValues, diagnosis: Diagnosis
) -> tuple[list[Item], list[float]]:
    """The blocks that explain the data best where the diagnosis locates the effect (anywhere, where
    it only says that a gap is left), and their probabilities."""
    blocks = generic_blocks(so_far)
    if location := diagnosis.location:
        near = list(dict.fromkeys([location.where, *location.places]))[:PLACES]
        blocks = [block for block in blocks if block.where in near]
    grams = Grams(so_far, so_far.data, project(so_far.data, noise))
    evidence = np.array([float(grams.of(block).evidence()[0]) for block in blocks])
    best = np.argsort(-evidence, kind="stable")[:BLOCKS]
    p = diagnosis.probability_unknown * special.softmax(evidence[best])
    return [Item(blocks[k], np.zeros(0), 0.0) for k in best], p.tolist()


def covered(sets: Sequence[RivalSet], diagnosis: Diagnosis) -> float:
    """Probability that the right answer is among the rivals: that there is something, and that it
    is none of the effects that are no rivals."""
    ours = {item.what.key for s in sets for item in (*s.rivals, *s.beside)}
    missed = [c.probability for c in diagnosis.candidates if (c.effect, c.where) not in ours]
    if diagnosis.verdict != "unknown_effect":
        missed.append(diagnosis.probability_unknown)
    return min(max(1 - diagnosis.probability_nothing - sum(missed), 0.0), 1.0)


# The order, time or anchor that imitates another best so far need not be the best once further
# poses are measured, when the diagnosis seeks it anew: what is nearly as good stays possible.

NEARLY = 4.0  # in d²: two standard deviations
SETTINGS = 6  # of a rival that are tried, at most


def imitating_columns(
    dataset: DiagnosisData, so_far: DiagnosisData, noise: NoiseValues, rivals: RivalSet
) -> list[list[Array]]:
    """Columns (C, m, k) of each rival as it was found; then at the settings that explain most of
    another's signal, which is that of its estimate by the data `so_far`, and at those that explain
    NEARLY as much; and about every start of its geometry."""
    widest = tuple(float(item.what.scales.max()) for item in rivals.beside)
    data, signals, out = with_items(so_far, rivals.beside, widest), list[Grams](), []
    for item in rivals.rivals:
        C = data.masked(so_far.packed(item.what, item.settings))
        at = project(data.with_columns(C, np.ones(C.shape[2])), noise)
        signal = replace(data, r=C @ at.beta[data.X.shape[2] :])
        signals.append(Grams(so_far, signal, project(signal, noise)))
    for b, item in enumerate(rivals.rivals):
        what, settings = item.what, [item.settings]
        if isinstance(what, Hypothesis) and what.settings and len(signals) > 1:
            others = [a for a in range(len(signals)) if a != b]
            lists = [settings_to_try(dataset, what, rivals.rivals[a]) for a in others]
            tried, size = np.unique(np.vstack(lists), axis=0), float(what.scales.max())
            short = -np.array([signals[a].of(what, tried).explained(size) for a in others])
            short -= short.min(axis=1, keepdims=True)
            near = np.flatnonzero((short <= NEARLY).any(axis=0))
            evenly = near[:: -(-len(near) // SETTINGS)]
            settings += [tried[k] for k in dict.fromkeys([*short.argmin(axis=1), *evenly])]
        columns = [dataset.packed(what, each) for each in settings[: 1 + SETTINGS]]
        if isinstance(what, Hypothesis) and what.starts(dataset.base.model):
            starts = StartSearch(dataset.columns, what).tangents()
            columns += [dataset.pack(C) * dataset.sizes_in(what, C) for _, C in starts]
        out.append(columns)
    return out


def eliminated(gram: Array, nuisance: int) -> Array:
    """Schur complement of the nuisance, the first columns, in gram (…, w, w)."""
    cross = gram[..., :nuisance, nuisance:]
    taken = np.linalg.solve(gram[..., :nuisance, :nuisance], cross)
    return np.asarray(gram[..., nuisance:, nuisance:] - cross.swapaxes(-1, -2) @ taken)


# How far apart rivals are, and how probably the right one is named, after any set of visits.
#
# With W's nuisance columns X (prior precision Λ) and rival b's columns C_b (as large as the verdict
# lets a rival be, s_b) eliminated, the signal C_a γ of rival a keeps the squared length
#
#     d²_ab(γ) = min_{β, η} |C_a γ − X β − C_b η|²_V⁻¹ + |β|²_Λ + |η|²/s_b² = γᵀ D_ab γ,
#     D_ab = S_aa − S_ab (S_bb + I/s_b²)⁻¹ S_ba,
#
# with S the Schur complement of the nuisance in the Gram matrix and the smallest over all columns
# with which b may imitate a: the T-criterion (Atkinson and Fedorov 1975), and twice the
# Kullback-Leibler distance (López-Fidalgo et al. 2007).  γ is what the data so far leave of it:
# draws from its posterior.  If a is at work, further visits that raise d² by δ² move the log odds
# of a over b from where they stand, L_ab, by N(δ²/2, δ²), so that b wins with probability
# Φ(−(L_ab + δ²/2)/δ).

DRAWS = 32  # of each sign
# A pair that all candidates together would not tell apart with this probability is inseparable:
HOPE = 0.9
APART_AT_LAST = 2 * float(special.ndtri(HOPE))  # the distance that it takes


class Discrimination:
    """One set of rivals to be told apart, with everything that judges a choice of candidates, which
    stand last in the dataset, `so_far` without them.

    With columns W whitened by V, the covariance of each configuration, `known` (w, w) is WᵀV⁻¹W of
    the data so far with the nuisance's prior precision, `pool` (N, m, w) V^−½W of each candidate.
    The `nuisance` first columns are those of the fitted parameters and of the effects beside the
    rivals.  Counted from there come each rival's, at the spans of `columns`, its own first, then
    those with which it may imitate others instead.  `draws`: γ (draws, k) of each rival; `before`
    (rivals, rivals, draws) d² in the data so far; `apart` (rivals, rivals) d by all candidates;
    `classes` (rivals,): those with the same number even these do not tell apart."""

    def __init__(
        self, dataset: DiagnosisData, so_far: DiagnosisData, noise: NoiseValues, candidates: int,
        rivals: RivalSet, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        data, measured = dataset.data, len(dataset.data.X) - candidates
        # What is beside counts by the widest size of its prior.
        beside = [dataset.packed(i.what, i.settings) * i.what.scales.max() for i in rivals.beside]
        each = imitating_columns(dataset, so_far, noise, rivals)
        own, fitted = [*chain.from_iterable(each)], data.X.shape[2]
        self.rivals, self.nuisance = rivals, fitted + sum(C.shape[2] for C in beside)
        W = np.concatenate([data.X, *beside, *own, data.r[:, :, None]], axis=2)
        white = np.linalg.solve(np.linalg.cholesky(data.V(noise)), data.masked(W))
        known = white[:measured].reshape(-1, W.shape[2])
        gram = known.T @ known
        own_precision = np.append(data.precision, np.ones(self.nuisance - fitted))
        gram[np.diag_indices(self.nuisance)] += own_precision
        self.known, self.pool = gram[:-1, :-1], white[measured:, :, :-1]
        widths = [C.shape[2] for C in own]
        spans = iter(spans_of(widths, sum(widths)))
        self.columns = [list(islice(spans, len(of))) for of in each]
        S = eliminated(gram, self.nuisance)
        self.draws = [
            _posterior_draws(item, S[of[0], of[0]], S[of[0], -1], rng)
            for item, of in zip(rivals.rivals, self.columns, strict=True)
        ]
        self.before = self._squared_by(S[:-1, :-1])
        self.apart = self.distances(self.squared(range(candidates)))
        self.classes = connected_components(self.apart < APART_AT_LAST, directed=False)[1]

    def _gram(self, chosen: Sequence[int]) -> Array:
        H = self.pool[list(chosen)].reshape(-1, len(self.known))
        return self.known + H.T @ H

    def squared(self, chosen: Sequence[int]) -> Array:
        """d² (rivals, rivals, draws) of every ordered pair by the data so far and the chosen
        candidates; zero of a rival with itself."""
        return self._squared_by(eliminated(self._gram(chosen), self.nuisance))

    def _squared_by(self, S: Array) -> Array:
        n = len(self.draws)
        out = np.zeros((*S.shape[:-2], n, n, 2 * DRAWS))
        for a, b in permutations(range(n), 2):
            of_a, g = self.columns[a][0], self.draws[a]
            size = PLAUSIBLE * self.rivals.rivals[b].what.scales.max()
            each = []
            for of_b in self.columns[b]:
                tie = np.eye(of_b.stop - of_b.start) / size**2
                taken = np.linalg.solve(S[..., of_b, of_b] + tie, S[..., of_b, of_a])
                D = S[..., of_a, of_a] - S[..., of_a, of_b] @ taken
                each.append(((g @ D) * g).sum(axis=-1))
            out[..., a, b, :] = np.maximum(np.min(each, axis=0), 0.0)
        return out

    def errors_with_each(self, chosen: Sequence[int]) -> Array:
        """Σ_ab √(p_a p_b) E exp(−δ²_ab/8) with each of the candidates (N,) added to those chosen:
        Chernoff's bound of the pairs' errors, whose largest term is that of the closest pair, and
        which is smooth where Φ is flat."""
        each = self._gram(chosen) + self.pool.transpose(0, 2, 1) @ self.pool
        squared = self._squared_by(eliminated(each, self.nuisance))
        p, other = self.rivals.probability, self.classes[:, None] != self.classes[None, :]
        bound = np.exp(-np.maximum(squared - self.before, 0.0) / 8).mean(axis=-1)
        return np.asarray((np.sqrt(p[:, None] * p[None, :]) * other * bound).sum(axis=(-2, -1)))

    def probability(self, squared: Array) -> float:
        """Of naming the right class, averaged over the right one and its size.  By the union bound
        over its rival classes, each as dangerous as its strongest member; not below what naming the
        likeliest so far gives, which nobody has to give up.  While a pair is as near as the verdict
        calls alike, no odds name one of the two with more than TOO_NEAR_PROBABILITY."""
        p = self.rivals.probability
        of_class = np.bincount(self.classes, p)
        odds = np.log(of_class[self.classes])
        L = (odds[:, None] - odds[None, :])[..., None]
        delta = np.sqrt(np.maximum(squared - self.before, 1e-12))
        beaten = special.ndtr(-(L + delta**2 / 2) / delta)
        beaten = np.where(
            squared < TOO_NEAR**2, np.maximum(beaten, 1 - TOO_NEAR_PROBABILITY), beaten
        )
        lost = np.zeros((len(p), beaten.shape[-1]))
        for k in range(len(of_class)):
            lost += beaten[:, self.classes == k].max(axis=1) * (self.classes != k)[:, None]
        named = p @ np.maximum(1 - lost, 0.0).mean(axis=-1)
        return float(max(named, of_class[self.classes[np.argmax(p)]]))

    def distances(self, squared: Array) -> Array:
        """d (rivals, rivals) of each unordered pair: the median size's, the nearer way round."""
        d = np.sqrt(np.median(squared, axis=-1))
        return np.minimum(d, d.T)

    def pairs(self, chosen: Sequence[int]) -> Iterator[RivalPair]:
        before, after = self.distances(self.before), self.distances(self.squared(chosen))
        names = self.rivals.names
        for a, b in zip(*np.triu_indices(len(names), 1), strict=True):
            yield RivalPair(names[a], names[b], float(before[a, b]), float(after[a, b]))

    @property
    def inseparable(self) -> dict[tuple[str, ...], float]:
        """Names of the rivals of each class of several, and how far apart neighbours among them
        are at most."""
        near, names = np.where(self.apart < APART_AT_LAST, self.apart, 0.0), self.rivals.names
        classes = (np.flatnonzero(self.classes == k) for k in np.unique(self.classes))
        return {
            tuple(names[k] for k in own): float(near[np.ix_(own, own)].max())
            for own in classes if len(own) > 1
        }  # fmt: skip


def _posterior_draws(item: Item, A: Array, b: Array, rng: np.random.Generator) -> Array:
    """γ (2·DRAWS, k) of a rival as if it were the one at work, antithetic about its estimate.  γ |
    data ~ N(mean, (A + I/s²)⁻¹) by its part A (k, k) of S and b (k,) of the readings, at the scale
    s of the size prior that explains the data best."""
    lam, U = np.linalg.eigh(A)
    lam, beta = np.maximum(lam, 0.0), U.T @ b
    each = at_scales(lam[None], beta[None, :, None], item.what.scales)
    precision = lam + 1 / item.what.scales[int(np.argmax(each))] ** 2
    z = rng.normal(size=(DRAWS, len(lam))) / np.sqrt(precision)
    return np.asarray((beta / precision + np.concatenate([z, -z])) @ U.T)
