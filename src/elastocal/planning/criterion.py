"""What a planning criterion is: a function Φ of the covariance V = M⁻¹ of a plan's parameters.

A criterion states its value, its slope C = ∂Φ/∂V and, where it has a bound, its curvature.  Through
V they are those of the information M: with A, A' two directions of M and G = V C V,

    ∂Φ = −⟨G, A⟩,        ∂²Φ = 2 tr(A V A' G) + D²Φ[V A V, V A' V]

Φ is of degree 1 in V, and where it is `certifiable` 1/Φ is concave in M (Pukelsheim 2006, ch. 5),
so that its tangent lies above it: 1/Φ(M') ≤ ⟨G, M'⟩/Φ² for every M'.  That one inequality prices
candidates, prunes them, orders exchanges and bounds every plan.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np

from elastocal.errors import InputError, require
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, BoolArray, IntArray

Need = Literal["test_poses", "combination", "doubts"]

# tr(H⁻¹) of M scaled to unit diagonal, H, above which M is singular to rounding: a matrix of rank
# p − 1 formed in double precision shows 1/(p ε) ≈ 10¹⁴ or more.
SINGULAR = 1e13


def covariance(M: Array) -> tuple[Array, BoolArray]:
    """V = M⁻¹ (..., p, p) of symmetric M, and where M is regular (...), V being of use."""
    size = np.sqrt(np.maximum(np.diagonal(M, axis1=-2, axis2=-1), 0.0))
    size = np.where(size > 0, size, 1.0)
    outer = size[..., :, None] * size[..., None, :]
    lam, U = np.linalg.eigh(M / outer)
    ok = (lam > 0).all(axis=-1)
    inverse = 1 / np.where(lam > 0, lam, 1.0)
    ok &= inverse.sum(axis=-1) < SINGULAR
    return np.asarray((U * inverse[..., None, :]) @ U.swapaxes(-1, -2) / outer), ok


def inverse(M: Array) -> Array:
    """M⁻¹ (..., p, p) of what is regular by its making."""
    return np.asarray(np.linalg.inv(M), dtype=np.float64)


def power_mean(x: Array, q: float) -> Array:
    """(Σ_i x_i^q / n)^{1/q} (...,) of x ≥ 0 (..., n): the geometric mean for q = 0, max for inf.

    It lies between n^{−1/q} max x and max x, q ≥ 1.  Of degree 1, and for 1/x_i concave in M so is
    its reciprocal (Hardy, Littlewood & Pólya 1934, ch. 2).
    """
    top = x.max(axis=-1)
    if q == np.inf:
        return np.asarray(top)
    ratio = x / np.where(top > 0, top, 1.0)[..., None]
    if q == 0:
        with np.errstate(divide="ignore"):
            return np.asarray(top * np.exp(np.log(ratio).mean(axis=-1)))
    return np.asarray(top * (np.maximum(ratio, 0.0) ** q).mean(axis=-1) ** (1 / q))


def mean_slope(x: Array, q: float) -> Array:
    """∂ mean/∂x_i (n,) of x > 0 (n,); of the maximum that of the first largest x_i."""
    if q == np.inf:
        return np.asarray(np.arange(len(x)) == x.argmax(), dtype=float)
    return np.asarray((x / power_mean(x, q)) ** (q - 1) / len(x))


def mean_curvature(x: Array, q: float) -> Array:
    """∂² mean/∂x_i∂x_j (n, n) of x > 0 (n,), q finite."""
    g = mean_slope(x, q)
    return np.asarray((q - 1) * (np.diag(g / x) - np.outer(g, g) / power_mean(x, q)))


def triangular(F: Array) -> Array:
    """R with RᵀR = FᵀF and no more rows than columns."""
    R = np.linalg.qr(F, mode="r") if len(F) > F.shape[1] else F
    return np.asarray(R, dtype=np.float64)


@dataclass(frozen=True)
class TangentBound:
    """Φ(M') ≥ `value`²/⟨G, M'⟩ for every M' (p, p), of a certifiable criterion; G (p, p)."""

    value: float
    G: Array


# What a criterion is made from, and what it is.


@dataclass(frozen=True)
class CriterionInputs:
    """What cell and model give a criterion: p scaled parameters y, x_i = `sizes`_i · y_i.

    `criterion`: the name asked for.  `interest` (k,): indices of the parameters that count, the
    others are nuisance.  A (T, r, p) = ∂(position at target t)/∂y in m, with `weights` (T,);
    `combination` (p,) of y with its `unit`; `n_poses` of the plan; `names` and `sizes` (p,).
    """

    criterion: str
    parameters: int
    interest: IntArray
    A: Array | None = None
    weights: Array | None = None
    combination: Array | None = None
    unit: str = ""
    n_poses: int | None = None
    names: tuple[str, ...] = ()
    sizes: Array | None = None

    def counted(self) -> Array:
        """E (k, p), which picks the parameters of interest; InputError for none or unknown ones."""
        chosen = np.asarray(self.interest)
        require(
            chosen.ndim == 1 and len(chosen) > 0,
            "no parameter of interest is left: every parameter counts as nuisance; name "
            "parameters or effects in [design] interest",
        )
        inside = (chosen >= 0) & (chosen < self.parameters)
        require(
            bool(inside.all()) and len(np.unique(chosen)) == len(chosen),
            f"parameters of interest are repeated or unknown: {chosen.tolist()} of "
            f"{self.parameters}",
        )
        return np.eye(self.parameters)[chosen]

    def targets(self) -> Array:
        """A (T, r, p); InputError where there is none."""
        return self._given(self.A, "test poses", (None, None, self.parameters))

    def target_weights(self) -> Array:
        """Weights (T,) of the test poses, equal where none are stated; InputError for others."""
        shape = self.targets().shape[:1]
        if self.weights is None:
            return np.ones(shape)
        weights = self._given(self.weights, "weights of the test poses", shape)
        require(
            bool((weights >= 0).all() and weights.any()),
            f"weights of the test poses are {quoted(weights.tolist())}: none may be negative, and "
            "one at least must be positive",
        )
        return weights

    def stated_combination(self) -> Array:
        """`[design] combination` as coefficients (p,) of y; InputError where there is none."""
        return self._given(self.combination, "a parameter or combination", (self.parameters,))

    def row(self, factors: Mapping[str, float]) -> Array:
        """Coefficients (p,) of y for Σ factor · x over parameters by name, in SI units.

        Raises InputError for a name that is none of those that the plan's poses show.
        """
        coefficients = np.zeros(self.parameters)
        sizes = np.ones(self.parameters) if self.sizes is None else self.sizes
        for name, factor in factors.items():
            require(
                name in self.names,
                f"criterion {self.criterion} takes the parameter {quoted(name)}, which the model "
                f"lacks or no pose shows{did_you_mean(name, self.names)}; there are "
                f"{listed(self.names)}",
            )
            i = self.names.index(name)
            coefficients[i] = factor * sizes[i]
        return coefficients

    def _given(self, array: Array | None, what: str, shape: tuple[int | None, ...]) -> Array:
        """`array` where it is there, of this shape (None: any positive length) and finite."""
        name = self.criterion
        if array is None:
            raise InputError(f"criterion {name} needs {what}: add to [design], or choose another")
        found = np.asarray(array, dtype=float)
        fits = found.ndim == len(shape) and all(
            n > 0 if wanted is None else n == wanted
            for n, wanted in zip(found.shape, shape, strict=True)
        )
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        require(
            fits, f"criterion {name}: an array of shape {found.shape} was given, not ({wanted})"
        )
        require(
            bool(np.isfinite(found).all()),
            f"criterion {name}: {what} with derivatives that are not finite; check that every test "
            "pose is within reach and has a static equilibrium",
        )
        return found


class ScenarioCriterion(ABC):
    """Φ(V) of degree 1 in the covariance V (p, p), to be minimised, for one arm.

    `name` is how cell files and plans call it, `title` what it is in a few words, `unit` that of
    the figure a user knows (see `figure`), and `better` which figure is the better one.
    `needs`: what is worked out for it from the cell.  `certifiable`: 1/Φ is concave in M = V⁻¹ and
    `curvature` is stated; otherwise plans come by exchange and polish alone, and `without_bound`
    completes "criterion NAME …".
    """

    name: str
    title: str = ""
    unit: str = ""
    better: Literal["smaller", "larger"] = "smaller"
    needs: ClassVar[tuple[Need, ...]] = ()
    certifiable: bool = False
    without_bound: str = "states no curvature"
    kinked: bool = False

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        """The criterion for this cell and model; InputError where something it needs is missing."""
        raise NotImplementedError(f"{cls.__name__} does not say how it is made from a cell")

    @abstractmethod
    def value(self, V: Array) -> Array:
        """Φ (...,) of V (..., p, p)."""

    @abstractmethod
    def slope(self, V: Array) -> tuple[float, Array]:
        """Φ and C = ∂Φ/∂V (p, p), symmetric, at V (p, p); one of several at a kink."""

    def curvature(self, V: Array, X: Array) -> Array | float:
        """D²Φ[X_i, X_j] (k, k) for directions X (k, p, p) of V; 0 where Φ is linear in V."""
        return 0.0

    @abstractmethod
    def figure(self, value: float) -> float:
        """The figure a user knows, from Φ."""

    def reported(self, value: float) -> tuple[float, str]:
        """The figure a user knows, from Φ, and its unit."""
        return self.figure(value), self.unit

    def of_information(self, M: Array) -> Array:
        """Φ (...,) of M (..., p, p); inf where M is singular."""
        V, ok = covariance(M)
        V = np.where(ok[..., None, None], V, np.eye(M.shape[-1]))
        return np.where(ok, self.value(V), np.inf)

    def tangent_at(self, V: Array) -> TangentBound:
        """The tangent of 1/Φ at V (p, p)."""
        value, C = self.tangent(V)
        return TangentBound(value, V @ C @ V)

    def turned(self, T: Array) -> ScenarioCriterion:
        """The same criterion of the parameters z, y = T z, T (p, k)."""
        return Turned(self, T)

    def softened(self, q: float) -> ScenarioCriterion:
        """A smooth criterion nowhere above this one, towards which it grows with q: kinks (a
        largest eigenvalue or pose) become power means.  Without kinks it is its own."""
        return self

    def tangent(self, V: Array) -> tuple[float, Array]:
        """L and C with L = ⟨C, V⟩ and ⟨C, V'⟩ or Φ(V') of concave reciprocal below Φ everywhere;
        at a kink of weights that sum to 1, so that it is as near Φ as can be."""
        return self.slope(V)


@dataclass(frozen=True)
class Turned(ScenarioCriterion):
    """Φ(T V Tᵀ): `base` of the parameters y = T z, as a function of the covariance V of z."""

    base: ScenarioCriterion
    T: Array

    def __post_init__(self) -> None:
        for what in ("name", "title", "unit", "better", "certifiable", "without_bound", "kinked"):
            object.__setattr__(self, what, getattr(self.base, what))

    def value(self, V: Array) -> Array:
        return self.base.value(self.T @ V @ self.T.T)

    def slope(self, V: Array) -> tuple[float, Array]:
        value, C = self.base.slope(self.T @ V @ self.T.T)
        return value, self.T.T @ C @ self.T

    def curvature(self, V: Array, X: Array) -> Array | float:
        return self.base.curvature(self.T @ V @ self.T.T, self.T @ X @ self.T.T)

    def figure(self, value: float) -> float:
        return self.base.figure(value)

    def turned(self, T: Array) -> Turned:
        return Turned(self.base, self.T @ T)

    def softened(self, q: float) -> Turned:
        return Turned(self.base.softened(q), self.T)

    def tangent(self, V: Array) -> tuple[float, Array]:
        value, C = self.base.tangent(self.T @ V @ self.T.T)
        return value, self.T.T @ C @ self.T


# Variances of linear functions of the parameters.


@dataclass(frozen=True)
class TraceCriterion(ScenarioCriterion):
    """Φ = tr(F V Fᵀ), L-optimality: the summed variance of the linear functions F (q, p) of y.

    Nuisance parameters are marginalised by their columns of F being zero.  `figure` is `scale` · √Φ
    in `unit`.  1/Φ is concave for any F.  Raises InputError where F is zero or not finite.
    Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (L- or linear optimality).
    """

    F: Array
    name = "L"
    scale = 1.0
    certifiable = True

    def __post_init__(self) -> None:
        F = self.F
        require(F.ndim == 2, f"F of the {self.name} criterion has shape {F.shape}; give (q, p)")
        require(
            bool(np.isfinite(F).all() and F.any()),
            f"F of the {self.name} criterion is zero or not finite: no target depends on the "
            "parameters; check the test poses, loads and parameters of interest",
        )

    @cached_property
    def C(self) -> Array:
        """FᵀF (p, p)."""
        return np.asarray(self.F.T @ self.F)

    def value(self, V: Array) -> Array:
        return np.asarray(((self.F @ V) * self.F).sum(axis=(-1, -2)))

    def slope(self, V: Array) -> tuple[float, Array]:
        return float(self.value(V)), self.C

    def turned(self, T: Array) -> ScenarioCriterion:
        if type(self).value is not TraceCriterion.value:
            return Turned(self, T)
        F = self.F @ T
        return replace(self, F=triangular(F))

    def figure(self, value: float) -> float:
        return self.scale * float(np.sqrt(value))


# Eigenvalues of the covariance of the parameters of interest.


@dataclass(frozen=True)
class SpectralCriterion(ScenarioCriterion):
    """Φ = φ(λ_1, …, λ_k), λ the eigenvalues of E V Eᵀ in ascending order, E (k, p).

    E picks the parameters of interest, so that all others are marginalised.  1/√λ_i are the
    singular values of the stacked, scaled and whitened regressor after projecting the nuisance
    columns out: those of the observability indices.
    """

    E: Array

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.counted())

    @abstractmethod
    def phi(self, lam: Array) -> Array:
        """φ (...,) of eigenvalues λ > 0 (..., k) in ascending order."""

    @abstractmethod
    def phi_slope(self, lam: Array) -> Array:
        """∂φ/∂λ_i (k,) at λ (k,)."""

    def phi_curvature(self, lam: Array) -> Array:
        """∂²φ/∂λ_i∂λ_j (k, k) at λ (k,)."""
        raise NotImplementedError

    def value(self, V: Array) -> Array:
        lam: Array = np.asarray(np.linalg.eigvalsh(self.E @ V @ self.E.T), dtype=np.float64)
        return np.asarray(self.phi(_positive(lam)))

    def slope(self, V: Array) -> tuple[float, Array]:
        lam, U = self._eigen(V)
        return float(self.phi(lam)), (U * self.phi_slope(lam)) @ U.T

    def curvature(self, V: Array, X: Array) -> Array | float:
        """In the eigenbasis: Σ h_ab X_aa X_bb + Σ_{a≠b} (g_a − g_b)/(λ_a − λ_b) X_ab², g and h the
        derivatives of φ (Daleckii & Krein)."""
        lam, U = self._eigen(V)
        Y = U.T @ X @ U
        g, h = self.phi_slope(lam), self.phi_curvature(lam)
        gap = np.subtract.outer(lam, lam)
        same = np.abs(gap) < 1e-7 * np.add.outer(lam, lam)
        equal = np.diag(h)[:, None] - h  # the limit of the quotient for equal eigenvalues
        mixed = np.where(same, equal, np.subtract.outer(g, g) / np.where(same, 1.0, gap))
        np.fill_diagonal(mixed, 0.0)
        along = np.einsum("kii->ki", Y)
        flat = Y.reshape(len(Y), -1)
        return np.asarray(along @ h @ along.T + (flat * mixed.ravel()) @ flat.T)

    def _eigen(self, V: Array) -> tuple[Array, Array]:
        lam, U = np.linalg.eigh(self.E @ V @ self.E.T)
        return _positive(lam), self.E.T @ U

    def turned(self, T: Array) -> ScenarioCriterion:
        return replace(self, E=self.E @ T)


def _positive(lam: Array) -> Array:
    """Eigenvalues lost in rounding beside the largest one, kept above zero."""
    return np.asarray(np.maximum(lam, np.finfo(float).eps * lam[..., -1:]), dtype=np.float64)


@dataclass(frozen=True)
class MeanCriterion(SpectralCriterion):
    """Φ the mean of the λ of order q (Kiefer's matrix means): D at 0, O5 at ½, A at 1, E at inf.

    Source: Kiefer 1974, Annals of Statistics 2, 849–879; Pukelsheim 2006, ch. 6.
    """

    order: float = 1.0
    certifiable = True

    def phi(self, lam: Array) -> Array:
        return power_mean(lam, self.order)

    def phi_slope(self, lam: Array) -> Array:
        return mean_slope(lam, self.order)

    def phi_curvature(self, lam: Array) -> Array:
        return mean_curvature(lam, self.order)
