"""elastocal diagnose: why the real arm still differs from the model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    Json,
    Seed,
    app,
    check_outputs,
    console,
    progress_line,
    reporting_errors,
)
from elastocal.cli.design_command import check_apart, files_of
from elastocal.cli.identify_command import load_inputs
from elastocal.cli.outputs import Outputs, write_diagnosis
from elastocal.errors import require
from elastocal.text import json_text

MOST_POSES = 10


@app.command()
@reporting_errors
def diagnose(
    cell: CellFile,
    data: Annotated[Path, typer.Argument(help="Measurements (CSV or Parquet).")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the diagnosis as JSON.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report (one HTML page).")] = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="Write extra poses (CSV) that tell the rivals apart, where there are."),
    ] = None,
    poses: Annotated[
        int | None,
        typer.Option(min=1, help=f"Most extra poses of --plan.  [default: {MOST_POSES}]"),
    ] = None,
    cell_out: Annotated[
        Path | None, typer.Option(help="Write the cell (TOML) with the effects found added.")
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="EFFECT", help="Take an effect out of the catalogue; repeatable."),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Why does the real arm still differ from the model?

    Says where the gap lies, which effect of the catalogue causes it, or that none does, and how
    far the error of fresh poses falls once it is added.

    Example: elastocal diagnose cell.toml data.csv -o diagnosis.json --report diagnosis.html
    """
    from elastocal.cell.work_cell import read_cell
    from elastocal.diagnosis.diagnose import DiagnosisOptions
    from elastocal.diagnosis.diagnose import diagnose as run
    from elastocal.diagnosis.diagnosis import publish
    from elastocal.model.effects import CATALOGUE
    from elastocal.verbs import with_extra_poses

    if not set(without or ()) <= set(CATALOGUE):
        read_cell(cell)  # its plug-ins may have the effect
    # What can be wrong with the options is told before any file is read.
    options = DiagnosisOptions(seed=seed, without=tuple(without or ()))
    require(
        poses is None or plan is not None,
        f"--poses {poses} has no meaning without --plan; name the file for the extra poses",
    )
    outputs = Outputs(output, report, plan, cell_out)
    check_outputs(*outputs.wanted)
    with progress_line(quiet) as progress:
        progress("reading")
        model, (table,) = load_inputs(cell, [data])
        check_apart(outputs.wanted, [cell, data, *files_of(model.cell)])
        found = run(model, table, options, progress)
        if plan is not None and found.open:
            most = MOST_POSES if poses is None else poses
            found = with_extra_poses(model, table, found, most, seed, progress)
        content = publish(found, model, str(data))
        told = write_diagnosis(outputs, found, content, model, cell, data, seed)
    if as_json:
        typer.echo(json_text(content))
        return
    from elastocal.report.terminal import print_diagnosis

    print_diagnosis(console(), found, model.chain.kinds)
    for line in told:
        typer.echo(line)
