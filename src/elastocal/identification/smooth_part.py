"""What an identification says of a smooth function: its size, how sure, and its course."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from elastocal.identification.covariance import root_of, t_quantile
from elastocal.model.smooth_groups import SmoothGroup
from elastocal.units import Array, IntArray

GRID = 200
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

    def course(self, x: Array) -> tuple[Array, Array]:
        """Values and half widths of their 95 % band (components, n) at x (n,); NaN where the
        parameters are no function of one quantity."""
        if self.group.basis is None:
            nothing = np.full((len(self.value), len(x)), np.nan)
            return nothing, nothing
        return self._course(self.group.basis(x))

    def shape(self) -> tuple[Array, Array, Array]:
        """Places x (GRID,) over its range, values and half widths of the 95 % band (components,
        GRID) of what is left of the function without its mean and its wave of one period per
        turn (of a time, its slope), for which offsets, lengths and tilts of the arm can stand."""
        if self.group.basis is None:
            nothing = np.zeros((len(self.value), 0))
            return np.zeros(0), nothing, nothing
        x = self.group.grid(GRID)
        return x, *self._course(self._own_waves(x))

    def _own_waves(self, x: Array) -> Array:
        assert self.group.basis is not None
        alike = [np.ones(len(x)), *((np.cos(x), np.sin(x)) if self.group.lasting else (x - x[0],))]
        Q, _ = np.linalg.qr(np.column_stack(alike))
        waves = self.group.basis(x)
        return np.asarray(waves - Q @ (Q.T @ waves))

    def _course(self, waves: Array) -> tuple[Array, Array]:
        k = self.value.shape[1]
        half = float(t_quantile(LEVEL, np.array(np.inf)))
        width = [
            np.sqrt(np.maximum(((waves @ self._block(c, k)) * waves).sum(axis=1), 0.0))
            for c in range(len(self.value))
        ]
        return self.value @ waves.T, half * np.array(width)

    def _block(self, c: int, k: int) -> Array:
        return self.covariance[c * k : (c + 1) * k, c * k : (c + 1) * k]

    @cached_property
    def sizes(self) -> dict[str, tuple[float, tuple[float, float], float]]:
        """By unit, over all components and the places of the readings: rms of the function's
        `shape`, the 95 % interval of that, and the rms half width of the 95 % band.

        Of parameters that are no function of one quantity, the root of their sum of squares.
        """
        basis = self.group.basis
        found = {}
        for unit in dict.fromkeys(self.group.units):
            own = [c for c, u in enumerate(self.group.units) if u == unit]
            if basis is None:
                waves = np.eye(self.value.shape[1]) * np.sqrt(self.value.shape[1])
            else:
                waves = self._own_waves(_thinned(self.places))
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


def _thinned(places: Array) -> Array:
    """At most PLACES of them, evenly over their order."""
    if len(places) <= PLACES:
        return places
    ordered = np.sort(places)
    return np.asarray(ordered[np.linspace(0, len(ordered) - 1, PLACES).astype(int)])


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
