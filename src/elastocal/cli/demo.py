"""elastocal demo: the worked example."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import Json, Seed, app, console, progress_line, reporting_errors
from elastocal.text import json_text


@app.command(short_help="See a KR 270 simulated and calibrated (Klimchik et al. 2013).")
@reporting_errors
def demo(
    folder: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the example's files.")
    ] = Path("demo_out"),
    seed: Seed = 2013,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """The KR 270 example of Klimchik et al. 2013, measured (simulated) and identified.

    Example: elastocal demo -o demo_out
    """
    from elastocal.cli.results import write_results
    from elastocal.demo import run_demo

    with progress_line(quiet) as progress:
        done = run_demo(folder, seed, progress)
        report = folder / "report.html"
        inputs = [done.cell, done.plan, done.data]
        write_results(
            done.result, folder / "result.json", report, None, inputs, done.truth, seed,
            done.published,
        )  # fmt: skip
    if as_json:
        typer.echo(json_text(done.result.to_json() | {"truth": done.truth}))
        return
    from elastocal.report.terminal import print_result

    print_result(console(), done.result, truth=done.truth)
    typer.echo(
        f"\nTo repeat it by hand: elastocal identify {done.cell} {done.data} -o result.json\n"
        f"Report to open: {report.absolute()}"
    )
