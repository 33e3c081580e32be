"""A measurement plan as tables and lines for the terminal."""

from __future__ import annotations

import math

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.design.plan import Plan
from elastocal.design.reasons import Predicted, Reason
from elastocal.report.console_table import titled
from elastocal.report.units import display, significant
from elastocal.report.words import printable

TOLD = 2  # parameters that a pose serves, in the table
WIDE = 110  # columns, from which on the reasons stand beside the poses
SERVES = "serves (standard deviation without it)"


def print_plan(console: Console, plan: Plan) -> None:
    """Poses in the order of the plan, predicted intervals, and what the plan is worth in words."""
    wide = console.width >= WIDE
    console.print(pose_table(plan) if wide else _narrow_poses(console, plan))
    if not wide:
        console.print(reason_table(plan))
    console.print(interval_table(plan))
    if plan.curve:
        console.print(curve_table(plan))
    console.print()
    for label, text in plan_lines(plan):
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((f"{label}: ", style), text))


def _narrow_poses(console: Console, plan: Plan) -> Table:
    """The poses with as many decimals as there is room for; plan.csv has all of them."""
    room = console.options.update(max_width=WIDE)
    for decimals in (2, 1):
        table = pose_table(plan, reasons=False, decimals=decimals)
        if console.measure(table, options=room).maximum <= console.width:
            return table
    return pose_table(plan, reasons=False, decimals=0)


def pose_table(plan: Plan, reasons: bool = True, decimals: int = 2) -> Table:
    """Joint values, load, place in the order of execution, and what the pose is there for."""
    table = titled("Poses")
    table.add_column("pose", justify="right")
    for i, kind in enumerate(plan.model.chain.kinds):
        unit = "°" if kind == "revolute" else "mm"
        table.add_column(f"q{i + 1} {unit}", justify="right", overflow="fold")
    if len(plan.forces) > 1 and (plan.load >= 0).any():
        table.add_column("load N", justify="right")
    table.add_column("order", justify="right")
    if reasons:
        table.add_column(SERVES, overflow="fold")
    order = {stop.pose: k + 1 for k, stop in reversed(list(enumerate(plan.execution.stops)))}
    for k, reason in enumerate(plan.reasons):
        row = [str(k + 1)]
        for value, kind in zip(plan.q[k], plan.model.chain.kinds, strict=True):
            shown = np.degrees(value) if kind == "revolute" else value * 1e3
            row.append(f"{shown:.{decimals}f}")
        if len(plan.forces) > 1 and (plan.load >= 0).any():
            row.append(" ".join(f"{f:g}" for f in plan.forces[plan.load[k]]))
        row += [str(order[k]), *([served(reason)] if reasons else [])]
        table.add_row(*map(Text, row))
    return table


def reason_table(plan: Plan) -> Table:
    """What each pose is there for."""
    table = titled("Why each pose")
    table.add_column("pose", justify="right")
    table.add_column(SERVES, overflow="fold")
    for k, reason in enumerate(plan.reasons):
        table.add_row(str(k + 1), Text(served(reason)))
    return table


def served(reason: Reason) -> str:
    """The parameters that a pose serves most: "joint3.compliance +38 %"."""
    parts = [
        f"{printable(name)} {'lost' if math.isinf(growth) else f'+{100 * (growth - 1):.0f} %'}"
        for name, growth in reason.serves[:TOLD]
    ]
    return ", ".join(parts) or "all a little"


def interval_table(plan: Plan) -> Table:
    """Predicted half widths of the 95 % intervals."""
    table = titled("Predicted intervals")
    table.add_column("parameter", overflow="fold")
    table.add_column("± 95 %", justify="right")
    table.add_column("unit")
    if any(p.combined_with for p in plan.predicted):
        table.add_column("together with", overflow="fold")
    for p in plan.predicted:
        shown, unit = display(p.half_width, p.unit)
        row = [printable(p.name), significant(shown, 2), unit]
        if len(table.columns) > 3:
            row.append(_partners(p))
        table.add_row(*map(Text, row))
    return table


def _partners(p: Predicted) -> str:
    names = [printable(name) for name in p.combined_with]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def curve_table(plan: Plan) -> Table:
    """The criterion against the number of poses."""
    table = titled("Number of poses")
    table.add_column("poses", justify="right")
    table.add_column(f"{plan.criterion} {plan.unit}".strip(), justify="right")
    table.add_column("best possible on the pool", justify="right")
    for point in plan.curve:
        bound = "–" if point.bound is None else f"{point.bound:.4g}"
        table.add_row(str(point.poses), f"{point.value:.4g}", bound)
    return table


def plan_lines(plan: Plan) -> list[tuple[str, str]]:
    """What the plan is worth, as (label, sentence)."""
    lines = [_criterion_line(plan), _candidate_line(plan), *_certificate_lines(plan)]
    lines.append(_execution_line(plan))
    if plan.polished:
        text = f"{plan.polished} of {len(plan.q)} poses come from local searches between the drawn"
        lines.append(("Polish", f"{text} candidates."))
    return lines + [("Warning", printable(text)) for text in plan.warnings]


def _criterion_line(plan: Plan) -> tuple[str, str]:
    if plan.criterion == "test_pose":
        return "Criterion", (
            f"ρ₀ = {plan.reported:.4g} µm, the rms position error that remains at the test poses "
            f"after compensation ({printable(plan.targets)})."
        )
    return "Criterion", f"{plan.criterion} = {plan.reported:.6g} {plan.unit}".rstrip() + "."


def _candidate_line(plan: Plan) -> tuple[str, str]:
    c = plan.candidates
    removed = sorted(c.removed_by.items(), key=lambda item: -item[1])
    told = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in removed if n)
    text = f"{c.feasible} feasible of {c.tried} tried"
    return "Candidates", text + (f"; removed by {told}." if told else "; no rule removed any.")


def _certificate_lines(plan: Plan) -> list[tuple[str, str]]:
    c = plan.certificate
    if c.efficiency_pool is None:
        return [("Certificate", f"none: {plan.criterion} is not convex, so no bound is known.")]
    told = "" if plan.bound_reported is None else f" (bound {plan.bound_reported:.4g} {plan.unit})"
    lines = [
        (
            "Certificate",
            f"certified on the pool: efficiency {c.efficiency_pool:.4f} against the best plan "
            f"of these shares from {c.pool} candidates{told.replace(' )', ')')}.",
        )
    ]
    if c.efficiency_continuum is not None:
        lines.append(
            (
                "Certificate",
                f"estimated on the continuum: efficiency {c.efficiency_continuum:.4f}, after "
                f"{c.searched} more poses and {c.ascents} local searches; a better pose may "
                "have been missed.",
            )
        )
    return lines


def _execution_line(plan: Plan) -> tuple[str, str]:
    e = plan.execution
    stops, changes = len(e.stops), e.load_changes
    text = f"{stops} stops, {e.travel:.0f} s of travel"
    if e.gap > 5e-4:
        text += f" (at most {100 * e.gap:.1f} % above the shortest order)"
    if changes:
        text += f", {changes} load change{'s' if changes > 1 else ''} by hand"
    via = sum(len(stop.via) for stop in e.stops) + len(e.home_via)
    if via:
        text += f", {via} points in between to get around obstacles"
    return "Execution", f"{text}, {e.total / 60:.0f} min in all; every move checked."
