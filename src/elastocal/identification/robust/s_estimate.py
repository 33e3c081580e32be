"""S-estimates by random subsets: the fit with the smallest M-scale of its residuals.

FAST-S (Salibian-Barrera and Yohai 2006) for observations of `size` rows.  Subsets grow one
random observation at a time until they determine every parameter (nonsingular subsampling,
Koller and Stahel 2017): a compliance that only a fifth of the configurations see would make
nearly all subsets of the smallest size singular.  All subsets are refined at once by stacked
normal equations in the orthonormal coordinates of the design.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InsufficientDataError
from elastocal.identification.robust.design import Design, lengths
from elastocal.identification.robust.loss import Bisquare
from elastocal.identification.robust.scale import expected_rho, m_scale, median_length

Array = NDArray[np.float64]

SUBSETS = 300
FINALISTS, WINNERS = 6, 2  # candidates refined further, and to the end
FIRST_STEPS, MORE_STEPS = 2, 12
SEARCH = 1500  # observations searched; the winners are refined on all
DETERMINED = 1e-4  # share of a subset's mean information that its worst direction must have
SETTLED = 1e-9
MAX_REFINE = 100


def s_estimate(
    problem: Design, loss: Bisquare, seed: int, subsets: int = SUBSETS, starts: Array | None = None
) -> tuple[Array, float]:
    """Coordinates z (p,) and scale of the S-estimate, over random subsets and `starts` (k, p)."""
    search = _searched(problem, np.random.default_rng(seed))
    candidates = (problem.Q.T @ problem.y)[None]
    if starts is not None:
        candidates = np.concatenate([candidates, starts])
    if subsets:
        drawn = _subset_fits(search, np.random.default_rng(seed + 1), subsets)
        drawn = _improve(search, drawn, loss, FIRST_STEPS)
        best = np.argsort(_scales(search, drawn, loss), kind="stable")[:FINALISTS]
        candidates = np.concatenate([candidates, drawn[best]])
    candidates = _improve(search, candidates, loss, MORE_STEPS)
    order = np.argsort(_scales(search, candidates, loss), kind="stable")[:WINNERS]
    return min((_refine(problem, candidates[k], loss) for k in order), key=_scale_of)


def _scale_of(found: tuple[Array, float]) -> float:
    return found[1]


def _searched(problem: Design, rng: np.random.Generator) -> Design:
    """All of the problem, or a random part of it that still determines every parameter."""
    if problem.n <= SEARCH:
        return problem
    chosen = np.sort(rng.choice(problem.n, SEARCH, replace=False))
    rows = (chosen[:, None] * problem.size + np.arange(problem.size)).ravel()
    Q = problem.Q[rows]
    information = np.linalg.eigvalsh(Q.T @ Q) * problem.n / SEARCH
    if information[0] < DETERMINED:
        return problem
    return Design(problem.B[rows], problem.y[rows], problem.size, Q, problem.R, problem.norm)


def _products(problem: Design) -> tuple[Array, Array]:
    """Q_iᵀQ_i (n, p·p) and Q_iᵀy_i (n, p) of every observation."""
    Q3 = problem.Q.reshape(problem.n, problem.size, problem.p)
    gram = (Q3.transpose(0, 2, 1) @ Q3).reshape(problem.n, -1)
    return gram, np.einsum("nij,ni->nj", Q3, problem.y.reshape(problem.n, -1))


def _subset_fits(problem: Design, rng: np.random.Generator, subsets: int) -> Array:
    """Least-squares fits (subsets, p) to random subsets just large enough to determine them."""
    n, p = problem.n, problem.p
    gram, moment = _products(problem)
    order = rng.permuted(np.tile(np.arange(n), (subsets, 1)), axis=1)
    smallest = min(-(-p // problem.size), n)
    first = order[:, :smallest]
    G = gram[first].sum(axis=1).reshape(subsets, p, p)
    g = moment[first].sum(axis=1)
    taken = np.full(subsets, smallest)
    open_ = ~_determined(G)
    while open_.any() and taken.max() < n:
        k = np.flatnonzero(open_)
        added = order[k, taken[k]]
        G[k] += gram[added].reshape(-1, p, p)
        g[k] += moment[added]
        taken[k] += 1
        open_[k] = ~_determined(G[k])
    return np.asarray(np.linalg.solve(_regular(G), g[..., None]))[..., 0]


def _regular(G: Array) -> Array:
    """G (k, p, p) with a ridge at rounding size, so that no factorisation fails."""
    p = G.shape[-1]
    ridge = 1e-13 * np.trace(G, axis1=1, axis2=2) + np.finfo(float).tiny
    return G + ridge[:, None, None] * np.eye(p)


def _determined(G: Array) -> NDArray[np.bool_]:
    p = G.shape[-1]
    pivots = np.diagonal(np.linalg.cholesky(_regular(G)), axis1=1, axis2=2) ** 2
    mean = np.trace(G, axis1=1, axis2=2) / p
    return np.asarray(pivots.min(axis=1) > DETERMINED * mean)


def _improve(problem: Design, z: Array, loss: Bisquare, steps: int) -> Array:
    """`steps` concentration steps of every candidate z (k, p) at once."""
    gram, moment = _products(problem)
    p = problem.p
    d = _lengths(problem, z)
    scale = np.maximum(np.median(d, axis=1) / median_length(problem.size), problem.floor)
    for _ in range(steps):
        scale = _scale_step(problem, d, scale, loss)
        w = loss.weight(d / scale[:, None])
        G = _regular((w @ gram).reshape(-1, p, p))
        z = np.asarray(np.linalg.solve(G, (w @ moment)[..., None]))[..., 0]
        d = _lengths(problem, z)
    return z


def _lengths(problem: Design, z: Array) -> Array:
    """|e_i| (k, n) of the candidates z (k, p)."""
    r = problem.y - z @ problem.Q.T
    return np.sqrt((r.reshape(len(z), problem.n, problem.size) ** 2).sum(axis=2))


def _scale_step(problem: Design, d: Array, scale: Array, loss: Bisquare) -> Array:
    """One fixed-point step of the M-scale for every candidate; d (k, n), scale (k,)."""
    target = expected_rho(loss) * (problem.n - problem.p / problem.size)
    share = loss.rho(d / scale[:, None]).sum(axis=1) / target
    return np.maximum(scale * np.sqrt(share), problem.floor)


def _scales(problem: Design, z: Array, loss: Bisquare) -> Array:
    """M-scale (k,) of every candidate to a few digits, enough to rank them."""
    d = _lengths(problem, z)
    scale = np.median(d, axis=1) / median_length(problem.size)
    scale = np.maximum(scale, problem.floor)
    for _ in range(8):
        scale = _scale_step(problem, d, scale, loss)
    return scale


def _refine(problem: Design, z: Array, loss: Bisquare) -> tuple[Array, float]:
    """Iterate one candidate until its M-scale no longer falls, or rejection leaves too little."""
    size, p = problem.size, problem.p
    r = problem.residual(z)
    scale = max(m_scale(lengths(r, size), loss, p), problem.floor)
    for _ in range(MAX_REFINE):
        w = loss.weight(lengths(r, size) / scale)
        try:
            moved = z + problem.weighted_step(w, r)
        except InsufficientDataError:
            break
        residual = problem.residual(moved)
        lower = max(m_scale(lengths(residual, size), loss, p), problem.floor)
        if lower >= scale:
            break
        settled = scale - lower <= SETTLED * scale
        z, r, scale = moved, residual, lower
        if settled:
            break
    return z, scale
