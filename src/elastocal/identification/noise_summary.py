"""What the result says of the noise: which model, its size, why, and whether repeats agree."""

from __future__ import annotations

import re
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.identification.lack_of_fit import LackOfFit, lack_of_fit
from elastocal.identification.methods import Found
from elastocal.identification.noise import Weights, block_diagonal, weights_for, whitener
from elastocal.identification.variance.choose import NoiseFit
from elastocal.identification.variance.judge import own_noise
from elastocal.identification.weighting import linearised
from elastocal.measurements import Measurements

Array = NDArray[np.float64]

NUMBERED = re.compile(r"^(marker|configuration) (\d+)")


def noise_summary(found: Found, sigma: float) -> dict[str, Any]:
    """JSON-ready: kind, description, sizes, reason, candidates, lack of fit, kind of intervals.

    `sigma` is the standard deviation of a whitened row.  `sigma_um` is the noise of a reading's
    component where one number says it, `ratio_to_stated` the residual over the stated noise where
    any was stated.
    """
    weights = found.solution.problem.weights
    misfit = _lack_of_fit(found)
    covariance = found.intervals.covariance
    summary: dict[str, Any] = {
        "kind": weights.kind,
        "description": weights.description,
        "sigma_um": None if weights.absolute else sigma * 1e6,
        "ratio_to_stated": _ratio_to_stated(found, sigma),
        "lack_of_fit": None if misfit is None else asdict(misfit),
        "intervals": {"kind": covariance.kind, "description": covariance.description},
    }
    if found.noise is not None:
        summary |= _estimated(found.noise, found.solution.problem.observations.table)
    elif found.solution.problem.large:
        summary["reason"] = (
            "the table is too large for a choice among noise models; stated noise, or equal noise "
            "where none is stated, is scaled to the residual"
        )
    return summary


def _estimated(noise: NoiseFit, table: Measurements) -> dict[str, Any]:
    fit = noise.fit
    labels = {"marker": table.marker_names, "configuration": table.configuration_labels}

    def label(numbered: re.Match[str]) -> str:
        return f"{numbered[1]} {labels[numbered[1]][int(numbered[2])]}"

    # The structure numbers markers and configurations; the user knows their names.
    names = [NUMBERED.sub(label, name) for name in fit.structure.names]
    own = [
        {"name": name, "sigma_um": None, "factor": float(np.sqrt(v))}
        if fit.structure.name == "stated"
        else {"name": name, "sigma_um": float(np.sqrt(v)) * 1e6}
        for name, v in zip(names, fit.own, strict=True)
    ]
    shared = [
        {"name": f"common to each {e.name}", "sigma_um": float(np.sqrt(v)) * 1e6}
        for e, v in zip(fit.shared, fit.common, strict=True)
    ]
    alone = fit.structure.name == "independent" and len(fit.own) == 1
    return {
        "kind": noise.kind,
        "description": noise.description,
        "reason": noise.reason,
        "sigma_um": float(np.sqrt(fit.own[0])) * 1e6 if alone else None,
        "variances": own + shared,
        "tried": [
            {"kind": t.kind, "variances": t.n_variances, "criterion": t.criterion}
            for t in noise.trials
        ],
    }


def _ratio_to_stated(found: Found, sigma: float) -> float | None:
    """Root mean square of the residual in units of the stated noise, per degree of freedom."""
    solution = found.solution
    if found.method == "wls" and solution.problem.weights.absolute:
        return sigma
    try:
        stated = weights_for(solution.problem.observations, solution.problem.model.cell.tracker)
    except InputError:
        return None
    if not stated.absolute:
        return None
    e = stated.apply(solution.fit.residual)
    return float(np.sqrt(e @ e / max(len(e) - len(solution.fit.columns), 1)))


def _lack_of_fit(found: Found) -> LackOfFit | None:
    """Repeats against configurations, each reading weighted by its own noise alone."""
    solution = found.solution
    problem, fit = solution.problem, solution.fit
    weights = problem.weights
    if found.noise is not None and any(found.noise.fit.common > 0):
        readings = linearised(problem.model, problem.observations, fit.x, fit.columns)
        own = block_diagonal(own_noise(found.noise.fit, readings)[0])
        weights = Weights("own", whitener(own), True, "")
    whitened = weights.apply(fit.residual)
    return lack_of_fit(problem.observations, whitened, len(fit.columns))
