"""Warnings as sentences that name the remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg

from elastocal.errors import option
from elastocal.identification.outliers import blocks
from elastocal.identification.result import Calibration, Outlier
from elastocal.identification.solve import Solution
from elastocal.identification.variance.choose import SHARED

FEW_DOF_PER_PARAMETER = 1.0
ILL_CONDITIONED = 1e3  # intervals this many times as wide as if each stood alone
FAR_ABOVE_STATED = 2.0
MANY = 0.05
LACK_OF_FIT = 0.001  # false-alarm rate of a sentence that calls intervals too narrow


def warnings_for(result: Calibration, solution: Solution) -> Calibration:
    """The same result with its warnings."""
    found = [
        *_convergence(result),
        *_few_poses(result),
        *_conditioning(result, solution),
        *_noise(result),
        *_lack_of_fit(result),
        *_bounds(result, solution),
        *_outliers(result),
    ]
    return replace(result, warnings=tuple(found))


def _convergence(result: Calibration) -> list[str]:
    if result.converged:
        return []
    return [
        f"The fit did not converge: {result.reason}. Give start hints in [model.nominal], fit "
        "fewer effects, or measure more poses."
    ]


def _few_poses(result: Calibration) -> list[str]:
    found, n = [], len(result.determined)
    if result.dof < FEW_DOF_PER_PARAMETER * n:
        found.append(
            f"Only {result.dof} degrees of freedom for {n} determined parameters: intervals are "
            "wide and the residual flatters the model. Measure more poses."
        )
    if not np.isfinite(result.heldout_rms):
        found.append(
            "Some configuration alone determines a parameter, so there is no held-out error for "
            "it. Measure more configurations."
        )
    return found


def _conditioning(result: Calibration, solution: Solution) -> list[str]:
    kept = solution.reduction.kept
    # Unit columns: what is judged is how far they are from parallel, not their units.
    scaled = solution.fit.triangle.R
    scaled = scaled / np.linalg.norm(scaled, axis=0)
    _, singular, Vt = linalg.svd(scaled[: len(kept)])
    if singular[0] <= ILL_CONDITIONED * singular[-1]:
        return []
    worst = np.argsort(-np.abs(Vt[-1]))[:3]
    names = ", ".join(result.determined[i] for i in worst)
    return [
        f"Ill-conditioned (condition number {singular[0] / singular[-1]:.1e} after scaling): the "
        f"data barely separate {names}. Measure poses in which these joints differ more, or fix "
        "one of them."
    ]


def _noise(result: Calibration) -> list[str]:
    ratio = result.noise["ratio_to_stated"]
    if ratio is None or ratio < FAR_ABOVE_STATED:
        return []
    return [
        f"The residual is {ratio:.1f} times the stated noise: something is unmodelled or the "
        "stated noise is too small. The intervals use the residual, not the stated noise; look "
        "for effects that the model lacks."
    ]


def _lack_of_fit(result: Calibration) -> list[str]:
    found = result.noise["lack_of_fit"]
    if found is None or found["p"] > LACK_OF_FIT or str(result.noise["kind"]).endswith(SHARED):
        return []  # shared effects in the noise model: the intervals count with them
    return [
        f"Configurations scatter more than their repeats (lack of fit: F = {found['F']:.2f} on "
        f"{found['dof_between']} and {found['dof_pure']} degrees of freedom, p = {found['p']:.1g}):"
        " the arm does not come back to the same place, or an effect is missing. The intervals "
        "take all readings for independent and are too narrow: use the default method, whose noise "
        "model has this scatter, or intervals by cr2; measure more configurations rather than more "
        "repeats."
    ]


def _bounds(result: Calibration, solution: Solution) -> list[str]:
    found = []
    at_bound = {result.model.names[c] for c in solution.reduction.at_bound}
    for e, p in zip(result.estimates, result.model.parameters, strict=True):
        if p.lower < e.held < p.upper or not (np.isfinite(p.lower) or np.isfinite(p.upper)):
            continue
        bound = p.lower if e.held <= p.lower else p.upper
        if p.name in at_bound:
            found.append(
                f"{e.name} stands at its bound {bound:g} {e.unit}; it is held there and has no "
                "interval. Check load direction and torque signs, or measure poses that load it "
                "more."
            )
        elif e.value is not None and e.std is not None and abs(e.value - bound) > 2 * e.std:
            found.append(
                f"{e.name} = {e.value:.3g} ± {e.std:.2g} {e.unit} lies beyond its physical bound "
                f"{bound:g}: check load direction and torque signs, measure poses that load it "
                "more, or fit with bounds."
            )
    return found


def _lines(readings: tuple[Outlier, ...]) -> str:
    """ "lines 142–507, 610 …": runs of lines, the first eight."""
    runs = blocks([o.line for o in readings])
    shown = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in runs[:8])
    return f"lines {shown}{' …' if len(runs) > 8 else ''}"


def _count(readings: tuple[Outlier, ...], one: str, many: str) -> str:
    n = len(readings)
    return f"1 reading {one}" if n == 1 else f"{n} readings {many}"


def _outliers(result: Calibration) -> list[str]:
    found = []
    if result.outliers:
        lines = _lines(result.outliers)
        found.append(
            f"{_count(result.outliers, 'lies', 'lie')} beyond what the noise explains ({lines}) "
            f"and had a part in the fit. Check them; {option('outliers', 'drop')} leaves them out."
        )
        if len(result.outliers) > MANY * len(result.observations.lead):
            found.append(
                "That is too large a share for reading errors: a shifted block of readings, or an "
                "effect that the model lacks in some load state, marker or region. Look at where "
                "they lie before leaving any out."
            )
    if result.excluded:
        lines = _lines(result.excluded)
        found.append(
            f"{_count(result.excluded, 'was', 'were')} left out as faulty ({lines}): the "
            "noise does not explain them. All are listed in the result under 'excluded'; "
            f"{option('outliers', 'keep')} fits them too."
        )
    return found
