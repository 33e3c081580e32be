"""Which noise model the readings support, which readings it does not explain, and its weights."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, special

from elastocal.errors import ElastocalError, InputError, InsufficientDataError
from elastocal.identification.covariance import Covariance, orthogonal
from elastocal.identification.linear_solver import least_norm
from elastocal.identification.noise_structure import (
    EACH,
    JOINTS,
    REGISTERED,
    SHARED,
    STRUCTURES,
    TIME,
    Kind,
    Readings,
    SharedEffect,
    Structure,
    along_axes,
    joint_effects,
    of_readings,
    shared_effects,
    with_drift,
)
from elastocal.identification.outliers import FALSE_ALARM
from elastocal.identification.reml import (
    TINY,
    LogPrior,
    Reml,
    Whitened,
    kenward_roger,
    mean_covariance,
    prior_of_groups,
    reml,
    score_test,
    score_test_of_columns,
    usual_start,
)
from elastocal.identification.tails import rejection_point
from elastocal.identification.visit_record import LONGEST, VisitRecord, visit_record
from elastocal.identification.weighted_problem import (
    Weights,
    block_diagonal,
    same_size,
    stated_by_observation,
    whitener,
)
from elastocal.measurements import numbered
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, polar_axes
from elastocal.units import Array, BoolArray, IntArray

# Which noise model: what the readings allow is tried, and an information criterion decides.
#
#     criterion = −2ℓ + k_own · log(rows − p) + 2 · k_shared
#
# For the structure of single readings the price per variance is Schwarz's (BIC): one that is not
# clearly better only makes the judgement of faulty readings erratic; so for joints told apart.  For
# shared effects it is Akaike's (AIC): one that is left out wrongly makes intervals too narrow.

ROWS_PER_VARIANCE = 5  # degrees of freedom that a variance needs before it is worth trying
LEAST_START = 1e-6  # of the largest: a variance smaller than that of a former fit is no start
FEWEST_TELLING = 10  # degrees of freedom of repeats, from which on they tell the noise
MOST_GROUPS = 1000  # configurations: their information matrix has (3 · 1000)² entries
# Readings, and those per parameter, that the choice is made from: so many tell a variance to 3 %.
CHOSEN_FROM, PER_PARAMETER = 2000, 20


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
    parameters: Δx = basis · fit.state.x, which shifts all its log-likelihoods by one constant.
    Where the noise has a course in time, `every` (p + k,) and `spread` (p + k, p + k) hold its
    coefficients behind x, and their covariance.
    """

    kind: str
    fit: Reml
    x: Array
    covariance: Covariance
    trials: tuple[Trial, ...]
    reason: str
    basis: Array  # (p + k, p + k)
    every: Array
    spread: Array
    tests: tuple[NoiseTest, ...] = ()
    course: VisitRecord | None = None  # whose times those of what drifts are
    to_longest: float = 0.0  # log-likelihood that the longest time tried is short of the best

    @property
    def description(self) -> str:
        """The model in words."""
        text = self.fit.structure.description
        told = [e for e, v in zip(self.fit.shared, self.fit.common, strict=True) if v > 0]
        found = [e.name for e in told if not e.joints]
        if found:
            text += f", and a deviation common to each {' / '.join(found)}"
        if any(e.joints for e in told):
            text += ", joints that settle anew at each visit"
        return text + (", and a drift in time" if self.lasting else "")

    @property
    def lasting(self) -> float | None:
        """Correlation time of what drifts, as a share of the campaign; None where nothing does."""
        return self.fit.structure.lasting

    def columns(self, readings: Readings) -> Array:
        """B of the readings (N, size, p + k) with the columns of what drifts."""
        if self.lasting is None or readings.visits is None:
            return readings.B
        waves = readings.visits.waves(self.lasting)
        return np.concatenate([readings.B, along_axes(waves, np.ones(readings.size))], axis=2)

    def of(self, readings: Readings) -> Readings:
        """The readings as the model takes them: repeats of different visits apart, or together."""
        return readings.by_visit(Kind.of(self.kind).by_visit)


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
    `like`, a fit of nearly the same readings, is where the search of a named kind starts.

    Raises InputError for an unknown kind or one that the readings do not support.
    """
    asked, (basis, T) = Kind.of(kind), _orthonormal(readings)
    if kind == "auto":
        return replace(_chosen(basis, T), course=readings.visits)
    fit = _fitted(basis, asked, None if like is None else like.fit)
    return replace(_result(kind, fit, T, (), "as asked for"), course=readings.visits)


# What may be added to the best model of single readings and configurations.  Only a trace of it is
# worth the fits: a part that a test at this level does not find changes no interval.
TRACE = 0.05
MOST_TOGETHER = 300  # rows of a configuration, whose covariance is formed
FEWEST_VISITS, SEVERAL = 8, 2


def _chosen(readings: Readings, T: Array) -> NoiseFit:
    """The model with the smallest criterion; of many readings a sample chooses it, and all of them
    tell its variances."""
    names = _supported(readings)
    some = readings.sample(max(CHOSEN_FROM, PER_PARAMETER * readings.n_parameters))
    if some is readings:
        return _Choice(readings, names).result(T)
    try:
        found = _Choice(some, names).result(T)
        kind = Kind.of(found.kind)
        fit = _fitted(readings, kind, found.fit, found.lasting)
    except ElastocalError:  # the sample does not show all parameters, or not all labels
        return _Choice(readings, names).result(T)
    why = f"{found.reason}; chosen from {len(some)} readings at random, estimated from all"
    return _result(_found(kind, fit)[0].name, fit, T, found.trials, why, found.tests)


def _found(kind: Kind, fit: Reml) -> tuple[Kind, list[SharedEffect]]:
    """The kind without what is shared and was not found, with which it is the same model."""
    told = [e for e, v in zip(fit.shared, fit.common, strict=True) if v > 0]
    joints = kind.joints if any(e.joints for e in told) else ""
    shared = kind.shared and any(not e.joints for e in told)
    return kind._replace(shared=shared, joints=joints), told


class _Choice:
    """The search for the model with the smallest criterion, among those of these `names`."""

    def __init__(self, readings: Readings, names: list[str]) -> None:
        self.readings, self.names = readings, names
        self.trials: list[Trial] = []
        self.price = float(np.log(max(readings.e.size - readings.n_parameters, 3)))
        self.best: tuple[float, Kind, Reml] | None = None
        self.tests: list[NoiseTest] = []

    def result(self, T: Array) -> NoiseFit:
        readings, names = self.readings, self.names
        could_share = bool(shared_effects(STRUCTURES["independent"](readings).sets, readings.size))
        for name in names:
            self.attempt(Kind(name, could_share))
        if self.best is None:
            raise InsufficientDataError(
                "there are too few readings to estimate any noise from; measure more poses"
            )
        if self.best[1].shared:
            self.attempt(self.best[1]._replace(shared=False))
        if self._knows_visits():
            if self._sees_joints():
                self._with_joints(names[0])
            if self.readings.visits is not None and self.readings.visits.drifts:
                self._with_time(names[0])
        _, kind, fit = self.best
        reason, trials = _reason(kind.name, self.trials), tuple(self.trials)
        return _result(kind.name, fit, T, trials, reason, tuple(self.tests))

    def attempt(self, kind: Kind, lasting: float | None = None) -> None:
        """Fit a kind of noise and keep it where it is better than what there is."""
        try:
            fit = _fitted(self.readings, kind, self.best[2] if self.best else None, lasting)
        except InsufficientDataError:
            return
        kind, told = _found(kind, fit)
        own, common = fit.structure.n_own, len(told)
        if fit.structure.shrunk:
            own = self.readings.size + 2  # means of log θ and its two variances
        if kind.joints == EACH:  # what tells their sizes apart, those found to be none included
            common += 1 - sum(bool(e.joints) for e in told)
            own += sum(bool(e.joints) for e in fit.shared) - 1
        drifting = len(fit.structure.names) - fit.structure.n_own
        spent = common + drifting + kind.time
        criterion = own * self.price + 2 * spent - 2 * fit.log_likelihood
        self.trials.append(Trial(kind.name, own + spent, float(criterion)))
        if self.best is None or criterion < self.best[0]:
            self.best = (float(criterion), kind, fit)

    def _knows_visits(self) -> bool:
        record = self.readings.visits
        if record is None or record.n_visits < FEWEST_VISITS:
            return False
        together = np.unique(self.readings.configuration, return_counts=True)[1]
        return int(together.max()) * self.readings.size <= MOST_TOGETHER

    def _sees_joints(self) -> bool:
        """Are there mostly several readings to a visit?  A single one tells the joints' scatter
        from its own noise by nothing but how both change from pose to pose, as the model's own
        errors do."""
        assert self.readings.visits is not None
        own = self.readings.visits.visit
        return bool(np.median(np.unique(own[own >= 0], return_counts=True)[1]) >= SEVERAL)

    def _plain(self, first: str) -> list[str]:
        """Structures to add to: the best one, and the `first` one where that has a prior."""
        assert self.best is not None
        _, kind, fit = self.best
        return [kind.own, first] if fit.structure.shrunk else [kind.own]

    def _with_joints(self, first: str) -> None:
        assert self.best is not None
        p = self.p_value(JOINTS)
        if p < TRACE:
            shared = self.best[1].shared
            for own in self._plain(first):
                for both in (True, False) if shared else (False,):
                    self.attempt(self.best[1]._replace(own=own, shared=both, joints=JOINTS))
            if self.best[1].joints:
                self.attempt(self.best[1]._replace(joints=EACH))
        self.tests.append(NoiseTest(JOINTS, p))

    def _with_time(self, first: str) -> None:
        assert self.best is not None
        p = self.p_value(TIME)
        self.tests.append(NoiseTest(TIME, p))
        if p >= TRACE:
            return
        name = next((own for own in self._plain(first) if own != "groups"), first)
        kind = self.best[1]._replace(own=name, time=True)
        assert self.readings.visits is not None
        for lasting in self.readings.visits.lasting:
            self.attempt(kind, lasting)
        if not self.best[1].time:
            return
        found = self.best[2].structure.lasting
        for less in (kind._replace(shared=False), kind._replace(joints="")):
            if less != kind:
                self.attempt(less, found)

    def p_value(self, part: str) -> float:
        """Of there being none of a part of the noise that the best model lacks."""
        assert self.best is not None
        _, kind, fit = self.best
        if part == TIME:
            sets = fit.structure.sets
            assert sets.visits is not None
            waves = sets.visits.waves(sets.visits.lasting[0])
            # Of a pose, only positions.
            columns = along_axes(waves, np.ones(min(self.readings.size, 3)))
            if self.readings.size == 6:
                columns = np.concatenate([columns, 0 * columns], axis=1)
            return score_test_of_columns(fit, columns)
        structure, effects = _parts(
            self.readings, kind._replace(joints=JOINTS), fit.structure.lasting
        )
        own, n = structure.n_own, len(structure.names)
        theta = _known(structure, effects, fit, np.zeros(n + len(effects)))
        theta[:own] = fit.own[: fit.structure.n_own]
        looked = [n + k for k, e in enumerate(effects) if e.joints]
        found = [score_test(structure, effects, theta, k) for k in looked]
        return min(1.0, len(found) * min(found, default=1.0))


def _supported(readings: Readings) -> list[str]:
    """Structures whose variances the table can tell: labels, number of readings."""
    size, rows = readings.size, readings.e.size
    spare = (rows - readings.n_parameters) // ROWS_PER_VARIANCE
    # What is stated is believed until something else is better.
    names = ["independent"] if readings.stated is None else ["stated", "independent"]
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


def _parts(
    readings: Readings, kind: Kind, lasting: float | None
) -> tuple[Structure, tuple[SharedEffect, ...]]:
    """The structure of a kind of noise, what is `lasting` so long included, and its effects."""
    readings = readings.by_visit(kind.by_visit)
    structure = STRUCTURES[kind.own](readings)
    effects = shared_effects(structure.sets, readings.size, kind.shared)
    if structure.sets.dof.sum() * readings.size < FEWEST_TELLING:
        # Nothing but repeats tells a deviation of each set from the noise of single readings, and a
        # few of them may agree by chance.
        n = len(structure.sets)
        effects = tuple(e for e in effects if len(np.unique(e.unit)) < n) or effects
    if kind.shared and not effects:
        raise InputError(
            f"'{kind.own}{SHARED}' needs repeats or several markers in a configuration; this table "
            "has one reading in each"
        )
    if kind.joints:
        effects += joint_effects(structure.sets, kind.joints == EACH)
    if not kind.time or lasting is None:
        return structure, effects
    before = len(structure.sets)
    structure = with_drift(structure, lasting)
    return structure, tuple(e.padded(len(structure.sets) - before) for e in effects)


def _fitted(
    readings: Readings, kind: Kind, like: Reml | None = None, lasting: float | None = None
) -> Reml:
    """A model's fit; the search starts from the variances of `like` where it has the same.

    What drifts is `lasting` so long, as in `like`, or as is the most likely.
    """
    if kind.by_visit and readings.visits is None:
        raise InputError(
            f"'{kind.name}' needs the visits of the arm, which these readings do not tell"
        )
    if kind.time and readings.visits is not None and not readings.visits.drifts:
        raise InputError(
            "no drift can be told in these readings: the model itself has what changes with time, "
            "or successive poses are near each other; visit poses in random order"
        )
    if kind.time and readings.visits is not None and lasting is None:
        if like is None or like.structure.lasting is None:
            tried = [_fitted(readings, kind, like, each) for each in readings.visits.lasting]
            return max(tried, key=lambda fit: fit.log_likelihood)
        lasting = like.structure.lasting
    structure, effects = _parts(readings, kind._replace(time=False), None)
    start, prior = usual_start(structure, effects), None
    own = len(structure.names)
    if structure.shrunk:
        prior = _prior(structure)
        start[:own] = np.exp(prior.mean)
    if kind.time:
        if structure.shrunk:
            raise InputError(f"'{kind.own}' has a prior, with which no drift can be estimated")
        structure, effects = _parts(readings, kind, lasting)
        # As a course of variance one has a mean square of about one: as shared effects start.
        drift = max(0.1 * float((readings.e**2).mean()), TINY)
        start = np.insert(start, own, np.full(len(structure.names) - own, drift))
    return reml(structure, effects, prior, _known(structure, effects, like, start))


def _known(
    structure: Structure, effects: tuple[SharedEffect, ...], like: Reml | None, start: Array
) -> Array:
    """Variances (K,) of `like` where it has the same ones, else those of the `start`."""
    theta = start.copy()
    if like is None:
        return theta
    own, n = structure.n_own, len(structure.names)
    common = {e.name: v for e, v in zip(like.shared, like.common, strict=True) if v > 0}
    theta[n:] = [common.get(e.name, v) for e, v in zip(effects, theta[n:], strict=True)]
    if like.structure.names[: like.structure.n_own] == structure.names[:own]:
        known = like.own[: like.structure.n_own]
        theta[:own] = np.where(known > LEAST_START * known.max(), known, theta[:own])
    if like.structure.lasting is not None:
        known = like.own[like.structure.n_own :]
        theta[own:n] = known[: n - own]
    return theta


def _prior(structure: Structure) -> LogPrior:
    """Prior of the group variances, from residuals of a fit with the plain mean of repeats."""
    sets = structure.sets
    B, e = sets.B.reshape(-1, sets.B.shape[2]), sets.e.ravel()
    weight = np.repeat(np.sqrt(sets.repeats), sets.e.shape[1])
    x = least_norm(B * weight[:, None], e * weight)
    return prior_of_groups(structure, (e - B @ x).reshape(sets.e.shape))


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
    factors, _ = orthogonal(readings.B.reshape(-1, p), readings.e.ravel())
    return replace(readings, B=factors.Q.reshape(n, size, p)), factors.V


def _result(
    label: str, fit: Reml, T: Array, trials: tuple[Trial, ...], reason: str,
    tests: tuple[NoiseTest, ...] = (),
) -> NoiseFit:  # fmt: skip
    p = len(T)
    whole = linalg.block_diag(T, np.eye(len(fit.state.x) - p))
    adjusted, dof = kenward_roger(fit, whole)
    text = "weights estimated by restricted likelihood; covariance of Kenward and Roger"
    covariance = Covariance("kenward-roger", adjusted[:p, :p], dof[:p], text)
    every = whole @ fit.state.x
    return NoiseFit(
        label, fit, every[:p], covariance, trials, reason, whole, every, adjusted, tests
    )


def over_times(found: NoiseFit, readings: Readings) -> NoiseFit:
    """The same fit with a covariance that does not take for known how long what drifts lasts, where
    the cell does not say: the mean (`reml.mean_covariance`) over the correlation times tried."""
    if found.lasting is None or readings.visits is None:
        return found
    basis, T = _orthonormal(readings)
    fits = [found.fit]
    for lasting in readings.visits.lasting:
        if lasting != found.lasting:
            with suppress(ElastocalError, np.linalg.LinAlgError):
                fits.append(_fitted(basis, Kind.of(found.kind), found.fit, lasting))
    level = {fit.structure.lasting: fit.log_likelihood for fit in fits}
    short = max(level.values()) - level.get(LONGEST, -math.inf)
    mean = mean_covariance(fits, T, found.covariance)
    return replace(found, covariance=mean, to_longest=short)


# Is a reading explained by the others?  Deletion residuals under an estimated noise model.
#
# With P = V⁻¹ − V⁻¹BΦBᵀV⁻¹, the error of predicting reading i from all others, its configuration's
# shared deviation included, is d_i = P_ii⁻¹ (P e)_i with covariance P_ii⁻¹ (Haslett and Hayes 1998,
# J. R. Stat. Soc. B 60, 201): one evaluation judges every reading of the fit.


def unexplained_readings(
    found: NoiseFit, readings: Readings, good: BoolArray, level: float
) -> BoolArray:
    """Readings (N,) that the noise does not explain, at `level` for the whole table (Bonferroni).

    `found` was estimated from the `good` readings (N,); each component of a reading's
    `standard_errors` is compared with t on the degrees of freedom behind it.
    """
    size, dof = standard_errors(found, readings, good)
    return np.asarray((size > rejection_point(size.size, dof, level)).any(axis=1))


def standard_errors(found: NoiseFit, readings: Readings, good: BoolArray) -> tuple[Array, Array]:
    """Errors (N, size) of predicting each reading from the `good` ones (N,) that are not it, in
    units of their own deviation, and the degrees of freedom (N, size) behind that."""
    readings = found.of(readings)
    own, dof = own_noise(found.fit, readings)
    t = np.zeros(readings.e.shape)
    t[good] = _deletion_fit(found, readings.take(good), own[good])
    if not good.all():
        t[~good] = _not_fitted(found, readings.take(~good), own[~good])
    # A fitted reading has a part in the variance it is measured with: leave it out there as well.
    squared = np.minimum(t**2, dof * (1 - 1e-12))
    outside = np.maximum(dof - 1, 1.0)
    deleted = np.sqrt(squared * outside / (dof - squared))
    fitted = good[:, None]
    return np.where(fitted, deleted, np.abs(t)), np.where(fitted, outside, dof)


def own_noise(fit: Reml, readings: Readings) -> tuple[Array, Array]:
    """Covariance (N, size, size) of single readings, and degrees of freedom (N, size) behind it.

    A reading of a group that has none in the fit gets the mean of all variances.
    """
    names, index, matrix = of_readings(fit.structure, readings)
    place = {name: k for k, name in enumerate(fit.structure.names[: fit.structure.n_own])}
    known = np.array([place.get(name, -1) for name in names])
    own = fit.own[: fit.structure.n_own]
    theta = np.where(known >= 0, own[known], own.mean())
    W = fit.covariance[: len(own), : len(own)]
    spread = np.where(known >= 0, np.diag(W)[known], np.diag(W).max())
    covariance = np.einsum("nl,nlij->nij", theta[index], matrix)
    parts = np.diagonal(matrix, axis1=2, axis2=3)  # (N, L, size)
    variance = np.einsum("nl,nla->na", spread[index], parts**2)
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    return covariance, np.maximum(2 * diagonal**2 / np.maximum(variance, 1e-300), 2.0)


def _deletion_fit(found: NoiseFit, inside: Readings, own: Array) -> Array:
    """Deletion residuals (N, size) of the readings of the fit, each over its deviation."""
    fit = found.fit
    sets, set_of = fit.structure.sets, inside.set_of
    n_sets, size = len(sets), inside.size
    mean_P, mean_Pe = np.zeros((n_sets, size, size)), np.zeros((n_sets, size))
    for w in fit.state.whitened:
        back = w.inverse.transpose(0, 2, 1)
        VB, Pe = back @ w.B, (back @ _residual(fit, w)[:, :, None])[..., 0]
        for j in range(w.stack.sets.shape[1]):
            rows = slice(j * size, (j + 1) * size)
            column = w.inverse[:, :, rows]
            P = column.transpose(0, 2, 1) @ column
            mean_P[w.stack.sets[:, j]] = P - VB[:, rows] @ fit.state.Phi @ VB[:, rows].transpose(
                0, 2, 1
            )
            mean_Pe[w.stack.sets[:, j]] = Pe[:, rows]
    precision = np.linalg.inv(own)
    unit = np.einsum("cl,clij->cij", fit.own[fit.structure.index], fit.structure.mean_matrix)
    # `set_of` knows nothing of what holds a course in time: it comes last.
    share = precision @ unit[set_of]  # of a reading in the mean of its set, transposed
    P = precision - share @ precision + share @ mean_P[set_of] @ share.transpose(0, 2, 1)
    deviation = (inside.e - sets.e[set_of])[:, :, None]
    Pe = (precision @ deviation + share @ mean_Pe[set_of][:, :, None])[..., 0]
    # A direction that this reading alone determines has no deletion residual.
    values, vectors = np.linalg.eigh(P)
    smallest = 1e-9 * np.linalg.eigvalsh(precision)[:, -1:]
    inverse = np.where(values > smallest, 1 / np.maximum(values, smallest), 0.0)
    spread = (vectors * inverse[:, None, :]) @ vectors.transpose(0, 2, 1)
    d = (spread @ Pe[:, :, None])[..., 0]
    deviation = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    return np.divide(d, deviation, out=np.zeros_like(d), where=deviation > 0)


def _not_fitted(found: NoiseFit, rest: Readings, own: Array) -> Array:
    """Prediction errors (N, size) of readings outside the fit, each over its deviation.

    With k the covariance of a reading with the fitted ones, d = e − BΔx − kᵀV⁻¹r varies by
    Σ − kᵀV⁻¹k + FΦ_AFᵀ, where F = B − kᵀV⁻¹B_fit.
    """
    fit = found.fit
    F = found.columns(rest).copy()
    d, spread = rest.e - F @ found.every, own.copy()
    each = np.arange(len(rest))[:, None]
    for effect, variance in fit.deviations:
        mine = effect.of(rest)
        spread += variance * mine.product(each, mine, each)[:, 0, :, 0]
    if fit.deviations:
        for w in fit.state.whitened:
            here, u = _common(fit, w, rest)
            back = u.transpose(0, 2, 1)
            mates, z = w.B[here[1]], _residual(fit, w)[here[1]]
            d[here[0]] -= (back @ z[:, :, None])[..., 0]
            spread[here[0]] -= back @ u
            observed = (back @ mates).reshape(-1, F.shape[2])
            F[here[0]] -= np.linalg.solve(found.basis.T, observed.T).T.reshape(F[here[0]].shape)
    spread += F @ found.spread @ F.transpose(0, 2, 1)
    return d / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))


def _common(fit: Reml, w: Whitened, rest: Readings) -> tuple[tuple[IntArray, IntArray], Array]:
    """Which readings of `rest` have mates in which cluster of the stack, and R⁻¹k (n, rows, size).

    k is what a reading and its configuration's fitted sets vary by together.
    """
    sets, size = fit.structure.sets, rest.size
    cluster = {int(c): g for g, c in enumerate(sets.configuration[w.stack.sets[:, 0]])}
    mates = np.array([cluster.get(int(c), -1) for c in rest.configuration])
    here = np.flatnonzero(mates >= 0)
    members = w.stack.sets[mates[here]]  # (n, sets)
    k = np.zeros((len(here), members.shape[1] * size, size))
    for effect, variance in fit.deviations:
        both = effect.product(members, effect.of(rest), here[:, None])
        k += variance * both.reshape(k.shape)
    return (here, mates[here]), w.inverse[mates[here]] @ k


def _residual(fit: Reml, w: Whitened) -> Array:
    """R⁻¹ (e − BΔx) (G, n) of a stack; x and B are in the fit's orthonormal basis."""
    return w.e - w.B @ fit.state.x


# A first guess at the faulty readings, from a robust fit: where the search for them starts.

OWN_SCALE = 6  # readings that a group needs for a median and a scale of its own
MOVED = 1 / 3  # share of a configuration's readings
LIMIT = 5.0  # robust standard deviations; the verdict that follows takes back what it can explain


def outlier_screening(
    readings: Readings, residual: Array, good: BoolArray | None = None
) -> BoolArray:
    """Readings (N,) whose residual (N, size) from a robust fit lies with the others.

    Each component is compared with the median and the median absolute deviation of its
    configuration (under its load), where that holds enough readings; else with zero and the
    deviation of the `good` readings (N,) of the whole table (default all).  Where noise is stated,
    residuals count in units of it.

    What moves a configuration or a marker in it as a whole moves its median too: readings that are
    not `good` stay out where they make up a third of their configuration.
    """
    if readings.stated is not None:
        residual = residual / np.sqrt(np.diagonal(readings.stated, axis1=1, axis2=2))
    table = _scale(np.abs(residual if good is None else residual[good]))
    deviation, scale = np.abs(residual), np.broadcast_to(table, residual.shape).copy()
    group = numbered(readings.configuration, readings.load)
    for members in same_size(group):
        if members.shape[1] >= OWN_SCALE:
            r = residual[members]
            deviation[members] = np.abs(r - np.median(r, axis=1, keepdims=True))
            scale[members] = _scale(deviation[members], axis=1)[:, None]
    # A group that happens to agree is no reason to suspect the one reading that differs a little.
    scale = np.maximum(scale, 0.2 * table)
    near = (deviation <= LIMIT * scale).all(axis=1)
    if good is None:
        return np.asarray(near)
    share = (np.bincount(group, ~good) / np.bincount(group))[group]
    return np.asarray(near & (good | (share < MOVED)))


def _scale(deviation: Array, axis: int = 0) -> Array:
    return np.median(deviation, axis=axis) / special.ndtri(0.75)


# The default estimate: faulty readings set apart, noise model chosen, x by its weights.

ROUNDS = 12
FEWEST_GOOD = 0.5


class NoiseAndOutliers(NamedTuple):
    """The noise found from the `good` readings (N,); the noise does not explain the others."""

    noise: NoiseFit
    good: BoolArray


def settle(
    readings: Readings, kind: str = "auto", good: BoolArray | None = None
) -> NoiseAndOutliers:
    """Noise and good readings that agree with each other, starting from `good` (default all).

    The noise model is fitted to the good readings, every reading is judged by the error of its
    prediction from them (false-alarm rate 1 % for the whole table), and so on.  Starting from
    all, errors that hide each other may stay: start from a robust fit.  A set that comes back
    after others ends the search: readings that were good at any time of that round are kept.

    Faulty readings that are taken back bend the fit, so that more of them seem to fit.  Where the
    better half of all readings is left worse explained than by an earlier set, beyond what chance
    allows, that set stands.
    """
    good = np.ones(len(readings), dtype=bool) if good is None else good
    try:
        noise = estimate_noise(readings.take(good), kind)
    except ElastocalError:
        good = np.ones(len(readings), dtype=bool)  # the others alone do not show all parameters
        noise = estimate_noise(readings, kind)
    own = np.asarray(np.linalg.inv(own_noise(noise.fit, readings)[0]), dtype=np.float64)
    visited = [(_misfit(noise, readings, own), good, noise)]
    for _ in range(ROUNDS):
        updated = ~unexplained_readings(noise, readings, good, FALSE_ALARM)
        if np.array_equal(updated, good) or updated.mean() < FEWEST_GOOD:
            break
        masks = [mask for _, mask, _ in visited]
        again = next((k for k, mask in enumerate(masks) if np.array_equal(mask, updated)), None)
        if again is not None:
            updated = np.logical_or.reduce(masks[again:])
        try:
            near = None if noise.lasting is None else noise  # how long it lasts is known by now
            noise = estimate_noise(readings.take(updated), noise.kind, near)
        except ElastocalError:
            break  # so few readings cannot judge the others
        good = updated
        visited.append((_misfit(noise, readings, own), good, noise))
        if again is not None:
            break
    last, best = visited[-1], min(visited, key=lambda v: v[0])
    half = (len(readings) // 2 + 1) * readings.size
    if last[0] > best[0] * special.fdtri(half, half, 1 - FALSE_ALARM):
        last = best
    _, good, noise = last
    if len(visited) > 1 and kind == "auto":
        noise = estimate_noise(readings.take(good), kind)
    return NoiseAndOutliers(noise, good)


def _misfit(noise: NoiseFit, readings: Readings, precision: Array) -> float:
    """Sum of the smaller half of the squared residuals, in units of `precision` (N, size, size)."""
    r = readings.e - readings.B @ noise.x
    squared = np.einsum("ni,nij,nj->n", r, precision, r)
    return float(np.sort(squared)[: len(squared) // 2 + 1].sum())


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


def weights_of(noise: NoiseFit, readings: Readings) -> Weights:
    """Weights of the readings (N,) under an estimated noise; whitened residuals have size 1."""
    n, size = len(readings), readings.size
    covariance = block_diagonal(own_noise(noise.fit, readings)[0])
    for effect, variance in noise.fit.deviations:
        if variance <= 0:
            continue
        Z = effect.of(readings).columns()
        covariance = covariance + variance * (Z @ Z.T)
    whiten = whitener(sparse.csr_array(covariance))
    weights = Weights(noise.kind, whiten, True, noise.description)
    if noise.lasting is None or readings.visits is None:
        return weights
    fit, k = noise.fit, readings.n_parameters
    kinds = fit.own[fit.structure.n_own :][
        np.arange(size) // 3 if size == 6 else np.zeros(size, int)
    ]
    columns = noise.columns(readings)[:, :, k:].reshape(n * size, -1)
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
