"""What is left of the oracle's knowledge where it has to search for the lines' orders.

All else is as for the oracle.  For every joint and first order on a grid, columns are the sines and
cosines of this order and its multiples, each with the prior of its amplitude; a joint whose family
is not found yet scatters from pose to pose by as much as its lines do.  Families are taken in
while the marginal likelihood of the readings grows by more than the logarithm of the number of
orders tried, the best first, and refined.  Its error over the oracle's is the price of not knowing
orders, to one who knows noise, scatter, sizes and all else: `whole_arms.py --search` shows it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from whole_draw import RANGES
from whole_laws import LINES
from whole_oracle import Sights, effects, geometry, line_deviation, rms_length, whitening

Array = NDArray[np.float64]
STEP = 0.25  # of the resolution: one over the range of the joint's angle
FINE, FINE_STEPS = 0.05, 20  # about the best, in the same unit
MULTIPLES = 3


class Search:
    """The readings of a world, whitened, beside what is known but the families of lines.

    Readings are those about the truth: noise, and what the families do.
    """

    def __init__(self, sights: Sights) -> None:
        self.sights = sights
        world = sights.world
        self.joints = range(sights.at_here.load.shape[1])
        blocks = [*geometry(sights), *effects(sights)]
        known = [b for b in blocks if b.line in ("", "eccentricity")]
        families = [b for b in blocks if b.line not in ("", "eccentricity")]
        truth = world.noise_free(sights.here)
        self._white = whitening(sights, truth)
        moved = sum(b.here @ b.away for b in families)
        r = (world.readings() - truth).reshape(len(truth), -1) + moved
        self.t = np.einsum("nij,nj->ni", self._white, r)
        self.hidden = sum(b.there @ b.away for b in families)
        here = np.concatenate([b.here * b.deviation for b in known], axis=2)
        self.there = np.concatenate([b.there * b.deviation for b in known], axis=2)
        self.away = np.concatenate([b.away / b.deviation for b in known])
        self.known = self._white @ here

    @cached_property
    def joint(self) -> Array:
        """Whitened motion (n, K, J) per rad of a joint, times the size of a first line."""
        return self._white @ self.sights.at_here.joint * self.sights.world.spec.gear

    @cached_property
    def sizes(self) -> Array:
        """Prior deviations of the lines of a family, heavy arm, rad."""
        return np.array([line_deviation(f"line{m + 1}") for m in range(MULTIPLES)])

    def scattered(self, j: int) -> Array:
        """Columns (n, K, poses) of a joint that errs at each pose by as much as its lines do."""
        pose = self.sights.here.pose
        each = np.eye(pose.max() + 1)[pose] * np.sqrt(2 * (self.sizes[:2] ** 2).sum())
        return self.joint[:, :, j, None] * each[:, None]

    def waves(self, q: Array, order: Array) -> Array:
        """(n, orders, 2 MULTIPLES) in units of their priors; lines above the highest are zero."""
        multiple = np.arange(1, MULTIPLES + 1)
        orders = order[:, None] * multiple
        phase = q[:, None, None] * orders
        size = self.sizes * (orders <= RANGES.highest_order)
        return np.concatenate([np.sin(phase) * size, np.cos(phase) * size], axis=2)

    def family(self, j: int, order: float) -> tuple[Array, Array]:
        """Columns here, whitened, and there, of a joint's family."""
        s = self.sights
        here, there = (self.waves(v.q[:, j], np.array([order]))[:, 0] for v in (s.here, s.there))
        other = s.at_there.joint[:, :, j] * s.world.spec.gear
        return self.joint[:, :, j, None] * here[:, None], other[:, :, None] * there[:, None]

    def columns(self, found: Mapping[int, float], scattering: list[int]) -> Array:
        parts = [self.known, *(self.family(j, p)[0] for j, p in found.items())]
        parts += [self.scattered(j) for j in scattering]
        X = np.concatenate(parts, axis=2)
        return X.reshape(-1, X.shape[2])

    def solved(self, X: Array) -> tuple[Array, tuple]:
        """Estimate in units of the priors, and the factor of its information."""
        factor = cho_factor(X.T @ X + np.eye(X.shape[1]))
        mean = np.zeros(X.shape[1])
        mean[: len(self.away)] = self.away
        return cho_solve(factor, X.T @ self.t.ravel() - mean), factor

    def gains(self, found: Mapping[int, float], j: int, orders: Array) -> Array:
        """Log likelihood ratio (orders,) of a family at joint j to scatter of as much there."""
        rest = [i for i in self.joints if i not in found and i != j]
        X = self.columns({i: p for i, p in found.items() if i != j}, rest)
        u, factor = self.solved(X)
        left = (self.t.ravel() - X @ u).reshape(self.t.shape)
        n, K = self.t.shape
        own = self.joint[:, :, j]
        crossed = np.einsum("nk,nkp->np", own, X.reshape(n, K, -1))
        weight, pull = (own**2).sum(axis=1), (own * left).sum(axis=1)

        def gain(w: Array) -> float:
            b, c = w.T @ pull, crossed.T @ w
            A = w.T @ (weight[:, None] * w) - c.T @ cho_solve(factor, c) + np.eye(w.shape[1])
            return float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1]) / 2

        pose = self.sights.here.pose
        size = np.sqrt(2 * (self.sizes[:2] ** 2).sum())
        scatter = gain(np.eye(pose.max() + 1)[pose] * size)
        waves = self.waves(self.sights.here.q[:, j], orders)
        return np.array([gain(waves[:, k]) for k in range(len(orders))]) - scatter

    def error(self, found: Mapping[int, float]) -> float:
        """Rms length (m) at the other poses."""
        rest = [j for j in self.joints if j not in found]
        u, _ = self.solved(self.columns(found, rest))
        other = [self.there, *(self.family(j, p)[1] for j, p in found.items())]
        X = np.concatenate(other, axis=2)
        return rms_length(X @ u[: X.shape[2]] - self.hidden)


def searched(sights: Sights) -> tuple[float, dict[int, float]]:
    """Rms length (m) of the error at the other poses, and the first order of every joint (0-based)
    whose family is found."""
    search = Search(sights)
    found: dict[int, float] = {}
    resolution = 1 / np.ptp(sights.here.q, axis=0)
    grids = [np.arange(*RANGES.order, STEP * r) for r in resolution]
    while len(found) < len(search.joints):
        best = []
        for j in search.joints:
            if j not in found:
                gains = search.gains(found, j, grids[j])
                best.append((gains.max() - np.log(len(grids[j])), j, grids[j][gains.argmax()]))
        gain, j, order = max(best)
        if gain <= 0:
            break
        found[j] = float(order)
        for i in found:
            fine = found[i] + FINE * resolution[i] * np.arange(-FINE_STEPS, FINE_STEPS + 1)
            found[i] = float(fine[search.gains(found, i, fine).argmax()])
    return search.error(found), found


def true_orders(sights: Sights) -> dict[int, float]:
    """The first order of every joint's family."""
    lines = [e for e in sights.world.effects if e.name == LINES]
    return {e.index: e.settings["line1"] for e in lines}
