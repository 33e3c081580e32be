"""The planning criteria: one class each, and `CRITERIA`, in which all others look them up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self, TypeVar

import numpy as np

from elastocal.cell.plan_wishes import TEST_POSE
from elastocal.errors import InputError, require
from elastocal.planning.criterion import (
    CriterionInputs,
    MeanCriterion,
    Need,
    ScenarioCriterion,
    SpectralCriterion,
    TraceCriterion,
    mean_curvature,
    mean_slope,
    power_mean,
    triangular,
)
from elastocal.text import did_you_mean, is_label, listed, quoted
from elastocal.units import Array

# Variances of linear functions of the parameters.


@dataclass(frozen=True)
class RemainingError(TraceCriterion):
    """Φ = ρ₀² = E‖δp₀‖² = Σ_t w_t tr(A_t cov(X̂) A_tᵀ), V = cov(X̂), in m².

    The mean square position error left at the user's test poses and loads once the arm is
    compensated by the identified parameters.  A (T, r, p) = ∂(position at test pose t)/∂X in m
    per scaled parameter, w the weights (T,) scaled to the sum 1.  `reported`: ρ₀ in µm.  It does
    not depend on the parametrisation; what no test pose shows is nuisance.
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
        rows = np.sqrt(weights / weights.sum())[:, None, None] * A
        return cls(triangular(rows.reshape(-1, A.shape[-1])))


@dataclass(frozen=True)
class RobustError(RemainingError):
    """Φ as of test_pose, with the effects that the model may lack among the parameters.

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
class GCriterion(ScenarioCriterion):
    """Φ = max_t tr(A_t V A_tᵀ), V = M⁻¹, in m²: the worst of a region's T points.

    A (T, r, p) in m per scaled parameter: what is predicted at point t, as r components.
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
    kinked = True

    def __post_init__(self) -> None:
        require(
            bool(self.A.any()),
            "A of the G criterion is zero: no target depends on the parameters; check the test "
            "poses and loads",
        )

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        return cls(inputs.targets())

    @cached_property
    def C(self) -> Array:
        """A_tᵀA_t as rows (T, p²)."""
        return np.asarray((self.A.swapaxes(-1, -2) @ self.A).reshape(len(self.A), -1))

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

    def tangent(self, V: Array) -> tuple[float, Array]:
        each = self._each(V)
        weights = mean_slope(each, self.order)
        weights = weights / weights.sum()
        return float(weights @ each), (weights @ self.C).reshape(V.shape)

    def turned(self, T: Array) -> GCriterion:
        return replace(self, A=self.A @ T)

    def softened(self, q: float) -> GCriterion:
        return replace(self, order=q)

    def figure(self, value: float) -> float:
        return 1e6 * float(np.sqrt(value))


# Eigenvalues of the covariance of the parameters of interest.


@dataclass(frozen=True)
class DeterminantCriterion(MeanCriterion):
    """Φ = det(V_II)^{1/k}, V = M⁻¹; D_s-optimality with nuisance.

    The k-th root makes efficiencies comparable: Φ halves when every pose is measured twice.  An
    efficiency does not depend on the parametrisation of the parameters of interest.  `reported`:
    log det of the covariance V_II of the scaled parameters, without unit.
    Source: Wald 1943; Pukelsheim 2006, ch. 6 and 9; Atkinson, Donev & Tobias 2007, ch. 11.
    """

    order: float = 0.0
    volume: float = 1.0
    name = "D"
    title = "D-optimality: volume of the confidence ellipsoid"
    unit = "log det"

    def value(self, V: Array) -> Array:
        K = self.E @ V @ self.E.T
        return np.asarray(self.volume * np.exp(np.linalg.slogdet(K)[1] / len(self.E)))

    def slope(self, V: Array) -> tuple[float, Array]:
        K, value = self.E @ V @ self.E.T, float(self.value(V))
        return value, value / len(K) * self.E.T @ np.linalg.solve(K, self.E)

    def curvature(self, V: Array, X: Array) -> Array | float:
        K, k, value = self.E @ V @ self.E.T, len(self.E), float(self.value(V))
        Y = np.linalg.solve(K, self.E @ X @ self.E.T)
        trace = np.einsum("kii->k", Y)
        pairs = Y.reshape(len(Y), -1) @ Y.swapaxes(1, 2).reshape(len(Y), -1).T
        return np.asarray(value / k * (np.outer(trace, trace) / k - pairs))

    def turned(self, T: Array) -> ScenarioCriterion:
        """E T = L Q: what L stretches is a factor, so that Q keeps the determinant's digits."""
        Q, L = np.linalg.qr((self.E @ T).T)
        stretched = np.exp(2 * np.log(np.abs(np.diag(L))).mean())
        return replace(self, E=Q.T, volume=self.volume * float(stretched))

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

    def softened(self, q: float) -> Self:
        return replace(self, order=q)

    def tangent(self, V: Array) -> tuple[float, Array]:
        lam, U = self._eigen(V)
        weights = self.phi_slope(lam)
        weights = weights / weights.sum()
        return float(weights @ lam), (U * weights) @ U.T

    def figure(self, value: float) -> float:
        return float(np.sqrt(value))


@dataclass(frozen=True)
class FirstObservability(DeterminantCriterion):
    """O1 = (σ_1 ⋯ σ_k)^{1/k} / √m, to be maximised: Φ = m · 1/(m O1²) = det(V_II)^{1/k}.

    m = `n_poses`, the number of measurement configurations.  At a given number of poses O1 orders
    plans as D does.  `reported`: O1, in noise standard deviations per typical size.
    Source: Menq & Borm 1988; Borm & Menq 1991, Int. J. Robotics Research 10(1), 51–63.
    """

    n_poses: int = 1
    name = "O1"
    title = "observability index: volume of the ellipsoid of the singular values"
    unit = ""
    better = "larger"

    @classmethod
    def of(cls, inputs: CriterionInputs) -> Self:
        n = inputs.n_poses
        if not n:
            raise InputError("criterion O1 needs the number of poses: set [design] poses")
        return cls(inputs.counted(), n_poses=n)

    def figure(self, value: float) -> float:
        return float(1 / np.sqrt(self.n_poses * value))


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

    def figure(self, value: float) -> float:
        return float(1 / np.sqrt(value))


@dataclass(frozen=True)
class FifthObservability(MeanCriterion):
    """O5 = 1 / Σ_i (1/σ_i), to be maximised: 1/O5² = (tr V_II^{1/2})² = k² Φ, V = M⁻¹.

    Φ is the matrix mean of order 1/2 between D and A, hence 1/Φ is concave.  `reported`: O5, in
    noise standard deviations per typical size.
    Source: Sun & Hollerbach 2008, IEEE Int. Conf. Robotics and Automation, 831–836, where O1 is
    related to D, O3 to E and O5 to A; Pukelsheim 2006, ch. 6.
    """

    order: float = 0.5
    name = "O5"
    title = "observability index: harmonic sum of the singular values"
    better = "larger"

    def figure(self, value: float) -> float:
        return float(1 / (len(self.E) * np.sqrt(value)))


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
        ThirdObservability,
        FifthObservability,
    )
}
# What a plan for them would be made for instead.
CONDITION = (
    "its plans had no bound, and what it asks for is the worst-known direction: take E or O3"
)
GONE = {"O2": CONDITION, "O4": CONDITION}
Registered = TypeVar("Registered", bound=type[ScenarioCriterion])
# What criteria stated before they were functions of V.
FORMER = ("each", "each_gradient", "each_after_adding", "term", "cone")


def register(criterion: Registered) -> Registered:
    """Add a criterion of one's own to `CRITERIA`; usable as a decorator of its class.

    Raises InputError where it is no class of a ScenarioCriterion that says how it is made (`of`),
    its name is taken or no text on one line, it is stated as a function of M, and where it is
    `certifiable` without a curvature for the relaxation.  The same class defined again, as in a
    notebook, replaces the former.
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
    former = [what for what in FORMER if hasattr(criterion, what)]
    require(
        not former,
        f"{known} ({quoted(name)}) defines {listed(former)}, functions of M; state value, slope "
        "and curvature as functions of the covariance V instead",
    )
    made = criterion.of.__func__ is not ScenarioCriterion.of.__func__  # type: ignore[attr-defined]
    missing = sorted(getattr(criterion, "__abstractmethods__", ())) + ([] if made else ["of"])
    require(not missing, f"{known} ({quoted(name)}) is not complete: define {listed(missing)}")
    own = criterion.curvature is not ScenarioCriterion.curvature
    if issubclass(criterion, SpectralCriterion):
        own = criterion.curvature is not SpectralCriterion.curvature or (
            criterion.phi_curvature is not SpectralCriterion.phi_curvature
        )
    linear = issubclass(criterion, TraceCriterion) and criterion.value is TraceCriterion.value
    require(
        own or linear or not criterion.certifiable,
        f"{known} ({quoted(name)}) is certifiable but states no curvature for the relaxation; "
        "define curvature (phi_curvature of a SpectralCriterion), or leave certifiable out",
    )
    CRITERIA[name] = criterion
    return criterion


def _place(criterion: type[ScenarioCriterion]) -> tuple[str, str]:
    return criterion.__module__, criterion.__qualname__


def criterion_named(name: str) -> type[ScenarioCriterion]:
    """The criterion that CRITERIA has under this name; InputError that lists them for another."""
    require(name not in GONE, f"criterion {name} is gone: {GONE.get(name)}")
    require(
        name in CRITERIA,
        f"criterion {quoted(name)} is unknown{did_you_mean(name, CRITERIA)}; there are "
        f"{listed(CRITERIA)}",
    )
    return CRITERIA[name]
