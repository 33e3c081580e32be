"""elastocal design: which poses to measure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    Interrupts,
    Json,
    Plugins,
    Quiet,
    ReportFile,
    Seed,
    check_apart,
    check_outputs,
    command,
    console,
    files_of,
    repeated,
)
from elastocal.errors import InputError, require
from elastocal.screen import progress_line, say
from elastocal.text import listed

if TYPE_CHECKING:
    from elastocal.cell.work_cell import Cell
    from elastocal.model.chain import Chain
    from elastocal.planning.execution import Execution
    from elastocal.planning.plan import Plan
    from elastocal.units import Array

PROGRAMS = {".src": "KUKA KRL", ".script": "URScript"}
PICTURES = (".png", ".svg")
# Their classes load numpy and pydantic, for which help need not wait; a test compares the two.
CRITERIA = "test_pose, robust, D, A, E, G, I, c, O1, O2, O3, O4, O5"


def _criteria() -> list[str]:
    from elastocal.planning.criteria import CRITERIA as known

    return list(known)


@command()
def design(
    cell: CellFile,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="The plan to write (CSV), .json beside it; OUTPUT.resume while it works.",
        ),
    ],
    poses: Annotated[int | None, typer.Option(min=1, help="Number of poses.")] = None,
    criterion: Annotated[
        str | None,
        typer.Option(help=f"{CRITERIA}; default as the cell says.", autocompletion=_criteria),
    ] = None,
    target: Annotated[
        float | None,
        typer.Option(
            metavar="µm",
            help="Find the fewest poses that reach this, for a criterion in µm.",
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(help="Find the best numbers of poses and readings within this time."),
    ] = None,
    curve: Annotated[
        str | None,
        typer.Option(metavar="N,N,…", help="Compare numbers of poses, as in 10,15,20,30."),
    ] = None,
    augment: Annotated[
        Path | None, typer.Option(help="Existing measurements (CSV) to extend.")
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(
            metavar="PLAN[:3,7]", help="Poses of an earlier plan that stay: all or these."
        ),
    ] = None,
    strike: Annotated[
        str | None,
        typer.Option(
            metavar="PLAN:3,7", help="Replace these poses of a plan; all its others stay."
        ),
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
        str | None,
        typer.Option(
            metavar="N|FILE[,N]",
            help="Feasible candidates to draw, over all levels; or a table of poses instead.",
        ),
    ] = None,
    effort: Annotated[str, typer.Option(help="quick, normal or thorough.")] = "normal",
    elsewhere: Annotated[
        float | None,
        typer.Option(
            min=0, max=0.99, help="Weight share of poses over the joint ranges, as in 0.2."
        ),
    ] = None,
    elsewhere_cap: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=0.99,
            help="Loss allowed at the test poses to minimise the error elsewhere, as in 0.05.",
        ),
    ] = None,
    load_changes: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Load changes allowed; more reduce the effect of drift; default: the fewest.",
        ),
    ] = None,
    reference_every: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Visit a reference pose again after every N stops."),
    ] = None,
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
    cell_out: Annotated[
        Path | None,
        typer.Option(help="Cell file to write, with what [design.choose] has chosen."),
    ] = None,
    report: ReportFile = None,
    jobs: Annotated[int, typer.Option(help="Processes; -1 for all cores.")] = 1,
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Which poses should I measure?

    Writes the plan (CSV) and plan.json beside it.  An interrupted run, started again with
    the same input, resumes.

    Example: elastocal design cell.toml -o plan.csv --poses 15 --picture poses.png
    """
    given = locals()
    from inspect import signature

    from elastocal.files import together
    from elastocal.model.choice import cell_of
    from elastocal.planning.checkpoint import Checkpoint, key_of
    from elastocal.planning.design import design as run
    from elastocal.planning.pins import plan_and_names
    from elastocal.saving import beside
    from elastocal.verbs import design as verb
    from elastocal.verbs import design_request

    summary = beside(output)
    programs = program or []
    _check_suffixes(programs, picture)
    written = check_outputs(output, summary, *programs, picture, report, cell_out)
    # What this command and `ec.design` call the same goes from one to the other.
    asked = {name: given[name] for name in signature(verb).parameters if name in given}
    asked |= {"target": _target(target, poses), "curve": _numbers(curve), "fixed": fix or ()}
    asked["candidates"] = _candidates(candidates)
    with progress_line(quiet) as tell, Interrupts() as interrupts:

        def progress(message: str) -> None:
            interrupts.check()
            tell(message)

        progress("reading")
        wanted, options = design_request(cell_of(cell, plugins), **asked)
        _check_programs(wanted, programs)
        require(
            cell_out is None or wanted.design.choose is not None,
            f"--cell-out {cell_out}: nothing is chosen; state [design.choose] in {cell}",
        )
        pinned = [plan_and_names(text)[0] for text in (keep, strike) if text]
        read = (cell, augment, knowledge, *pinned, *files_of(wanted))
        files = [p for p in read if p is not None]
        check_apart(written, files)
        apart = ("jobs", "augment", "knowledge")  # these are among the files
        told = {name: value for name, value in asked.items() if name not in apart}
        checkpoint = Checkpoint.beside(output, key_of(files, **told), interrupts.check)
        if checkpoint.begun:
            progress("resuming the interrupted design")
        try:
            plan = run(wanted, options, checkpoint, progress)
        except Exception as error:
            interrupts.check()
            if not isinstance(error, OSError):
                # The same input ends here again: there is nothing to go on with.
                checkpoint.drop()
            raise
        interrupts.check()
        with together(written):
            _write_all(plan, output, programs, picture)
            if cell_out is not None:
                from elastocal.diagnosis.diagnose import write_extended_cell

                write_extended_cell(
                    cell, cell_out, (), keys=plan.chosen.keys if plan.chosen else {}
                )
            if report is not None:
                from elastocal.report.page import write_page

                progress("writing the report")
                write_page(plan, report, list(dict.fromkeys(files)), repeated())
        checkpoint.clear()
    if as_json:
        say(summary.read_text(encoding="utf-8"), end="")
        return
    from elastocal.report.plan_terminal import print_plan

    print_plan(console(), plan)
    for path in written:
        say(f"wrote {path}")
    say(_what_next(cell, output, augment, plan))


def _what_next(cell: Path, output: Path, augment: Path | None, plan: Plan) -> str:
    """What to do with the plan."""
    from elastocal.planning.plan import load_name

    loads = plan.forces[(plan.forces != 0).any(axis=1)]
    carried, hung = "", ""
    if len(loads) and plan.stated_forces is None:  # else the plan's rows state their forces
        names = listed(load_name(force) for force in plan.forces)
        hung = f"with the loads of its note_load ({names}), "
        carried = f" --load {' '.join(f'{value:g}' for value in loads[0])}"
    elif len(loads):
        hung = "each row under its force, "
    added = "" if augment is None else f" (add them to {augment})"
    return (
        f"Next: measure {output} in its order, {hung}a row with x_mm, y_mm, z_mm for each "
        f"marker{added}; then\n"
        f"  elastocal identify {cell} {augment or 'data.csv'} --report report.html\n"
        f"To try it without an arm: elastocal simulate {cell} {output} -o data.csv --draw 1"
        f"{carried}"
    )


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


def _numbers(text: str | None) -> list[int]:
    try:
        return [] if text is None else [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(
            f"--curve takes numbers of poses, as in 10,15,20; found '{text}'"
        ) from None


def _candidates(text: str | None) -> int | str | list[int | str] | None:
    """--candidates 500, taught.csv or taught.csv,500."""
    if text is None:
        return None
    if text.isdecimal():
        return int(text)
    path, comma, number = text.rpartition(",")
    return [path, int(number)] if comma and number.isdecimal() else text


def _check_suffixes(programs: list[Path], picture: Path | None) -> None:
    """Refuse names that do not say which kind of file is wanted."""
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


def _check_programs(cell: Cell, programs: list[Path]) -> None:
    """Can these robot programs be written for this arm?  Told before the work, not after it."""
    import numpy as np

    from elastocal.cell.plan_wishes import Motion
    from elastocal.model.choice import load_chain
    from elastocal.planning.execution import Execution

    if programs:
        chain = load_chain(cell)
        nothing = Execution((), np.zeros((0, chain.n_joints)), 0.0, False, Motion(), 0, 0)
        for path in programs:
            _program(path, nothing, chain)


def _write_all(plan: Plan, output: Path, programs: list[Path], picture: Path | None) -> None:
    """plan.csv, plan.json, robot programs and picture."""
    from elastocal.files import atomic_write_text
    from elastocal.model.chain import joint_limits
    from elastocal.planning.programs import check_program, steps_of
    from elastocal.saving import save_plan

    chain = plan.model.chain
    limits = joint_limits(plan.model.cell, chain)
    save_plan(plan, output, repeated())
    for path in programs:
        text = _program(path, plan.execution, chain, plan.configurations, plan.forces, limits)
        # Before it appears: a program that moves elsewhere than the plan is not left behind.
        check_program(text, list(steps_of(plan.execution, plan.configurations, plan.forces)))
        atomic_write_text(path, text)
    if picture is not None:
        from elastocal.report.arm_view import write_plan_picture

        write_plan_picture(picture, plan)


def _program(
    path: Path, execution: Execution, chain: Chain,
    configurations: tuple[str, ...] = (), forces: Array | None = None,
    limits: tuple[Array, Array] | None = None,
) -> str:  # fmt: skip
    """The robot program to write to `path`."""
    from elastocal.planning.programs import krl_program, urscript_program

    text = krl_program if path.suffix.lower() == ".src" else urscript_program
    try:
        return text(execution, chain, configurations, forces, name=path.stem, limits=limits)
    except InputError as error:
        raise InputError(f"--program {path}: {error}") from None
