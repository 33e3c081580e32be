"""How the numbers came about, in words: method, intervals, active constraints, prior."""

from __future__ import annotations

from typing import Any

from elastocal.identification.constrained.minimise import ActiveConstraint
from elastocal.identification.result import Calibration
from elastocal.report.units import display, plain
from elastocal.report.words import printable

MOST_NAMED = 6
MOSTLY = 0.5  # share of its information from which an estimate owes more to the prior

METHODS = {
    "reml": "generalised least squares, weights estimated by restricted likelihood (REML)",
    "ols": "ordinary least squares, all readings weighted alike",
    "wls": "weighted least squares",
    "eq14": "weighted least squares as published, weights of eq. (14) with σ by group, iterated",
    "eq14-residual": (
        "weighted least squares as published, weights of eq. (14) from each residual, iterated; "
        "it acts like a robust fit, and its stated intervals are far too narrow"
    ),
    "huber": "robust M-estimate with Huber's loss, which limits the pull of far readings",
    "tukey": "robust MM-estimate with Tukey's biweight, which gives far readings no weight at all",
    "l1": "least sum of residual lengths (L1), the robust relative of the median",
    "student-t": "maximum likelihood under Student-t noise, which expects some far readings",
}
# What the weights are is said by the method itself, or by the line on the noise model.
SAID = {"reml", "ols", "eq14", "eq14-residual"}

INTERVALS = {
    "kenward-roger": (
        "t intervals of Kenward and Roger, which count with the weights being estimated; they "
        "assume the noise model and normal noise"
    ),
    "classical": (
        "t intervals that take the readings for independent (after weighting) and the size of the "
        "noise from the residual, also where it was stated"
    ),
    "clustered": (
        "robust to correlation within a configuration; they assume independent configurations"
    ),
    "wild": (
        "wild cluster bootstrap over configurations; assumes only that these are independent, "
        "not equal or normal noise"
    ),
    "bootstrap": (
        "parametric bootstrap: noise drawn from the model and everything estimated anew; assumes "
        "the noise model, not that estimates are normal"
    ),
    "profile": (
        "profile of the sum of squares, which follows the curvature of the model and may be "
        "lopsided; assumes independent normal noise"
    ),
    "t under constraints": (
        "t intervals that take equalities for exact and end at bounds; no bound is active, and "
        "they assume the noise of the method"
    ),
    "posterior": (
        "t intervals of readings and prior together, ending at bounds; they take the prior at its "
        "word and assume the noise of the method"
    ),
    "constrained profile": (
        "profile of the fit under the constraints: one-sided at a bound, and too wide rather than "
        "too narrow near one; assumes normal noise"
    ),
    "constrained bootstrap": (
        "parametric bootstrap of the fit under the constraints: noise drawn from the model, its "
        "size taken for known, and fitted anew; assumes the noise model"
    ),
    "eq7": "as published, eq. (7): equal, independent noise of the residual's size",
    "eq8": "as published, eq. (8): independent noise whose σ are taken for known",
    "eq11": "as published, eq. (11): independent noise whose σ are taken for known",
    "eq13": (
        "as published, eq. (13): weights taken for known although they come from the same "
        "residuals, which makes the intervals too narrow"
    ),
}
HC = (
    "robust to unequal noise ({}): every reading may have a variance of its own; they assume "
    "independent readings"
)
CR = (
    "cluster-robust ({}): readings of a configuration may be correlated in any way; they assume "
    "independent configurations"
)
# Without correction for leverage: right in the limit of many rows or configurations.
LARGE = {
    "hc0": "that these are many",
    "hc1": "that these are many",
    "cr0": "that these are many",
    "cr1": "that these are many, ten or more per parameter",
}
SIGNS = {"lower": "≥", "upper": "≤", "equality": "="}
HELD = {
    "constrained profile": (
        "Intervals keep the constraints: they stop at bounds and take equalities for exact"
    ),
    "constrained bootstrap": "Intervals come from fits that keep the constraints too",
}
ROBUST = "asymptotic covariance of the robust estimate ({}); assumes independent readings"


def method_of(result: Calibration) -> str:
    return str(result.method).replace("_", "-")


def method_and_weights(result: Calibration) -> str:
    """The method, and the weights where the method does not say them."""
    method, noise = method_of(result), result.noise
    if method == "constrained":
        return _constrained(result)
    text = METHODS.get(method, printable(method))
    if method in SAID or noise["kind"] == "none":
        return text
    return f"{text}, {printable(str(noise['description']))}"


def _constrained(result: Calibration) -> str:
    """What was known besides the readings, and the weights that the method before it gave these."""
    prior, active = bool(result.prior_share), bool(result.active)
    text = "fit with a prior" if prior else "fit under constraints"
    text += " and under constraints" if prior and active else ""
    noise = result.noise
    if noise["kind"] == "none":
        return f"{text}, all readings weighted alike"
    how = "weights estimated by restricted likelihood (REML): " if noise.get("variances") else ""
    return f"{text}, {how}{printable(str(noise['description']))}"


def interval_kind(result: Calibration) -> str:
    found: dict[str, Any] = result.noise.get("intervals") or {"kind": "classical"}
    return str(found["kind"]).lower()


def takes_configurations_as_a_whole(result: Calibration) -> bool:
    """Whether the intervals hold where the readings of a configuration are correlated."""
    kind = interval_kind(result)
    return kind in ("wild", "clustered") or kind.startswith("cr")


def intervals_line(result: Calibration) -> str:
    """Which kind of interval, and what it assumes."""
    kind = interval_kind(result)
    if kind in INTERVALS:
        return INTERVALS[kind]
    if kind.startswith(("hc", "cr")):
        text = (HC if kind.startswith("hc") else CR).format(printable(kind.upper()))
        return f"{text} and {LARGE[kind]}" if kind in LARGE else text
    if kind in ("h1", "h2", "h3"):
        return ROBUST.format(kind.upper())
    description = result.noise["intervals"].get("description", "")
    return printable(f"{kind}: {description}" if description else kind)


def constraints_line(result: Calibration) -> str | None:
    """Which constraints hold with equality, and what the intervals make of them."""
    active = result.active
    if not active:
        return None
    units = {p.name: p.unit for p in result.model.parameters}
    texts = [_in_words(a, units) for a in active[:MOST_NAMED]]
    more = len(active) - len(texts)
    text = "; ".join([*texts, *([f"and {more} more"] if more else [])])
    bound = any(a.kind != "equality" for a in active)
    want = "; the readings alone would go beyond the bounds" if bound else ""
    held = HELD.get(interval_kind(result), "Intervals take these for exact")
    return f"Active: {text}. {held}{want}."


def _in_words(a: ActiveConstraint, units: dict[str, str]) -> str:
    """ "joint2.compliance ≥ 0 µrad/(N·m)"; a label of the user's own stays as it is."""
    label = printable(a.label)
    if a.kind == "semidefinite":
        return f"{label} (semidefinite)"
    own = a.kind == "equality" and a.label != f"{a.names[0]} = {a.value:.6g}"
    if len(a.names) != 1 or own or a.names[0] not in units:
        return label
    value, unit = display(a.value, units[a.names[0]])
    return f"{printable(a.names[0])} {SIGNS[a.kind]} {plain(value)} {unit}"


def prior_line(result: Calibration) -> str | None:
    """Parameters that owe more than half of their information to the prior."""
    shares = result.prior_share
    if not shares:
        return None
    mostly = sorted((n for n, s in shares.items() if s > MOSTLY), key=lambda n: -shares[n])
    if not mostly:
        largest = max((s for s in shares.values() if s == s), default=0.0)  # NaN: constrained
        return f"No estimate is mostly prior (largest share {_percent(largest)})."
    named = ", ".join(f"{printable(n)} {_percent(shares[n])}" for n in mostly[:MOST_NAMED])
    more = len(mostly) - MOST_NAMED
    text = f"Mostly prior, share of the information: {named}" + (
        f", and {more} more" if more > 0 else ""
    )
    return f"{text}. These data say little about them; poses that load them more would."


def _percent(share: float) -> str:
    """Never 100 % where the data say anything."""
    return f"{min(100 * share, 99.9):.3g} %" if share < 1 else "100 %"
