"""Plans that determine all parameters, and the messages where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.design.exact.pool import admissible, random_plan, without
from elastocal.design.problem import Array, DesignProblem, IntArray
from elastocal.errors import InsufficientDataError
from elastocal.planning.information_matrices import SINGULAR, factorise

# Ridges, as shares of a candidate's mean information, under which a regular plan is looked for.
RIDGES = (1e-3, 1e-6, 1e-9)
ATTEMPTS = 20
# Singular values of a block, relative to its largest, below which a direction is not shown.
SHOWN = 1e-10


def is_regular(M: Array) -> bool:
    """Are all of M (S, p, p) regular, by a margin that no order of summation or columns uses up?"""
    return bool((factorise(M).condition < SINGULAR / 10).all())


def check_enough(problem: DesignProblem) -> None:
    """Raise InsufficientDataError where no plan of these shares can determine all parameters."""
    _, _, r, p = problem.blocks.shape
    n, known = problem.n_poses, _known(problem)
    needed = -(-(p - known) // r)
    if n < needed:
        prior = f" and the prior {known}" if known else ""
        raise InsufficientDataError(
            f"fewer equations than parameters: {n} poses of {r} readings give {n * r}{prior}, for "
            f"{p} parameters; plan at least {needed} poses, switch effects off or state a prior"
        )
    usable = np.flatnonzero(problem.shares[problem.group] > 0)
    if not is_regular(problem.prior + problem.sum_of(usable)):
        raise InsufficientDataError(
            f"all {len(usable)} candidates of the groups with a share together do not determine "
            f"the {p} parameters; allow other joint levels or more load, or switch effects off"
        )


def _known(problem: DesignProblem) -> int:
    """How many combinations of parameters the prior determines."""
    return min(int(np.linalg.matrix_rank(prior, hermitian=True)) for prior in problem.prior)


def log_det_gain(M: Array, blocks: Array) -> Array:
    """Σ_s log det(1 + B_si M_s⁻¹ B_siᵀ) (k,) for blocks (S, k, r, p): what adding i brings."""
    inverse = np.linalg.inv(M)[:, None]
    inner = blocks @ inverse @ blocks.swapaxes(-1, -2)
    return np.asarray(np.linalg.slogdet(np.eye(blocks.shape[2]) + inner)[1].sum(axis=0))


def ridge(problem: DesignProblem) -> Array:
    """Diagonal matrices (S, p, p): the mean information of the candidates, parameter by parameter.

    Parameters that differ in scale by orders of magnitude are so treated alike; 1 where no
    candidate shows a parameter.
    """
    mean = np.einsum("snrp,snrp->sp", problem.blocks, problem.blocks) / problem.n_candidates
    mean = np.where(mean > 0, mean, 1.0)
    return np.asarray(mean[:, :, None] * np.eye(mean.shape[1]))


def regular_plan(problem: DesignProblem, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """A plan of regular M near `chosen`: exchanges that raise Σ_s log det(M_s + δ), δ → 0.

    For small δ a determinant counts the rank first.  Each candidate stands with an orthonormal
    basis of what it shows, which leaves ranks as they are and lets no large candidate outweigh
    one that shows what the others do not.  Random plans are tried where `chosen` leads to none;
    raises InsufficientDataError where they do not either.
    """
    if is_regular(problem.prior + problem.sum_of(chosen)):
        return chosen
    even = _evened(problem)
    unit = np.eye(problem.blocks.shape[-1])
    for _ in range(ATTEMPTS):
        for delta in RIDGES:
            chosen = _raise_determinant(even, chosen, delta * unit)
            if is_regular(problem.prior + problem.sum_of(chosen)):
                return chosen
        chosen = random_plan(problem, rng)
    raise InsufficientDataError(
        f"no plan of {problem.n_poses} poses that determines all {len(unit)} parameters was found; "
        "plan more poses, other shares, or state a prior"
    )


def _evened(problem: DesignProblem) -> DesignProblem:
    """The problem with an orthonormal basis of its rows in place of each block, parameters in
    units of their mean information beforehand."""
    scale = 1 / np.sqrt(np.einsum("spp->sp", ridge(problem) + problem.prior))
    _, size, basis = np.linalg.svd(problem.blocks * scale[:, None, None, :], full_matrices=False)
    shown = size > SHOWN * size[..., :1]
    prior = problem.prior * scale[:, :, None] * scale[:, None, :]
    return replace(problem, blocks=basis * shown[..., None], prior=prior)


def _raise_determinant(problem: DesignProblem, chosen: IntArray, extra: Array) -> IntArray:
    """Exchanges, each the best for its pose, until none raises the determinant."""
    improved = True
    while improved:
        improved = False
        for out in np.unique(chosen):
            rest = without(chosen, out)
            into = admissible(problem, rest, int(problem.group[out]))
            M = problem.prior + extra + problem.sum_of(rest)
            gain = log_det_gain(M, problem.blocks[:, into])
            best = int(np.argmax(gain))
            if gain[best] > gain[np.searchsorted(into, out)] + 1e-6:
                chosen, improved = np.sort(np.append(rest, into[best])), True
    return chosen
