"""elastocal design: which poses to measure."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal import verbs
from elastocal.cli.app import files_of, repeated
from elastocal.cli.signatures import Asked, CellFile, ReportFile, Run, command
from elastocal.errors import InputError, require
from elastocal.screen import interrupt_check, say
from elastocal.text import listed

if TYPE_CHECKING:
    from elastocal.cell.work_cell import Cell
    from elastocal.model.chain import Chain
    from elastocal.planning.checkpoint import Checkpoint
    from elastocal.planning.design import DesignOptions
    from elastocal.planning.execution import Execution
    from elastocal.planning.plan import Plan
    from elastocal.units import Array, Progress

PROGRAMS = {".src": "KUKA KRL", ".script": "URScript"}
PICTURES = (".png", ".svg")


def _target(text: str) -> float:
    """--target in m."""
    try:
        target = float(text)
    except ValueError:
        target = math.nan
    require(
        math.isfinite(target) and target > 0,
        f"--target takes a positive number of µm; found {text}",
    )
    return target * 1e-6


def _numbers(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(
            f"--curve takes numbers of poses, as in 10,15,20; found '{text}'"
        ) from None


def _candidates(text: str) -> int | str | list[int | str]:
    """--candidates 500, taught.csv or taught.csv,500."""
    if text.isdecimal():
        return int(text)
    path, comma, number = text.rpartition(",")
    return [path, int(number)] if comma and number.isdecimal() else text


@command(
    verb=verbs.design,
    offers="poses criterion target minutes curve augment keep strike knowledge fixed candidates "
    "effort elsewhere elsewhere_cap load_states load_changes reference_every jobs seed",
    texts={
        "target": ("µm", _target),
        "curve": ("N,N,…", _numbers),
        "keep": ("PLAN[:3,7]", str),
        "strike": ("PLAN:3,7", str),
        "candidates": ("N|FILE[,N]", _candidates),
    },
)
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
    *,
    asked: Asked,
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
    run: Run,
) -> None:
    """Which poses should I measure?

    Writes the plan (CSV) and plan.json beside it.  An interrupted run, started again with
    the same input, resumes.

    Example: elastocal design cell.toml -o plan.csv --poses 15 --picture poses.png
    """
    from elastocal.files import together
    from elastocal.model.choice import cell_of
    from elastocal.planning.candidates import plan_and_names
    from elastocal.report.terminal import print_report
    from elastocal.saving import beside

    summary = beside(output)
    programs = program or []
    _check_suffixes(programs, picture)
    run.writes(output, summary, *programs, picture, report, cell_out)
    check = interrupt_check()
    with run.progress() as tell:

        def progress(message: str) -> None:
            check()
            tell(message)

        progress("reading")
        wanted, options = verbs.design_request(cell_of(cell, run.plugins), **asked)
        _check_programs(wanted, programs)
        require(
            cell_out is None or wanted.design.choose is not None,
            f"--cell-out {cell_out}: nothing is chosen; state [design.choose] in {cell}",
        )
        pinned = [plan_and_names(asked[name])[0] for name in ("keep", "strike") if name in asked]
        stated = [asked.get(name) for name in ("augment", "knowledge")]
        files = run.reads(cell, *stated, *pinned, *files_of(wanted))
        plan, checkpoint = _resumed(wanted, options, output, files, asked, check, progress)
        with together(run.written):
            _write_all(plan, output, programs, picture)
            if cell_out is not None:
                from elastocal.diagnosis.diagnose import write_extended_cell

                keys = plan.chosen.keys if plan.chosen else {}
                write_extended_cell(cell, cell_out, (), keys=keys)
            if report is not None:
                progress("writing the report")
                plan.report(report, inputs=list(dict.fromkeys(files)), command=repeated())
        checkpoint.clear()
    if run.json:
        say(summary.read_text(encoding="utf-8"), end="")
    else:
        run.answer(plan.to_json, lambda screen: print_report(screen, plan))
        say(_what_next(cell, output, asked.get("augment"), plan))


def _resumed(
    cell: Cell, options: DesignOptions, output: Path, files: list[Path], asked: Asked,
    check: Callable[[], None], progress: Progress,
) -> tuple[Plan, Checkpoint]:  # fmt: skip
    """The plan, where an interrupted run of the same input left off, and what that left."""
    from elastocal.planning.checkpoint import Checkpoint, key_of
    from elastocal.planning.design import design as run

    apart = ("jobs", "augment", "knowledge")  # these are among the files
    told = {name: value for name, value in asked.items() if name not in apart}
    checkpoint = Checkpoint.beside(output, key_of(files, **told), check)
    if checkpoint.begun:
        progress("resuming the interrupted design")
    try:
        plan = run(cell, options, checkpoint, progress)
    except Exception as error:
        check()
        if not isinstance(error, OSError):
            # The same input ends here again: there is nothing to go on with.
            checkpoint.drop()
        raise
    check()
    return plan, checkpoint


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
