"""elastocal identify: parameters and intervals from measurements."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    DataFile,
    Json,
    Plugins,
    Quiet,
    ReportFile,
    Seed,
    check_apart,
    check_outputs,
    command,
    console,
    repeated,
)
from elastocal.screen import progress_line, say
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.identification.result import Calibration
    from elastocal.report.identification_view import Truth
    from elastocal.report.page import Published


@command()
def identify(
    cell: CellFile,
    data: DataFile,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the result as JSON.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option(help="Independent measurements to test the result on.")
    ] = None,
    report: ReportFile = None,
    certificate: Annotated[
        Path | None, typer.Option(help="Write a calibration certificate (one HTML page).")
    ] = None,
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
            "stated; with +configuration for deviations common to a configuration."
        ),
    ] = "auto",
    weights: Annotated[
        str,
        typer.Option(help="Stated noise to take as it is: none, rows, axis, polar, covariance."),
    ] = "auto",
    intervals: Annotated[
        str,
        typer.Option(help="auto, classical, hc0 to hc3, cr0 to cr3 (by configuration), profile."),
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
        typer.Option(help="Prior knowledge: priors, bounds, equalities (TOML)."),
    ] = None,
    physical: Annotated[
        bool,
        typer.Option(
            "--physical",
            help="No negative compliance, compliance matrices semidefinite.",
        ),
    ] = False,
    outliers: Annotated[
        str,
        typer.Option(
            help="Outliers: auto (exclude, unless they are a tenth or more), "
            "drop, keep. They are listed in any case."
        ),
    ] = "auto",
    require: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=UM",
            help="Largest error in µm that is accepted: heldout=, new_poses=, test=; repeatable, "
            "else as [require] of the cell says. Exit code 3 where one is exceeded.",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(help="Has no effect: nothing is drawn in processes.")] = 1,
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
    details: Annotated[
        bool,
        typer.Option("--details", help="Also method, noise, residuals, intervals, all lists."),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """What are the parameters of my arm, and how certain are they?

    Example: elastocal identify cell.toml data.csv -o result.json --test other.csv
    """
    from elastocal import verbs
    from elastocal.errors import NotAcceptedError
    from elastocal.measurements import read_matrix
    from elastocal.model.choice import cell_of

    written = check_outputs(output, report, residuals, certificate)
    limits = limits_of(require or [])
    inputs = [p for p in (cell, data, test, covariance, knowledge) if p is not None]
    known = cell_of(cell, plugins)  # its plug-ins may have the noise model
    check_apart(written, inputs, known)
    with progress_line(quiet) as progress:
        result = verbs.identify(
            known, data, test=test, fixed=fix or (), method=method, noise=noise,  # type: ignore[arg-type]
            weights=weights, intervals=intervals, outliers=outliers,  # type: ignore[arg-type]
            covariance=None if covariance is None else read_matrix(covariance, "noise covariance"),
            bounded=bounded, physical=physical, knowledge=knowledge, seed=seed, jobs=jobs,
            progress=progress,
        )  # fmt: skip
        write_results(
            result, output, report, residuals, inputs, seed=seed, certificate=certificate
        )  # fmt: skip
    if as_json:
        say(json_text(result.to_json()))
    else:
        from elastocal.report.terminal import print_result

        print_result(console(), result, details=details)
        for path in written:
            say(f"wrote {path}")
    if unmet := result.unmet(**limits):
        raise NotAcceptedError(f"not accepted: {'; '.join(unmet)}")


def limits_of(stated: list[str], names: tuple[str, ...] = ()) -> dict[str, float | None]:
    """NAME=UM as limits in m, NAME one of `names`, by default of all."""
    from elastocal.cell.work_cell import Acceptance
    from elastocal.errors import InputError, option
    from elastocal.text import listed

    names = names or tuple(vars(Acceptance()))
    limits: dict[str, float | None] = {}
    for text in stated:
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if name not in names or not 0 < value < math.inf:
            raise InputError(
                f"{option('require')} takes NAME=UM, NAME one of {listed(names)} and UM a positive "
                f"number in µm; found '{text}'"
            )
        limits[name] = value * 1e-6
    return limits


def write_results(
    result: Calibration,
    output: Path | None,
    report: Path | None,
    residuals: Path | None,
    inputs: list[Path],
    seed: int,
    truth: Truth | None = None,
    published: Published | None = None,
    certificate: Path | None = None,
) -> None:
    """Write what was asked for, all of it or nothing.

    `inputs` are named with their hashes in the report, where `truth` and `published` (SI) stand
    beside the estimates.
    """
    from elastocal.files import together
    from elastocal.saving import save_residuals, write_json

    with together(p for p in (output, residuals, report, certificate) if p is not None):
        if output is not None:
            write_json(output, result.to_json())
        if residuals is not None:
            save_residuals(result, residuals)
        if report is not None:
            from elastocal.report.page import write_page

            write_page(result, report, inputs, repeated(), seed, truth=truth, published=published)
        if certificate is not None:
            from elastocal.report.page import write_page

            write_page(result, certificate, inputs, repeated(), seed, certificate=True)
