"""elastocal next: which poses to measure next, or that no more are needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    DataFile,
    Json,
    Plugins,
    Quiet,
    Seed,
    check_apart,
    check_outputs,
    command,
    console,
    repeated,
)
from elastocal.cli.identify_command import limits_of
from elastocal.screen import progress_line, say
from elastocal.text import json_text


@command("next")
def next_command(
    cell: CellFile,
    data: DataFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The poses to write (CSV); .json beside it.")
    ],
    batch: Annotated[int, typer.Option(min=1, help="Number of poses.")] = 5,
    required: Annotated[
        str | None,
        typer.Option(
            "--require",
            metavar="new_poses=UM",
            help="Error in µm at new poses that is enough where it is kept with 95 %; default as "
            "[require] of the cell says.",
        ),
    ] = None,
    least_gain: Annotated[
        float,
        typer.Option(min=0, max=99, metavar="%", help="A batch pays that lowers the error so far."),
    ] = 1.0,
    candidates: Annotated[
        int, typer.Option(min=1, help="Feasible candidates to choose from.")
    ] = 400,
    jobs: Annotated[int, typer.Option(help="Processes; -1 for all cores.")] = 1,
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Which poses should I measure next, or are these enough?

    Diagnoses and identifies the measurements so far, and writes the next poses (CSV and
    plan.json) for the parameters and for effects that may be missing; none if the required
    error is kept, or no batch gains enough.

    Example: elastocal next cell.toml data.csv -o next.csv --batch 5 --require new_poses=50
    """
    from elastocal.diagnosis.next_poses import next_poses
    from elastocal.files import together
    from elastocal.model.choice import cell_of
    from elastocal.saving import beside, save_plan

    summary = beside(output)
    written = check_outputs(output, summary)
    limits = limits_of([] if required is None else [required], ("new_poses",))
    known = cell_of(cell, plugins)
    check_apart(written, [cell, data], known)
    with progress_line(quiet) as progress:
        found = next_poses(
            known, data, batch=batch, require=limits.get("new_poses"),
            least_gain=least_gain / 100, candidates=candidates, seed=seed, jobs=jobs,
            progress=progress,
        )  # fmt: skip
        if found.plan is not None:
            with together(written):
                save_plan(found.plan, output, repeated())
    if as_json:
        say(json_text(found.to_json()))
        return
    from elastocal.report.plan_terminal import print_next

    print_next(console(), found)
    say(f"{output} not written" if found.plan is None else f"wrote {output}\nwrote {summary}")
