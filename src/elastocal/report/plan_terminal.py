"""Plans on the terminal: apart from the other results, which do not need what designs a plan."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from elastocal.diagnosis.next_poses import NextPoses
from elastocal.planning.plan import Plan
from elastocal.report.plan_view import (
    curve_rows,
    interval_rows,
    next_lines,
    plan_lines,
    pose_rows,
    reason_rows,
    timed_rows,
)
from elastocal.report.terminal import print_lines, table_of

WIDE_FOR_REASONS = 110  # columns, from which on the reasons stand beside the poses


def print_plan(console: Console, plan: Plan) -> None:
    """Poses in the order of the plan, predicted intervals, and what the plan is worth in words."""
    wide = console.width >= WIDE_FOR_REASONS
    tables = {"Predicted intervals": interval_rows(plan)}
    if not wide:
        tables = {"Why each pose": reason_rows(plan)} | tables
    if plan.curve:
        tables["Number of poses"] = curve_rows(plan)
    if plan.timed:
        tables["Poses and readings within the time"] = timed_rows(plan)
    console.print(_pose_table(plan, 2, reasons=True) if wide else _narrow_poses(console, plan))
    for title, table in tables.items():
        console.print(table_of(title, table, whole=True))
    console.print()
    print_lines(console, plan_lines(plan))


def print_next(console: Console, found: NextPoses) -> None:
    """Whether to measure more and what it brings, and the poses."""
    if found.plan is not None:
        print_plan(console, found.plan)
        console.print()
    print_lines(console, next_lines(found))


def _narrow_poses(console: Console, plan: Plan) -> Table:
    """The poses with as many decimals as there is room for; plan.csv has all of them."""
    room = console.options.update(max_width=WIDE_FOR_REASONS)
    for decimals in (2, 1):
        table = _pose_table(plan, decimals)
        if console.measure(table, options=room).maximum <= console.width:
            return table
    return _pose_table(plan, 0)


def _pose_table(plan: Plan, decimals: int, reasons: bool = False) -> Table:
    return table_of("Poses", pose_rows(plan, reasons, decimals), whole=True)
