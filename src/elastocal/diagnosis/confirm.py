"""How far the gap shrinks on poses that had no part in choosing or fitting the effect.

The error of a fresh pose is the model's prediction less the truth, without noise.  Each
configuration c stands for a fresh one: predictions for it come from fits to the others, and miss
its readings by e₋c, of which n*_c = r_c − X_c θ* is noise, θ* drawn from the posterior given all
data:

    before:  n*_c − e⁰₋c,   after:  n*_c − e¹₋c.

What is drawn as the truth is at times a rival or nothing, as probable as each is, which
charges the interval for the selection.  The remaining fraction is the ratio of the rms errors,
with configurations weighted at random (Bayesian bootstrap, Rubin 1981) for the choice of poses,
and a set of FRESH poses drawn by these weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.diagnosis.heldout import left_out_residual, squared_lengths
from elastocal.diagnosis.model_set import ModelSet
from elastocal.diagnosis.noise import project

Array = NDArray[np.float64]

DRAWS = 400
FRESH = 100  # poses of the fresh set that the intervals are for


@dataclass(frozen=True)
class Shrinkage:
    """Fraction by which the fresh-pose error falls: best value, `ci90` and `ci95`."""

    reduction: float
    ci90: tuple[float, float]
    ci95: tuple[float, float]


def shrinkage(
    before: ModelSet, after: ModelSet, truths: list[tuple[ModelSet, float]], between: float,
    rng: np.random.Generator,
) -> Shrinkage:  # fmt: skip
    """Reduction from `before` to `after`, the truth being each of `truths` with its probability.

    `between` (m²): squared error of all readings, on average over configurations, that a change
    makes in the pause in which it happened: a fresh pose may fall on the wrong side of it.
    """
    data = before.data
    missed = [_missed(s) for s in (before, after)]
    weights = np.array([p for _, p in truths])
    which = rng.choice(len(truths), DRAWS, p=weights / weights.sum())
    ratios = np.empty(DRAWS)
    draws = {k: _Draws(truths[k][0]) for k in np.unique(which)}
    for d in range(DRAWS):
        noise = draws[which[d]](rng)
        configurations = rng.multinomial(FRESH, rng.dirichlet(np.ones(len(noise)))) / FRESH
        squares = [float(configurations @ squared_lengths(data, noise - e)[0]) for e in missed]
        squares[1] += between * rng.random()
        ratios[d] = 1 - np.sqrt(squares[1] / max(squares[0], 1e-300))
    low95, low90, middle, high90, high95 = np.quantile(ratios, [0.025, 0.05, 0.5, 0.95, 0.975])
    return Shrinkage(float(middle), (float(low90), float(high90)), (float(low95), float(high95)))


def _missed(chosen: ModelSet) -> Array:
    """Left-out residuals (C, m) of a fit weighted by the instrument's noise alone.

    That is what a calibration does that knows nothing of the joints' scatter; and the scatter
    fitted beside a missing effect is the effect, which weights by it would spare.
    """
    at = project(chosen.data, chosen.noise.of_instrument())
    return chosen.data.masked(left_out_residual(at))


class _Draws:
    """Noise r − X θ* (C, m) with θ* from the posterior of a set."""

    def __init__(self, chosen: ModelSet) -> None:
        at, data = chosen.at, chosen.data
        self.X, self.r = data.masked(data.X), data.masked(data.r)
        self.factor = at.factor
        self.mean = at.beta

    def __call__(self, rng: np.random.Generator) -> Array:
        spread = linalg.solve_triangular(
            self.factor, rng.normal(size=len(self.mean)), lower=True, trans="T"
        )
        return np.asarray(self.r - self.X @ (self.mean + spread))
