"""Which readings an estimated noise does not explain, and the noise of the others, in turns."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from elastocal.errors import ElastocalError
from elastocal.identification.noise_choice import NoiseFit, estimate_noise
from elastocal.identification.noise_structure import Readings
from elastocal.identification.noisy_readings import (
    NoisyReadings,
    covariance_of,
    own_noise,
    variances_of,
)
from elastocal.identification.outliers import FALSE_ALARM
from elastocal.identification.tails import rejection_point
from elastocal.units import Array, BoolArray

# Is a reading explained by the others?  Deletion residuals under an estimated noise model.
#
# The error of predicting reading i from all others, its configuration's shared deviation included,
# is d_i = P_ii⁻¹ (P e)_i with covariance P_ii⁻¹ (Haslett and Hayes 1998, J. R. Stat. Soc. B 60,
# 201): one evaluation judges every reading of the fit.  A reading outside it, of the covariance k
# with those inside, errs by d = e − BΔx − kᵀV⁻¹r, which varies by Σ − kᵀV⁻¹k + FΦ_AFᵀ with
# F = B − kᵀV⁻¹B_fit.


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
    own, dof = own_noise(found.fit, readings)
    t = _predicted(found, readings, good, own)
    # A fitted reading has a part in the variance it is measured with: leave it out there as well.
    squared = np.minimum(t**2, dof * (1 - 1e-12))
    outside = np.maximum(dof - 1, 1.0)
    deleted = np.sqrt(squared * outside / (dof - squared))
    fitted_too = good[:, None]
    return np.where(fitted_too, deleted, np.abs(t)), np.where(fitted_too, outside, dof)


def _predicted(found: NoiseFit, readings: Readings, good: BoolArray, own: Array) -> Array:
    """Errors (N, size) of predicting each reading from the others, each over its deviation."""
    structure, theta, _ = variances_of(found.fit, readings)
    basis = found.basis[: readings.n_parameters, : readings.n_parameters]
    turned = replace(readings, B=readings.B @ basis)
    noisy = NoisyReadings(turned, found.fit.noisy.kind, found.lasting, structure, ~good)
    known = dict(zip(found.fit.noisy.names, found.fit.theta, strict=True))
    rest = [known.get(name, 0.0) for name in noisy.names[len(theta) :]]
    state = noisy.model().state(np.concatenate([theta, rest]))
    spread = covariance_of(found.fit, np.eye(len(state.x)))[0]
    size, sets = readings.size, noisy.sets
    P, variance = np.zeros((2, sets.n, size, size))
    Pe, d = np.zeros((2, sets.n, size))
    for (members, _), w, (pack, inside, u) in zip(
        noisy.packs, state.packs, state.projected(), strict=False
    ):
        here, M = members >= 0, members.shape[1]
        P[members[here]] = _blocks(inside, M)[here]
        Pe[members[here]] = u.reshape(-1, M, size)[here]
        some = (pack.absent & np.repeat(here, size, axis=1)).any(axis=1)
        if some.any():
            # R⁻¹k of every row with those that count, F and d.
            V = pack.V(state.theta)[some]
            k = w.root[some] @ V
            back, own_sets = k.transpose(0, 2, 1), members[some]
            F = sets.B[own_sets].reshape(*V.shape[:2], -1) - back @ w.B[some]
            off = sets.e[own_sets].reshape(V.shape[:2]) - (back @ w.e[some][..., None])[..., 0]
            left = _blocks(V - back @ k + F @ spread @ F.transpose(0, 2, 1), M)
            d[own_sets[here[some]]] = (off - F @ state.x).reshape(-1, M, size)[here[some]]
            variance[own_sets[here[some]]] = left[here[some]]
    out = _deleted(noisy, P, Pe, own)
    outside = d / np.sqrt(np.maximum(np.diagonal(variance, axis1=1, axis2=2), 1e-300))
    out[~good] = outside[sets.of[~good]]
    return out


def _blocks(V: Array, M: int) -> Array:
    """The blocks (C, M, size, size) along the diagonal of V (C, M·size, M·size)."""
    size, at = V.shape[1] // M, np.arange(M)
    return V.reshape(-1, M, size, M, size)[:, at, :, at, :].transpose(1, 0, 2, 3)


def _deleted(noisy: NoisyReadings, P: Array, Pe: Array, own: Array) -> Array:
    """d_i over its deviation (N, size), of P (S, size, size) and Pe (S, size) of sets of repeats,
    whose contrasts have their own noise alone."""
    sets, of, e = noisy.sets, noisy.sets.of, noisy.readings.e
    precision = np.linalg.inv(sets.mean(own))[of]
    share = (1 / sets.root**2)[of, None, None]
    mean = (sets.e / sets.root[:, None])[of]
    inside = share * P[of] + (1 - share) * precision
    right = Pe[of] / sets.root[of, None] + (precision @ (e - mean)[..., None])[..., 0]
    # A direction that this reading alone determines has no deletion residual.
    values, vectors = np.linalg.eigh(inside)
    smallest = 1e-9 * np.linalg.eigvalsh(precision)[:, -1:]
    inverse = np.where(values > smallest, 1 / np.maximum(values, smallest), 0.0)
    spread = (vectors * inverse[:, None, :]) @ vectors.transpose(0, 2, 1)
    d = (spread @ right[..., None])[..., 0]
    deviation = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    return np.divide(d, deviation, out=np.zeros_like(d), where=deviation > 0)


# The default estimate: faulty readings set apart, noise model chosen, x by its weights.

ROUNDS = 12
FEWEST_GOOD = 0.5


class NoiseAndOutliers(NamedTuple):
    """The noise found from the `good` readings (N,); the noise does not explain the others."""

    noise: NoiseFit
    good: BoolArray


def settle(
    readings: Readings, kind: str = "auto", good: BoolArray | None = None,
    known: NoiseAndOutliers | None = None,
) -> NoiseAndOutliers:  # fmt: skip
    """Noise and good readings that agree with each other, starting from `good` (default all).

    A kind of noise that is `known` from such readings is only chosen again where those that turn
    out good are not those that it was chosen from, or have other columns.

    The noise model is fitted to the good readings, every reading is judged by the error of its
    prediction from them (false-alarm rate 1 % for the whole table), and so on.  Starting from
    all, errors that hide each other may stay: start from a robust fit.  A set that comes back
    after others ends the search: readings that were good at any time of that round are kept.

    Faulty readings that are taken back bend the fit, so that more of them seem to fit.  Where the
    better half of all readings is left worse explained than by an earlier set, beyond what chance
    allows, that set stands.
    """
    good = np.ones(len(readings), dtype=bool) if good is None else good
    like = None if known is None else known.noise
    first = kind if like is None else like.kind
    try:
        noise = estimate_noise(readings.take(good), first, like)
    except ElastocalError:
        good = np.ones(len(readings), dtype=bool)  # the others alone do not show all parameters
        noise = estimate_noise(readings, first, like)
    chosen_from = good if known is None else known.good
    anew = known is not None and len(known.noise.x) != readings.n_parameters
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
            noise = estimate_noise(readings.take(updated), noise.kind, noise)
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
    if kind == "auto" and (anew or not np.array_equal(good, chosen_from)):
        noise = estimate_noise(readings.take(good), kind)
    return NoiseAndOutliers(noise, good)


def _misfit(noise: NoiseFit, readings: Readings, precision: Array) -> float:
    """Sum of the smaller half of the squared residuals, in units of `precision` (N, size, size)."""
    r = readings.e - readings.B @ noise.x
    squared = np.einsum("ni,nij,nj->n", r, precision, r)
    return float(np.sort(squared)[: len(squared) // 2 + 1].sum())
