"""The planning criteria: one class each, and `CRITERIA`, in which all others look them up.

With matrix variables U ⪰ V = M⁻¹ and J ⪯ (V_II)⁻¹, both linear matrix inequalities in the weights
by Schur complements, every criterion with a bound is linear or has a standard cone:

    [M  Q; Qᵀ U] ⪰ 0   (Q spans the targets, U ⪰ QᵀVQ)      M ⪰ E_Iᵀ J E_I   (E_I picks I)

    test_pose, A, c, I    tr(C U)                           D, O1    exp(−log det J / k)
    G                     max_t tr(C_t U)                   E, O3    1/u with J = u 1
                                                            O5       (tr X⁻¹)² with X² ⪯ J

Sources: Boyd & Vandenberghe, Convex Optimization (2004), ch. 7.5; Ben-Tal & Nemirovski, Lectures
on Modern Convex Optimization (2001), ch. 4.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, ClassVar, Self, TypeVar, get_args

import numpy as np

from elastocal.cell.plan_wishes import TEST_POSE
from elastocal.errors import InputError, require
from elastocal.planning.criterion import (
    Cone,
    Criterion,
    CriterionInputs,
    Interest,
    Need,
    Robust,
    ScenarioCriterion,
    SpectralTerm,
    Term,
    TraceTerm,
    Variances,
    Worst,
    power_mean,
    power_mean_slope,
    trustworthy,
    whitened_rows,
)
from elastocal.text import did_you_mean, is_label, listed, quoted
from elastocal.units import Array, IntArray

Registered = TypeVar("Registered", bound=type[ScenarioCriterion])

ASYMMETRY = 1e-9
# Eigenvalues of Σ C_t below this part of the largest do not count as directions of the targets.
LOST = 1e-12


# --- Variances of linear functions of the parameters --------------------------------------------


@dataclass(frozen=True)
class TraceCriterion(ScenarioCriterion):
    """Φ_s = tr(C_s M_s⁻¹), L-optimality: C (S, p, p) symmetric, positive semidefinite, not 0.

    Nuisance parameters are marginalised by their rows and columns of C being zero.
    `reported` is `scale` · √Φ in `unit`.  1/Φ is concave for any C (Pukelsheim 2006, ch. 3 and
    5).  Raises InputError for another C.
    Source: Fedorov 1972; Atkinson, Donev & Tobias 2007, ch. 10 (L- or linear optimality).
    """

    C: Array
    name = "L"
    scale = 1.0
    certifiable = True

    def __post_init__(self) -> None:
        C = self.C
        require(
            C.ndim == 3 and C.shape[1] == C.shape[2],
            f"C of the {self.name} criterion has shape {C.shape}; give (scenarios, p, p)",
        )
        size = np.abs(C).max(axis=(1, 2), initial=0.0)
        require(
            bool(np.isfinite(size).all() and (size > 0).all()),
            f"C of the {self.name} criterion is zero or not finite: no target depends on the "
            "parameters; check the test poses, loads and parameters of interest",
        )
        skew = np.abs(C - C.swapaxes(-1, -2)).max(axis=(1, 2))
        lowest = np.linalg.eigvalsh(C)[:, 0]
        require(
            bool((skew <= ASYMMETRY * size).all() and (lowest >= -ASYMMETRY * size).all()),
            f"C of the {self.name} criterion is not symmetric and positive semidefinite",
        )

    @cached_property
    def variances(self) -> Variances:
        """φ with F (S, 1, q, p), FᵀF = C and q the largest rank of the C_s."""
        eigenvalues, U = np.linalg.eigh(self.C)
        lost = len(U[0]) * np.finfo(float).eps * eigenvalues[:, -1:]
        kept = (eigenvalues > lost).any(axis=0)
        root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None, :] * U
        return Variances(root[:, None, :, kept].swapaxes(-1, -2))

    def each(self, M: Array) -> Array:
        return np.asarray(self.variances.of(M)[..., 0])

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        values, gains = self.variances.with_gains(M)
        gains = gains[:, :, 0]
        return values[:, 0], gains @ gains.swapaxes(-1, -2)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        return np.asarray(self.variances.after_adding(M, blocks)[..., 0])

    def turned(self, T: Array) -> TraceCriterion | None:
        if type(self).each is not TraceCriterion.each:
            return None
        # From a root: TᵀCT itself is positive semidefinite to rounding of its largest parts only.
        F = self.variances.F[:, 0] @ T
        return replace(self, C=F.swapaxes(-1, -2) @ F)

    def figure(self, value: float) -> float:
        return self.scale * float(np.sqrt(value))

    def term(self, s: int) -> Term | None:
        return TraceTerm(self.C[s][None])

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        return _largest_trace(cp, self.C[s][None], M, root, unit)


@dataclass(frozen=True)
class RemainingError(TraceCriterion):
    """Φ = ρ₀² = E‖δp₀‖² = Σ_t w_t tr(A_t cov(X̂) A_tᵀ) = tr(C M⁻¹), in m².

    The mean square position error left at the user's test poses and loads once the arm is
    compensated by the identified parameters.  A (S, T, r, p) = ∂(position at test pose t)/∂X in m
    per scaled parameter, w the weights (T,) scaled to the sum 1, C_s = Σ_t w_t A_tᵀ A_t.
    `reported`: ρ₀ in µm.  It does not depend on the parametrisation; what no test pose shows is
    nuisance.
    Source: Klimchik, Wu, Pashkevich, Caro & Furet 2012, Applied Mechanics and Materials 162,
    161–170.
    """

    name = TEST_POSE
    title = "position error ρ₀ that remains at the test poses after compensation, rms"
    unit = "µm"
    scale = 1e6
    needs: ClassVar[tuple[Need, ...]] = ("test_poses",)

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        A, weights = inputs.targets(), inputs.target_weights()
        w = weights / weights.sum()
        return cls(np.einsum("t,stri,strj->sij", w, A, A, optimize=True))


@dataclass(frozen=True)
class RobustError(RemainingError):
    """Φ = tr(C M⁻¹) as of test_pose, with the effects that the model may lack among the parameters.

    Each of their parameters has mean 0 and the variance π s²: the probability π that the effect is
    missing, its typical size s.  `reported`: √Φ in µm, the error at the test poses of one who
    reckons with them.  It serves the parameters and shows what may be missing, as far as it matters
    at the test poses.
    Source: DuMouchel & Jones 1994, Technometrics 36, 37–47.
    """

    name = "robust"
    title = "position error at the test poses, effects that the model may lack included, rms"
    needs = ("test_poses", "doubts")


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
        interest = inputs.counted()
        C = np.zeros((inputs.scenarios, inputs.parameters, inputs.parameters))
        C[:, interest, interest] = 1.0
        return cls(C, scale=len(interest) ** -0.5)


@dataclass(frozen=True)
class CombinationVariance(TraceCriterion):
    """Φ = cᵀ V c, V = M⁻¹: the variance of c·X̂ with c from `[design] combination`.

    `reported`: its standard deviation √Φ, in the unit of the combination.
    The optimal weights often make M singular in the limit, where Φ is inf here: the bound holds,
    and weights as close to the optimum as one likes remain regular.
    Source: Elfving 1952; Pukelsheim 2006, ch. 2; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    unit: str = ""
    name = "c"
    title = "c-optimality: standard deviation of one parameter or combination"
    needs = ("combination",)

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        c = inputs.stated_combination()
        C = np.broadcast_to(np.outer(c, c), (inputs.scenarios, *c.shape * 2))
        return cls(C, unit=inputs.unit)


@dataclass(frozen=True)
class GCriterion(ScenarioCriterion):
    """Φ_s = max_t tr(A_t V_s A_tᵀ), V = M⁻¹, in m²: the worst of a region's T points.

    A (S, T, r, p) in m per scaled parameter: what is predicted at point t, as r components.
    1/Φ is the minimum of concave functions.  A finite `order` q gives the power mean
    (Σ_t φ_t^q / T)^{1/q} ≤ Φ, smooth.  `reported`: √Φ in µm, the root mean square error at the
    worst point.  Raises InputError where A is zero.
    Source: Kiefer & Wolfowitz 1960; Atkinson, Donev & Tobias 2007, ch. 9 and 10.
    """

    A: Array
    order: float = np.inf
    name = "G"
    title = "G-optimality: error of prediction at the worst test pose, rms"
    unit = "µm"
    needs = ("test_poses",)
    certifiable = True

    def __post_init__(self) -> None:
        require(
            self.A.ndim == 4 and bool(np.isfinite(self.A).all()),
            f"A of the G criterion has shape {self.A.shape}; give finite (scenarios, T, r, p)",
        )
        require(
            bool(self.A.any(axis=(1, 2, 3)).all()),
            "A of the G criterion is zero: no target depends on the parameters; check the test "
            "poses and loads",
        )

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.targets())

    @cached_property
    def variances(self) -> Variances:
        return Variances(self.A)

    def each(self, M: Array) -> Array:
        return power_mean(self.variances.of(M), self.order)

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        values, gains = self.variances.with_gains(M)
        weighted = gains * power_mean_slope(values, self.order)[:, None, :, None]
        return power_mean(values, self.order), np.einsum("sitq,sjtq->sij", weighted, gains)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        return power_mean(self.variances.after_adding(M, blocks), self.order)

    def turned(self, T: Array) -> GCriterion:
        return replace(self, A=self.A @ T[:, None])

    def softened(self, order: float) -> GCriterion:
        return GCriterion(self.A, order)

    def figure(self, value: float) -> float:
        return 1e6 * float(np.sqrt(value))

    def term(self, s: int) -> Term | None:
        if self.order != np.inf:
            return None
        A = self.A[s]
        return TraceTerm(A.transpose(0, 2, 1) @ A)

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        if self.order != np.inf:
            return super().cone(cp, s, M, root, unit)
        A = self.A[s]
        return _largest_trace(cp, A.transpose(0, 2, 1) @ A, M, root, unit)


def _largest_trace(cp: ModuleType, C: Array, M: Any, root: Array, unit: float) -> Cone:
    """max_t tr(C_t V), C (T, p, p)."""
    turned = root @ C @ root.T / unit
    size, Q = np.linalg.eigh(turned.sum(axis=0))
    Q = Q[:, size > LOST * size[-1]]
    q = Q.shape[1]
    U = cp.Variable((q, q), symmetric=True)
    largest = cp.Variable()
    limit = (Q.T @ turned @ Q).reshape(len(C), -1) @ cp.vec(U, order="C") <= largest

    def tangent(information: Array) -> tuple[float, Array]:
        """Of Σ_t μ_t tr(C_t V) ≤ max_t tr(C_t V), Σ μ_t = 1."""
        mu = np.maximum(limit.dual_value, 0.0)
        mean, V = np.tensordot(mu / mu.sum(), C, 1), np.linalg.inv(information)
        return float(np.sum(mean * V)), V @ mean @ V

    kinked = tangent if len(C) > 1 else None
    return Cone(largest, [cp.bmat([[M, Q], [Q.T, U]]) >> 0, limit], kinked)


# --- Eigenvalues of the information of interest -------------------------------------------------


@dataclass(frozen=True)
class SpectralCriterion(ScenarioCriterion):
    """Φ_s = φ(μ_1, …, μ_k), μ the eigenvalues of M_I = (V_II)⁻¹, V = M_s⁻¹.

    σ_i = √μ_i are the singular values of the stacked, scaled and whitened regressor of the
    parameters `interest` (k,) after projecting the nuisance columns out: those of the
    observability indices.  Without nuisance parameters and with unit noise they are the singular
    values of the scaled regressor itself, as in the literature.
    Raises InputError for an empty, repeated or unknown `interest`.
    """

    interest: IntArray

    def __post_init__(self) -> None:
        _ = self.marginal  # an unusable choice is refused here, not at the first plan

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.counted())

    @cached_property
    def marginal(self) -> Interest:
        return Interest(self.interest)

    @abstractmethod
    def phi(self, mu: Array) -> Array:
        """φ (...,) of positive eigenvalues μ (..., k) in ascending order."""

    @abstractmethod
    def slope(self, mu: Array) -> Array:
        """−∂φ/∂μ_i (..., k); a subgradient at a kink."""

    def each(self, M: Array) -> Array:
        factor = self.marginal.factor(M)
        mu = self._positive(np.asarray(np.linalg.eigvalsh(self.marginal.information(factor))))
        return np.where(factor.regular, self.phi(mu), np.inf)

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        factor = self.marginal.factor(M)
        factor.require_regular()
        mu, U = np.linalg.eigh(self.marginal.information(factor))
        mu = self._positive(mu)
        rows = U.swapaxes(-1, -2) @ self.marginal.projection(factor)
        G = rows.swapaxes(-1, -2) @ (self.slope(mu)[..., None] * rows)
        return self.phi(mu), (G + G.swapaxes(-1, -2)) / 2

    @staticmethod
    def _positive(mu: Array) -> Array:
        """Eigenvalues lost in rounding beside the largest one, kept above zero."""
        return np.maximum(mu, np.finfo(float).eps * mu[..., -1:])


@dataclass(frozen=True)
class DeterminantCriterion(SpectralCriterion):
    """Φ_s = det(V_II)^{1/k} = (Π μ_i)^{−1/k}, V = M⁻¹; D_s-optimality with nuisance.

    The k-th root makes efficiencies comparable: Φ halves when every pose is measured twice.  An
    efficiency does not depend on the parametrisation of the parameters of interest.  `reported`:
    log det of the covariance V_II of the scaled parameters, without unit.
    Source: Wald 1943; Pukelsheim 2006, ch. 6 and 9; Atkinson, Donev & Tobias 2007, ch. 11.
    """

    name = "D"
    title = "D-optimality: volume of the confidence ellipsoid"
    unit = "log det"
    certifiable = True

    def phi(self, mu: Array) -> Array:
        return np.asarray(np.exp(-np.log(mu).mean(axis=-1)))

    def slope(self, mu: Array) -> Array:
        return np.asarray(self.phi(mu)[..., None] / (mu.shape[-1] * mu))

    def each(self, M: Array) -> Array:
        factor = self.marginal.factor(M)
        pivots = np.diagonal(factor.L, axis1=-2, axis2=-1)[..., -self.marginal.count :]
        return np.where(factor.regular, self.phi(pivots**2), np.inf)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        """det(V_II) = det(M_NN)/det(M), and a pose multiplies each by one r × r determinant."""
        factor = self.marginal.factor(M)
        if not trustworthy(factor):
            return super().each_after_adding(M, blocks)
        order = self.marginal.ordered(M.shape[-1])
        nuisance = len(order) - self.marginal.count
        growth = np.empty((blocks.shape[1], len(M)))
        for part, W, K in whitened_rows(factor, blocks[..., order]):
            gained = _log_det(K)
            if nuisance:
                # L is lower triangular, so W's first columns are B_N L_NN⁻ᵀ.
                N = W[..., :nuisance]
                gained -= _log_det(np.eye(W.shape[-2]) + N @ N.swapaxes(-1, -2))
            growth[part] = gained.T
        return np.asarray(self.each(M) * np.exp(-growth / self.marginal.count))

    def figure(self, value: float) -> float:
        return self.marginal.count * float(np.log(value))

    def term(self, s: int) -> Term | None:
        return RootDeterminantTerm(np.asarray(self.interest))

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        """det(V_II)^{1/k}, J in the basis where V_II starts as the identity."""
        K = root.T[self.interest]
        K = np.linalg.solve(np.linalg.cholesky(K @ K.T), K)
        J = cp.Variable((len(K), len(K)), symmetric=True)
        return Cone(cp.exp(-cp.log_det(J) / len(K)), [M - K.T @ J @ K >> 0])


def _log_det(K: Array) -> Array:
    """log det (...,) of positive definite K (..., r, r)."""
    pivots = np.diagonal(np.linalg.cholesky(K), axis1=-2, axis2=-1)
    return np.asarray(2 * np.log(pivots).sum(axis=-1))


@dataclass(frozen=True)
class EigenvalueCriterion(SpectralCriterion):
    """Φ_s = λ_max(V_II) = 1/μ_1, V = M⁻¹: the largest variance of any unit combination.

    A finite `order` q gives the power mean (Σ μ_i^{−q} / k)^{1/q} ≤ Φ, smooth where the smallest
    eigenvalue is multiple, as it often is at the optimum: the matrix means of Kiefer 1974, with
    A at q = 1 and E at q = ∞.  `reported`: √Φ, the standard deviation of the worst-known
    direction, in typical sizes of the parameters.
    Source: Ehrenfeld 1955; Pukelsheim 2006, ch. 6; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    order: float = np.inf
    name = "E"
    title = "E-optimality: standard deviation of the worst-known direction"
    unit = "typical sizes"
    certifiable = True

    def phi(self, mu: Array) -> Array:
        return power_mean(1 / mu, self.order)

    def slope(self, mu: Array) -> Array:
        return power_mean_slope(1 / mu, self.order) / mu**2

    def softened(self, order: float) -> Self:
        return replace(self, order=order)

    def figure(self, value: float) -> float:
        return float(np.sqrt(value))

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        """λ_max(V_II) = 1/u."""
        if self.order != np.inf:
            return super().cone(cp, s, M, root, unit)
        interest = self.interest
        K = root.T[interest] / np.sqrt(unit)
        u = cp.Variable(nonneg=True)
        above = M - u * (K.T @ K) >> 0

        def tangent(information: Array) -> tuple[float, Array]:
            """M' ⪰ u' E_IᵀE_I, u' = 1/λ_max(V'_II), times Z ⪰ 0 is
            ⟨Z, M'⟩ ≥ tr(Z_II)/λ_max(V'_II)."""
            size, U = np.linalg.eigh(root.T @ above.dual_value @ root)
            Z = (U * np.maximum(size, 0.0)) @ U.T
            V = np.linalg.inv(information)[np.ix_(interest, interest)]
            largest = float(np.linalg.eigvalsh(V)[-1])
            return largest, Z * largest**2 / np.trace(Z[np.ix_(interest, interest)])

        return Cone(cp.inv_pos(u), [above], tangent)


@dataclass(frozen=True)
class ObservabilityIndex(SpectralCriterion):
    """An index O, to be maximised, with Φ_s = 1/O²; σ as in SpectralCriterion: of the scaled,
    whitened regressor with the nuisance columns projected out.

    `reported`: O, in noise standard deviations per typical size.
    """

    unit = ""
    better = "larger"

    def figure(self, value: float) -> float:
        return float(1 / np.sqrt(value))


@dataclass(frozen=True)
class FirstObservability(ObservabilityIndex, DeterminantCriterion):
    """O1 = (σ_1 ⋯ σ_k)^{1/k} / √m, to be maximised: Φ_s = 1/(m O1²) = det(V_II)^{1/k}.

    m = `n_poses`, the number of measurement configurations.  At a given number of poses O1 orders
    plans as D does.
    Source: Menq & Borm 1988; Borm & Menq 1991, Int. J. Robotics Research 10(1), 51–63.
    """

    n_poses: int
    name = "O1"
    title = "observability index: volume of the ellipsoid of the singular values"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.n_poses > 0,
            f"O1 divides by the root of the number of poses, not {self.n_poses}; ask for one",
        )

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        n = inputs.n_poses
        if n is None:
            raise InputError("criterion O1 needs the number of poses: set [design] poses")
        return cls(inputs.counted(), n)

    def figure(self, value: float) -> float:
        return super().figure(self.n_poses * value)


@dataclass(frozen=True)
class SecondObservability(ObservabilityIndex):
    """O2 = σ_min / σ_max, to be maximised: Φ_s = 1/O2² = μ_k / μ_1, without unit.

    The squared condition number of the information of interest.  It has degree 0 in M and may
    grow when a pose is added, so it gives no lower bound here; without nuisance parameters it
    is quasi-convex: Φ ≤ t is the linear matrix inequality z 1 ⪯ M ⪯ t z 1 in M and z.
    `reported`: O2 between 0 and 1.
    Source: Driels & Pathre 1990, J. Robotic Systems 7(1), 27–53.
    """

    name = "O2"
    title = "observability index: inverse condition number"
    without_bound = "is not convex"

    def phi(self, mu: Array) -> Array:
        return np.asarray(mu[..., -1] / mu[..., 0])

    def slope(self, mu: Array) -> Array:
        slope = np.zeros_like(mu)
        slope[..., 0] += mu[..., -1] / mu[..., 0] ** 2
        slope[..., -1] -= 1 / mu[..., 0]
        return slope


@dataclass(frozen=True)
class ThirdObservability(ObservabilityIndex, EigenvalueCriterion):
    """O3 = σ_min, to be maximised: Φ_s = 1/O3² = 1/μ_1; it orders plans as E does.

    Source: Nahvi, Hollerbach & Hayward 1994, IEEE Int. Conf. Robotics and Automation, 407–412.
    """

    name = "O3"
    title = "observability index: smallest singular value"


@dataclass(frozen=True)
class FourthObservability(ObservabilityIndex):
    """O4 = σ_min² / σ_max = O2 · O3, to be maximised: Φ_s = 1/O4² = μ_k / μ_1².

    The noise amplification index.  It has degree −1 in M, but may grow when a pose is added, and
    1/Φ is not concave: no bound.
    Source: Nahvi & Hollerbach 1996, IEEE Int. Conf. Robotics and Automation, 647–654.
    """

    name = "O4"
    title = "observability index: noise amplification"
    without_bound = "is not convex"

    def phi(self, mu: Array) -> Array:
        return np.asarray(mu[..., -1] / mu[..., 0] ** 2)

    def slope(self, mu: Array) -> Array:
        slope = np.zeros_like(mu)
        slope[..., 0] += 2 * mu[..., -1] / mu[..., 0] ** 3
        slope[..., -1] -= 1 / mu[..., 0] ** 2
        return slope


@dataclass(frozen=True)
class FifthObservability(ObservabilityIndex):
    """O5 = 1 / Σ_i (1/σ_i), to be maximised: Φ_s = 1/O5² = (tr V_II^{1/2})², V = M⁻¹.

    k² times the matrix mean of order −1/2 between D and A, hence 1/Φ is concave.
    Source: Sun & Hollerbach 2008, IEEE Int. Conf. Robotics and Automation, 831–836, where O1 is
    related to D, O3 to E and O5 to A; Pukelsheim 2006, ch. 6.
    """

    name = "O5"
    title = "observability index: harmonic sum of the singular values"
    certifiable = True

    def phi(self, mu: Array) -> Array:
        return np.asarray((mu**-0.5).sum(axis=-1) ** 2)

    def slope(self, mu: Array) -> Array:
        return np.asarray((mu**-0.5).sum(axis=-1)[..., None] * mu**-1.5)

    def term(self, s: int) -> Term | None:
        return SquaredTraceRootTerm(np.asarray(self.interest))

    def cone(self, cp: ModuleType, s: int, M: Any, root: Array, unit: float) -> Cone:
        """(tr V_II^{1/2})² with X² ⪯ J by [J X; X 1] ⪰ 0."""
        K = root.T[self.interest] / np.sqrt(unit)
        k = len(K)
        J, X = cp.Variable((k, k), symmetric=True), cp.Variable((k, k), symmetric=True)
        below = [M - K.T @ J @ K >> 0, cp.bmat([[J, X], [X, np.eye(k)]]) >> 0]
        return Cone(cp.square(cp.matrix_frac(np.eye(k), X)), below)


@dataclass(frozen=True)
class RootDeterminantTerm(SpectralTerm):
    """φ = det(V_II)^{1/m}: D."""

    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        value = float(np.exp(np.mean(np.log(eigenvalues))))
        return value, value / (len(eigenvalues) * eigenvalues)

    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        value, first = self._slope(eigenvalues)
        return first, -value / (len(eigenvalues) * np.outer(eigenvalues, eigenvalues)), 1.0 / value


@dataclass(frozen=True)
class SquaredTraceRootTerm(SpectralTerm):
    """φ = (tr V_II^{1/2})² = (Σ 1/σ_i)²: O5."""

    def _slope(self, eigenvalues: Array) -> tuple[float, Array]:
        roots = np.sqrt(eigenvalues)
        return float(roots.sum() ** 2), roots.sum() / roots

    def _curvature(self, eigenvalues: Array) -> tuple[Array, Array, float]:
        roots = np.sqrt(eigenvalues)
        mixed = -roots.sum() / (np.outer(roots, roots) * np.add.outer(roots, roots))
        return 0.5 / roots, mixed, 2.0


# --- The criteria that there are ----------------------------------------------------------------

# By name.  Cell files, command line, documentation, design and relaxation all ask this.
CRITERIA: dict[str, type[ScenarioCriterion]] = {
    criterion.name: criterion
    for criterion in (
        RemainingError,
        RobustError,
        DeterminantCriterion,
        ParameterVariance,
        EigenvalueCriterion,
        GCriterion,
        PredictionVariance,
        CombinationVariance,
        FirstObservability,
        SecondObservability,
        ThirdObservability,
        FourthObservability,
        FifthObservability,
    )
}


def register(criterion: Registered) -> Registered:
    """Add a criterion of one's own to `CRITERIA`; usable as a decorator of its class.

    Raises InputError where it is no class of a ScenarioCriterion that says how it is made (`of`),
    its name is taken or no text on one line, and where it is `certifiable` without a `term` or
    `cone` for the relaxation.  The same class defined again, as in a notebook, replaces the former.
    """
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
        _place(taken) == _place(criterion),
        f"{known}: the name {quoted(name)} is taken by {taken.__name__}; choose another than "
        f"{listed(CRITERIA)}",
    )
    made = criterion.of.__func__ is not ScenarioCriterion.of.__func__  # type: ignore[attr-defined]
    missing = sorted(getattr(criterion, "__abstractmethods__", ())) + ([] if made else ["of"])
    require(not missing, f"{known} ({quoted(name)}) is not complete: define {listed(missing)}")
    forms = ("term", "cone")
    bounded = any(getattr(criterion, f) is not getattr(ScenarioCriterion, f) for f in forms)
    require(
        bounded or not criterion.certifiable,
        f"{known} ({quoted(name)}) is certifiable but has neither term nor cone for the "
        "relaxation; define one of them, or leave certifiable out",
    )
    CRITERIA[name] = criterion
    return criterion


def _place(criterion: type[ScenarioCriterion]) -> tuple[str, str]:
    return criterion.__module__, criterion.__qualname__


def criterion_named(name: str) -> type[ScenarioCriterion]:
    """The criterion that CRITERIA has under this name; InputError that lists them for another."""
    require(
        name in CRITERIA,
        f"criterion {quoted(name)} is unknown{did_you_mean(name, CRITERIA)}; there are "
        f"{listed(CRITERIA)}",
    )
    return CRITERIA[name]


def make_criterion(
    name: str,
    *,
    parameters: int,
    interest: IntArray,
    scenarios: int = 1,
    robust: Robust = "none",
    **inputs: Any,
) -> Criterion:
    """The criterion `name`, one of CRITERIA, for p = `parameters` scaled parameters.

    All else, `inputs` too, as in CriterionInputs.  Over S = `scenarios` > 1 of the arm, `robust`
    says whether the average or the worst counts.
    Raises InputError for an unknown name, and where something the criterion needs is missing, of
    another shape, or empty.
    """
    chosen = criterion_named(name)
    options = get_args(Robust)
    require(
        robust in options,
        f"robust = {quoted(robust)} is unknown{did_you_mean(robust, options)}; there are "
        f"{listed(options)}",
    )
    require(
        robust != "none" or scenarios == 1,
        f"criterion {name} has {scenarios} scenarios of the arm to weigh: say whether the "
        'average or the worst counts (robust = "average" or "worst")',
    )
    indices = np.asarray(interest, dtype=np.int64)
    criterion = chosen.of(CriterionInputs(name, parameters, indices, scenarios, **inputs))
    return Worst(criterion) if robust == "worst" else criterion
