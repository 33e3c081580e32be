"""Variances by restricted maximum likelihood, and an estimate that knows they are estimated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from elastocal.errors import InsufficientDataError
from elastocal.identification.correlated_stacks import ClusterSums, Stack, Whitened, stacks
from elastocal.identification.covariance import Covariance
from elastocal.identification.noise_structure import RepeatSets, SharedEffect, Structure
from elastocal.units import Array, BoolArray

# Restricted likelihood of variances, its slope and information, and the estimate under them.
#
# For e = B Δx + noise with V = Σ_k θ_k V_k (Patterson and Thompson 1971; Harville 1977):
#
#     −2 ℓ_R = log|V| + log|BᵀV⁻¹B| + eᵀPe + (rows − p) log 2π,   P = V⁻¹ − V⁻¹BΦBᵀV⁻¹
#     ∂ℓ/∂θ_k = ½ (eᵀP V_k P e − tr P V_k),   E[−∂²ℓ/∂θ_k∂θ_l] = ½ tr(P V_k P V_l)
#
# with Φ = (BᵀV⁻¹B)⁻¹.  Repeats enter as their means, and their scatter as Wishart terms.

LEAST_TOLD = 1e-9  # of the information on θ_k that there would be if Δx were known


@dataclass(frozen=True)
class State:
    """Everything at one θ (K,): estimate Δx (p,), Φ (p, p), `log_likelihood`, and what it took."""

    theta: Array
    x: Array
    Phi: Array
    log_likelihood: float
    whitened: list[Whitened]
    inner: Array  # (sets with repeats, size, size): inverse covariance of a single reading


@dataclass(frozen=True)
class Slope:
    """Score (K,), expected and observed information (K, K) of θ; `C` (K, p, p): BᵀV⁻¹V_kV⁻¹B;
    `mean` (K,): ½ tr(P V_k), the mean of ½ eᵀP V_k P e.

    `told` (K,): whether the readings say anything of θ_k, which they do not where the parameters
    explain all that it could cause.
    """

    score: Array
    information: Array
    observed: Array
    C: Array
    told: BoolArray
    mean: Array


def evaluate(structure: Structure, stacked: list[Stack], theta: Array) -> State:
    """State at θ.  Raises LinAlgError where V is not positive definite.

    InsufficientDataError where B has dependent columns.
    """
    sets = structure.sets
    p, size = sets.B.shape[2], sets.e.shape[1]
    whitened = [stack.under(theta) for stack in stacked]
    normal, right, squares = np.zeros((p, p)), np.zeros(p), 0.0
    for N, r, square in (w.normal() for w in whitened):
        normal, right, squares = normal + N, right + r, squares + square
    try:
        factor = linalg.cholesky(normal, lower=True)
    except linalg.LinAlgError:
        raise InsufficientDataError(
            "the columns of B depend on each other under this noise model; measure more poses"
        ) from None
    x = linalg.cho_solve((factor, True), right)
    Phi = linalg.cho_solve((factor, True), np.eye(p))
    squares -= float(right @ x)
    repeated = sets.dof > 0
    single = np.einsum("cl,clij->cij", theta[structure.index[repeated]], structure.matrix[repeated])
    inner = np.linalg.inv(single)
    log_det = np.linalg.slogdet(single)[1]
    within = float(sets.dof[repeated] @ log_det) + float(np.vdot(inner, sets.scatter[repeated]))
    rows = int(sets.repeats.sum()) * size
    total = (
        sum(w.log_det for w in whitened) + 2 * float(np.log(np.diag(factor)).sum()) + squares
        + within + sets.log_offset + (rows - p) * np.log(2 * np.pi)
    )  # fmt: skip
    return State(theta, x, Phi, -0.5 * total, whitened, inner)


def slope(structure: Structure, state: State) -> Slope:
    """Score and information of θ at a state."""
    K, p = len(state.theta), len(state.x)
    w = ClusterSums.of(state.whitened, state.x, state.Phi)
    taken = 0.5 * w.C.reshape(K, p * p) @ state.Phi.ravel()
    score, mean = 0.5 * (w.squares - w.trace) + taken, 0.5 * w.trace - taken
    half = linalg.cholesky(state.Phi, lower=True)
    rotated = (half.T @ w.C @ half).reshape(K, -1)
    information = 0.5 * (w.twice_expected + rotated @ rotated.T)
    # −∂²ℓ/∂θ_k∂θ_l = eᵀP V_k P V_l P e − ½ tr(P V_k P V_l)
    Dh = w.D @ half
    observed = w.product - Dh @ Dh.T - information
    _within(structure, state, score, mean, information, observed)
    told = np.diag(information) > LEAST_TOLD * 0.5 * w.known
    return Slope(score, information, observed, w.C, told, mean)


def _within(
    structure: Structure, state: State, score: Array, mean: Array, information: Array,
    observed: Array,
) -> None:  # fmt: skip
    """Add what the scatter of repeats says: Wishart terms of each set."""
    sets, K = structure.sets, len(score)
    repeated = np.flatnonzero(sets.dof > 0)
    if not len(repeated):
        return
    dof, index = sets.dof[repeated], structure.index[repeated]
    n, L = index.shape
    S = state.inner[:, None] @ structure.matrix[repeated]  # (C, L, size, size)
    W = state.inner @ sets.scatter[repeated]
    flat = S.reshape(n, L, -1)
    other = S.transpose(0, 1, 3, 2).reshape(n, L, -1)
    squares = (flat @ W.transpose(0, 2, 1).reshape(n, -1, 1))[..., 0]
    trace = np.trace(S, axis1=2, axis2=3)
    expects = dof[:, None] * trace
    score += np.bincount(index.ravel(), 0.5 * (squares - expects).ravel(), K)
    mean += np.bincount(index.ravel(), 0.5 * expects.ravel(), K)
    pairs = (index[:, :, None] * K + index[:, None, :]).ravel()
    expected = 0.5 * dof[:, None, None] * (flat @ other.transpose(0, 2, 1))
    product = flat @ (W[:, None] @ S).transpose(0, 1, 3, 2).reshape(n, L, -1).transpose(0, 2, 1)
    product = (product + product.transpose(0, 2, 1)) / 2
    information += np.bincount(pairs, expected.ravel(), K * K).reshape(K, K)
    observed += np.bincount(pairs, (product - expected).ravel(), K * K).reshape(K, K)


# Variances by restricted maximum likelihood: Newton and Fisher steps, variances kept ≥ 0.

STEPS = 60
DECREMENT = 1e-18  # gain in ℓ that a step still promises: variances exact to about nine digits
VISIBLE = 1e-7  # gains below this drown in the rounding of ℓ, those of the score do not
SMALLEST = 1e-10  # of the start: a variance that falls below this (σ by 1e5) stays there
# A variance that goes to zero falls by e with every Newton step in its logarithm, and the gain with
# it.  Once no step promises more than this, one step takes it all the way.
LITTLE = 1e-3
LONGEST = 2.0  # step of a logarithm
TINY = 1e-100  # stands for the variance of perfect data: its square is still a number


@dataclass(frozen=True)
class LogPrior:
    """Gaussian prior on log θ of the structure's own variances: mean (K,), precision (K, K)."""

    mean: Array
    precision: Array

    @cached_property
    def log_constant(self) -> float:
        """log of the normalising constant."""
        log_det = float(np.linalg.slogdet(self.precision)[1])
        return 0.5 * log_det - 0.5 * len(self.mean) * float(np.log(2 * np.pi))

    def value(self, theta: Array) -> float:
        """log density at log θ."""
        d = np.log(theta) - self.mean
        return self.log_constant - 0.5 * float(d @ self.precision @ d)


@dataclass(frozen=True)
class Reml:
    """Variances θ (own ones first, then shared), state there, their covariance (K, K) of θ̂.

    `log_likelihood` is the restricted one, and with a prior the marginal one by Laplace's method.
    """

    structure: Structure
    shared: tuple[SharedEffect, ...]
    state: State
    slope: Slope
    covariance: Array
    log_likelihood: float
    converged: bool

    @property
    def own(self) -> Array:
        return self.state.theta[: len(self.structure.names)]

    @property
    def common(self) -> Array:
        return self.state.theta[len(self.structure.names) :]

    @property
    def deviations(self) -> list[tuple[SharedEffect, float]]:
        """All that readings share beside the waves of a course, and its variance."""
        effects = (*self.structure.faster, *self.shared)
        values = self.state.theta[len(self.state.theta) - len(effects) :]
        return list(zip(effects, values.tolist(), strict=True))


def reml(
    structure: Structure,
    shared: tuple[SharedEffect, ...],
    prior: LogPrior | None = None,
    start: Array | None = None,
) -> Reml:
    """Maximise the restricted likelihood (times the prior of log θ, where there is one).

    Own variances are stepped in log θ, shared ones in θ, each with a bound (zero for shared ones,
    next to nothing for own ones): one that the likelihood pushes below it stays there.
    """
    theta = usual_start(structure, shared) if start is None else start.copy()
    search = _VarianceSearch(structure, stacks(structure, shared), prior, theta)
    own, bound = search.own, search.bound
    state = search.state(theta)
    at = slope(structure, state)
    if not at.told[own:].all():  # shared, and the parameters could explain all of it
        theta[own:] *= at.told[own:]
        state = search.state(theta)
        at = slope(structure, state)
    value, converged, last = search.value(state), False, np.inf
    for _ in range(STEPS):
        score, step = search.step(at, state.theta)
        gain = float(score @ step)
        if gain < DECREMENT or VISIBLE > gain >= last:
            converged = True
            break
        if gain < VISIBLE:
            state, last = search.state(search.moved(state.theta, step)), gain
        else:
            found = search.vanished(state, value, gain, step) or search.along(state, value, step)
            if found is None:
                converged = gain < 1e-4  # as good as rounding allows
                break
            state, value = found
        at = slope(structure, state)
    _, H, chain = search.working(at, state.theta)
    covariance = np.zeros_like(H)
    free = np.flatnonzero((state.theta > bound) & at.told)
    # A variance at its bound is taken for zero, not for uncertain (the convention of mixed-model
    # software): counting it widens intervals that are wide enough already.
    if free.size:
        covariance[np.ix_(free, free)] = _inverse(H[np.ix_(free, free)])
    covariance = chain[:, None] * covariance * chain
    likelihood = state.log_likelihood
    if prior is not None:
        log_det = np.linalg.slogdet(H[:own, :own])[1]
        likelihood += prior.value(state.theta[:own]) + 0.5 * own * np.log(2 * np.pi) - 0.5 * log_det
    return Reml(structure, shared, state, at, covariance, likelihood, converged)


class _VarianceSearch:
    """The objective, its derivatives and the steps that raise it; from θ = `start` (K,)."""

    def __init__(
        self, structure: Structure, stacked: list[Stack], prior: LogPrior | None, start: Array
    ) -> None:
        self.structure, self.stacked, self.prior = structure, stacked, prior
        self.own = own = len(structure.names)
        self.bound = np.zeros(len(start))
        self.bound[:own] = SMALLEST * float(start[:own].max())

    def state(self, theta: Array) -> State:
        return evaluate(self.structure, self.stacked, theta)

    def value(self, state: State) -> float:
        own = state.theta[: self.own]
        return state.log_likelihood + (0.0 if self.prior is None else self.prior.value(own))

    def working(self, at: Slope, theta: Array) -> tuple[Array, Array, Array]:
        """Score and expected information in the stepping variables, and dθ/d(variable)."""
        own, prior = self.own, self.prior
        chain = np.ones(len(theta))
        chain[:own] = theta[:own]
        score, H = chain * at.score, chain[:, None] * at.information * chain
        if prior is not None:
            score[:own] -= prior.precision @ (np.log(theta[:own]) - prior.mean)
            H[:own, :own] += prior.precision
        return score, H, chain

    def step(self, at: Slope, theta: Array) -> tuple[Array, Array]:
        """Score and step in the stepping variables.

        Newton's step where the objective is concave, else Fisher's.
        """
        score, expected, chain = self.working(at, theta)
        free = ((theta > self.bound) | (score > 0)) & at.told
        curvature = chain[:, None] * (at.observed - at.information) * chain
        i = np.arange(self.own)
        curvature[i, i] -= (chain * at.score)[: self.own]
        step = np.zeros(len(theta))
        if not free.any():
            return score, step
        inside = np.ix_(free, free)
        # Variances of which rounding leaves no information together are stepped one by one.
        for H in (expected + curvature, expected, np.diag(np.diag(expected))):
            try:
                step[free] = _solve(H[inside], score[free])
                break
            except np.linalg.LinAlgError:
                continue
        return score, step

    def moved(self, theta: Array, step: Array) -> Array:
        """θ after a step, own variances in their logarithm, none below its bound."""
        moved = theta + step
        moved[: self.own] = theta[: self.own] * np.exp(step[: self.own])
        return np.maximum(moved, self.bound)

    def better(self, theta: Array, value: float) -> tuple[State, float] | None:
        """State and objective at θ; None where that is not above `value`, or there is none."""
        try:
            trial = self.state(theta)
        except np.linalg.LinAlgError:
            return None
        found = self.value(trial)
        return (trial, found) if found > value else None

    def vanished(
        self, state: State, value: float, gain: float, step: Array
    ) -> tuple[State, float] | None:
        """The step that takes variances on their way to zero to their bound; None where there are
        none or that costs."""
        falling = np.zeros(len(step), dtype=bool)
        falling[: self.own] = np.abs(step[: self.own] + 1.0) < 0.1
        if gain > LITTLE or not falling.any():
            return None
        theta = self.moved(state.theta, step)
        theta[falling] = self.bound[falling]
        return self.better(theta, value)

    def along(self, state: State, value: float, step: Array) -> tuple[State, float] | None:
        """The first of ever shorter steps that raises the objective; None where none does."""
        # Each by itself: one that rounding sends far must not keep the others where they are.
        step, length = step.copy(), 1.0
        step[: self.own] = np.clip(step[: self.own], -LONGEST, LONGEST)
        for _ in range(30):
            found = self.better(self.moved(state.theta, length * step), value)
            if found is not None:
                return found
            length /= 2
        return None


def _solve(H: Array, score: Array) -> Array:
    """H⁻¹ score.  Raises LinAlgError unless H is positive definite."""
    diagonal = np.diag(H)
    if diagonal.min() <= 0:
        raise np.linalg.LinAlgError
    scale = np.sqrt(diagonal)
    # A trace of ridge: variances that the data cannot separate share the step.
    factor = linalg.cho_factor(H / np.outer(scale, scale) + 1e-9 * np.eye(len(H)), lower=True)
    return np.asarray(linalg.cho_solve(factor, score / scale)) / scale


def _inverse(H: Array) -> Array:
    """Inverse of the information; the pseudo-inverse where variances cannot be told apart."""
    scale = np.sqrt(np.diag(H))
    scaled = H / np.outer(scale, scale)
    factor, failed = linalg.lapack.dpotrf(scaled, lower=True)
    if failed or np.diag(factor).min() < 1e-6:
        inverse = np.linalg.pinv(scaled, hermitian=True)
    else:
        inverse = linalg.cho_solve((factor, True), np.eye(len(H)))
    return np.asarray(inverse / np.outer(scale, scale))


def usual_start(structure: Structure, shared: tuple[SharedEffect, ...]) -> Array:
    """Own variances from the scatter of repeats where there is any, else from all residuals."""
    sets = structure.sets
    size = sets.e.shape[1]
    # Variance of one reading that θ = 1 would give: 1, but for noise that is stated.
    unit = np.trace(structure.mean_matrix.sum(axis=1), axis1=1, axis2=2) * sets.repeats / size
    own = float(np.median((sets.e**2).mean(axis=1) * sets.repeats / unit))
    if sets.dof.sum() > 0:
        squares = float(np.trace(sets.scatter, axis1=1, axis2=2).sum())
        # A few repeats may agree by rounding: from near zero the search does not come back.
        dof = float(sets.dof.sum()) * size
        own = max((squares + own / dof) / (dof + 1 / dof), 1e-9 * own)
    # Shared effects start above zero, from where they are free to go there.
    share = 0.1 * float((sets.e**2).mean())
    moved = [float((effect.loading**2).sum(axis=(1, 3)).mean()) for effect in shared]
    common = [
        share / m if effect.joints else share for effect, m in zip(shared, moved, strict=True)
    ]
    return np.concatenate([np.full(len(structure.names), max(own, TINY)), np.maximum(common, TINY)])


# Is there a further variance?  A test that needs no fit with it.
#
# At θ_k = 0, U = ½ eᵀP V_k P e has the mean ½ tr(P V_k) and, the other variances being estimated,
# the variance I_kk − I_ko I_oo⁻¹ I_ok; a scaled χ² with the same two moments gives its p-value
# (Zhang and Lin 2003, Biostatistics 4, 57).


def score_test(
    structure: Structure, shared: tuple[SharedEffect, ...], theta: Array, k: int
) -> float:
    """p-value of the hypothesis θ_k = 0; `theta` (K,) is the fit without it, with zero in its
    place."""
    at = slope(structure, evaluate(structure, stacks(structure, shared), theta))
    free = (theta > 0) & at.told
    if not at.told[k]:
        return 1.0
    own, across = at.information[np.ix_(free, free)], at.information[free, k]
    return _tail(float(at.score[k]), float(at.mean[k]), at.information[k, k], across, own)


def score_test_of_columns(fit: Reml, F: Array) -> float:
    """p-value of V_k = FFᵀ not being part of the covariance; F (C, size, q) of the fit's sets."""
    state = fit.state
    q = F.shape[2]
    white, across, right = [], np.zeros((len(state.x), q)), np.zeros(q)
    for w in state.whitened:
        own = w.inverse @ F[w.stack.sets].reshape(len(w.B), -1, F.shape[2])
        white.append(own)
        across = across + np.tensordot(w.B, own, ((0, 1), (0, 1)))
    W, mixed = np.zeros((F.shape[2],) * 2), np.zeros(len(state.theta))
    for w, own in zip(state.whitened, white, strict=True):
        H = own - w.B @ (state.Phi @ across)
        W += np.tensordot(H, H, ((0, 1), (0, 1)))
        right = right + np.tensordot(H, w.e - w.B @ state.x, ((0, 1), (0, 1)))
        each = np.einsum("glnm,gnq,gmq->gl", w.A, H, H, optimize=True)
        mixed += np.bincount(w.stack.index.ravel(), 0.5 * each.ravel(), len(mixed))
    free = (state.theta > 0) & fit.slope.told
    mean = 0.5 * float(np.trace(W))
    score = 0.5 * float(right @ right) - mean
    own = fit.slope.information[np.ix_(free, free)]
    return _tail(score, mean, 0.5 * float((W**2).sum()), mixed[free], own)


def _tail(score: float, mean: float, variance: float, across: Array, own: Array) -> float:
    """p-value of a score with the information `variance`, of which the other variances (k,), with
    the information `own` (k, k), explain a part `across`."""
    left = variance - float(across @ np.linalg.pinv(own, hermitian=True) @ across)
    if mean <= 0 or left <= LEAST_TOLD * variance:
        return 1.0
    return float(special.chdtrc(2 * mean**2 / left, 2 * mean * (mean + score) / left))


# Covariance and degrees of freedom of an estimate whose weights were estimated too.
#
# Kenward and Roger 1997 (Biometrics 53, 983): with W = cov(θ̂), P_k = −BᵀV⁻¹V_kV⁻¹B and
# Q_kl = BᵀV⁻¹V_kV⁻¹V_lV⁻¹B,
#
#     Φ_A = Φ + 2 Φ [Σ_kl W_kl (Q_kl − P_k Φ P_l)] Φ
#
# Φ alone is too small twice over: estimated weights cost accuracy, and Φ̂ does not see it.  (Their
# term in ∂²V/∂θ² is zero, V being linear in θ.)  A combination c of the parameters has
# Satterthwaite's degrees of freedom 2 (cᵀΦc)² / (gᵀWg), g_k = cᵀΦBᵀV⁻¹V_kV⁻¹BΦc, which is what
# theirs are for one contrast.


def kenward_roger(fit: Reml, combinations: Array | None = None) -> tuple[Array, Array]:
    """Adjusted covariance (k, k) of `combinations` (k, p) of Δx, default each parameter.

    And the degrees of freedom (k,) of each; infinite where no estimated variance matters.
    """
    Phi, C, W = fit.state.Phi, fit.slope.C, fit.covariance
    p = len(Phi)
    middle = np.zeros((p, p))
    for w in fit.state.whitened:
        middle += w.between(W)
    mixed = (W @ C.reshape(len(W), -1)).reshape(C.shape)
    middle -= (C @ Phi @ mixed).sum(axis=0)
    # No less than zero but for rounding, which shows where variances differ by many powers of ten.
    values, vectors = np.linalg.eigh((middle + middle.T) / 2)
    more = Phi @ (vectors * np.sqrt(2 * np.maximum(values, 0.0)))
    adjusted = Phi + more @ more.T
    rows = np.eye(p) if combinations is None else combinations
    plain = rows @ Phi
    variance = (plain * rows).sum(axis=1)
    g = ((plain @ C) * plain).sum(axis=2)  # (K, k)
    spread = (g * (W @ g)).sum(axis=0)
    told = spread > 0
    dof = np.divide(2 * variance**2, spread, out=np.full(len(rows), np.inf), where=told)
    covariance = rows @ adjusted @ rows.T
    return (covariance + covariance.T) / 2, dof


def mean_covariance(fits: list[Reml], T: Array, like: Covariance) -> Covariance:
    """Σ = Σ_m w_m Σ_m of the parameters T (p, p) times those of the `fits`, which come first there.

    w_m ∝ the restricted likelihoods.  To what the degrees of freedom f_m leave unknown,
    Σ_m w_m/f_m, comes what the models differ by (`Covariance.tails`), most for base and tracker.
    """
    level = np.array([fit.log_likelihood for fit in fits])
    weight = np.exp(level - level.max()) / np.exp(level - level.max()).sum()
    rows = [np.pad(T, ((0, 0), (0, len(fit.state.x) - len(T)))) for fit in fits]
    found = [kenward_roger(fit, own) for fit, own in zip(fits, rows, strict=True)]
    matrices, dof = (np.array(part) for part in zip(*found, strict=True))
    among = tuple(zip(weight.tolist(), matrices, strict=True))
    mean = replace(like, matrix=np.tensordot(weight, matrices, 1), among=among)
    between = 1 / replace(mean, dof=np.full(len(T), np.inf)).tails(np.eye(len(T))[:, None])[0]
    left = weight @ (1 / dof) + between
    return replace(mean, dof=np.divide(1, left, out=np.full(len(left), np.inf), where=left > 0))


# Many variances from few readings each: shrink their logarithms towards one another.
#
# Empirical Bayes in the spirit of Smyth 2004 (Stat. Appl. Genet. Mol. Biol. 3, 3), with a lognormal
# prior that knows direction and configuration: log θ_ca = μ_a + u_c + v_ca, where u ~ N(0, ω_u) and
# v ~ N(0, ω_v).  A sample variance s² on f degrees of freedom has log s² = log θ + ψ(f/2) −
# log(f/2) plus scatter of variance ψ'(f/2), from which an analysis of variance finds μ, ω_u and
# ω_v.

FEWEST = 2.0  # degrees of freedom of a group, at the median, below which there is nothing to shrink
NARROWEST = 1e-3  # variance of log θ: equal to within 3 %


def prior_of_groups(structure: Structure, residual: Array) -> LogPrior:
    """Prior of the group variances from the scatter of a group's sets about their own mean.

    `residual` (C, size): means less a fit.  What all sets of a group share, an effect of
    its configuration, is taken out with the mean.  Raises InsufficientDataError where the groups
    hold too few readings.
    """
    sets = structure.sets
    size = residual.shape[1]
    K = len(structure.names)
    s2, f = _sample_variances(sets, structure.index, residual, K)
    if np.median(f) < FEWEST or 3 * size > K:
        raise InsufficientDataError(
            "the groups of a configuration and a direction hold too few readings for variances of "
            "their own; repeat readings, or choose another noise model"
        )
    # A lucky group of (near) equal readings says little about its variance, not minus infinity.
    s2 = np.maximum(s2, max(1e-6 * float(np.median(s2)), TINY))
    z = np.log(s2) - special.digamma(f / 2) + np.log(f / 2)
    noise = special.polygamma(1, f / 2)
    table, scatter = z.reshape(-1, size), float(noise.mean())
    configurations = len(table)
    mean = np.average(table, axis=0, weights=1 / noise.reshape(-1, size))
    between = table - mean
    u = between.mean(axis=1)
    within = ((between - u[:, None]) ** 2).sum()
    if size > 1:
        omega_v = float(within / ((configurations - 1) * (size - 1))) - scatter
        omega_u = float((u**2).sum() / (configurations - 1)) - (max(omega_v, 0) + scatter) / size
    else:
        omega_v, omega_u = float((u**2).sum() / (configurations - 1)) - scatter, 0.0
    block = max(omega_u, 0.0) * np.ones((size, size)) + max(omega_v, NARROWEST) * np.eye(size)
    precision = np.kron(np.eye(configurations), np.linalg.inv(block)).astype(np.float64)
    return LogPrior(np.tile(mean, configurations), precision)


def _sample_variances(
    sets: RepeatSets, index: NDArray[np.int64], residual: Array, K: int
) -> tuple[Array, Array]:
    """Variance of a single reading within each group (K,), and its degrees of freedom (K,)."""
    weight = np.repeat(sets.repeats[:, None], residual.shape[1], axis=1).ravel()
    group, e = index.ravel(), residual.ravel()
    mean = np.bincount(group, weight * e, K) / np.bincount(group, weight, K)
    squares = np.bincount(group, weight * (e - mean[group]) ** 2, K)
    squares += np.bincount(group, np.diagonal(sets.scatter, axis1=1, axis2=2).ravel(), K)
    dof = np.bincount(group, weight, K) - 1.0
    return squares / np.maximum(dof, 1.0), np.maximum(dof, 0.5)
