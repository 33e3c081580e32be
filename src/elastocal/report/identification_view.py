"""What an identification says, as blocks: verdict, errors, parameters; behind them the rest."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from elastocal.identification import findings
from elastocal.identification.prediction import PredictedError
from elastocal.identification.result import LOPSIDED, Calibration, Combination, Estimate
from elastocal.identification.scrutiny import ErrorBudget, gap_budget, stage_of
from elastocal.messages import listed, option, printable, some
from elastocal.model.calibrated import mostly_prior
from elastocal.model.chain import names_told
from elastocal.model.effects.base import Parameter
from elastocal.report import blocks as say
from elastocal.report import judgement_view as words
from elastocal.report.figures import Residuals, uncertainty_map, waterfall
from elastocal.units import Array

Truth = dict[str, float]
Published = Mapping[str, tuple[float, float]]
FEW = 6  # rows that stand open
LARGEST_TERMS = 4  # of a combination
MOST_GROUPS = 3
MOST_CORRELATIONS = 30
MOST_INFLUENTIAL = 12
NOMINAL = "nominal arm"  # its `nominal_rms`: with base and markers placed by all readings
READINGS = {
    "position": "position readings",
    "deflection": "deflections (loaded minus unloaded readings)",
    "pose": "pose readings",
    "distance": "distance readings",
}


def calibration_blocks(
    result: Calibration, truth: Truth | None = None, published: Published | None = None
) -> Iterator[say.Block]:
    budget = cache(lambda: gap_budget(result))
    yield say.Fold("", lambda: [_key(result, budget())])
    yield words.judgement(result, reasons=False)
    yield say.Lines([
        *(("Reason", why) for why in words.reasons_of(result)),
        ("Error (rms)", error_line(result)),
        ("Expected", at_new_poses(result.predicted)),
        *(("Next", f.remedy) for f in findings.next_steps(result)),
        *words.warnings_beside(result),
    ])  # fmt: skip
    yield say.Fold("", lambda: _error_figures(result, budget()), figures=("waterfall", "sureness"))
    yield parameter_table(result, truth, published)
    if result.combinations:
        told = "Combinations that are determined although their members are not"
        names = [shortened(c) for c in result.combinations]
        title = "Combinations (factors in SI units)"
        yield _open_if_few(_numbers(title, names, result.combinations, {}), told)
        whole = [shortened(c, len(c.terms)) for c in result.combinations]
        longer = [say.Sentence(every) for every in whole if every not in names]
        yield say.Fold("Combinations with all their members", lambda: longer)
    for line in undetermined_lines(result, FEW):
        yield say.Sentence(say.sentence(line), soft=True)
    yield say.Lines([
        ("Readings", readings(result)),
        ("Identified", what_was_identified(result)),
        ("Joints", names_told(result.model.chain)),
        ("Noise", words.does_noise_explain_it(result)),
        ("Constraints", words.constraints_line(result)),
        ("Prior", words.prior_line(result)),
        ("Truth", coverage(result, truth)),
        *(("Outliers", text) for text in words.fault_lines(result, MOST_GROUPS)),
    ])  # fmt: skip
    fit = result.model, result.observations, result.x, result.residual
    residuals = cache(lambda: Residuals(*fit))
    yield say.Fold("", lambda: residuals().figures(), figures=("residuals", "against_joints"))
    yield _open_if_few(words.smooth_table(result), "Smooth functions")
    yield say.Fold("Method, noise and intervals", lambda: _method(result), printed=True)
    missing = undetermined_table(result, truth)
    if missing.rows:
        why = f"Every parameter without a value, and why ({len(missing.rows)})"
        remedy = say.Sentence(
            "To see an invisible parameter, measure poses and loads that move the markers through "
            "it. To separate a combination, add markers, loads or poses in which its members "
            "differ.",
            soft=True,
        )
        yield say.Fold(why, lambda: [missing, remedy], printed=True)
    if result.correlations:
        yield say.Fold("Correlations over 0.9", lambda: [_correlation_table(result)], printed=True)
    yield say.Fold("Errors in numbers", lambda: _errors(result, budget()))
    yield say.Fold(
        "Residuals on the arm, over time and by group",
        lambda: _on_the_arm(residuals()),
        figures=("space", "over_time"),
    )  # fmt: skip
    single = len(result.outliers) + len(result.excluded)
    if single or words.fault_lines(result):
        yield say.Fold(f"Outliers ({single})", lambda: _outliers(result))
    yield say.Fold("Which configurations decide the fit", lambda: [_influence_table(result)])


def _open_if_few(table: say.ShownTable, summary: str) -> say.Block:
    if len(table.rows) <= FEW:
        return table
    return say.Fold(f"{summary} ({len(table.rows)})", lambda: [table], printed=True)


def _key(result: Calibration, budget: ErrorBudget | None) -> say.KeyFigures:
    held = math.isfinite(result.heldout_rms)
    after = result.heldout_rms if held else result.residual_rms
    figures = [(NOMINAL, say.length(result.nominal_rms))]
    figures.append(("held-out poses" if held else "fitted poses, not held out", say.length(after)))
    if result.test is not None:
        figures.append(("test data", say.length(result.test.rms)))
    if (at := result.verdict.at) is not None:
        figures.append(("new poses, without noise", f"≤ {say.length(at)}"))
    headline = f"{say.length(result.nominal_rms)} → {say.length(after)}"
    if budget is not None and budget.floor is not None:
        figures.append((f"noise ({budget.floor_name})", say.length(budget.floor)))
        headline += f" (noise {say.length(budget.floor)})"
    return say.KeyFigures(headline, figures)


def _error_figures(result: Calibration, budget: ErrorBudget | None) -> Iterator[say.Block]:
    if budget is not None:
        yield waterfall("waterfall", *budget_steps(result, budget))
    if (found := uncertainty_map(result)) is not None:
        yield found


def _on_the_arm(residuals: Residuals) -> Iterator[say.Block]:
    from elastocal.report.arm_view import residual_arm

    yield residual_arm(*residuals.fit)
    yield from residuals.others()


def _method(result: Calibration) -> Iterator[say.Block]:
    summary = result.residual_summary
    yield say.Lines([
        ("Method", say.sentence(words.method_and_weights(result))),
        ("Degrees of freedom", f"{result.dof}."),
        ("Prediction", prediction_line(result)),
        ("Noise model", words.noise_model_line(result)),
        ("Repeats", words.repeats_line(result)),
        ("Residuals", None if summary is None else words.shape_line(summary)),
        ("In time", words.in_time_line(result)),
        ("Intervals", say.sentence(words.intervals_line(result))),
    ])  # fmt: skip
    if len((tried := words.candidate_table(result.noise)).rows) > 1:
        yield tried
    if summary is not None:
        yield words.deviating_table(summary)


def _errors(result: Calibration, budget: ErrorBudget | None) -> Iterator[say.Block]:
    if budget is not None:
        yield say.budget_table(*budget_steps(result, budget))
    found = before_and_after(result, budget)
    lengths = {name: np.linalg.norm(errors, axis=1) for name, errors in found.items()}
    if result.test is not None and len(result.test.errors):
        lengths["calibrated, test data"] = result.test.errors
    yield spread_table(lengths, "readings", "Before and after")


def _outliers(result: Calibration) -> Iterator[say.Block]:
    if groups := words.fault_lines(result):
        yield say.Lines([("Groups", text) for text in groups])
        assert result.faulty_report is not None  # which the groups are of
        share = 100 * result.faulty_report.false_alarm
        told = f"False-alarm rate: at most {share:g} % of tables without outliers."
        yield say.Sentence(told, soft=True)
    kept = f"Kept in the fit; {option('outliers', 'drop')} excludes them"
    for title, found in ((kept, result.outliers), ("Excluded from the fit", result.excluded)):
        if found:
            yield from say.outlier_blocks(title, [(o, o.residual, o.ratio) for o in found])


def _correlation_table(result: Calibration) -> say.ShownTable:
    rows = [
        (printable(a), printable(b), f"{r:+.3f}" if abs(r) < 0.9995 else f"{r:+.6f}")
        for a, b, r in result.correlations[:MOST_CORRELATIONS]
    ]
    more = len(result.correlations) - len(rows)
    note = "Such parameters are known far better together than each alone: the intervals count "
    note += "with it, and so does every prediction."
    note += f" {more} more are in the result's file." if more else ""
    return say.ShownTable(("parameter", "and", "correlation"), rows, (0, 1), note=note)


def what_was_identified(result: Calibration) -> str:
    standing, n = findings.standings(result), len(result.combinations)
    count = Counter(standing[e.name] for e in result.ordinary)
    mostly = [standing.get(p) for p in mostly_prior(result.prior_share)].count(findings.ALONE)
    alone = count[findings.ALONE] - mostly
    text = f"{alone} of {say.counted(len(result.ordinary), 'parameter')}"
    text += f", {mostly} more mostly by a prior" * bool(mostly)
    if n:
        text += f", and {say.counted(n, 'combination')} of parameters that these readings cannot "
        text += f"separate ({count[findings.ABSORBED]} held in exchange)"
    told = {
        **NO_VALUE, findings.INVISIBLE: "not visible in these data",
        findings.UNREAD: "of markers without own readings", findings.FIXED: "fixed by the user",
    }  # fmt: skip
    for kind, why in told.items():
        if found := count[kind]:
            text += f"; {found} {why}"
    if (far := result.finding("unheard_of")) is not None:
        text += f"; {len(far.numbers['parameters'])} with implausible values"
    if smooth := [part.coefficients for part in result.smooth if part.scale]:
        many = say.counted(len(smooth), "smooth function")
        text += f"; and {many} of {sum(smooth)} coefficients"
    return f"{text}."


def prediction_line(result: Calibration) -> str:
    text, held = "", math.isfinite(result.heldout_rms)
    if not held:
        text = "No held-out error: some configuration alone determines a parameter. "
    elif result.noise.drift is not None:
        text = "Whole blocks in time were held out, with another day's drift. "
    if held and result.excluded:
        text += (
            f"With the {say.counted(len(result.excluded), 'reading')} excluded as outliers, the "
        )
        text += f"held-out error is {say.length(result.heldout_all_rms)} rms. "
    if (t := result.test) is not None:
        text += f"Test error ({say.counted(t.n, 'reading')}, not fitted): {say.length(t.rms)} rms, "
        text += f"{say.length(t.mean)} mean, {say.length(t.maximum)} maximum."
    return text.rstrip()


def at_new_poses(found: PredictedError | None) -> str:
    if found is None:
        return ""
    low, high = found.ci95
    parts = [f"parameters {say.length(found.parameters)}"]
    if found.open > 0:
        parts.append(f"undetermined parameters {say.length(found.open)}")
    if found.lacking:
        parts.append(f"possible model error {say.length(found.lacking)}")
    return (
        f"{say.length(found.rms)} rms at new poses, 95 %: {say.length(low)} to {say.length(high)}, "
        f"measurement noise excluded ({', '.join(parts)}). New poses: {found.source}."
    )


def error_line(result: Calibration) -> str:
    sizes = {
        NOMINAL: result.nominal_rms,
        "fitted poses": result.residual_rms,
        "held-out poses": result.heldout_rms,
    }
    if result.test is not None:
        sizes["test data"] = result.test.rms
    text = ", ".join(f"{name} {say.length(value)}" for name, value in sizes.items())
    if result.observations.kind == "pose":
        turns = (r.reshape(-1, 6)[:, 3:] for r in (result.residual, result.held_out_counted))
        rms = (float(np.sqrt((turn**2).sum(axis=1).mean())) for turn in turns)
        told = (
            f"{say.significant(v * 1e6)} µrad" if math.isfinite(v) else "not available" for v in rms
        )
        text += f"; rotations {next(told)} fitted, {next(told)} held out"
    return text


def readings(result: Calibration) -> str:
    observed = result.observations
    markers = len(np.unique(observed.table.marker[observed.lead]))
    return (
        f"{len(observed.lead)} {READINGS[observed.kind]} in "
        f"{say.counted(observed.n_configurations, 'configuration')}, "
        f"{say.counted(markers, 'marker')} ({printable(observed.table.source)})"
    )


def nominal_held_out(result: Calibration) -> str:
    placed = any(stage_of(p.effect) == 0 for p in result.model.parameters)
    return f"{NOMINAL}, held out" if placed else NOMINAL


def budget_steps(result: Calibration, budget: ErrorBudget) -> say.Budget:
    named = {"nominal_arm": nominal_held_out(result)}
    steps = [(named.get(s.step, s.step), s.heldout_rms, s.ci95) for s in budget.steps]
    floor = None if budget.floor is None else (budget.floor_name, budget.floor)
    return steps, floor, say.rms(result.model)


def before_and_after(result: Calibration, budget: ErrorBudget | None) -> dict[str, Array]:
    """Errors (n, 3) in m of the nominal and the calibrated arm in poses that were not fitted."""
    if budget is None or len(budget.steps) < 2:
        return {}
    ends = budget.steps[0].errors, budget.steps[-1].errors
    return dict(zip((nominal_held_out(result), "calibrated"), ends, strict=True))


def spread_table(found: dict[str, Array], count: str, title: str) -> say.ShownTable:
    rows = []
    for name, e in found.items():
        sizes = (e.mean(), e.std(), np.quantile(e, 0.95), e.max())
        rows.append((name, str(len(e)), *(say.length(float(size)) for size in sizes)))
    return say.ShownTable(("error", count, "mean", "std", "95 % below", "max"), rows, title=title)


def _influence_table(result: Calibration) -> say.ShownTable:
    found = sorted(result.influence(), key=lambda c: (-c.cook, -c.leverage))[:MOST_INFLUENTIAL]
    rows = [
        (
            printable(c.configuration), str(c.readings), say.significant(c.leverage, 2),
            say.significant(c.cook, 2) if math.isfinite(c.cook) else "∞", printable(c.moved),
            say.significant(c.by, 2) if math.isfinite(c.by) else "undetermined",
        )
        for c in found
    ]  # fmt: skip
    heads = (
        "configuration", "readings", "leverage (parameters)", "Cook's distance", "moves most",
        "by (std)",
    )  # fmt: skip
    note = (
        "Without a configuration the estimates move, one of them most. Cook's distance counts all "
        "of them together: at 1 they move about to the edge of their 50 % region. To depend less "
        "on one, measure more like it."
    )
    return say.ShownTable(heads, rows, (0, 4), note=note)


def shortened(combination: Combination, most: int = LARGEST_TERMS) -> str:
    """The first member and the largest other terms by factor, "+ n more" for the rest."""
    rest = list(combination.terms.items())[1:]
    # Of factors that are alike but for rounding the first ones are told, on any machine.
    kept = dict(sorted(rest, key=lambda term: -float(f"{abs(term[1]):.6g}"))[: most - 1])
    text = printable(combination.sum_of(kept, say.significant, 4))
    more = len(rest) - len(kept)
    return f"{text} + {more} more" if more else text


NO_VALUE = {findings.WEAK: "hardly shown", findings.BEYOND: "beyond a physical bound"}
REDUNDANT = "redundant"
HELD = {
    findings.INVISIBLE: " (not visible in these data)",
    findings.ABSORBED: ", absorbed in a combination",
    REDUNDANT: ", not identifiable at any pose under these loads (expected)",
}
WITHOUT = {findings.UNREAD: "held: no reading of its own", findings.FIXED: "fixed by the user"}


def limits(result: Calibration, e: Estimate) -> str:
    """What the readings say of a parameter without a value, and what the model uses."""
    assert e.limits is not None
    p = result.model.parameters[result.model.names.index(e.name)]
    if p.beyond(e.limits):
        value, half, unit = say.estimate(e.held, (e.limits[1] - e.limits[0]) / 2, e.unit)
        return f"{value} ± {half} {unit}"
    low, high = (say.significant(say.display(end, e.unit)[0], 2) for end in e.limits)
    held, unit = say.display(e.held, e.unit)
    text = f"{low} to {high} {unit}"
    if e.limits[0] <= p.lower <= e.limits[1]:
        text = f"at most {high} {unit}"
    elif e.limits[0] <= p.upper <= e.limits[1]:
        text = f"at least {low} {unit}"
    used = "nominal" if e.held == e.nominal and e.held else say.significant(held, 2)
    return f"{text}; {used} is used"


def inside(value: float | None, ci95: tuple[float, float] | None) -> str:
    if value is None or ci95 is None:
        return ""
    return "inside" if ci95[0] <= value <= ci95[1] else "outside"


def coverage(result: Calibration, truth: Truth | None) -> str | None:
    if not truth:
        return None
    found = [inside(truth.get(e.name), e.ci95) for e in result.ordinary]
    hit, n = found.count("inside"), sum(map(bool, found))
    return f"{hit} of {n} intervals at 95 % hold the true value (expected: {0.95 * n:.1f})."


def stated(parameter: Parameter) -> bool:
    """False for a zero that only stands for "no nominal value stated", as of a compliance."""
    return parameter.nominal != 0 or parameter.typical is not None


def nominal_text(e: Estimate, parameter: Parameter) -> str:
    return say.plain(say.display(e.nominal, e.unit)[0]) if stated(parameter) else "–"


def undetermined_lines(result: Calibration, most: int | None = None) -> Iterator[str]:
    standing, known = findings.standings(result), {p.name: p for p in result.model.parameters}
    redundant = result.left.redundant if result.left else ()
    groups: dict[str, list[Estimate]] = {}
    for e in result.ordinary:
        kind = standing[e.name]
        extra = kind in HELD and e.name in redundant
        groups.setdefault(REDUNDANT if extra else kind, []).append(e)
    for kind in (*NO_VALUE, *HELD, findings.UNREAD, findings.FIXED):
        found = groups.get(kind, [])
        at_nominal = all(e.held == e.nominal and stated(known[e.name]) for e in found)
        why = "held at nominal" if at_nominal else "held at the start value"
        why += HELD.get(
            kind, f" ({printable(findings.no_reading(result))})" if kind == findings.UNREAD else ""
        )
        why = "fixed by the user" if kind == findings.FIXED else why
        names = [printable(e.name) for e in found]
        if kind in NO_VALUE:
            why = f"{NO_VALUE[kind]}, so without a value (95 %)"
            names = [f"{n} ({limits(result, e)})" for n, e in zip(names, found, strict=True)]
        if names:
            yield f"{why}: {listed(names, most or len(names))}"


def undetermined_table(result: Calibration, truth: Truth | None = None) -> say.ShownTable:
    rows, standing = list[tuple[str, ...]](), findings.standings(result)
    redundant = result.left.redundant if result.left else ()
    known = {p.name: p for p in result.model.parameters}
    for e in result.ordinary:
        kind, name = standing[e.name], printable(e.name)
        if kind == findings.ALONE:
            continue
        if kind == findings.COMBINED:
            why = f"only as {shortened(result.combination(e.name))}"
        elif kind == findings.ABSORBED:
            why = f"held: absorbed in {some(map(printable, e.combined_with), 3, more=' + {} more')}"
        elif kind in NO_VALUE:
            why = f"{NO_VALUE[kind]}: {limits(result, e)}"
        elif kind == findings.INVISIBLE:
            why = f"held{HELD[REDUNDANT if e.name in redundant else kind]}"
        else:
            why = WITHOUT[kind]
        *_, unit, true = texts(e, truth.get(e.name) if truth else None)
        nominal = nominal_text(e, known[e.name])
        rows.append((name, nominal, unit, *([true] if truth else []), why))
    heads = ("parameter", "nominal", "unit", *(["truth"] if truth else []), "why")
    return say.ShownTable(heads, rows, (0, 2, len(heads) - 1))


def texts(e: Estimate | Combination, true: float | None) -> tuple[str, str, str, str]:
    """Value, half width or both ends, unit and true value; "–" for what is not determined."""
    shown, unit = say.display(true or 0.0, e.unit)
    if e.value is None or e.ci95 is None:
        return "–", "–", unit, "–" if true is None else say.plain(shown)
    value, low, high = (say.display(number, e.unit)[0] for number in (e.value, *e.ci95))
    width = (high - low) / 2
    text, half = say.with_uncertainty(value, width)
    if is_lopsided(e):
        text, half, width = say.with_ends(value, low, high)
    return text, half, unit, "–" if true is None else say.with_uncertainty(shown, width)[0]


HOLDS = "in 95 %"
ROUNDING = 1e-9  # sides of an interval this short beside the value are alike


def is_lopsided(e: Estimate | Combination) -> bool:
    """Not symmetric, or without an end: both ends are to be told."""
    assert e.value is not None and e.ci95 is not None
    below, above = e.value - e.ci95[0], e.ci95[1] - e.value
    if not (math.isfinite(below) and math.isfinite(above)):
        return True
    return abs(above - below) > max(LOPSIDED * max(above, below), ROUNDING * abs(e.value))


def parameter_table(
    result: Calibration, truth: Truth | None = None, published: Published | None = None
) -> say.ShownTable:
    own, more = [e for e in result.ordinary if e.identifiable], dict[str, list[str]]()
    known = {p.name: p for p in result.model.parameters}
    if truth:
        true = [truth.get(e.name) for e in own]
        more["truth"] = [texts(e, value)[3] for e, value in zip(own, true, strict=True)]
        more[HOLDS] = [inside(value, e.ci95) for e, value in zip(own, true, strict=True)]
    nominal = [nominal_text(e, known[e.name]) for e in own]
    if not set(nominal) <= {"–"}:
        more["nominal"] = nominal
    if published:
        given = [(published.get(e.name), e.unit) for e in own]
        more["published"] = ["–" if v is None else " ± ".join(say.estimate(*v, unit)[:2])
                             for v, unit in given]  # fmt: skip
    mostly = mostly_prior(result.prior_share)
    notes = [printable(e.note) or "mostly prior" * (e.name in mostly) for e in own]
    if any(notes):
        more["note"] = notes
    of = [known[e.name].effect.replace("_", " ") for e in own]
    groups = {k: name for k, name in enumerate(of) if not k or name != of[k - 1]}
    table = _numbers("Parameters", [printable(e.name) for e in own], own, more)
    return replace(table, groups=groups)


def _numbers(
    title: str, names: list[str], found: Sequence[Estimate | Combination],
    more: dict[str, list[str]],
) -> say.ShownTable:  # fmt: skip
    """With `more` columns, of which a narrow terminal has whether the interval holds the truth."""
    lopsided, held = any(map(is_lopsided, found)), more.get(HOLDS)
    first, half = title.split()[0].lower().removesuffix("s"), "95 %" if lopsided else "± 95 %"
    rows, brief = [], []
    for k, e in enumerate(found):
        value, width, unit, _ = texts(e, None)
        signed = width if width.startswith("[") else f"± {width}"
        beside = [column[k] for column in more.values()]
        rows.append((names[k], value, signed if lopsided else width, unit, *beside))
        brief.append((names[k], f"{value} {signed} {unit}", *([held[k]] if held else [])))
    heads = (first, "value", half, "unit", *more)
    words = tuple(k for k, head in enumerate(heads) if head in (first, "unit", HOLDS, "note"))
    few = (first, f"value {half}", *([HOLDS] if held else []))
    narrow = say.ShownTable(few, brief, (0, 1, 2), title=title)
    return say.ShownTable(heads, rows, words, title=title, narrow=narrow)
