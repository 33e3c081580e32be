"""The judgement of an identification in words: the verdict, what speaks against it, what to do; how
the numbers came about: method, intervals, noise, faulty readings, functions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from elastocal.identification.faulty_readings import FaultyGroup
from elastocal.identification.findings import only_placed, shape_of, warning_sentences
from elastocal.identification.knowledge import ActiveConstraint
from elastocal.identification.noise_structure import Kind
from elastocal.identification.noise_summary import Noise, NoiseSize, ResidualSummary
from elastocal.identification.result import Calibration, Finding
from elastocal.identification.start import ROBUST
from elastocal.messages import gathered, listed, option, printable, rounded, some
from elastocal.model.observations import available_noise
from elastocal.report import blocks as say


def judgement(result: Calibration, reasons: bool = True) -> say.ShownVerdict:
    """With all its `reasons`, or where there are several without: they are lines of their own."""
    tone, several = result.verdict.tone, len(result.verdict.missing) > 1
    if tone == "poor":
        return say.ShownVerdict("poor", say.sentence(doubt_of(result)))
    if tone == "care":
        told = CARE if several and not reasons else doubt_of(result)
        return say.ShownVerdict("warn", f"{say.sentence(told)} {_accuracy(result)}")
    noise = " The residual is consistent with noise." * (result.finding(*COMPARED[1:]) is not None)
    return say.ShownVerdict("good", f"This calibration can be used. {_accuracy(result)}{noise}")


CARE = "use this calibration with care"


def doubt_of(result: Calibration) -> str:
    """What speaks against its use, without a point; empty where nothing does."""
    tone, doubts = result.verdict.tone, result.verdict.missing
    if tone == "poor":
        why = next(_doubt(f) for f in doubts if f.severity == "poor")
        return f"do not use this calibration: {why}"
    told = f": {'; and '.join(map(_doubt, doubts))}" if doubts else ""
    return f"{CARE}{told}" if tone == "care" else ""


def reasons_of(result: Calibration) -> list[str]:
    """Why it is to be used with care, where the verdict has not the room to say it."""
    doubts = result.verdict.missing
    several = result.verdict.tone == "care" and len(doubts) > 1
    return [say.sentence(_doubt(f)) for f in doubts] if several else []


def warnings_beside(result: Calibration) -> list[tuple[str, str]]:
    """Those that say more than the verdict, what to do next and the line on noise: what is only a
    note does not call for attention."""
    told = {"residual_above_stated_noise", "scatter_not_counted", "impossible_values"}
    said = {f.kind for f in result.verdict.missing} & told
    notes = {f.kind for f in result.findings if f.severity == "note"}
    of = warning_sentences(result)
    kinds = [(of.get(w, ""), printable(w)) for w in result.warnings]
    return [("Note" if kind in notes else say.WARNING, w) for kind, w in kinds if kind not in said]


def _length(f: Finding, name: str) -> str:
    return say.length(f.number(name) * 1e-6)


def _doubt(f: Finding) -> str:
    """Lengths in the units people think in, others to three digits."""
    words = DOUBTS[f.kind]
    if not isinstance(words, str):
        return words(f)
    return words.format(**{
        name: _length(f, name) if name.endswith("_um")
        else say.significant(value) if isinstance(value, float)
        else listed(map(str, value)) if isinstance(value, tuple) else value
        for name, value in f.numbers.items()
    })  # fmt: skip


DOUBTS: dict[str, str | Callable[[Finding], str]] = {
    "not_converged": "the fit did not converge ({reason})",
    "knowledge_contradicted": "the readings contradict {stated}",
    "no_better_than_nominal": "the held-out error ({heldout_rms_um} rms) is not below that of the "
    "nominal arm ({nominal_rms_um})",
    "not_held_out": lambda f: (
        "some pose alone determines a parameter, and nothing checks it"
        + (
            f" ({_length(f, 'unchecked_um')} of the {_length(f, 'rms_um')} expected at new poses)"
            if f.numbers
            else ""
        )
    ),
    "residual_above_stated_noise": "the residual is {ratio} times the stated noise",
    "residual_below_stated_noise": "the stated noise is too large (the residual is {ratio} times "
    "it), so a missing effect would not show",
    "common_noise_too_large": "what is stated as common to a configuration is too large "
    "(configurations scatter {ratio} times as much), so a missing effect would not show",
    "residuals_heavy_tailed": lambda f: (
        "large errors are more frequent than in normal noise (excess kurtosis "
        f"{f.number('excess_kurtosis'):+.2g})"
    ),
    "autocorrelated": "residuals of successive visits are correlated, as under a drift or where "
    "successive poses are alike",
    "exchanged_markers": "the names of markers {markers} are exchanged",
    "load_unit": lambda f: (
        f"the compliances are {say.significant(f.number('ratio'), 2)} times those expected from "
        f"{f.numbers['by']}: the loads may be in another unit"
    ),
    "impossible_values": lambda f: _impossible(f),
    "scatter_not_counted": "residuals scatter between visits, or drift, beyond the noise model",
    "lack_of_fit": "configurations scatter more than their repeats",
    "fit_flatters": "the held-out error is larger than the fitted one ({residual_rms_um})",
    "scale": lambda f: (
        f"all measured lengths are {say.significant(f.number('readings_over_file'), 4)} times "
        "those of the robot's file: "
        + (
            "most likely the cell describes another robot"
            if f.numbers["likely"] == "another robot"
            else "a scale error, as of a target or unit of another size"
        )
    ),
    "unheard_of": lambda f: _unheard_of(f),
    "little_gain": "the error is hardly smaller than that of the nominal arm",
    "few_configurations": lambda f: (
        f"{say.counted(f.numbers['configurations'], 'configuration')} give only "
        f"{f.numbers['equations_left']} equations beyond {f.numbers['parameters']} parameters "
        f"(needed: {f.numbers['needed']})"
    ),
    "noise_unknown": "the noise level is unknown (neither stated nor repeated), so the residual "
    "may hide a missing effect",
    "new_poses_not_shown": lambda f: (
        f"{_length(f, 'open_um')} of the error at new poses comes from parameters that the "
        f"measured poses do not show ({listed(map(printable, f.numbers['parameters']), 3)})"
    ),
    "new_poses_no_gain": lambda f: (
        f"the error expected at new poses ({_length(f, 'rms_um')}) is "
        + ("hardly smaller" if f.number("rms_um") <= f.number("nominal_rms_um") else "larger")
        + f" than that of the nominal arm at measured poses ({_length(f, 'nominal_rms_um')})"
    ),
    "many_faulty_readings": "{faulty} of the {fitted} fitted readings are outliers",
    "many_left_out": "{left_out} readings are excluded as outliers, and {fitted} are fitted",
    "drift": "base or tracker drift by {sigma_um} during the measurement session",
    "test_data_worse": "the test error ({test_rms_um} rms) is larger than chance explains",
    "test_data_far": "{far} of {configurations} test poses are more uncertain than every measured "
    "pose ({predicted_std_um} rms over all test poses, at most {fitted_std_um} at measured ones)",
}


def _impossible(f: Finding) -> str:
    values = f.numbers["values"]
    shown = [" ".join((say.significant(number), unit)) for number, unit in
             map(say.display, values, f.numbers["units"])]  # fmt: skip
    how = "negative" if max(values) < 0 else "beyond the physical bound"
    named = printable(gathered(f.numbers["parameters"]))
    likely = f"; most likely {f.numbers['likely']} is wrong" if f.numbers["likely"] else ""
    return f"impossible values: {named} {how} ({listed(shown, 4)}){likely}"


def _unheard_of(f: Finding) -> str:
    told = map(say.display, f.numbers["values"], f.numbers["units"])
    shown = [
        f"{printable(name)} at {say.significant(number)} {unit}, {say.significant(sizes, 2)} "
        "typical deviations from nominal"
        for name, (number, unit), sizes in zip(
            f.numbers["parameters"], told, f.numbers["typical_sizes"], strict=True
        )
    ]
    return (
        f"implausible values ({listed(shown, 3)}): most likely an effect is missing, or these "
        "poses hardly determine them"
    )


def _accuracy(result: Calibration) -> str:
    """The arm's own error where nobody measured, and that of readings, which has their noise; where
    markers were placed alone, their places; that the load point is known worse than the markers."""
    kind = result.observations.kind
    of = f" of {kind}s" if kind in ("deflection", "distance") else ""
    own = "Expected error at new poses: not known."
    if (at := result.verdict.at) is not None:
        below = f"≤ {say.length(at)} rms (95 %), measurement noise excluded"
        own = f"Expected error at new poses: {below}."
    text = f"{own} Held-out error{of}: {say.length(result.heldout_rms)} rms"
    if not math.isfinite(result.heldout_rms):
        text = f"{own} Residual{of}: {say.length(result.residual_rms)} rms; no held-out error"
    elif only_placed(result):
        found: dict[str, list[str]] = {}
        for e in result.ordinary:
            name, _, axis = e.name.rpartition(".")
            if axis in ("x", "y", "z") and e.value is not None and e.ci95 is not None:
                value, half, unit = say.estimate(e.value, (e.ci95[1] - e.ci95[0]) / 2, e.unit)
                found.setdefault(name, []).append(f"{axis} = {value} ± {half} {unit}")
        told = [f"{printable(name.removeprefix('marker:'))} lies at {', '.join(axes)}"
                for name, axes in found.items() if len(axes) == 3]  # fmt: skip
        text += f"; {listed(told, 3)} (95 %)" if told else ""
    else:
        text += f" (nominal arm {say.length(result.nominal_rms)})"
    if result.load_point_error is None:
        return f"{text}."
    marker = printable(next(iter(result.model.cell.tool.markers)))
    return (
        f"{text}. The load point, default of compensate, is known only to "
        f"{say.length(result.load_point_error)} rms: measure a marker there, or state "
        f"{option('point')} {marker}."
    )


MOST_NAMED = 6
METHODS = {
    "reml": "generalised least squares, weights estimated by restricted likelihood (REML)",
    "ols": "ordinary least squares, all readings weighted alike",
    "wls": "weighted least squares",
    "eq14": "weighted least squares as published, weights of eq. (14) with σ by group, iterated",
    "eq14-residual": "weighted least squares as published, weights of eq. (14) from each residual, "
    "iterated; it acts like a robust fit, and its stated intervals are far too narrow",
    "huber": "robust M-estimate with Huber's loss, which limits the weight of outliers",
    "l1": "least sum of residual lengths (L1), robust like the median",
}
# What the weights are is said by the method itself, or by the line on the noise model.
SAID = {"reml", "ols", "eq14", "eq14-residual"}
SIGNS = {"lower": "≥", "upper": "≤", "equality": "="}


def method_of(result: Calibration) -> str:
    return str(result.method).replace("_", "-")


def method_and_weights(result: Calibration) -> str:
    method, noise = method_of(result), result.noise
    if method == "constrained":
        # The weights are those that the method before it gave to the readings.
        text = "fit with a prior" if result.prior_share else "fit under constraints"
        text += " and under constraints" if result.prior_share and result.active else ""
        if noise.kind == "none":
            return f"{text}, all readings weighted alike"
        how = "weights estimated by restricted likelihood (REML): " if noise.estimated else ""
        return f"{text}, {how}{printable(noise.description)}"
    text = METHODS.get(method, printable(method))
    if method in SAID or noise.kind == "none":
        return text
    return f"{text}, {printable(noise.description)}"


# What intervals of each kind assume, where their description does not say it.
ASSUMED = {
    "kenward-roger": "the noise model and normal noise",
    "classical": "independent readings",
    "profile": "normal noise",
    "eq13": "weights known beforehand, so that it is too narrow",
    "h1": "independent readings",
    "hc": "independent readings",
    "cr": "independent configurations",
}


def intervals_line(result: Calibration) -> str:
    kind, description = result.noise.interval_kind, result.noise.interval_description
    name = kind.title() if "-" in kind else kind  # of two people
    told = ": ".join(text for text in (name, description) if text)
    assumed = ASSUMED.get(kind.lower()) or ASSUMED.get(kind.lower().rstrip("0123"))
    return printable(f"{told}; assumes {assumed}" if assumed else told)


def constraints_line(result: Calibration) -> str | None:
    active = result.active
    if not active:
        return None
    units = {p.name: p.unit for p in result.model.parameters}

    def told(a: ActiveConstraint) -> str:
        """ "joint2.compliance ≥ 0 µrad/(N·m)"; a label of the user's own stays as it is."""
        if a.kind == "semidefinite":
            return f"{printable(a.label)} (semidefinite)"
        own = a.kind == "equality" and a.label != f"{a.names[0]} = {a.value:.6g}"
        if len(a.names) != 1 or own or a.names[0] not in units:
            return printable(a.label)
        value, unit = say.display(a.value, units[a.names[0]])
        return f"{printable(a.names[0])} {SIGNS[a.kind]} {say.plain(value)} {unit}"

    text = some(map(told, active), MOST_NAMED, "; ", "; and {} more")
    bound = any(a.kind != "equality" for a in active)
    held = "Intervals take these for exact"
    if result.noise.interval_kind.lower() == "constrained profile":
        held = "Intervals keep the constraints: they stop at bounds and take equalities for exact"
    want = "; the readings alone would go beyond the bounds" * bound
    return f"Active: {text}. {held}{want}."


def prior_line(result: Calibration) -> str | None:
    shares, found = result.prior_share, result.finding("mostly_prior")
    if not shares:
        return None

    def percent(share: float) -> str:  # never 100 % where the data say anything
        return f"{rounded(min(100 * share, 99.9))} %" if share < 1 else "100 %"

    if found is None:
        largest = max((s for s in shares.values() if s == s), default=0.0)  # NaN: constrained
        return f"No estimate is mostly prior (largest share {percent(largest)})."
    told = (f"{printable(n)} {percent(shares[n])}" for n in found.numbers["parameters"])
    named = some(told, MOST_NAMED, more=", and {} more")
    beside = " Beside smooth functions typical sizes are a prior." * bool(result.smooth)
    return f"Mostly prior, share of the information: {named}.{beside}"


FEW = 6  # sizes that are named one by one; of more, the range and the extremes
MOST_GROUPS = 4
COMPARED = (  # the first is against the noise that is stated
    "residual_above_stated_noise",
    "residual_agrees_with_stated_noise",
    "residual_below_stated_noise",
    "residual_agrees_with_readings",
)
SHAPES = {
    "residuals_skew": "errors are skewed, as with a missing effect.",
    "residuals_heavy_tailed": "large errors are more frequent. A robust method (huber, l1) shows "
    "whether the estimates depend on them.",
    "residuals_light_tailed": "large errors are rarer, as with rounded or selected readings.",
}


def does_noise_explain_it(result: Calibration) -> str:
    # Whether the weights come from a noise model with estimated variances.
    estimated = method_of(result) in ("reml", "constrained") and result.noise.estimated
    f = result.finding(*COMPARED)
    if f is None:  # what is missing for a comparison of the residual with stated noise
        observed, tracker = result.observations, result.model.cell.tracker
        stated = available_noise(observed.table, tracker) != "none"
        if observed.kind == "distance":
            stated = tracker.distance_sigma is not None
        by_repeats = result.finding("lack_of_fit", "repeats_agree") is not None
        text = "No noise was stated, "
        text += "repeats judge the residual" if by_repeats else "so the residual cannot be judged"
        if observed.kind == "pose" and stated != (tracker.rotation_sigma is not None):
            which = "positions" if stated else "rotations"
            text = f"Noise was stated for {which} only, so the residual cannot be judged"
        elif stated or result.noise.kind == "covariance":
            text = "The residual was not compared with the stated noise"
        if result.noise.sigma is not None and method_of(result) == "ols":
            of = "reading" if observed.kind == "distance" else "coordinate"
            return f"{text}; the residual amounts to {say.length(result.noise.sigma)} per {of}."
        return f"{text}{'; the noise level was estimated from the readings' * estimated}."
    size = f"{say.significant(f.number('ratio'))} times the stated noise; chance alone gives "
    size += f"{f.number('by_chance_from'):.2f} to {f.number('by_chance_to'):.2f}"
    if f.kind == "residual_agrees_with_stated_noise":
        return f"The residual agrees with the stated noise ({size})."
    single = result.finding("stated_noise_too_small")
    if f.kind == "residual_agrees_with_readings" and single is not None:
        text = f"The stated noise is too small: the residual is {size}, and {single.numbers['by']} "
        text += f"scatter by {say.significant(single.number('ratio'))} times the stated noise."
    elif f.kind == "residual_above_stated_noise":
        text = f"The residual is larger than the stated noise explains ({size}): an effect is "
        text += "missing, or the noise is larger than stated."
    else:
        text = f"The residual is smaller than the stated noise ({size}), which is too large."
    return text + " Weights and intervals use the estimated noise." * estimated


def noise_model_line(result: Calibration) -> str | None:
    noise = result.noise
    sizes, reason = _sizes(noise), noise.reason
    if not sizes and not reason:
        return None
    text = printable(noise.description)
    text = text[:1].upper() + text[1:]
    text += f": {'; '.join(sizes)}" if sizes else ""
    candidates = candidate_table(noise).rows
    if (n := len(candidates)) > 1:
        second, _, gap = candidates[1]
        reason = f"smallest information criterion of {n} models, next {second} (+{gap})"
    return f"{text}. Chosen: {printable(reason)}." if reason else f"{text}."


def _sizes(noise: Noise) -> list[str]:
    def told(s: NoiseSize, name: str) -> str:
        if s.sigma is None:
            return f"{printable(name)} {say.significant(s.factor or 0.0)}"
        size = f"{say.significant(s.sigma * 1e6)} µrad" if s.turns else say.length(s.sigma)
        return f"{printable(name)} {size}"

    sizes = noise.sizes or ()
    alone, shared = ([s for s in sizes if bool(s.part) == whether] for whether in (False, True))
    named = [(s, s.name) for s in alone]
    if (n := len(alone)) > FEW:
        own = sorted(alone, key=lambda s: (s.factor or 0.0) if s.sigma is None else s.sigma)
        named = [(own[n // 2], f"median of {n}")]
        named += [(own[0], f"smallest ({own[0].name})"), (own[-1], f"largest ({own[-1].name})")]
    return [told(s, name) for s, name in [*named, *((s, s.name) for s in shared)]]


def candidate_table(noise: Noise) -> say.ShownTable:
    tried = sorted(noise.tried or (), key=lambda t: t.criterion)
    rows = [
        (printable(Kind.parsed(t.kind).words), str(t.variances),
         f"{t.criterion - tried[0].criterion:.1f}")
        for t in tried
    ]  # fmt: skip
    heads = ("noise model", "variances", "criterion over best")
    note = (
        "The information criterion: twice the loss in log-likelihood and a price per variance; 10 "
        "above the best is practically no support."
    )
    return say.ShownTable(heads, rows, title="Noise models tried", note=note)


def repeats_line(result: Calibration) -> str | None:
    f = result.finding("lack_of_fit", "repeats_agree")
    if f is None:
        return None
    numbers = f"lack of fit: F = {f.number('F'):.2f} on {f.numbers['dof_between']} and "
    numbers += f"{f.numbers['dof_pure']} degrees of freedom, {say.size_of(f.number('p'))}"
    by = str(f.numbers["counted_by"])
    if f.kind == "repeats_agree":
        text = f"Repeats agree with the scatter between configurations ({numbers})"
        if by == "the noise model":
            return (
                f"{text}: the test shows no common deviation. The noise model, chosen by its "
                "criterion, has one; the intervals include it."
            )
        return f"{text}: readings of one configuration have no common deviation."
    includes = {
        "the noise model": "The noise model has this common deviation; the intervals include it.",
        "the intervals": "The intervals take each configuration as a whole and include it.",
    }
    return (
        f"Configurations scatter more than their repeats ({numbers}): the arm does not return to "
        "the same place, or an effect is missing. "
        + includes.get(by, "The intervals do not include it and are too narrow.")
    )


def shape_line(summary: ResidualSummary) -> str:
    f = shape_of(summary)
    numbers = f"skewness {f.number('skewness'):+.2f}, excess "
    numbers += f"kurtosis {f.number('excess_kurtosis'):+.2f}"
    if f.kind == "residuals_too_few":
        text = f"Too few values to judge whether residuals are normal ({numbers})."
    else:
        numbers += f", {say.size_of(f.number('p'))}"
        text = f"Standardised residuals agree with a normal distribution ({numbers})."
        if f.kind != "residuals_normal":
            text = f"Standardised residuals are not normal ({numbers}): {SHAPES[f.kind]}"
    if (scatter := summary.whole.held_out_mean_square) is not None:
        text += f" In held-out configurations the scatter is {say.significant(scatter**0.5)} times "
        text += "that of the noise model."
    groups = [f"{row[0]} {row[2]} times" for row in deviating_table(summary).rows[:MOST_GROUPS]]
    if not groups:
        return f"{text} No group of readings deviates from the noise model."
    more = sum(g.n_deviating for g in summary.groupings) - len(groups)
    tail = f", and {more} more" if more else ""
    return f"{text} Scatter unlike the noise model: {', '.join(groups)}{tail}."


def deviating_table(summary: ResidualSummary) -> say.ShownTable:
    rows = [
        (f"{by} {printable(g.name)}", str(g.n), say.significant(float(np.sqrt(g.mean_square)), 2),
         say.p_value(g.p_holm))
        for by, g in summary.deviating
    ]  # fmt: skip
    heads = ("scatters unlike the noise model", "values", "observed / expected", "p (Holm)")
    return say.ShownTable(heads, rows)


def in_time_line(result: Calibration) -> str | None:
    found = result.autocorrelation
    if found is None:
        return None
    numbers = (
        f"correlation {found.correlations[0]:+.2f} over {found.visits} visits in the order of "
    )
    numbers += f"{'their times' if found.by == 'times' else 'the rows'}, {say.size_of(found.p)}"
    told = result.finding("autocorrelated")
    which = "Residuals of successive visits are"
    if told is None:
        return f"{which} no more alike than others ({numbers})."
    if told.numbers["counted"] == "yes":
        return f"{which} alike ({numbers}); the noise model has this as a drift."
    return (
        f"{which} alike ({numbers}): drift, or an effect missing at neighbouring poses. Intervals "
        "are too narrow."
    )


PLACE = {"block": "Block of lines {}", "marker": "Marker {}", "configuration": "Configuration {}"}


def fault_lines(result: Calibration, most: int | None = None) -> list[str]:
    report = result.faulty_report
    groups = [] if report is None else [f for f in report.findings if f.level != "reading"]
    more = len(groups) - len(groups[:most])
    return [_fault(result, f) for f in groups[:most]] + [f"And {more} more."] * bool(more)


def _fault(result: Calibration, finding: FaultyGroup) -> str:
    n, beyond = len(finding.lines), finding.beyond
    apart = {o.line for o in result.excluded} & set(finding.lines)
    how = "err in common by" if finding.pattern == "common" else "scatter by"
    noise = f"{say.significant(finding.sigmas, 2)} times the noise"
    text = f"{PLACE[finding.level].format(printable(finding.name))}: {n} readings {how} "
    # Of a pose the error is the position's, and the finding may be one of rotation.
    turned = result.observations.kind == "pose"
    text += noise if turned else f"{say.length(finding.error)} ({noise})"
    if beyond < n:
        text += f", {beyond or 'none'} of them beyond the noise"
    name = printable(finding.moves_most)
    if not math.isfinite(finding.influence):
        return f"{text}; the other readings leave {name} undetermined."
    bends = not apart and method_of(result) not in ROBUST  # readings of full weight in the fit
    moves = "in the fit they move" if bends else "fitted along they would move"
    count = say.significant(finding.influence, 2)
    return f"{text}; {moves} {name} by {count} standard deviation{'s' * (count != '1.0')}."


def smooth_table(result: Calibration) -> say.ShownTable:
    rows = []
    for part in (part for part in result.smooth if part.scale):
        for unit, (rms, (low, high), half) in part.sizes.items():
            size, *ends, known = (
                say.significant(say.display(v, unit)[0]) for v in (rms, low, high, half)
            )
            worth = f"{say.significant(part.effective, 2)} of {part.coefficients}"
            named, shown = printable(part.group.name), say.display(0.0, unit)[1]
            rows.append((named, size, " to ".join(ends), known, shown, worth))
    note = (
        "What the arm does besides, as smooth functions of joint angles or time: they correct it "
        "where it was measured, and explain nothing. Each takes as many of its coefficients as "
        "the readings pay for."
    )
    heads = ("smooth function", "rms", "95 %", "known to ±", "unit", "coefficients' worth")
    return say.ShownTable(heads, rows, (0, 4), title="Smooth functions", note=note)
