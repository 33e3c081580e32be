"""The diagnosis report: one HTML page that needs no network and no other file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from elastocal.diagnosis.result import Diagnosis
from elastocal.files import atomic_write_text
from elastocal.manipulator.model import Model
from elastocal.report import diagnosis_rows as rows
from elastocal.report.diagnosis_verdict import extra_lines, headline, next_steps, verdict_lines
from elastocal.report.diagnosis_words import (
    STAGES,
    capital,
    effect_at,
    noise_lines,
    place,
    probability,
    together,
)
from elastocal.report.page import Inputs, Repeat, Table, render, title_of
from elastocal.report.residual_rows import residual_table
from elastocal.report.residual_space import (
    marker_positions,
    residual_space,
    time_caption,
    view_caption,
)
from elastocal.report.residuals import residuals_by
from elastocal.report.space import space_json
from elastocal.report.units import significant
from elastocal.report.verdict import counted
from elastocal.report.words import printable

MOST_CANDIDATES = 40
MOST_TESTS = 12
MOST_FAULTY = 100
MOST_PLACES = 8
MOST_VISITS = 200
BOX, GAP = 118, 18  # width of a box of the chain and the room between two, in SVG units


@dataclass(frozen=True)
class Box:
    """A link of the chain as the page draws it: `shade` 0 to 1, None where it cannot err."""

    name: str
    x: int
    shade: float | None
    evidence: str


def write_diagnosis_report(
    diagnosis: Diagnosis,
    model: Model,
    path: str | Path,
    data: str,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
) -> None:
    """Write the page to `path`, whole or not at all; arguments as for `diagnosis_page`.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    atomic_write_text(path, diagnosis_page(diagnosis, model, data, command, inputs, seed))


def diagnosis_page(
    diagnosis: Diagnosis,
    model: Model,
    data: str,
    command: str | None = None,
    inputs: Inputs = None,
    seed: int | None = None,
) -> str:
    """The page as text.

    `model` is the arm that was diagnosed, `data` names its measurements; `inputs` are the files
    read, or a map from their names to their SHA-256; `command` and `seed` tell how to repeat it.
    """
    return render(
        "diagnosis.html.j2",
        title_of(model),
        Repeat(command, inputs, seed, model.backend_report()),
        **_contents(diagnosis, model),
        **_residuals(diagnosis),
        data=printable(data),
    )


def _contents(d: Diagnosis, model: Model) -> dict[str, Any]:
    from markupsafe import Markup

    kinds = model.chain.kinds
    lines = [(label, capital(text)) for label, text in verdict_lines(d)[1:]]
    alike = [together([effect_at(e) for e in rivals]) for rivals in d.indistinguishable]
    return {
        "headline": headline(d),
        "tone": d.findings[0].severity,
        "verdict": lines,
        "steps": next_steps(d),
        "warnings": [capital(printable(w)) for w in d.warnings],
        "readings": f"{counted(d.n_readings, 'reading')} in "
        f"{counted(d.n_configurations, 'configuration')}",
        "boxes": _boxes(d),
        "box": BOX,
        "places": _places(d),
        "figures": {name: Markup(svg) for name, svg in _figures(d).items()},
        "budget": Table(rows.BUDGET, rows.budget_rows(d)),
        "parameters": Table(rows.PARAMETERS, rows.parameter_rows(d.effects), (0, 3)),
        "candidates": Table(rows.CANDIDATES, rows.candidate_rows(d, MOST_CANDIDATES), (0, 5)),
        "n_candidates": len(d.candidates),
        "alike": [capital(text) for text in alike],
        "structure": Table(rows.STRUCTURE, rows.structure_rows(d, MOST_TESTS)),
        "n_structure": len(d.structure),
        "noise": noise_lines(d.noise, kinds),
        "faulty": Table(rows.FAULTY, rows.faulty_rows(d, MOST_FAULTY), (1, 2)),
        "more_faulty": max(0, len(d.noise.faulty) - MOST_FAULTY),
        "untested": Table(rows.UNTESTED, rows.untested_rows(d), (0, 1, 2)),
        "extra": [] if d.extra is None else extra_lines(d.extra),
        "pairs": Table(rows.PAIRS, [] if d.extra is None else rows.pair_rows(d.extra)),
        "visits": _visits(d, kinds),
    }


def _residuals(d: Diagnosis) -> dict[str, Any]:
    """The residuals of the calibrated arm; no view where they are not known."""
    base = d.calibrated
    if base is None:
        return {"view": None, "residual_table": None, "view_caption": "", "time_caption": ""}
    residuals = residuals_by(base.seen, base.residual)
    space = residual_space(base.model, base.seen, base.x, base.residual)
    return {
        "view": space_json(space),
        "view_caption": view_caption(space, len(residuals.labels)),
        "time_caption": time_caption(base.seen),
        "residual_table": residual_table(base.seen, residuals),
    }


def _boxes(d: Diagnosis) -> list[Box]:
    """The chain from commanded joints to tracker, shaded by the evidence for each link."""
    stages = {} if d.location is None else d.location.stages
    named: list[tuple[str, float | None]] = [("commanded joints", None)]
    named += [(name, stages.get(stage, 0.0) if stages else None) for stage, name in STAGES.items()]
    return [
        Box(name, k * (BOX + GAP), shade, "" if shade is None else probability(shade))
        for k, (name, shade) in enumerate(named)
    ]


def _places(d: Diagnosis) -> list[tuple[str, str]]:
    """The likeliest places, the likeliest first."""
    if d.location is None:
        return []
    order = sorted(d.location.places.items(), key=lambda item: -item[1])
    return [(place(where), probability(p)) for where, p in order[:MOST_PLACES]]


def _figures(d: Diagnosis) -> dict[str, str]:
    """Name → SVG, empty where there is nothing to draw."""
    from elastocal.report import diagnosis_figures as figures

    return {
        "waterfall": figures.waterfall(d) if d.budget else "",
        "candidates": figures.candidates(d),
        "curves": figures.curves(d) if d.curves else "",
        **_residual_figures(d),
    }


def _residual_figures(d: Diagnosis) -> dict[str, str]:
    from elastocal.report.figures import against_joints
    from elastocal.report.place_figures import by_region, over_time
    from elastocal.report.space_picture import space_picture

    base = d.calibrated
    if base is None:
        return {}
    residuals = residuals_by(base.seen, base.residual)
    positions = marker_positions(base.model, base.seen, base.x)
    space = residual_space(base.model, base.seen, base.x, base.residual)
    return {
        "against_joints": against_joints(base.model.chain.kinds, residuals),
        "over_time": over_time(base.seen, residuals),
        "by_region": by_region(positions, residuals.value[:, : residuals.positions]),
        "space": space_picture(space, "Residuals of the calibrated arm as arrows"),
    }


def _visits(d: Diagnosis, kinds: tuple[str, ...]) -> dict[str, Any] | None:
    """The extra poses as a table, in the order of measuring; None where there are none."""
    if d.extra is None or d.extra.plan is None:
        return None
    import numpy as np

    plan = d.extra.plan
    heads = ["order", "pose"]
    heads += [f"q{i + 1} {'°' if kind == 'revolute' else 'mm'}" for i, kind in enumerate(kinds)]
    heads.append("force N")
    heads += ["approach"] if plan.approach is not None else []
    heads += ["time min"] if plan.time is not None else []
    shown = np.where(np.array(kinds) == "revolute", np.degrees(plan.q), plan.q * 1e3)
    table: list[tuple[str, ...]] = []
    for i in range(min(len(plan), MOST_VISITS)):
        row = [str(i + 1), printable(plan.configuration_labels[plan.configuration[i]])]
        row += [f"{v + 0.0:.2f}" for v in shown[i]]
        row.append(" ".join(significant(f) for f in plan.force[i]))
        if plan.approach is not None:
            row.append(" ".join("+" if a > 0 else "−" if a < 0 else "0" for a in plan.approach[i]))
        if plan.time is not None:
            row.append(f"{plan.time[i] / 60:.1f}")
        table.append(tuple(row))
    return {"table": Table(tuple(heads), table, ()), "more": len(plan) - len(table)}
