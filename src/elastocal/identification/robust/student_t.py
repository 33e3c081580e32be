"""Maximum likelihood under multivariate Student-t errors, ν given or estimated."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, special

from elastocal.errors import InputError, require
from elastocal.identification.robust.design import Design, design, lengths
from elastocal.identification.robust.estimate import RobustEstimate, score_optimality
from elastocal.identification.robust.loss import StudentT
from elastocal.identification.robust.scale import median_scale

Array = NDArray[np.float64]

NU_RANGE = (1.0, 200.0)  # below 1 the likelihood may be unbounded; at 200 the t is normal
TOLERANCE = 1e-11
MAX_ITER = 2000


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

    Raises InputError for wrong shapes, dependent columns or ν outside (0, ∞).
    """
    problem = design(B, y, size)
    z = problem.Q.T @ problem.y
    r = problem.residual(z)
    state = z, max(median_scale(lengths(r, size), size), problem.floor)
    if nu is not None:
        return _estimate(problem, StudentT(size, nu), *state)
    require(problem.n > problem.p, "estimating ν needs more observations than parameters")

    def cost(log_nu: float) -> float:
        nonlocal state
        found = _estimate(problem, StudentT(size, float(np.exp(log_nu))), *state)
        state = problem.coordinates(found.x), found.scale
        return -log_likelihood(found)

    bounds = np.log(NU_RANGE)
    best = optimize.minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return _estimate(problem, StudentT(size, float(np.exp(best.x))), *state)


def log_likelihood(found: RobustEstimate) -> float:
    """Sum of the logarithms of the multivariate t densities of y at the estimate.

    Raises InputError for an estimate with another loss.
    """
    loss, n = found.loss, found.design.n
    if not isinstance(loss, StudentT):
        raise InputError(f"a Student-t likelihood needs a Student-t estimate, not {loss.name}")
    nu, size = loss.nu, loss.size
    constant = special.gammaln((nu + size) / 2) - special.gammaln(nu / 2)
    constant -= size / 2 * np.log(nu * np.pi) + size * np.log(found.scale)
    return float(n * constant - found.objective)


def _estimate(problem: Design, loss: StudentT, z: Array, scale: float) -> RobustEstimate:
    size = problem.size
    r = problem.residual(z)
    converged, count = False, 0
    while not converged and count < MAX_ITER:
        w = loss.weight(lengths(r, size) / scale)
        step = problem.weighted_step(w, r)
        z = z + step
        r = problem.residual(z)
        before = scale
        squared = lengths(r, size) ** 2
        scale = max(float(np.sqrt(w @ squared / (size * w.sum()))), problem.floor)
        count += 1
        moved = float(np.linalg.norm(step))
        still = moved <= 4 * np.finfo(float).eps * np.linalg.norm(z)
        converged = bool(
            (moved <= TOLERANCE * scale or still) and abs(scale - before) <= TOLERANCE * scale
        )
    optimality = score_optimality(problem, loss, r, scale)
    return RobustEstimate(
        problem, loss, problem.parameters(z), r, scale, converged, count, optimality
    )
