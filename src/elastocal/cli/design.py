"""elastocal design: which poses to measure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperOption

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
from elastocal.cli.interrupts import Interrupts
from elastocal.cli.plan_files import (
    check_apart,
    check_programs,
    check_suffixes,
    files_of,
    write_all,
    write_page,
)
from elastocal.errors import ElastocalError, InputError, require


def _criteria() -> list[str]:
    from elastocal.planning.criteria import CRITERIA

    return list(CRITERIA)


class NamingCriteria(TyperCommand):
    """A command whose help lists the criteria that there are; only help waits for them."""

    def format_help(self, *args: Any) -> None:
        for parameter in self.params:
            if isinstance(parameter, TyperOption) and parameter.name == "criterion":
                parameter.help = f"{', '.join(_criteria())}; default as the cell says."
        super().format_help(*args)


@app.command(cls=NamingCriteria)
@reporting_errors
def design(
    cell: CellFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="The plan to write (CSV).")],
    poses: Annotated[int | None, typer.Option(min=1, help="Number of poses.")] = None,
    criterion: Annotated[
        str | None,
        typer.Option(
            help="What makes a plan good; default as the cell says.", autocompletion=_criteria
        ),
    ] = None,
    target: Annotated[
        float | None,
        typer.Option(
            metavar="µm",
            help="Find the smallest number of poses that reaches this, for a criterion in µm.",
        ),
    ] = None,
    curve: Annotated[
        str | None,
        typer.Option(metavar="N,N,…", help="Compare numbers of poses, as in 10,15,20,30."),
    ] = None,
    augment: Annotated[
        Path | None, typer.Option(help="Measurements already done (CSV), which the plan adds to.")
    ] = None,
    knowledge: Annotated[
        Path | None, typer.Option(help="Priors on parameters (TOML), as for identify.")
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Hold a parameter, place or effect as known; repeatable."
        ),
    ] = None,
    candidates: Annotated[
        int | None, typer.Option(min=1, help="Feasible candidates to choose from, over all levels.")
    ] = None,
    effort: Annotated[str, typer.Option(help="quick, normal or thorough.")] = "normal",
    program: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Robot program to write: NAME.src (KRL), NAME.script (URScript); repeatable.",
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the poses to write (PNG, SVG).")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report (one HTML page).")] = None,
    jobs: Annotated[int, typer.Option(help="Processes; -1 for all cores.")] = 1,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Which poses should I measure?

    Writes the plan (CSV) and plan.json beside it.  An interrupted run goes on where it was when
    it is started again with the same input.

    Example: elastocal design cell.toml -o plan.csv --poses 15 --picture poses.png
    """
    from elastocal.design.checkpoint import Checkpoint, key_of
    from elastocal.design.design import design as run
    from elastocal.verbs import design_request

    summary = output.with_suffix(".json")
    require(output.suffix.lower() != ".json", f"{output}: name the plan .csv; .json goes beside it")
    programs = tuple(program or ())
    check_suffixes(programs, picture)
    written = [p for p in (output, summary, *programs, picture, report) if p is not None]
    check_outputs(*written)
    asked: dict[str, Any] = {
        "poses": poses,
        "criterion": criterion,
        "target": _target(target, poses),
        "candidates": candidates,
    }
    with progress_line(quiet) as tell, Interrupts() as interrupts:

        def progress(message: str) -> None:
            interrupts.check()
            tell(message)

        progress("reading")
        wanted, options = design_request(
            cell, **asked, augment=augment, knowledge=knowledge, fixed=tuple(fix or ()),
            curve=_numbers(curve), effort=effort, seed=seed, jobs=jobs,
        )  # fmt: skip
        check_programs(wanted, programs)
        files = [p for p in (cell, augment, knowledge, *files_of(wanted)) if p is not None]
        check_apart(written, files)
        told = asked | {"fix": fix, "curve": curve, "effort": effort}
        key = key_of(files, seed=seed, **told)
        checkpoint = Checkpoint.beside(output, key, interrupts.check)
        if checkpoint.begun:
            progress("going on with the design that was interrupted")
        try:
            plan = run(wanted, options, checkpoint, progress)
        except Exception as error:
            interrupts.check()
            if isinstance(error, ElastocalError):
                # The same input ends here again: there is nothing to go on with.
                checkpoint.drop()
            raise
        interrupts.check()
        write_all(plan, output, programs, picture)
        if report is not None:
            progress("writing the report")
            write_page(plan, report, files)
        checkpoint.clear()
    if as_json:
        typer.echo(summary.read_text(encoding="utf-8"), nl=False)
        return
    from elastocal.report.terminal import print_plan

    print_plan(console(), plan)
    for path in written:
        typer.echo(f"wrote {path}")


def _target(target: float | None, poses: int | None) -> float | None:
    """--target in m."""
    if target is None:
        return None
    require(
        math.isfinite(target) and target > 0,
        f"--target takes a positive number of µm; found {target:g}",
    )
    require(
        poses is None,
        f"--poses {poses} and --target {target:g}: a target asks for the number of poses; drop one",
    )
    return target * 1e-6


def _numbers(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    try:
        return tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise InputError(
            f"--curve takes numbers of poses, as in 10,15,20; found '{text}'"
        ) from None
