"""elastocal identify: parameters and intervals from measurements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from elastocal.errors import InputError
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.measurements import Measurements
    from elastocal.model.manipulator import Model

MOST_BYTES = 1_000_000_000  # of a covariance as text: 6000 rows


@app.command()
@reporting_errors
def identify(
    cell: CellFile,
    data: Annotated[Path, typer.Argument(help="Measurements (CSV or Parquet).")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the result as JSON.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option(help="Measurements never fitted, to test the result on.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report (one HTML page).")] = None,
    residuals: Annotated[
        Path | None, typer.Option(help="Write residuals of every reading as CSV.")
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="auto (reml), reml, ols, wls, eq14, eq14-residual, huber, tukey, l1, student-t."
        ),
    ] = "auto",
    noise: Annotated[
        str,
        typer.Option(
            help="Noise that reml estimates: auto, independent, axis, marker, groups, polar, "
            "stated; with +configuration for what a configuration's readings share."
        ),
    ] = "auto",
    weights: Annotated[
        str,
        typer.Option(help="Stated noise to take as it is: none, rows, axis, polar, covariance."),
    ] = "auto",
    intervals: Annotated[
        str,
        typer.Option(
            help="auto, classical, hc0 to hc4, cr0 to cr3 (by configuration), wild, bootstrap, "
            "profile."
        ),
    ] = "auto",
    covariance: Annotated[
        Path | None, typer.Option(help="Noise covariance in m² (CSV without header, or .npy).")
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Hold a parameter, place or effect at its start; repeatable."
        ),
    ] = None,
    bounded: Annotated[
        bool, typer.Option("--bounded", help="Keep parameters inside their physical bounds.")
    ] = False,
    knowledge: Annotated[
        Path | None,
        typer.Option(help="What is known besides: priors, bounds, equalities (TOML)."),
    ] = None,
    physical: Annotated[
        bool,
        typer.Option(
            "--physical",
            help="No negative compliance, no compliance matrix that yields energy.",
        ),
    ] = False,
    outliers: Annotated[
        str,
        typer.Option(
            help="Readings beyond the noise: auto (leave out, unless they are a tenth or more), "
            "drop, keep. They are listed in any case."
        ),
    ] = "auto",
    jobs: Annotated[int, typer.Option(help="Processes of a bootstrap; -1 for all cores.")] = 1,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """What are the parameters of my arm, and how sure are we?

    Example: elastocal identify cell.toml data.csv -o result.json --test other.csv
    """
    from elastocal.cell.work_cell import read_cell
    from elastocal.cli.outputs import write_results
    from elastocal.identification.identify import identify as run
    from elastocal.identification.noise_structure import noise_models
    from elastocal.identification.options import Options
    from elastocal.verbs import knowledge_of

    if noise not in noise_models():
        read_cell(cell)  # its plug-ins may have the model
    # What can be wrong with the options is told before any file is read.
    chosen = Options(
        method=method,  # type: ignore[arg-type]
        noise=noise,
        weights=weights,  # type: ignore[arg-type]
        covariance=None if covariance is None else _read_covariance(covariance),
        intervals=intervals,  # type: ignore[arg-type]
        fixed=tuple(fix or ()),
        bounded=bounded,
        faulty=outliers,  # type: ignore[arg-type]
        seed=seed,
        jobs=jobs,
    )
    known = knowledge_of(knowledge, physical)
    check_outputs(output, report, residuals)
    inputs = [p for p in (cell, data, test, covariance, knowledge) if p is not None]
    written = [p for p in (output, report, residuals) if p is not None]
    check_apart(written, inputs)
    with progress_line(quiet) as progress:
        progress("reading")
        model, tables = load_inputs(cell, [data] if test is None else [data, test])
        check_apart(written, files_of(model.cell))
        if known is not None:
            constraints, prior = known.of(model)
            chosen = replace(chosen, constraints=constraints, prior=prior)
        result = run(model, tables[0], chosen, None if test is None else tables[1], progress)
        write_results(result, output, report, residuals, inputs, seed=seed)
    if as_json:
        typer.echo(json_text(result.to_json()))
        return
    from elastocal.report.terminal import print_result

    print_result(console(), result)
    for path in written:
        typer.echo(f"wrote {path}")


def load_inputs(cell_path: Path, data: list[Path]) -> tuple[Model, list[Measurements]]:
    """Model and tables; every file is checked before anything is computed."""
    from elastocal.model.manipulator import Model

    model = Model(cell_path)
    tables = [model.read(path) for path in data]
    return model.with_markers_of(*tables), tables


def _read_covariance(path: Path) -> Any:
    import numpy as np

    from elastocal.files import open_input, read_text

    try:
        if path.suffix == ".npy":
            with open_input(path, "noise covariance") as handle:
                return np.load(handle, allow_pickle=False)
        text = read_text(path, "noise covariance", MOST_BYTES)
        return np.loadtxt(text.splitlines(), delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: not a matrix of numbers ({error})") from None
