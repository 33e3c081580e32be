"""What a measurement plan says, as blocks: its worth, the stops, and what is behind them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from elastocal.messages import listed, option, printable, rounded, some
from elastocal.planning.collision import mounting_plane
from elastocal.planning.criteria import CRITERIA
from elastocal.planning.execution import DRIFT
from elastocal.planning.plan import Plan, Reason, load_name
from elastocal.report import blocks as say
from elastocal.report.figures import NO_ENDS, plan_curve, rows_of_dots

if TYPE_CHECKING:
    from elastocal.diagnosis.next_poses import NextPoses


def plan_blocks(plan: Plan) -> Iterator[say.Block]:
    def arm() -> Iterator[say.Block]:
        from elastocal.report.arm_view import plan_arm

        yield say.Lines([("Next", text) for text in plan_steps(plan)])
        yield stop_table(plan)
        yield plan_arm(plan)

    yield say.Fold("", lambda: [_key(plan)])
    # A gap to the bound is no fault of the plan's: with few poses much of it is the bound's.
    yield say.ShownVerdict("warn" if plan.warnings else "good", plan_headline(plan))
    yield say.Lines([(say.WARNING, say.sentence(printable(text))) for text in plan.warnings])
    yield say.Fold("", arm, figures=("poses",))
    # Less digits where there is no room.
    two, one, none = (pose_table(plan, decimals) for decimals in (2, 1, 0))
    poses = replace(two, narrow=replace(one, narrow=none))
    yield say.Fold("Poses", lambda: [poses], printed=True)
    why = [(name, served(r)) for name, r in zip(plan.names, plan.reasons, strict=True)]
    reasons = say.ShownTable(("pose", SERVES), why, (1,), title="Why each pose")
    yield say.Fold("Why each pose", lambda: [reasons], printed=True)
    yield say.Fold("Predicted intervals", lambda: [interval_table(plan)], printed=True)
    figure = f"{plan.criterion} {plan.unit}".strip()
    if plan.curve:
        rows = [
            (str(s.poses), rounded(s.value, 4), "–" if s.bound is None else rounded(s.bound, 4))
            for s in plan.curve
        ]
        heads = ("poses", figure, "best possible on the pool")
        drawn = ", of the candidates as drawn" * (plan.model.cell.design.target is None)
        curve = say.ShownTable(heads, rows, (), title=f"Number of poses{drawn}")
        both: list[say.Block] = [curve, plan_curve(plan)]
        yield say.Fold(curve.title, lambda: both, printed=True, figures=("curve",))
    if plan.timed:
        timed = say.ShownTable(
            ("poses", "readings each", "minutes", figure),
            [(str(s.poses), str(s.repeats), f"{s.minutes:.0f}", rounded(s.value, 4))
             for s in plan.timed],
            (), title="Poses and readings within the time",
        )  # fmt: skip
        yield say.Fold(timed.title, lambda: [timed], printed=True)
    yield say.Fold("What the plan is worth", lambda: [say.Lines(plan_lines(plan))], printed=True)


def next_blocks(found: NextPoses) -> Iterator[say.Block]:
    g, names = found.gain, ("measured so far", "with this batch")
    rows = [
        (f"{name}{model}", value, NO_ENDS)
        for model, values in (("", (g.before, g.after)),
                              (", if the model is right", (g.model_before, g.model_after)))
        for name, value in zip(names, values, strict=True) if math.isfinite(value)
    ]  # fmt: skip
    title, axis = "Error before and after the batch", "rms error at the test poses"
    yield say.Lines(next_lines(found))
    yield say.Fold("", lambda: [rows_of_dots("gain", title, rows, axis)], figures=("gain",))
    if found.plan is not None:
        yield from plan_blocks(found.plan)


def _key(plan: Plan) -> say.KeyFigures:
    n, minutes = say.counted(len(plan.q), "pose"), f"{plan.execution.total / 60:.0f} min"
    worth = "criterion", f"{plan.criterion} = {_value(plan, plan.reported)}"
    if plan.of_test_poses:
        worth = "error at the test poses", say.length(_rho(plan) * 1e-6)
    figures = [("poses", str(len(plan.q))), worth]
    if (e := plan.everywhere) is not None:
        figures.append(("error over the joint ranges", say.length(e.elsewhere)))
    figures.append(("time", minutes))
    figures += [("load states", str(len(plan.forces)))][: 4 - len(figures)]
    return say.KeyFigures(f"{n} → {worth[1]}, {minutes}", figures)


def _value(plan: Plan, value: float) -> str:
    return f"{rounded(value, 4)} {plan.unit}".rstrip()


TOLD = 2  # parameters that a pose serves, in the table
MANIFOLD = 3.0  # from which a growth reads better as a factor
SERVES = "most affected if dropped (standard deviation)"


def pose_table(plan: Plan, decimals: int = 2) -> say.ShownTable:
    kinds, each = plan.model.chain.kinds, range(len(plan))
    joints = zip(*(say.joint_texts(q, kinds, decimals) for q in plan.q), strict=True)
    columns: dict[str, Sequence[str]] = {"pose": plan.names}
    columns |= dict(zip(say.joint_heads(kinds), joints, strict=True))
    order = say.first_stops(plan)
    columns["order"] = [str(order[k]) for k in each]
    if not plan.crossed:
        columns["load"] = [plan.loads(k) for k in each]
    if plan.seen is not None:
        columns["markers"] = [printable(plan.markers(k)) for k in each]
    words = tuple(k for k, head in enumerate(columns) if head in ("load", "markers"))
    rows = list(zip(*columns.values(), strict=True))
    return say.ShownTable(tuple(columns), rows, words, title="Poses")


def served(reason: Reason) -> str:
    def grown(factor: float) -> str:
        if math.isinf(factor):
            return "undetermined"
        return f"×{rounded(factor)}" if factor >= MANIFOLD else f"+{100 * (factor - 1):.0f} %"

    parts = [f"{printable(name)} {grown(factor)}" for name, factor in reason.serves[:TOLD]]
    return ", ".join(parts) or "all slightly"


def interval_table(plan: Plan) -> say.ShownTable:
    rows: list[tuple[str, ...]] = []
    for p in plan.predicted:
        shown, unit = say.display(p.half_width, p.unit)
        others = some(map(printable, p.combined_with), 3)
        rows.append((printable(p.name), say.significant(shown, 2), unit, others))
    heads = ("parameter", "± 95 %", "unit", "together with")
    table = say.ShownTable(heads, rows, (0, 2, 3), title="Predicted intervals")
    return table if any(p.combined_with for p in plan.predicted) else table.without(3)


def stop_table(plan: Plan) -> say.ShownTable:
    rows, loads, e = list[tuple[str, ...]](), len(plan.forces) > 1, plan.execution

    def via(stop: int | None) -> Iterator[tuple[str, ...]]:
        points = [say.joint_texts(q, plan.model.chain.kinds) for at, q in e.between if at == stop]
        return (("", f"via {', '.join(q)}", *[""] * (2 + loads)) for q in points)

    for k, (stop, now) in enumerate(zip(e.stops, e.arrivals, strict=True)):
        rows += via(k + 1)
        change = ", to change" * (stop.change_after is not None)
        load = [f"{' '.join(f'{f:g}' for f in plan.forces[stop.load])}{change}"] if loads else []
        rows.append((str(k + 1), stop.name(plan.names), *load, f"{now / 60:.0f}", "☐"))
    rows += via(None)
    heads = ("stop", "pose", *(["load in N"] if loads else []), "minute", "done")
    return say.ShownTable(heads, rows, (1, 2) if loads else (1,), title="Stops in order")


def plan_headline(plan: Plan) -> str:
    text = f"{say.counted(len(plan.q), 'pose')}: "
    if plan.of_test_poses:
        error = say.length(_rho(plan) * 1e-6)
        text += f"position error ρ₀ = {error} rms at the test poses after compensation"
        if (g := plan.gain) is not None and g.model_after > 1.01e-6 * _rho(plan):
            text += f", {say.length(g.model_after)} with the cell's smooth functions"
    else:
        text += f"{plan.criterion} = {_value(plan, plan.reported)}"
    better = plan.certificate.better_pool
    if better is None or plan.certificate.vain:
        return f"{text}; no useful bound on the best plan is known."
    text += "; no other plan from these candidates is "
    text += f"more than {100 * better:.1f} % better" if better else "better"
    text += " by the weighted error" if _weighted(plan) else ""
    return f"{text} (certified)."


def _weighted(plan: Plan) -> bool:
    return plan.everywhere is not None and plan.everywhere.share > 0


def _rho(plan: Plan) -> float:
    e = plan.everywhere
    return plan.reported if e is None or not e.share else e.test_poses * 1e6


def _criterion(plan: Plan) -> str:
    if _weighted(plan):
        return "weighted error"
    return "ρ₀" if plan.of_test_poses else plan.criterion


def plan_steps(plan: Plan) -> Iterator[str]:
    yield (
        "Measure the poses in the given order, which limits the effect of drift, and record the "
        "time of each reading."
    )
    if plan.of_test_poses:
        yield (
            f"If ρ₀ is not small enough: {option('target')} finds the fewest poses for a value, "
            f"{option('curve')} compares numbers of poses."
        )
    ends = plan.certificate.starts
    if ends and max(ends) - min(ends) > 0.02 * max(map(abs, ends)):
        yield f"For a better plan: {option('effort', 'thorough')}, which has more starts."
    if together := sum(bool(p.combined_with) for p in plan.predicted):
        yield (
            f"{say.counted(together, 'parameter')} will be determined only in sums, which more "
            "poses like these do not separate: as expected where they describe the same motion; "
            "other loads separate compliances, three markers the turn of the tool."
        )
    yield "Then: elastocal identify with the same cell and the measurements."


Told = Iterator[tuple[str, str]]  # label, sentence


def plan_lines(plan: Plan) -> Told:
    yield from _chosen_lines(plan)
    text = f"{plan.criterion} = {_value(plan, plan.reported)}"
    if plan.of_test_poses:
        text = f"ρ₀ = {rounded(_rho(plan), 4)} µm rms position error at the test poses after "
        text += f"compensation ({printable(plan.targets)})"
    yield "Criterion", f"{text}."
    if plan.made_for:
        yield "Made for", f"{printable(plan.made_for)}."
    yield from _everywhere_lines(plan)
    yield from _chance_lines(plan)
    c = plan.candidates
    hardest = sorted(c.removed_by.items(), key=lambda item: -item[1])
    told = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in hardest if n)
    rules = f"; removed by {told}." if told else "; no rule removed any."
    yield "Candidates", f"{c.feasible} feasible of {c.tried} tried{rules}"
    yield from (("Certificate", text) for text in _certificate(plan))
    yield from _execution_lines(plan)
    s = plan.scheduled
    if s is not None and s.test_poses is not None and s.without is not None:
        yield (
            "In time",
            f"{rounded(s.test_poses * 1e6, 4)} µm at the test poses with {listed(s.effects)} "
            f"identified too, {rounded(s.without * 1e6, 4)} µm if they were known.",
        )
    if plan.timed:
        spec, took = plan.model.cell.design, plan.execution.total / 60
        text = f"{took:.0f} minutes with {say.counted(spec.repeats, 'reading')} of each marker"
        yield "Time", f"{text}, moves and changes of load included."
    if plan.polished:
        text = f"{plan.polished} of {len(plan.q)} poses come from local searches between the drawn"
        yield "Polish", f"{text} candidates."


def _chosen_lines(plan: Plan) -> Told:
    c, s = plan.chosen, plan.states

    def at(place: Any) -> str:
        return f"[{', '.join(rounded(v, 4) for v in place)}]"

    if c is not None:
        told = [
            f"{printable(name)} at {at(after)} m instead of {at(before)}"
            if at(after) != at(before)
            else f"{printable(name)} stays at {at(before)} m"
            for name, (before, after) in c.places.items()
        ]
        if c.loads is not None:
            told.append(f"loads {', '.join(at(load) for load in c.loads)} N")
        yield "Chosen", f"{'; '.join(told)}."
        stood = "no plan" if c.before is None else rounded(c.before, 4)
        seen = "none" if c.share[0] is None else f"{100 * c.share[0]:.1f} %"
        value = f"{rounded(c.after, 4)} {c.unit}".rstrip()
        worth = f"best possible value of any plan from {stood} to {value}"
        yield (
            "Chosen",
            f"{worth} (relaxed, {c.candidates} candidates each), feasible poses from {seen} to "
            f"{100 * c.share[1]:.1f} %.",
        )
    if s is None:
        return
    text = f"every pose in every load state, as {s.why}"
    if s.used != "all":
        text = listed(
            f"{say.counted(int(n), 'pose')} {'' if name == 'unloaded' else 'under '}{name}"
            for n, name in zip(plan.read_in, map(load_name, plan.forces), strict=True)
            if n
        )
    if s.crossed is not None and s.chosen is not None:
        text += (
            " (relaxed on candidates, time saved spent on more stops: in all load states "
            f"{_value(plan, s.crossed)}, chosen for each pose {_value(plan, s.chosen)})"
        )
    yield "Loads", f"{text}."


def _everywhere_lines(plan: Plan) -> Told:
    if (e := plan.everywhere) is None:
        return

    def shown(error: float | None) -> str:
        return "none" if error is None else f"{rounded(error * 1e6, 4)} µm"

    own = "" if plan.of_test_poses else f"; at the test poses {shown(e.test_poses)}"
    text = f"{shown(e.elsewhere)} rms over the joint ranges{own}; a random plan gives "
    text += f"{shown(e.random_elsewhere)} there and {shown(e.random_test_poses)} at the test poses"
    if drift := plan.model.cell.noise.drift:
        text += f"; with the drift of {say.length(drift)} that [noise] states "
        text += f"{shown(e.drifting_test_poses)} and {shown(e.drifting_elsewhere)}"
    if e.share:
        text += f"; minimised is the weighted error, {rounded(plan.reported, 4)} µm, in which the "
        text += f"joint ranges count {100 * e.share:.0f} %"
        text += f", with ρ₀ at most {100 * e.cap:g} % above its minimum" if e.cap else ""
    elif plan.of_test_poses:
        cap = option("elsewhere_cap", 0.05)
        text += f"; {cap} minimises it, allowing 5 % more at the test poses"
    yield "Elsewhere", f"{text}."


def _chance_lines(plan: Plan) -> Told:
    c = plan.chance
    if c is None:
        return
    whole = f"{c.n} random plans of as many feasible poses"
    lost = f"{c.n - c.determined} of {whole} do not determine all parameters of this plan"
    text = ""
    if c.median is not None and c.best is not None:
        worst = "no value" if c.worst is None else rounded(c.worst, 4)
        text = (
            f"the median of {whole} has {_criterion(plan)} = {_value(plan, c.median)} (best "
            f"{rounded(c.best, 4)}, worst {worst})"
        )
        if c.efficiency is not None:
            text += f", an efficiency of {c.efficiency:.2f} against this plan"
    yield "Chance", "; ".join([text] * bool(text) + [lost] * (not text or c.n > c.determined)) + "."


def _certificate(plan: Plan) -> Iterator[str]:
    c, name = plan.certificate, _criterion(plan)
    found, bound = c.efficiency_pool, plan.bound_reported
    if found is None:
        reason = CRITERIA[plan.criterion].without_bound
        yield f"none: {plan.criterion} {reason}, so no bound is known."
        return
    told = "" if bound is None else f" (bound {name} = {_value(plan, bound)})"
    efficiency = f"{found:.1g}" if c.vain else f"{found:.4f}"
    yield (
        f"certified on the pool: efficiency {efficiency} (in readings) against the best subset of "
        f"the {c.pool} candidates with the same number per level{told}."
    )
    if c.vain:
        yield (
            "with so few poses the bound says nothing: the relaxation spreads weights over many "
            "candidates."
        )
        return
    if c.efficiency_continuum is not None:
        yield (
            f"estimated on the continuum: efficiency {c.efficiency_continuum:.4f}, after "
            f"{c.searched} more poses and {c.ascents} local searches; a better pose may "
            "have been missed."
        )
    if c.starts and bound is not None:
        ends = " to ".join(dict.fromkeys(rounded(e, 4) for e in (min(c.starts), max(c.starts))))
        yield (
            f"{say.counted(len(c.starts), 'start')} of the search ended with {name} = "
            f"{f'{ends} {plan.unit}'.rstrip()}, the bound is {_value(plan, bound)}. The difference "
            "is what no start found, or what only weights can reach: the fewer poses, the more of "
            "the latter."
        )


def _execution_lines(plan: Plan) -> Told:
    e, space = plan.execution, plan.model.cell.workspace
    again = sum(stop.again > 0 for stop in e.stops)
    visits = f", {again} of them at reference poses" if again else ""
    text = f"{say.counted(len(e.stops), 'stop')}{visits}, {e.travel:.0f} s of travel"
    parts = sum(stop.part > 0 for stop in e.stops)
    if parts:
        are = f"{say.counted(parts, 'pose')} {'is' if parts == 1 else 'are'}"
        up = ", rounded up" * (plan.model.cell.design.repeats % 2)
        text += f"; {are} measured unloaded at start and end (half the readings each{up})"
    if e.load_changes:
        text += f", {say.counted(e.load_changes, 'load change')} by hand"
    via = len(e.between)
    text += f", {say.counted(via, 'via point')} (page and JSON list them)" if via else ""
    checked = "every move checked"
    if not (len(space.link_radius) > 0 or space.urdf_geometry or len(space.bodies) > 0):
        if mounting_plane(plan.model.cell, plan.model.chain) is None:
            checked = "no move was checked, and poses may reach below the mounting plane"
        else:
            checked += " against the mounting plane only (z = 0 of the base; [workspace] "
            checked += "mounting_plane = false disables it)"
        checked += ", as [workspace] states no bodies"
    yield "Execution", f"{text}, {e.total / 60:.0f} min in all; {checked}."
    if (d := e.drift) is None:
        return
    text = f"a steady drift of {DRIFT * 1e6:g} µm changes "
    if d.at_test_poses:
        text += f"the result by at most {rounded(round(d.bias * 1e6, 6), 2)} µm at the test poses"
        other = f"{rounded(d.shortest * 1e6, 2)} µm"
    else:
        text += f"parameters by at most {rounded(d.bias, 2)} standard deviations"
        other = rounded(d.shortest, 2)
    yield "Drift", f"{text}{f' (in the shortest order {other})' * (d.bias < d.shortest)}."


def next_lines(found: NextPoses) -> Told:
    g, n = found.gain, say.counted(found.batch, "pose")
    limit = "" if found.required is None else f" (required: {say.length(found.required)})"
    verdicts = {
        "measure": f"measure {n} more; then run it again with all readings in one table",
        "enough": "no further pose is needed: the required error is kept with 95 %",
        "no_gain": f"no {n} lower the error by {100 * found.least_gain:g} % "
        f"({option('least_gain')}): use more repeats, a better instrument "
        "or another kind of measurement",
    }
    now = "not known yet, as some parameters are undetermined"
    if math.isfinite(found.reached):
        now = f"≤ {say.length(found.reached)} rms at new poses (95 %){limit}"
        if (alone := found.beside) is not None:
            now += f"; identify says ≤ {say.length(alone)}, as it takes all scatter beyond the "
            now += "noise for what the model may lack, and diagnose finds that improbable"

    def both(before: float, after: float) -> str:
        begun = say.length(before) if math.isfinite(before) else "an unknown error"
        return f"{begun} to {say.length(after)}"

    fit = found.calibration
    if fit is not None and (fit.verdict.tone == "poor" or found.verdict == "enough"):
        yield from ((say.WARNING, say.sentence(printable(text))) for text in fit.arm.doubted)
    yield "Next", f"{verdicts[found.verdict]}."
    yield "Error now", f"{now}."
    gain, if_right = both(g.before, g.after), both(g.model_before, g.model_after)
    gain += f" with what the model may lack; from {if_right} if it is right" * (gain != if_right)
    yield "Gain", f"{n} lower the expected rms error at the test poses from {gain}."
    named = [f"{say.effect_at(f)} ({say.probability(f.probability)})" for f in found.found]
    if named:
        text = f"{', '.join(named)}, added to the model here; write the cell with it"
        yield "Found", printable(f"{text} (diagnose, {option('cell_out')}).")
    doubts = [
        f"{say.effect_at_places(effect, [where])} ({say.probability(p)})"
        for effect, where, p in found.doubts[:3]
        if not say.probability(p).startswith("<")
    ]
    if doubts:
        rivals = found.diagnosis is not None and found.diagnosis.open
        apart = f"; poses that tell them apart: diagnose {option('plan')}" if rivals else ""
        yield "In doubt", printable(f"likeliest {', '.join(doubts)}{apart}.")
