"""Who the rivals are, what may imitate them, and how far apart any visits would put them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, permutations

import numpy as np
from scipy import special
from scipy.sparse.csgraph import connected_components

from elastocal.diagnosis.baseline import SMALLEST_NOISE, Baseline, NoiseValues, project
from elastocal.diagnosis.diagnosis import Diagnosis, RivalPair
from elastocal.diagnosis.diagnosis_data import (
    UNKNOWN_EFFECT,
    DiagnosisData,
    diagnosis_data_of,
    generic_blocks,
)
from elastocal.diagnosis.effect_search import (
    PLAUSIBLE,
    ModelSet,
    distances,
    settings_to_try,
    spans_of,
    with_items,
)
from elastocal.diagnosis.evidence import Grams, Item, at_scales
from elastocal.diagnosis.hypotheses import Hypothesis, StartSearch, possible
from elastocal.diagnosis.verdict import TOO_NEAR, TOO_NEAR_PROBABILITY
from elastocal.errors import InputError, require
from elastocal.measurements import Measurements
from elastocal.model.effects.compliances import JointCompliance
from elastocal.model.manipulator import Model
from elastocal.units import Array

# The noise that a diagnosis found, and the readings that it left out, in the campaign's terms.


def as_diagnosed(dataset: DiagnosisData, diagnosis: Diagnosis) -> tuple[DiagnosisData, NoiseValues]:
    """The data, planned ones included, less the faulty readings, and the noise."""
    found = diagnosis.noise
    faulty = np.isin(dataset.table.row[dataset.lead], [f.line for f in found.faulty])
    joint = np.maximum(found.repeatability, SMALLEST_NOISE)
    shared = np.array(found.shared_by_joint or [found.shared] * len(joint))
    return dataset.without(faulty), NoiseValues(found.stated_factor, joint, shared)


# Who the rivals are: the named sets of an ambiguous verdict, or what an unknown effect may be.

# An unknown effect is told from the known ones that keep a chance, so many at least and at most,
# as so many blocks at so many places.
CHANCE = 0.01
FEWEST_KNOWN, MOST_KNOWN, BLOCKS, PLACES = 2, 6, 2, 2
# Probability that a rival keeps, however unlikely it looks so far.  Blocks only approximate what
# is unknown, so that the evidence for them against each other says less.
LEAST_PROBABILITY, LEAST_PROBABILITY_UNKNOWN = 0.01, 0.05


class RivalSet:
    """Items of which one is at work, `beside` other items that are.

    `probability` (rivals,) of each given that it is one of them, none below the `smallest`.
    """

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


class Suspects:
    """The items that a diagnosis speaks of, with the settings it found for them.

    Raises InputError where they do not belong to this model and table.
    """

    def __init__(self, model: Model, table: Measurements, diagnosis: Diagnosis) -> None:
        self.diagnosis = diagnosis
        hypotheses = {h.key: h for h in possible(model, table)[0]}
        # Every effect that was tried, and its probability.
        self.items: dict[tuple[str, str], Item] = {}
        self.p: dict[tuple[str, str], float] = {}
        for c in diagnosis.candidates:
            if h := hypotheses.get((c.effect, c.where)):
                settings = np.array([c.settings[s.key] for s in h.settings])
                self.items[h.key], self.p[h.key] = Item(h, settings, 0.0), c.probability
        self._found = [(f.effect, f.where) for f in diagnosis.effects]
        # Whether something without a name is at work.
        self.unknown = diagnosis.verdict == "unknown_effect"
        groups = [
            [(e.effect, e.where) for e in group if e.effect != UNKNOWN_EFFECT]
            for group in diagnosis.indistinguishable
        ]
        for effect, where in chain(self._found, *groups):
            require(
                (effect, where) in self.items,
                f"{table.source}: the diagnosis names {effect} at {where}, which this model and "
                "table cannot test; plan with those that were diagnosed",
            )
        self.sets = tuple(
            RivalSet(
                [self.items[key] for key in keys], [self.p[key] for key in keys],
                [self.items[key] for key in self._found if key not in keys],
            ) for keys in groups if len(keys) > 1
        )  # fmt: skip

    @property
    def covered(self) -> float:
        """Probability that the right answer is among the rivals: that there is something, and that
        it is none of the effects that are no rivals."""
        d, ours = self.diagnosis, set(self._rivals())
        others = sum(p for key, p in self.p.items() if key not in ours)
        missed = d.probability_nothing + others + (0.0 if self.unknown else d.probability_unknown)
        return min(max(1 - missed, 0.0), 1.0)

    def _rivals(self) -> list[tuple[str, str]]:
        items = [item for s in self.sets for item in (*s.rivals, *s.beside)]
        keys = [item.what.key for item in items] + self._found
        return keys + self._likeliest() if self.unknown else keys

    @property
    def hypotheses(self) -> list[Hypothesis]:
        keys = self._rivals()
        if self.unknown:
            # Torques, which may drive what is unknown, come from the compliances' columns.
            keys += [key for key in self.items if key[0] == JointCompliance.name]
        whats = [self.items[key].what for key in dict.fromkeys(keys)]
        return [h for h in whats if isinstance(h, Hypothesis)]

    @property
    def matters(self) -> dict[str, bool]:
        """Whether the side of approach may tell the rivals apart, and waiting, since some rival
        relaxes with time."""
        constants = [s.kind for h in self.hypotheses for s in h.settings]
        sides = any(s.depends_on("approach") for s in self.sets)
        return {
            "sides": self.unknown or sides,
            "waits": self.unknown or "time_constant" in constants,
        }

    def unknown_set(self, dataset: DiagnosisData, noise: NoiseValues) -> RivalSet:
        """The blocks that explain the data best where the diagnosis locates the effect (anywhere,
        where it only says that a gap is left), and the likeliest effects of the catalogue; in
        `dataset` only the data so far count."""
        blocks = generic_blocks(dataset)
        if location := self.diagnosis.location:
            near = list(dict.fromkeys([location.where, *location.places]))[:PLACES]
            blocks = [block for block in blocks if block.where in near]
        items = [Item(block, np.zeros(0), 0.0) for block in blocks]
        grams = Grams(dataset, dataset.data, project(dataset.data, noise))
        evidence = np.array([float(grams.of(block).evidence()[0]) for block in blocks])
        best = np.argsort(-evidence, kind="stable")[:BLOCKS]
        share = self.diagnosis.probability_unknown * special.softmax(evidence[best])
        keys = self._likeliest()
        return RivalSet(
            [*(items[k] for k in best), *(self.items[key] for key in keys)],
            [*share, *(self.p[key] for key in keys)],
            [self.items[key] for key in self._found],
            LEAST_PROBABILITY_UNKNOWN,
        )

    def _likeliest(self) -> list[tuple[str, str]]:
        free = [key for key in self.p if key not in self._found]
        free = sorted(free, key=lambda key: -self.p[key])[:MOST_KNOWN]
        return [key for n, key in enumerate(free) if n < FEWEST_KNOWN or self.p[key] >= CHANCE]


def check_open(diagnosis: Diagnosis) -> None:
    if diagnosis.verdict not in ("ambiguous", "unknown_effect"):
        raise InputError(
            f"the verdict is {diagnosis.verdict}: there are no rivals to tell apart; extra poses "
            "are planned for an ambiguous or unknown_effect verdict"
        )
    if diagnosis.groups:
        raise InputError(
            "many causes act at once: extra poses are planned for rivals of single causes; spread "
            "more poses over the whole range of every joint instead"
        )


# Rivals that the verdict has no room to name: what one of those named may also be.
#
# A set names three effects at most.  Whichever of them is at work, further poses leave open what
# imitates it, whether it was listed or not; a plan that did not know of it would promise too much.

# Alike, or so near (twice the deviate of 0.97, what a plan is to reach) that their evidence
# leaves them a chance; so many at most, those named among them.
NEAR, MOST = 3.76, 10


def with_neighbours(base: Baseline, suspects: Suspects) -> tuple[RivalSet, ...]:
    """The suspects' sets with what each of their rivals may also be."""
    if not suspects.sets:
        return ()
    items, chance, diagnosis = suspects.items, suspects.p, suspects.diagnosis
    hypotheses = [i.what for i in items.values() if isinstance(i.what, Hypothesis)]
    dataset, noise = as_diagnosed(diagnosis_data_of(base, hypotheses), diagnosis)
    out = []
    for s in suspects.sets:
        near = dict.fromkeys(items, np.inf)
        for rival in s.rivals:
            of_rival = ModelSet(dataset, (rival, *s.beside), noise)
            found = distances(dataset, of_rival, 0)
            near |= {key: min(near[key], d) for key, d in found.items()}
        taken = {item.what.key for item in (*s.rivals, *s.beside)}
        free = [
            key
            for key, p in chance.items()
            if key not in taken and (near[key] < TOO_NEAR or (near[key] < NEAR and p >= CHANCE))
        ]
        free = sorted(free, key=lambda key: near[key])[: max(MOST - len(s.rivals), 0)]
        rivals = [*s.rivals, *(items[key] for key in free)]
        # Those named have their probability given that there is something, as these need, too.
        something = max(1 - diagnosis.probability_nothing, 1e-9)
        probable = [chance[item.what.key] for item in s.rivals]
        probable += [chance[key] / something for key in free]
        out.append(RivalSet(rivals, probable, s.beside))
    return tuple(out)


# The starts from which one rival may imitate another: where a spring would be anchored.
#
# A spring's geometry is sought by the diagnosis from several starts, and only the best so far has
# given its columns to the dataset.  Once further poses are measured it is sought anew, and what
# another start explains of them is no longer told from a rival.


def columns_of_starts(dataset: DiagnosisData, item: Item) -> list[Array]:
    """Columns (C, m, k) of an item about each of its starts, per typical size; none without."""
    what, of = item.what, dataset.columns
    if not isinstance(what, Hypothesis) or not what.starts(dataset.base.model):
        return []
    starts = StartSearch(of.full, what, of.base, of.x, of.rows).tangents()
    return [dataset.pack(C) * dataset.sizes_in(what, C) for _, C in starts]


# The settings with which one rival may imitate the others: its order, its time.
#
# The best in the data so far need not be the best once further poses are measured, when the
# diagnosis seeks them anew: what is nearly as good stays possible.

NEARLY = 4.0  # in d²: two standard deviations
SETTINGS = 6  # of a rival that are tried, at most


def alternatives(
    dataset: DiagnosisData, noise: NoiseValues, rivals: RivalSet
) -> tuple[tuple[Item, ...], ...]:
    """Of each rival that has settings the item at those which explain most of another's signal,
    the bests first, then what explains NEARLY as much; of other rivals nothing.

    A signal is a rival's at its estimate; in `dataset` only the data so far count.
    """
    widest = tuple(float(item.what.scales.max()) for item in rivals.beside)
    data = with_items(dataset, rivals.beside, widest)
    grams, out = list[Grams](), list[tuple[Item, ...]]()
    for item in rivals.rivals:
        C = data.masked(dataset.packed(item.what, item.settings))
        at = project(data.with_columns(C, np.ones(C.shape[2])), noise)
        signal = C @ at.beta[data.X.shape[2] :]
        grams.append(Grams(dataset, data, project(replace(data, r=signal), noise)))
    for b, rival in enumerate(rivals.rivals):
        what, others = rival.what, [a for a in range(len(grams)) if a != b]
        if not isinstance(what, Hypothesis) or not what.settings or not others:
            out.append(())
            continue
        lists = [settings_to_try(dataset, what, rivals.rivals[a]) for a in others]
        tried = np.unique(np.vstack(lists), axis=0)
        size = float(what.scales.max())
        explained = np.array([grams[a].of(what, tried).explained(size) for a in others])
        short = explained.max(axis=1, keepdims=True) - explained
        near = np.flatnonzero((short <= NEARLY).any(axis=0))
        evenly = near[np.linspace(0, len(near) - 1, min(SETTINGS, len(near))).round().astype(int)]
        chosen = list(dict.fromkeys([*short.argmin(axis=1), *evenly]))[:SETTINGS]
        out.append(tuple(replace(rival, settings=tried[k]) for k in chosen))
    return tuple(out)


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
# with S the Schur complement of the nuisance in the Gram matrix and the smallest over the starts
# from which b is sought: the T-criterion (Atkinson and Fedorov 1975), and twice the
# Kullback-Leibler distance (López-Fidalgo et al. 2007).  γ is what the data so far leave of it:
# draws from its posterior.  If a is at work, further visits that raise d² by δ² move the log odds
# of a over b from where they stand, L_ab, by N(δ²/2, δ²), so that b wins with probability
# Φ(−(L_ab + δ²/2)/δ).

DRAWS = 32  # of each sign


class Discrimination:
    """One set of rivals to be told apart, with everything that judges a choice of candidates, which
    stand last in the dataset, `so_far` without them.

    With columns W whitened by V, the covariance of each configuration, `known` (w, w) is WᵀV⁻¹W of
    the data so far with the nuisance's prior precision, `pool` (N, m, w) V^−½W of each candidate.
    The `nuisance` first columns are those of the fitted parameters and of the effects beside the
    rivals.  Counted from there come each rival's own, at `groups`, and at `alternatives` those with
    which it may imitate others instead: at other settings or about other starts, each by itself.
    `draws`: γ (draws, k) of each rival; `before` (rivals, rivals, draws) d² in the data so far;
    `classes` (rivals,): those with the same number are not asked to be told apart.
    """

    def __init__(
        self, dataset: DiagnosisData, so_far: DiagnosisData, noise: NoiseValues, candidates: int,
        rivals: RivalSet, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        data, measured = dataset.data, len(dataset.data.X) - candidates
        searched = alternatives(so_far, noise, rivals)

        def packed(item: Item) -> Array:
            return dataset.packed(item.what, item.settings)

        # What is beside counts by the widest size of its prior.
        beside = [packed(item) * float(item.what.scales.max()) for item in rivals.beside]
        others = [
            [*(packed(i) for i in items), *columns_of_starts(dataset, rival)]
            for rival, items in zip(rivals.rivals, searched, strict=True)
        ]
        own = [packed(rival) for rival in rivals.rivals]
        own += chain.from_iterable(others)
        fitted, n = data.X.shape[2], len(rivals.rivals)
        self.rivals, self.nuisance = rivals, fitted + sum(C.shape[2] for C in beside)
        W = np.concatenate([data.X, *beside, *own, data.r[:, :, None]], axis=2)
        L = np.linalg.cholesky(data.V(noise))
        white = np.linalg.solve(L, data.masked(W))
        known = white[:measured].reshape(-1, W.shape[2])
        gram = known.T @ known
        own_precision = np.append(data.precision, np.ones(self.nuisance - fitted))
        gram[np.diag_indices(self.nuisance)] += own_precision
        self.known, self.pool = gram[:-1, :-1], white[measured:, :, :-1]
        widths = [C.shape[2] for C in own]
        spans = spans_of(widths, sum(widths))
        self.groups, rest = spans[:n], iter(spans[n:])
        self.alternatives = [
            list(islice(rest, len(each))) or [own] for own, each in zip(spans, others, strict=False)
        ]
        S = eliminated(gram, self.nuisance)
        self.draws = _posterior_draws(rivals, self.groups, S, rng)
        self.before, self.classes = self._apart(S[:-1, :-1]), np.arange(n)

    def _gram(self, chosen: Sequence[int]) -> Array:
        """Gram matrix (w, w) of the data so far and the chosen candidates."""
        H = self.pool[list(chosen)].reshape(-1, len(self.known))
        return self.known + H.T @ H

    def squared(self, chosen: Sequence[int]) -> Array:
        """d² (rivals, rivals, draws) of every ordered pair by the data so far and the chosen
        candidates; zero of a rival with itself."""
        return self._apart(eliminated(self._gram(chosen), self.nuisance))

    def squared_with_each(self, chosen: Sequence[int]) -> Array:
        """d² (N, rivals, rivals, draws) with each candidate added to those chosen."""
        each = self._gram(chosen) + self.pool.transpose(0, 2, 1) @ self.pool
        return self._apart(eliminated(each, self.nuisance))

    def _apart(self, S: Array) -> Array:
        n = len(self.draws)
        out = np.zeros((*S.shape[:-2], n, n, 2 * DRAWS))
        for a, b in permutations(range(n), 2):
            of_a, g = self.groups[a], self.draws[a]
            size = PLAUSIBLE * self.rivals.rivals[b].what.scales.max()
            each = []
            for of_b in self.alternatives[b]:
                tie = np.eye(of_b.stop - of_b.start) / size**2
                taken = np.linalg.solve(S[..., of_b, of_b] + tie, S[..., of_b, of_a])
                D = S[..., of_a, of_a] - S[..., of_a, of_b] @ taken
                each.append(((g @ D) * g).sum(axis=-1))
            out[..., a, b, :] = np.maximum(np.min(each, axis=0), 0.0)
        return out

    def gained(self, squared: Array) -> Array:
        """δ² (…, rivals, rivals, draws)."""
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
        """(…,) probability of naming the right class, averaged over the right one and its size.

        By the union bound over its rival classes, each as dangerous as its strongest
        member; not below what naming the likeliest so far gives, which nobody has to give up.
        While a pair is as near as the verdict calls alike, no odds name one of the two with more
        than TOO_NEAR_PROBABILITY.
        """
        p = self.rivals.probability
        odds = np.log(np.bincount(self.classes, p)[self.classes])
        L = (odds[:, None] - odds[None, :])[..., None]
        delta = np.sqrt(np.maximum(self.gained(squared), 1e-12))
        beaten = special.ndtr(-(L + delta**2 / 2) / delta)
        beaten = np.where(
            squared < TOO_NEAR**2, np.maximum(beaten, 1 - TOO_NEAR_PROBABILITY), beaten
        )
        lost = np.zeros(beaten.shape[:-2] + beaten.shape[-1:])
        for k in np.unique(self.classes):
            strongest = beaten[..., self.classes == k, :].max(axis=-2)
            lost += strongest * (self.classes != k)[:, None]
        named = (np.maximum(1 - lost, 0.0).mean(axis=-1) * p).sum(axis=-1)
        return np.maximum(named, p[self.classes == self.classes[np.argmax(p)]].sum())

    def distances(self, squared: Array) -> Array:
        """d (rivals, rivals) of each unordered pair: the median size's, the nearer way round."""
        d = np.sqrt(np.median(squared, axis=-1))
        return np.minimum(d, d.T)


def _posterior_draws(
    rivals: RivalSet, groups: Sequence[slice], S: Array, rng: np.random.Generator
) -> tuple[Array, ...]:
    """γ (2·DRAWS, k) of each rival as if it were the one at work, antithetic about its estimate.

    γ | data ~ N(mean, A⁻¹), A = S_aa + I/s², at the scale s of the size prior that explains the
    data best; S's last row is that of the readings.
    """
    out = []
    for item, of in zip(rivals.rivals, groups, strict=True):
        lam, U = np.linalg.eigh(S[of, of])
        lam = np.maximum(lam, 0.0)
        beta = U.T @ S[of, -1]
        each = at_scales(lam[None], beta[None, :, None], item.what.scales)
        precision = lam + 1 / item.what.scales[int(np.argmax(each))] ** 2
        z = rng.normal(size=(DRAWS, len(lam))) / np.sqrt(precision)
        out.append((beta / precision + np.concatenate([z, -z])) @ U.T)
    return tuple(out)


# Which rivals any poses can tell apart.

# A pair that all candidates together would not tell apart with this probability is inseparable.
HOPE = 0.9
APART_AT_LAST = 2 * float(special.ndtri(HOPE))  # the distance that it takes


def inseparable(tasks: Sequence[Discrimination]) -> dict[tuple[str, str], float]:
    """The pairs that the whole pool could not tell apart, with their distance in all of it; such
    rivals are of one class from now on."""
    hopeless = {}
    for c in tasks:
        d = c.distances(c.squared(range(len(c.pool))))
        near = d < APART_AT_LAST
        c.classes = connected_components(near, directed=False)[1].astype(np.int64)
        names = c.rivals.names
        for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            hopeless[names[a], names[b]] = float(d[a, b])
    return hopeless


def together(c: Discrimination) -> Iterator[tuple[str, ...]]:
    for k in np.unique(c.classes):
        names = [name for name, own in zip(c.rivals.names, c.classes, strict=True) if own == k]
        if len(names) > 1:
            yield tuple(names)


def pairs_of(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> tuple[RivalPair, ...]:
    out = []
    for c in tasks:
        before, after = c.distances(c.before), c.distances(c.squared(chosen))
        names = c.rivals.names
        for a, b in zip(*np.triu_indices(len(names), 1), strict=True):
            out.append(RivalPair(names[a], names[b], float(before[a, b]), float(after[a, b])))
    return tuple(out)
