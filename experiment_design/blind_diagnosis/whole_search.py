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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from whole_draw import RANGES
from whole_laws import LINES
from whole_oracle import Sights, covariance, effects, geometry, line_deviation, rms_length

Array = NDArray[np.float64]
STEP = 0.25  # of the resolution: one over the range of the joint's angle
FINE, FINE_STEPS = 0.05, 20  # about the best, in the same unit
MULTIPLES = 3


@dataclass(frozen=True)
class Fit:
    """Known columns and families fitted beside joints that scatter from pose to pose.

    Readings and columns are whitened: left (P, 2K) what remains of the readings of P poses, X
    (P, 2K, p), estimate u (p,), the factor of its information, the Cholesky factors of the poses'
    covariances (P, 2K, 2K), and the log evidence but for a constant.
    """

    root: Array
    X: Array
    left: Array
    u: Array
    factor: tuple
    evidence: float


class Search:
    """The readings of a world beside what is known but the families of lines.

    Readings are those about the truth: noise, and what the families do.  Every pose has two
    visits, whose rows stand together here.
    """

    def __init__(self, sights: Sights) -> None:
        self.sights = sights
        world, at = sights.world, sights.at_here
        self.joints = range(at.load.shape[1])
        self._rows = np.argsort(sights.here.pose, kind="stable").reshape(-1, 2)
        blocks = [*geometry(sights), *effects(sights)]
        known = [b for b in blocks if b.line in ("", "eccentricity")]
        families = [b for b in blocks if b.line not in ("", "eccentricity")]
        self._noise = covariance(sights, world.noise_free(sights.here))
        r = world.readings() - world.noise_free(sights.here)
        moved = sum(b.here @ b.away for b in families)
        self._readings = self._by_pose(r.reshape(len(r), -1) + moved)
        self._hidden = sum(b.there @ b.away for b in families)
        here = np.concatenate([b.here * b.deviation for b in known], axis=2)
        self._known = self._by_pose(here)
        self._there = np.concatenate([b.there * b.deviation for b in known], axis=2)
        self._away = np.concatenate([b.away / b.deviation for b in known])
        self._joint = self._by_pose(at.joint) * world.spec.gear
        self._angles = sights.here.q[self._rows[:, 0]]
        self._sizes = np.array([line_deviation(f"line{m + 1}") for m in range(MULTIPLES)])

    def _by_pose(self, rows: Array) -> Array:
        """(n, K, …) of visits → (P, 2K, …) of poses."""
        both = rows[self._rows]
        return both.reshape(len(both), -1, *rows.shape[2:])

    def waves(self, q: Array, orders: Array) -> Array:
        """(n, orders, 2 MULTIPLES) in units of their priors; lines above the highest are zero."""
        each = orders[:, None] * np.arange(1, MULTIPLES + 1)
        phase, size = q[:, None, None] * each, self._sizes * (each <= RANGES.highest_order)
        return np.concatenate([np.sin(phase) * size, np.cos(phase) * size], axis=2)

    def fit(self, found: Mapping[int, float], apart: int | None = None) -> Fit:
        """With these families; joints without one scatter, but `apart`."""
        scattering = [j for j in self.joints if j not in found and j != apart]
        size = np.sqrt(2 * (self._sizes[:2] ** 2).sum())
        moved = self._joint[:, :, scattering] * size
        V = moved @ moved.transpose(0, 2, 1)
        K = self._noise.shape[1]
        for visit in range(2):
            rows = slice(visit * K, (visit + 1) * K)
            V[:, rows, rows] += self._noise[self._rows[:, visit]]
        root = np.linalg.cholesky(V)
        own = [
            self._joint[:, :, j, None]
            * self.waves(self._angles[:, j], np.array([p]))[:, 0][:, None]
            for j, p in found.items()
        ]
        X = np.linalg.solve(root, np.concatenate([self._known, *own], axis=2))
        t = np.linalg.solve(root, self._readings[:, :, None])[:, :, 0]
        flat = X.reshape(-1, X.shape[2])
        away = np.zeros(X.shape[2])
        away[: len(self._away)] = self._away
        factor = cho_factor(flat.T @ flat + np.eye(X.shape[2]))
        u = cho_solve(factor, flat.T @ t.ravel() - away)
        left = t - X @ u
        misfit = (left**2).sum() + ((u + away) ** 2).sum()
        size = np.log(np.diagonal(root, axis1=1, axis2=2)).sum()
        evidence = -misfit / 2 - size - np.log(np.diagonal(factor[0])).sum()
        return Fit(root, X, left, u, factor, float(evidence))

    def gains(self, found: Mapping[int, float], j: int, orders: Array) -> Array:
        """Log likelihood ratio (orders,) of a family at joint j to scatter of as much there."""
        others = {i: p for i, p in found.items() if i != j}
        fit = self.fit(others, apart=j)
        own = np.linalg.solve(fit.root, self._joint[:, :, j, None])[:, :, 0]
        waves = self.waves(self._angles[:, j], orders)
        w = waves.transpose(1, 0, 2)
        crossed = np.einsum("nk,nkp->np", own, fit.X)
        c = np.einsum("np,ona->opa", crossed, w, optimize=True)
        A = np.einsum("ona,n,onb->oab", w, (own**2).sum(axis=1), w, optimize=True)
        flat = c.transpose(1, 0, 2).reshape(c.shape[1], -1)
        solved = cho_solve(fit.factor, flat).reshape(c.shape[1], *c.shape[::2])
        A += np.eye(A.shape[1]) - np.einsum("opa,pob->oab", c, solved, optimize=True)
        b = np.einsum("ona,n->oa", w, (own * fit.left).sum(axis=1))
        best = np.linalg.solve(A, b[:, :, None])[:, :, 0]
        gain = ((b * best).sum(axis=1) - np.linalg.slogdet(A)[1]) / 2
        return gain + fit.evidence - self.fit(others).evidence

    def error(self, found: Mapping[int, float]) -> float:
        """Rms length (m) at the other poses."""
        there, at = self.sights.there, self.sights.at_there
        gear = self.sights.world.spec.gear
        own = [
            gear * at.joint[:, :, j, None] * self.waves(there.q[:, j], np.array([p]))[:, 0][:, None]
            for j, p in found.items()
        ]
        X = np.concatenate([self._there, *own], axis=2)
        return rms_length(X @ self.fit(found).u - self._hidden)


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
