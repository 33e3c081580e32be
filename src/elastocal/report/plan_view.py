"""What a measurement plan says, as blocks: its worth, the stops, and what is behind them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elastocal.errors import option
from elastocal.planning.bodies import mounting_plane
from elastocal.planning.criteria import CRITERIA
from elastocal.planning.execution import DRIFT
from elastocal.planning.plan import Plan, Predicted, Reason, load_name
from elastocal.report.blocks import (
    WARNING,
    Block,
    Figure,
    Fold,
    KeyFigures,
    Lines,
    Report,
    ShownTable,
    ShownVerdict,
)
from elastocal.report.formatting import (
    counted,
    display,
    first_stops,
    joint_heads,
    joint_texts,
    length,
    significant,
    title_of,
)
from elastocal.text import listed, printable

if TYPE_CHECKING:
    from elastocal.diagnosis.next_poses import NextPoses


def plan_report(plan: Plan) -> Report:
    """A plan: what it is worth and the stops to make; behind them poses, proof and order."""
    model = plan.model
    title = title_of(model.chain.name, model.cell.name)
    return Report("Measurement plan", title, plan_blocks(plan), model.backend_report(), plan.seed)


def plan_blocks(plan: Plan) -> Iterator[Block]:
    yield Fold("", lambda: [_key(plan)])
    # A gap to the bound is no fault of the plan's: with few poses much of it is the bound's.
    yield ShownVerdict("warn" if plan.warnings else "good", plan_headline(plan))
    yield Lines([(WARNING, printable(text)) for text in plan.warnings])
    steps = Lines([("Next", text) for text in plan_steps(plan)])
    yield Fold("", lambda: [steps, stop_table(plan), _arm(plan)], figures=("poses",))
    yield Fold("Poses", lambda: [pose_table(plan)], printed=True)
    yield Fold("Why each pose", lambda: [reason_table(plan)], printed=True)
    yield Fold("Predicted intervals", lambda: [interval_table(plan)], printed=True)
    if plan.curve:
        yield Fold("Number of poses", lambda: _curve(plan), printed=True, figures=("curve",))
    if plan.timed:
        yield Fold("Poses and readings within the time", lambda: [timed_table(plan)], printed=True)
    yield Fold("What the plan is worth", lambda: [Lines(plan_lines(plan))], printed=True)


def next_report(found: NextPoses) -> Report:
    """Whether to measure more, what it brings, and the poses."""
    return Report("Next poses", printable(found.source), _next_blocks(found))


def _next_blocks(found: NextPoses) -> Iterator[Block]:
    yield Lines(next_lines(found))
    yield Fold("", lambda: _next_figures(found), figures=("gain",))
    if found.plan is not None:
        yield from plan_blocks(found.plan)


def _key(plan: Plan) -> KeyFigures:
    worth = f"{plan.criterion} = {plan.reported:.4g} {plan.unit}".rstrip()
    figures = [("poses", str(len(plan.q))), ("criterion", worth)]
    if plan.of_test_poses:
        figures[1] = ("error at the test poses", f"{_rho(plan):.3g} µm")
    if (e := plan.everywhere) is not None:
        figures.append(("error over the joint ranges", f"{e.elsewhere * 1e6:.3g} µm"))
    figures.append(("time", f"{plan.execution.total / 60:.0f} min"))
    if len(figures) < 4:
        figures.append(("load states", str(len(plan.forces))))
    return KeyFigures(figures)


def _arm(plan: Plan) -> Block:
    from elastocal.report.arm_view import plan_arm

    return plan_arm(plan)


def _curve(plan: Plan) -> Iterator[Block]:
    from elastocal.report.figures import plan_curve

    yield curve_table(plan)
    yield plan_curve(plan)


def _next_figures(found: NextPoses) -> Iterator[Figure]:
    """The error before and after the batch."""
    from elastocal.report.figures import NO_ENDS, rows_of_dots

    g = found.gain
    names = ("measured so far", "with this batch")
    rows = [
        (f"{name}{model}", value * 1e6, NO_ENDS, length(value))
        for model, values in (("", (g.before, g.after)),
                              (", if the model is right", (g.model_before, g.model_after)))
        for name, value in zip(names, values, strict=True) if math.isfinite(value)
    ]  # fmt: skip
    axis = "rms error at the test poses"
    yield rows_of_dots("gain", "Error before and after the batch", rows, axis, lengths=True)


TOLD = 2  # parameters that a pose serves, in the table
SERVES = "most affected if dropped (standard deviation)"


def pose_table(plan: Plan) -> ShownTable:
    """Joint values and place in the order of execution; less digits where there is no room."""
    two, one, none = (_poses(plan, decimals) for decimals in (2, 1, 0))
    return replace(two, narrow=replace(one, narrow=none))


def _poses(plan: Plan, decimals: int) -> ShownTable:
    kinds = plan.model.chain.kinds
    heads = ["pose", *joint_heads(kinds), "order"]
    heads += [] if plan.crossed else ["load"]
    heads += [] if plan.seen is None else ["markers"]
    order = first_stops(plan)
    rows: list[tuple[str, ...]] = []
    for k, name in enumerate(plan.configurations):
        row = [name, *joint_texts(plan.q[k], kinds, decimals)]
        row += [str(order[k]), *([] if plan.crossed else [plan.loads(k)])]
        row += [] if plan.seen is None else [printable(plan.markers(k))]
        rows.append(tuple(row))
    words = tuple(k for k, head in enumerate(heads) if head in ("load", "markers"))
    return ShownTable(tuple(heads), rows, words, title="Poses")


def reason_table(plan: Plan) -> ShownTable:
    """What each pose is there for."""
    rows = [(name, served(r)) for name, r in zip(plan.configurations, plan.reasons, strict=True)]
    return ShownTable(("pose", SERVES), rows, (1,), title="Why each pose")


def served(reason: Reason) -> str:
    """The parameters that a pose serves most: "joint3.compliance +38 %"."""
    parts = [
        f"{printable(name)} {'lost' if math.isinf(growth) else f'+{100 * (growth - 1):.0f} %'}"
        for name, growth in reason.serves[:TOLD]
    ]
    return ", ".join(parts) or "all slightly"


def interval_table(plan: Plan) -> ShownTable:
    """Predicted half widths of the 95 % intervals."""
    combined = any(p.combined_with for p in plan.predicted)
    rows: list[tuple[str, ...]] = []
    for p in plan.predicted:
        shown, unit = display(p.half_width, p.unit)
        row = (printable(p.name), significant(shown, 2), unit)
        rows.append((*row, _partners(p)) if combined else row)
    heads: tuple[str, ...] = ("parameter", "± 95 %", "unit")
    heads = (*heads, "together with") if combined else heads
    return ShownTable(heads, rows, (0, 2, 3), title="Predicted intervals")


def _partners(p: Predicted) -> str:
    names = [printable(name) for name in p.combined_with]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def curve_table(plan: Plan) -> ShownTable:
    """The criterion against the number of poses."""
    heads = ("poses", f"{plan.criterion} {plan.unit}".strip(), "best possible on the pool")
    rows = [
        (str(s.poses), f"{s.value:.4g}", "–" if s.bound is None else f"{s.bound:.4g}")
        for s in plan.curve
    ]
    return ShownTable(heads, rows, (), title="Number of poses")


def timed_table(plan: Plan) -> ShownTable:
    """The criterion against numbers of poses and of readings that the time allows."""
    heads = ("poses", "readings each", "minutes", f"{plan.criterion} {plan.unit}".strip())
    rows = [
        (str(s.poses), str(s.repeats), f"{s.minutes:.0f}", f"{s.value:.4g}") for s in plan.timed
    ]
    return ShownTable(heads, rows, (), title="Poses and readings within the time")


def stop_table(plan: Plan) -> ShownTable:
    """The stops in the order of execution: what the operator does at each, with a box to tick."""
    rows, loads, e = [], len(plan.forces) > 1, plan.execution
    for k, (stop, now) in enumerate(zip(e.stops, e.arrivals, strict=True)):
        change = ", to change" * (stop.change_after is not None)
        load = [f"{' '.join(f'{f:g}' for f in plan.forces[stop.load])}{change}"] if loads else []
        rows.append((str(k + 1), stop.name(plan.configurations), *load, f"{now / 60:.0f}", "☐"))
    heads = ("stop", "pose", *(["load in N"] if loads else []), "minute", "done")
    return ShownTable(heads, rows, (2,) if loads else (), title="Stops in order")


APART = 0.02  # of the criterion, between starts of the search: more of them may find better
VAIN = 0.1  # below which the bound says nothing: so few poses cannot be spread as its weights are


def plan_headline(plan: Plan) -> str:
    """What the plan is worth and how far from the best it is, in one sentence."""
    n = counted(len(plan.q), "pose")
    if plan.of_test_poses:
        text = (
            f"{n}: position error ρ₀ = {_rho(plan):.3g} µm rms at the test poses after compensation"
        )
    else:
        text = f"{n}: {plan.criterion} = {plan.reported:.4g} {plan.unit}".rstrip()
    found, better = plan.certificate.efficiency_pool, plan.certificate.better_pool
    if found is None or better is None or found < VAIN:
        return f"{text}; no bound on the best plan is known."
    away = 100 * better
    text += "; no other plan from these candidates is "
    text += "better" if away < 0.05 else f"more than {away:.1f} % better"
    text += " by the weighted error" if _weighted(plan) else ""
    return f"{text} (certified)."


def _weighted(plan: Plan) -> bool:
    """Was the error at the test poses minimised together with that elsewhere?"""
    return plan.everywhere is not None and plan.everywhere.share > 0


def _rho(plan: Plan) -> float:
    """ρ₀ in µm, also where the criterion weighs it with the error elsewhere."""
    e = plan.everywhere
    return plan.reported if e is None or not e.share else e.test_poses * 1e6


def _apart(plan: Plan) -> bool:
    """Did the starts of the search end so far apart that more of them may find a better plan?"""
    ends = plan.certificate.starts
    return len(ends) > 1 and max(ends) - min(ends) > APART * max(abs(end) for end in ends)


def plan_steps(plan: Plan) -> list[str]:
    steps = [
        "Measure the poses in the given order, which limits the effect of drift, and record the "
        "time of each reading."
    ]
    if plan.of_test_poses:
        steps.append(
            f"If ρ₀ is not small enough: {option('target')} finds the fewest poses for a value, "
            f"{option('curve')} compares numbers of poses."
        )
    if _apart(plan):
        steps.append(f"For a better plan: {option('effort', 'thorough')}, which has more starts.")
    together = sum(bool(p.combined_with) for p in plan.predicted)
    if together:
        steps.append(
            f"{counted(together, 'parameter')} will be determined only in sums: more "
            "markers or load states separate them, more poses like these do not."
        )
    steps.append("Then: elastocal identify with the same cell and the measurements.")
    return steps


def plan_lines(plan: Plan) -> list[tuple[str, str]]:
    """What the plan is worth, as (label, sentence)."""
    lines = [*_chosen_lines(plan), *_state_lines(plan), _criterion_line(plan)]
    if plan.made_for:
        lines.append(("Made for", f"{printable(plan.made_for)}."))
    lines += [*_everywhere_lines(plan), *_chance_lines(plan)]
    lines.append(_candidate_line(plan))
    lines += _certificate_lines(plan)
    lines += [_execution_line(plan), *_drift_lines(plan)]
    s = plan.scheduled
    if s is not None and s.test_poses is not None and s.without is not None:
        text = (
            f"{s.test_poses * 1e6:.4g} µm at the test poses with {listed(s.effects)} identified "
            f"too, {s.without * 1e6:.4g} µm if they were known"
        )
        lines.append(("In time", f"{text}."))
    if plan.timed:
        spec, took = plan.model.cell.design, plan.execution.total / 60
        text = f"{took:.0f} minutes with {counted(spec.repeats, 'reading')} of each marker"
        lines.append(("Time", f"{text}, moves and changes of load included."))
    if plan.polished:
        text = f"{plan.polished} of {len(plan.q)} poses come from local searches between the drawn"
        lines.append(("Polish", f"{text} candidates."))
    return lines


def _chosen_lines(plan: Plan) -> list[tuple[str, str]]:
    """What was chosen besides the poses, and what it is worth."""
    c = plan.chosen
    if c is None:
        return []

    def at(place: Any) -> str:
        return f"[{', '.join(f'{v:.4g}' for v in place)}]"

    told = [
        f"{printable(name)} at {at(after)} m instead of {at(before)}"
        for name, (before, after) in c.places.items()
    ]
    if c.loads is not None:
        told.append(f"loads {', '.join(at(load) for load in c.loads)} N")
    stood = "no plan" if c.before is None else f"{c.before:.4g}"
    seen = "none" if c.share[0] is None else f"{100 * c.share[0]:.1f} %"
    worth = (
        f"best possible value of any plan from {stood} to {c.after:.4g} {c.unit}".rstrip()
        + f" (relaxed, {c.candidates} candidates each), feasible poses from {seen} to "
        f"{100 * c.share[1]:.1f} %"
    )
    return [("Chosen", f"{'; '.join(told)}."), ("Chosen", f"{worth}.")]


def _state_lines(plan: Plan) -> list[tuple[str, str]]:
    """In which load states poses are measured, and what that is worth."""
    s = plan.states
    if s is None:
        return []
    worth, unit = "", f" {plan.unit}" if plan.unit else ""
    if s.crossed is not None and s.chosen is not None:
        worth = (
            f" (relaxed on candidates, in the same time: in all load states {s.crossed:.4g}{unit}, "
            f"chosen for each pose {s.chosen:.4g}{unit})"
        )
    if s.used == "all":
        return [("Loads", f"every pose in every load state, as {s.why}{worth}.")]
    counts = (plan.readings > 0).sum(axis=0)
    told = [
        f"{counted(int(n), 'pose')} {'' if name == 'unloaded' else 'under '}{name}"
        for n, name in zip(counts, map(load_name, plan.forces), strict=True)
        if n
    ]
    return [("Loads", f"{listed(told)}{worth}.")]


def _criterion_line(plan: Plan) -> tuple[str, str]:
    if not plan.of_test_poses:
        return "Criterion", f"{plan.criterion} = {plan.reported:.6g} {plan.unit}".rstrip() + "."
    return "Criterion", (
        f"ρ₀ = {_rho(plan):.4g} µm rms position error at the test poses after compensation "
        f"({printable(plan.targets)})."
    )


def _everywhere_lines(plan: Plan) -> list[tuple[str, str]]:
    """The error at the test poses and all over the joint ranges, beside a random plan's."""
    e = plan.everywhere
    if e is None:
        return []

    def micrometres(error: float | None) -> str:
        return "none" if error is None else f"{error * 1e6:.4g}"

    own = "" if plan.of_test_poses else f"; at the test poses {e.test_poses * 1e6:.4g}"
    text = (
        f"{e.elsewhere * 1e6:.4g} µm rms over the joint ranges{own}; a random plan gives "
        f"{micrometres(e.random_elsewhere)} there and {micrometres(e.random_test_poses)} at the "
        "test poses"
    )
    noise = plan.model.cell.noise
    if noise.drift:
        text += (
            f"; with the drift of {noise.drift * 1e6:.3g} µm that [noise] states "
            f"{e.drifting_test_poses * 1e6:.4g} and {e.drifting_elsewhere * 1e6:.4g} µm"
        )
    if e.share:
        text += f"; minimised is the weighted error, {plan.reported:.4g} µm, in which the joint "
        text += f"ranges count {100 * e.share:.0f} %"
        text += f", with ρ₀ at most {100 * e.cap:g} % above its minimum" if e.cap else ""
    elif plan.of_test_poses:
        text += (
            f"; {option('elsewhere_cap', 0.05)} minimises it, allowing 5 % more at the test poses"
        )
    return [("Elsewhere", f"{text}.")]


def _chance_lines(plan: Plan) -> list[tuple[str, str]]:
    """What as many random poses would have given."""
    c = plan.chance
    if c is None:
        return []
    whole = f"{c.n} random plans of as many feasible poses"
    open_ = c.n - c.determined
    lost = f"{open_} of {whole} do not determine all parameters of this plan"
    if c.median is None or c.best is None:
        return [("Chance", f"{lost}.")]
    name = _criterion(plan)
    unit = f" {plan.unit}" if plan.unit else ""
    worst = "no value" if c.worst is None else f"{c.worst:.4g}"
    text = (
        f"the median of {whole} has {name} = {c.median:.4g}{unit} (best {c.best:.4g}, worst "
        f"{worst})"
    )
    if c.efficiency is not None:
        text += f", an efficiency of {c.efficiency:.2f} against this plan"
    return [("Chance", f"{text}; {lost}." if open_ else f"{text}.")]


def _criterion(plan: Plan) -> str:
    """The name of what the search made small, which starts and bound are figures of."""
    if _weighted(plan):
        return "weighted error"
    return "ρ₀" if plan.of_test_poses else plan.criterion


def _candidate_line(plan: Plan) -> tuple[str, str]:
    c = plan.candidates
    hardest = sorted(c.removed_by.items(), key=lambda item: -item[1])
    told = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in hardest if n)
    text = f"{c.feasible} feasible of {c.tried} tried"
    return "Candidates", text + (f"; removed by {told}." if told else "; no rule removed any.")


def _certificate_lines(plan: Plan) -> list[tuple[str, str]]:
    c = plan.certificate
    if c.efficiency_pool is None:
        reason = CRITERIA[plan.criterion].without_bound
        return [("Certificate", f"none: {plan.criterion} {reason}, so no bound is known.")]
    told = ""
    if plan.bound_reported is not None:
        told = f" (bound {_criterion(plan)} = {plan.bound_reported:.4g} {plan.unit})"
    lines = [
        (
            "Certificate",
            f"certified on the pool: efficiency {_share(c.efficiency_pool)} (in readings) against "
            f"the best subset of the {c.pool} candidates with the same number per level"
            f"{told.replace(' )', ')')}.",
        )
    ]
    if c.efficiency_pool < VAIN:
        text = (
            "with so few poses the bound says nothing: the relaxation spreads weights over many "
            "candidates"
        )
        return [*lines, ("Certificate", f"{text}.")]
    if c.efficiency_continuum is not None:
        lines.append(
            (
                "Certificate",
                f"estimated on the continuum: efficiency {c.efficiency_continuum:.4f}, after "
                f"{c.searched} more poses and {c.ascents} local searches; a better pose may "
                "have been missed.",
            )
        )
    return lines + _starts_lines(plan)


def _starts_lines(plan: Plan) -> list[tuple[str, str]]:
    """Where the starts of the search ended, and what lies between the best plan and the bound."""
    ends, bound = plan.certificate.starts, plan.bound_reported
    if not ends or bound is None:
        return []
    unit = f" {plan.unit}" if plan.unit else ""
    low, high = f"{min(ends):.4g}", f"{max(ends):.4g}"
    told = f"{low if low == high else f'{low} to {high}'}{unit}"
    text = (
        f"{counted(len(ends), 'start')} of the search ended with {_criterion(plan)} = {told}, the "
        f"bound is {bound:.4g}{unit}. The difference is what no start found, or what only weights "
        "can reach: the fewer poses, the more of the latter."
    )
    return [("Certificate", text)]


def _share(value: float) -> str:
    return f"{value:.4f}" if value >= VAIN else f"{value:.1g}"


def _execution_line(plan: Plan) -> tuple[str, str]:
    e = plan.execution
    stops, changes = len(e.stops), e.load_changes
    text = f"{stops} stops, {e.travel:.0f} s of travel"
    again = sum(stop.again > 0 for stop in e.stops)
    if again:
        text = f"{stops} stops, {again} of them at reference poses, {e.travel:.0f} s of travel"
    parts = sum(stop.part > 0 for stop in e.stops)
    if parts:
        text += f"; {parts} poses are measured unloaded at start and end (half the readings each)"
    if changes:
        text += f", {changes} load change{'s' if changes > 1 else ''} by hand"
    via = sum(len(stop.via) for stop in e.stops) + len(e.home_via)
    if via:
        text += f", {via} via points around obstacles"
    space = plan.model.cell.workspace
    if len(space.link_radius) > 0 or space.urdf_geometry or len(space.bodies) > 0:
        checked = "every move checked"
    elif mounting_plane(plan.model.cell, plan.model.chain) is not None:
        checked = (
            "every move checked against the mounting plane (z = 0 of the base; [workspace] "
            "mounting_plane = false disables it) only, as [workspace] states no bodies"
        )
    else:
        checked = (
            "no move was checked, as [workspace] states no bodies, and poses may reach below the "
            "mounting plane"
        )
    return "Execution", f"{text}, {e.total / 60:.0f} min in all; {checked}."


def _drift_lines(plan: Plan) -> list[tuple[str, str]]:
    """What a steady drift does in this order, and what it would do in the shortest."""
    d = plan.execution.drift
    if d is None:
        return []
    size = f"a steady drift of {DRIFT * 1e6:g} µm"
    if d.at_test_poses:
        text = f"{size} changes the result by at most {d.bias * 1e6:.2g} µm at the test poses"
        other = f"{d.shortest * 1e6:.2g} µm"
    else:
        text = f"{size} changes parameters by at most {d.bias:.2g} standard deviations"
        other = f"{d.shortest:.2g}"
    if d.bias < d.shortest:
        text += f" (in the shortest order {other})"
    return [("Drift", f"{text}.")]


def next_lines(found: NextPoses) -> list[tuple[str, str]]:
    """Whether to measure more, what it brings, and what may be missing, as (label, sentence)."""
    g, n = found.gain, counted(found.batch, "pose")
    limit = "" if found.required is None else f" (required: {found.required * 1e6:.3g} µm)"
    verdicts = {
        "measure": f"measure {n} more; then run it again with all readings in one table",
        "enough": "no further pose is needed: the required error is kept with 95 %",
        "no_gain": f"no {n} lower the error by {100 * found.least_gain:g} % "
        f"({option('least_gain')}): use more repeats, a better instrument "
        "or another kind of measurement",
    }
    now = "not known yet, as some parameters are undetermined"
    if math.isfinite(found.reached):
        now = f"≤ {found.reached * 1e6:.3g} µm rms at new poses (95 %){limit}"

    def both(before: float, after: float) -> str:
        begun = f"{before * 1e6:.3g} µm" if math.isfinite(before) else "an unknown error"
        return f"{begun} to {after * 1e6:.3g} µm"

    lines = [("Next", verdicts[found.verdict] + "."), ("Error now", now + ".")]
    lines.append(
        (
            "Gain",
            f"{n} lower the rms error at the test poses from {both(g.before, g.after)} with what "
            f"the model may lack; from {both(g.model_before, g.model_after)} if it is right.",
        )
    )
    named = [f"{f.effect} at {f.where} ({f.probability:.2f})" for f in found.found]
    if named:
        text = f"{', '.join(named)}, added to the model here; write the cell with it"
        lines.append(("Found", printable(f"{text} (diagnose, {option('cell_out')}).")))
    doubts = [f"{e} at {w} ({p:.2g})" for e, w, p in found.doubts[:3]]
    if doubts:
        rivals = found.diagnosis is not None and found.diagnosis.open
        apart = f"; poses that tell them apart: diagnose {option('plan')}" if rivals else ""
        lines.append(("In doubt", printable(f"likeliest {', '.join(doubts)}{apart}.")))
    return lines
