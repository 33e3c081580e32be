"""elastocal identify: parameters and intervals from measurements."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from elastocal import verbs
from elastocal.cli.app import repeated
from elastocal.cli.signatures import Asked, CellFile, DataFile, JsonFile, ReportFile, Run, command
from elastocal.errors import InputError, NotAcceptedError, option
from elastocal.text import listed

if TYPE_CHECKING:
    from elastocal.identification.result import Calibration
    from elastocal.report.parameter_tables import Published, Truth


@command(
    verb=verbs.identify,
    offers="test method noise weights intervals covariance fixed bounded knowledge physical "
    "outliers jobs seed",
)
def identify(
    cell: CellFile,
    data: DataFile,
    output: JsonFile = None,
    report: ReportFile = None,
    certificate: Path | None = None,
    residuals: Path | None = None,
    require: list[str] | None = None,
    *,
    asked: Asked,
    details: bool = False,
    run: Run,
) -> None:
    """What are the parameters of my arm, and how certain are they?

    Example: elastocal identify cell.toml data.csv -o result.json --test other.csv

    Args:
        certificate: Write a calibration certificate (.html, or .xml: a DCC).
        residuals: Write residuals of every reading as CSV.
        require (NAME=UM): Largest error in µm that is accepted: heldout=, new_poses=, test=;
            repeatable, else as [require] of the cell says. Exit code 3 where one is exceeded.
        details: Also method, noise, residuals, intervals, all lists.
    """
    from elastocal.model.choice import cell_of
    from elastocal.report.terminal import print_report

    run.writes(output, report, residuals, certificate)
    limits = limits_of(require or [])
    known = cell_of(cell, run.plugins)  # its plug-ins may have the noise model
    files = (asked.get(name) for name in ("test", "covariance", "knowledge"))
    inputs = run.reads(cell, data, *files, cell=known)
    with run.progress() as progress:
        result = verbs.identify(known, data, **asked, progress=progress)
        write_results(
            result, output, report, residuals, inputs, asked["seed"], certificate=certificate
        )
    run.answer(result.to_json, lambda screen: print_report(screen, result, details))
    if unmet := result.unmet(**limits):
        raise NotAcceptedError(f"not accepted: {'; '.join(unmet)}")


def limits_of(stated: list[str], names: tuple[str, ...] = ()) -> dict[str, float | None]:
    """NAME=UM as limits in m, NAME one of `names`, by default of all."""
    from elastocal.cell.work_cell import Acceptance

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
    result: Calibration, output: Path | None, report: Path | None, residuals: Path | None,
    inputs: list[Path], seed: int, truth: Truth | None = None, published: Published | None = None,
    certificate: Path | None = None,
) -> None:  # fmt: skip
    """Write what was asked for, all of it or nothing.

    `inputs` are named with their hashes in the report, where `truth` and `published` (SI) stand
    beside the estimates.
    """
    from elastocal.files import together
    from elastocal.report.page import write_page
    from elastocal.saving import save_residuals, write_json

    with together(p for p in (output, residuals, report, certificate) if p is not None):
        if output is not None:
            write_json(output, result.to_json())
        if residuals is not None:
            save_residuals(result, residuals)
        if report is not None:
            write_page(result, report, inputs, repeated(), seed, truth=truth, published=published)
        if certificate is not None:
            write_page(result, certificate, inputs, repeated(), seed, certificate=True)
