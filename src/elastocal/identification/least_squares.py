"""What a least-squares fit says of itself: the covariance of its estimates, under different
assumptions on the errors, and what it would predict of readings that had been left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from elastocal.identification.weighted_problem import Problem, Weights, same_size
from elastocal.measurements import numbered
from elastocal.messages import EXACT, InputError, InsufficientDataError
from elastocal.units import Array, BoolArray, IntArray

LEVEL = 0.95


@dataclass(frozen=True)
class Covariance:
    """Covariance (p, p) of x̂ in the squared units of the parameters, with t degrees of freedom.

    `dof` (p,) belongs to the variance of each parameter on its own: infinite where the variance is
    known, 0 where the estimator cannot tell it (the interval is then unbounded).  The interval of a
    combination Cx needs its own dof: pass B C⁻¹ to the estimator, whose result then refers to Cx.
    `among`: where it is the mean of covariances under several models, their weights and matrices;
    `dof` then is that of `tails`.  `ends` (p, 2): the 95 % intervals where they are not those of t.
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
        """x_j ± t_{dof_j}((1 + level)/2) · std_j as (p, 2), std_j by the share of `tails`; at 95 %
        the `ends` where there are any."""
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


DEPENDENT = 1e-10  # of a variance: what is less beside the others before it follows from these


def drawing_root(covariance: Array) -> Array:
    """L (p, p) with L Lᵀ = covariance, for draws: triangular, since alike eigenvalues turn their
    axes, and the draws with them, by their last digits; so would columns that follow from others.
    By way of correlations, since the rounding of large variances would drown small ones.  What does
    not vary is not drawn."""
    rho, unit = correlations(covariance)
    lower = np.zeros_like(rho)
    for k in range(len(rho)):
        left = rho[k:, k] - lower[k:, :k] @ lower[k, :k]
        if left[0] > DEPENDENT:
            lower[k:, k] = left / np.sqrt(left[0])
    return np.asarray(unit[:, None] * lower)


def t_quantile(level: float, dof: Array) -> Array:
    """P(|t| ≤ quantile) = level with `dof`, at any shape; infinite at dof 0."""
    p, few = (1 + level) / 2, np.where((dof > 0) & np.isfinite(dof), dof, 1.0)
    t = np.where(np.isinf(dof), special.ndtri(p), special.stdtrit(few, p))
    return np.where(dof > 0, t, np.inf)


# Orthogonal factors of B, in which every covariance estimator of this package works.

EPS = float(np.finfo(np.float64).eps)


def orthogonal(B: Array) -> tuple[Array, Array]:
    """Of the whitened B (rows, p) Q (rows, p) with QᵀQ = I and V (p, p) with x̂ = V Qᵀy,
    V Vᵀ = (BᵀB)⁻¹: any sandwich (BᵀB)⁻¹ BᵀΩB (BᵀB)⁻¹ is V (QᵀΩQ) Vᵀ, and BᵀB, whose condition is
    that of B squared, is never formed.  InputError where the columns depend on each other,
    InsufficientDataError where there are no more rows than parameters."""
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
POWERS = {"0": 0.0, "1": 0.0, "2": -0.5, "3": -1.0}  # of I − Q_cQ_cᵀ in A_c


Rows = tuple[Array, Array, NDArray[Any]]  # Q_c and e_c of whole clusters, and the cluster of each


def clustered(
    parts: Iterable[Rows],
    V: Array,
    kind: str,
    named: Callable[[Any], str] = "configuration {}".format,
) -> Covariance:
    """Covariance of x̂ that allows any correlation within a cluster (equations above), of rows in
    parts, Q = B V with V Vᵀ = (BᵀB)⁻¹ and e = y − B x̂ the least-squares residual, whitened; HC0 to
    HC3 are the CR where every row is a cluster, with n − p degrees of freedom for HC0 and HC1.

    Where a cluster alone determines a direction, I − Q_cQ_cᵀ is singular: CR2 takes the generalised
    inverse square root, which leaves parameters outside that direction unbiased (there, Theorem 1).
    A parameter that depends on it has dof 0 and an unbounded interval.  CR3 does not exist then:
    InsufficientDataError, as for a single cluster.

    Cost: n p² + G p³ operations; nothing of size n² is formed.  Degrees of freedom by
    Satterthwaite, each for its own A_c (Pustejovsky & Tipton 2018); at most G, or G − 1 for CR0 and
    CR1, whose scores sum to zero over the clusters, and far fewer where few clusters matter.
    """
    p, n, G = len(V), 0, 0
    meat, outer, alone = np.zeros((p, p)), np.zeros((p, p, p)), np.zeros(p, dtype=bool)
    lone: list[Any] = []
    size, trace, square = np.zeros((3, p))  # Σ aᵀa, tr Γ and tr Γ²
    of_rows, power = kind[0] == "H", POWERS[kind[-1]]
    for Q, e, cluster in parts:
        n, G = n + len(e), G + len(np.unique(cluster))
        # Clusters of one size, in blocks of bounded memory.
        of_one_size = ((own, len(own) * p * max(own.shape[1], p)) for own in same_size(cluster))
        for rows in (b for own, n in of_one_size for b in np.array_split(own, -(-n // ENTRIES))):
            Qc = Q[rows]
            adjusted, determined = adjusted_rows(Qc, power)
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
    if lone and power == -1:
        raise InsufficientDataError(
            f"{named(lone[0])} alone determines a combination of the parameters: leaving it out, "
            f"as {kind} does, leaves no answer; fit fewer parameters or use {kind[:2]}2"
        )
    if kind[-1] == "1":
        meat *= G / (G - 1) * (n - 1) / (n - p)
    what = "each row its own variance" if of_rows else f"rows correlated within {G} clusters"
    text = f"{what}, {DESCRIPTION[kind]}"
    square = square + (outer**2).sum(axis=(1, 2))
    told = (trace > 1e-9 * size) & (square > 0) & ~alone  # the residual says something of it
    dof = np.where(told, trace**2 / np.where(told, square, 1.0), 0.0)
    if kind in ("HC0", "HC1"):
        dof = np.full(p, float(n - p))
    return Covariance(kind, V @ ((meat + meat.T) / 2) @ V.T, dof, text)


def adjusted_rows(Qc: Array, power: float) -> tuple[Array, BoolArray]:
    """(I − Q_cQ_cᵀ)^power Q_c (k, size, p), and which of the k clusters determine a direction
    alone, along which it is zero.  The smaller side of g(I − Q_cQ_cᵀ) Q_c = Q_c g(I − Q_cᵀQ_c) is
    decomposed."""
    by_row = Qc.shape[1] < Qc.shape[2]
    gram = Qc @ Qc.transpose(0, 2, 1) if by_row else Qc.transpose(0, 2, 1) @ Qc
    values, U = np.linalg.eigh(gram)
    single = 1 - values < ALONE
    determined = np.asarray(single.any(axis=1))
    if not power:
        return Qc, determined
    factor = np.where(single, 0.0, np.where(single, 1.0, 1 - values) ** power)
    A = (U * factor[:, None, :]) @ U.transpose(0, 2, 1)
    return (A @ Qc if by_row else Qc @ A), determined


Crossed = tuple[Array, Array, Array]  # held-out residual, leverage, `share_left`, each (rows,)


def held_out_residual(
    B: Array, residual: Array, weights: Weights, configuration: IntArray, size: int
) -> Array:
    """Residual (rows,) of every configuration under the fit to all the others.

    With whitened B = QR and whitened residual e, leaving configuration c out moves the estimate by
    x̂ − x̂₍₋c₎ = R⁻¹ Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c, exactly for a linear model (Allen 1974, PRESS, by
    groups); the residual of c then grows by B_c times that, infinitely where it alone determines a
    parameter.  B (rows, columns) and residual (rows,) raw; `configuration` (observations,), `size`
    rows each.  Where all readings are correlated, as by a drift, those of `weights.together` are
    left out at a time.
    """
    rows, e = weights.beside_common(B, residual)
    Q, R = linalg.qr(rows, mode="economic")
    n, k = len(B), len(rows) - len(B)
    code = np.repeat(configuration if weights.together is None else weights.together, size)
    if k:
        # What all have in common are columns beside B, held by rows of their own that never go out;
        # what is predicted is without them.
        e = e - Q @ (Q.T @ e)
        B = np.pad(B, ((0, k), (0, k)))
        code = np.concatenate([code, code.max() + 1 + np.arange(k)])
    seen = np.asarray(linalg.solve_triangular(R, B.T, trans="T").T)
    return residual + growth(seen, Q, e, code)[:n]


def held_out_by_parts(
    problem: Problem, x: Array, columns: IntArray, half: Array, step: Array | None = None
) -> Crossed:
    """The same with the model linearised at x, a part at a time.
    `half` (columns, q) with half · halfᵀ the cofactor of the estimates: R⁻¹ of the whitened B, or
    the directions in which constraints let them move.  `step` (parameters,) is the Gauss–Newton
    step to the linear model's minimum, where x is not it."""
    held, leverage = np.empty((2, len(problem.observations.value)))
    left = np.broadcast_to(1.0, len(held)) if problem.large else np.empty(len(held))
    together, size = problem.weights.together, problem.observations.size

    def leave_out(part: Problem) -> None:
        at = part.regressor(x, columns)
        residual = at.residual
        if step is not None:
            moved = np.flatnonzero(step)
            residual = residual - part.regressor(x, moved).B @ step[moved]
        B = at.B @ half
        Q, e = part.weights.apply(B), part.weights.apply(residual)
        labels = part.observations.configuration if together is None else together
        held[part.rows] = residual + growth(B, Q, e, np.repeat(labels, size))
        leverage[part.rows] = np.minimum((Q**2).sum(axis=1), 1.0)
        if not problem.large:  # of which nobody asks it
            left[part.rows] = share_left(Q, np.repeat(part.observations.configuration, size))

    list(problem.each(leave_out))
    return held, leverage, left


def growth(B: Array, Q: Array, e: Array, configuration: IntArray) -> Array:
    """By how much (rows,) the residual grows where its configuration is left out; B are columns
    that are orthonormal as whitened ones, Q."""
    grown = np.empty(len(e))
    for rows, moved, alone in left_out(Q, e, configuration):
        grown[rows] = (B[rows] @ moved[..., None])[..., 0]
        grown[rows[alone]] = np.inf
    return grown


def left_out(
    Q: Array, e: Array, configuration: IntArray
) -> Iterator[tuple[IntArray, Array, BoolArray]]:
    """Rows (g, m) of configurations of one size, Q_cᵀ (I − Q_c Q_cᵀ)⁻¹ e_c (g, columns),
    meaningless where a configuration is alone in some direction, and which are."""
    for rows in same_size(configuration):
        Qc, Qt = Q[rows], Q[rows].transpose(0, 2, 1)
        # (I − Q_cᵀQ_c)⁻¹ Q_cᵀ is the same map, by a matrix of the parameters' size.
        many = rows.shape[1] > Q.shape[1]
        share = Qt @ Qc if many else Qc @ Qt
        gap, alone = np.eye(share.shape[1]) - share, np.zeros(len(share), dtype=bool)
        # The largest eigenvalue is at most the trace: only configurations of weight need theirs.
        heavy = np.flatnonzero(np.trace(share, axis1=1, axis2=2) >= 0.5)
        if len(heavy):  # none where constraints hold all columns
            alone[heavy] = np.linalg.eigvalsh(gap[heavy])[:, 0] < ALONE
        gap[alone] = np.eye(share.shape[1])
        own = e[rows][..., None]
        moved = np.linalg.solve(gap, Qt @ own) if many else Qt @ np.linalg.solve(gap, own)
        yield rows, np.asarray(moved[..., 0], dtype=np.float64), alone


def drawn_by_each(B: Array, Q: Array, e: Array, held: Array, code: IntArray) -> Array:
    """By how much (C,) the squares of errors h that are `held` out (rows,; 0 where none counts)
    change with the weight of each configuration j, which draws the fit to the others towards it:
    −2 Σ_c h_cᵀ B_c (I − Q_cᵀQ_c)⁻¹ Q_jᵀ e_j, c ≠ j (infinitesimal jackknife).  B and Q as in
    `growth`, whitened residuals e; `code` (rows,) numbers the configurations."""
    pulled, own = np.zeros((2, code.max() + 1, Q.shape[1]))
    np.add.at(pulled, code, B * held[:, None])
    np.add.at(own, code, Q * e[:, None])
    # (I − QᵀQ)⁻¹ = I + Qᵀ(I − QQᵀ)⁻¹Q
    for rows, moved, _ in left_out(Q, (Q * pulled[code]).sum(axis=1), code):
        pulled[code[rows[:, 0]]] += moved
    return np.asarray(-2 * ((pulled.sum(axis=0) - pulled) * own).sum(axis=1))


def share_left(Q: Array, configuration: IntArray) -> Array:
    """Variance (rows,) of a row as the fit predicts it, over that by a fit to the configurations
    besides its own: of Q_c Q_cᵀ over Q_c Q_cᵀ (I − Q_c Q_cᵀ)⁻¹, Q orthonormal as in `growth`; none
    where its configuration alone tells a direction."""
    left = np.ones(len(Q))
    for rows in same_size(configuration):
        without, alone = adjusted_rows(Q[rows], -0.5)
        here, grown = ((part**2).sum(axis=2) + EXACT for part in (Q[rows], without))
        left[rows] = np.where(alone[:, None], 0.0, here / grown)
    return left


def told_by_one(B: Array, configuration: IntArray) -> Array:
    """P (columns, columns): the part P·δ of a deviation δ of the estimates that the readings of one
    of these configurations alone hold, so that nothing checks it.

    With whitened B = QR, a direction u of Q_c with Q_cᵀQ_c u = u is shown by configuration c only
    (all other Q are at right angles to it); with these as columns of U, P = R⁻¹ U Uᵀ R.
    `configuration` (rows,), −1 where the others can do without it.
    """
    Q, R = linalg.qr(B, mode="economic")
    found = [np.zeros((len(R), 0))]
    for c in np.unique(configuration[configuration >= 0]):
        share, direction = np.linalg.eigh(Q[configuration == c].T @ Q[configuration == c])
        found.append(direction[:, share > 1 - ALONE])
    U = np.hstack(found)
    return np.asarray(linalg.solve_triangular(R, U) @ (U.T @ R))


def as_of_another_campaign(B: Array, weights: Weights, size: int) -> Array:
    """Factors (rows,) that make what blocks in time are off by what a campaign of another day is.

    Blocks of one campaign share part of the drift FFᵀ, and the fit follows it.  With x̂ and û the
    estimates of parameters and drift from the other blocks, C = cov(x̂ − x, û − u) and Σ₀ the other
    noise, a reading of the block that was left out and one with a drift of its own vary by

        Σ₀ + FFᵀ + B C_xx Bᵀ + F C_ux Bᵀ + (F C_ux Bᵀ)ᵀ     and     Σ₀ + FFᵀ + B C_xx Bᵀ

    (cov(x̂, û) = 0: Henderson 1975, Biometrics 31, 423).
    """
    F, together = weights.common, weights.together
    assert F is not None and together is not None and weights.whiten is not None
    p, k = B.shape[1], F.shape[1]
    Q, R = linalg.qr(weights.beside_common(B, np.zeros(len(B)))[0], mode="economic")
    T = linalg.solve_triangular(R, np.eye(p + k))
    factor = np.ones(len(B))
    block, whiten = np.repeat(together, size), weights.whiten.tocsr()
    for b in np.unique(block):
        rows = np.flatnonzero(block == b)
        gap = np.eye(p + k) - Q[rows].T @ Q[rows]
        if np.linalg.eigvalsh(gap)[0] < ALONE:
            continue
        C = T @ np.linalg.solve(gap, T.T)
        own = np.linalg.inv(whiten[rows][:, rows].toarray())
        new = (own**2).sum(axis=1) + (F[rows] ** 2).sum(axis=1)
        new += ((B[rows] @ C[:p, :p]) * B[rows]).sum(axis=1)
        shared = ((F[rows] @ C[p:, :p]) * B[rows]).sum(axis=1)
        factor[rows] = np.sqrt(new / (new + 2 * shared))
    return factor


def rms_3d(residual: Array, size: int) -> float:
    """Root mean square length in m of the position part of the residual (rows,)."""
    return float(np.sqrt((residual.reshape(-1, size)[:, :3] ** 2).sum(axis=1).mean()))


# Does a wider set of parameters predict better?  A test, since any gain is taken too often.

CHANCE = 0.01  # of the wider set being taken though the parameters it adds are none


def f_test(
    gain: float | Array, columns: int, rest: float | Array, dof: float | Array
) -> tuple[Any, Any]:
    """F and its p-value where `columns` took `gain` off a sum of squares of whitened residuals, of
    which `rest` is left with `dof` degrees of freedom: p is the chance of that if they are none."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # nothing is left
        F = np.divide(gain, columns) * dof / rest
    return F, special.fdtrc(columns, dof, F)


def predicts_better(
    narrow: Array, wide: Array, weights: Weights, configuration: IntArray, size: int
) -> bool:
    """Do the held-out residuals `wide` (rows,) of more parameters show that `narrow` (rows,) lacks
    some?

    Both models see the same noise, and the wider one errs more from estimating more: under the
    narrow one's truth f_c = |n_c|² − (|w_c|² − |n_c − w_c|²) = 2 n_cᵀ(n_c − w_c), whitened, has the
    mean zero over configurations c, since n_c − w_c comes from the others (Clark and West 2007, J.
    Econometrics 138, 291).  True where its t is significant, one-sided, and the squares themselves
    became smaller.
    """
    before, after = rms_3d(narrow, size), rms_3d(wide, size)
    if not after < before < np.inf:
        return bool(after < before)
    n, w = weights.apply(narrow), weights.apply(wide)
    f = np.bincount(np.repeat(numbered(configuration), size), 2 * n * (n - w))
    if len(f) < 2:
        return False
    deviation = float(f.std(ddof=1)) / np.sqrt(len(f))
    return bool(f.mean() > deviation * special.stdtrit(len(f) - 1, 1 - CHANCE))
