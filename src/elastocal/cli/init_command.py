"""elastocal init and effects: how to begin, and what there is to fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from elastocal.cli.signatures import Output, Run, command
from elastocal.screen import say

if TYPE_CHECKING:
    from rich.console import Console


@command(short_help="Write a working cell file for my arm", flags="")
def init(
    robot: Path,
    output: Output = Path("cell.toml"),
    base: str | None = None,
    flange: str | None = None,
    convention: str = "standard",
    ur_model: str | None = None,
    force: bool = False,
    *,
    run: Run,
) -> None:
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
    from elastocal.cell.work_cell import read_cell
    from elastocal.importing.first_cell import init as write
    from elastocal.importing.first_cell import notes_of, reach_of
    from elastocal.model.choice import load_chain

    run.writes(output)
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
def effects(
    cell: Annotated[Path | None, typer.Argument()] = None,
    *,
    run: Run,
) -> None:
    """Every effect of the catalogue: its parameters' unit and typical size, what it is, and where.

    Example: elastocal effects cell.toml

    Args:
        cell: Cell file (TOML); default: the KR 270 of the demo.
    """
    from elastocal.demo import example
    from elastocal.model.choice import cell_of
    from elastocal.report.effect_names import effect_entries

    known = cell_of(cell or Path(example.__file__).parent / "cell.toml", run.plugins)
    entries = effect_entries(known)
    run.answer(
        lambda: {"schema": "elastocal/effects/1", "effects": entries},
        lambda screen: _print_effects(screen, known, entries),
    )


def _print_effects(screen: Console, cell: Any, entries: Any) -> None:
    from rich.padding import Padding

    from elastocal.model.choice import load_chain, names_told
    from elastocal.report.effect_names import effect_lines

    stage = ""
    for its_stage, head, what in effect_lines(entries):
        if its_stage != stage:
            stage = its_stage
            screen.print(f"\n{stage.capitalize()}", style="bold")
        screen.print(Padding(head, (0, 0, 0, 2)))
        screen.print(Padding(what, (0, 0, 0, 6)), style="dim")
    screen.print()
    if told := names_told(load_chain(cell)):
        screen.print(f"Joints: {told}")
    screen.print("Each line: effect (* fitted or acting), places, typical size of its parameters.")
    screen.print('In the cell: [model] effects = ["joint_offset", "backlash:joint2"].')
