"""Which noise model: what the readings allow is tried, and an information criterion decides.

    criterion = −2ℓ + k_own · log(rows − p) + 2 · k_shared

For the structure of single readings the price per variance is Schwarz's (BIC): one that is not
clearly better only makes the judgement of faulty readings erratic.  For shared effects it is
Akaike's (AIC): one that is left out wrongly makes intervals too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.errors import InputError, InsufficientDataError
from elastocal.identification.covariance.estimate import Covariance
from elastocal.identification.covariance.orthogonal import orthogonal
from elastocal.identification.variance.kenward_roger import kenward_roger
from elastocal.identification.variance.readings import Readings
from elastocal.identification.variance.reml import LogPrior, Reml, reml, usual_start
from elastocal.identification.variance.shared import shared_effects
from elastocal.identification.variance.shrinkage import prior_of_groups
from elastocal.identification.variance.structure import (
    REGISTERED,
    SHARED,
    STRUCTURES,
    Structure,
    noise_models,
)
from elastocal.text import did_you_mean

Array = NDArray[np.float64]

ROWS_PER_VARIANCE = 5  # degrees of freedom that a variance needs before it is worth trying
SEEN = 1e-6  # of the largest: a variance smaller than that of a former fit is no start
MOST_GROUPS = 1000  # configurations: their information matrix has (3 · 1000)² entries


@dataclass(frozen=True)
class Trial:
    """One noise model that was tried: how many variances it has, and its criterion."""

    kind: str
    n_variances: int
    criterion: float


@dataclass(frozen=True)
class NoiseFit:
    """The noise model that was chosen, the estimate under it, and what else was tried.

    `x` (p,) is the generalised least-squares estimate of the readings' Δx, `covariance` that of
    Kenward and Roger; `kind` is a name of `noise_models` other than auto.  `fit` is in orthonormal
    parameters: Δx = basis · fit.state.x, which shifts all its log-likelihoods by one constant.
    """

    kind: str
    fit: Reml
    x: Array
    covariance: Covariance
    trials: tuple[Trial, ...]
    reason: str
    basis: Array  # (p, p)

    @property
    def description(self) -> str:
        """The model in words."""
        text = self.fit.structure.description
        found = [e.name for e, v in zip(self.fit.shared, self.fit.common, strict=True) if v > 0]
        return text + (f", and a deviation common to each {' / '.join(found)}" if found else "")


def estimate_noise(
    readings: Readings, kind: str = "auto", like: NoiseFit | None = None
) -> NoiseFit:
    """Variances of the chosen noise model by REML, and the estimate under it.

    `kind`: a structure (independent, axis, marker, groups, polar, stated), with "+configuration"
    for effects that readings of a configuration share, or "auto".  Auto tries every structure
    that the table has the labels and the readings for, each with shared effects, takes the one
    with the smallest criterion, and leaves the shared effects out where it is smaller without.
    `like`, a fit of nearly the same readings, is where the search of a named kind starts.

    Raises InputError for an unknown kind or one that the readings do not support.
    """
    if kind not in noise_models():
        raise InputError(f"there is no noise model '{kind}'{did_you_mean(kind, noise_models())}")
    basis, T = _orthonormal(readings)
    if kind != "auto":
        near = None if like is None else like.fit
        fit = _fitted(basis, kind.removesuffix(SHARED), kind.endswith(SHARED), near)
        return _result(kind, fit, T, (), "as asked for")
    best: tuple[float, str, Reml] | None = None
    trials: list[Trial] = []
    price = np.log(max(readings.e.size - readings.n_parameters, 3))

    def attempt(name: str, shared: bool) -> None:
        nonlocal best
        try:
            fit = _fitted(basis, name, shared, best[2] if best else None)
        except InsufficientDataError:
            return
        if shared and not (fit.common > 0).any():
            shared = False  # none was found: the same model without
        label = name + (SHARED if shared else "")
        own, common = _n_variances(fit)
        criterion = own * price + 2 * common - 2 * fit.log_likelihood
        trials.append(Trial(label, own + common, float(criterion)))
        if best is None or criterion < best[0]:
            best = (criterion, label, fit)

    could_share = bool(shared_effects(STRUCTURES["independent"](basis).cells, readings.size))
    for name in _supported(basis):
        attempt(name, could_share)
    if best is None:
        raise InsufficientDataError(
            "there are too few readings to estimate any noise from; measure more poses"
        )
    if best[1].endswith(SHARED):
        attempt(best[1].removesuffix(SHARED), False)
    _, label, fit = best
    return _result(label, fit, T, tuple(trials), _reason(label, trials))


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


def _fitted(readings: Readings, name: str, shared: bool, like: Reml | None = None) -> Reml:
    """A structure's fit; the search starts from the variances of `like` where it has the same."""
    structure = STRUCTURES[name](readings)
    effects = shared_effects(structure.cells, readings.size, shared)
    if shared and not effects:
        raise InputError(
            f"'{name}{SHARED}' needs repeats or several markers in a configuration; this table "
            "has one reading in each"
        )
    start, prior = usual_start(structure, effects), None
    own = len(structure.names)
    if structure.shrunk:
        prior = _prior(structure)
        start[:own] = np.exp(prior.mean)
    if like is not None and len(like.common) == len(effects):
        start[own:] = np.where(like.common > 0, like.common, start[own:])
        if like.structure.names == structure.names:
            start[:own] = np.where(like.own > SEEN * like.own.max(), like.own, start[:own])
    return reml(structure, effects, prior, start)


def _prior(structure: Structure) -> LogPrior:
    """Prior of the group variances, from residuals of a fit with the plain mean of repeats."""
    cells = structure.cells
    B, e = cells.B.reshape(-1, cells.B.shape[2]), cells.e.ravel()
    weight = np.repeat(np.sqrt(cells.repeats), cells.e.shape[1])
    x = linalg.lstsq(B * weight[:, None], e * weight)[0]
    return prior_of_groups(structure, (e - B @ x).reshape(cells.e.shape))


def _n_variances(fit: Reml) -> tuple[int, int]:
    """How many own and shared variances the readings chose."""
    own = len(fit.structure.names)
    if fit.structure.shrunk:
        own = fit.structure.cells.e.shape[1] + 2  # means of log θ and its two variances
    return own, int((fit.common > 0).sum())


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


def _result(label: str, fit: Reml, T: Array, trials: tuple[Trial, ...], reason: str) -> NoiseFit:
    adjusted, dof = kenward_roger(fit, T)
    text = "weights estimated by restricted likelihood; covariance of Kenward and Roger"
    covariance = Covariance("kenward-roger", adjusted, dof, text)
    return NoiseFit(label, fit, T @ fit.state.x, covariance, trials, reason, T)
