"""Rows of a measurement plan's tables as text: shared by the terminal and the page."""

from __future__ import annotations

import math

import numpy as np

from elastocal.design.plan import Plan
from elastocal.design.reasons import Predicted, Reason
from elastocal.report.page import Table
from elastocal.report.units import display, significant
from elastocal.report.words import printable

TOLD = 2  # parameters that a pose serves, in the table
SERVES = "serves (standard deviation without it)"


def joint_text(value: float, kind: str, decimals: int = 2) -> str:
    """A joint's position in ° or mm."""
    return f"{np.degrees(value) if kind == 'revolute' else value * 1e3:.{decimals}f}"


def pose_rows(plan: Plan, reasons: bool = True, decimals: int = 2) -> Table:
    """Joint values, load, place in the order of execution, and what the pose is there for."""
    kinds = plan.model.chain.kinds
    loads = len(plan.forces) > 1 and bool((plan.load >= 0).any())
    heads = ["pose"]
    heads += [f"q{i + 1} {'°' if kind == 'revolute' else 'mm'}" for i, kind in enumerate(kinds)]
    heads += [*(["load N"] if loads else []), "order", *([SERVES] if reasons else [])]
    order = first_stops(plan)
    rows: list[tuple[str, ...]] = []
    for k, reason in enumerate(plan.reasons):
        row = [plan.configurations[k]]
        row += [joint_text(v, kind, decimals) for v, kind in zip(plan.q[k], kinds, strict=True)]
        if loads:
            row.append(force_text(plan, int(plan.load[k])))
        rows.append((*row, str(order[k]), *([served(reason)] if reasons else [])))
    return Table(tuple(heads), rows, (len(heads) - 1,) if reasons else ())


def first_stops(plan: Plan) -> dict[int, int]:
    """Pose → its first place in the order of execution, from 1."""
    return {stop.pose: k + 1 for k, stop in reversed(list(enumerate(plan.execution.stops)))}


def force_text(plan: Plan, load: int) -> str:
    return " ".join(f"{f:g}" for f in plan.forces[load])


def reason_rows(plan: Plan) -> Table:
    """What each pose is there for."""
    rows: list[tuple[str, ...]] = [
        (name, served(r)) for name, r in zip(plan.configurations, plan.reasons, strict=True)
    ]
    return Table(("pose", SERVES), rows, (1,))


def served(reason: Reason) -> str:
    """The parameters that a pose serves most: "joint3.compliance +38 %"."""
    parts = [
        f"{printable(name)} {'lost' if math.isinf(growth) else f'+{100 * (growth - 1):.0f} %'}"
        for name, growth in reason.serves[:TOLD]
    ]
    return ", ".join(parts) or "all a little"


def interval_rows(plan: Plan) -> Table:
    """Predicted half widths of the 95 % intervals."""
    combined = any(p.combined_with for p in plan.predicted)
    rows: list[tuple[str, ...]] = []
    for p in plan.predicted:
        shown, unit = display(p.half_width, p.unit)
        row = (printable(p.name), significant(shown, 2), unit)
        rows.append((*row, _partners(p)) if combined else row)
    heads = ("parameter", "± 95 %", "unit")
    return Table((*heads, "together with") if combined else heads, rows, (0, 2, 3))


def _partners(p: Predicted) -> str:
    names = [printable(name) for name in p.combined_with]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def curve_rows(plan: Plan) -> Table:
    """The criterion against the number of poses."""
    heads = ("poses", f"{plan.criterion} {plan.unit}".strip(), "best possible on the pool")
    rows: list[tuple[str, ...]] = [
        (str(s.poses), f"{s.value:.4g}", "–" if s.bound is None else f"{s.bound:.4g}")
        for s in plan.curve
    ]
    return Table(heads, rows, ())


def removal_rows(plan: Plan) -> Table:
    """Which rule of the cell removed how many candidates, the hardest rule first."""
    c = plan.candidates
    removed = sorted(c.removed_by.items(), key=lambda item: -item[1])
    rows: list[tuple[str, ...]] = [
        (name.replace("_", " "), str(n), f"{100 * n / max(c.tried, 1):.1f} %")
        for name, n in removed
        if n
    ]
    rows.append(("feasible", str(c.feasible), f"{100 * c.feasible / max(c.tried, 1):.1f} %"))
    return Table(("rule", "candidates", "share"), rows)


def stop_rows(plan: Plan) -> Table:
    """The stops in the order of execution: pose, load, how it is reached, what it takes."""
    kinds = plan.model.chain.kinds
    rows: list[tuple[str, ...]] = []
    for k, stop in enumerate(plan.execution.stops):
        rows.append(
            (
                str(k + 1),
                plan.configurations[stop.pose],
                force_text(plan, stop.load),
                "by hand" if stop.change_after is not None else "",
                str(len(stop.via)),
                f"{stop.travel:.1f}",
                *(joint_text(v, kind) for v, kind in zip(stop.q, kinds, strict=True)),
            )
        )
    joints = tuple(f"q{i + 1} {'°' if k == 'revolute' else 'mm'}" for i, k in enumerate(kinds))
    heads = ("stop", "pose", "load N", "load change", "points in between", "travel s", *joints)
    return Table(heads, rows, (2, 3))
