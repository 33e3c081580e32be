"""Parameters with a prior beside parameters without one: sizes by restricted likelihood, posterior.

    e = B_f α + B_s b + ε,   ε ~ N(0, σ²),   b ~ N(0, Λ),   Λ = diag(λ_g s²)

with whitened rows; α are the ordinary parameters, b the shrunk ones as deviations from nominal, s
their standard deviations as declared and λ_g one scale for each group.  With [B_f B_s e] = QR the
rows are needed no more: R_ss, below what the ordinary parameters take, holds all that decides σ²
and λ (Patterson and Thompson 1971; Harville 1977).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from elastocal.engine.mixed import Products, climb
from elastocal.identification.covariance import root_of, t_quantile
from elastocal.identification.knowledge import share_of_prior
from elastocal.identification.weighted_problem import RFactor
from elastocal.model.manipulator import SmoothGroup
from elastocal.units import Array, IntArray

# Scales λ beyond these are no longer told apart: nothing is left of the group, or of its prior.
LEAST, MOST = 1e-3, 1e6
SMALL = 0.05
# Of log λ above 0: a function may be smaller than stated at no price, but ten times the size costs
# what a likelihood ratio of 1e8 gains.  Data that hardly show a function know no upper limit.
PRICE = 0.75
# Noise as shares of the variance that ordinary parameters leave, from which the search starts.
SHARES = (1.0, 0.1, 0.01, 0.001)
STEPS, ENOUGH, CURVED = 30, 0.02, 0.3  # of −2ℓ: what the last step may promise; its curvature


@dataclass(frozen=True)
class Scales:
    """λ (groups,), σ² of a whitened row, and by how much (groups,) the restricted log-likelihood
    falls where a group is left out."""

    scale: Array
    variance: float
    gain: Array

    @property
    def sigma(self) -> float:
        return float(np.sqrt(self.variance))


@dataclass(frozen=True)
class LinearRows:
    """Rows linearised: the R factor of [B_f B_s e], e at nominal functions.

    `std` (shrunk,) are the prior's standard deviations as declared, `group` (shrunk,) the numbers
    of the groups.
    """

    factor: RFactor
    std: Array
    group: IntArray

    @classmethod
    def of(cls, factor: RFactor, away: Array, std: Array, group: IntArray) -> LinearRows:
        """From the R factor with the functions `away` (shrunk,) from nominal."""
        rows = factor.augmented.copy()
        rows[:, -1] += rows[:, len(rows) - 1 - len(away) : -1] @ away
        return cls(RFactor(rows, factor.rows), std, group)

    def only(self, kept: IntArray) -> LinearRows:
        """With the ordinary columns `kept` alone: what the others took is the functions' again."""
        chosen = np.append(kept, np.arange(self.ordinary, self.factor.columns))
        return replace(self, factor=self.factor.of_columns(chosen))

    @property
    def ordinary(self) -> int:
        return self.factor.columns - len(self.std)

    @cached_property
    def products(self) -> Products:
        """Those of B_s and e with the ordinary columns projected out."""
        S, e = self.factor.augmented[self.ordinary :, self.ordinary : -1], self.factor.augmented
        left = e[self.ordinary :, -1]
        spare = max(self.factor.rows - self.ordinary, 1)
        return Products(S.T @ S, S.T @ left, float(left @ left), spare)

    def scales(self, start: Scales | None = None) -> Scales:
        """λ and σ² of the largest restricted likelihood, where λ above 1 has its PRICE; what is 0
        at the `start` stays so."""
        alive = (
            np.ones(self.group.max(initial=-1) + 1, dtype=bool)
            if start is None
            else start.scale > 0
        )
        own = np.flatnonzero(alive[self.group])
        group = np.unique(self.group[own], return_inverse=True)[1].ravel()
        whole = self.products
        products = replace(whole, M=whole.M[np.ix_(own, own)], z=whole.z[own])
        grown = 2.0 * (group[:, None] == np.arange(int(alive.sum())))

        def objective(theta: Array) -> tuple[float, Array, Array]:
            """In log σ and the ½ log λ of the groups."""
            variances = np.exp(2 * theta[1:])[group] * self.std[own] ** 2
            value, slope, information = products.objective(variances, grown, float(theta[0]))
            over = np.maximum(2 * theta[1:], 0.0) / PRICE
            slope[1:] += 4 * over / PRICE
            # What is next to nothing has next to no curvature: no step may be taken for it.
            information[np.diag_indices_from(information)] += CURVED
            at = 1 + np.flatnonzero(over > 0)
            information[at, at] += 8 / PRICE**2
            return value + float(over @ over), slope, information

        variance, n = max(whole.squares / whole.rows, 1e-300), grown.shape[1]
        size = 0.5 * np.log([LEAST, MOST])
        noise = 0.5 * np.log(variance) + np.array([-20.0, 1.0])
        lower, upper = (np.concatenate([[noise[k]], np.full(n, size[k])]) for k in (0, 1))

        def found(theta: Array) -> Array:
            return climb(objective, np.clip(theta, lower, upper), lower, upper, ENOUGH, STEPS)[0]

        if start is None:
            levels = 0.5 * np.log(variance * np.array(SHARES))
            begun = [np.concatenate([[level], np.zeros(n)]) for level in levels]
            theta = found(min(begun, key=lambda one: objective(one)[0]))
            small = theta[1:] < 0.5 * np.log(SMALL)
            if small.any():
                again = found(np.where(np.concatenate([[False], small]), 0.0, theta))
                theta = min(theta, again, key=lambda one: objective(one)[0])
        else:
            # From nothing the likelihood shows no way back: what is small begins anew.
            known = np.where(start.scale[alive] < SMALL, 1.0, start.scale[alive])
            theta = found(0.5 * np.log(np.concatenate([[start.variance], known])))
        scale, gain = np.zeros(len(alive)), np.zeros(len(alive))
        scale[alive] = np.exp(2 * theta[1:])
        at = products.at(scale[self.group[own]] * self.std[own] ** 2, float(theta[0]))
        gain[alive] = at.left_out([np.flatnonzero(group == g) for g in range(n)])
        return Scales(scale, float(np.exp(2 * theta[0])), gain)

    def posterior(self, scales: Scales) -> Posterior:
        k, std = self.ordinary, np.sqrt(scales.scale / scales.variance)[self.group] * self.std
        own = np.flatnonzero(std > 0)
        P = np.eye(len(own), k + len(own), k) / std[own, None]
        rows = self.factor.of_columns(np.append(np.arange(k), k + own))
        prior = RFactor(np.column_stack([P, np.zeros(len(own))]), 0)
        return Posterior(rows.merged(prior), own, P)


@dataclass(frozen=True)
class Posterior:
    """The estimate under a prior: ordinary columns first, then the shrunk ones that take part.

    `r_factor` is that of readings and prior rows P (own, columns) together, in units of σ, the
    shrunk ones counted from nominal; `own` index those that take part.
    """

    r_factor: RFactor
    own: IntArray
    P: Array

    @property
    def ordinary(self) -> int:
        return self.r_factor.columns - len(self.own)

    @property
    def of_own(self) -> Array:
        """P of the shrunk ones (own, own), diagonal."""
        return self.P[:, self.ordinary :]

    @cached_property
    def half(self) -> Array:
        return self.r_factor.half

    @property
    def step(self) -> Array:
        """α and b (columns,)."""
        return self.half @ self.r_factor.projected

    @property
    def marginal(self) -> RFactor:
        """R of the ordinary columns with the shrunk ones taken for noise,
        RᵀR/σ² = B_fᵀ(σ² + B_sΛB_sᵀ)⁻¹B_f."""
        last = np.roll(np.arange(self.r_factor.columns), len(self.own))
        rows = self.r_factor.of_columns(last)
        return RFactor(rows.augmented[len(self.own) :, len(self.own) :], rows.rows)

    @cached_property
    def cofactor(self) -> Array:
        return self.half @ self.half.T

    @property
    def prior_share(self) -> Array:
        """Share of each estimate's information that is the prior's, 0 to 1."""
        return share_of_prior(self.cofactor, self.P)

    @cached_property
    def effective(self) -> Array:
        """How many parameters' worth of each (columns,) the readings determine, 0 to 1: their sum
        is the trace of the hat matrix."""
        return np.asarray(1 - (self.P**2).sum(axis=0) * np.diag(self.cofactor))


# What an identification says of a smooth function: its size, and how sure.

PLACES = 500
DRAWS = 400
LEVEL = 0.95


@dataclass(frozen=True)
class SmoothPart:
    """A smooth function as it was fitted.

    Attributes:
        group: Its parameters and what it follows.
        scale: By how much the variance of its coefficients is larger than the prior that the cell
            states; 0 where it was left out.
        effective: How many coefficients' worth of it the readings determine.
        value: Coefficients (components, waves).
        covariance: Theirs, (components · waves, components · waves).
        places: What it follows in the readings fitted (n,), in rad or s.
    """

    group: SmoothGroup
    scale: float
    effective: float
    value: Array
    covariance: Array
    places: Array

    @property
    def coefficients(self) -> int:
        """How many parameters it has."""
        return int(self.value.size)

    def refitted(self, x: Array, columns: IntArray, covariance: Array) -> SmoothPart:
        """The same function at other parameters x (parameters,), the covariance that of the
        `columns` fitted."""
        mine = self.group.columns
        place = {int(c): k for k, c in enumerate(columns)}
        at = np.array([place.get(int(c), -1) for c in mine.ravel()])
        there, matrix = np.flatnonzero(at >= 0), np.zeros((mine.size, mine.size))
        matrix[np.ix_(there, there)] = covariance[np.ix_(at[there], at[there])]
        return replace(self, value=x[mine], covariance=matrix)

    def _own_waves(self, x: Array) -> Array:
        """The waves at x (n,) without their mean and their wave of one period per turn (of a time,
        its slope), for which offsets, lengths and tilts of the arm can stand."""
        assert self.group.basis is not None
        alike = [np.ones(len(x)), *((np.cos(x), np.sin(x)) if self.group.lasting else (x - x[0],))]
        Q, _ = np.linalg.qr(np.column_stack(alike))
        waves = self.group.basis(x)
        return np.asarray(waves - Q @ (Q.T @ waves))

    def _block(self, c: int, k: int) -> Array:
        return self.covariance[c * k : (c + 1) * k, c * k : (c + 1) * k]

    @cached_property
    def sizes(self) -> dict[str, tuple[float, tuple[float, float], float]]:
        """By unit, over all components and the places of the readings: rms of what is left of the
        function without what the arm can stand for, the 95 % interval of that, and the rms half
        width of its 95 % band.

        Of parameters that are no function of one quantity, the root of their sum of squares.
        """
        basis = self.group.basis
        found = {}
        for unit in dict.fromkeys(self.group.units):
            own = [c for c, u in enumerate(self.group.units) if u == unit]
            if basis is None:
                waves = np.eye(self.value.shape[1]) * np.sqrt(self.value.shape[1])
            else:
                places = np.sort(self.places)
                even = np.linspace(0, len(places) - 1, min(len(places), PLACES)).astype(int)
                waves = self._own_waves(places[even])
            mean = self.value[own] @ waves.T
            rng = np.random.default_rng(0)
            k = waves.shape[1]
            total, spread = np.zeros(DRAWS), 0.0
            for c, m in zip(own, mean, strict=True):
                drawn = rng.normal(size=(DRAWS, k)) @ root_of(self._block(c, k)).T @ waves.T
                total += ((m + drawn) ** 2).mean(axis=1)
                spread += float(((waves @ self._block(c, k)) * waves).sum(axis=1).mean())
            rms = np.sqrt(total / (1 if basis is None else len(own)))
            low, high = np.quantile(rms, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
            half = float(t_quantile(LEVEL, np.array(np.inf))) * np.sqrt(spread / len(own))
            found[unit] = (float(np.median(rms)), (float(low), float(high)), float(half))
        return found

    def to_json(self) -> list[dict[str, Any]]:
        """An entry for each unit that the function has, in SI."""
        g = self.group
        return [
            {
                "effect": g.effect, "where": g.where, "follows": g.follows or None, "unit": unit,
                "size": g.size, "length": _finite(g.length), "low": _finite(g.low),
                "high": _finite(g.high), "scale": self.scale, "coefficients": self.coefficients,
                "effective": self.effective, "rms": rms, "rms_ci95": list(ci95), "band95": half,
            }
            for unit, (rms, ci95, half) in self.sizes.items()
        ]  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
