"""Rows whose noise is a sum of parts of unknown size, and columns with a prior or without one.

    e = B x + ε,   ε ~ N(0, V),   V = Σ_k θ_k K_k,   x_j flat (λ_j = 0) or N(0, 1/λ_j)

With x integrated out (Patterson and Thompson 1971; Harville 1977),

    −2 ℓ = log|V| + log|BᵀV⁻¹B + Λ| − log|Λ| + eᵀPe + n log 2π,   P = V⁻¹ − V⁻¹BΦBᵀV⁻¹,
    ∂(−2ℓ)/∂θ_k = tr P K_k − eᵀP K_k P e,   Φ = (BᵀV⁻¹B + Λ)⁻¹

(n less the number of flat columns).  V is block-diagonal: clusters of rows come in packs of one
padded size, so that all linear algebra runs on stacks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from scipy import linalg, sparse

from elastocal.messages import InsufficientDataError
from elastocal.units import Array, BoolArray, IntArray

LOG_2PI = float(np.log(2 * np.pi))
ROUNDING = 1e-12


class Parts(NamedTuple):
    """Parts K = ℓℓᵀ of every one of C clusters, with loadings ℓ (C, k, m, r); `of` (C, k) are the
    numbers of their variances."""

    of: IntArray
    loading: Array


@dataclass(frozen=True)
class Pack:
    """C clusters of m rows: B (C, m, p), p = 0 where they hold nothing of x; e (C, m); parts of V.
    Rows that are `absent` (C, m) do not count: padding, or readings that only are to be judged."""

    B: Array
    e: Array
    parts: tuple[Parts, ...]
    absent: BoolArray

    @cached_property
    def of(self) -> IntArray:
        return np.concatenate([part.of for part in self.parts], axis=1)

    @cached_property
    def loadings(self) -> Array:
        """Those of all parts beside each other (C, m, r₁ + r₂ + …)."""
        each = (part.loading.swapaxes(1, 2).reshape(*self.e.shape, -1) for part in self.parts)
        return np.concatenate([*each], axis=2)

    @cached_property
    def _widths(self) -> IntArray:
        """r (k,) of each part."""
        each = [np.full(part.of.shape[1], part.loading.shape[3]) for part in self.parts]
        return np.concatenate(each)

    def by_part(self, values: Array) -> Array:
        """Sums (C, …, k) over the columns (C, …, r₁ + r₂ + …) of each part."""
        starts = np.cumsum(self._widths) - self._widths
        return np.asarray(np.add.reduceat(values, starts, axis=-1))

    @cached_property
    def _sums(self) -> sparse.csr_array:
        return sparse.csr_array((np.ones(self.of.size), (self.of.ravel(), np.arange(self.of.size))))

    def added(self, values: Array, K: int) -> Array:
        """Sums (K, …) of `values` (C, k, …) by the numbers of the variances."""
        out = np.zeros((K, *values.shape[2:]))
        found = self._sums @ values.reshape(self.of.size, -1)
        out[: len(found)] = found.reshape(-1, *values.shape[2:])
        return out

    def pairs(self, values: Array, K: int) -> Array:
        """Sums (K, K) of `values` (C, k, k) by the numbers of two variances."""
        at = (self.of[:, :, None] * K + self.of[:, None, :]).ravel()
        return np.bincount(at, values.ravel(), K * K).astype(np.float64).reshape(K, K)

    def V(self, theta: Array) -> Array:
        """V (C, m, m) at θ (K,), absent rows of unit variance by themselves."""
        own = self.loadings * np.sqrt(theta[self.of]).repeat(self._widths, axis=1)[:, None]
        V = own @ own.swapaxes(1, 2)
        if self.absent.any():
            here = ~self.absent
            V *= here[:, :, None] & here[:, None, :]
            np.einsum("cii->ci", V)[:] += self.absent
        return V


class Whitened:
    """A pack under V = RRᵀ: `root` R⁻¹ (C, m, m), R⁻¹B and R⁻¹e, zeros in absent rows, log|V|."""

    def __init__(self, pack: Pack, theta: Array) -> None:
        self.pack = pack
        R = np.asarray(np.linalg.cholesky(pack.V(theta)), dtype=np.float64)
        self.log_det = 2 * float(np.log(np.einsum("cii->ci", R)).sum())
        self.root = np.asarray(np.linalg.inv(R), dtype=np.float64)
        if pack.absent.any():
            self.root *= ~pack.absent[:, None, :]
        self.B = self.root @ pack.B
        self.e = (self.root @ pack.e[..., None])[..., 0]


@dataclass(frozen=True)
class State:
    """Everything at one θ (K,): x (p,), L of LLᵀ = BᵀV⁻¹B + Λ, and −2ℓ."""

    theta: Array
    packs: tuple[Whitened, ...]
    x: Array
    L: Array
    value: float

    @cached_property
    def inverse(self) -> Array:
        """L⁻¹ (p, p)."""
        return np.asarray(linalg.lapack.dtrtri(self.L, lower=1)[0])

    def each(self) -> Iterator[tuple[Whitened, Array, Array]]:
        """The packs with H = R⁻¹BL⁻ᵀ (C, m, p), so that P = R⁻ᵀ(1 − HHᵀ)R⁻¹, and R⁻¹(e − Bx)."""
        for w in self.packs:
            if p := w.B.shape[2]:
                # One product, not one for each cluster.
                H = linalg.blas.dtrmm(1.0, self.inverse, w.B.reshape(-1, p).T, lower=1).T
                yield w, H.reshape(w.B.shape), w.e - w.B @ self.x
            else:
                yield w, w.B, w.e


@dataclass(frozen=True)
class LogPrior:
    """Gaussian prior of the logarithms of the first k variances: `mean` (k,), its `precision`."""

    mean: Array
    precision: Array

    def penalty(self, t: Array) -> tuple[float, Array]:
        """−2 log density at logarithms (K,) but for its constant, and the slope of that (k,)."""
        off = t[: len(self.mean)] - self.mean
        slope = self.precision @ off
        return float(off @ slope), 2 * slope

    def curved(self, information: Array) -> Array:
        out, k = information.copy(), len(self.mean)
        out[:k, :k] += self.precision
        return out


@dataclass(frozen=True)
class Mixed:
    """The model: packs of rows, `K` variances, and the columns' prior precisions (p,)."""

    packs: tuple[Pack, ...]
    K: int
    precision: Array
    prior: LogPrior | None = None

    @property
    def rows(self) -> int:
        return int(sum((~pack.absent).sum() for pack in self.packs))

    def whitened(self, theta: Array) -> tuple[tuple[Whitened, ...], Products, float]:
        """The packs under V, sums of products over their rows, and Σ log|V|.

        Raises LinAlgError where V is not positive definite.
        """
        packs, p = tuple(Whitened(pack, theta) for pack in self.packs), len(self.precision)
        M, z, squares = np.zeros((p, p)), np.zeros(p), 0.0
        for w in packs:
            squares += float(np.vdot(w.e, w.e))
            if w.B.shape[2]:
                flat = w.B.reshape(-1, p)
                M, z = M + flat.T @ flat, z + flat.T @ w.e.ravel()
        return packs, Products(M, z, squares, self.rows), sum(w.log_det for w in packs)

    def state(self, theta: Array) -> State:
        """Raises LinAlgError where V is not positive definite, InsufficientDataError where columns
        without a prior depend on each other."""
        packs, sums, value = self.whitened(theta)
        known, M, z = self.precision > 0, sums.M.copy(), sums.z
        # A little more than the prior: what others show as well must not drown in rounding.
        M[np.diag_indices_from(M)] += self.precision + ROUNDING * known * np.diag(M)
        try:
            L = np.asarray(linalg.cholesky(M, lower=True, check_finite=False))
        except linalg.LinAlgError:
            raise InsufficientDataError(
                "the columns of B depend on each other under this noise model; measure more poses"
            ) from None
        x = linalg.cho_solve((L, True), z, check_finite=False)
        value += sums.squares + 2 * float(np.log(np.diag(L)).sum()) - float(x @ z)
        value += (self.rows - int((~known).sum())) * LOG_2PI
        value -= float(np.log(self.precision[known]).sum())
        return State(theta, packs, x, L, value)

    def objective(self, t: Array) -> tuple[float, Array, Array]:
        """−2 log posterior at logarithms t (K,), its slope, and its average information: of θ_k and
        θ_l the mean of observed and expected curvature, eᵀPK_kPK_lPe (Gilmour, Thompson and Cullis
        1995, Biometrics 51, 1440)."""
        state, K = self.state(np.exp(t)), self.K
        slope, information = np.zeros(K), np.zeros((K, K))
        seen = np.zeros((K, len(state.x)))  # of K_l P e by x
        for w, H, z in state.each():
            pack, theta = w.pack, state.theta[w.pack.of]
            A = w.root @ pack.loadings  # ℓᵀPe = Aᵀz, ℓᵀPℓ = Aᵀ(1 − HHᵀ)A
            along, left = z[:, None] @ A, A - (H @ H.transpose(0, 2, 1)) @ A
            each = theta * pack.by_part((A * left).sum(axis=1) - np.square(along[:, 0]))
            slope += np.bincount(pack.of.ravel(), each.ravel(), K)
            own = theta[..., None] * pack.by_part(A * along).swapaxes(1, 2)  # R⁻¹K_kPe
            information += pack.pairs(own @ own.transpose(0, 2, 1), K)
            if H.shape[2]:
                seen += pack.added(own @ H, K)
        value, information = state.value, information - seen @ seen.T
        if self.prior is not None:
            penalty, more = self.prior.penalty(t)
            value += penalty
            slope[: len(more)] += more
            information = 2 * self.prior.curved(information / 2)
        return value, slope, information


LEAST_TOLD = 1e-9  # of the information on θ_k that there would be if x were known


class Expected:
    """The expected information on θ at a state, ½ tr P K_k P K_l (K, K), and what Kenward and Roger
    need: twice the same diagonal were x known (K,), BᵀV⁻¹K_kV⁻¹B (K, p, p), Φ, and of each pack
    R⁻¹K_lR⁻ᵀR⁻¹B (C, L, m, p) with the numbers (C, L) of these parts."""

    def __init__(self, state: State) -> None:
        K, p = len(state.theta), len(state.x)
        Phi, half = state.inverse.T @ state.inverse, state.inverse.T
        C, pairs, known = np.zeros((K, p, p)), np.zeros((K, K)), np.zeros(K)
        turned: list[tuple[IntArray, Array]] = []
        for w in state.packs:
            turns = (w.root[:, None] @ part.loading for part in w.pack.parts)
            A = np.concatenate([own @ own.swapaxes(2, 3) for own in turns], axis=1)
            flat, left = A.reshape(*A.shape[:2], -1), A  # (C, k, m, m)
            if w.B.shape[2]:
                AB = A @ w.B[:, None]
                C += w.pack.added(w.B.transpose(0, 2, 1)[:, None] @ AB, K)
                H = w.B @ half
                left = A - 2 * A @ (H @ H.transpose(0, 2, 1))[:, None]
                turned.append((w.pack.of, AB))
            other = left.swapaxes(2, 3).reshape(flat.shape)
            pairs += w.pack.pairs(flat @ other.transpose(0, 2, 1), K)
            known += w.pack.added((flat**2).sum(axis=2), K)
        rotated = (half.T @ C @ half).reshape(K, -1)
        information = 0.5 * (pairs + rotated @ rotated.T)
        self.information = (information + information.T) / 2
        self.known, self.C, self.Phi, self.turned = known, C, Phi, turned

    def kenward_roger(self, W: Array, rows: Array) -> tuple[Array, Array]:
        """Covariance (k, k) of combinations `rows` (k, p) of x, and degrees of freedom (k,).

        With W = cov(θ̂) (K, K), P_k = −BᵀV⁻¹K_kV⁻¹B and Q_kl = BᵀV⁻¹K_kV⁻¹K_lV⁻¹B,

            Φ_A = Φ + 2 Φ [Σ_kl W_kl (Q_kl − P_k Φ P_l)] Φ

        (Kenward and Roger 1997, Biometrics 53, 983; V is linear in θ).  Φ alone is too small twice
        over: estimated weights cost accuracy, and Φ̂ does not see it.  A combination c has
        Satterthwaite's degrees of freedom 2 (cᵀΦc)² / gᵀWg, g_k = cᵀΦBᵀV⁻¹K_kV⁻¹BΦc; infinite
        where no estimated variance matters.
        """
        Phi, C = self.Phi, self.C
        middle = np.zeros_like(Phi)
        for of, AB in self.turned:
            weight = W[of[:, :, None], of[:, None, :]]
            mixed = (weight @ AB.reshape(*of.shape, -1)).reshape(AB.shape)
            middle += np.tensordot(AB, mixed, ((0, 1, 2), (0, 1, 2)))
        mixed = (W @ C.reshape(len(W), -1)).reshape(C.shape)
        middle -= (C @ Phi @ mixed).sum(axis=0)
        # No less than zero but for rounding, where variances differ by many powers of ten.
        values, vectors = np.linalg.eigh((middle + middle.T) / 2)
        more = rows @ Phi @ (vectors * np.sqrt(2 * np.maximum(values, 0.0)))
        plain = rows @ Phi
        covariance = plain @ rows.T + more @ more.T
        variance = (plain * rows).sum(axis=1)
        g = ((plain @ C) * plain).sum(axis=2)  # (K, k)
        spread = (g * (W @ g)).sum(axis=0)
        dof = np.divide(2 * variance**2, spread, out=np.full(len(rows), np.inf), where=spread > 0)
        return (covariance + covariance.T) / 2, dof


# The variances of the largest restricted likelihood.

# Steps before it is asked which variances are none, and how often; of −2ℓ: what a last step may
# promise, and what none may cost.
STEPS, ROUNDS, ENOUGH, FINE = 6, 15, 1e-7, 1e-3
KEPT = 4  # evaluations, to be asked for again: a thousand groups have an information of 70 MB
SMALLEST, LARGEST = 1e-10, 1e6  # of the start
UNSEEN = 1e-5  # curvature of ℓ in its logarithm below which a variance is as good as none
FLAT, NEAR = 1.0, 0.1  # curvature and slope in it below which it may be none


class MixedFit:
    """θ (K,) at the maximum of the restricted likelihood (times the prior of log θ), searched from
    `start` (K,) until a step promises less than `enough` of −2ℓ, and whether the search ended.
    Variances that `may_vanish` are zero where the likelihood does not miss them.  `log_likelihood`
    is the restricted one, with a prior the marginal one by Laplace's method."""

    def __init__(
        self, model: Mixed, start: Array, may_vanish: Sequence[int] = (), enough: float = ENOUGH
    ) -> None:
        t = np.log(start)
        lower, upper, ended = t + np.log(SMALLEST), t + np.log(LARGEST), False

        @lru_cache(KEPT)
        def known(logarithms: bytes) -> tuple[float, Array, Array]:
            try:
                return model.objective(np.frombuffer(logarithms))
            except np.linalg.LinAlgError:
                return np.inf, np.zeros(model.K), np.eye(model.K)

        def evaluated(t: Array) -> tuple[float, Array, Array]:
            return known(t.tobytes())

        # Those that the columns could explain all of say nothing: they are none.
        told = np.diag(evaluated(t)[2]) > LEAST_TOLD
        held = np.array([k for k in may_vanish if not told[k]], dtype=np.int64)
        for _ in range(ROUNDS):
            t[held], lower[held], upper[held] = -np.inf, -np.inf, -np.inf
            before, (t, ended) = t, climb(evaluated, t, lower, upper, enough, STEPS)
            value, slope, information = evaluated(t)
            falling = (slope > 0) & (slope < NEAR) & (np.diag(information) < FLAT) & np.isfinite(t)
            gone: list[int] = []
            for k in may_vanish:
                without = t.copy()
                without[[*gone, k]] = -np.inf
                if falling[k] and evaluated(without)[0] <= value + FINE:
                    gone.append(k)
            if not gone and (ended or np.array_equal(t, before)):
                break
            held = np.append(held, gone).astype(np.int64)
        self.model, self.theta, self.converged, self.value = model, np.exp(t), ended, value

    @cached_property
    def state(self) -> State:
        return self.model.state(self.theta)

    @cached_property
    def expected(self) -> Expected:
        return Expected(self.state)

    @cached_property
    def _curvature(self) -> Array:
        """That of −ℓ to expect in log θ (K, K), with the prior's."""
        H = self.theta[:, None] * self.expected.information * self.theta
        return H if self.model.prior is None else self.model.prior.curved(H)

    @cached_property
    def covariance(self) -> Array:
        """W (K, K) of θ̂.  A variance that is none is taken for zero, not for uncertain (the
        convention of mixed-model software): counting it widens what is wide enough already."""
        theta, H, expected = self.theta, self._curvature, self.expected
        out = np.zeros_like(H)
        # Of those that x could explain all of the readings say nothing.
        told = np.diag(expected.information) > LEAST_TOLD * 0.5 * expected.known
        free = np.flatnonzero((np.diag(H) > UNSEEN) & told)
        if len(free):
            scale = 1 / np.sqrt(np.diag(H)[free])
            own = H[np.ix_(free, free)] * np.outer(scale, scale)
            scale *= theta[free]
            # The pseudo-inverse where variances cannot be told apart.
            inverse = np.linalg.pinv(own, 1e-12, hermitian=True)
            out[np.ix_(free, free)] = inverse * np.outer(scale, scale)
        return out

    @cached_property
    def log_likelihood(self) -> float:
        found, prior = -0.5 * self.value, self.model.prior
        if prior is None:
            return found
        k = len(prior.mean)
        log_dets = (np.linalg.slogdet(H)[1] for H in (prior.precision, self._curvature[:k, :k]))
        return found + 0.5 * float(np.subtract(*log_dets))


# The least of a function of a few logarithms between limits, by steps of its information.

# Value, slope (k,) and information (k, k) of −2ℓ at logarithms (k,).
Objective = Callable[[Array], tuple[float, Array, Array]]

STRIDE = 1.5  # longest step of a logarithm
LENGTHS: tuple[float, ...] = (1.0, 0.5, 0.25, 0.0625)  # of a step that are tried
FLAT_RIDGE = 1e-9  # of the largest curvature
ROUNDED = 1e-11  # of a sum over tens of thousands of rows: its rounding
EXCHANGES = 30  # of what is held at a bound, after which another method has to end the search


def climb(
    evaluate: Objective, theta: Array, lower: Array, upper: Array, enough: float, steps: int
) -> tuple[Array, bool]:
    """Where −2ℓ is least, and whether it ended there.  What has no room between its limits stays.
    A step that promises less than `enough`, or than rounding, is not taken any more; none is longer
    than STRIDE in any logarithm.  What the information lacks of the curvature is learned from how
    steps turn the slope (Dennis, Gay and Welsch 1981, ACM Trans. Math. Softw. 7, 348)."""
    value, slope, information = evaluate(theta)
    free = np.flatnonzero(lower < upper)
    lower, upper = lower[free], upper[free]
    lacking = np.zeros_like(information)
    for _ in range(steps):
        step, H = np.zeros(len(theta)), information + lacking
        # What is next to nothing has next to no curvature.
        H[np.diag_indices_from(H)] += FLAT_RIDGE * max(float(np.diag(H).max(initial=0.0)), 1e-3)
        low = np.maximum(lower - theta[free], -STRIDE)
        high = np.minimum(upper - theta[free], STRIDE)
        lengths = LENGTHS
        try:
            step[free] = step_within(H[np.ix_(free, free)], slope[free], low, high)
        except linalg.LinAlgError:
            lengths = ()
        if lengths and -float(slope @ step) < max(enough, ROUNDED * abs(value)):
            return theta, True
        for length in lengths:
            tried = evaluate(theta + length * step)
            if tried[0] < value:
                break
        else:
            if not lacking.any():
                break
            lacking[:] = 0.0  # what was learned elsewhere misleads here
            continue
        step *= length
        turned = tried[1] - slope
        missing, known = turned - tried[2] @ step, float(step @ lacking @ step)
        if known:
            lacking *= min(1.0, abs(float(missing @ step) / known))
        if (curved := float(turned @ step)) > 0:
            missing -= lacking @ step
            part = np.outer(missing, turned) / curved
            part -= 0.5 * float(missing @ step) * np.outer(turned, turned) / curved**2
            lacking += part + part.T
        theta, (value, slope, information) = theta + step, tried
    return theta, False


def step_within(H: Array, slope: Array, low: Array, high: Array) -> Array:
    """s (k,) in its box where sᵀslope + ½sᵀHs is least, H positive definite.  What is held at its
    bounds is exchanged, all at once, for what then passes them or is drawn off them, until that
    stays (Hintermüller, Ito and Kunisch 2002, SIAM J. Optim. 13, 865).  Where it goes round in
    circles, by bounded least squares, whose module takes as long to load as a fit."""
    below = above = np.zeros(len(slope), dtype=bool)
    for _ in range(EXCHANGES):
        step, inside = np.where(below, low, np.where(above, high, 0.0)), ~(below | above)
        root = linalg.cho_factor(H[np.ix_(inside, inside)], check_finite=False)
        step[inside] = linalg.cho_solve(root, -(slope + H @ step)[inside], check_finite=False)
        force = slope + H @ step
        was, below, above = (
            (below, above),
            (step < low) | (below & (force > 0)), (step > high) | (above & (force < 0)),
        )  # fmt: skip
        if np.array_equal(below, was[0]) and np.array_equal(above, was[1]):
            return np.asarray(step)
    root = linalg.cholesky(H)
    target = -linalg.solve_triangular(root, slope, trans="T")
    return np.asarray(scipy.optimize.lsq_linear(root, target, (low, high), method="bvls").x)


# Coefficients with a prior of unknown size, of which nothing is left of the rows but products.
#
#     e = C b + ε,   ε ~ N(0, a²),   b ~ N(0, diag v),   v_j = v_j(θ)
#
# with whitened rows, M = CᵀC and z = Cᵀe (columns without a prior projected out of both, and
# counted off the rows).  In units of √v, A = 1 + √v M √v / a² = LLᵀ is the posterior precision and
# b = A⁻¹√v z / a² the mean; with b integrated out
#
#     −2 ℓ = n log a² + |e|²/a² + log|A| − bᵀA b   (+ n log 2π)
#     ∂(−2ℓ)/∂ log v_j = 1 − (A⁻¹)_jj − b_j².


@dataclass(frozen=True)
class Products:
    """M = CᵀC (k, k), z = Cᵀe (k,), |e|² and the number of rows, less that of columns without a
    prior."""

    M: Array
    z: Array
    squares: float
    rows: int

    def at(self, variances: Array, factor: float = 0.0) -> Standardised:
        """The coefficients under prior variances v (k,) and noise of the deviation e^factor."""
        return Standardised.of(self.M, self.z, np.sqrt(variances), float(np.exp(factor)))

    def value(self, at: Standardised) -> float:
        """−2ℓ but for n log 2π."""
        a = at.noise
        return 2 * self.rows * float(np.log(a)) + self.squares / a**2 + at.log_det - at.explained

    def objective(
        self, variances: Array, grown: Array, factor: float
    ) -> tuple[float, Array, Array]:
        """−2ℓ, slope and average information in the factor and θ (1 + m,), which let the logarithms
        of the variances grow by `grown` (k, m)."""
        at = self.at(variances, factor)
        b, a2, inverse = at.b, at.noise**2, at.inverse
        left = np.einsum("ij,ij->j", inverse, inverse)  # posterior over prior variance
        beta = np.sqrt(variances) * b
        rss = (self.squares - 2 * float(beta @ self.z) + float(beta @ (self.M @ beta))) / a2
        slope = np.empty(1 + grown.shape[1])
        slope[0] = 2 * (self.rows - (len(left) - left.sum()) - rss)
        slope[1:] = ((1 - left) - b**2) @ grown
        information, of_noise = np.empty((len(slope),) * 2), 2 * (inverse @ b)
        information[1:, 1:], half = at.information(grown)
        information[0, 1:] = information[1:, 0] = of_noise @ half
        information[0, 0] = 4 * rss - float(of_noise @ of_noise)
        return self.value(at), slope, information


@dataclass(frozen=True)
class Standardised:
    """The coefficients in units of their prior deviations `root` (k,): L, b, and bᵀA b, under noise
    of a deviation."""

    L: Array
    b: Array
    explained: float
    root: Array
    noise: float

    @classmethod
    def of(cls, M: Array, z: Array, root: Array, noise: float = 1.0) -> Standardised:
        scaled = root / noise
        A = M * scaled
        A *= scaled[:, None]
        # Beside readings that are exact a prior drowns in rounding.
        A[np.diag_indices_from(A)] += np.maximum(1.0, ROUNDING * np.diag(A))
        # Symmetric, and LAPACK's own way round: nothing is copied.
        L = linalg.cholesky(A.T, lower=True, overwrite_a=True, check_finite=False)
        right = scaled * z / noise
        b = linalg.cho_solve((L, True), right, check_finite=False)
        return cls(L, b, float(b @ right), root, noise)

    @property
    def log_det(self) -> float:
        return 2 * float(np.log(np.diag(self.L)).sum())

    @cached_property
    def inverse(self) -> Array:
        """L⁻¹ (k, k)."""
        return np.asarray(linalg.lapack.dtrtri(self.L, lower=1)[0])

    def information(self, grown: Array) -> tuple[Array, Array]:
        """Average information (m, m) of parameters that let the logarithms of prior variances grow
        by `grown` (k, m), and L⁻¹ of b so grown (k, m).  Of two that let them grow by s and t the
        mean of observed and expected curvature of −2ℓ (Gilmour, Thompson and Cullis 1995,
        Biometrics 51, 1440) is sᵀb(1 − A⁻¹)bt."""
        moved = grown * self.b[:, None]
        half = linalg.blas.dtrmm(1.0, self.inverse, moved, lower=1)
        return moved.T @ moved - half.T @ half, half

    def block(self, own: IntArray | slice) -> Array:
        """That of A⁻¹ (g, g) of some of the coefficients."""
        half = self.inverse[:, own]
        return np.asarray(half.T @ half)

    def left_out(self, groups: Sequence[IntArray | slice]) -> Array:
        """By how much ℓ falls (G,) where one of these groups of coefficients is left out, all else
        as it is (Savage and Dickey): with S its block of A⁻¹, ½ (log|S| + bᵀS⁻¹b)."""
        out = np.zeros(len(groups))
        for k, own in enumerate(groups):
            C = linalg.cholesky(self.block(own), lower=True)
            y = linalg.solve_triangular(C, self.b[own], lower=True)
            out[k] = 0.5 * float(y @ y + 2 * np.log(np.diag(C)).sum())
        return out


def beside(M: Array, z: Array, prior: Array, others: IntArray, own: slice) -> tuple[Array, Array]:
    """Of columns c what the others x, of prior precisions Λ, leave of normal matrix and right side:
    A = M_cc − M_cx (M_xx + Λ)⁻¹ M_xc and b = z_c − M_cx (M_xx + Λ)⁻¹ z_x."""
    if not len(others):
        return M[own, own], z[own]
    L = M[np.ix_(others, others)]
    L[np.diag_indices_from(L)] += prior[others]
    L = linalg.cholesky(L, lower=True, overwrite_a=True, check_finite=False)
    right = np.column_stack([M[others, own], z[others]])
    half = linalg.solve_triangular(L, right, lower=True, check_finite=False)
    across = half[:, :-1].T
    return M[own, own] - across @ across.T, z[own] - across @ half[:, -1]


def least_norm(A: Array, b: Array, cond: float | None = None) -> Array:
    """x (k, …) of least norm among those that minimise |A x − b|, by singular values; those below
    `cond` of the largest count as zero, by default what the rounding of so many rows makes.  By
    LAPACK's divide and conquer, which may fail to converge on finite numbers (a matrix of condition
    3e6 did, by AVX-512 kernels, where it does not a rounding away); the slower iteration then
    converges."""
    if cond is None:
        cond = np.finfo(np.float64).eps * max(A.shape)
    try:
        return np.asarray(linalg.lstsq(A, b, cond=cond)[0])
    except linalg.LinAlgError:
        return np.asarray(linalg.lstsq(A, b, cond=cond, lapack_driver="gelss")[0])
