"""What a planning criterion is: Φ of the information, its gains for exchange, its convex form.

A criterion is a convex function Φ(M), homogeneous of degree −1, of the information matrix M of a
plan.  One class states all that is known of it: name and unit, what it takes from the cell, its
value and gradient, and what the two solvers of the relaxation need for its bound.  `criteria`
lists those that there are and takes those of a user.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError, InsufficientDataError, require
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, IntArray

# Linear algebra on many information matrices at once, and what one more pose changes in them.

# Matrices (..., S, p, p) that a batched evaluation holds at once, as numbers.
BATCH_NUMBERS = 2_000_000
# Numbers of a chunk of candidates, small enough for the cache of one core.
CHUNK_NUMBERS = 100_000
# tr(H⁻¹) of M scaled to unit diagonal, above which M is singular to rounding: a matrix of rank
# p − 1 formed in double precision shows 1/(p ε) ≈ 10¹⁴ or more.
SINGULAR = 1e13
# tr(H⁻¹) of M (see `factorise`) up to which the determinants of an update keep it.
WELL_CONDITIONED = 1e7
# Relative accuracy that an update of Φ must keep; otherwise Φ is formed anew.
ACCURACY = 1e-10


def candidate_sums(M: Array, blocks: Array) -> Iterator[tuple[slice, Array]]:
    """M_s + B_siᵀ B_si (n, S, p, p) for slices of candidates that fit into memory.

    M (S, p, p), blocks (S, N, r, p).
    """
    scenarios, n, _, p = blocks.shape
    size = max(BATCH_NUMBERS // (scenarios * p * p), 1)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        yield part, M + (B.swapaxes(-1, -2) @ B).swapaxes(0, 1)


@dataclass(frozen=True)
class InformationFactor:
    """M = L Lᵀ with L (..., p, p) lower triangular; `regular` (...) where M is positive definite.

    Elsewhere L is the identity, so that no NaN spreads and no solver raises.
    """

    L: Array
    inverse: Array
    condition: Array

    @cached_property
    def regular(self) -> NDArray[np.bool_]:
        return self.condition < SINGULAR

    def require_regular(self) -> None:
        """Raise InsufficientDataError where M (S, p, p) of some scenario is singular."""
        singular = np.flatnonzero(~self.regular)
        if len(singular):
            raise InsufficientDataError(
                f"the information matrix of scenario {singular[0] + 1} of {len(self.regular)} is "
                "singular: the weighted poses leave a combination of parameters unseen; weight "
                "more candidates, ask for more poses or add prior information"
            )


def factorise(M: Array) -> InformationFactor:
    """The factor of symmetric M (..., p, p).

    `condition` is tr(H⁻¹), the sum of the variance inflation factors, H being M scaled to unit
    diagonal; it does not depend on the units of the parameters; inf where M is not positive
    definite.
    """
    definite = np.ones(M.shape[:-2], dtype=bool)
    try:
        L = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        L, definite = _one_by_one(M)
    inverse = np.asarray(np.linalg.inv(L))
    inflation = np.einsum("...ij,...jj->...", inverse**2, M)
    condition = np.where(definite, inflation, np.inf)
    return InformationFactor(np.asarray(L), inverse, condition)


def _one_by_one(M: Array) -> tuple[Array, NDArray[np.bool_]]:
    """numpy refuses a whole stack for one bad matrix; LAPACK itself says which one it is."""
    from scipy.linalg.lapack import dpotrf

    p = M.shape[-1]
    L = np.tile(np.eye(p), (*M.shape[:-2], 1, 1))
    definite = np.zeros(M.shape[:-2], dtype=bool)
    for index in np.ndindex(*M.shape[:-2]):
        lower, info = dpotrf(M[index], lower=1, clean=1)
        if info == 0:
            L[index], definite[index] = lower, True
    return L, definite


def trustworthy(factor: InformationFactor) -> bool:
    """Whether M is regular enough for its inverse to be updated rather than formed anew."""
    return bool((factor.condition < WELL_CONDITIONED).all())


def doubtful(before: Array, after: Array, condition: Array) -> Array:
    """Whether so much of Φ is taken away that the difference has lost its digits.

    `after` = before − removed, where both are known to about ε · `condition` relative to
    `before` (measured: a third of it at most).
    """
    return np.asarray(after * ACCURACY < before * condition * np.finfo(float).eps / 3)


def whitened_rows(factor: InformationFactor, blocks: Array) -> Iterator[tuple[slice, Array, Array]]:
    """W = B L⁻ᵀ (S, n, r, p) for slices of candidates, and I + W Wᵀ (S, n, r, r).

    With M = L Lᵀ: (M + BᵀB)⁻¹ = L⁻ᵀ [I − Wᵀ (I + W Wᵀ)⁻¹ W] L⁻¹ (Woodbury) and
    det(M + BᵀB) = det(M) det(I + W Wᵀ) (matrix determinant lemma).
    """
    scenarios, n, r, p = blocks.shape
    size = max(CHUNK_NUMBERS // (scenarios * r * p), 1)
    upper = factor.inverse.swapaxes(-1, -2)
    for start in range(0, n, size):
        part = slice(start, start + size)
        B = blocks[:, part]
        W = (B.reshape(scenarios, -1, p) @ upper).reshape(B.shape)
        yield part, W, np.eye(r) + W @ W.swapaxes(-1, -2)


@dataclass(frozen=True)
class Interest:
    """The parameters `interest` (k,) of p; all others are nuisance, estimated but not counted.

    Raises InputError for an empty, repeated or negative choice.
    """

    interest: IntArray

    def __post_init__(self) -> None:
        chosen = np.asarray(self.interest)
        require(
            chosen.ndim == 1 and len(chosen) > 0,
            "no parameter of interest is left: every parameter counts as nuisance; name "
            "parameters or effects in [design] interest",
        )
        require(
            len(np.unique(chosen)) == len(chosen) and int(chosen.min()) >= 0,
            f"parameters of interest are repeated or negative: {chosen.tolist()}",
        )

    @cached_property
    def count(self) -> int:
        return len(self.interest)

    @cached_property
    def _orders(self) -> dict[int, IntArray]:
        """What `ordered` gave before: a search asks for the same at every exchange."""
        return {}

    def ordered(self, parameters: int) -> IntArray:
        """Indices (p,) of nuisance parameters first, then `interest`."""
        if parameters in self._orders:
            return self._orders[parameters]
        require(
            int(np.max(self.interest)) < parameters,
            f"parameter of interest {int(np.max(self.interest))} does not exist: there are "
            f"{parameters}",
        )
        nuisance = np.setdiff1d(np.arange(parameters), self.interest)
        return self._orders.setdefault(parameters, np.concatenate([nuisance, self.interest]))

    def factor(self, M: Array) -> InformationFactor:
        """L L' = M in that order; its last k rows and columns give those of M_I."""
        order = self.ordered(M.shape[-1])
        return factorise(M[..., order[:, None], order])

    def information(self, factor: InformationFactor) -> Array:
        """M_I = (V_II)⁻¹ = M_II − M_IN M_NN⁻¹ M_NI (..., k, k): the Schur complement L_II L_IIᵀ."""
        L = factor.L[..., -self.count :, -self.count :]
        return np.asarray(L @ L.swapaxes(-1, -2))

    def projection(self, factor: InformationFactor) -> Array:
        """E (..., k, p), columns in M's own order, with M_I = E M Eᵀ and ∂M_I = E ∂M Eᵀ.

        E = L_II (last k rows of L⁻¹) = [−M_IN M_NN⁻¹, 1].
        """
        k = self.count
        E = np.empty((*factor.L.shape[:-2], k, factor.L.shape[-1]))
        E[..., self.ordered(E.shape[-1])] = factor.L[..., -k:, -k:] @ factor.inverse[..., -k:, :]
        return E


@dataclass(frozen=True)
class Variances:
    """φ_st = tr(F_st M_s⁻¹ F_stᵀ), the summed variance of F_st x̂ under scenario s.

    F (S, T, q, p): T groups of q linear functions of the p parameters.
    """

    F: Array

    def of(self, M: Array) -> Array:
        """φ (..., S, T) at M (..., S, p, p); inf where M_s is singular."""
        factor = factorise(M)
        return np.where(factor.regular[..., None], self._grouped(self._roots(factor)), np.inf)

    def with_gains(self, M: Array) -> tuple[Array, Array]:
        """φ (S, T), and V_s F_sᵀ (S, p, T, q) whose products are the −∂φ/∂M; M (S, p, p).

        Raises InsufficientDataError where M_s is singular.
        """
        factor, Z = self._at(M)
        factor.require_regular()
        gains = factor.inverse.swapaxes(-1, -2) @ Z
        return self._grouped(Z), gains.reshape(self._columns.shape[:2] + self.F.shape[1:3])

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """φ (N, S, T) at M_s + B_siᵀ B_si; M (S, p, p), blocks (S, N, r, p)."""
        factor, Z = self._at(M)
        n = blocks.shape[1]
        if not trustworthy(factor):
            return self._anew(M, blocks)
        before = self._grouped(Z)
        values = np.empty((n, *before.shape))
        for part, W, K in whitened_rows(factor, blocks):
            values[part] = before - self._removed(W, K, Z).swapaxes(0, 1)
        condition = factor.condition[:, None]
        unsure = np.flatnonzero(doubtful(before, values, condition).any(axis=(1, 2)))
        values[unsure] = self._anew(M, blocks[:, unsure])
        return values

    @cached_property
    def _columns(self) -> Array:
        """F_sᵀ (S, p, T q)."""
        S, T, q, p = self.F.shape
        return np.ascontiguousarray(self.F.reshape(S, T * q, p).swapaxes(-1, -2))

    @cached_property
    def _last(self) -> list[tuple[Array, InformationFactor, Array]]:
        return []

    def _at(self, M: Array) -> tuple[InformationFactor, Array]:
        """The factor of M, and Z; an exchange asks for slope and values at the same M."""
        if not self._last or self._last[0][0] is not M:
            factor = factorise(M)
            self._last[:] = [(M, factor, self._roots(factor))]
        return self._last[0][1:]

    def _roots(self, factor: InformationFactor) -> Array:
        """Z = L⁻¹ Fᵀ (..., S, p, T q), whose squares sum to φ."""
        return np.asarray(factor.inverse @ self._columns)

    def _grouped(self, Z: Array) -> Array:
        squares = (Z**2).sum(axis=-2)
        return np.asarray(squares.reshape(*squares.shape[:-1], *self.F.shape[1:3]).sum(axis=-1))

    def _removed(self, W: Array, K: Array, Z: Array) -> Array:
        """tr(Zᵀ Wᵀ K⁻¹ W Z) (S, n, T) by group, the variance that a pose takes away."""
        S, n, r, p = W.shape
        T, q = self.F.shape[1:3]
        X = (W.reshape(S, n * r, p) @ Z).reshape(S, n, r, T * q)
        if T == 1 and q > r:
            solved = np.linalg.solve(K, X @ X.swapaxes(-1, -2))
            return np.asarray(np.trace(solved, axis1=-2, axis2=-1)[..., None])
        products = (X * np.linalg.solve(K, X)).sum(axis=-2)
        return np.asarray(products.reshape(S, n, T, q).sum(axis=-1))

    def _anew(self, M: Array, blocks: Array) -> Array:
        values = np.empty((blocks.shape[1], *self.F.shape[:2]))
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.of(sums)
        return values


# What a criterion is, and what the relaxation needs of it.

Robust = Literal["none", "average", "worst"]
Need = Literal["test_poses", "combination", "doubts"]


@dataclass(frozen=True)
class Gradient:
    """Φ and −∂Φ/∂M = G (S, p, p), symmetric, so that ∂Φ/∂w_i = −Σ_s tr(B_si G_s B_siᵀ)."""

    value: float
    G: Array


@dataclass(frozen=True)
class CriterionInputs:
    """What cell and model give a criterion: p scaled parameters y, x_i = `sizes`_i · y_i.

    `criterion`: the name asked for.  `interest` (k,): indices of the parameters that count, the
    others are nuisance.  `scenarios` S of the arm.  A (S, T, r, p) = ∂(position at target t)/∂y in
    m, with `weights` (T,); `combination` (p,) of y with its `unit`; `n_poses` of the plan;
    `names` (p,) and `sizes` (p,) in SI units, where a criterion asks for parameters by name.
    """

    criterion: str
    parameters: int
    interest: IntArray
    scenarios: int = 1
    A: Array | None = None
    weights: Array | None = None
    combination: Array | None = None
    unit: str = ""
    n_poses: int | None = None
    names: tuple[str, ...] = ()
    sizes: Array | None = None

    def counted(self) -> IntArray:
        """`interest` (k,) as it was given; InputError for an empty or unknown one."""
        return Interest(self.interest).ordered(self.parameters)[-len(self.interest) :]

    def targets(self) -> Array:
        """A (S, T, r, p); InputError where there is none."""
        return self._given(self.A, "test poses", (self.scenarios, None, None, self.parameters))

    def target_weights(self) -> Array:
        """Weights (T,) of the test poses, equal where none are stated; InputError for others."""
        shape = self.targets().shape[1:2]
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


class Criterion(ABC):
    """Φ(M), to be minimised, M (S, p, p): information under each of S scenarios of the arm.

    Φ is decreasing in M and homogeneous of degree −1, Φ(cM) = Φ(M)/c, and where `certifiable`
    1/Φ is concave (Pukelsheim 2006, ch. 5).  Then for weights w and any plan w' with the same
    shares, gap = max_w' Σ (w'_i − w_i) d_i gives Φ(w') ≥ Φ(w) / (1 + gap/Φ(w)).  Without prior
    information this is Φ²/Σ_l n_l max_{i∈l} d_i.

    `name` is how cell files and plans call it, `title` what it is in a few words, `unit` that of
    the figure a user knows (see `reported`), and `better` which figure is the better one.
    `needs`: what is worked out for it from the cell.
    `certifiable`: 1/Φ is concave and `term` or `cone` states it for the relaxation; otherwise
    plans come by exchange alone, and `without_bound` completes "criterion NAME …".
    """

    name: str
    title: str = ""
    unit: str = ""
    better: Literal["smaller", "larger"] = "smaller"
    needs: ClassVar[tuple[Need, ...]] = ()
    certifiable: bool = False
    without_bound: str = "states no relaxation"

    @abstractmethod
    def value(self, M: Array) -> Array:
        """Φ (...,) of M (..., S, p, p); inf where M is singular."""

    @abstractmethod
    def gradient(self, M: Array) -> Gradient:
        """Φ and G at M (S, p, p); a subgradient where Φ has a kink."""

    def after_adding(self, M: Array, blocks: Array) -> Array:
        """Φ (N,) at M_s + B_siᵀ B_si for each i; M (S, p, p), blocks (S, N, r, p)."""
        values = np.empty(blocks.shape[1])
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.value(sums)
        return values

    def softened(self, order: float) -> Criterion:
        """A smooth criterion nowhere above this one, towards which it grows with `order`.

        Kinks (a largest eigenvalue, pose or scenario) become power means; a criterion without
        any is its own.  A lower bound on the softened criterion is one on this.
        """
        return self

    def turned(self, T: Array) -> Criterion | None:
        """The same criterion of the parameters z, y = T_s z, T (S, p, p); None where that would
        be another."""
        return None

    def reported(self, value: float) -> tuple[float, str]:
        """The figure a user knows and its unit, from Φ: ρ₀ in µm, log det, an index."""
        return self.figure(value), self.unit

    @abstractmethod
    def figure(self, value: float) -> float:
        """The figure a user knows, from Φ."""


class ScenarioCriterion(Criterion):
    """Φ = (1/S) Σ_s Φ_s(M_s): the expectation over equally likely scenarios of the true arm.

    A nonlinear model's B depends on the parameters that are still to be found; the scenarios are
    draws from what is known of them (Atkinson, Donev & Tobias 2007, ch. 18).  1/Φ is the harmonic
    mean of the concave 1/Φ_s over S and hence concave.  With S = 1 this is Φ_1 itself.
    """

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        """The criterion for this cell and model; InputError where something it needs is missing."""
        raise NotImplementedError(f"{cls.__name__} does not say how it is made from a cell")

    @abstractmethod
    def each(self, M: Array) -> Array:
        """Φ_s (..., S) of M (..., S, p, p); inf where M_s is singular."""

    @abstractmethod
    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        """Φ_s (S,) and −∂Φ_s/∂M_s (S, p, p) at M (S, p, p).

        Raises InsufficientDataError where M_s is singular.
        """

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        """Φ_s (N, S) at M_s + B_siᵀ B_si; M (S, p, p), blocks (S, N, r, p)."""
        values = np.empty((blocks.shape[1], len(M)))
        for part, sums in candidate_sums(M, blocks):
            values[part] = self.each(sums)
        return values

    def term(self, s: int) -> Term | None:
        """Φ_s as a smooth function of V_s = M_s⁻¹, or as the largest of several.

        None where it has no such form; then the relaxation takes `cone`.
        """
        return None

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        """Φ_s/`unit` as a conic program for the expression M (p, p) of root·M_s·rootᵀ.

        `cp` is cvxpy.  Raises InputError where the criterion has no such form.
        """
        raise InputError(f"criterion {self.name} has no conic form here: choose another method")

    def value(self, M: Array) -> Array:
        return np.asarray(self.each(M).mean(axis=-1))

    def gradient(self, M: Array) -> Gradient:
        values, G = self.each_gradient(M)
        return Gradient(float(values.mean()), G / len(values))

    def after_adding(self, M: Array, blocks: Array) -> Array:
        return np.asarray(self.each_after_adding(M, blocks).mean(axis=-1))

    def softened(self, order: float) -> ScenarioCriterion:
        return self


@dataclass(frozen=True)
class Worst(Criterion):
    """Φ = max_s Φ_s(M_s): the least favourable scenario of the true arm (maximin design).

    1/Φ = min_s 1/Φ_s is concave.  A finite `order` q gives the power mean
    (Σ_s Φ_s^q / S)^{1/q} ≤ Φ, smooth and with concave 1/Φ as well.  Units as of `base`.
    Source: Pronzato & Walter 1988; Atkinson, Donev & Tobias 2007, ch. 17 and 18.
    """

    base: ScenarioCriterion
    order: float = np.inf

    def __post_init__(self) -> None:
        for what in ("name", "title", "unit", "better", "certifiable", "without_bound"):
            object.__setattr__(self, what, getattr(self.base, what))

    def value(self, M: Array) -> Array:
        return power_mean(self.base.each(M), self.order)

    def gradient(self, M: Array) -> Gradient:
        values, G = self.base.each_gradient(M)
        slope = power_mean_slope(values, self.order)
        return Gradient(float(power_mean(values, self.order)), slope[:, None, None] * G)

    def after_adding(self, M: Array, blocks: Array) -> Array:
        return power_mean(self.base.each_after_adding(M, blocks), self.order)

    def turned(self, T: Array) -> Worst | None:
        base = self.base.turned(T)
        return Worst(base, self.order) if isinstance(base, ScenarioCriterion) else None

    def softened(self, order: float) -> Worst:
        return Worst(self.base.softened(order), order)

    def figure(self, value: float) -> float:
        return self.base.figure(value)


def power_mean(x: Array, order: float) -> Array:
    """(Σ_i x_i^q / n)^{1/q} (...,) of positive x (..., n), q = `order` ≥ 1; max_i x_i for q = inf.

    It lies between n^{−1/q} max x and max x.  Of degree 1, and for 1/x_i concave in M so is its
    reciprocal, a power mean of exponent −q of the 1/x_i (Hardy, Littlewood & Pólya 1934, ch. 2).
    """
    largest = x.max(axis=-1)
    if order == np.inf:
        return np.asarray(largest)
    # Relative to the largest, no power overflows; where that is inf the mean is inf too.
    scale = np.where(np.isfinite(largest), largest, 1.0)
    ratio = np.minimum(x / scale[..., None], 1.0)
    return np.asarray(largest * (ratio**order).mean(axis=-1) ** (1 / order))


def power_mean_slope(x: Array, order: float) -> Array:
    """∂ mean/∂x_i (..., n); for q = inf the subgradient of the first largest x_i."""
    n = x.shape[-1]
    if order == np.inf:
        return np.asarray(np.arange(n) == x.argmax(axis=-1)[..., None], dtype=float)
    return np.asarray((x / power_mean(x, order)[..., None]) ** (order - 1) / n)


class Term(ABC):
    """One or more smooth increasing functions φ_t, t = 1 … T, of the covariance V = M⁻¹ (p, p).

    Through V they are criteria of M: with C = ∂φ/∂V and A, A' two directions of M,

        ∂φ = −tr(G A),  G = V C V,        ∂²φ = 2 tr(A V A' G) + D²φ[V A V, V A' V],

    so a term only states its value, C and the curvature D²φ that it has as a function of V.
    """

    count: int = 1

    @abstractmethod
    def slope(self, V: Array) -> tuple[Array, Array]:
        """φ (T,) and C (T, p, p)."""

    @abstractmethod
    def curvature(self, V: Array, X: Array) -> Array | None:
        """D²φ[X_i, X_j] (k, k) of directions X (k, p, p) of V; None if φ is linear."""


@dataclass(frozen=True)
class TraceTerm(Term):
    """φ_t = tr(C_t V), C (T, p, p): test poses, A, c, I; several of them for G."""

    C: Array

    @property
    def count(self) -> int:  # type: ignore[override]
        return len(self.C)

    def slope(self, V: Array) -> tuple[Array, Array]:
        return np.einsum("tij,ij->t", self.C, V), self.C

    def curvature(self, V: Array, X: Array) -> None:
        return None


@dataclass(frozen=True)
class SpectralTerm(Term):
    """A function of the eigenvalues λ of V_II, I = `interest` (m,)."""

    interest: IntArray

    def slope(self, V: Array) -> tuple[Array, Array]:
        eigenvalues, U = np.linalg.eigh(V[np.ix_(self.interest, self.interest)])
        value, first = self._slope(eigenvalues)
        C = np.zeros((1, *V.shape))
        C[0][np.ix_(self.interest, self.interest)] = (U * first) @ U.T
        return np.array([value]), C

    def curvature(self, V: Array, X: Array) -> Array:
        eigenvalues, U = np.linalg.eigh(V[np.ix_(self.interest, self.interest)])
        turned = U.T @ X[:, self.interest[:, None], self.interest] @ U
        outer, mixed, factor = self._curvature(eigenvalues)
        along = np.einsum("kii,i->k", turned, outer)
        flat = turned.reshape(len(X), -1)
        return np.asarray(factor * np.outer(along, along) + (flat * mixed.ravel()) @ flat.T)

    @abstractmethod
    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        """φ and ∂φ/∂λ (m,)."""

    @abstractmethod
    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        """h (m,), K (m, m), f of D²φ[X, Y] = f ⟨h, diag X⟩⟨h, diag Y⟩ + Σ K_ab X_ab Y_ab
        in the eigenbasis of V_II (Daleckii–Krein)."""


@dataclass(frozen=True)
class Cone:
    """Φ_s in units of its first value, as a cvxpy expression, and the constraints behind it.

    `tangent` gives, at M (p, p) of the solution, v and G (p, p) by its multipliers with
    Φ_s(M') ≥ v²/⟨G, M'⟩ for all M'; None where Φ_s is smooth and its own gradient does.
    """

    value: Any
    constraints: list[Any]
    tangent: Callable[[Array], tuple[float, Array]] | None = None
