"""The report of any result, as `Result.report` asks for it: one HTML page."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

from elastocal.compensation.compensate import Compensation
from elastocal.design.plan import Plan
from elastocal.diagnosis.result import Diagnosis
from elastocal.files import atomic_write_text
from elastocal.identification.result import Calibration
from elastocal.manipulator.model import Model
from elastocal.report.formatting import printable
from elastocal.report.notebook import view_of
from elastocal.report.page import (
    Inputs,
    Repeat,
    render,
    write_diagnosis_report,
    write_identification_report,
    write_plan_report,
)


def write_page(
    result: object, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    """Write the result's page, whole or not at all; `inputs` None are the files it came from.

    Raises InputError where an input cannot be read or `path` cannot be written.
    """
    write = next(write for kind, write in PAGES.items() if isinstance(result, kind))
    write(result, path, inputs, command, seed)


def _calibration(
    fit: Calibration, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    files = _files(fit.model, fit.observations.table.source) if inputs is None else inputs
    write_identification_report(fit, path, command=command, inputs=files, seed=seed)


def _plan(plan: Plan, path: Path, inputs: Inputs, command: str | None, seed: int | None) -> None:
    write_plan_report(plan, path, command, _files(plan.model) if inputs is None else inputs)


def _diagnosis(
    found: Diagnosis, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    assert found.model is not None  # `diagnose` states it
    files = _files(found.model, found.data) if inputs is None else inputs
    write_diagnosis_report(
        found, found.model, path, found.data, command=command, inputs=files, seed=seed
    )


def _compensation(
    found: Compensation, path: Path, inputs: Inputs, command: str | None, seed: int | None
) -> None:
    from markupsafe import Markup

    view = view_of(found)
    table = Path(found.targets.table.source)
    files = [table] if inputs is None and table.is_file() else inputs
    figures = [
        Markup('<img alt="{}" src="data:image/png;base64,{}">').format(
            kind, _png(view, found, kind)
        )
        for kind in view.figures
    ]
    page = render(
        "compensation.html.j2",
        printable(found.chain.name),
        Repeat(command, files, seed),
        shown=Markup(view.html(found)),
        drawn=figures,
    )
    atomic_write_text(path, page)


def _png(view: Any, found: Compensation, kind: str) -> str:
    import io

    picture = io.BytesIO()
    view.plot(found, kind, False).savefig(picture, format="png", dpi=110)
    return base64.b64encode(picture.getvalue()).decode()


def _files(model: Model, *tables: str) -> list[Path]:
    """The cell and the tables, as far as they are files."""
    named = [model.cell.path, *map(Path, tables)]
    return [path for path in named if path is not None and Path(path).is_file()]


PAGES: dict[type, Callable[[Any, Path, Inputs, str | None, int | None], None]] = {
    Calibration: _calibration,
    Plan: _plan,
    Diagnosis: _diagnosis,
    Compensation: _compensation,
}
