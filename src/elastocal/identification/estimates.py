"""From a solution to estimates: covariance, t intervals, combinations, correlations."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from elastocal.identification.advice import warnings_for
from elastocal.identification.heldout import rms_3d
from elastocal.identification.lack_of_fit import lack_of_fit
from elastocal.identification.linear import solve_weighted
from elastocal.identification.result import (
    Combination,
    Estimate,
    IdentificationResult,
    Outlier,
)
from elastocal.identification.solve import Solution, residual_sigma
from elastocal.manipulator.model import Model

Array = NDArray[np.float64]

CORRELATED = 0.9


def summarise(
    model: Model,
    solution: Solution,
    outliers: tuple[Outlier, ...],
    excluded: tuple[Outlier, ...],
) -> IdentificationResult:
    """Estimates with 95 % t intervals from cov(X̂) = s² (BᵀW²B)⁻¹ (eq. 7 and 13).

    s² is the weighted residual's mean square per degree of freedom, also where the noise was
    stated: a stated sigma that the residuals contradict is not believed.
    """
    problem, reduction, final = solution.problem, solution.reduction, solution.fit
    kept = reduction.kept
    B = problem.weights.apply(final.B)
    linear = solve_weighted(B, final.whitened, scale=solution.sizes[kept])
    sigma = residual_sigma(final, len(kept))
    dof = len(final.whitened) - len(kept)
    covariance = sigma**2 * linear.cofactor
    std = np.sqrt(np.diag(covariance))
    half = float(stats.t.ppf(0.975, dof)) * std
    estimates, combinations = _estimates(model, solution, std, half)
    determined = tuple(model.names[c] for c in kept)
    seen = problem.observations
    misfit = lack_of_fit(seen, final.whitened, len(kept))
    noise: dict[str, Any] = {
        "kind": problem.weights.kind,
        "description": problem.weights.description,
        "sigma_um": None if problem.weights.absolute else sigma * 1e6,
        "ratio_to_stated": sigma if problem.weights.absolute else None,
        "lack_of_fit": None if misfit is None else asdict(misfit),
    }
    result = IdentificationResult(
        model=model,
        method="ols" if problem.weights.kind == "none" else "wls",
        noise=noise,
        estimates=estimates,
        combinations=combinations,
        x=final.x,
        determined=determined,
        covariance=covariance,
        correlations=_correlations(covariance, determined),
        observations=seen,
        residual=final.residual,
        held_out=solution.heldout,
        sigma=sigma,
        dof=dof,
        residual_rms=rms_3d(final.residual, seen.size),
        heldout_rms=rms_3d(solution.heldout, seen.size),
        nominal_rms=solution.nominal_rms,
        converged=final.converged,
        reason=final.reason,
        outliers=outliers,
        excluded=excluded,
        warnings=(),
    )
    return warnings_for(result, solution)


def _estimates(
    model: Model, solution: Solution, std: Array, half: Array
) -> tuple[tuple[Estimate, ...], tuple[Combination, ...]]:
    reduction, x = solution.reduction, solution.fit.x
    partners: dict[int, list[str]] = {int(d): [] for d in reduction.dropped}
    found: dict[int, Estimate] = {}
    combinations = []
    for k, c in enumerate(reduction.kept):
        parameter = model.parameters[c]
        terms = reduction.terms(k, solution.sizes, std[k])
        value, ci = float(x[c]), (float(x[c] - half[k]), float(x[c] + half[k]))
        for d in terms:
            partners[d].append(parameter.name)
        names = tuple(model.names[d] for d in terms)
        if terms:
            shares = {parameter.name: 1.0} | {model.names[d]: f for d, f in terms.items()}
            combination = Combination(shares, parameter.unit, value, float(std[k]), ci)
            combinations.append(combination)
            found[int(c)] = Estimate(
                parameter.name, parameter.unit, parameter.nominal, value,
                combined_with=names, note=f"only as {combination.expression}",
            )  # fmt: skip
        else:
            found[int(c)] = Estimate(
                parameter.name, parameter.unit, parameter.nominal, value, value,
                float(std[k]), ci,
            )  # fmt: skip
    invisible = set(reduction.invisible.tolist())
    for d in reduction.dropped:
        p = model.parameters[d]
        note = "held: no reading depends on it enough to determine it"
        if int(d) not in invisible and partners[int(d)]:
            note = "held: known only together with " + ", ".join(partners[int(d)])
        found[int(d)] = Estimate(
            p.name, p.unit, p.nominal, float(x[d]), combined_with=tuple(partners[int(d)]), note=note
        )
    for c in reduction.at_bound:
        p = model.parameters[c]
        note = f"held at its bound {x[c]:g}: the data want it beyond"
        found[int(c)] = Estimate(p.name, p.unit, p.nominal, float(x[c]), note=note)
    for i, p in enumerate(model.parameters):
        if i not in found:
            found[i] = Estimate(p.name, p.unit, p.nominal, float(x[i]), note="fixed by the user")
    return tuple(found[i] for i in range(len(model.parameters))), tuple(combinations)


def _correlations(covariance: Array, names: tuple[str, ...]) -> tuple[tuple[str, str, float], ...]:
    """Pairs with |ρ| over 0.9, strongest first."""
    std = np.sqrt(np.diag(covariance))
    rho = covariance / np.outer(std, std)
    i, j = np.triu_indices(len(names), k=1)
    strong = [(a, b) for a, b in zip(i, j, strict=True) if abs(rho[a, b]) > CORRELATED]
    strong.sort(key=lambda ab: -abs(rho[ab]))
    return tuple((names[a], names[b], float(rho[a, b])) for a, b in strong)
