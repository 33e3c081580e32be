"""How far apart rivals are after any set of visits, and which of them poses can tell apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, islice, permutations
from typing import Any

import numpy as np
from scipy import linalg, special
from scipy.sparse.csgraph import connected_components

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.diagnosis import RivalPair
from elastocal.diagnosis.diagnosis_data import DiagnosisData, diagnosis_data_of
from elastocal.diagnosis.evidence import evidence_of
from elastocal.diagnosis.model_set import PLAUSIBLE, packed_columns, spans_of
from elastocal.diagnosis.noise_floor import NoiseValues
from elastocal.diagnosis.rivals import (
    RivalSet,
    Suspects,
    alternatives,
    as_diagnosed,
    columns_of_starts,
)
from elastocal.diagnosis.verdict import TOO_NEAR, TOO_NEAR_PROBABILITY
from elastocal.measurements import Measurements, visits, with_moves
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.candidates import draw
from elastocal.planning.feasibility import Feasibility
from elastocal.simulation import simulate
from elastocal.units import Array, BoolArray, IntArray

CANDIDATES, FEWEST_POSES = 256, 64
NEWTON = 1.0  # forces are told apart to this
RARE = 0.1  # share of the visits below which a load state is not asked for again


@dataclass(frozen=True)
class VisitPool:
    """N candidates, each one pose with its side of approach and moment, in all load states.

    `q` (N, n); `approach` (N, n) of ±1 and `time` (N,) s where the table has them; `forces`
    (L, 3) N.  `table` holds their rows: candidate by candidate, load by load, marker by marker,
    with the readings that the fitted model expects; those `hidden` (rows,) the tracker cannot make.
    """

    q: Array
    approach: Array | None
    time: Array | None
    forces: Array
    table: Measurements
    hidden: BoolArray

    def __len__(self) -> int:
        return len(self.q)


def draw_pool(
    model: Model, x: Array, table: Measurements, *, sides: bool, waits: bool, most: int, seed: int
) -> VisitPool:
    """Candidates that the cell's rules allow, after the campaign of `table`.

    Some CANDIDATES, or `most` where memory is short, of FEWEST_POSES poses at least.  With
    `sides` every pose comes twice, each joint from either side; with `waits` twice too: at once
    and after as long as the campaign took.  Both only where the table has such a column.

    Raises InsufficientDataError where no pose is feasible.
    """
    sides, waits = sides and table.approach is not None, waits and table.time is not None
    rng = np.random.default_rng(seed)
    forces = load_forces(table)
    n = max(min(CANDIDATES, most) // (1 + sides) // (1 + waits), FEWEST_POSES)
    cell, chain = model.cell, model.chain
    if cell.model.compliance_levels and not cell.design.levels:
        # A joint whose compliance is known at its levels only can be nowhere else.
        spec = replace(cell.design, levels=cell.model.compliance_levels)
        cell = replace(cell, design=spec)
    q = draw(Feasibility(cell, chain), forces, n, seed).q
    approach = time = None
    if table.approach is not None:
        approach = rng.choice([-1.0, 1.0], q.shape)
        if sides:
            q, approach = np.concatenate([q, q]), np.concatenate([approach, -approach])
    if table.time is not None:
        begin, step = table.time.max() + time_step(table), np.ptp(table.time)
        time = np.full(len(q), begin)
        if waits:
            q, time = np.concatenate([q, q]), np.concatenate([time, time + step])
            approach = None if approach is None else np.tile(approach, (2, 1))
    return visit_pool_of(model, x, table, q, approach, time, forces)


def visit_pool_of(
    model: Model, x: Array, table: Measurements, q: Array, approach: Array | None,
    time: Array | None, forces: Array,
) -> VisitPool:  # fmt: skip
    """The pool of these candidates, read as the model at `x` would be."""
    n, L, M = len(q), len(forces), len(table.marker_names)
    candidate = np.repeat(np.arange(n), L * M)
    known = len(table.configuration_labels)
    rows = replace(
        table.take(np.zeros(len(candidate), dtype=np.int64)),
        row=np.zeros(len(candidate), dtype=np.int64),  # no line of any file
        q=q[candidate],
        configuration=known + candidate,
        configuration_labels=table.configuration_labels + tuple(f"candidate {i}" for i in range(n)),
        repeat=np.zeros(len(candidate), dtype=np.int64),
        marker=np.tile(np.arange(M), n * L),
        force=forces[np.tile(np.repeat(np.arange(L), M), n)],
        approach=None if approach is None else approach[candidate],
        time=None if time is None else time[candidate],
    )
    if table.temperature is not None:
        rows = replace(rows, temperature=np.full(len(rows), np.median(table.temperature)))
    if table.move is not None:
        rows = with_moves(rows)  # from one candidate to the next, as good as any order
    read = simulate(model, rows, x, 0, noise=False)
    return VisitPool(q, approach, time, forces, read, _hidden(model, q, forces, table.marker_names))


def _hidden(model: Model, q: Array, forces: Array, markers: tuple[str, ...]) -> BoolArray:
    """(N·L·M,): the tracker does not see the marker of pose q (N, n) under that of `forces` (L, 3),
    or for deflections under another of them."""
    seen, stated = Feasibility(model.cell, model.chain).seen, list(model.cell.tool.markers)
    if seen is None:
        return np.zeros(len(q) * len(forces) * len(markers), dtype=bool)
    own = [stated.index(name) for name in markers]
    hidden = np.stack([~seen(q, force)[:, own] for force in forces], axis=1)
    if model.observe == "deflection":
        hidden |= hidden.any(axis=1, keepdims=True)
    return hidden.ravel()


def load_forces(table: Measurements) -> Array:
    """The table's usual load states (L, 3) N; the mean load where every visit has its own."""
    _, first = np.unique(visits(table), return_index=True)
    force = table.force[first]
    _, group, count = np.unique(
        np.round(force / NEWTON), axis=0, return_inverse=True, return_counts=True
    )
    usual = np.flatnonzero(count >= RARE * len(force))
    loaded, group = np.any(force != 0, axis=1), group.ravel()
    if not len(usual) or (loaded.any() and not loaded[np.isin(group, usual)].any()):
        return np.array([force[part].mean(axis=0) for part in (~loaded, loaded) if part.any()])
    means = [force[group == k].mean(axis=0) for k in usual]
    return np.array(sorted(means, key=lambda f: float(np.linalg.norm(f))))


def time_step(table: Measurements) -> float:
    assert table.time is not None
    moments = np.unique(table.time)
    return float(np.median(np.diff(moments))) if len(moments) > 1 else 0.0


def joined(first: Measurements, second: Measurements) -> Measurements:
    """Both tables' rows; the second's labels hold for both, its columns are the first's.

    How the arm came to each visit follows from the order of them all.
    """
    first, known = replace(first, move=None, direction=None), first.move is not None
    arrays: dict[str, Any] = {
        f.name: np.concatenate([value, getattr(second, f.name)])
        if isinstance(value, np.ndarray) else value
        for f in fields(first)
        if isinstance(value := getattr(first, f.name), np.ndarray) or value is None
    }  # fmt: skip
    table = replace(second, source=first.source, **arrays)
    return with_moves(table) if known else table


def with_pool(
    base: Baseline, pool: VisitPool, suspects: Suspects
) -> tuple[DiagnosisData, DiagnosisData, NoiseValues]:
    """Columns of the data so far and of the pool at the fit, of the data alone, and the noise that
    the diagnosis found; faulty readings and those of markers that are not seen left out.

    Candidates are read as precisely as the same marker was on average.
    """
    table = base.observed.table
    observed = observe(joined(table, pool.table), base.model.observe)
    n, size, stated = len(base.observed.lead), observed.size, base.covariance
    marker = table.marker[base.observed.lead]
    usual = np.zeros((len(table.marker_names), size, size))
    usual[:] = stated.mean(axis=0)
    for k in np.unique(marker):
        usual[k] = stated[marker == k].mean(axis=0)
    later = observed.table.marker[observed.lead[n:]]
    both = replace(
        base, observed=observed, stated=np.concatenate([stated, usual[later]]),
        residual=np.concatenate([base.residual, np.zeros(size * len(later))]), planned=len(later),
    )  # fmt: skip
    dataset, noise = as_diagnosed(diagnosis_data_of(both, suspects.hypotheses), suspects.diagnosis)
    hidden = np.concatenate([np.zeros(len(table), dtype=bool), pool.hidden])[observed.lead]
    dataset = dataset.without(dataset.data.faulty | hidden)
    blocks, measured = dataset.blocks, len(np.unique(table.configuration[base.observed.lead]))
    planned = np.isin(np.arange(blocks.n), blocks.member[measured:])
    return dataset, dataset.without(planned | dataset.data.faulty), noise


def eliminated(gram: Array, nuisance: int) -> tuple[Array, Array]:
    """Schur complement of the nuisance in gram (w, w), and its inverse Gram (p, p)."""
    factor = linalg.cho_factor(gram[:nuisance, :nuisance])
    inverse = linalg.cho_solve(factor, np.eye(nuisance))
    cross = gram[:nuisance, nuisance:]
    return gram[nuisance:, nuisance:] - cross.T @ inverse @ cross, inverse


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


@dataclass(frozen=True)
class Discrimination:
    """One set of rivals to be told apart, with everything that judges a choice of candidates.

    With whitened columns W, `known` (w, w) is WᵀV⁻¹W of the data so far with the nuisance's prior
    precision, `pool` (N, m, w) V^−½W of each candidate.  The `nuisance` first columns are those of
    the fitted parameters and of the effects beside the rivals.  Counted from there come each
    rival's own, at `groups`, and at `alternatives` those with which it may imitate others instead:
    at other settings or about other starts, each by itself.  `draws`: γ (draws, k) of each rival;
    `before` (rivals, rivals, draws) d² in the data so far; `classes` (rivals,): those with the same
    number are not asked to be told apart.
    """

    rivals: RivalSet
    known: Array
    pool: Array
    nuisance: int
    groups: tuple[slice, ...]
    alternatives: tuple[tuple[slice, ...], ...]
    draws: tuple[Array, ...]
    before: Array
    classes: IntArray

    @classmethod
    def of(
        cls, dataset: DiagnosisData, so_far: DiagnosisData, noise: NoiseValues, candidates: int,
        rivals: RivalSet, rng: np.random.Generator,
    ) -> Discrimination:  # fmt: skip
        """Columns of the rivals whitened by V, the covariance of each configuration; of those of
        the dataset the last are `candidates`."""
        data, measured = dataset.data, len(dataset.data.X) - candidates
        searched = alternatives(so_far, noise, rivals)
        # What is beside counts by the widest size of its prior.
        beside = [
            packed_columns(dataset, item) * float(item.scales.max()) for item in rivals.beside
        ]
        others = [
            [*(packed_columns(dataset, i) for i in items), *columns_of_starts(dataset, rival)]
            for rival, items in zip(rivals.rivals, searched, strict=True)
        ]
        own = [packed_columns(dataset, rival) for rival in rivals.rivals]
        own += chain.from_iterable(others)
        fitted, n = data.X.shape[2], len(rivals.rivals)
        nuisance = fitted + sum(C.shape[2] for C in beside)
        W = np.concatenate([data.X, *beside, *own, data.r[:, :, None]], axis=2)
        L = np.linalg.cholesky(data.V(noise))
        white = np.linalg.solve(L, data.masked(W))
        known = white[:measured].reshape(-1, W.shape[2])
        gram = known.T @ known
        gram[np.diag_indices(nuisance)] += np.append(data.precision, np.ones(nuisance - fitted))
        widths = [C.shape[2] for C in own]
        spans = spans_of(widths, sum(widths))
        groups, rest = spans[:n], iter(spans[n:])
        by = tuple(tuple(islice(rest, len(each))) or (groups[b],) for b, each in enumerate(others))
        S = eliminated(gram, nuisance)[0]
        draws = _posterior_draws(rivals, groups, S, rng)
        start = cls(
            rivals, gram[:-1, :-1], white[measured:, :, :-1], nuisance, groups, by,
            draws, np.zeros((n, n, 2 * DRAWS)), np.arange(n),
        )  # fmt: skip
        return replace(start, before=start._squared(S[None, :-1, :-1])[0])

    @property
    def open(self) -> bool:
        return bool(np.any(self.classes != self.classes[0]))

    def gram(self, chosen: Sequence[int]) -> Array:
        """Gram matrix (w, w) of the data so far and the chosen candidates."""
        H = self.pool[list(chosen)].reshape(-1, len(self.known))
        return self.known + H.T @ H

    def squared(self, gram: Array) -> Array:
        """d² (rivals, rivals, draws) of every ordered pair; zero of a rival with itself."""
        return self._squared(eliminated(gram, self.nuisance)[0][None])[0]

    def squared_with_each(self, gram: Array) -> Array:
        """d² (N, rivals, rivals, draws) with each candidate added to the visits behind `gram`.

        A candidate's few rows H = [H_X, H_R] change S by EᵀK⁻¹E with E = H_R − H_X M⁻¹ M_XR and
        K = I + H_X M⁻¹ H_Xᵀ (Woodbury), which spares an elimination for each.
        """
        p = self.nuisance
        S, inverse = eliminated(gram, p)
        H = self.pool
        through = H[:, :, :p] @ inverse
        E = H[:, :, p:] - through @ gram[:p, p:]
        K = np.eye(H.shape[1]) + through @ H[:, :, :p].transpose(0, 2, 1)
        return self._squared(S + E.transpose(0, 2, 1) @ np.linalg.solve(K, E))

    def _squared(self, S: Array) -> Array:
        n = len(self.draws)
        out = np.zeros((len(S), n, n, 2 * DRAWS))
        for a, b in permutations(range(n), 2):
            of_a, g = self.groups[a], self.draws[a]
            size = PLAUSIBLE * self.rivals.rivals[b].scales.max()
            nearest = np.full((len(S), len(g)), np.inf)
            for of_b in self.alternatives[b]:
                tie = np.eye(of_b.stop - of_b.start) / size**2
                taken = np.linalg.solve(S[:, of_b, of_b] + tie, S[:, of_b, of_a])
                D = S[:, of_a, of_a] - S[:, of_a, of_b] @ taken
                nearest = np.minimum(nearest, ((g @ D) * g).sum(axis=2))
            out[:, a, b] = np.maximum(nearest, 0.0)
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
        each = [evidence_of(lam[None], beta[None], np.array([s]))[0] for s in item.scales]
        precision = lam + 1 / item.scales[int(np.argmax(each))] ** 2
        z = rng.normal(size=(DRAWS, len(lam))) / np.sqrt(precision)
        out.append((beta / precision + np.concatenate([z, -z])) @ U.T)
    return tuple(out)


# The sets of rivals of a diagnosis over a pool, and which of them any poses can tell apart.

# A pair that all candidates together would not tell apart with this probability is inseparable.
HOPE = 0.9
APART_AT_LAST = 2 * float(special.ndtri(HOPE))  # the distance that it takes


def discriminations_of(
    base: Baseline, pool: VisitPool, suspects: Suspects, seed: int
) -> list[Discrimination]:
    dataset, so_far, noise = with_pool(base, pool, suspects)
    sets = [*suspects.sets, *([suspects.unknown_set(so_far, noise)] if suspects.unknown else [])]
    return [
        Discrimination.of(dataset, so_far, noise, len(pool), s, np.random.default_rng(seed))
        for s in sets
    ]


def judged(
    tasks: Sequence[Discrimination],
) -> tuple[list[Discrimination], dict[tuple[str, str], float]]:
    """Each set in classes that the whole pool could tell apart, and the pairs that it could not,
    with their distance in all of it."""
    out, hopeless = [], {}
    for c in tasks:
        d = c.distances(c.squared(c.gram(range(len(c.pool)))))
        near = d < APART_AT_LAST
        classes = connected_components(near, directed=False)[1].astype(np.int64)
        out.append(replace(c, classes=classes))
        names = c.rivals.names
        for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
            hopeless[names[a], names[b]] = float(d[a, b])
    return out, hopeless


def together(c: Discrimination) -> Iterator[tuple[str, ...]]:
    for k in np.unique(c.classes):
        names = [name for name, own in zip(c.rivals.names, c.classes, strict=True) if own == k]
        if len(names) > 1:
            yield tuple(names)


def pairs_of(tasks: Sequence[Discrimination], chosen: Sequence[int]) -> tuple[RivalPair, ...]:
    out = []
    for c in tasks:
        before, after = c.distances(c.before), c.distances(c.squared(c.gram(chosen)))
        names = c.rivals.names
        for a, b in zip(*np.triu_indices(len(names), 1), strict=True):
            out.append(RivalPair(names[a], names[b], float(before[a, b]), float(after[a, b])))
    return tuple(out)
