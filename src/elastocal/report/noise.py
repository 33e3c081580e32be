"""What the noise is, in words and as rows: model, sizes, candidates, repeats, shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from elastocal.identification.residual_summary import GroupSummary, ResidualSummary
from elastocal.identification.result import Calibration
from elastocal.identification.variance.choose import SHARED
from elastocal.report.method import method_of, takes_configurations_as_a_whole
from elastocal.report.units import length, significant
from elastocal.report.words import printable
from elastocal.tracker_noise import available_noise

FEW = 6  # sizes that are named one by one; of more, the range and the extremes
MOST_GROUPS = 4
LACK_OF_FIT = 0.01
NOT_NORMAL = 0.01
TURNED = ("rx", "ry", "rz", "rotation", "angular")  # sizes in rad

KINDS = {
    "independent": "equal noise",
    "axis": "one size per axis",
    "marker": "one size per marker",
    "groups": "one size per configuration and direction",
    "polar": "range and transverse sizes of the tracker",
    "stated": "stated noise × factor",
}


def does_noise_explain_it(result: Calibration) -> str:
    """Residual against stated noise, judged by the χ² distribution of its mean square."""
    ratio = result.noise.get("ratio_to_stated")
    if ratio is None:
        sigma, method = result.noise.get("sigma_um"), method_of(result)
        size = ""
        if sigma is not None and method == "ols":
            size = f"; the residual amounts to {length(sigma * 1e-6)} per coordinate"
        elif _is_estimated(result):
            size = "; the size of the noise was estimated from the readings"
        return f"{_why_not_judged(result)}{size}."
    low, high = np.sqrt(stats.chi2.ppf([0.025, 0.975], result.dof) / result.dof)
    band = f"chance alone gives {low:.2f} to {high:.2f}"
    size = f"{significant(ratio)} times the stated noise; {band}"
    if ratio > high:
        text = (
            f"The residual is larger than the stated noise explains ({size}): something is "
            "unmodelled, or the noise is larger than stated."
        )
    elif ratio < low:
        text = f"The residual is smaller than the stated noise ({size}): it was stated too large."
    else:
        return f"The residual agrees with the stated noise ({size})."
    if _is_estimated(result):
        text += " Weights and intervals follow the noise that the readings show."
    return text


def _is_estimated(result: Calibration) -> bool:
    """Whether the weights come from a noise model with estimated variances."""
    return method_of(result) in ("reml", "constrained") and bool(result.noise.get("variances"))


def _why_not_judged(result: Calibration) -> str:
    """What is missing for a comparison of the residual with stated noise."""
    seen, tracker = result.observations, result.model.cell.tracker
    stated = available_noise(seen.table, tracker) != "none"
    if seen.kind == "distance":
        stated = tracker.distance_sigma is not None
    nothing_says = "so nothing says how small the residual should be"
    if seen.kind == "pose" and stated != (tracker.rotation_sigma is not None):
        which = "positions" if stated else "rotations"
        return f"Noise was stated for {which} only, {nothing_says}"
    if stated or result.noise["kind"] == "covariance":
        return "The residual was not compared with the stated noise"
    return f"No noise was stated, {nothing_says}"


def noise_model_line(result: Calibration) -> str | None:
    """The estimated noise model with its sizes, and why it was chosen."""
    noise = result.noise
    sizes, reason = size_rows(noise), noise.get("reason")
    if not sizes and not reason:
        return None
    text = printable(str(noise["description"]))
    text = text[:1].upper() + text[1:]
    if sizes:
        text += ": " + "; ".join(f"{name} {size}" for name, size in sizes)
    candidates = candidate_rows(noise)
    if len(candidates) > 1:
        second, _, gap = candidates[1]
        n = len(candidates)
        reason = f"smallest information criterion of {n} models, next {second} (+{gap})"
    return f"{text}. Chosen: {printable(str(reason))}." if reason else f"{text}."


def size_rows(noise: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and standard deviation of every noise component; of many, the two extremes."""
    sizes = noise.get("variances") or []
    shared = [s for s in sizes if str(s["name"]).startswith("common to each")]
    own = [s for s in sizes if s not in shared]
    if len(own) <= FEW:
        return [(printable(str(s["name"])), _size(s)) for s in [*own, *shared]]
    ordered = sorted(own, key=_number)
    middle = ordered[len(ordered) // 2]
    named = [("smallest", ordered[0]), ("largest", ordered[-1])]
    return [
        (f"median of {len(own)}", _size(middle)),
        *((f"{which} ({printable(str(s['name']))})", _size(s)) for which, s in named),
        *((printable(str(s["name"])), _size(s)) for s in shared),
    ]


def candidate_rows(noise: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Noise models that were tried, best first: words, variances, criterion above the best."""
    tried = sorted(noise.get("tried") or [], key=lambda t: t["criterion"])
    return [
        (
            kind_in_words(str(t["kind"])),
            str(t["variances"]),
            f"{t['criterion'] - tried[0]['criterion']:.1f}",
        )
        for t in tried
    ]


def kind_in_words(kind: str) -> str:
    text = KINDS.get(kind.removesuffix(SHARED), printable(kind.removesuffix(SHARED)))
    return f"{text} + deviations of a configuration" if kind.endswith(SHARED) else text


def repeats_line(result: Calibration) -> str | None:
    """The lack-of-fit test, and what follows from it for the intervals; None without repeats."""
    found = result.noise.get("lack_of_fit")
    if found is None:
        return None
    numbers = (
        f"lack of fit: F = {found['F']:.2f} on {found['dof_between']} and {found['dof_pure']} "
        f"degrees of freedom, {_p(found['p'])}"
    )
    included = str(result.noise["kind"]).endswith(SHARED)
    if found["p"] >= LACK_OF_FIT:
        text = f"Repeats agree with the scatter between configurations ({numbers})"
        return f"{text}: readings of one configuration bear no common deviation worth counting."
    text = (
        f"Configurations scatter more than repeats of one explain ({numbers}): the arm does not "
        "come back to the same place, or an effect is missing."
    )
    if included:
        return f"{text} The noise model has this common deviation; the intervals include it."
    if takes_configurations_as_a_whole(result):
        return f"{text} The intervals take each configuration as a whole and include it."
    return (
        f"{text} The intervals do not include it and are too narrow: use the default method, whose "
        "noise model has it, or intervals by cr2; measure more configurations, not more repeats."
    )


def shape_line(summary: ResidualSummary) -> str:
    """Are the standardised residuals normal, and does any group scatter unlike the model?"""
    whole = summary.whole
    numbers = f"skewness {whole.skewness:+.2f}, excess kurtosis {whole.excess_kurtosis:+.2f}"
    p = whole.normality_p
    if p is None:
        text = f"Too few values to judge whether residuals are normal ({numbers})."
    elif p >= NOT_NORMAL:
        text = f"Standardised residuals agree with a normal distribution ({numbers}, {_p(p)})."
    else:
        text = f"Standardised residuals are not normal ({numbers}, {_p(p)})" + _consequence(whole)
    found = sum(g.n_deviating for g in summary.groupings)
    if not found:
        return f"{text} No group of readings scatters more or less than the noise model says."
    named = [f"{group_name(by, g)} {ratio(g)} times" for by, g in summary.deviating[:MOST_GROUPS]]
    more = found - len(named)
    tail = f", and {more} more" if more else ""
    return f"{text} Scatter unlike the noise model: {', '.join(named)}{tail}."


def group_name(by: str, group: GroupSummary) -> str:
    return f"{by} {printable(group.name)}"


def ratio(group: GroupSummary) -> str:
    """Observed over expected standard deviation."""
    return significant(float(np.sqrt(group.mean_square)), 2)


def _consequence(whole: GroupSummary) -> str:
    # Of a normal sample, kurtosis has twice the standard deviation of skewness.
    if abs(whole.skewness) > abs(whole.excess_kurtosis) / 2:
        return ": errors lean to one side, as an effect that the model lacks would make them."
    if whole.excess_kurtosis > 0:
        return (
            ": far readings are more frequent. A robust method (huber, tukey, student-t) shows "
            "whether the estimates depend on them."
        )
    return ": far readings are rarer, as with rounded or selected readings."


def _size(s: dict[str, Any]) -> str:
    if s.get("sigma_um") is None:
        return significant(float(s["factor"]))
    name = str(s["name"])
    if name in TURNED or name.endswith("(rotation)"):
        return f"{significant(float(s['sigma_um']))} µrad"
    return length(float(s["sigma_um"]) * 1e-6)


def _number(s: dict[str, Any]) -> float:
    return float(s["factor"] if s.get("sigma_um") is None else s["sigma_um"])


def _p(p: float) -> str:
    return "p < 1e-6" if p < 1e-6 else f"p = {significant(p, 2)}"
