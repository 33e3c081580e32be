"""The method's fit again under constraints and with a prior: one more step on its weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

from elastocal.errors import InputError, option
from elastocal.identification.constrained import (
    ActiveConstraint,
    ConstrainedFit,
    constrained_fit,
    fitted_columns,
    own_bounds,
)
from elastocal.identification.constrained_intervals import LinearisedFit, intervals_with_knowledge
from elastocal.identification.constrained_solver import ResidualLoss, loss_of
from elastocal.identification.identifiability import Reduction, residual_sigma
from elastocal.identification.intervals import Intervals
from elastocal.identification.knowledge import Constraints
from elastocal.identification.least_squares import Fit, FitProblem
from elastocal.identification.options import Options
from elastocal.identification.residuals import held_out_residual
from elastocal.identification.robust_core import median_scale
from elastocal.identification.solve import Solution
from elastocal.identification.weighted_problem import RFactor
from elastocal.text import listed
from elastocal.units import Array, Progress

ROUNDING = 1e-9  # factors below this share of a typical size are no combination
CONTRADICTED = 0.001  # false-alarm rate of a sentence that doubts what the user knows


@dataclass(frozen=True)
class KnowledgeFit:
    """A solution under constraints and with a prior, its intervals, and what each contributed.

    `prior_share` by parameter, empty without a prior; parameters that equalities fix are left
    out.  `effective` is how many parameters the readings paid for, `leverage` (rows,) how much
    each drew the fit to itself.  `warnings` say where the readings contradict the knowledge.
    """

    solution: Solution
    intervals: Intervals
    active: tuple[ActiveConstraint, ...]
    prior_share: dict[str, float]
    effective: int
    leverage: Array
    warnings: tuple[str, ...]


def fit_with_knowledge(
    solution: Solution, before: Intervals, options: Options, progress: Progress
) -> KnowledgeFit:
    """Minimise Σ ρ(W (y − h(X))) + σ² (X − m)ᵀ C⁻¹ (X − m) under `options.constraints`.

    W and the readings are those of the method's `solution`, σ the noise of a whitened row under
    it, ρ squares or, for the method huber, Huber's loss.  `knowledge_columns` says what is fitted,
    `knowledge_intervals` what the intervals are; t intervals have the degrees of freedom of
    `before`, the method's own.

    Raises InputError for constraints that contradict each other or held values, names that are no
    parameters, and tables too large to hold B; InsufficientDataError where an equality names a
    parameter that readings, prior and equalities do not determine.
    """
    problem = solution.problem
    if problem.large:
        raise InputError(
            "constraints and priors need B as a whole, which a table of this size does not allow: "
            f"fit a part of the table, or {option('bounded', True)} for the physical bounds alone"
        )
    constraints = (options.constraints or Constraints()) + own_bounds(solution)
    prior, name = options.prior, "huber" if options.resolved == "huber" else "squares"
    size = problem.observations.size if name == "huber" else 1
    sigma = _noise(solution, name, size)
    columns = fitted_columns(solution, before.covariance.std, constraints, prior)
    posed = replace(problem, bounded=False).fit_of(columns, solution.fit.x, solution.sizes)
    progress("fitting under constraints" if prior is None else "fitting with the prior")
    found = constrained_fit(posed, constraints, prior=prior, loss=name, sigma=sigma)  # type: ignore[arg-type]
    loss: ResidualLoss = loss_of(name, size, sigma)  # type: ignore[arg-type]
    local = LinearisedFit.at(posed, found, constraints, prior, loss, sigma)
    progress("intervals under constraints" if prior is None else "intervals with the prior")
    intervals = intervals_with_knowledge(
        posed, found, local, constraints, prior, _dof(solution, before, columns),
        options.intervals, options.seed, options.jobs,
    )  # fmt: skip
    shares = {} if prior is None else dict(zip(found.names, local.prior_share, strict=True))
    known = replace(
        solution,
        fit=_as_fit(posed, found, local),
        reduction=_reduction(solution, found, local),
        heldout=_held_out(solution, found, local),
    )
    return KnowledgeFit(
        known, intervals, found.active,
        {n: float(s) for n, s in shares.items() if np.isfinite(s)},
        round(local.effective), local.leverage, _contradiction(solution, before, found, local),
    )  # fmt: skip


def _noise(solution: Solution, loss: str, size: int) -> float:
    """σ of a whitened row: of the residual, or for Huber's loss of its median length."""
    fit = solution.fit
    if loss == "squares":
        return residual_sigma(fit, len(fit.columns))
    lengths = np.linalg.norm(fit.whitened.reshape(-1, size), axis=1)
    return max(median_scale(lengths, size), 1e-12)


def _contradiction(
    solution: Solution, before: Intervals, found: ConstrainedFit, local: LinearisedFit
) -> tuple[str, ...]:
    """A sentence where the objective grew by more than noise explains (F-test), for squares.

    Rows of the prior and active constraints count as degrees of freedom, less the parameters they
    made estimable.  At active bounds the true distribution is smaller (χ̄²): the test is cautious.
    """
    stated = len(local.P) + len(found.active) - (len(found.columns) - len(solution.fit.columns))
    if stated < 1 or not local.loss.quadratic:
        return ()
    grown = found.objective - float(solution.fit.whitened @ solution.fit.whitened)
    dof = max(float(before.covariance.dof.min()), 1.0)
    F = max(grown, 0.0) / (stated * local.sigma**2)
    p = float(stats.f.sf(F, stated, dof) if np.isfinite(dof) else stats.chi2.sf(F * stated, stated))
    if p > CONTRADICTED:
        return ()
    what = [f"'{a.label}'" for a in found.active]
    what += ["the prior"] if len(local.P) else []
    return (
        f"The readings contradict {listed(what, 6)}: without, they are fitted better than noise "
        f"explains (F = {F:.1f} on {stated} and {dof:.0f} degrees of freedom, p = {p:.1g}). Check "
        "names, units and signs of what is stated, and whether the model lacks an effect.",
    )


def _dof(solution: Solution, before: Intervals, columns: NDArray[np.int64]) -> Array:
    """The method's degrees of freedom (columns,); its fewest for a parameter that it held."""
    known = dict(zip(solution.fit.columns.tolist(), before.covariance.dof.tolist(), strict=True))
    fewest = min(known.values())
    return np.array([known.get(c, fewest) for c in columns.tolist()])


def _as_fit(problem: FitProblem, found: ConstrainedFit, local: LinearisedFit) -> Fit:
    """As the fit of a method; its triangle has prior and equalities as further rows.

    Without them a parameter that no reading shows would leave it singular; equalities weigh as
    much as the readings of a parameter do.
    """
    A = local.system.A * local.unit
    rows = np.vstack([local.B, local.P, A / np.linalg.norm(A, axis=1)[:, None] / local.unit])
    rest = np.concatenate([local.e, local.lack, np.zeros(len(A))])
    return Fit(
        found.x, found.residual, found.whitened, RFactor.of(rows, rest), found.converged,
        found.reason, found.steps, replace(problem, x=found.x),
    )  # fmt: skip


def _reduction(solution: Solution, found: ConstrainedFit, local: LinearisedFit) -> Reduction:
    """What is fitted, what is held, and how a held parameter's error would move the estimates.

    A parameter that an active constraint holds back does not move: it stands for itself.
    """
    before, problem = solution.reduction, solution.problem
    observed, columns = problem.observations, found.columns
    dropped = np.setdiff1d(before.dropped, columns)
    at = problem.model.regressor(observed.table, found.x, dropped, observed)
    K = local.loss.root(problem.weights.apply(at.B), local.e)
    mixing = local.on_face @ (local.K.T @ K)
    share = np.abs(mixing) * solution.sizes[dropped] / solution.sizes[columns][:, None]
    mixing[share < ROUNDING] = 0.0
    return Reduction(columns, dropped, mixing, np.setdiff1d(before.invisible, columns))


def _held_out(solution: Solution, found: ConstrainedFit, local: LinearisedFit) -> Array:
    """Residual (rows,) of each configuration under a fit to the others and the prior.

    Linearised, with the active constraints kept active and Huber's weights as they are.
    """
    if not local.face.shape[1]:
        return found.residual
    observed, weights = solution.problem.observations, solution.problem.weights
    # The prior's rows go with no configuration, so that they are never left out.
    more = -len(local.P) % observed.size
    P = np.vstack([local.P, np.zeros((more, len(local.x)))])
    own = observed.configuration.max() + 1 + np.arange(len(P) // observed.size)
    whiten = sparse.diags_array(np.sqrt(local.loss.weights(local.e)))
    if weights.whiten is not None:
        whiten = whiten @ weights.whiten
    both = sparse.block_diag([whiten, sparse.eye_array(len(P))], format="csr")
    held = held_out_residual(
        np.vstack([found.B, P]) @ local.face,
        np.concatenate([found.residual, local.lack, np.zeros(more)]),
        replace(weights, whiten=sparse.csr_array(both)),
        np.concatenate([observed.configuration, own]),
        observed.size,
    )
    return held[: len(found.residual)]
