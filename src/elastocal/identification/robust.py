"""Robust fits: losses of a reading's whole length, by reweighting; L1 as a cone program."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, optimize, special

from elastocal.errors import ElastocalError, InsufficientDataError, require
from elastocal.identification.covariance import Covariance, SatterthwaiteSums, orthogonal
from elastocal.identification.least_squares import FitProblem
from elastocal.identification.linear_solver import least_norm
from elastocal.identification.trimmed import least_trimmed_squares, median_scale
from elastocal.units import Array, IntArray

# The linear model of every robust fit, in the coordinates of an orthonormal basis of B.


@dataclass(frozen=True)
class Design:
    """y (rows,) ≈ B (rows, p) x in n observations of `size` consecutive whitened rows.

    Solvers work with z = V⁻¹ x, where B x = Q z and Q (rows, p) is orthonormal: the units of the
    parameters and their scaling cannot matter.
    """

    y: Array
    size: int
    Q: Array
    V: Array

    @property
    def n(self) -> int:
        return len(self.y) // self.size

    @property
    def p(self) -> int:
        return self.Q.shape[1]

    @property
    def floor(self) -> float:
        """Smallest scale that rounding of y lets a residual have."""
        return float(np.finfo(float).eps * np.sqrt(np.mean(self.y**2)) + np.finfo(float).tiny)

    def parameters(self, z: Array) -> Array:
        """x (p,) or (p, k) of coordinates z."""
        return self.V @ z

    def residual(self, z: Array) -> Array:
        """y − Q z (rows,)."""
        return self.y - self.Q @ z

    def rows(self, weights: Array) -> Array:
        """Per-observation weights (n,) repeated for the rows (rows,)."""
        return np.repeat(weights, self.size)

    def weighted_step(self, weights: Array, r: Array) -> Array:
        """δz (p,) minimising Σ w_i |r_i − Q_i δz|².

        Raises InsufficientDataError where the observations that keep a weight do not determine
        every parameter.
        """
        QW = self.Q.T * self.rows(weights)
        try:
            factor = linalg.cho_factor(QW @ self.Q, check_finite=False)
        except linalg.LinAlgError:
            raise InsufficientDataError(
                "the observations that the loss does not reject do not determine all parameters; "
                "measure more, or fit fewer parameters"
            ) from None
        return np.asarray(linalg.cho_solve(factor, QW @ r, check_finite=False))


def design(B: ArrayLike, y: ArrayLike, size: int) -> Design:
    """Check B (n·size, p) and y (n·size,), and factor B.

    Raises InputError for rows that are no multiple of `size`, and as `orthogonal`.
    """
    factors, y = orthogonal(B, y)
    require(
        size >= 1 and len(y) % size == 0,
        f"{len(y)} rows cannot be split into observations of {size} rows; check size",
    )
    return Design(y, size, factors.Q, factors.V)


def lengths(residual: Array, size: int) -> Array:
    """|e_i| (n,) of each observation; for size 1 its absolute value."""
    return np.abs(residual) if size == 1 else np.linalg.norm(residual.reshape(-1, size), axis=1)


# Losses ρ(d) of the length d = |e_i|/σ of an observation's scaled residual.
#
# An observation of `size` whitened rows (x, y, z of a tracker reading) is right or wrong as a
# whole: the loss sees its Mahalanobis length, and its rows share one weight.  For size 1 the
# length is |r| and these are the usual losses per row.


@dataclass(frozen=True)
class Loss(ABC):
    """ρ with ρ(0) = 0, ψ = ρ′ and slope ψ′, elementwise of lengths d ≥ 0.

    weight = ψ(d)/d solves ψ's estimating equation; it is not an inverse variance.
    """

    name: ClassVar[str]
    size: int

    @abstractmethod
    def rho(self, d: Array) -> Array: ...

    @abstractmethod
    def weight(self, d: Array) -> Array: ...

    @abstractmethod
    def slope(self, d: Array) -> Array: ...

    def psi(self, d: Array) -> Array:
        return d * self.weight(d)


@dataclass(frozen=True)
class Huber(Loss):
    """ρ = d²/2 up to c, c d − c²/2 beyond (Huber 1964)."""

    name: ClassVar[str] = "huber"
    c: float

    def rho(self, d: Array) -> Array:
        return np.where(d <= self.c, d**2 / 2, self.c * (d - self.c / 2))

    def weight(self, d: Array) -> Array:
        return self.c / np.maximum(d, self.c)

    def slope(self, d: Array) -> Array:
        return (d <= self.c).astype(float)


@dataclass(frozen=True)
class Bisquare(Loss):
    """Tukey's ρ = c²/6 (1 − (1 − (d/c)²)³) up to c, c²/6 beyond (Beaton and Tukey 1974)."""

    name: ClassVar[str] = "tukey"
    c: float

    def rho(self, d: Array) -> Array:
        return self.c**2 / 6 * (1 - self._inside(d) ** 3)

    def weight(self, d: Array) -> Array:
        return self._inside(d) ** 2

    def slope(self, d: Array) -> Array:
        inside = self._inside(d)
        return inside * (5 * inside - 4)  # (1 − u²)(1 − 5u²), u = d/c

    def _inside(self, d: Array) -> Array:
        return np.maximum(1 - (d / self.c) ** 2, 0.0)


@dataclass(frozen=True)
class Absolute(Loss):
    """ρ = d: least absolute values, or the least sum of Euclidean lengths for size > 1."""

    name: ClassVar[str] = "l1"

    def rho(self, d: Array) -> Array:
        return d

    def weight(self, d: Array) -> Array:
        return 1 / np.maximum(d, np.finfo(float).tiny)

    def slope(self, d: Array) -> Array:
        return np.zeros_like(d)


@dataclass(frozen=True)
class StudentT(Loss):
    """−log density of the multivariate t: ρ = (ν + size)/2 · log(1 + d²/ν)."""

    name: ClassVar[str] = "student-t"
    nu: float

    def rho(self, d: Array) -> Array:
        return (self.nu + self.size) / 2 * np.log1p(d**2 / self.nu)

    def weight(self, d: Array) -> Array:
        return (self.nu + self.size) / (self.nu + d**2)

    def slope(self, d: Array) -> Array:
        return (self.nu + self.size) * (self.nu - d**2) / (self.nu + d**2) ** 2


# Tuning constants by the rows of an observation, 1 to 6.
#
# Under normal noise the scaled length d follows χ(size).  With r = e/σ, Ψ(r) = ψ(|r|) r/|r| and
# J = ∂Ψ/∂r, symmetry gives E J = a·I and E ΨΨᵀ = b·I with
#
#     a = E[ψ′/size + (1 − 1/size) ψ(d)/d],    b = E ψ²/size
#
# and the efficiency a²/b (Huber 1981, section 7.6, for size 1; Maronna 1976 for vectors).  The
# constants of HUBER and TUKEY solve a²/b = 0.95, those of HALF solve E ρ = sup ρ/2, which gives an
# M-scale the breakdown point of one half (Rousseeuw and Yohai 1984): found by quadrature of the
# density of χ(size), to ten digits.  For size 1 they are the well-known 1.345, 4.685 and 1.548.

HUBER = (1.344997509, 1.501141084, 1.627987920, 1.731072513, 1.812018420, 1.869337729)
TUKEY = (4.685064949, 5.122986090, 5.490249208, 5.810315587, 6.096266469, 6.356216290)
HALF = (1.547644981, 2.660803393, 3.452881651, 4.096562166, 4.652023341, 5.147685250)


def huber(size: int = 1) -> Huber:
    """Huber's loss with 95 % efficiency at the normal for observations of `size` rows."""
    return Huber(size, HUBER[size - 1])


def bisquare(size: int = 1) -> Bisquare:
    """Tukey's bisquare with 95 % efficiency at the normal for observations of `size` rows."""
    return Bisquare(size, TUKEY[size - 1])


# The result of every robust linear fit.


@dataclass(frozen=True)
class RobustEstimate:
    """x (p,) with Σ B_iᵀ Ψ(e_i/σ) = 0, its residual (rows,), scale σ and the loss.

    `weights` (n,) are ψ(d)/d of each observation, 1 for what counts in full and 0 for what is
    rejected (unbounded where an L1 fit meets an observation).  They are NOT inverse variances; for
    the covariance see `asymptotic_covariance`.  `optimality` says how nearly x is optimal:
    |Σ Q_iᵀ Ψ| over √Σ|Ψ|² with an orthonormal basis Q of B, or for L1 the duality gap relative to
    the minimum.
    """

    design: Design
    loss: Loss
    x: Array
    residual: Array
    scale: float
    converged: bool
    iterations: int
    optimality: float

    @property
    def distance(self) -> Array:
        """|e_i|/σ (n,)."""
        return lengths(self.residual, self.design.size) / self.scale

    @property
    def weights(self) -> Array:
        return self.loss.weight(self.distance)

    @property
    def objective(self) -> float:
        """Σ ρ(|e_i|/σ)."""
        return float(self.loss.rho(self.distance).sum())


# Reweighting: iterated least squares, with the scale estimated alongside or held.

TOLERANCE = 1e-11  # of the step |B δx| in units of the scale
MAX_ITER = 2000
Rescaled = Callable[
    [Array, Array, float], float
]  # of lengths and weights (n,) and the scale so far


def reweighted(
    problem: Design, loss: Loss, z: Array, scale: float, rescaled: Rescaled | None = None
) -> RobustEstimate:
    """IRLS from coordinates z; each step lowers Σ ρ at its scale (Huber 1981, section 7.8).

    The `scale` is held, or `rescaled` says it anew after each step.
    """
    r, size = problem.residual(z), problem.size
    converged, count = False, 0
    while not converged and count < MAX_ITER:
        weights = loss.weight(lengths(r, size) / scale)
        step = problem.weighted_step(weights, r)
        z, before = z + step, scale
        r = problem.residual(z)
        if rescaled is not None:
            scale = max(rescaled(lengths(r, size), weights, scale), problem.floor)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)  # no more digits in z
        same = abs(scale - before) <= TOLERANCE * scale
        converged = bool((moved <= TOLERANCE * scale or still) and same)
    scores = problem.rows(loss.weight(lengths(r, size) / scale)) * r / scale
    total = float(np.linalg.norm(scores))
    optimality = float(np.linalg.norm(problem.Q.T @ scores)) / total if total > 0 else 0.0
    x = problem.parameters(z)
    return RobustEstimate(problem, loss, x, r, scale, converged, count, optimality)


def m_estimate(B: ArrayLike, y: ArrayLike, loss: Loss, *, size: int = 1) -> RobustEstimate:
    """Solve Σ B_iᵀ Ψ(e_i/σ) = 0, e = y − B x, Ψ(r) = ψ(|r|) r/|r| (Huber 1981, chapter 7).

    B (n·size, p) and y (n·size,) whitened, `size` rows per observation.  σ is the MAD about zero
    of every residual anew; the start is least squares.  A monotone ψ (Huber, L1) has one solution
    and resists errors in y but not at leverage points; a redescending one finds the solution near
    the start, so bisquare belongs after a fit of the majority (`tukey`).

    Raises InputError as `design`; InsufficientDataError where rejection leaves too little.
    """
    problem = design(B, y, size)
    if isinstance(loss, Absolute):
        return least_absolute(problem, loss)
    z, sigma = _least_squares(problem)
    return reweighted(problem, loss, z, sigma, lambda length, *_: median_scale(length, size))


def _least_squares(problem: Design) -> tuple[Array, float]:
    z = problem.Q.T @ problem.y
    return z, _scale_at(problem, z)


def _scale_at(problem: Design, z: Array) -> float:
    length = lengths(problem.residual(z), problem.size)
    return max(median_scale(length, problem.size), problem.floor)


def tukey(
    B: ArrayLike, y: ArrayLike, *, size: int = 1, start: Array | None = None, seed: int = 0
) -> RobustEstimate:
    """Tukey's bisquare with 95 % efficiency, reweighted from the fit of the majority.

    The start is x = `start` (p,), or the least trimmed squares of random subsets: then almost half
    of the observations, leverage points among them, may be wrong.  The bisquare of `HALF` makes the
    scale as small as it gets nearby, with Σ ρ(|e_i|/σ) = (n − p/size) sup ρ/2, and that of 95 %
    descends from there at this scale (Yohai 1987; for p/size Maronna and Yohai 2010).

    Raises InputError as `design`; InsufficientDataError where rejection leaves too little.
    """
    problem, half = design(B, y, size), Bisquare(size, HALF[size - 1])
    if start is None:
        z = least_trimmed_squares(problem.Q, problem.y, size, seed)
    else:
        z = problem.Q.T @ (np.asarray(B, dtype=np.float64) @ start)
    target = half.c**2 / 12 * (problem.n - problem.p / size)

    def rescaled(length: Array, _: Array, scale: float) -> float:
        return scale * float(np.sqrt(half.rho(length / scale).sum() / target))

    found = reweighted(problem, half, z, _scale_at(problem, z), rescaled)
    z = problem.Q.T @ (problem.y - found.residual)
    return reweighted(problem, bisquare(size), z, found.scale)


NU_RANGE = (1.0, 200.0)  # below 1 the likelihood may be unbounded; at 200 the t is normal


def student_t(
    B: ArrayLike, y: ArrayLike, *, size: int = 1, nu: float | None = None
) -> RobustEstimate:
    """ML of y_i = B_i x + e_i, e_i ~ t_ν(0, σ² I) of `size` components per observation.

    EM in the parameter-expanded form, which has the same fixed points and is faster (Kent, Tyler
    and Vardi 1994; Meng and van Dyk 1997):

        w_i = (ν + size)/(ν + |e_i|²/σ²),    Σ w_i B_iᵀ(y_i − B_i x) = 0,
        σ² = Σ w_i |e_i|²/(size Σ w_i)

    `nu` None maximises the profile likelihood over 1 ≤ ν ≤ 200.  σ is the scale of the t, not a
    standard deviation (which is σ √(ν/(ν−2))).  The start is least squares with the median's
    scale; for small ν with outliers at leverage points the likelihood has other maxima.

    Raises InputError as `design`, and where fewer observations than parameters tell no ν.
    """
    problem = design(B, y, size)
    state = _least_squares(problem)

    def estimate(nu: float) -> RobustEstimate:
        return reweighted(
            problem, StudentT(size, nu), *state,
            lambda length, w, _: float(np.sqrt(w @ length**2 / (size * w.sum()))),
        )  # fmt: skip

    if nu is not None:
        return estimate(nu)
    require(problem.n > problem.p, "estimating ν needs more observations than parameters")

    def cost(log_nu: float) -> float:
        nonlocal state
        found = estimate(float(np.exp(log_nu)))
        state = problem.Q.T @ (problem.y - found.residual), found.scale
        return -log_likelihood(found)

    bounds = np.log(NU_RANGE)
    best = optimize.minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return estimate(float(np.exp(best.x)))


def log_likelihood(found: RobustEstimate) -> float:
    """Sum of the logarithms of the multivariate t densities of y at a Student-t estimate."""
    loss, n = found.loss, found.design.n
    assert isinstance(loss, StudentT)
    nu, size = loss.nu, loss.size
    constant = special.gammaln((nu + size) / 2) - special.gammaln(nu / 2)
    constant -= size / 2 * np.log(nu * np.pi) + size * np.log(found.scale)
    return float(n * constant - found.objective)


# Least absolute values, and the least sum of Euclidean lengths, with a certificate.
#
#     minimise  Σ |e_i|,  e = y − B x         dual:  maximise Σ y_iᵀ λ_i,  Bᵀ λ = 0,  |λ_i| ≤ 1
#
# Any feasible λ bounds the minimum from below, so the gap Σ|e_i| − yᵀλ proves how good x is.

OPTIMAL = 5e-6  # relative duality gap that counts as solved
ACCURATE = 1e-12  # asked of the cone solver, which ends where rounding allows no more
MOST_STEPS = 100


def least_absolute(problem: Design, loss: Absolute) -> RobustEstimate:
    """Minimise the sum of |e_i|; `optimality` is the duality gap over the minimum.

    The median's scale is only reported: x does not depend on it.
    """
    z, dual, count = _cone_program(problem)
    z = _descended(problem, z)
    r = problem.residual(z)
    length = lengths(r, problem.size)
    # The bound is that of the nearest λ with Bᵀλ = 0, shrunk until every |λ_i| ≤ 1, and the gap
    # is less what rounding of y may leave of both.
    feasible = dual - problem.Q @ (problem.Q.T @ dual)
    feasible /= max(1.0, float(lengths(feasible, problem.size).max()))
    rounding, minimum = 30 * len(r) * problem.floor, float(length.sum())
    gap = max(minimum - float(problem.y @ feasible) - rounding, 0.0) / max(minimum, rounding)
    sigma = max(median_scale(length, problem.size), problem.floor)
    x = problem.parameters(z)
    return RobustEstimate(problem, loss, x, r, sigma, gap <= OPTIMAL, count, gap)


def _cone_program(problem: Design) -> tuple[Array, Array, int]:
    """z, the optimal λ and the solver's steps, from least squares on in units of its residual."""
    import cvxpy as cp

    start, _ = _least_squares(problem)
    first = problem.residual(start)
    unit = max(float(np.abs(first).mean()), problem.floor)
    dz, e = cp.Variable(problem.p), cp.Variable((problem.n, problem.size))
    left = cp.reshape(first / unit - problem.Q @ dz, e.shape, order="C")
    total = cp.sum(cp.abs(e)) if problem.size == 1 else cp.sum(cp.norm(e, 2, axis=1))
    solved = cp.Problem(cp.Minimize(total), [e == left])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the accuracy, which the gap tells
        solved.solve(
            solver=cp.CLARABEL, accept_unknown=True,
            tol_gap_abs=ACCURATE, tol_gap_rel=ACCURATE, tol_feas=ACCURATE,
        )  # fmt: skip
    dual = -np.asarray(solved.constraints[0].dual_value).ravel()
    return start + unit * np.asarray(dz.value), dual, int(solved.solver_stats.num_iters or 0)


def _descended(problem: Design, z: Array) -> Array:
    """z with the digits that the cone program leaves open, by steps of weights 1/|e_i| while
    Σ |e_i| falls: through observations that are met exactly, where it has a kink."""
    r = problem.residual(z)
    for _ in range(MOST_STEPS):
        length = np.maximum(lengths(r, problem.size), problem.floor)
        root = problem.rows(1 / np.sqrt(length))
        trial = z + least_norm(problem.Q * root[:, None], r * root)
        residual = problem.residual(trial)
        if not lengths(residual, problem.size).sum() < length.sum():
            break
        z, r = trial, residual
    return z


# Robust fit of the nonlinear model: linear robust steps on the exact B.

LossName = Literal["huber", "tukey", "l1", "student-t"]

SETTLED = 1e-7  # |B δx| in units of the scale at which the steps have converged
MOST_MOVES = 40
SEARCHES = 2  # steps of tukey that begin with trimmed squares; later ones at the last fit


@dataclass(frozen=True)
class RobustFit:
    """x (parameters,), raw and whitened residual (rows,), and the robust estimate of the `linear`
    model at x, whose step is negligible."""

    x: Array
    residual: Array
    whitened: Array
    linear: RobustEstimate
    converged: bool
    steps: int


def robust_fit(problem: FitProblem, loss_name: LossName = "tukey", seed: int = 0) -> RobustFit:
    """Minimise Σ ρ(|W (y − h(X))_i|/σ) over X[columns] by damped Gauss–Newton steps.

    Each step is the robust linear fit of the whitened residual to the whitened B at X: "huber"
    (95 % efficient, σ by the median), "tukey", "l1", or "student-t" (ML, ν estimated); it is
    halved until Σ ρ at the step's σ falls.  The rows of an observation share a weight; `seed` is
    that of the trimmed squares with which tukey begins.

    Whitening by a covariance that couples observations (deflections that share an unloaded
    reading) mixes them: a bad reading then also shows in those whitened after it.

    Raises InputError for a problem with ties or bounds, or dependent columns; ElastocalError
    where the start has poses without equilibrium.
    """
    require(
        problem.tie is None and not problem.bounded,
        "a robust fit takes neither ties nor bounds: fit the reduced set of parameters, unbounded",
    )
    model, observed, columns = problem.model, problem.observations, problem.columns
    sizes, size = problem.sizes[columns], problem.observations.size
    x, steps = problem.x.copy(), 0

    def linearised(x: Array) -> tuple[Array, Array, Array]:
        at = model.regressor(observed.table, x, columns, observed)
        return problem.weights.apply(at.B), problem.weights.apply(at.residual), at.residual

    B, e, raw = linearised(x)
    while True:
        found = _step(B * sizes, e, loss_name, size, seed if steps < SEARCHES else None)
        moved = float(np.linalg.norm(B @ (found.x * sizes)))
        converged = moved <= SETTLED * found.scale * np.sqrt(len(columns))
        share = 0.0 if converged or steps == MOST_MOVES else _damping(problem, x, found, e)
        if share == 0.0:
            break
        x[columns] += share * found.x * sizes
        B, e, raw = linearised(x)
        steps += 1
    return RobustFit(x, raw, e, _step(B, e, loss_name, size, None), converged, steps)


def _step(B: Array, e: Array, loss_name: LossName, size: int, seed: int | None) -> RobustEstimate:
    if loss_name == "student-t":
        return student_t(B, e, size=size)
    if loss_name != "tukey":
        return m_estimate(B, e, huber(size) if loss_name == "huber" else Absolute(size), size=size)
    here = tukey(B, e, size=size, start=np.zeros(B.shape[1]))
    if seed is None:
        return here
    return min(here, tukey(B, e, size=size, seed=seed), key=lambda found: found.scale)


def _damping(problem: FitProblem, x: Array, found: RobustEstimate, e: Array) -> float:
    """Largest of 1, ½, ¼, … of the step that lowers Σ ρ at its scale; 0 where none does."""
    size, observed, columns = found.design.size, problem.observations, problem.columns
    before = float(found.loss.rho(lengths(e, size) / found.scale).sum())
    for share in 0.5 ** np.arange(20):
        trial = x.copy()
        trial[columns] += share * found.x * problem.sizes[columns]
        try:
            residual = observed.value - problem.model.predict(observed.table, trial, observed)
        except ElastocalError:
            continue
        d = lengths(problem.weights.apply(residual), size) / found.scale
        if np.isfinite(d).all() and found.loss.rho(d).sum() <= before * (1 + 1e-12):
            return float(share)
    return 0.0


# Covariance of an M-estimate: from ψ and ψ′, never from the weights of its iteration.
#
# With r_i = e_i/σ, Ψ(r) = ψ(|r|) r/|r| and u = r/|r| the derivative of an observation's score is
#
#     J_i = ∂Ψ/∂r = ψ′(d_i) u uᵀ + (ψ(d_i)/d_i)(I − u uᵀ),      d_i = |r_i|,
#
# eigenvalue ψ′ along the error and ψ/d across it (size − 1 times; for size 1 only ψ′).  Expanding
# Σ B_iᵀ Ψ(e_i/σ) = 0 gives x̂ − x ≈ σ W⁻¹ Σ B_iᵀ Ψ_i, W = Σ B_iᵀ J_i B_i, and for errors that are
# symmetric in direction E J = a I, E ΨΨᵀ = b I,
#
#     cov x̂ = σ² (b/a²) (BᵀB)⁻¹        (Huber 1981, sections 7.6 and 7.10, per row; Maronna 1976)
#
# The weights ψ/d as inverse variances would be wrong: a weight is small because that residual came
# out large, not because its variance was known to be.

UNDETERMINED = (
    "the loss rejects so many observations that the rest do not determine the parameters' "
    "covariance; use a monotone loss such as huber, or look for the cause of the outliers"
)
EXACT = 1e-8  # scaled length below which an L1 fit passes through an observation


def asymptotic_covariance(found: RobustEstimate) -> Covariance:
    """Covariance (p, p) of x̂; t intervals with the rows that keep a weight less p as dof.

    Huber's H2, k σ² (b̂/â) W⁻¹, with â the mean eigenvalue of J_i, b̂ = Σψ²/(n·size − p), and his
    small-sample factor k = 1 + (p/(n·size)) Var(eigenvalues)/â² (k = 1 for L1).  Unlike his H1 and
    H3 it leaves wrong observations at leverage points out of b̂/â and of W alike.  Under dependence
    or unequal spread use `clustered_covariance`.

    Raises InsufficientDataError where W is not positive definite.
    """
    problem, (along, across) = found.design, _curvature(found)
    rows, p, size = len(problem.y), problem.p, problem.size
    a = float(np.mean(along + (size - 1) * across)) / size
    if not a > 0:
        raise InsufficientDataError(UNDETERMINED)
    b = float((found.loss.psi(found.distance) ** 2).sum()) / (rows - p)
    k = 1.0
    if not isinstance(found.loss, Absolute):
        square = float((along**2).sum() + (size - 1) * (across**2).sum()) / rows
        k = 1 + p / rows * (square - a**2) / a**2
    W = _information(found, np.zeros(problem.n, dtype=np.int64))[0]
    inner = k * found.scale**2 * b / a * _inverse_of(W)
    matrix = problem.V @ inner @ problem.V.T
    dof = float(size * np.count_nonzero(found.weights) - p)
    text = f"asymptotic covariance H2 of the {found.loss.name} estimate, from ψ and ψ′"
    return Covariance("H2", matrix, np.full(p, dof), text)


def clustered_covariance(found: RobustEstimate, cluster: ArrayLike) -> Covariance:
    """Covariance (p, p) of x̂ under any dependence within clusters, with t dofs (p,).

    `cluster` (n,) integer label of each observation, such as its configuration.  Leaving cluster
    g out moves x̂ by δ_g = σ (W − W_g)⁻¹ s_g to first order, with the scores s_g = Σ_{i∈g} B_iᵀΨ_i
    and W_g = Σ_{i∈g} B_iᵀ J_i B_i; the jackknife of these (CR3 of Bell and McCaffrey 2002 for the
    M-estimate's score),

        cov x̂ = (G − 1)/G Σ_g δ_g δ_gᵀ,

    needs no model of the dependence, and dividing by W − W_g undoes that a fit follows its own
    clusters.  dof are Satterthwaite's under independence, (tr T)²/tr T² with the quadratic form
    T of each parameter: few clusters, or few that see a parameter, have few.

    Raises InputError for labels of the wrong shape or a single cluster, InsufficientDataError
    where without one cluster the others do not determine every parameter.
    """
    labels, problem = np.asarray(cluster), found.design
    require(
        labels.shape == (problem.n,),
        f"cluster must hold one label per observation, ({problem.n},); found {labels.shape}",
    )
    names, code = np.unique(labels, return_inverse=True)
    require(len(names) > 1, "a clustered covariance needs at least two clusters; found one")
    W_g = _information(found, code)
    W = W_g.sum(axis=0)
    inverse, rest = _inverse_of(W), W - W_g
    lowest = np.linalg.eigvalsh(rest)[:, 0]
    alone = np.flatnonzero(lowest <= 1e-9 * np.linalg.eigvalsh(W)[-1])
    if alone.size:
        raise InsufficientDataError(
            f"without cluster {names[alone[0]]} the others do not determine every parameter, so "
            "its scatter cannot be judged; measure more such configurations or fit fewer parameters"
        )
    psi = (problem.rows(found.weights) * found.residual / found.scale)[:, None] * problem.Q
    scores = np.zeros((len(names), problem.p))
    np.add.at(scores, np.repeat(code, problem.size), psi)
    shift = found.scale * np.linalg.solve(rest, scores[..., None])[..., 0] @ problem.V.T
    matrix = (len(names) - 1) / len(names) * shift.T @ shift
    text = f"jackknife of the {found.loss.name} scores over {len(names)} clusters"
    # T = diag(own) − K with K_gh = m_gᵀ W⁻¹ m_h, never formed: there may be thousands of clusters.
    reach = np.linalg.solve(rest, np.broadcast_to(problem.V.T, rest.shape))  # by parameter
    m = W_g @ reach
    sums = SatterthwaiteSums(problem.p)
    sums.add(np.einsum("gij,gij->gj", reach, m), linalg.cholesky(inverse) @ m)
    return Covariance("clustered", matrix, sums.dof(), text)


def _curvature(found: RobustEstimate) -> tuple[Array, Array]:
    """Eigenvalues of every J_i: ψ′ along the error (n,) and ψ/d across it (n,).

    ψ of L1 jumps at zero: for size 1 ψ′ = 2 f(0) is estimated from the density of the residuals
    there, by the Siddiqui quotient with Hall and Sheather's bandwidth, without the p residuals that
    the fit makes zero (Koenker 2005, section 3.4); for vectors ψ′ = 0 and ψ/d = 1/d suffice,
    without observations that are met exactly.
    """
    d, loss = found.distance, found.loss
    if not isinstance(loss, Absolute):
        return loss.slope(d), loss.weight(d)
    if loss.size > 1:
        return np.zeros_like(d), np.divide(1, d, out=np.zeros_like(d), where=d >= EXACT)
    r = found.residual / found.scale
    kept = np.sort(r[np.argsort(d)[found.design.p :]])
    h = len(kept) ** (-1 / 3) * special.ndtri(0.975) ** (2 / 3)
    h = min(h * (1.5 / (2 * np.pi)) ** (1 / 3), 0.49)
    low, high = np.quantile(kept, [0.5 - h, 0.5 + h])
    level = np.full_like(d, 4 * h / max(high - low, np.finfo(float).tiny))
    return level, level


def _information(found: RobustEstimate, code: IntArray) -> Array:
    """Σ Q_iᵀ J_i Q_i (groups, p, p) per group `code` (n,) of the observations."""
    problem, (along, across) = found.design, _curvature(found)
    size, p, n = problem.size, problem.p, problem.n
    Q3, r = problem.Q.reshape(n, size, p), found.residual.reshape(n, size)
    u = r / np.maximum(np.linalg.norm(r, axis=1), np.finfo(float).tiny)[:, None]
    toward = np.einsum("nij,ni->nj", Q3, u)
    order = np.argsort(code, kind="stable")
    total = []
    for chosen in np.split(order, np.flatnonzero(np.diff(code[order])) + 1):
        rows, excess = Q3[chosen].reshape(-1, p), (along - across)[chosen]
        within = (rows.T * np.repeat(across[chosen], size)) @ rows
        total.append(within + (toward[chosen].T * excess) @ toward[chosen])
    return np.array(total)


def _inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix.

    Raises InsufficientDataError where it is not: the data left after rejection do not determine
    all parameters.
    """
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix), np.eye(len(matrix))))
    except linalg.LinAlgError:
        raise InsufficientDataError(UNDETERMINED) from None
