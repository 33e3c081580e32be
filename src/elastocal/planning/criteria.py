"""Planning criteria: functions Φ of the covariance V = M⁻¹ of a plan's parameters.

A criterion states its value, its slope C = ∂Φ/∂V and, where it has a bound, its curvature.  Through
V they are those of the information M: with A, A' two directions of M and G = V C V,

    ∂Φ = −⟨G, A⟩,        ∂²Φ = 2 tr(A V A' G) + D²Φ[V A V, V A' V]

Φ is of degree 1 in V, and where it is `certifiable` 1/Φ is concave in M (Pukelsheim 2006, ch. 5),
so that its tangent lies above it: 1/Φ(M') ≤ ⟨G, M'⟩/Φ² for every M'.  That one inequality prices
candidates, prunes them, orders exchanges and bounds every plan.  `CRITERIA` has one class each.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, Self, TypeVar

import numpy as np

from elastocal.cell_tables import TEST_POSE
from elastocal.files import same_class
from elastocal.messages import InputError, check_known, is_label, listed, quoted, require, rounded
from elastocal.units import Array, BoolArray, IntArray

Need = Literal["test_poses", "combination"]

# tr(H⁻¹) of M scaled to unit diagonal, H, above which M is singular to rounding: a matrix of rank
# p − 1 formed in double precision shows 1/(p ε) ≈ 10¹⁴ or more.
SINGULAR = 1e13


def covariance(M: Array) -> tuple[Array, BoolArray]:
    """V = M⁻¹ (..., p, p) of symmetric M, and where M is regular (...)."""
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
    its reciprocal (Hardy, Littlewood & Pólya 1934, ch. 2)."""
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
    g = mean_slope(x, q)
    return np.asarray((q - 1) * (np.diag(g / x) - np.outer(g, g) / power_mean(x, q)))


def triangular(F: Array) -> Array:
    """R (..., r, p), r ≤ p, with RᵀR = FᵀF, F (..., q, p)."""
    R = np.linalg.qr(F, mode="r") if F.shape[-2] > F.shape[-1] else F
    return np.asarray(R, dtype=np.float64)


def root(A: Array, weight: Array) -> Array:
    """R (r, p) with RᵀR = Σ_t w_t A_tᵀ A_t, A (T, r, p)."""
    return triangular((np.sqrt(weight)[:, None, None] * A).reshape(-1, A.shape[-1]))


@dataclass(frozen=True)
class TangentBound:
    """Φ(M') ≥ `value`²/⟨G, M'⟩ for every M' (p, p), of a certifiable criterion; G (p, p)."""

    value: float
    G: Array

    def bound(self, prior: Array, reach: float) -> float:
        """On Φ wherever ⟨G, M'⟩ is at most `reach` more than ⟨G, prior⟩."""
        return self.value**2 / (float((self.G * prior).sum()) + reach)


@dataclass(frozen=True)
class CriterionInputs:
    """What cell and model give a criterion: p scaled parameters y, x_i = `sizes`_i · y_i.  What is
    asked for and missing is an InputError.

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
    n_poses: int = 1
    names: tuple[str, ...] = ()
    sizes: Array | None = None

    def counted(self) -> Array:
        """E (k, p), which picks the parameters of interest."""
        return np.eye(self.parameters)[self.interest]

    def targets(self) -> Array:
        return self._given(self.A, "test poses")

    def target_weights(self) -> Array:
        """Weights (T,) of the test poses, equal where none are stated."""
        return np.ones(len(self.targets())) if self.weights is None else self.weights

    def stated_combination(self) -> Array:
        """`[design] combination` as coefficients (p,) of y."""
        return self._given(self.combination, "a parameter or combination")

    def row(self, factors: Mapping[str, float]) -> Array:
        """Coefficients (p,) of y for Σ factor · x over parameters by name, in SI units."""
        coefficients = np.zeros(self.parameters)
        sizes = np.ones(self.parameters) if self.sizes is None else self.sizes
        for name, factor in factors.items():
            told = f"criterion {self.criterion} takes the parameter {quoted(name)}, which the model"
            check_known(name, self.names, f"{told} lacks or no pose shows")
            i = self.names.index(name)
            coefficients[i] = factor * sizes[i]
        return coefficients

    def _given(self, array: Array | None, what: str) -> Array:
        need = f"criterion {self.criterion} needs {what}: add to [design], or choose another"
        require(array is not None, need)
        return np.asarray(array)


class ScenarioCriterion(ABC):
    """Φ(V) of degree 1 in the covariance V (p, p), to be minimised, for one arm.

    `name` is how cell files and plans call it, `title` what it is in a few words, `unit` that of
    the figure a user knows (see `figure`), and `better` which figure is the better one.
    `needs`: what is worked out for it from the cell.  `certifiable`: 1/Φ is concave in M = V⁻¹ and
    `curvature` is stated; otherwise plans come by exchange and polish alone, and `without_bound`
    completes "criterion NAME …".  `kinked`: Φ is the largest of many, a power mean whose field
    `order` is inf.
    """

    name: str
    title: str = ""
    unit: str = ""
    better: Literal["smaller", "larger"] = "smaller"
    scale: float = 1.0
    needs: ClassVar[tuple[Need, ...]] = ()
    certifiable: bool = False
    without_bound: str = "states no curvature"
    kinked: bool = False

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        """The criterion for this cell and model."""
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

    def figure(self, value: float) -> float:
        """The figure a user knows, from Φ: `scale` · √Φ, its reciprocal where the larger is the
        better one."""
        root = self.scale * float(np.sqrt(value))
        return 1 / root if self.better == "larger" else root

    def told(self, value: float) -> str:
        """The figure of Φ, in its unit."""
        return f"{rounded(self.figure(value), 4)} {self.unit}".rstrip()

    def of_information(self, M: Array) -> Array:
        """Φ (...,) of M (..., p, p); inf where M is singular."""
        V, ok = covariance(M)
        V = np.where(ok[..., None, None], V, np.eye(M.shape[-1]))
        return np.where(ok, self.value(V), np.inf)

    def tangent_at(self, V: Array) -> TangentBound:
        """The tangent of 1/Φ at V (p, p), or nearer to a maximum that is softened here: where its
        pieces count with weights that sum to 1."""
        (value, C), total = self.slope(V), self.weight(V)
        return TangentBound(value / total, V @ C @ V / total)

    def weight(self, V: Array) -> float:
        """Of all pieces of a softened maximum together in the slope at V (p, p)."""
        return 1.0

    def turned(self, T: Array) -> ScenarioCriterion:
        """The same criterion of the parameters z, y = T z, T (p, k)."""
        return Turned(self, T)

    def softened(self, q: float) -> ScenarioCriterion:
        """A smooth criterion nowhere above this one, towards which it grows with q: kinks (a
        largest eigenvalue or pose) become power means.  Without kinks it is its own."""
        return replace(self, order=q) if self.kinked else self  # type: ignore[type-var]


class Turned(ScenarioCriterion):
    """Φ(T V Tᵀ): `base` of the parameters y = T z, as a function of the covariance V of z."""

    def __init__(self, base: ScenarioCriterion, T: Array) -> None:
        self.base, self.T, self.name, self.unit = base, T, base.name, base.unit
        self.certifiable, self.without_bound = base.certifiable, base.without_bound

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


@dataclass(frozen=True)
class TraceCriterion(ScenarioCriterion):
    """Φ = tr(F V Fᵀ), L-optimality: the summed variance of the linear functions F (q, p) of y.

    Of several such sums, F (T, q, p), the power mean of `order` over T: smooth, and for inf the
    largest.  Nuisance parameters are marginalised by their columns of F being zero.  `figure` is
    `scale` · √Φ in `unit`.  1/Φ is concave for any F.  Raises InputError where F is zero or not
    finite. Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (L- or linear optimality).
    """

    F: Array
    name = "L"
    certifiable = True
    order = 1.0  # of a subclass's instances where that makes it a field

    def __post_init__(self) -> None:
        require(
            bool(np.isfinite(self.F).all() and self.F.any()),
            f"F of the {self.name} criterion is zero or not finite: no target depends on the "
            "parameters; check the test poses, loads and parameters of interest",
        )

    @cached_property
    def C(self) -> Array:
        return np.asarray((self.F.swapaxes(-1, -2) @ self.F).reshape(-1, self.F.shape[-1] ** 2))

    def _each(self, V: Array) -> Array:
        return np.asarray(V.reshape(*V.shape[:-2], -1) @ self.C.T)

    def value(self, V: Array) -> Array:
        return power_mean(self._each(V), self.order)

    def slope(self, V: Array) -> tuple[float, Array]:
        each = self._each(V)
        C = (mean_slope(each, self.order) @ self.C).reshape(V.shape)
        return float(power_mean(each, self.order)), C

    def curvature(self, V: Array, X: Array) -> Array | float:
        along = self._each(X)
        return np.asarray(along @ mean_curvature(self._each(V), self.order) @ along.T)

    def weight(self, V: Array) -> float:
        return float(mean_slope(self._each(V), self.order).sum())

    def turned(self, T: Array) -> ScenarioCriterion:
        if type(self).value is not TraceCriterion.value:
            return Turned(self, T)
        return replace(self, F=triangular(self.F @ T))


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
    # What is lost in rounding beside the largest one is kept above zero.
    return np.asarray(np.maximum(lam, np.finfo(float).eps * lam[..., -1:]), dtype=np.float64)


@dataclass(frozen=True)
class MeanCriterion(SpectralCriterion):
    """Φ = c · the mean of the λ of order q (Kiefer's matrix means): D at 0, O5 at ½, A at 1, E at
    inf; c = `factor`.

    Source: Kiefer 1974, Annals of Statistics 2, 849–879; Pukelsheim 2006, ch. 6.
    """

    order: float = 1.0
    factor: float = 1.0
    certifiable = True

    def phi(self, lam: Array) -> Array:
        return self.factor * power_mean(lam, self.order)

    def phi_slope(self, lam: Array) -> Array:
        return self.factor * mean_slope(lam, self.order)

    def phi_curvature(self, lam: Array) -> Array:
        return self.factor * mean_curvature(lam, self.order)


@dataclass(frozen=True)
class RemainingError(TraceCriterion):
    """Φ = ρ₀² = E‖δp₀‖² = Σ_t w_t tr(A_t cov(X̂) A_tᵀ), V = cov(X̂), in m².

    The mean square position error left at the user's test poses and loads once the arm is
    compensated by the identified parameters.  A (T, r, p) = ∂(position at test pose t)/∂X in m per
    scaled parameter, w the weights (T,) scaled to the sum 1.  `reported`: ρ₀ in µm.  It does not
    depend on the parametrisation; what no test pose shows is nuisance. Source: Klimchik, Wu,
    Pashkevich, Caro & Furet 2012, Applied Mechanics and Materials 162, 161–170.
    """

    name = TEST_POSE
    title = "position error ρ₀ that remains at the test poses after compensation, rms"
    unit = "µm"
    scale = 1e6
    needs: ClassVar[tuple[Need, ...]] = ("test_poses",)

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        A, weights = inputs.targets(), inputs.target_weights()
        return cls(root(A, weights / weights.sum()))


@dataclass(frozen=True)
class PredictionVariance(RemainingError):
    """Φ = (1/T) Σ_t tr(A_t V A_tᵀ), V = M⁻¹, in m²: `test_pose` with equal weights, the mean over a
    region's T points of the variance of what is predicted there.

    `reported`: √Φ in µm, the root mean square error of prediction.
    Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (I- and V-optimality).
    """

    name = "I"
    title = "I-optimality: mean error of prediction over the test poses, rms"

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return super().of(replace(inputs, weights=None))


@dataclass(frozen=True)
class ParameterVariance(TraceCriterion):
    """Φ = tr V_II, V = M⁻¹: the summed variance of the k scaled parameters of interest.

    `reported`: √(Φ/k), their root mean square standard deviation, in typical sizes of the
    parameters.  It depends on these sizes, unlike D and `test_pose`.
    Source: Pukelsheim 2006, ch. 6; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    scale: float = 1.0
    name = "A"
    title = "A-optimality: mean standard deviation of the parameters, rms"
    unit = "typical sizes"

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        E = inputs.counted()
        return cls(E, scale=len(E) ** -0.5)


@dataclass(frozen=True)
class CombinationVariance(TraceCriterion):
    """Φ = cᵀ V c, V = M⁻¹: the variance of c·X̂ with c from `[design] combination`.

    `reported`: its standard deviation √Φ, in the unit of the combination.
    The optimal weights often make M singular in the limit: the bound holds, and weights as close
    to the optimum as one likes remain regular.
    Source: Elfving 1952; Pukelsheim 2006, ch. 2; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    unit: str = ""
    name = "c"
    title = "c-optimality: standard deviation of one parameter or combination"
    needs = ("combination",)

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.stated_combination()[None], unit=inputs.unit)


@dataclass(frozen=True)
class GCriterion(TraceCriterion):
    """Φ = max_t tr(A_t V A_tᵀ), V = M⁻¹, in m²: the worst of a region's T points.

    F (T, r, p), the A_t, in m per scaled parameter: what is predicted at point t, as r components.
    A finite `order` q gives the power mean (Σ_t φ_t^q / T)^{1/q} ≤ Φ, smooth.  `reported`: √Φ in
    µm, the root mean square error at the worst point.
    Source: Kiefer & Wolfowitz 1960; Atkinson, Donev & Tobias 2007, ch. 9 and 10.
    """

    order: float = np.inf
    name = "G"
    title = "G-optimality: error of prediction at the worst test pose, rms"
    unit = "µm"
    scale = 1e6
    needs = ("test_poses",)
    kinked = True

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.targets())


@dataclass(frozen=True)
class DeterminantCriterion(MeanCriterion):
    """Φ = det(V_II)^{1/k}, V = M⁻¹; D_s-optimality with nuisance.

    The k-th root makes efficiencies comparable: Φ halves when every pose is measured twice.  An
    efficiency does not depend on the parametrisation of the parameters of interest.  `reported`:
    log det of the covariance V_II of the scaled parameters, without unit.
    Source: Wald 1943; Pukelsheim 2006, ch. 6 and 9; Atkinson, Donev & Tobias 2007, ch. 11.
    """

    order: float = 0.0
    name = "D"
    title = "D-optimality: volume of the confidence ellipsoid"
    unit = "log det"

    def value(self, V: Array) -> Array:
        K = self.E @ V @ self.E.T
        return np.asarray(self.factor * np.exp(np.linalg.slogdet(K)[1] / len(self.E)))

    def turned(self, T: Array) -> ScenarioCriterion:
        """E T = L Q: what L stretches is a factor, so that Q keeps the determinant's digits."""
        Q, L = np.linalg.qr((self.E @ T).T)
        stretched = np.exp(2 * np.log(np.abs(np.diag(L))).mean())
        return replace(self, E=Q.T, factor=self.factor * float(stretched))

    def figure(self, value: float) -> float:
        return len(self.E) * float(np.log(value))


@dataclass(frozen=True)
class EigenvalueCriterion(MeanCriterion):
    """Φ = λ_max(V_II), V = M⁻¹: the largest variance of any unit combination.

    A finite `order` gives the matrix mean below it, smooth where the largest eigenvalue is
    multiple, as it often is at the optimum.  `reported`: √Φ, the standard deviation of the
    worst-known direction, in typical sizes of the parameters.
    Source: Ehrenfeld 1955; Pukelsheim 2006, ch. 6; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    order: float = np.inf
    name = "E"
    title = "E-optimality: standard deviation of the worst-known direction"
    unit = "typical sizes"
    kinked = True

    def weight(self, V: Array) -> float:
        return float(self.phi_slope(self._eigen(V)[0]).sum())


@dataclass(frozen=True)
class FirstObservability(DeterminantCriterion):
    """O1 = (σ_1 ⋯ σ_k)^{1/k} / √m, to be maximised: Φ = m · 1/(m O1²) = det(V_II)^{1/k}.

    m = `n_poses`, the number of measurement configurations.  At a given number of poses O1 orders
    plans as D does.  `reported`: O1, in noise standard deviations per typical size.
    Source: Menq & Borm 1988; Borm & Menq 1991, Int. J. Robotics Research 10(1), 51–63.
    """

    scale: float = 1.0
    name = "O1"
    title = "observability index: volume of the ellipsoid of the singular values"
    unit = ""
    better = "larger"
    figure = ScenarioCriterion.figure

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.counted(), scale=inputs.n_poses**0.5)


@dataclass(frozen=True)
class ThirdObservability(EigenvalueCriterion):
    """O3 = σ_min, to be maximised: Φ = 1/O3² = λ_max(V_II); it orders plans as E does.

    `reported`: O3, in noise standard deviations per typical size.
    Source: Nahvi, Hollerbach & Hayward 1994, IEEE Int. Conf. Robotics and Automation, 407–412.
    """

    name = "O3"
    title = "observability index: smallest singular value"
    unit = ""
    better = "larger"


@dataclass(frozen=True)
class FifthObservability(MeanCriterion):
    """O5 = 1 / Σ_i (1/σ_i), to be maximised: 1/O5² = (tr V_II^{1/2})² = k² Φ, V = M⁻¹.

    Φ is the matrix mean of order 1/2 between D and A, hence 1/Φ is concave.  `reported`: O5, in
    noise standard deviations per typical size.
    Source: Sun & Hollerbach 2008, IEEE Int. Conf. Robotics and Automation, 831–836, where O1 is
    related to D, O3 to E and O5 to A; Pukelsheim 2006, ch. 6.
    """

    order: float = 0.5
    scale: float = 1.0
    name = "O5"
    title = "observability index: harmonic sum of the singular values"
    better = "larger"

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(E := inputs.counted(), scale=len(E))


# By name.  Cell files, command line, documentation, design and relaxation all ask this.
CRITERIA: dict[str, type[ScenarioCriterion]] = {
    criterion.name: criterion
    for criterion in (
        RemainingError,
        DeterminantCriterion,
        ParameterVariance,
        EigenvalueCriterion,
        GCriterion,
        PredictionVariance,
        CombinationVariance,
        FirstObservability,
        ThirdObservability,
        FifthObservability,
    )
}
# What a plan for them would be made for instead.
CONDITION = (
    "its plans had no bound, and what it asks for is the worst-known direction: take E or O3"
)
GONE = {
    "O2": CONDITION,
    "O4": CONDITION,
    "robust": f"take {TEST_POSE}; for effects that the model may lack measure, and ask next, or "
    "diagnose with a plan of extra poses",
}
Registered = TypeVar("Registered", bound=type[ScenarioCriterion])


def register(criterion: Registered) -> Registered:
    """The same class defined again, as in a notebook, replaces the former."""
    require(
        isinstance(criterion, type) and issubclass(criterion, ScenarioCriterion),
        f"register takes a class derived from ScenarioCriterion; found {quoted(criterion)}",
    )
    known = f"criterion {criterion.__name__}"
    name = vars(criterion).get("name")
    if not isinstance(name, str) or not is_label(name):
        raise InputError(
            f'{known} has no name that a cell file can state; add one, as in name = "my_criterion"'
        )
    taken = CRITERIA.get(name, criterion)
    require(
        same_class(taken, criterion),
        f"{known}: the name {quoted(name)} is taken by {taken.__name__}; choose another than "
        f"{listed(CRITERIA)}",
    )
    made = criterion.of.__func__ is not ScenarioCriterion.of.__func__  # type: ignore[attr-defined]
    missing = sorted(getattr(criterion, "__abstractmethods__", ())) + ([] if made else ["of"])
    require(not missing, f"{known} ({quoted(name)}) is not complete: define {listed(missing)}")
    bases = ScenarioCriterion, TraceCriterion, SpectralCriterion
    bent = criterion.curvature not in [base.curvature for base in bases]
    if issubclass(criterion, SpectralCriterion):
        bent |= criterion.phi_curvature is not SpectralCriterion.phi_curvature
    linear = issubclass(criterion, TraceCriterion) and criterion.value is TraceCriterion.value
    require(
        bent or linear or not criterion.certifiable,
        f"{known} ({quoted(name)}) is certifiable but states no curvature for the relaxation; "
        "define curvature (phi_curvature of a SpectralCriterion), or leave certifiable out",
    )
    CRITERIA[name] = criterion
    return criterion


def criterion_named(name: str, what: str = "criterion") -> type[ScenarioCriterion]:
    """The criterion that CRITERIA has under this name; InputError that lists them for another,
    which `what` begins."""
    require(name not in GONE, f"{what} {name} is gone: {GONE.get(name)}")
    check_known(name, CRITERIA, f"{what} {quoted(name)} is unknown")
    return CRITERIA[name]
