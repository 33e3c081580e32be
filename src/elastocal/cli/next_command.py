"""elastocal next: which poses to measure next, or that no more are needed."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from elastocal.cli.app import repeated
from elastocal.cli.identify_command import limits_of
from elastocal.cli.signatures import CellFile, DataFile, Output, Run, Seed, command
from elastocal.screen import say


@command("next")
def next_command(
    cell: CellFile,
    data: DataFile,
    output: Output,
    batch: Annotated[int, typer.Option(min=1)] = 5,
    required: Annotated[str | None, typer.Option("--require")] = None,
    least_gain: Annotated[float, typer.Option(min=0, max=99)] = 1.0,
    candidates: Annotated[int, typer.Option(min=1)] = 400,
    jobs: int = 1,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """Which poses should I measure next, or are these enough?

    Diagnoses and identifies the measurements so far, and writes the next poses (CSV and
    plan.json) for the parameters and for effects that may be missing; none if the required
    error is kept, or no batch gains enough.

    Example: elastocal next cell.toml data.csv -o next.csv --batch 5 --require new_poses=50

    Args:
        output: The poses to write (CSV); .json beside it.
        batch: Number of poses.
        required (new_poses=UM): Error in µm at new poses that is enough where it is kept with
            95 %; default as [require] of the cell says.
        least_gain (%): A batch pays that lowers the error so far.
        candidates: Feasible candidates to choose from.
        jobs: Processes; -1 for all cores.
    """
    from elastocal.diagnosis.next_poses import next_poses
    from elastocal.files import together
    from elastocal.model.choice import cell_of
    from elastocal.report.terminal import print_report
    from elastocal.saving import beside, save_plan

    summary = beside(output)
    run.writes(output, summary)
    limits = limits_of([] if required is None else [required], ("new_poses",))
    known = cell_of(cell, run.plugins)
    run.reads(cell, data, cell=known)
    with run.progress() as progress:
        found = next_poses(
            known, data, batch=batch, require=limits.get("new_poses"),
            least_gain=least_gain / 100, candidates=candidates, seed=seed, jobs=jobs,
            progress=progress,
        )  # fmt: skip
        if found.plan is not None:
            with together(run.written):
                save_plan(found.plan, output, repeated())
    show = partial(print_report, result=found)
    if run.answer(found.to_json, show, files=found.plan is not None) and found.plan is None:
        say(f"{output} not written")
