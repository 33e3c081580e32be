"""elastocal design: which poses to measure."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

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

if TYPE_CHECKING:
    from elastocal.cell import Cell
    from elastocal.design.options import DesignOptions
    from elastocal.identification.constrained.prior import GaussianPrior


@app.command()
@reporting_errors
def design(
    cell: CellFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="The plan to write (CSV).")],
    poses: Annotated[int | None, typer.Option(min=1, help="Number of poses.")] = None,
    criterion: Annotated[
        str | None,
        typer.Option(help="test_pose, D, A, E, G, I, c, O1 to O5; default as the cell says."),
    ] = None,
    target: Annotated[
        float | None,
        typer.Option(
            metavar="µm",
            help="Find the smallest number of poses that reaches this, in µm (test_pose, I, G).",
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

    summary = output.with_suffix(".json")
    require(output.suffix.lower() != ".json", f"{output}: name the plan .csv; .json goes beside it")
    programs = tuple(program or ())
    check_suffixes(programs, picture)
    written = [p for p in (output, summary, *programs, picture, report) if p is not None]
    check_outputs(*written)
    asked = {
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
        wanted = _read(cell, asked)
        check_programs(wanted, programs)
        options = _options(wanted, augment, knowledge, fix, curve, effort, seed, jobs)
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
    from elastocal.report.plan_tables import print_plan

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


def _read(path: Path, asked: dict[str, Any]) -> Cell:
    """The cell, with what the command line says of [design] in its place."""
    from elastocal.cell_design import CriterionName
    from elastocal.cell_reader import read_cell
    from elastocal.manipulator.effects import CATALOGUE
    from elastocal.nearest import did_you_mean, listed, quoted

    cell = read_cell(path, known_effects=tuple(CATALOGUE))
    names = get_args(CriterionName)
    name = asked["criterion"]
    if name is not None and name not in names:
        raise InputError(
            f"--criterion {quoted(name)} is unknown{did_you_mean(name, names)}; there are "
            f"{listed(names)}"
        )
    changes = {key: value for key, value in asked.items() if value is not None}
    if "poses" in changes:
        # What the cell says of their number gives way to the command line.
        changes |= {"per_level": (), "target": None}
    return replace(cell, design=replace(cell.design, **changes))


def _options(
    cell: Cell, augment: Path | None, knowledge: Path | None, fix: list[str] | None,
    curve: str | None, effort: str, seed: int, jobs: int,
) -> DesignOptions:  # fmt: skip
    from elastocal.design.options import DesignOptions
    from elastocal.manipulator.choice import load_chain
    from elastocal.measurement_reader import read_measurements

    done = None
    if augment is not None:
        done = read_measurements(
            augment,
            joint_kinds=load_chain(cell).kinds,
            marker_names=tuple(cell.tool.markers),
            observe=cell.model.observe,
        )
    markers = () if done is None else done.marker_names
    prior, notes = (None, ()) if knowledge is None else _prior(knowledge, cell, markers)
    return DesignOptions(
        effort=effort,  # type: ignore[arg-type]
        seed=seed,
        jobs=jobs,
        fixed=tuple(fix or ()),
        prior=prior,
        done=done,
        curve=_numbers(curve),
        notes=notes,
    )


def _prior(
    path: Path, cell: Cell, markers: tuple[str, ...]
) -> tuple[GaussianPrior, tuple[str, ...]]:
    """What a knowledge file says that counts for a plan, and a sentence on what does not."""
    from elastocal.identification.constrained.constraints import Constraints
    from elastocal.identification.knowledge import read_knowledge
    from elastocal.manipulator.model import Model

    known = read_knowledge(path)
    prior = known.of(Model(cell, markers))[1]
    if prior is None:
        raise InputError(
            f"{path}: states no prior, and only priors count for a plan; add "
            '[prior."joint2.compliance"] with mean and std, or leave --knowledge out'
        )
    left_out = known.physical or known.constraints != Constraints()
    note = f"{path}: only its priors count for a plan; bounds, equalities and matrices do not"
    return prior, (note,) if left_out else ()


def _numbers(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    try:
        return tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise InputError(
            f"--curve takes numbers of poses, as in 10,15,20; found '{text}'"
        ) from None
