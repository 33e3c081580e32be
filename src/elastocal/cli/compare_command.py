"""elastocal compare: what has changed since the last calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import (
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
from elastocal.errors import InputError
from elastocal.screen import progress_line, say
from elastocal.text import json_text


@command(short_help="What has changed since the last calibration?")
def compare(
    old: Annotated[Path, typer.Argument(help="Result of identify (JSON), the earlier one.")],
    new: Annotated[Path, typer.Argument(help="Result of identify (JSON), the later one.")],
    cell: Annotated[
        Path | None,
        typer.Option(help="Cell file of both; default: cell.toml beside the earlier one."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Write JSON.")] = None,
    report: ReportFile = None,
    load: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Force in N at the load point (tracker's axes); default: the measured loads.",
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Probability of any finding if nothing has changed.")
    ] = 0.05,
    poses: Annotated[int, typer.Option(min=2, max=100_000, help="Random poses.")] = 300,
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """What has changed between two calibrations: by parameter, and how far the tool moved.

    Example: elastocal compare january.json june.json --cell cell.toml --report changes.html
    """
    from elastocal.diagnosis.changes import compare as run
    from elastocal.files import together
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.diagnosis_terminal import print_comparison
    from elastocal.saving import write_json

    written = check_outputs(output, report)
    known = old.parent / "cell.toml" if cell is None else cell
    if cell is None and not known.is_file():
        raise InputError(f"there is no cell.toml beside {old}; name the cell of both by --cell")
    check_apart(written, [old, new, known])
    with progress_line(quiet) as progress:
        progress("reading")
        arms = [read_calibrated(known, path, plugins) for path in (old, new)]
        check_apart(written, [], arms[0].model.cell)
        progress("comparing")
        found = run(*arms, load=load, level=level, poses=poses, seed=seed)
    with together(written):
        if output is not None:
            write_json(output, found.to_json())
        if report is not None:
            found.report(report, inputs=[known, old, new], command=repeated(), seed=seed)
    if as_json:
        say(json_text(found.to_json()))
        return
    print_comparison(console(), found)
    for path in written:
        say(f"wrote {path}")
