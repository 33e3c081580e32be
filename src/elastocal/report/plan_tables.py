"""A measurement plan as tables and lines for the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from elastocal.design.plan import Plan
from elastocal.planning.criteria import CRITERIA
from elastocal.report.console_table import titled
from elastocal.report.page import Table
from elastocal.report.plan_rows import curve_rows, interval_rows, pose_rows, reason_rows
from elastocal.report.words import printable

WIDE = 110  # columns, from which on the reasons stand beside the poses


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


def _narrow_poses(console: Console, plan: Plan) -> RichTable:
    """The poses with as many decimals as there is room for; plan.csv has all of them."""
    room = console.options.update(max_width=WIDE)
    for decimals in (2, 1):
        table = pose_table(plan, reasons=False, decimals=decimals)
        if console.measure(table, options=room).maximum <= console.width:
            return table
    return pose_table(plan, reasons=False, decimals=0)


def pose_table(plan: Plan, reasons: bool = True, decimals: int = 2) -> RichTable:
    """Joint values, load, place in the order of execution, and what the pose is there for."""
    return _printed("Poses", pose_rows(plan, reasons, decimals))


def reason_table(plan: Plan) -> RichTable:
    """What each pose is there for."""
    return _printed("Why each pose", reason_rows(plan))


def interval_table(plan: Plan) -> RichTable:
    """Predicted half widths of the 95 % intervals."""
    return _printed("Predicted intervals", interval_rows(plan))


def curve_table(plan: Plan) -> RichTable:
    """The criterion against the number of poses."""
    return _printed("Number of poses", curve_rows(plan))


def _printed(title: str, table: Table) -> RichTable:
    """For the terminal: joints and words may wrap, other numbers may not."""
    shown = titled(title)
    for k, head in enumerate(table.heads):
        wraps = (k in table.words and head != "unit") or head.startswith("q")
        shown.add_column(head, justify="left" if k in table.words else "right",
                         overflow="fold" if wraps else "ellipsis")  # fmt: skip
    for row in table.rows:
        shown.add_row(*map(Text, row))
    return shown


def plan_lines(plan: Plan) -> list[tuple[str, str]]:
    """What the plan is worth, as (label, sentence)."""
    lines = [_criterion_line(plan), *_chance_lines(plan), _candidate_line(plan)]
    lines += _certificate_lines(plan)
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


def _chance_lines(plan: Plan) -> list[tuple[str, str]]:
    """What as many random poses would have given."""
    c = plan.chance
    if c is None:
        return []
    whole = f"{c.drawn} random plans of as many feasible poses"
    open_ = c.drawn - c.determined
    lost = f"{open_} of {whole} leave parameters open that this plan determines"
    if c.median is None or c.best is None:
        return [("Chance", f"{lost}.")]
    name = "ρ₀" if plan.criterion == "test_pose" else plan.criterion
    unit = f" {plan.unit}" if plan.unit else ""
    worst = "no value" if c.worst is None else f"{c.worst:.4g}"
    text = (
        f"the median of {whole} has {name} = {c.median:.4g}{unit} (best {c.best:.4g}, worst "
        f"{worst})"
    )
    if c.efficiency is not None:
        text += f", an efficiency of {c.efficiency:.2f} against this plan"
    return [("Chance", f"{text}; {lost}." if open_ else f"{text}.")]


def _candidate_line(plan: Plan) -> tuple[str, str]:
    c = plan.candidates
    removed = sorted(c.removed_by.items(), key=lambda item: -item[1])
    told = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in removed if n)
    text = f"{c.feasible} feasible of {c.tried} tried"
    return "Candidates", text + (f"; removed by {told}." if told else "; no rule removed any.")


def _certificate_lines(plan: Plan) -> list[tuple[str, str]]:
    c = plan.certificate
    if c.efficiency_pool is None:
        reason = CRITERIA[plan.criterion].without_bound
        return [("Certificate", f"none: {plan.criterion} {reason}, so no bound is known.")]
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
