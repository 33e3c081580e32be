"""Verbs up to the measurements: init, effects, design, simulate, import."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from elastocal import verbs
from elastocal.cli.app import PAGES, Asked, Run, command, named_numbers, repeated, whole_numbers
from elastocal.messages import InputError, counted, listed, require, said_of
from elastocal.screen import interrupts, say

if TYPE_CHECKING:
    from rich.console import Console

    from elastocal.cell import Cell
    from elastocal.importing.assemble import Imported
    from elastocal.planning.design import DesignOptions
    from elastocal.planning.plan import Plan
    from elastocal.planning.search import Checkpoint
    from elastocal.units import Progress


@command(short_help="Write a working cell file for my arm", flags="")
def init(
    robot: Path, output: Path = Path("cell.toml"), base: str | None = None,
    flange: str | None = None, convention: str = "standard", ur_model: str | None = None,
    force: bool = False, *, run: Run,
) -> None:  # fmt: skip
    """Write a working cell: joints and limits from the robot's file, commented guesses elsewhere.

    Example: elastocal init arm.urdf -o cell.toml

    Args:
        robot: URDF (.urdf), MuJoCo model (.xml, .mjcf), DH table (.csv) or factory calibration
            of a UR (.conf, .yaml).
        output: Cell file to write (TOML).
        base: First link or body; default: the root.
        flange: Last link, body or site; default: as found.
        convention: Of a DH table: standard or modified.
        ur_model: Of a calibration.conf: the robot, as UR10e.
        force: Write over a file.
    """
    from elastocal.cell import read_cell
    from elastocal.importing.first_cell import init as write
    from elastocal.importing.first_cell import notes_of
    from elastocal.model.manipulator import load_chain
    from elastocal.model.rigid import reach_of

    run.writes((output, ".toml"))
    run.reads(robot)
    write(robot, output, base=base, flange=flange, convention=convention,  # type: ignore[arg-type]
          ur_model=ur_model, force=force)  # fmt: skip
    cell = read_cell(output)
    chain = load_chain(cell)
    names = [joint.name for joint in chain.joints]
    reach = f"reach {reach_of(chain):.2f} m"
    say(f"wrote {output}: {len(names)} joints ({', '.join(names)}), {reach}")
    for note in notes_of(cell.robot, chain):
        say(f"Note: {note}.")
    if cell.robot.flange is not None:
        say(f"The flange is '{cell.robot.flange}'; --flange names another.")
    say("Replace what is marked as a guess. It runs as it is:")
    say(f"  elastocal design {output} -o plan.csv --effort quick")
    loads = cell.design.loads
    load = " ".join(f"{v:g}" for v in loads[-1]) if loads is not None else "0 0 -100"
    say(f"  elastocal simulate {output} plan.csv -o data.csv --draw 1 --load {load}")


@command(short_help="List the effects that can be fitted", flags="plugins json")
def effects(cell: Annotated[Path | None, typer.Argument()] = None, *, run: Run) -> None:
    """Every effect of the catalogue: its parameters' unit and typical size, what it is, and where.

    Example: elastocal effects cell.toml

    Args:
        cell: Cell file (TOML); default: the KR 270 of the demo.
    """
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.model.manipulator import effect_entries
    from elastocal.simulation import DEMO

    known = cell_of(cell or DEMO / "cell.toml", run.plugins)
    entries = effect_entries(known)
    run.answer(
        lambda: {"schema": "elastocal/effects/1", "effects": entries},
        lambda screen: _print_effects(screen, known, entries),
    )


def _print_effects(screen: Console, cell: Any, entries: Any) -> None:
    from rich.padding import Padding

    from elastocal.model.chain import names_told
    from elastocal.model.manipulator import load_chain
    from elastocal.report.blocks import STAGES, effect_head

    for stage, several in groupby(entries, lambda entry: entry["stage"]):
        screen.print(f"\n{STAGES[stage].capitalize()}", style="bold")
        for entry in several:
            screen.print(Padding(effect_head(entry), (0, 0, 0, 2)))
            screen.print(Padding(entry["what"], (0, 0, 0, 6)), style="dim")
    screen.print()
    if told := names_told(load_chain(cell)):
        screen.print(f"Joints: {told}")
    screen.print("Each line: effect (* fitted or acting), places, typical size of its parameters.")
    screen.print('In the cell: [model] effects = ["joint_offset", "backlash:joint2"].')


CURVE = "--curve takes numbers of poses, as in 10,15,20"


def _target(text: str) -> float:
    target = math.nan
    with suppress(ValueError):
        target = float(text)
    require(0 < target < math.inf, f"--target takes a positive number of µm; found {text}")
    return target * 1e-6


def _candidates(text: str) -> int | str | list[int | str]:
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
        "curve": ("N,N,…", partial(whole_numbers, takes=CURVE)),
        "keep": ("PLAN[:3,7]", str),
        "strike": ("PLAN:3,7", str),
        "candidates": ("N|FILE[,N]", _candidates),
    },
)
def design(
    cell: Path, output: Path, *, asked: Asked, program: list[Path] | None = None,
    picture: Path | None = None, cell_out: Path | None = None, report: Path | None = None, run: Run,
) -> None:  # fmt: skip
    """Which poses should I measure?

    Writes the plan (CSV) and plan.json beside it.  An interrupted run, started again with
    the same input, resumes.

    Example: elastocal design cell.toml -o plan.csv --poses 15 --picture poses.png

    Args:
        output: The plan to write (CSV), .json beside it; OUTPUT.resume while it works.
        program (FILE): Robot program to write: NAME.src (KRL), NAME.script (URScript); repeatable.
        picture: Picture of the poses to write (PNG, SVG).
        cell_out: Cell file to write, with what [design.choose] has chosen.
    """
    from elastocal.cell import files_of
    from elastocal.files import atomic_write
    from elastocal.model.effects.catalogue import cell_of
    from elastocal.planning.poses import plan_and_names
    from elastocal.report.arm_view import write_plan_picture
    from elastocal.report.renderers import print_report
    from elastocal.saving import LANGUAGES, beside, save_plan

    summary = beside(output)
    programs = program or []
    kinds = " or ".join(f"{suffix} for {way.title}" for suffix, way in LANGUAGES.items())
    for path in programs:
        told = f"--program {path}: the suffix says the language, {kinds}"
        require(path.suffix.lower() in LANGUAGES, told)
    require(picture is None or picture.suffix != "", f"--picture {picture}: name it .png or .svg")
    run.writes(
        (output, ".csv"), (summary, ".json"), *((path, "") for path in programs),
        (picture, ".png .svg"), (report, PAGES), (cell_out, ".toml"),
    )  # fmt: skip
    with run.progress() as progress:

        def chosen(path: Path) -> None:
            from elastocal.diagnosis.diagnose import write_extended_cell

            write_extended_cell(cell, path, (), keys=plan.chosen.keys if plan.chosen else {})

        progress("reading")
        wanted, options = verbs.design_request(cell_of(cell, run.plugins), **asked)
        _programs(programs, wanted)
        require(
            cell_out is None or wanted.design.choose is not None,
            f"--cell-out {cell_out}: nothing is chosen; state [design.choose] in {cell}",
        )
        pinned = [plan_and_names(asked[name])[0] for name in ("keep", "strike") if name in asked]
        stated = [asked.get(name) for name in ("augment", "knowledge")]
        files = run.reads(cell, *stated, *pinned, *files_of(wanted))
        plan, checkpoint = _resumed(wanted, options, output, files, asked, progress)
        if report is not None:
            progress("writing the report")
        texts = _programs(programs, plan.model.cell, plan)
        run.write(
            (output, lambda path: save_plan(plan, path, repeated())),
            *((path, partial(atomic_write, content=text)) for path, text in texts.items()),
            (picture, lambda path: write_plan_picture(path, plan)),
            (cell_out, chosen),
            (report, partial(plan.report, inputs=list(dict.fromkeys(files)), command=repeated())),
        )
        checkpoint.clear()
    if run.json:
        say(summary.read_text(encoding="utf-8"), end="")
    else:
        run.answer(plan.to_json, lambda screen: print_report(screen, plan))
        of = cell if plan.chosen is None else cell_out or "chosen.toml"
        if plan.chosen is not None and cell_out is None:
            say("Run it again with --cell-out chosen.toml for the cell that the plan is of.")
        named = f"{of}{' --plugins' * run.plugins}"
        say(_what_next(named, output, asked.get("augment"), plan))


def _resumed(
    cell: Cell, options: DesignOptions, output: Path, files: list[Path], asked: Asked,
    progress: Progress,
) -> tuple[Plan, Checkpoint]:  # fmt: skip
    from elastocal.planning.design import design as run
    from elastocal.planning.search import Checkpoint, key_of

    apart = ("jobs", "augment", "knowledge")  # these are among the files
    told = {name: value for name, value in asked.items() if name not in apart}
    checkpoint = Checkpoint.beside(output, key_of(files, **told))
    if checkpoint.begun:
        progress("resuming the interrupted design")
    before = len(interrupts)
    try:
        return run(cell, options, checkpoint, progress), checkpoint
    except Exception as error:
        if not isinstance(error, OSError) and len(interrupts) == before:
            # The same input ends here again: there is nothing to go on with.
            checkpoint.clear()
        raise


def _what_next(cell: str, output: Path, augment: Path | None, plan: Plan) -> str:
    from elastocal.planning.plan import load_name

    loads = plan.forces[(plan.forces != 0).any(axis=1)]
    carried, hung = "", "each row under its force, " if len(loads) else ""
    if len(loads) and plan.stated_forces is None:  # else the plan's rows state their forces
        names = listed(load_name(force) for force in plan.forces)
        hung = f"with the loads of its note_load ({names}), "
        carried = f" --load {' '.join(f'{value:g}' for value in loads[0])}"
    if (readings := plan.model.cell.design.repeats) > 1:
        carried += f" --repeats {readings}"
    added = "" if augment is None else f" (add them to {augment})"
    read = "distance_mm" if (kind := plan.model.observe) == "distance" else "x_mm, y_mm, z_mm"
    read += ", rx_deg, ry_deg, rz_deg (rotation vector)" * (kind == "pose")
    via = f"by the via points of {output.with_suffix('.json')}, " * bool(plan.execution.between)
    text = (
        f"Next: measure {output} in its order, {via}{hung}a row with {read} for each marker{added};"
        " then\n"
        f"  elastocal identify {cell} {augment or 'data.csv'} --report report.html"
    )
    if augment is None:  # an arm that was measured is not the one that --draw takes
        text += f"\nTo try it without an arm: elastocal simulate {cell} {output} -o data.csv"
        text += f" --draw 1{carried}"
    return text


def _programs(paths: list[Path], cell: Cell, plan: Plan | None = None) -> dict[Path, str]:
    """Without a plan only whether they can be written for this arm, which is told before the work
    and not after it."""
    from elastocal.model.chain import joint_limits
    from elastocal.model.manipulator import load_chain
    from elastocal.saving import LANGUAGES, check_six_axes, robot_program

    written, chain = dict[Path, str](), load_chain(cell)
    for path in paths:
        with said_of(f"--program {path}"):
            check_six_axes(chain, LANGUAGES[path.suffix.lower()].title)
            if plan is not None:
                written[path] = robot_program(
                    path.suffix, plan.execution, chain, plan.names, plan.forces,
                    joint_limits(cell, chain), path.stem,
                )  # fmt: skip
    return written


@command(
    short_help="Simulate the measurements of a plan",
    verb=verbs.simulate,
    offers="draw load repeats seed",
)
def simulate(
    cell: Path, plan: Path, output: Path, set_: list[str] | None = None,
    truth: Path | None = None, no_noise: bool = False, *, asked: Asked, run: Run,
) -> None:  # fmt: skip
    """Simulate measurements from the cell's model, with chosen errors and noise.

    Example: elastocal simulate cell.toml plan.csv -o data.csv --set joint2.compliance=3e-7
    --load 0 0 -2600 --repeats 6

    Args:
        plan: Poses (CSV): configuration, q1_deg, …
        output: Measurements to write (CSV).
        set_ (NAME=VALUE): True value in SI units; repeatable.
        truth: Write the true values used, as JSON {name: value}.
        no_noise: Exact readings.
    """
    from elastocal.model.manipulator import Model
    from elastocal.saving import WRITERS, write_json

    run.writes((output, " ".join(WRITERS["Measurements"])), (truth, ".json"))
    model = Model(cell, plugins=run.plugins)
    run.reads(cell, plan, cell=model.cell)
    poses = model.read_plan(plan)
    values = named_numbers(set_ or (), "--set takes NAME=VALUE with a number in SI units")
    table, x = verbs.simulated(model, poses, **asked, values=values, noise=not no_noise)
    planned = model.cell.design.loads
    if "load" not in asked and not table.force.any() and planned is not None and planned.any():
        say(
            f"Warning: {plan} states no load and none is given, so every reading is unloaded; the "
            "cell plans some ([design] loads_N): simulate one by --load",
            error=True,
        )
    named = dict(zip(model.names, x.tolist(), strict=True))
    run.write((output, table.save), (truth, lambda path: write_json(path, named)))
    n = len(poses.configuration_labels)
    answer = {"output": str(output), "readings": len(table), "poses": n, "seed": asked["seed"]}
    told = f"wrote {len(table)} readings of {counted(n, 'pose')} to {output}"
    run.answer(lambda: answer | {"truth": named}, lambda _: say(told), files=False)


@command(
    "import",
    short_help="Convert tracker exports and joint logs to the measurement table",
    flags="json",
)
def import_(
    files: Annotated[list[Path] | None, typer.Argument()] = None, output: Path | None = None,
    mapping: Annotated[Path | None, typer.Option("--map")] = None, preset: list[str] | None = None,
    show_preset: str | None = None, preview: bool = False,
    cell: Annotated[Path | None, typer.Option()] = None, length_unit: str | None = None,
    angle_unit: str | None = None, *, run: Run,
) -> None:  # fmt: skip
    """Convert exports of a laser tracker and joint logs to the measurement table.

    Example: elastocal import points.txt poses.dat --preset spatialanalyzer --preset kuka
    --cell cell.toml --preview -o data.csv

    Args:
        files: Exports of the tracker and logs of the joints, in any order.
        output: Measurements to write (CSV).
        mapping: Mapping file (TOML): what the columns mean.
        preset (NAME): One for all files, or one per file: spatialanalyzer, polyworks, leica,
            faro, spherical, wide, kuka, abb, ros.
        show_preset (NAME): Print a preset to copy from, and stop.
        preview: Show what was understood; needs no --output.
        cell: Cell file: check joints, limits, markers and the fit to its robot.
        length_unit: Unit of lengths where a file does not say: mm, m, um, in.
        angle_unit: Unit of angles where a file does not say: deg, rad, gon.
    """
    from elastocal.cell import read_cell
    from elastocal.files import atomic_write
    from elastocal.importing.assemble import import_files
    from elastocal.importing.exports import likely_presets
    from elastocal.importing.mapping_file import PRESETS, preset_text, read_mapping
    from elastocal.report.renderers import print_blocks
    from elastocal.report.smaller_views import import_blocks, left_out

    if show_preset is not None:
        say(preset_text(show_preset), end="")
        return
    paths = list(files or ())
    told = "the argument FILES is missing: the tracker's export, and the log of the joints"
    require(bool(paths), told)
    told = "import needs -o data.csv to write to, or --preview to only look"
    require(output is not None or preview or run.json, told)
    if mapping is None and not preset:
        likely = {path: likely_presets(path) for path in paths if path.is_file()}
        read_by = [
            f"{path} as --preset {' or '.join(found)}" for path, found in likely.items() if found
        ]
        hint = f"; what reads your files: {', '.join(read_by)}" if read_by else ""
        raise InputError(f"import needs --map mapping.toml, or --preset: {listed(PRESETS)}{hint}")
    run.writes((output, ".csv"))
    run.reads(*paths, mapping, cell)
    read = read_mapping(mapping, preset or (), length_unit, angle_unit)
    known = None if cell is None else read_cell(cell)
    run.reads(cell=known)
    found = import_files(paths, read, known, str(output or "the table"))
    if preview or run.json:
        run.answer(
            lambda: _understood(found, output),
            lambda screen: print_blocks(screen, import_blocks(found, screen.width)), files=False,
        )  # fmt: skip
    else:
        for line in (*(f"Warning: {warning}" for warning in found.warnings), *left_out(found)):
            say(line, error=True)
    require(not found.refused, found.refused)
    run.write((output, partial(atomic_write, content=found.text)))
    if output is not None and not run.json:
        n, configurations = len(found.table), len(found.table.configuration_labels)
        say(f"wrote {n} readings of {configurations} configurations to {output}")


def _understood(found: Imported, output: Path | None) -> dict[str, Any]:
    table, joined = found.table, found.joined
    return {
        "schema": "elastocal/import/1",
        "output": None if output is None else str(output),
        "readings": len(table),
        "configurations": len(table.configuration_labels),
        "markers": list(table.markers_read),
        "columns": list(found.columns),
        "joined_by": None if joined is None else joined.how,
        "left_out": [] if joined is None else list(joined.left_out),
        "poses_without_point": [] if joined is None else list(joined.unused),
        "nominal_fit_um": None if found.fit is None else found.fit.error * 1e6,
        "files": [one | {"ignored": [{"line": n, "reason": why} for n, why in one["ignored"]]}
                  for one in found.understood],
        "warnings": list(found.warnings),
        "refused": found.refused or None,
    }  # fmt: skip
