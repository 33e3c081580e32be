"""What the noise is, in words and as rows: model, sizes, candidates, repeats, shape."""

from __future__ import annotations

import numpy as np

from elastocal.identification.findings import shape_of
from elastocal.identification.noise_summary import Noise, NoiseSize
from elastocal.identification.residual_summary import GroupSummary, ResidualSummary
from elastocal.identification.result import IdentificationResult
from elastocal.identification.variance.choose import SHARED
from elastocal.report.method import method_of
from elastocal.report.units import length, significant
from elastocal.report.words import printable
from elastocal.tracker_noise import available_noise

FEW = 6  # sizes that are named one by one; of more, the range and the extremes
MOST_GROUPS = 4
TURNED = ("rx", "ry", "rz", "rotation", "angular")  # sizes in rad

KINDS = {
    "independent": "equal noise",
    "axis": "one size per axis",
    "marker": "one size per marker",
    "groups": "one size per configuration and direction",
    "polar": "range and transverse sizes of the tracker",
    "stated": "stated noise × factor",
}
COMPARED = (
    "residual_above_stated_noise",
    "residual_agrees_with_stated_noise",
    "residual_below_stated_noise",
)
SHAPES = {
    "residuals_skew": "errors lean to one side, as an effect that the model lacks would make them.",
    "residuals_heavy_tailed": (
        "far readings are more frequent. A robust method (huber, tukey, student-t) shows "
        "whether the estimates depend on them."
    ),
    "residuals_light_tailed": "far readings are rarer, as with rounded or selected readings.",
}


def does_noise_explain_it(result: IdentificationResult) -> str:
    """Residual against stated noise, as the finding has it."""
    f = result.finding(*COMPARED)
    if f is None:
        sigma, method = result.noise.sigma, method_of(result)
        size = ""
        if sigma is not None and method == "ols":
            size = f"; the residual amounts to {length(sigma)} per coordinate"
        elif _is_estimated(result):
            size = "; the size of the noise was estimated from the readings"
        return f"{_why_not_judged(result)}{size}."
    size = (
        f"{significant(f.number('ratio'))} times the stated noise; chance alone gives "
        f"{f.number('by_chance_from'):.2f} to {f.number('by_chance_to'):.2f}"
    )
    if f.kind == "residual_agrees_with_stated_noise":
        return f"The residual agrees with the stated noise ({size})."
    if f.kind == "residual_above_stated_noise":
        text = (
            f"The residual is larger than the stated noise explains ({size}): something is "
            "unmodelled, or the noise is larger than stated."
        )
    else:
        text = f"The residual is smaller than the stated noise ({size}): it was stated too large."
    if _is_estimated(result):
        text += " Weights and intervals follow the noise that the readings show."
    return text


def _is_estimated(result: IdentificationResult) -> bool:
    """Whether the weights come from a noise model with estimated variances."""
    return method_of(result) in ("reml", "constrained") and result.noise.estimated


def _why_not_judged(result: IdentificationResult) -> str:
    """What is missing for a comparison of the residual with stated noise."""
    seen, tracker = result.observations, result.model.cell.tracker
    stated = available_noise(seen.table, tracker) != "none"
    if seen.kind == "distance":
        stated = tracker.distance_sigma is not None
    nothing_says = "so nothing says how small the residual should be"
    if seen.kind == "pose" and stated != (tracker.rotation_sigma is not None):
        which = "positions" if stated else "rotations"
        return f"Noise was stated for {which} only, {nothing_says}"
    if stated or result.noise.kind == "covariance":
        return "The residual was not compared with the stated noise"
    return f"No noise was stated, {nothing_says}"


def noise_model_line(result: IdentificationResult) -> str | None:
    """The estimated noise model with its sizes, and why it was chosen."""
    noise = result.noise
    sizes, reason = size_rows(noise), noise.reason
    if not sizes and not reason:
        return None
    text = printable(noise.description)
    text = text[:1].upper() + text[1:]
    if sizes:
        text += ": " + "; ".join(f"{name} {size}" for name, size in sizes)
    candidates = candidate_rows(noise)
    if len(candidates) > 1:
        second, _, gap = candidates[1]
        n = len(candidates)
        reason = f"smallest information criterion of {n} models, next {second} (+{gap})"
    return f"{text}. Chosen: {printable(reason)}." if reason else f"{text}."


def size_rows(noise: Noise) -> list[tuple[str, str]]:
    """Name and standard deviation of every noise component; of many, the two extremes."""
    sizes = noise.sizes or ()
    shared = [s for s in sizes if s.shared]
    own = [s for s in sizes if not s.shared]
    if len(own) <= FEW:
        return [(printable(s.name), _size(s)) for s in [*own, *shared]]
    ordered = sorted(own, key=_number)
    middle = ordered[len(ordered) // 2]
    named = [("smallest", ordered[0]), ("largest", ordered[-1])]
    return [
        (f"median of {len(own)}", _size(middle)),
        *((f"{which} ({printable(s.name)})", _size(s)) for which, s in named),
        *((printable(s.name), _size(s)) for s in shared),
    ]


def candidate_rows(noise: Noise) -> list[tuple[str, str, str]]:
    """Noise models that were tried, best first: words, variances, criterion above the best."""
    tried = sorted(noise.tried or (), key=lambda t: t.criterion)
    return [
        (
            kind_in_words(t.kind),
            str(t.n_variances),
            f"{t.criterion - tried[0].criterion:.1f}",
        )
        for t in tried
    ]


def kind_in_words(kind: str) -> str:
    text = KINDS.get(kind.removesuffix(SHARED), printable(kind.removesuffix(SHARED)))
    return f"{text} + deviations of a configuration" if kind.endswith(SHARED) else text


def repeats_line(result: IdentificationResult) -> str | None:
    """The lack-of-fit test, and what follows from it for the intervals; None without repeats."""
    f = result.finding("lack_of_fit", "repeats_agree")
    if f is None:
        return None
    numbers = (
        f"lack of fit: F = {f.number('F'):.2f} on {f.numbers['dof_between']} and "
        f"{f.numbers['dof_pure']} degrees of freedom, {_p(f.number('p'))}"
    )
    counted = f.numbers["counted_by"]
    if f.kind == "repeats_agree":
        text = f"Repeats agree with the scatter between configurations ({numbers})"
        if counted == "the noise model":
            return (
                f"{text}: the test shows no common deviation. The noise model, chosen by its "
                "criterion, has one; the intervals include it."
            )
        return f"{text}: readings of one configuration bear no common deviation worth counting."
    text = (
        f"Configurations scatter more than repeats of one explain ({numbers}): the arm does not "
        "come back to the same place, or an effect is missing."
    )
    if counted == "the noise model":
        return f"{text} The noise model has this common deviation; the intervals include it."
    if counted == "the intervals":
        return f"{text} The intervals take each configuration as a whole and include it."
    return (
        f"{text} The intervals do not include it and are too narrow: use the default method, whose "
        "noise model has it, or intervals by cr2; measure more configurations, not more repeats."
    )


def shape_line(summary: ResidualSummary) -> str:
    """Are the standardised residuals normal, and does any group scatter unlike the model?"""
    f = shape_of(summary)
    numbers = (
        f"skewness {f.number('skewness'):+.2f}, excess kurtosis {f.number('excess_kurtosis'):+.2f}"
    )
    if f.kind == "residuals_too_few":
        text = f"Too few values to judge whether residuals are normal ({numbers})."
    elif f.kind == "residuals_normal":
        numbers += f", {_p(f.number('p'))}"
        text = f"Standardised residuals agree with a normal distribution ({numbers})."
    else:
        numbers += f", {_p(f.number('p'))}"
        text = f"Standardised residuals are not normal ({numbers}): {SHAPES[f.kind]}"
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


def _size(s: NoiseSize) -> str:
    if s.sigma is None:
        return significant(_number(s))
    if s.name in TURNED or s.name.endswith("(rotation)"):
        return f"{significant(s.sigma * 1e6)} µrad"
    return length(s.sigma)


def _number(s: NoiseSize) -> float:
    return (s.factor or 0.0) if s.sigma is None else s.sigma


def _p(p: float) -> str:
    return "p < 1e-6" if p < 1e-6 else f"p = {significant(p, 2)}"
