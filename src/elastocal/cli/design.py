"""elastocal design: which poses to measure."""

from __future__ import annotations

import json
import sys
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
from elastocal.errors import InputError, require

if TYPE_CHECKING:
    from elastocal.cell import Cell
    from elastocal.design.options import DesignOptions
    from elastocal.design.plan import Plan

PROGRAMS = {".src": "KUKA KRL", ".script": "URScript"}
PICTURES = (".png", ".svg")


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
            help="Find the smallest number of poses that reaches this (µm for test_pose)."
        ),
    ] = None,
    curve: Annotated[
        str | None, typer.Option(help="Compare numbers of poses, as in 10,15,20,30.")
    ] = None,
    augment: Annotated[
        Path | None, typer.Option(help="Measurements already done (CSV), which the plan adds to.")
    ] = None,
    knowledge: Annotated[
        Path | None, typer.Option(help="Priors on parameters (TOML), as for identify.")
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(help="Hold a parameter, place or effect as known; repeatable."),
    ] = None,
    candidates: Annotated[
        int | None, typer.Option(min=1, help="Feasible candidates per level to choose from.")
    ] = None,
    effort: Annotated[str, typer.Option(help="quick, normal or thorough.")] = "normal",
    program: Annotated[
        list[Path] | None,
        typer.Option(help="Robot program to write: NAME.src (KRL), NAME.script (URScript)."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the poses to write (PNG, SVG).")
    ] = None,
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

    report = output.with_suffix(".json")
    require(output.suffix.lower() != ".json", f"{output}: name the plan .csv; .json goes beside it")
    programs = tuple(program or ())
    _check_suffixes(programs, picture)
    check_outputs(output, report, picture, *programs)
    asked = {
        "poses": poses,
        "criterion": criterion,
        "target": None if target is None else target * 1e-6,
        "candidates": candidates,
    }
    with progress_line(quiet) as progress:
        progress("reading")
        wanted = _read(cell, asked)
        options = _options(wanted, augment, knowledge, fix, curve, effort, seed, jobs)
        files = [p for p in (cell, augment, knowledge, *_files_of(wanted)) if p is not None]
        told = {k: v for k, v in asked.items()} | {"fix": fix, "curve": curve, "effort": effort}
        checkpoint = Checkpoint.beside(output, key_of(files, seed=seed, **told))
        if checkpoint.begun:
            progress(f"going on with the interrupted design in {checkpoint.folder}")
        plan = run(wanted, options, checkpoint, progress)
        _write(plan, output, report, programs, picture)
        checkpoint.clear()
    if as_json:
        typer.echo(json.dumps(plan.to_json(), indent=1))
        return
    from elastocal.report.plan_tables import print_plan

    print_plan(console(), plan)
    for path in (output, report, *programs, picture):
        if path is not None:
            typer.echo(f"wrote {path}")


def _check_suffixes(programs: tuple[Path, ...], picture: Path | None) -> None:
    for path in programs:
        require(
            path.suffix.lower() in PROGRAMS,
            f"--program {path}: the suffix says the language, "
            + " or ".join(f"{suffix} for {name}" for suffix, name in PROGRAMS.items()),
        )
    require(
        picture is None or picture.suffix.lower() in PICTURES,
        f"--picture {picture}: name it {' or '.join(PICTURES)}",
    )


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
        changes["per_level"] = ()
    return replace(cell, design=replace(cell.design, **changes))


def _options(
    cell: Cell, augment: Path | None, knowledge: Path | None, fix: list[str] | None,
    curve: str | None, effort: str, seed: int, jobs: int,
) -> DesignOptions:  # fmt: skip
    from elastocal.design.options import DesignOptions
    from elastocal.identification.knowledge import read_knowledge
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
    return DesignOptions(
        effort=effort,  # type: ignore[arg-type]
        seed=seed,
        jobs=jobs,
        fixed=tuple(fix or ()),
        prior=None if knowledge is None else read_knowledge(knowledge).prior,
        done=done,
        curve=_numbers(curve),
    )


def _numbers(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    try:
        return tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        raise InputError(
            f"--curve takes numbers of poses, as in 10,15,20; found '{text}'"
        ) from None


def _files_of(cell: Cell) -> tuple[Path | None, ...]:
    """Files that the cell names and a plan depends on."""
    robot, path = cell.robot, cell.design.test_path
    meshes = [s.mesh for s in cell.workspace.obstacles]
    meshes += [body.solid.mesh for body in cell.workspace.bodies]
    return (robot.urdf, robot.dh, robot.masses, None if path is None else path.file, *meshes)


def _write(
    plan: Plan, output: Path, report: Path, programs: tuple[Path, ...], picture: Path | None
) -> None:
    from elastocal.design.plan_file import plan_rows, write_plan, write_plan_json

    chain = plan.model.chain
    rows = plan_rows(plan.execution, plan.configurations, plan.group + 1, plan.stated_forces)
    write_plan(output, rows, chain.kinds)
    write_plan_json(report, plan.to_json() | {"command": " ".join(["elastocal", *sys.argv[1:]])})
    for path in programs:
        _write_program(plan, path)
    if picture is not None:
        from elastocal.report.plan_picture import write_plan_picture

        write_plan_picture(
            picture, plan.model.cell, chain, plan.q,
            names=plan.configurations, group=plan.group, group_names=plan.group_names,
        )  # fmt: skip


def _write_program(plan: Plan, path: Path) -> None:
    from elastocal.design.programs.krl import krl_program
    from elastocal.design.programs.urscript import urscript_program
    from elastocal.files import atomic_write_text

    write = krl_program if path.suffix.lower() == ".src" else urscript_program
    arguments = (plan.execution, plan.model.chain, plan.configurations, plan.forces)
    atomic_write_text(path, write(*arguments, name=path.stem))
