"""Which noise model the readings support, and its weights."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, special

from elastocal.engine.mixed import ENOUGH, Full, LogPrior, Mixed, MixedFit, Pack, fit
from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.covariance import Covariance, orthogonal
from elastocal.identification.noise_structure import (
    EACH,
    JOINTS,
    LONGEST,
    REGISTERED,
    SHARED,
    STRUCTURES,
    TIME,
    Kind,
    Readings,
    Sets,
    SharedEffect,
    Structure,
    VisitRecord,
    along_axes,
    contrasts_of,
    drifts_of,
    faster_course,
    joint_effects,
    like,
    packs_of,
    shared_effects,
    visit_record,
)
from elastocal.identification.weighted_problem import (
    Weights,
    block_diagonal,
    least_norm,
    stated_by_observation,
    whitener,
)
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, polar_axes
from elastocal.units import Array, BoolArray, IntArray

TINY = 1e-100  # stands for the variance of perfect data: its square is still a number
LEAST_START = 1e-6  # of the largest: a variance smaller than that of a former fit is no start
FEWEST_TELLING = 10  # degrees of freedom of repeats, from which on they tell the noise


class NoisyReadings:
    """Readings under a kind of noise: its structure, what is shared, a course that is `lasting` so
    long, and all of that as a mixed model.

    Variances θ: those of single readings, of what drifts, of what is shared.  `whole` are the
    readings that the model is of, of which those `silent` (N,) are only there to be judged.
    """

    def __init__(
        self, readings: Readings, kind: Kind, lasting: float | None = None,
        structure: Structure | None = None, silent: BoolArray | None = None,
    ) -> None:  # fmt: skip
        self.readings, self.kind, self.lasting = readings, kind, lasting
        self.structure = structure or STRUCTURES[kind.own](readings)
        apart = []
        if kind.by_visit:
            if readings.visits is None:
                raise InputError(
                    f"'{kind.name}' needs the visits of the arm, which these readings do not tell"
                )
            apart.append(readings.visits.visit[:, 0])
        if kind.own == "stated":  # repeats that are stated alike
            stated = self.structure.matrix.reshape(len(readings), -1)
            apart.append(np.unique(stated, axis=0, return_inverse=True)[1].ravel())
        if silent is not None:
            apart.append(np.where(silent, 1 + np.arange(len(readings)), 0))  # each by itself
        self.sets = Sets(readings, self.columns(readings), apart)
        self.drifts = drifts_of(readings.size) if lasting is not None else ()
        self.silent = None if silent is None else silent[self.sets.first]

    def columns(self, readings: Readings) -> Array:
        """B of the readings (N, size, p + k) with the columns of what drifts."""
        if self.lasting is None or readings.visits is None:
            return readings.B
        waves = readings.visits.waves(self.lasting)
        return np.concatenate([readings.B, along_axes(waves, np.ones(readings.size))], axis=2)

    @property
    def own(self) -> int:
        """How many of the variances are those of single readings."""
        return len(self.structure.names)

    @property
    def spare(self) -> list[int]:
        """Own variances that may be none together, the others still giving every reading noise in
        every direction: the last that can be spared first."""
        theta = np.ones(self.own)
        found: list[int] = []
        if self.structure.index.shape[1] == 1 or self.structure.shrunk:
            return found
        for k in reversed(range(self.own)):
            theta[k] = 0.0
            if np.linalg.eigvalsh(self.structure.covariance(theta)).min() > 0:
                found.append(k)
            else:
                theta[k] = 1.0
        return found

    @cached_property
    def shared(self) -> tuple[SharedEffect, ...]:
        readings = self.readings
        found: tuple[SharedEffect, ...] = ()
        if self.kind.shared:
            found = shared_effects(readings)
            if len(self.sets.contrasts) * readings.size < FEWEST_TELLING:
                # Nothing but repeats tells a deviation of each set from the noise of single
                # readings, and a few of them may agree by chance.
                n = self.sets.n
                found = tuple(e for e in found if len(np.unique(e.unit)) < n) or found
            if not found:
                raise InputError(
                    f"'{self.kind.own}{SHARED}' needs repeats or several markers in a "
                    "configuration; this table has one reading in each"
                )
        if self.kind.joints:
            assert readings.visits is not None
            found += joint_effects(readings.visits, self.kind.joints == EACH)
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Of all variances."""
        return (
            *self.structure.names, *(name for name, _ in self.drifts),
            *(e.name for e in self.shared),
        )  # fmt: skip

    @cached_property
    def deviations(self) -> list[tuple[int, SharedEffect]]:
        """All that readings share beside a course's waves, with the numbers of its variance."""
        first = self.own + len(self.drifts)
        found = list(enumerate(self.shared, first))
        if self.lasting is not None and self.readings.visits is not None:
            for k, (_, axes) in enumerate(self.drifts, self.own):
                found.append((k, faster_course(self.readings.visits, self.lasting, axes)))
        return found

    @cached_property
    def packs(self) -> list[tuple[IntArray, Pack]]:
        numbers, effects = zip(*self.deviations, strict=True) if self.deviations else ((), ())
        together = self.readings.configuration[self.sets.first] if effects else None
        return packs_of(self.sets, self.structure, effects, numbers, together, self.silent)

    def model(self, prior: LogPrior | None = None) -> Mixed:
        """With a course in time: its coefficients are columns of B, which readings of zero with the
        unknown variance hold.  Restricted likelihood is then that of the course taken for noise
        (Henderson 1975), and nothing as large as the table squared is formed."""
        packs = [pack for _, pack in self.packs]
        if len(self.sets.contrasts):
            packs.append(contrasts_of(self.sets, self.structure))
        p, size = self.sets.B.shape[2], self.readings.size
        if held := p - self.readings.n_parameters:
            number = np.tile(self.own + np.arange(len(self.drifts)), (held // size, 1))
            along = np.array([np.diag(axes) for _, axes in self.drifts])
            parts = (Full(number, np.tile(along, (held // size, 1, 1, 1))),)
            B = np.eye(held, p, p - held).reshape(-1, size, p)
            packs.append(Pack(B, np.zeros(B.shape[:2]), parts, np.zeros(B.shape[:2], dtype=bool)))
        return Mixed(tuple(packs), len(self.names), np.zeros(p), prior)

    def start(self, like: Fitted | None = None) -> Array:
        """Variances (K,) to start from: of `like` where it has them; else own ones from the scatter
        of repeats where there is any, or from all residuals, and shared ones a tenth of these."""
        sets, size, e2 = self.sets, self.readings.size, (self.sets.e**2).mean(axis=1)
        # Variance of one reading that θ = 1 would give: 1, but for noise that is stated.
        unit = np.trace(self.structure.matrix.sum(axis=1), axis1=1, axis2=2)[sets.first] / size
        own = float(np.median(e2 / unit))
        if dof := sets.contrasts.size:
            # A few repeats may agree by rounding: from near zero the search does not come back.
            own = max((float((sets.contrasts**2).sum()) + own / dof) / (dof + 1 / dof), 1e-9 * own)
        share = 0.1 * float((self.readings.e**2).mean())
        moved = [
            float((e.loading**2).sum(axis=(1, 3)).mean()) if e.joints else 1.0 for e in self.shared
        ]
        theta = np.concatenate([
            np.full(self.own, own), np.full(len(self.drifts), share),
            share / np.array(moved),
        ])  # fmt: skip
        theta = np.maximum(theta, TINY)
        if like is None:
            return theta
        known = dict(zip(like.noisy.names, like.theta, strict=True))
        same = like.noisy.structure.names == self.structure.names
        least = LEAST_START * float(like.own.max())
        for k, name in enumerate(self.names):
            if (v := known.get(name, 0.0)) > (least if k < self.own else 0.0):
                theta[k] = v if same or k >= self.own else theta[k]
        return theta


@dataclass(frozen=True)
class Fitted:
    """A kind of noise fitted to readings."""

    noisy: NoisyReadings
    fit: MixedFit

    @property
    def structure(self) -> Structure:
        return self.noisy.structure

    @property
    def shared(self) -> tuple[SharedEffect, ...]:
        return self.noisy.shared

    @property
    def theta(self) -> Array:
        return self.fit.theta

    @property
    def own(self) -> Array:
        return self.theta[: self.noisy.own]

    @property
    def drift(self) -> Array:
        return self.theta[self.noisy.own : self.noisy.own + len(self.noisy.drifts)]

    @property
    def common(self) -> Array:
        return self.theta[self.noisy.own + len(self.noisy.drifts) :]

    @property
    def lasting(self) -> float | None:
        return self.noisy.lasting

    @property
    def log_likelihood(self) -> float:
        return self.fit.log_likelihood

    @property
    def told(self) -> list[SharedEffect]:
        """What is shared and was found."""
        return [e for e, v in zip(self.shared, self.common, strict=True) if v > 0]

    @property
    def found(self) -> Kind:
        """The kind without what is shared and was not found, with which it is the same model."""
        joints = self.noisy.kind.joints if any(e.joints for e in self.told) else ""
        shared = self.noisy.kind.shared and any(not e.joints for e in self.told)
        return self.noisy.kind._replace(shared=shared, joints=joints)


def fitted(
    readings: Readings, kind: Kind, like: Fitted | None = None, lasting: float | None = None,
    enough: float = ENOUGH,
) -> Fitted:  # fmt: skip
    """A model's fit; the search starts from the variances of `like` where it has the same.

    What drifts is `lasting` so long, as in `like`, or as is the most likely.
    """
    if kind.time and readings.visits is not None:
        if not readings.visits.drifts:
            raise InputError(
                "no drift can be recognised in these readings: the model itself has what changes "
                "with time, or successive poses are near each other; visit poses in random order"
            )
        if lasting is None and (like is None or like.lasting is None):
            tried = [fitted(readings, kind, like, each, enough) for each in readings.visits.lasting]
            return max(tried, key=lambda one: one.log_likelihood)
        lasting = lasting if lasting is not None or like is None else like.lasting
    noisy, prior = NoisyReadings(readings, kind, lasting if kind.time else None), None
    start = noisy.start(like)
    if noisy.structure.shrunk:
        if kind.time:
            raise InputError(f"'{kind.own}' has a prior, with which no drift can be estimated")
        prior = prior_of_groups(noisy)
        if like is None or like.structure.names != noisy.structure.names:
            start[: noisy.own] = np.exp(prior.mean)
    # Without what drifts its waves have no prior.
    shared = range(noisy.own + len(noisy.drifts), len(start))
    return Fitted(noisy, fit(noisy.model(prior), start, (*noisy.spare, *shared), enough))


# Many variances from few readings each: shrink their logarithms towards one another.
#
# Empirical Bayes in the spirit of Smyth 2004 (Stat. Appl. Genet. Mol. Biol. 3, 3), with a lognormal
# prior that knows direction and configuration: log θ_ca = μ_a + u_c + v_ca, where u ~ N(0, ω_u) and
# v ~ N(0, ω_v).  A sample variance s² on f degrees of freedom has log s² = log θ + ψ(f/2) −
# log(f/2) plus scatter of variance ψ'(f/2), from which an analysis of variance finds μ, ω_u and
# ω_v.

FEWEST = 2.0  # degrees of freedom of a group, at the median, below which there is nothing to shrink
NARROWEST = 1e-3  # variance of log θ: equal to within 3 %


def prior_of_groups(noisy: NoisyReadings) -> LogPrior:
    """Prior of the group variances from the scatter of a group's sets about their own mean, less a
    fit with the plain mean of repeats.  What all sets of a group share is taken out with the mean.

    Raises InsufficientDataError where the groups hold too few readings.
    """
    sets, size, K = noisy.sets, noisy.readings.size, noisy.own
    group = noisy.structure.index[sets.first]
    B, e = sets.B.reshape(-1, sets.B.shape[2]), sets.e.ravel()
    repeats = np.repeat(sets.root**2, size)
    residual = (e - B @ least_norm(B, e)) / np.sqrt(repeats)
    g = group.ravel()
    count = np.bincount(g, repeats, K)
    mean = np.bincount(g, repeats * residual, K) / count
    squares = np.bincount(g, repeats * (residual - mean[g]) ** 2, K)
    squares += np.bincount(group[sets.sets].ravel(), sets.contrasts.ravel() ** 2, K)
    f = np.maximum(count - 1.0, 0.5)
    if np.median(f) < FEWEST or 3 * size > K:
        raise InsufficientDataError(
            "the groups of a configuration and a direction hold too few readings for variances of "
            "their own; repeat readings, or choose another noise model"
        )
    s2 = squares / np.maximum(count - 1.0, 1.0)
    # A lucky group of (near) equal readings says little about its variance, not minus infinity.
    s2 = np.maximum(s2, max(1e-6 * float(np.median(s2)), TINY))
    z = (np.log(s2) - special.digamma(f / 2) + np.log(f / 2)).reshape(-1, size)
    noise = special.polygamma(1, f / 2)
    scatter, configurations = float(noise.mean()), len(z)
    mean = np.average(z, axis=0, weights=1 / noise.reshape(-1, size))
    u = (z - mean).mean(axis=1)
    omega_u, omega_v = float((u**2).sum() / (configurations - 1)), 0.0
    if size > 1:
        within = float(((z - mean - u[:, None]) ** 2).sum())
        omega_v = within / ((configurations - 1) * (size - 1)) - scatter
    omega_u -= (max(omega_v, 0.0) + scatter) / size
    block = max(omega_u, 0.0) * np.ones((size, size)) + max(omega_v, NARROWEST) * np.eye(size)
    precision = np.kron(np.eye(configurations), np.linalg.inv(block)).astype(np.float64)
    return LogPrior(np.tile(mean, configurations), precision)


def covariance_of(found: Fitted, rows: Array) -> tuple[Array, Array]:
    """Covariance and degrees of freedom of combinations `rows` of the fit's parameters."""
    return found.fit.expected.kenward_roger(found.fit.covariance, rows)


# The same noise of other readings.


def variances_of(found: Fitted, readings: Readings) -> tuple[Structure, Array, Array]:
    """The structure of these readings, its variances, and the variance of each of these.

    One that no reading of the fit has is the mean of all.
    """
    structure = like(found.structure, readings)
    place = {name: k for k, name in enumerate(found.structure.names)}
    known = np.array([place.get(name, -1) for name in structure.names])
    W = np.diag(found.fit.covariance)[: found.noisy.own]
    theta = np.where(known >= 0, found.own[known], found.own.mean())
    return structure, theta, np.where(known >= 0, W[known], W.max())


def own_noise(found: Fitted, readings: Readings) -> tuple[Array, Array]:
    """Covariance (N, size, size) of single readings, and degrees of freedom (N, size) behind it."""
    structure, theta, W = variances_of(found, readings)
    covariance = structure.covariance(theta)
    parts = np.diagonal(structure.matrix, axis1=2, axis2=3)  # (N, L, size)
    variance = np.einsum("nl,nla->na", W[structure.index], parts**2)
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    return covariance, np.maximum(2 * diagonal**2 / np.maximum(variance, 1e-300), 2.0)


def deviations_of(found: Fitted, readings: Readings) -> list[tuple[SharedEffect, float]]:
    """What these readings share beside the waves of a course, of variances that are not none."""
    record, told = readings.visits, {e.name for e in found.told}
    shared = shared_effects(readings, every=True) if found.noisy.kind.shared else ()
    if found.noisy.kind.joints and record is not None:
        shared += joint_effects(record, found.noisy.kind.joints == EACH)
    known = dict(zip(found.noisy.names, found.theta.tolist(), strict=True))
    out = [(e, known[e.name]) for e in shared if e.name in told]
    if found.lasting is not None and record is not None:
        out += [
            (faster_course(record, found.lasting, axes), known[name])
            for name, axes in found.noisy.drifts
        ]
    return out


# Which noise model the readings support, and its weights.

# Which noise model: what the readings allow is tried, and an information criterion decides.
#
#     criterion = −2ℓ + k_own · log(rows − p) + 2 · k_shared
#
# For the structure of single readings the price per variance is Schwarz's (BIC): one that is not
# clearly better only makes the judgement of faulty readings erratic; so for joints told apart.  For
# shared effects it is Akaike's (AIC): one that is left out wrongly makes intervals too narrow.

ROUGHLY = 1e-2  # of −2ℓ: what decides between models need not be finer
ROWS_PER_VARIANCE = 5  # degrees of freedom that a variance needs before it is worth trying
MOST_GROUPS = 1000  # configurations: their information matrix has (3 · 1000)² entries
# Readings, and those per parameter, that the choice is made from: so many tell a variance to 3 %.
CHOSEN_FROM, PER_PARAMETER = 2000, 20
# Scatter of the joints and a drift are added where a test finds a trace of them: a part that a test
# at this level does not find changes no interval.
TRACE = 0.05
MOST_TOGETHER = 300  # rows of a configuration, whose covariance is formed
FEWEST_VISITS, SEVERAL = 8, 2


@dataclass(frozen=True)
class Trial:
    """One noise model that was tried: how many variances it has, and its criterion."""

    kind: str
    n_variances: int
    criterion: float


@dataclass(frozen=True)
class NoiseTest:
    """A further part of the noise that was looked for: JOINTS or TIME, and the p-value of its being
    none, beside the model that was chosen without it."""

    part: str
    p: float


@dataclass(frozen=True)
class NoiseFit:
    """The noise model that was chosen, the estimate under it, and what else was tried.

    `x` (p,) is the generalised least-squares estimate of the readings' Δx, `covariance` that of
    Kenward and Roger; `kind` is a name of `noise_models` other than auto.  `fit` is in orthonormal
    parameters: Δx = basis · its x, which shifts all its log-likelihoods by one constant.  Where the
    noise has a course in time, the basis (p + k, p + k) has the course's coefficients last.
    """

    kind: str
    fit: Fitted
    x: Array
    covariance: Covariance
    trials: tuple[Trial, ...]
    reason: str
    basis: Array
    tests: tuple[NoiseTest, ...] = ()
    course: VisitRecord | None = None  # whose times those of what drifts are
    to_longest: float = 0.0  # log-likelihood that the longest time tried is short of the best

    @property
    def description(self) -> str:
        """The model in words."""
        text = self.fit.structure.description
        found = [e.name for e in self.fit.told if not e.joints]
        if found:
            text += f", and a deviation common to each {' / '.join(found)}"
        if any(e.joints for e in self.fit.told):
            text += ", joints that settle anew at each visit"
        return text + (", and a drift in time" if self.lasting else "")

    @property
    def lasting(self) -> float | None:
        """Correlation time of what drifts, as a share of the campaign; None where nothing does."""
        return self.fit.lasting

    def of_readings(self) -> NoiseFit:
        """Named as the best of what was tried that knows nothing of the arm's visits."""
        tried = tuple(t for t in self.trials if not Kind.of(t.kind).by_visit)
        kind = min(tried, key=lambda t: t.criterion).kind
        return replace(self, kind=kind, trials=tried, reason=_reason(kind, list(tried)))


def estimate_noise(
    readings: Readings, kind: str = "auto", like: NoiseFit | None = None
) -> NoiseFit:
    """Variances of the chosen noise model by REML, and the estimate under it.

    `kind`: a structure (independent, axis, marker, groups, polar, stated), with "+configuration"
    for effects that readings of a configuration share, "+joints" or "+each-joint" for joints that
    settle anew at each visit, "+time" for a drift, or "auto".  Auto tries every structure
    that the table has the labels and the readings for, each with shared effects, takes the one
    with the smallest criterion, and leaves the shared effects out where it is smaller without;
    scatter of the joints and drift are tried where a test finds a trace of them.
    `like`, a fit of nearly the same readings, is where the search of a named kind starts; how it
    was chosen there holds here.

    Raises InputError for an unknown kind or one that the readings do not support.
    """
    asked, (basis, T) = Kind.of(kind), _orthonormal(readings)
    if kind == "auto":
        return replace(_chosen(basis, T), course=readings.visits)
    found = fitted(basis, asked, None if like is None else like.fit)
    made = replace(_result(kind, found, T, (), "as asked for"), course=readings.visits)
    if like is None or like.kind != kind:
        return made
    return replace(made, trials=like.trials, reason=like.reason, tests=like.tests)


def _chosen(readings: Readings, T: Array) -> NoiseFit:
    """The model with the smallest criterion; of many readings a sample chooses it, and all of them
    tell its variances."""
    names = _supported(readings)
    some = readings.sample(max(CHOSEN_FROM, PER_PARAMETER * readings.n_parameters))
    if some is readings:
        return _Choice(readings, names).result(T)
    try:
        found = _Choice(some, names).result(T)
        again = fitted(readings, Kind.of(found.kind), found.fit, found.lasting)
    except ElastocalError:  # the sample does not show all parameters, or not all labels
        return _Choice(readings, names).result(T)
    why = f"{found.reason}; chosen from {len(some)} readings at random, estimated from all"
    return _result(again.found.name, again, T, found.trials, why, found.tests)


class _Choice:
    """The search for the model with the smallest criterion; parts that know of visits join where a
    test finds a trace of them."""

    def __init__(self, readings: Readings, names: list[str]) -> None:
        self.readings, self.names = readings, names
        self.trials: list[Trial] = []
        self.price = float(np.log(max(readings.e.size - readings.n_parameters, 3)))
        self.best: tuple[float, Kind, Fitted] | None = None
        self.tests: list[NoiseTest] = []

    def result(self, T: Array) -> NoiseFit:
        readings = self.readings
        could_share = bool(shared_effects(readings))
        for name in self.names:
            self.attempt(Kind(name, could_share))
        if self.best is None:
            raise InsufficientDataError(
                "there are too few readings to estimate any noise from; measure more poses"
            )
        if self.best[1].shared:
            self.attempt(self.best[1]._replace(shared=False))
        record = readings.visits
        if record is not None and self._knows(record):
            if record.per_visit >= SEVERAL:
                self._with_joints()
            if record.drifts:
                self._with_time(record.lasting)
        _, kind, best = self.best
        reason, trials = _reason(kind.name, self.trials), tuple(self.trials)
        best = fitted(readings, kind, best, best.lasting)
        return _result(kind.name, best, T, trials, reason, tuple(self.tests))

    def attempt(
        self, kind: Kind, lasting: float | None = None, found: Fitted | None = None
    ) -> None:
        """Fit a kind of noise, unless it is `found`, and keep it where it is better than what there
        is."""
        try:
            like = self.best[2] if self.best else None
            found = found or fitted(self.readings, kind, like, lasting, ROUGHLY)
        except InsufficientDataError:
            return
        kind, own, common = found.found, found.noisy.own, len(found.told)
        if found.structure.shrunk:
            own = self.readings.size + 2  # means of log θ and its two variances
        if kind.joints == EACH:  # what tells their sizes apart, those found to be none included
            common += 1 - sum(bool(e.joints) for e in found.told)
            own += sum(bool(e.joints) for e in found.shared) - 1
        spent = common + len(found.drift) + kind.time
        criterion = own * self.price + 2 * spent - 2 * found.log_likelihood
        self.trials.append(Trial(kind.name, own + spent, float(criterion)))
        if self.best is None or criterion < self.best[0]:
            self.best = (float(criterion), kind, found)

    def _knows(self, record: VisitRecord) -> bool:
        together = np.unique(self.readings.configuration, return_counts=True)[1]
        rows = int(together.max()) * self.readings.size
        return record.n_visits >= FEWEST_VISITS and rows <= MOST_TOGETHER

    def _plain(self) -> list[str]:
        """Structures to add to: the best one, and the first one where that has a prior."""
        assert self.best is not None
        _, kind, found = self.best
        return [kind.own, self.names[0]] if found.structure.shrunk else [kind.own]

    def _with_joints(self) -> None:
        assert self.best is not None
        kind = self.best[1]
        first = self._trace(JOINTS, kind._replace(joints=JOINTS), None)
        if first is None:
            return
        self.attempt(kind._replace(joints=JOINTS), found=first)
        for own in self._plain():
            for shared in (True, False) if kind.shared else (False,):
                if (own, shared) != (kind.own, kind.shared):
                    self.attempt(self.best[1]._replace(own=own, shared=shared, joints=JOINTS))
        if self.best[1].joints:
            self.attempt(self.best[1]._replace(joints=EACH))

    def _with_time(self, lasting: tuple[float, ...]) -> None:
        assert self.best is not None
        name = next((own for own in self._plain() if own != "groups"), self.names[0])
        kind = self.best[1]._replace(own=name, time=True)
        first = self._trace(TIME, kind, lasting[0])
        if first is None:
            return
        self.attempt(kind, found=first)
        for each in lasting[1:]:
            self.attempt(kind, each)
        if self.best[1].time:
            longest = self.best[2].lasting
            for less in (kind._replace(shared=False), kind._replace(joints="")):
                if less != kind:
                    self.attempt(less, longest)

    def _trace(self, part: str, kind: Kind, lasting: float | None) -> Fitted | None:
        """The fit of a kind with this part, where the likelihood shows a trace of it beside what
        there is.

        Twice what it gains, against a mixture of χ² with as many degrees of freedom as of the k
        variances of the part are not at zero, a half of them on average (Self and Liang 1987, J.
        Am. Stat. Assoc. 82, 605).
        """
        assert self.best is not None
        less = self.best[2]
        if less.structure.name != kind.own:
            without = kind._replace(time=False, joints="" if part == JOINTS else kind.joints)
            less = fitted(self.readings, without, less, None, ROUGHLY)
        more = fitted(self.readings, kind, less, lasting, ROUGHLY)
        joints = sum(bool(e.joints) for e in more.shared)
        k = np.arange(1, 1 + (joints if part == JOINTS else len(more.drift)))
        gain = 2 * (more.log_likelihood - less.log_likelihood)
        share = special.binom(len(k), k) / 2 ** len(k)
        p = float(share @ special.chdtrc(k, gain)) if gain > ROUGHLY else 1.0
        self.tests.append(NoiseTest(part, p))
        return more if p < TRACE else None


def _supported(readings: Readings) -> list[str]:
    """Structures whose variances the table can tell: labels, number of readings."""
    size, rows = readings.size, readings.e.size
    spare = (rows - readings.n_parameters) // ROWS_PER_VARIANCE
    # What is stated is believed until something else is better, and is nothing else where it is one
    # number for all.
    S = readings.stated
    even = S is None or (size <= 3 and np.allclose(S, S[0, 0, 0] * np.eye(size), rtol=1e-9, atol=0))
    names = ["independent"] if even else ["stated", "independent"]
    if size > 1 and spare >= size:
        names.append("axis")
    if size == 3 and 1 < len(np.unique(readings.marker)) <= spare:
        names.append("marker")
    if size == 3 and readings.sight is not None and spare >= 3:
        names.append("polar")
    groups = len(np.unique(np.column_stack([readings.configuration, readings.load]), axis=0))
    if 3 <= groups <= MOST_GROUPS and 3 * groups <= len(readings) - readings.n_parameters / size:
        names.append("groups")
    return names + [name for name, model in REGISTERED.items() if model.supports(readings)]


def _reason(label: str, trials: list[Trial]) -> str:
    others = sorted((t for t in trials if t.kind != label), key=lambda t: t.criterion)
    mine = min(t.criterion for t in trials if t.kind == label)
    if not others:
        return "the only model that the table supports"
    gaps = ", ".join(f"{t.kind} (+{t.criterion - mine:.1f})" for t in others)
    return (
        f"smallest information criterion among the models that the table supports; others: {gaps}"
    )


def _orthonormal(readings: Readings) -> tuple[Readings, Array]:
    """Readings with B T in the place of B, (B T)ᵀ(B T) = I, and T (p, p).

    Neither the units of the parameters nor their correlation then cost digits, and columns that
    depend on each other are found out.
    """
    n, size, p = readings.B.shape
    factors = orthogonal(readings.B.reshape(-1, p))
    return replace(readings, B=factors.Q.reshape(n, size, p)), factors.V


def _result(
    label: str, found: Fitted, T: Array, trials: tuple[Trial, ...], reason: str,
    tests: tuple[NoiseTest, ...] = (),
) -> NoiseFit:  # fmt: skip
    p, x = len(T), found.fit.state.x
    basis = linalg.block_diag(T, np.eye(len(x) - p))
    matrix, dof = covariance_of(found, basis[:p])
    text = "weights estimated by restricted likelihood; covariance of Kenward and Roger"
    covariance = Covariance("kenward-roger", matrix, dof, text)
    return NoiseFit(label, found, basis[:p] @ x, covariance, trials, reason, basis, tests)


def over_times(found: NoiseFit, readings: Readings) -> NoiseFit:
    """The same fit with a covariance that does not take for known how long what drifts lasts, where
    the cell does not say: the mean over the correlation times tried, Σ = Σ_m w_m Σ_m.

    w_m ∝ the restricted likelihoods.  To what the degrees of freedom f_m leave unknown,
    Σ_m w_m/f_m, comes what the models differ by (`Covariance.tails`), most for base and tracker.
    """
    if found.lasting is None or readings.visits is None:
        return found
    basis, T = _orthonormal(readings)
    fits = [found.fit]
    for lasting in readings.visits.lasting:
        if lasting != found.lasting:
            with suppress(ElastocalError, np.linalg.LinAlgError):
                fits.append(fitted(basis, Kind.of(found.kind), found.fit, lasting))
    level = np.array([one.log_likelihood for one in fits])
    longest = [v for one, v in zip(fits, level, strict=True) if one.lasting == LONGEST]
    weight = np.exp(level - level.max()) / np.exp(level - level.max()).sum()
    rows = [np.pad(T, ((0, 0), (0, len(one.fit.state.x) - len(T)))) for one in fits]
    each = [covariance_of(one, own) for one, own in zip(fits, rows, strict=True)]
    matrices, dof = (np.array(part) for part in zip(*each, strict=True))
    among = tuple(zip(weight.tolist(), matrices, strict=True))
    mean = replace(found.covariance, matrix=np.tensordot(weight, matrices, 1), among=among)
    between = 1 / replace(mean, dof=np.full(len(T), np.inf)).tails(np.eye(len(T))[:, None])[0]
    left = weight @ (1 / dof) + between
    dof = np.divide(1, left, out=np.full(len(left), np.inf), where=left > 0)
    short = float(level.max()) - max(longest, default=-math.inf)
    return replace(found, covariance=replace(mean, dof=dof), to_longest=short)


# Between a fit and its noise: readings linearised at the fit, weights from an estimated noise.


def linearised(
    model: Model, observed: Observations, x: Array, columns: NDArray[np.int64]
) -> Readings:
    """Residuals and B of the `columns` at x (parameters,), with the labels of each observation."""
    at = model.regressor(observed.table, x, columns, observed)
    n, size = len(observed.lead), observed.size
    table = observed.table
    sight, reach = _sight(model, observed)
    return Readings(
        at.B.reshape(n, size, -1), at.residual.reshape(n, size), observed.configuration,
        observed.load, table.marker[observed.lead], sight, reach,
        stated_by_observation(observed, model.cell.tracker), table, observed.lead,
        visit_record(model, observed, x),
    )  # fmt: skip


def weights_of(noise: NoiseFit, readings: Readings, more: Array | float = 0.0) -> Weights:
    """Weights of the readings (N,) under an estimated noise; whitened residuals have size 1.

    `more` (N, size, size) comes to the covariance of single readings."""
    n, size = len(readings), readings.size
    covariance = block_diagonal(own_noise(noise.fit, readings)[0] + more)
    for effect, variance in deviations_of(noise.fit, readings):
        Z = effect.columns()
        covariance = covariance + variance * (Z @ Z.T)
    whiten = whitener(sparse.csr_array(covariance))
    weights = Weights(noise.kind, whiten, True, noise.description)
    if noise.lasting is None or readings.visits is None:
        return weights
    k = readings.n_parameters
    columns = noise.fit.noisy.columns(readings)[:, :, k:].reshape(n * size, -1)
    kinds = noise.fit.drift[np.arange(size) // 3 if size == 6 else np.zeros(size, int)]
    deviation = np.tile(np.sqrt(kinds), columns.shape[1] // size)
    return weights.with_common(
        columns * deviation, readings.visits.blocks(readings.configuration, noise.lasting)
    )


def _sight(model: Model, observed: Observations) -> tuple[Array | None, Array | None]:
    """Axes along and across the line of sight (N, 3, 3) and its length (N,), where it is known."""
    position = observed.table.position
    if position is None or observed.size != 3:
        return None, None
    offset = position[observed.lead] - model.cell.tracker.position
    reach = np.linalg.norm(offset, axis=1)
    if not (reach > 0).all():
        return None, None
    return polar_axes(offset), reach
