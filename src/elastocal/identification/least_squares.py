"""Nonlinear weighted least squares on the exact B, with what else is known of the parameters:

    |W (y − h(X))|² + |target − P X|²   over X[columns],   lower ≤ X ≤ upper,  A X = b,  M(X) ⪰ 0

A weak tie to the start, the prior of random coefficients and stated knowledge are all of them rows
P; every fit is the same descent by Levenberg and Marquardt on R factors.  Then the covariance of
its estimates, under different assumptions on the errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from elastocal.identification.constrained import minimise
from elastocal.identification.knowledge import System
from elastocal.identification.weighted_problem import (
    Evaluation,
    Problem,
    RFactor,
    least_norm,
    same_size,
)
from elastocal.messages import ElastocalError, InputError, InsufficientDataError
from elastocal.units import Array, IntArray

SETTLED = "the sum of squares no longer fell"
NEGLIGIBLE = "the steps became negligible"
EXHAUSTED = "the step limit was reached; the start may be far off or the data ill-conditioned"

LEAST_DAMPING = 1e-18  # of the largest squared column, once a full step has failed
SHORTER = 0.3
ROUNDING = 1e-12  # relative: what separates two evaluations at the minimum


# What a step promises of the cost where a descent ends.  The last step is taken: at a million rows
# it is a tenth of a standard deviation, and what it leaves behind is smaller by orders.
TOLERANCE = 1e-8


@dataclass(frozen=True)
class PriorRows:
    """What a fit knows of its columns besides the readings: P (k, columns) and target (k,) with
    |target − P X|² beside whitened rows, and constraints on them."""

    P: Array
    target: Array
    system: System | None = None

    @classmethod
    def near(cls, centre: Array, width: Array) -> PriorRows:
        """X ~ N(centre, width²) in units of the noise, (columns,) each."""
        return cls(np.diag(1 / width), centre / width)

    def restricted(self, columns: IntArray, x: Array) -> PriorRows:
        """What it says of the `columns`, the others held at x.  Raises InputError where these alone
        break a constraint."""
        held = moved(x, columns, -x[columns])
        system = None if self.system is None else self.system.restricted(columns, x)
        return PriorRows(self.P[:, columns], self.target - self.P @ held, system)


@dataclass(frozen=True)
class Fit:
    """Values x (parameters,), raw residual (rows,), R factor of whitened B and residual.

    `columns` (fitted,) index the parameters; `known` is what the fit knew of them.
    """

    x: Array
    residual: Array
    r_factor: RFactor
    converged: bool
    reason: str
    problem: Problem = field(repr=False)
    columns: NDArray[np.int64]
    known: PriorRows

    @cached_property
    def B(self) -> Array:
        """B (rows, fitted) at x, raw.  Formed on demand: of a large table, use `r_factor`."""
        observed = self.problem.observations
        return self.problem.model.regressor(observed.table, self.x, self.columns, observed).B

    @cached_property
    def whitened(self) -> Array:
        """The whitened residual (rows,)."""
        return self.problem.weights.apply(self.residual)

    @cached_property
    def of_free(self) -> RFactor:
        """The R factor of all free columns at x."""
        problem = self.problem
        if np.array_equal(self.columns, problem.free):
            return self.r_factor
        return problem.evaluate(self.x, problem.free).r_factor

    def cofactor(self) -> Array:
        """(BᵀW²B)⁻¹ (fitted, fitted): covariance at unit variance (eq. 7 and 13)."""
        size = self.problem.sizes[self.columns]
        inverse = self.r_factor.scaled(size).half
        return (inverse @ inverse.T) * np.outer(size, size)


class Objective:
    """|e(u)|² + |target − P u|² under the `limits` on u, where X[columns] = x[columns] + size · u
    and the other parameters are x (parameters,)."""

    def __init__(
        self, problem: Problem, columns: IntArray, x: Array, size: Array, known: PriorRows
    ) -> None:
        self.problem, self.columns, self.x, self.size = problem, columns, x, size
        self.P, self.target = known.P * size, known.target - known.P @ x[columns]
        self.system = known.system
        self.limits = None if self.system is None else self.system.moved(x[columns], size)

    def evaluate(self, u: Array) -> Evaluation:
        """e, and the R factor of it and of B per unit of u; ElastocalError where the model has no
        prediction."""
        problem = self.problem
        at = problem.evaluate(self.values(u), self.columns)
        if not np.isfinite(at.r_factor.rss):
            raise ElastocalError(
                f"{problem.observations.table.source}: the model predicts no finite numbers at the "
                "start values; look in the cell for a length, force or compliance far too large"
            )
        return replace(at, r_factor=at.r_factor.scaled(self.size))

    def values(self, u: Array) -> Array:
        """X (parameters,), what lies at its bound but for rounding on it."""
        values, system = moved(self.x, self.columns, self.size * u), self.system
        if system is not None:
            own = values[self.columns]
            for bound in (system.lower, system.upper):
                own = np.where(np.abs(own - bound) <= ROUNDING * self.size, bound, own)
            values[self.columns] = np.clip(own, system.lower, system.upper)
        return values

    def rows(self, u: Array, at: Evaluation) -> tuple[Array, Array]:
        """A and b of the linearised cost |b − A step|²."""
        rows = at.r_factor.augmented
        A, b = np.vstack([rows[:, :-1], self.P]), self.target - self.P @ u
        return A, np.concatenate([rows[:, -1], b])

    def cost(self, u: Array, at: Evaluation) -> float:
        return at.r_factor.rss + float(np.sum((self.target - self.P @ u) ** 2))

    def step(self, u: Array, at: Evaluation, damping: float) -> tuple[Array, float]:
        """Minimiser of the linearised cost + damping · |step|², and by how much the cost falls."""
        p, (A, b) = len(u), self.rows(u, at)
        damped, target = np.vstack([A, np.sqrt(damping) * np.eye(p)]), np.append(b, np.zeros(p))
        if self.limits is None:
            cond = max(at.r_factor.rows, p) * np.finfo(float).eps
            step = least_norm(damped, target, cond=cond)
        else:
            step = minimise(damped, target, self.limits.moved(u, np.ones(p))).x
        left = b - A @ step
        return step, float(b @ b - left @ left)

    def descend(self, u: Array, tolerance: float, most: int) -> tuple[Array, Evaluation, str]:
        """Full Gauss–Newton steps while they lower the cost, damped ones where they do not: where
        they end, and why.

        Ends where the linearised cost promises less than `tolerance` of itself: that last step is
        still taken, and leaves an error smaller than itself by the factor with which Gauss–Newton
        converges.  Steps are judged by the cost itself, so no rounding of it can keep it from
        ending.
        """
        at = self.evaluate(u)
        cost, damping = self.cost(u, at), 0.0
        failed = -1.0  # the damping that was too little a step ago
        for _ in range(most - 1):
            step, promised = self.step(u, at, damping)
            last, small = promised <= tolerance * cost, np.abs(step).max(initial=0.0) <= ROUNDING
            if last and small:
                return u, at, NEGLIGIBLE
            try:
                trial = self.evaluate(u + step)
                trial_cost = self.cost(u + step, trial)
            except ElastocalError:
                trial, trial_cost = at, np.inf
            if last and (damping == 0 or failed >= 0):  # more than what is left is not to be had
                kept = trial_cost <= cost * (1 + ROUNDING)
                return (*((u + step, trial) if kept else (u, at)), SETTLED)
            if cost - trial_cost > 1e-4 * promised:
                u, at, cost = u + step, trial, trial_cost
                less = damping / 10 if damping > LEAST_DAMPING * _steepest(at) else 0.0
                damping, failed = (damping, failed / 100) if less <= failed else (less, failed)
            elif small:
                return u, at, NEGLIGIBLE
            else:
                failed, damping = damping, self._shortened(u, at, damping, step)
        return u, at, EXHAUSTED

    def _shortened(self, u: Array, at: Evaluation, damping: float, step: Array) -> float:
        """The damping with which a step that failed has at most SHORTER of its length."""
        longest = SHORTER * float(np.linalg.norm(step))
        damping = max(10 * damping, LEAST_DAMPING * _steepest(at))
        while np.linalg.norm(self.step(u, at, damping)[0]) > longest:
            damping *= 10
        return damping


def _steepest(at: Evaluation) -> float:
    return float((at.r_factor.R**2).sum(axis=0).max(initial=0.0))


def moved(x: Array, columns: IntArray, step: Array) -> Array:
    out = x.astype(float)
    out[columns] += step
    return out


def fit(
    problem: Problem, columns: IntArray, x: Array, *, known: PriorRows | None = None,
    max_steps: int = 60, tolerance: float = TOLERANCE,
) -> Fit:  # fmt: skip
    """min over X[columns] of |W (y − h(X))|² (eq. 9, nonlinear) with what is `known` of them, the
    other parameters held at x, by Levenberg–Marquardt from there, derivatives exact.

    On R factors, with the cost and the gradient of all rows, until a step promises less than
    `tolerance` of the cost.  Every step starts from the residual of the exact model, so that the
    rounding of one is taken back by the next.  Constraints are convex and kept in every step: where
    none improves the fit, the conditions of Karush, Kuhn and Tucker hold.

    Raises ElastocalError where the start has poses without equilibrium, InputError for constraints
    that contradict each other, InsufficientDataError where they leave something undetermined.
    """
    size, u = problem.sizes[columns], np.zeros(len(columns))
    known = known or PriorRows(np.zeros((0, len(u))), np.zeros(0))
    objective = Objective(problem, columns, x, size, known)
    if objective.limits is not None:  # the nearest that is allowed
        u = minimise(np.eye(len(u)), u, objective.limits).x
    u, at, reason = objective.descend(u, tolerance, max_steps)
    return Fit(
        objective.values(u), at.residual, at.r_factor.scaled(1 / size), reason != EXHAUSTED, reason,
        problem, columns, known,
    )  # fmt: skip


# An estimated covariance of a fit, and the t intervals that follow from it.

LEVEL = 0.95


@dataclass(frozen=True)
class Covariance:
    """Covariance (p, p) of x̂ in the squared units of the parameters, with t degrees of freedom.

    `dof` (p,) belongs to the variance of each parameter on its own: infinite where the variance
    is known, 0 where the estimator cannot tell it (the interval is then unbounded).  The interval
    of a combination Cx needs its own dof: pass B C⁻¹ to the estimator, whose result then refers
    to Cx.  `among`: where it is the mean of covariances under several models, their weights and
    matrices; `dof` then is that of `tails`.  `ends` (p, 2): the 95 % intervals where they are not
    those of t.
    """

    kind: str
    matrix: Array
    dof: Array
    description: str
    among: tuple[tuple[float, Array], ...] = ()
    ends: Array | None = None

    @property
    def std(self) -> Array:
        """Standard deviations (p,); infinite where `dof` is 0."""
        return np.where(self.dof > 0, np.sqrt(np.diag(self.matrix)), np.inf)

    @property
    def correlation(self) -> Array:
        """ρ (p, p), zeros for a value that equalities fix."""
        return correlations(self.matrix)[0]

    def tails(self, rows: Array) -> tuple[Array, Array]:
        """Degrees of freedom (n,) of `variance_of` the combinations rows (n, k, p), which a typical
        parameter has, and the share (n,) of that variance which is the squared scale of t.

        Where it is a mean over models, of weights w and variances v_m, normal errors mixed in these
        shares have the variance v = Σ w v_m and the kurtosis 3 (1 + 2 x), x = Σ w (v_m − v)²/2v².
        The same two has t with f = 4 + 1/x degrees of freedom and the squared scale v (f − 2)/f;
        with v itself for the latter, what the models differ by would count twice.
        """
        typical = float(np.median(self.dof)) if len(self.dof) else np.inf
        v = np.maximum(variance_of(rows, self.matrix), 1e-300)
        parts = (w * (variance_of(rows, matrix) / v - 1) ** 2 / 2 for w, matrix in self.among)
        x = sum(parts, np.zeros(len(v)))
        unsure = 1 / max(typical, 1e-300) + x / (1 + 4 * x)
        dof = np.divide(1, unsure, out=np.full(len(x), np.inf), where=unsure > 0)
        return dof, (1 + 2 * x) / (1 + 4 * x)

    def interval(self, x: Array, level: float = LEVEL) -> Array:
        """x_j ± t_{dof_j}((1 + level)/2) · std_j as (p, 2), for the estimate x (p,); std_j by the
        share of `tails`.  At 95 % the `ends` where there are any."""
        if self.ends is not None and level == LEVEL:
            return self.ends
        share = self.tails(np.eye(len(x))[:, None])[1] if self.among else 1.0
        half = t_quantile(level, self.dof) * self.std * np.sqrt(share)
        return np.column_stack([x - half, x + half])


def variance_of(rows: Array, covariance: Array) -> Array:
    """tr(A_i C A_iᵀ) (n,), the variances of all combinations A_i of rows (n, k, p) together."""
    return np.asarray(((rows @ covariance) * rows).sum(axis=(1, 2)))


def root_of(covariance: Array) -> Array:
    """L (…, p, p) with L Lᵀ = covariance, which may be singular."""
    value, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(value, 0.0))[..., None, :])


def correlations(covariance: Array) -> tuple[Array, Array]:
    """ρ (p, p) and the deviations (p,), 1 of what does not vary, which correlates with nothing."""
    unit = np.sqrt(np.diag(covariance))
    unit = np.where(unit > 0, unit, 1.0)
    return covariance / np.outer(unit, unit), unit


def drawing_root(covariance: Array) -> Array:
    """L (p, p) with L Lᵀ = covariance, for draws: triangular, since alike eigenvalues turn their
    axes, and the draws with them, by their last digits; by way of correlations, since the rounding
    of large variances would drown small ones.  What does not vary is not drawn."""
    rho, unit = correlations(covariance)
    lower = np.asarray(np.linalg.qr(root_of(rho).T, mode="r")).T
    return np.asarray(unit[:, None] * lower * np.where(np.diag(lower) < 0, -1, 1))


def t_quantile(level: float, dof: Array) -> Array:
    """Two-sided quantile of t with `dof`, at any shape: P(|t| ≤ quantile) = level; infinite at
    dof 0."""
    p, few = (1 + level) / 2, np.where((dof > 0) & np.isfinite(dof), dof, 1.0)
    t = np.where(np.isinf(dof), special.ndtri(p), special.stdtrit(few, p))
    return np.where(dof > 0, t, np.inf)


# Orthogonal factors of B, in which every covariance estimator of this package works.

EPS = float(np.finfo(np.float64).eps)


def orthogonal(B: Array) -> tuple[Array, Array]:
    """Of the whitened B (rows, p) Q (rows, p) with QᵀQ = I and V (p, p) with x̂ = V Qᵀy and
    V Vᵀ = (BᵀB)⁻¹.

    Any sandwich (BᵀB)⁻¹ BᵀΩB (BᵀB)⁻¹ is V (QᵀΩQ) Vᵀ: BᵀB, whose condition is that of B squared,
    is never formed.  Row j of V is the coefficient of parameter j on the columns of Q.

    Raises InputError where the columns depend on each other, InsufficientDataError where there are
    no more rows than parameters.
    """
    rows, p = B.shape
    if rows <= p:
        raise InsufficientDataError(
            f"{rows} rows leave no residual of {p} parameters to estimate a variance from;"
            " measure more configurations or fit fewer parameters"
        )
    lengths = np.linalg.norm(B, axis=0)
    lengths[lengths == 0] = 1.0
    Q, R, order = linalg.qr(B / lengths, mode="economic", pivoting=True)
    pivots = np.abs(np.diag(R))
    dependent = np.flatnonzero(pivots <= rows * EPS * pivots[0])
    if dependent.size:
        names = sorted(int(k) for k in order[dependent])
        raise InputError(f"columns {names} of B depend on the others; drop them first")
    V = np.empty((p, p))
    V[order] = linalg.solve_triangular(R, np.eye(p)) / lengths[order, None]
    return Q, V


# Satterthwaite degrees of freedom of variance estimates that are sums of squares.
#
# A sandwich estimate of var(x̂_j) is v_j = Σ_c (a_cᵀ e_c)², with e = (I − QQᵀ)u and one vector a_c
# per cluster.  Under the working model u ~ N(0, σ²I) the numbers a_cᵀe_c have covariance
# σ²Γ, Γ = diag(a_cᵀa_c) − b bᵀ with rows b_c = Q_cᵀa_c, and v_j has the mean σ² tr Γ and the
# variance 2σ⁴ tr Γ².  A scaled χ² with the same two moments has
#
#     dof_j = (tr Γ)² / tr Γ²
#
# (Satterthwaite 1946; Bell & McCaffrey 2002; Pustejovsky & Tipton 2018).  With
#
#     tr Γ = Σ_c (a_cᵀa_c − |b_c|²),   tr Γ² = Σ_c [(a_cᵀa_c)² − 2 a_cᵀa_c |b_c|²] + ‖Σ_c b_c b_cᵀ‖²
#
# only p-dimensional quantities are summed over clusters; neither Γ nor I − QQᵀ is formed.

# Cluster-robust covariance: rows of a cluster may be correlated in any way (CR0 to CR3).
#
# A cluster is what shares an error: the readings of one configuration share the arm's
# repeatability, those of one day its temperature.  With B = QR, cluster rows Q_c, e_c and x̂ = V
# Qᵀy,
#
#     cov(x̂) = V [ Σ_c Q_cᵀA_c e_c e_cᵀA_cᵀQ_c ] Vᵀ
#
#     CR0  A_c = I                               Liang & Zeger 1986
#     CR1  CR0 · G/(G − 1) · (n − 1)/(n − p)     the usual correction for G clusters
#     CR2  A_c = (I − Q_cQ_cᵀ)^(−1/2)            Bell & McCaffrey 2002: unbiased where whitened rows
#                                                are independent and of common variance
#     CR3  A_c = (I − Q_cQ_cᵀ)^(−1)              nearly the jackknife over clusters, errs wide
#
# The working model of CR2 and of the degrees of freedom is the identity: B and e are whitened.
#
# Where every row is a cluster, rows are independent, each of its own variance: with the leverage
# h_i = |Q_i|², CR0 to CR3 are then HC0 (White 1980), HC1, HC2, HC3 (MacKinnon and White 1985).

ALONE = 1e-9  # 1 − leverage below which a cluster is fitted exactly, whatever was read there
ENTRIES = 2**22  # of a temporary array, 32 MB
DEPENDS = 1e-6  # share of a parameter in such a direction above which it depends on it

DESCRIPTION = {
    "CR0": "uncorrected (biased low with few clusters)",
    "CR1": "corrected by G/(G − 1) · (n − 1)/(n − p)",
    "CR2": "bias-reduced, unbiased under the working model",
    "CR3": "nearly the jackknife over clusters",
    "HC0": "e² as it is (biased low in small samples)",
    "HC1": "e² · n/(n − p)",
    "HC2": "e²/(1 − h), unbiased under equal variances",
    "HC3": "e²/(1 − h)², nearly the jackknife",
}


Rows = tuple[Array, Array, IntArray]  # Q_c and e_c of whole clusters, and the cluster of each


def clustered(parts: Iterable[Rows], V: Array, kind: str) -> Covariance:
    """Covariance of x̂ that allows any correlation within a cluster (equations above), of rows in
    parts, Q = B V with V Vᵀ = (BᵀB)⁻¹ and e = y − B x̂ the least-squares residual, whitened; HC0
    to HC3 are the CR where every row is a cluster, with n − p degrees of freedom for HC0 and HC1.

    Where a cluster alone determines a direction, I − Q_cQ_cᵀ is singular: CR2 takes the
    generalised inverse square root, which leaves parameters outside that direction unbiased
    (there, Theorem 1).  A parameter that depends on it has no cluster-robust variance: its dof
    is 0 and its interval unbounded.  CR3 does not exist then: InsufficientDataError, as for a
    single cluster.

    Cost: n p² + G p³ operations and 32 MB of temporaries; nothing of size n² is formed.

    Degrees of freedom by Satterthwaite for every kind, each for its own A_c (Pustejovsky & Tipton
    2018); at most G, or G − 1 for CR0 and CR1, whose scores sum to zero over the clusters, and far
    fewer where few clusters matter.
    """
    p, n, G = len(V), 0, 0
    meat, outer, alone = np.zeros((p, p)), np.zeros((p, p, p)), np.zeros(p, dtype=bool)
    lone: list[int] = []
    size, trace, square = np.zeros((3, p))  # Σ aᵀa, tr Γ and tr Γ²
    for Q, e, cluster in parts:
        n, G = n + len(e), G + len(np.unique(cluster))
        # Clusters of one size, in blocks of bounded memory.
        of_one_size = ((own, len(own) * p * max(own.shape[1], p)) for own in same_size(cluster))
        for rows in (b for own, n in of_one_size for b in np.array_split(own, -(-n // ENTRIES))):
            Qc = Q[rows]
            adjusted, determined = _adjusted(Qc, kind)
            lone += cluster[rows[determined][:1, 0]].tolist()
            # A parameter may depend on a direction that one of the clusters determines alone.
            values, U = np.linalg.eigh(Qc[determined].transpose(0, 2, 1) @ Qc[determined])
            share = (V @ U) / np.linalg.norm(V, axis=1)[:, None]
            in_it = (np.abs(share) > DEPENDS) & (1 - values < ALONE)[:, None, :]
            alone |= in_it.any(axis=(0, 2))
            scores = (e[rows][:, None, :] @ adjusted)[:, 0]
            meat += scores.T @ scores
            a = adjusted @ V.T
            # In this order of axes BLAS multiplies b; in others numpy does, three times slower.
            aa, b = (a * a).sum(axis=1), a.transpose(0, 2, 1) @ Qc
            bb, by_parameter = np.einsum("cjp,cjp->cj", b, b), b.transpose(1, 0, 2)
            size, trace = size + aa.sum(axis=0), trace + (aa - bb).sum(axis=0)
            square = square + (aa * (aa - 2 * bb)).sum(axis=0)
            outer += by_parameter.transpose(0, 2, 1) @ by_parameter
    if G < 2:
        raise InsufficientDataError(
            "a cluster-robust covariance compares clusters, but all rows are in one;"
            " measure more configurations, or use a covariance of independent rows (HC3)"
        )
    of_rows, number = kind[0] == "H", kind[-1]
    if lone and number == "3":
        what, left = ("row", "HC") if n == G else ("cluster", "CR")
        raise InsufficientDataError(
            f"{what} {lone[0]} alone determines a combination of the parameters: leaving it out, "
            f"as {left}3 does, leaves no answer; fit fewer parameters or use {left}2"
        )
    if number == "1":
        meat *= G / (G - 1) * (n - 1) / (n - p)
    what = "each row its own variance" if of_rows else f"rows correlated within {G} clusters"
    text = f"{what}, {DESCRIPTION[kind]}"
    if alone.any() and not of_rows:
        text += f"; parameters {np.flatnonzero(alone).tolist()} hang on a single cluster"
    square = square + (outer**2).sum(axis=(1, 2))
    told = (trace > 1e-9 * size) & (square > 0) & ~alone  # the residual says something of it
    dof = np.where(told, trace**2 / np.where(told, square, 1.0), 0.0)
    if kind in ("HC0", "HC1"):
        dof = np.full(p, float(n - p))
    return Covariance(kind, V @ ((meat + meat.T) / 2) @ V.T, dof, text)


def _adjusted(Qc: Array, kind: str) -> tuple[Array, NDArray[np.bool_]]:
    """A_cQ_c (k, size, p), and which of the k clusters determine a direction alone.

    For g(I − Q_cQ_cᵀ) Q_c = Q_c g(I − Q_cᵀQ_c) the smaller of the two is decomposed.
    """
    by_row = Qc.shape[1] < Qc.shape[2]
    gram = Qc @ Qc.transpose(0, 2, 1) if by_row else Qc.transpose(0, 2, 1) @ Qc
    values, U = np.linalg.eigh(gram)
    gap = 1 - values
    single = gap < ALONE
    determined = np.asarray(single.any(axis=1))
    if kind[-1] in "01":
        return Qc, determined
    power = np.where(single, 1.0, gap) ** (-0.5 if kind[-1] == "2" else -1.0)
    A = (U * np.where(single, 0.0, power)[:, None, :]) @ U.transpose(0, 2, 1)
    return (A @ Qc if by_row else Qc @ A), determined
