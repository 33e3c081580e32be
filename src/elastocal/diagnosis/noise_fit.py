"""The most probable noise values of data, by a search in their logarithms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from elastocal.diagnosis.noise import (
    LARGEST,
    SHARED,
    SMALLEST,
    STATED_SPREAD,
    UNSTATED_SPREAD,
    NoiseValues,
    NoisyData,
)
from elastocal.diagnosis.projection import likelihood, posterior

Array = NDArray[np.float64]

STRIDE, ROUNDS = 1.5, 10  # of the logarithms
SOME = 250  # configurations that show where the optimum is
ENOUGH, LEVEL = 1e-3, 3e-3  # change of −2ℓ, and its slope, at which a search ends


def fit_noise(data: NoisyData, start: NoiseValues | None = None) -> NoiseValues:
    """The most probable noise values, by a quasi-Newton search in their logarithms.

    Where nothing is stated it starts from two ends, unless a start is given; with many
    configurations it comes from some of them to all.
    """
    if start is not None:
        return _climbed(data, start)
    if len(data.r) >= 2 * SOME:
        return _climbed(data, fit_noise(data.every(len(data.r) // SOME)))
    starts = [NoiseValues.usual(data.G.shape[2])]
    if not data.stated:
        starts.append(_balanced(data))
    ends = [_climbed(data, s) for s in starts]
    return min(ends, key=lambda end: posterior(data, end))


def _balanced(data: NoisyData) -> NoiseValues:
    """Instrument and joints share the scatter of the data equally.

    From far below it the likelihood is flat in a joint's logarithm, and no climb leaves.
    """
    used = ~data.left_out
    whole = float((data.r[used] ** 2).mean())
    shape = float(np.diagonal(data.covariance, axis1=1, axis2=2)[used].mean())
    moved = np.maximum((data.G[used] ** 2).mean(axis=0), 1e-300)
    joint = np.clip(np.sqrt(0.5 * whole / (len(moved) * moved)), SMALLEST, LARGEST)
    return NoiseValues(float(np.sqrt(0.5 * whole / shape)), joint, SHARED)


def _climbed(data: NoisyData, start: NoiseValues) -> NoiseValues:
    n = data.G.shape[2]

    seen: dict[bytes, tuple[float, Array]] = {}

    def cost(theta: Array) -> tuple[float, Array]:
        # A search begins where it has been: at the start, and where the last stride ended.
        key = theta.tobytes()
        if key not in seen:
            seen[key] = likelihood(data, NoiseValues.of_logs(theta))
        value, slope = seen[key]
        return value, slope.copy()

    spread = STATED_SPREAD if data.stated else UNSTATED_SPREAD
    lower = np.array([-4 * spread, -5.0] + [np.log(SMALLEST)] * n)
    upper = np.array([4 * spread, 2.0] + [np.log(LARGEST)] * n)
    theta = np.clip(start.logs(), lower, upper)
    ftol = ENOUGH / max(abs(cost(theta)[0]), 1.0)
    # Step by step: one long stride of the line search ends where V is singular to rounding.
    # A round ends at the first small gain, often that of a poor first direction: the search is
    # over when a whole round gains nothing.
    for _ in range(ROUNDS):
        low, high = np.maximum(lower, theta - STRIDE), np.minimum(upper, theta + STRIDE)
        found = optimize.minimize(
            cost, theta, jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
            options={"maxiter": 60, "ftol": ftol, "gtol": LEVEL},
        )  # fmt: skip
        gain, theta = cost(theta)[0] - float(found.fun), found.x
        inside = (theta > low) & (theta < high) | (theta == lower) | (theta == upper)
        if inside.all() and gain < ENOUGH:
            break
    return NoiseValues.of_logs(theta)
