"""What a sum of components says: shares of the gap, findings with names, fields without."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg
from scipy.special import expit, softmax

from elastocal.diagnosis.baseline import NoisyData, Projection, Weighted, project
from elastocal.diagnosis.component_search import exchanged, imitators, size_of_fellows
from elastocal.diagnosis.components import (
    GONE,
    LARGEST,
    Component,
    FittedSum,
    at_maximum,
    drawn,
    presence_cost,
)
from elastocal.diagnosis.diagnosis import (
    LARGE,
    ComponentShare,
    Curve,
    EffectAt,
    EffectGroup,
    FittedParameter,
    FoundEffect,
    Interval,
    Location,
    StructureTest,
    Verdict,
)
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import doubt, gains, spans_of
from elastocal.diagnosis.noise_floor import (
    NEW_POSES,
    SupportedFloor,
    each_left_out,
    rms_with_interval,
    squared_lengths,
    with_intervals,
)
from elastocal.identification.scrutiny import BudgetStep
from elastocal.model.effects.base import Stage, index
from elastocal.model.effects.geometry import GearSpectrum
from elastocal.model.effects.smooth import JointCurve
from elastocal.units import Array, BoolArray, IntArray

DRAWS = 400
DETERMINED = 1e-4  # of the largest, singular value of columns of unit length
MOST_POSES = 1500  # that a set of new poses is drawn from
PROBABLE = 0.5
NAMED = 0.9  # probability from which an effect is named without rivals beside it
CHANCE = 0.05  # probability from which a rival or a share is told
PAYS = 0.01  # of the error of left-out configurations, by which a name has to lower it
HARM = 2.0  # standard errors by which they are predicted worse with what is taken out of the sum
TOLD = 0.02  # share of the gap from which it matters which of several effects it is
SLIGHT = 0.01  # of the gap's rms: what moves the markers by less is next to nothing


# A parameter whose deviation grows by more under a prior so much weaker is undetermined.
WEAKER, HELD_BY_PRIOR = 1e-3, 2.0


def held_by_prior(D: Array, precision: Array) -> BoolArray:
    """Which coefficients (k,) of posterior covariance DᵀD are known by their own prior, of this
    precision (k,), alone."""
    covariance = D.T @ D
    without = np.linalg.inv(covariance) - (1 - WEAKER) * np.diag(precision)
    grown = np.diag(np.linalg.inv(without)) / np.diag(covariance)
    return np.asarray(grown > HELD_BY_PRIOR**2)


def pays(without: Array, now: Array) -> bool:
    """Whether the squared errors of left-out configurations say that a name lowers the error."""
    return bool(without.sum() > (1 + PAYS) ** 2 * now.sum())


@dataclass(frozen=True)
class SumAnswer:
    """The pieces of a diagnosis that a sum of components fills.  `before` has the columns of the
    cell's own parameters, `dataset` those beside the weights of links where the sum has them.
    `hidden` may be there as well: shares and intervals, not names, count with them.  `instead` is
    what the sum would be if some kinds of it did not exist."""

    before: DiagnosisData
    dataset: DiagnosisData
    found: FittedSum
    hidden: tuple[Component, ...]
    rng: np.random.Generator
    instead: Mapping[str, FittedSum]

    @cached_property
    def at(self) -> Projection:
        return Projection(self._weighted, self._wide.precision)

    @cached_property
    def _fitted(self) -> Projection:
        return project(self.found.data, self.found.noise)

    @cached_property
    def _weighted(self) -> Weighted:
        return Weighted.of(self._wide, self.found.noise)

    @cached_property
    def _wide(self) -> NoisyData:
        data = self.found.data
        for c in self.hidden:
            precision = np.full(c.width, np.exp(-2 * size_of_fellows(self.found, c)))
            data = data.with_columns(data.masked(c.columns), precision)
        return data

    @cached_property
    def _spans(self) -> tuple[slice, ...]:
        widths = [c.width for c in self._every]
        return spans_of(widths, sum(widths))

    @property
    def _every(self) -> tuple[Component, ...]:
        return (*self.found.components, *self.hidden)

    @cached_property
    def _own(self) -> int:
        """Number of the columns that were fitted before."""
        return self.dataset.data.X.shape[2]

    @cached_property
    def _rows(self) -> BoolArray:
        data = self.found.data
        of_size = np.arange(data.r.shape[1]) % data.blocks.size < 3
        return np.asarray(~data.left_out & of_size[None, :])

    @cached_property
    def _drawn(self) -> Array:
        """Posterior draws (p + Σ k, draws) of the fitted columns' coefficients and of these."""
        return drawn(self.found, self.hidden, self._weighted, self._wide.precision, DRAWS, self.rng)

    @cached_property
    def moved(self) -> Array:
        """C (rows, Σ k) in m: C w is what coefficients w leave of the positions once the fitted
        parameters have followed them, at equal weights.  They follow in the directions that the
        readings determine, not in what rounding leaves of parallel axes; what is only uncertain of
        the load's point is no fitted parameter."""
        before = self.before
        B = before.data.X[self._rows][:, np.isin(before.fitted, before.base.model.names)]
        B = B / np.maximum(np.linalg.norm(B, axis=0), 1e-300)
        U, size, _ = linalg.svd(B, full_matrices=False)
        known = U[:, size > DETERMINED * size.max(initial=0.0)]
        moved = self._wide.X[self._rows][:, self._own :]
        return np.asarray(moved - known @ (known.T @ moved))

    @cached_property
    def gram(self) -> Array:
        """G (Σ k, Σ k): w'Gw is the mean square in m² per reading that coefficients w leave."""
        return np.asarray(self.moved.T @ self.moved / self._left_out[1].sum())

    @cached_property
    def _poses(self) -> tuple[IntArray, Array, Array]:
        """Rows that show what new poses may be like, the share of each of their configurations in
        what poses there may be, and how often it is drawn among NEW_POSES (configurations, draws).
        """
        rows = np.nonzero(self._rows)[0]
        known = np.unique(rows)
        some = known[np.linspace(0, len(known) - 1, min(MOST_POSES, len(known))).astype(int)]
        kept: IntArray = np.flatnonzero(np.isin(rows, some))
        # What poses there are is known from the campaign's only (Bayesian bootstrap, Rubin 1981).
        share = self.rng.dirichlet(np.full(len(some), len(known) / len(some)), DRAWS)
        return kept, share.T, self.rng.multinomial(NEW_POSES, share).T.astype(np.float64)

    def squares(self, members: Sequence[int]) -> Array:
        """Mean squares (draws,) in m² of what these components do together."""
        w = self._drawn[(index := self._index(members)) + self._own]
        return np.einsum("kd,kd->d", w, self.gram[np.ix_(index, index)] @ w)

    def _index(self, members: Sequence[int]) -> IntArray:
        return np.r_[(slice(0, 0), *(self._spans[k] for k in members))]

    def shares(self, members: Sequence[int]) -> Array:
        """The share (draws,) of the squared gap that goes when these components are added last: the
        mean square of what they do over that of the whole and of what is unexplained."""
        whole = self.total + self.supported.unexplained**2
        return self.squares(members) / np.maximum(whole, 1e-300)

    @cached_property
    def supported(self) -> SupportedFloor:
        """What of the noise beside the sum is noise, and what is unexplained."""
        squares, count = self._left_out
        best = math.sqrt(squares.sum() / count.sum())
        return SupportedFloor(self.dataset, self.found.data, self.found.noise, best)

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        return self._left_out_without(())

    @cached_property
    def unexplained(self) -> float:
        """Rms length in m that is neither noise nor explained by a name: what is beyond the noise,
        and where that is more than the noise and a large part of the gap what only corrections
        without a name take away."""
        open_, floor = self.supported.unexplained, self.supported.noise
        left = self._left_by_names if self._unnamed else 0.0
        large = LARGE * (float(np.median(self.total)) + open_**2)
        return max(open_, math.sqrt(left)) if left > max(floor**2, large) else open_

    @cached_property
    def _left_by_names(self) -> float:
        """Mean square (m²) by which the names alone err at left-out configurations, beyond what
        noise and the uncertainty of their fit make of it: r_c − X_c β̂₋c has covariance P_cc⁻¹."""
        data, (P, u) = self.found.data, self._fitted_without(self._unnamed)
        squares, count = squared_lengths(data, each_left_out(P, u))
        variance = np.diagonal(np.linalg.inv(P), axis1=1, axis2=2)
        expected, _ = squared_lengths(data, np.sqrt(variance))
        return float(max((squares - expected).sum() / count.sum(), 0.0))

    @cached_property
    def total(self) -> Array:
        return self.squares(range(len(self._spans)))

    @property
    def decided(self) -> SumAnswer:
        """The same without what is not missed at left-out configurations and doubtful, harmful
        there, or hardly in any draw of what acts: with it the estimates would be other than the
        shares.  What they may take from others is in the shares still."""
        now = self._left_out[0]
        gone = [k for k in self._doubtful if not pays(self._left_out_without([k])[0], now)]
        answer = self._without(gone)
        missed = ((answer._at_place[key], gain) for key, gain in answer._not_paying.items())
        harmful = (own for own, gain in missed
                   if gain < -HARM or np.mean(answer.squares(own) > 0) < CHANCE)  # fmt: skip
        return answer._without([k for own in harmful for k in own])._sized

    @property
    def _sized(self) -> SumAnswer:
        """The same with sizes by draws: the rms of what each is where it is there.  Of two that
        look alike the most probable sizes may give one all that both do: sums are compared by them,
        but an eccentricity that stands for a sag is no estimate."""
        found, sizes = self.found, self.found.sizes.size.copy()
        for k, (c, span) in enumerate(zip(found.components, found.spans, strict=True)):
            squares = (self._drawn[span] ** 2).mean(axis=0)
            if c.hypothesis is not None and not c.settings and squares.any():
                sizes[k] = 0.5 * np.log(squares[squares > 0].mean())
        at = replace(found.sizes, size=np.clip(sizes, GONE, LARGEST))
        return replace(self, found=replace(at_maximum(found.sums, at), score=found.score))

    @cached_property
    def _doubtful(self) -> list[int]:
        """Effects of next to no share that are probably something else: guesses, as causes."""
        improbable = (k for k in self._rivals if self._probability(k) < PROBABLE)
        return [k for k in improbable if abs(np.median(self.shares([k]))) < TOLD]

    def _without(self, gone: Sequence[int]) -> SumAnswer:
        if not gone:
            return self
        removed = [self.found.components[k] for k in gone]
        return replace(self, found=exchanged(self.found, removed), hidden=(*self.hidden, *removed))

    @cached_property
    def _not_paying(self) -> dict[tuple[str, str], float]:
        """Named effects at their places without which configurations that are left out of the fit
        are predicted better, or worse by less than PAYS: by how many standard errors worse.  The
        one that matters least is judged first and stays out: of two alike, one remains."""
        gone: list[int] = []
        out: dict[tuple[str, str], float] = {}
        free = {k for k, c in enumerate(self.found.components) if c.named and not c.given}
        named = {key: own for key, own in self._at_place.items() if free.issuperset(own)}
        now = self._left_out[0]
        while named:
            without = {key: self._left_out_without([*gone, *own])[0] for key, own in named.items()}
            key = min(without, key=lambda key: without[key].sum())
            if pays(without[key], now):
                break
            change = without[key] - now
            out[key] = float(change.sum() / max(change.std() * math.sqrt(len(change)), 1e-300))
            now = without[key]
            gone += named.pop(key)
        return out

    def _left_out_without(self, gone: Sequence[int]) -> tuple[Array, Array]:
        """Σ of squared errors (C,) in m² of left-out configurations, these components not in the
        fit, and the number of readings."""
        return squared_lengths(self.found.data, each_left_out(*self._fitted_without(gone)))

    def _fitted_without(self, gone: Sequence[int]) -> tuple[Array, Array]:
        """P (C, m, m) of each configuration and u = P r (C, m) without these components, of mean β̂:
        P grows by ZZᵀ and u by Z R⁻ᵀβ̂."""
        at, (_, R, Z) = self._fitted, self._turned(gone)
        less = linalg.solve_triangular(R, at.beta[self._index(gone) + self._own], trans="T")
        return at.P + Z @ Z.transpose(0, 2, 1), at.u + Z @ less

    def _turned(self, gone: Sequence[int]) -> tuple[Array, Array, Array]:
        """Q and R of D, where these components' coefficients have the posterior covariance DᵀD,
        D = L⁻¹ there, and Z = HQ."""
        at = self._fitted
        Q, R = linalg.qr(at.beta_deviation[:, self._index(gone) + self._own], mode="economic")
        return Q, R, (at.H.reshape(-1, len(Q)) @ Q).reshape(*at.u.shape, len(R))

    @cached_property
    def components(self) -> tuple[ComponentShare, ...]:
        """One for each kind of dependence at each place, the largest first; none for what hardly
        moves the markers."""
        rows = []
        for (family, where), members in self._by(lambda c: (c.family, c.where)).items():
            if (there := self._matters(members)) < CHANCE:
                continue
            chosen = [self.found.components[k] for k in members]
            every = [k for k, c in enumerate(self._every) if (c.family, c.where) == (family, where)]
            rms, _, rms_ci95 = with_intervals(np.sqrt(self.squares(every)))
            rows.append(ComponentShare(
                family, where, tuple(dict.fromkeys(c.effect.name for c in chosen)),
                *with_intervals(self.shares(every))[:2], rms, rms_ci95,
                there, any(c.named for c in chosen),
            ))  # fmt: skip
        return tuple(sorted(rows, key=lambda row: -row.share))

    @cached_property
    def groups(self) -> tuple[EffectGroup, ...]:
        """One for each effect at all its places, lines and curves of joints as one; what the same
        does at others, where it hardly shows, is in the share."""
        groups = []
        for name, own in self._by(_kind).items():
            if members := [k for k in own if k not in self._slight]:
                chosen = [self.found.components[k] for k in members]
                places = tuple(sorted({c.where for c in chosen}))
                effects = tuple(dict.fromkeys(c.effect.name for c in chosen))
                share = with_intervals(self.shares(self._of_kind(name)))[:2]
                fall = self._reduction(members)[:2]
                groups.append(EffectGroup(name, places, effects, *share, *fall))
        return tuple(sorted(groups, key=lambda g: -g.share))

    def _of_kind(self, name: str) -> list[int]:
        return [k for k, c in enumerate(self._every) if _kind(c) == name]

    def _by(self, key: Callable[[Component], Any]) -> dict[Any, list[int]]:
        groups: dict[Any, list[int]] = {}
        for k, c in enumerate(self.found.components):
            if own := key(c):
                groups.setdefault(own, []).append(k)
        return groups

    @cached_property
    def _true(self) -> Array:
        """Readings without noise (rows, draws) of the configurations that are kept, each left out.
        θ* is drawn about the fit to the others, as uncertain as that is: what is read there then
        has the covariance P_cc⁻¹."""
        kept = self._poses[0]
        at, configuration = self.at, np.nonzero(self._rows)[0][kept]
        moved = self._wide.X[self._rows][kept] @ (self._drawn - at.beta[:, None])
        uncertain = np.linalg.inv(at.P) - self.found.data.V(self.found.noise)
        variance = np.diagonal(uncertain, axis1=1, axis2=2)[self._rows][kept]
        own, left_out = (
            np.bincount(configuration, each) for each in ((moved**2).mean(axis=1), variance)
        )
        grown = np.sqrt(np.maximum(left_out / np.maximum(own, 1e-300), 1.0))
        return self._predicted(self._of_all)[:, None] + moved * grown[configuration, None]

    @cached_property
    def _of_all(self) -> Array:
        """Residuals (C, m) of configurations left out of the fit of everything."""
        return each_left_out(self.at.P, self.at.u)

    def _predicted(self, left_out: Array) -> Array:
        return (self.found.data.r - left_out)[self._rows][self._poses[0]]

    def _error_without(self, gone: Sequence[int]) -> Array:
        """Mean square (draws,) in m² by which new poses err with these in no model."""
        P, u = self._fitted_without(gone)
        left_out = each_left_out(P, u)
        left = self._predicted(left_out)[:, None] - self._true  # (rows, draws)
        kept, share, times = self._poses
        rows = np.nonzero(self._rows)[0][kept]
        starts = np.flatnonzero(np.diff(rows, prepend=-1))
        each = (times * np.add.reduceat(left**2, starts, axis=0)).sum(axis=0)
        count = np.diff(np.append(starts, len(rows))) / min(self.found.data.blocks.size, 3)
        each /= (times * count[:, None]).sum(axis=0)
        by_fit = self._by_fit(gone, P, left_out)[rows[starts]]
        each *= np.exp((by_fit - by_fit.mean()) @ share / (count @ share) / each.mean())
        return np.asarray(each + self.supported.unexplained**2)

    def _by_fit(self, gone: Sequence[int], P: Array, left_out: Array) -> Array:
        """By how much (C,) in m² a pose counts beside its own error, as the fit that errs at the
        others hangs on it: infinitesimal jackknife of the mean square.  Without pose j, too, the
        error a_c where c is left out grows by P_cc⁻¹ P_cj e_j, P_cj = −H_c H_jᵀ, e as `left_out`.
        """
        Q, _, Z = self._turned(gone)
        H = self._fitted.H - Z @ Q.T
        errors = each_left_out(P, (self._of_all - left_out) * self._rows)
        of_error, of_pose = (np.einsum("cm,cmp->cp", one, H) for one in (errors, left_out))
        return np.asarray(2 * ((of_error.sum(axis=0) - of_error) * of_pose).sum(axis=1))

    @cached_property
    def _error(self) -> Array:
        return self._error_without(())

    def _reduction(self, members: Sequence[int]) -> tuple[float, Interval, Interval]:
        """Fraction by which the noise-free error of new poses falls when these components are added
        last.  A configuration c that is left out of a fit is a new pose for it.  Before, the error
        there is X_c β̂₋c − W_c θ*, after it W_c (θ̂₋c − θ*), with the columns W of all that is held
        to be true.  What is unexplained is no noise, and stays; so does a change for new readings
        that fall between its moment and the one that was found."""
        before = self._error_without(members)
        after = self._error + sum(self._mistimed(k) for k in members)
        return with_intervals(1 - np.sqrt(after / np.maximum(before, 1e-300)))

    def _mistimed(self, k: int) -> Array | float:
        """Mean square in m² by which new readings err for the moment of a change alone."""
        return 0.0

    @cached_property
    def _rivals(self) -> dict[int, dict[tuple[str, str], float]]:
        """Of each named component that has a hypothesis the probability of what it may be: by the
        evidence, and by what is there already of each kind."""
        out = {}
        places = Counter(h.effect.name for h in self.dataset.hypotheses)
        present = Counter(c.effect.name for c in self.found.components if c.hypothesis is not None)

        def odds(name: str, others: int) -> float:
            others = min(others, places[name] - 1)
            return presence_cost(places[name], others) - presence_cost(places[name], others + 1)

        angular = {(c.effect.name, c.where) for c in self.found.components if _of_gear(c)}
        named = [
            k for k, c in enumerate(self.found.components)
            if c.hypothesis is not None and not c.settings
        ]  # fmt: skip
        for k, own, others in imitators(self.dataset, self.found, named):
            c = self.found.components[k]
            assert c.hypothesis is not None
            if _of_gear(c):
                # Which harmonic of one joint's error it is decides nothing.
                others = {
                    key: evidence for key, evidence in others.items()
                    if key[1] != c.where and key not in angular
                }  # fmt: skip
            keys = [c.hypothesis.key, *others]
            prior = [odds(name, present[name] - (name == c.effect.name)) for name, _ in keys]
            p = softmax(np.array([own, *others.values()]) + prior)
            known = {key: float(v) for key, v in zip(keys, p, strict=True) if v >= CHANCE}
            out[k] = dict(sorted(known.items(), key=lambda pair: -pair[1]))
        return out

    @cached_property
    def indistinguishable(self) -> tuple[tuple[EffectAt, ...], ...]:
        sets = []
        for k, rivals in self._rivals.items():
            own = self.found.components[k].hypothesis
            assert own is not None
            alike = self._of_kind(_kind(self.found.components[k]))
            if k in self._slight or abs(float(np.median(self.shares(alike)))) < TOLD:
                continue
            if rivals.get(own.key, 0.0) < NAMED:
                keys = [own.key, *(key for key in rivals if key != own.key)][:3]
                sets.append(tuple(EffectAt(*key) for key in keys))
        largest = {f.effect: (f.effect, f.where) for f in reversed(self.effects)}
        for kind, doubted in self._replaced.items():
            if kind in largest and 1 - doubted < NAMED:
                there = ((c.effect.name, c.where) for c in self.instead[kind].components if c.named)
                new = dict.fromkeys(key for key in there if key not in self._at_place)
                sets.append(tuple(EffectAt(*key) for key in (largest[kind], *new))[:3])
        return tuple(s for s in sets if len(s) > 1)

    @cached_property
    def _replaced(self) -> dict[str, float]:
        """Of kinds without which there is another sum the probability that it is the right one."""
        return {
            kind: doubt(
                self.found.score - other.score, gains(self.found.data, other.data, self.found.noise)
            )
            for kind, other in self.instead.items()
        }

    @property
    def _unnamed(self) -> list[int]:
        return [k for k, c in enumerate(self.found.components) if not c.named]

    @property
    def unnamed_probability(self) -> float:
        return max(map(self._probability, self._unnamed), default=0.0)

    def location(self, tests: Sequence[StructureTest]) -> Location | None:
        """Where the largest cause acts, the largest without a name where the verdict is open;
        what each stage contributes, and how surely anything acts at each stage and place."""
        at_stage, at_place = self._by(_stage_of), self._by(lambda c: c.where)
        stages, places = (
            {key: float(self._present[own].max()) for key, own in groups.items()}
            for groups in (at_stage, at_place)
        )
        shares = {stage: float(np.median(self.shares(own))) for stage, own in at_stage.items()}
        unknown = self.verdict == "unknown_effect"
        chosen = (unknown and self._unnamed) or range(len(self.found.components))
        largest = max(chosen, key=lambda k: float(np.median(self.squares([k]))))
        c = self.found.components[largest]
        return Location.of(_stage_of(c), c.where, stages, places, tests, shares)

    @property
    def verdict(self) -> Verdict:
        nameless = bool(self._unnamed) and float(np.median(self.shares(self._unnamed))) > LARGE
        if nameless or not self.groups:  # something is there, and no name pays
            return "unknown_effect"
        return "ambiguous" if self.indistinguishable else "explained"

    @cached_property
    def effects(self) -> tuple[FoundEffect, ...]:
        """Each effect at a place once, the largest first."""
        return tuple(self._found_effects(named=True))

    @cached_property
    def slight(self) -> tuple[FoundEffect, ...]:
        return tuple(self._found_effects(named=True, slight=True))

    @cached_property
    def fields(self) -> tuple[FoundEffect, ...]:
        return tuple(self._found_effects(named=False))

    @property
    def _at_place(self) -> dict[tuple[str, str], list[int]]:
        return self._by(lambda c: (c.effect.name, c.where))

    @cached_property
    def _slight(self) -> set[int]:
        """Named components, by effect and place, that probably do not matter, or do not pay.  Where
        a kind does, and at which of its places these data do not tell, one of them stands for all:
        the most probable."""
        chance = {own[0]: self._matters(own) for own in self._at_place.values()}
        slight = set()
        for name, members in self._by(_kind).items():
            own = {k: p for k, p in chance.items() if k in members}
            likeliest = max(own, key=lambda k: own[k])
            spared = own[likeliest] < PROBABLE <= self._matters(members, self._of_kind(name))
            doubtful = {k for k, p in own.items() if p < PROBABLE}
            slight |= doubtful - {likeliest} if spared else doubtful
        slight |= {self._at_place[key][0] for key in self._not_paying} | {*self._doubtful}
        return {k for own in self._at_place.values() if own[0] in slight for k in own}

    def _matters(self, members: Sequence[int], together: Sequence[int] = ()) -> float:
        """Probability that these are there, and move the markers, `together` with others, by SLIGHT
        of the whole or more."""
        enough = self.squares(together or members) >= SLIGHT**2 * self.total
        return float(self._present[members].max() * enough.mean())

    def _found_effects(self, named: bool, slight: bool = False) -> Iterator[FoundEffect]:
        at_place = {
            key: own for key, own in self._at_place.items()
            if self.found.components[own[0]].named == named and (own[0] in self._slight) == slight
        }  # fmt: skip
        order = sorted(at_place.items(), key=lambda pair: -float(np.median(self.squares(pair[1]))))
        for (name, where), members in order:
            probability = max(self._probability(k) for k in members)
            sizes = {key: size for k in members for key, size in self._parameter_sizes(k)}
            yield replace(self._found_effect(name, where, members, probability), sizes=sizes)

    def _found_effect(
        self, name: str, where: str, members: list[int], probability: float
    ) -> FoundEffect:
        settings, fall = self._settings(members), self._reduction(members)
        known = [k for k in members if (h := self.found.components[k].hypothesis)
                 and not any(p.shrunk for p in h.parameters)]  # fmt: skip
        parameters = tuple(p for k in known for p in self._parameters(k))
        return FoundEffect(name, where, probability, *fall, parameters, settings)

    @cached_property
    def _present(self) -> Array:
        return np.asarray(expit(self.found.earned - self.found.sums.pool.costs(self.found.spread)))

    def _probability(self, k: int) -> float:
        c = self.found.components[k]
        there, hypothesis = float(self._present[k]), c.hypothesis
        there *= 1 - self._replaced.get(c.effect.name, 0.0)
        if k in self._rivals and hypothesis is not None:
            return there * self._rivals[k].get(hypothesis.key, CHANCE)
        return there

    def _settings(self, members: list[int]) -> dict[str, float]:
        found = [self.found.components[k] for k in members]
        sizes, lengths = self.found.sizes.size, self.found.sizes.length
        settings: dict[str, float] = {}
        if isinstance(found[0].effect, GearSpectrum):
            # One prior size for all families of a joint.
            size = math.sqrt(float(np.mean(np.exp(2 * sizes[members])))) * found[0].unit
            q = self.dataset.table.q[:, index(found[0].where)]
            centre = float((q.max() + q.min()) / 2)
            settings = {"spectrum_size_rad": size, "spectrum_centre_rad": centre}
            given = [[value for _, value in c.settings] for c in found]  # order, sd, order, sd, …
            lines = sorted(pair for one in given for pair in zip(one[::2], one[1::2], strict=True))
            for n, (order, sd) in enumerate(lines, start=1):
                settings |= {f"order_{n}": order, f"order_sd_{n}": sd}
            return settings
        for k, c in zip(members, found, strict=True):
            size, length = float(np.exp(sizes[k]) * c.unit), float(np.exp(lengths[k]))
            settings |= dict(c.settings)
            if c.follows:
                settings |= {f"field_{c.follows}_size": size, f"field_{c.follows}_length": length}
            elif isinstance(c.effect, JointCurve):
                settings |= {"curve_size_rad": size, "curve_length_rad": length}
            elif c.effect.sized_by:
                # The value that is stated is where the columns are of typical size.
                model = self.dataset.base.model
                stated = c.effect.stated(c.where, model.chain, model.cell)
                settings[c.effect.sized_by] = size * stated[c.effect.sized_by]
        return settings

    def _parameter_sizes(self, k: int) -> Iterator[tuple[str, float]]:
        c = self.found.components[k]
        if c.hypothesis is not None and not c.effect.sized_by:
            size = float(np.exp(self.found.sizes.size[k]))
            typical = self.dataset.sizes[c.hypothesis.key].tolist()
            for p, s in zip(c.hypothesis.parameters, typical, strict=True):
                if s > 0:
                    yield p.key, size * s

    def _parameters(self, k: int) -> Iterator[FittedParameter]:
        """Estimates of a component's parameters; deviations by draws, which know no sizes either,
        nor whether what is hidden is there."""
        c = self.found.components[k]
        assert c.hypothesis is not None
        span, sizes = self.found.spans[k], self.dataset.sizes[c.hypothesis.key]
        mean, D = sizes * self._fitted.beta[span], self._fitted.beta_deviation[:, span]
        apart = self._drawn[span] - self._fitted.beta[span, None]
        std = sizes * np.sqrt((apart**2).mean(axis=1))
        std[held_by_prior(D, self.found.data.precision[span])] = np.inf
        for p, m, s in zip(c.hypothesis.parameters, mean.tolist(), std.tolist(), strict=True):
            yield FittedParameter(f"{c.where}.{p.key}", p.nominal + m, p.unit, s)

    def budget(self, first: Sequence[BudgetStep]) -> tuple[BudgetStep, ...]:
        steps: list[BudgetStep] = list(first)
        members: list[int] = []
        for name, own in self._named_steps():
            members += own
            steps.append(self._step(name, members))
        if len(members) < len(self.found.components):
            everything = list(range(len(self.found.components)))
            nameless = sorted(self._unnamed, key=lambda k: -float(np.median(self.squares([k]))))
            places = dict.fromkeys(self.found.components[k].where for k in nameless)
            name = "unknown:" + "+".join(places) if places else "rest"
            steps.append(self._step(name, everything))
        return tuple(steps)

    def _named_steps(self) -> Iterator[tuple[str, list[int]]]:
        for group in self.groups[:MOST_STEPS]:
            yield f"{group.name}:{'+'.join(group.places)}", [
                k for k, c in enumerate(self.found.components)
                if c.named and c.where in group.places and c.effect.name in group.effects
                and k not in self._slight
            ]  # fmt: skip

    def _step(self, name: str, members: list[int]) -> BudgetStep:
        gone = [k for k in range(len(self.found.components)) if k not in members]
        left = each_left_out(*self._fitted_without(gone))
        return BudgetStep(name, *rms_with_interval(self.found.data, left, self.rng))

    def curves(self) -> tuple[Curve, ...]:
        out = []
        for k, c in enumerate(self.found.components):
            if not isinstance(c.effect, JointCurve) or c.waves is None:
                continue
            (_, low), (_, high) = c.settings
            x = np.linspace(low, high, 400)
            F = c.waves.at(x) * c.unit
            span = self.found.spans[k]
            y = F @ self.at.beta[span]
            sd = np.linalg.norm(F @ self.at.beta_deviation.T[span], axis=1)
            values = (tuple(v.tolist()) for v in (x, y - y.mean(), sd))
            out.append(Curve(f"{c.where} angle", "rad", c.where, "rad", *values))
        return tuple(out)


GEARS = "gear_errors"
MOST_STEPS = 4


def _stage_of(c: Component) -> Stage:
    if c.named:
        return c.effect.stage
    stages: dict[str, Stage] = {"joint": "transmission", "link": "geometry", "base": "tracker"}
    return next((s for kind, s in stages.items() if c.where.startswith(kind)), "tool")


def _kind(c: Component) -> str:
    """What a component is one of, wherever it acts; nothing where it has no name."""
    return (GEARS if _of_gear(c) else c.effect.name) if c.named else ""


def _of_gear(c: Component) -> bool:
    return c.family == "angle" and c.where.startswith("joint")
