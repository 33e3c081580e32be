"""What results show in a notebook: HTML, figures and data frames (found by elastocal.notebook)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.compensation.commands_file import commands_csv, joint_columns, summary
from elastocal.compensation.compensate import Compensation
from elastocal.design.plan import Plan
from elastocal.diagnosis.result import Diagnosis
from elastocal.errors import InputError
from elastocal.identification.result import Calibration
from elastocal.nearest import did_you_mean, listed, quoted
from elastocal.report import notebook_figures as figures
from elastocal.report.diagnosis_rows import BUDGET, CANDIDATES, budget_rows, candidate_rows
from elastocal.report.diagnosis_verdict import verdict_lines
from elastocal.report.plan_tables import plan_lines
from elastocal.report.rows import combination_rows, parameter_rows
from elastocal.report.units import length
from elastocal.report.verdict import summary_lines

if TYPE_CHECKING:
    import pandas as pd

MOST_ROWS = 60
MOST_CANDIDATES = 8
Drawn = Callable[[Any, bool], Any]


@dataclass(frozen=True)
class View:
    """How one kind of result shows itself; `figures` by kind, the first is the default."""

    html: Callable[[Any], str]
    frame: Callable[[Any], pd.DataFrame]
    figures: Mapping[str, Drawn]

    def plot(self, result: Any, kind: str | None, interactive: bool) -> Any:
        """The figure `kind`.  Raises InputError for a kind that the result does not have."""
        chosen = next(iter(self.figures)) if kind is None else kind
        if chosen not in self.figures:
            raise InputError(
                f"no figure {quoted(chosen)}{did_you_mean(chosen, self.figures)}; there are "
                f"{listed(self.figures)}"
            )
        return self.figures[chosen](result, interactive)


def view_of(result: object) -> View:
    """The view of a result's type; TypeError for a type without one, a mistake of the program."""
    for kind, view in VIEWS.items():
        if isinstance(result, kind):
            return view
    raise TypeError(type(result).__name__)


def _identification(result: Calibration) -> str:
    known = [row for row in parameter_rows(result, None) if row.determined]
    rows = [(r.name, r.value, r.interval, r.unit, r.nominal) for r in known]
    rows += [(r.name, r.value, r.interval, r.unit, "") for r in combination_rows(result, None)]
    heads = ("parameter", "value", "95 %", "unit", "nominal")
    lines = [line.partition(": ") for line in summary_lines(result)]
    return _table("Identification", heads, rows) + _lines([(a, c) for a, _, c in lines])


def _plan(plan: Plan) -> str:
    frame = _plan_frame(plan)
    rows = [tuple(_short(v) for v in row) for row in frame.itertuples(index=False)]
    return _table("Measurement plan", list(frame.columns), rows) + _lines(plan_lines(plan))


def _diagnosis(d: Diagnosis) -> str:
    return (
        _lines(verdict_lines(d))
        + _table("Gap budget (3-D rms error on held-out poses)", BUDGET, budget_rows(d))
        + _table("Candidates", CANDIDATES, candidate_rows(d, MOST_CANDIDATES))
    )


def _compensation(c: Compensation) -> str:
    told = summary(c, c.chain.kinds, commands=False)
    rows = [
        (name, *("–" if v is None else length(v * 1e-6) for v in told[key].values()))
        for name, key in (
            ("nominal command", "error_before_um"),
            ("new command", "error_after_um"),
            ("standard uncertainty", "std_um"),
        )
    ]
    frame = _commands(c)
    chosen = ["configuration", *joint_columns(c.chain.kinds), "std_um", "status"]
    commands = [
        tuple("" if v != v else _short(v) for v in row)
        for row in frame[chosen].itertuples(index=False)
    ]
    reached = f"{told['reached']} of {told['n']} targets reached by the {told['point']}"
    lines = [("Reached", f"{reached}; targets in the {told['frame']} frame.")]
    return (
        _lines([*lines, *(("Warning", text) for text in c.warnings)])
        + _table("Position of the tool, predicted", ("", "rms", "95 %", "max"), rows)
        + _table("Commands", chosen, commands)
    )


def _short(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose every cell is escaped; the first MOST_ROWS rows."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows[:MOST_ROWS]
    )
    more = f"<p>… and {len(rows) - MOST_ROWS} more rows</p>" if len(rows) > MOST_ROWS else ""
    return (
        f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>{more}"
    )


def _lines(lines: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<p><b>{escape(label)}:</b> {escape(text)}</p>" for label, text in lines)


def _estimates(result: Calibration) -> pd.DataFrame:
    """One row per parameter, SI units: NaN where the data do not determine it alone."""
    import pandas as pd

    rows = [
        {
            "parameter": e.name,
            "unit": e.unit,
            "value": e.value,
            "std": e.std,
            "ci95_low": None if e.ci95 is None else e.ci95[0],
            "ci95_high": None if e.ci95 is None else e.ci95[1],
            "nominal": e.nominal,
            "held": e.held,
            "identifiable": e.identifiable,
            "combined_with": ", ".join(e.combined_with),
            "note": e.note,
        }
        for e in result.estimates
    ]
    frame = pd.DataFrame(rows)
    numbers = ["value", "std", "ci95_low", "ci95_high", "nominal", "held"]
    return frame.astype(dict.fromkeys(numbers, float))


def _plan_frame(plan: Plan) -> pd.DataFrame:
    """One row per pose: joints in ° or mm, place in the order, and the load where it states one."""
    import pandas as pd

    columns: dict[str, Any] = {"configuration": list(plan.configurations)}
    for j, kind in enumerate(plan.model.chain.kinds):
        q = plan.q[:, j]
        if kind == "revolute":
            columns[f"q{j + 1}_deg"] = np.degrees(q)
        else:
            columns[f"q{j + 1}_mm"] = q * 1e3
    if plan.level_joint is not None:
        columns["level"] = plan.group + 1
    order = {stop.pose: k + 1 for k, stop in reversed(list(enumerate(plan.execution.stops)))}
    columns["order"] = [order.get(k) for k in range(len(plan.q))]
    if (plan.load >= 0).any():
        for k, axis in enumerate("xyz"):
            columns[f"force_{axis}_N"] = plan.forces[plan.load, k]
    return pd.DataFrame(columns)


def _candidates(d: Diagnosis) -> pd.DataFrame:
    """One row per hypothesis, best first; whether it is held to be real; `score` in nats."""
    import pandas as pd

    found = {(f.effect, f.where): f for f in d.effects}
    rows = []
    for c in d.candidates:
        f = found.get((c.effect, c.where))
        rows.append(
            {
                "effect": c.effect, "where": c.where, "stage": c.stage,
                "probability": c.probability, "score": c.score, "detectable": c.detectable,
                "found": f is not None,
                "gap_reduction": np.nan if f is None else f.gap_reduction,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _commands(c: Compensation) -> pd.DataFrame:
    """One row per target: the columns of the commands file, NaN where a target is not reached."""
    import pandas as pd

    text = io.StringIO(commands_csv(c, c.chain.kinds))
    return pd.read_csv(text, dtype={"configuration": str}, keep_default_na=False, na_values=[""])


VIEWS: dict[type, View] = {
    Calibration: View(
        _identification,
        _estimates,
        {"residuals": figures.residuals, "parameters": figures.parameters},
    ),
    Plan: View(_plan, _plan_frame, {"poses": figures.poses, "intervals": figures.intervals}),
    Compensation: View(
        _compensation, _commands, {"errors": figures.errors, "uncertainty": figures.uncertainties}
    ),
    Diagnosis: View(
        _diagnosis, _candidates, {"budget": figures.budget, "candidates": figures.candidates}
    ),
}
