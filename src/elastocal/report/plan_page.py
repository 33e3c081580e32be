"""The report of a measurement plan: one HTML page that needs no network and no other file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from elastocal.design.plan import Plan
from elastocal.files import atomic_write_text
from elastocal.report import plan_rows as rows
from elastocal.report.page import Inputs, Repeat, render, title_of
from elastocal.report.plan_tables import plan_lines
from elastocal.report.space import Posed, Space, frames_at, space_json, space_of
from elastocal.report.trust import Tone
from elastocal.report.verdict import counted

CLOSE = 0.95  # efficiency from which a plan is called near the best


def write_plan_report(
    plan: Plan,
    path: str | Path,
    command: str | None = None,
    inputs: Inputs = None,
) -> None:
    """Write the page to `path`, whole or not at all; arguments as for `plan_page`.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, plan_page(plan, command, inputs))


def plan_page(plan: Plan, command: str | None = None, inputs: Inputs = None) -> str:
    """The page as text.

    `inputs` are the files read, or a map from their names to their SHA-256; `command` tells how
    to repeat the run.
    """
    return render(
        "plan.html.j2",
        title_of(plan.model),
        Repeat(command, inputs, plan.seed, plan.model.backend_report()),
        **_contents(plan),
    )


def _contents(plan: Plan) -> dict[str, Any]:
    from markupsafe import Markup

    space = plan_space(plan)
    lines = plan_lines(plan)
    return {
        "lead": _lead(plan),
        "headline": headline(plan),
        "tone": _tone(plan),
        "verdict": [(label, _capital(text)) for label, text in lines if label != "Warning"],
        "warnings": [text for label, text in lines if label == "Warning"],
        "steps": _steps(plan),
        "poses": rows.pose_rows(plan, reasons=False),
        "reasons": rows.reason_rows(plan),
        "stops": rows.stop_rows(plan),
        "intervals": rows.interval_rows(plan),
        "removed": rows.removal_rows(plan),
        "curve": rows.curve_rows(plan),
        "view": space_json(space),
        "drawn_from": space.shells.drawn_from,
        "figures": {name: Markup(svg) for name, svg in _figures(plan, space).items()},
    }


def _lead(plan: Plan) -> str:
    n, forces = len(plan.q), len(plan.forces)
    readings = f"{counted(n, 'pose')}, {counted(forces, 'load state')}"
    return f"{readings}, {counted(len(plan.model.cell.tool.markers), 'marker')}"


def headline(plan: Plan) -> str:
    """What the plan is worth and how far from the best it is, in one sentence."""
    n = counted(len(plan.q), "pose")
    if plan.criterion == "test_pose":
        text = (
            f"{n} leave a position error of ρ₀ = {plan.reported:.3g} µm rms at the test poses "
            "after compensation"
        )
    else:
        text = f"{n} reach {plan.criterion} = {plan.reported:.4g} {plan.unit}".rstrip()
    found = plan.certificate.efficiency_pool
    if found is None:
        return f"{text}; how far that is from the best, no bound says."
    away = 100 * (1 - found)
    text += "; no plan from these candidates is "
    text += "better" if away < 0.05 else f"more than {away:.1f} % better"
    if (beyond := _beyond(plan)) is not None:
        return f"{text} (certified), but poses between them may be, by up to {beyond:.0f} %."
    return f"{text} (certified)."


def _beyond(plan: Plan) -> float | None:
    """How much better (%) a plan from all of the joint space may be, where that is much."""
    found = plan.certificate.efficiency_continuum
    return None if found is None or found >= CLOSE else 100 * (1 - found)


def _tone(plan: Plan) -> Tone:
    found = plan.certificate.efficiency_pool
    close = found is not None and found >= CLOSE and _beyond(plan) is None
    return "good" if close and not plan.warnings else "care"


def _steps(plan: Plan) -> list[str]:
    steps = ["Measure the poses in the order given: it is short, and every move was checked."]
    if plan.criterion == "test_pose":
        steps.append(
            "If ρ₀ is not small enough: --target finds the fewest poses that reach a value, "
            "--curve compares numbers of poses."
        )
    if _beyond(plan) is not None:
        steps.append(
            "For a better plan: more --candidates, or --effort thorough, which polishes poses "
            "between them."
        )
    together = sum(bool(p.combined_with) for p in plan.predicted)
    if together:
        steps.append(
            f"{counted(together, 'parameter')} will be known only together with others: more "
            "markers or load states separate them, more poses like these do not."
        )
    steps.append("Then: elastocal identify with the same cell and the measurements.")
    return steps


def plan_space(plan: Plan) -> Space:
    """The arm in every pose of the plan."""
    cell, chain = plan.model.cell, plan.model.chain
    frames, flange = frames_at(cell, chain, plan.q)
    names = tuple(cell.tool.markers)
    local = np.array(list(cell.tool.markers.values())).reshape(-1, 3)
    order = rows.first_stops(plan)
    poses = []
    for k, T in enumerate(flange):
        joints = [
            f"q{i + 1} {rows.joint_text(v, kind)}{' °' if kind == 'revolute' else ' mm'}"
            for i, (v, kind) in enumerate(zip(plan.q[k], chain.kinds, strict=True))
        ]
        group = plan.group_names[plan.group[k]]
        about = [f"stop {order[k]}", *([group] if plan.level_joint else []), ", ".join(joints)]
        poses.append(
            Posed(
                name=plan.configurations[k],
                about="; ".join(about),
                frames=frames[k],
                flange=T,
                markers=local @ T[:3, :3].T + T[:3, 3],
                names=names,
            )
        )
    return space_of(cell, chain, poses)


def _figures(plan: Plan, space: Space) -> dict[str, str]:
    from elastocal.report import plan_figures as figures
    from elastocal.report.space_picture import space_picture

    return {
        "space": space_picture(space, "The arm in the poses of the plan"),
        "intervals": figures.intervals(plan) if plan.predicted else "",
        "removed": figures.removed(plan),
        "curve": figures.curve(plan) if plan.curve else "",
    }


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" if not text.startswith("ρ") else text
