"""One noise model of given readings: its variances by restricted likelihood, and the estimate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from elastocal.engine.mixed import ENOUGH, Diagonal, LogPrior, Mixed, MixedFit, Pack, fit
from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.noise_structure import (
    EACH,
    SHARED,
    STRUCTURES,
    Kind,
    Readings,
    Sets,
    SharedEffect,
    Structure,
    along_axes,
    contrasts_of,
    drifts_of,
    faster_course,
    joint_effects,
    like,
    packs_of,
    shared_effects,
)
from elastocal.identification.weighted_problem import least_norm
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
            along = np.array([axes for _, axes in self.drifts])
            parts = (Diagonal(number, np.tile(along, (held // size, 1, 1))),)
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
                "no drift can be told in these readings: the model itself has what changes with "
                "time, or successive poses are near each other; visit poses in random order"
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
