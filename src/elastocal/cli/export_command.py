"""elastocal export: the calibrated arm for other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.signatures import FORCE, CellFile, ResultFile, Run, Seed, command

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from elastocal.export.export import Exported
    from elastocal.export.exportable import Cost
    from elastocal.export.refit import Refit


WORTH_TELLING = 10e-6  # m, as for what compensate leaves open


@command(short_help="Write the calibrated model: URDF, MuJoCo, DH table")
def export(
    cell: CellFile,
    result: ResultFile,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="File to write: .urdf, .xml or .mjcf, .csv (DH), .yaml, .json."
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(
            help="urdf, mjcf, dh, mdh (modified DH), yaml, json, or corrections (smooth functions "
            "as CSV); default: by the ending."
        ),
    ] = None,
    load: Annotated[
        FORCE | None,
        typer.Option(
            metavar="X Y Z",
            help="Force in N at the load point (tracker's axes) for costs and fit.",
        ),
    ] = None,
    frames: Annotated[
        bool,
        typer.Option("--frames/--no-frames", help="URDF: links for markers and load point."),
    ] = True,
    base_frame: Annotated[
        bool,
        typer.Option("--base-frame", help="Put the tracker's frame above the robot's base."),
    ] = False,
    joint_correction: Annotated[
        Path | None,
        typer.Option(
            help="Write the joint correction for simulators (CSV); the file is fitted with it."
        ),
    ] = None,
    temperature_c: Annotated[
        float | None, typer.Option("--temperature-c", help="Temperature in °C to export at.")
    ] = None,
    time_s: Annotated[
        float | None, typer.Option("--time-s", help="Time in s, as in the data, to export at.")
    ] = None,
    poses: Annotated[
        int, typer.Option(min=2, max=1_000_000, help="Random poses to find costs at.")
    ] = 500,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """Write the calibrated arm as URDF, MJCF, DH table or parameters, and state the loss.

    Example: elastocal export cell.toml result.json -o calibrated.urdf --load 0 0 -2600
    """
    from elastocal.export.export import export as exported
    from elastocal.export.export import write
    from elastocal.model.calibrated import read_calibrated
    from elastocal.saving import wish_of

    run.writes(output, joint_correction)
    wish = wish_of(
        output, format, load, frames, base_frame, temperature_c, time_s, poses, seed,
        joint_correction is not None,
    )  # fmt: skip
    with run.progress() as progress:
        progress("reading")
        calibrated = read_calibrated(cell, result, run.plugins)
        run.reads(cell, result, cell=calibrated.model.cell)
        done = exported(calibrated, wish, progress)
    write(done, output, joint_correction)
    run.answer(lambda: {"output": str(output)} | done.to_json(), lambda screen: _tell(screen, done))


def _tell(screen: Console, done: Exported) -> None:
    """What the file holds and what not, for people."""
    from elastocal.text import printable

    cost, (name, in_title) = done.cost, NAMES[done.format]
    if cost.effects:
        screen.print(_cost_table(f"What {in_title} cannot hold", cost))
    held = list(done.held)
    more = f" and {len(held) - 8} more" if len(held) > 8 else ""
    for wanted, sentence in (
        (not cost.effects, f"{name} holds all of the calibrated model."),
        (
            cost.effects,
            f"Costs: differences from the calibrated model at {cost.poses} random poses within the "
            f"joint {'ranges measured' if cost.measured else 'limits'} under "
            f"{_loads(cost)}, each effect left out alone.",
        ),
        (
            done.refit is not None,
            _fit(done.refit),
        ),
        (
            done.checked is not None,
            f"Read back with {done.checked_with}: {_rounding(done.checked)} at most.",
        ),
        (
            done.without_beta is not None,
            f"Without the column beta_rad: {_rounding(done.without_beta)} at most.",
        ),
        (
            held,
            "Not determined by the data, at the values that the identification predicts with: "
            f"{', '.join(held[:8])}{more}.",
        ),
        (
            done.of_the_measurement,
            f"Left out, effects of the measurement: {', '.join(done.of_the_measurement)}.",
        ),
        *((True, f"Note: {warning}.") for warning in done.warnings),
        (
            cost.total is not None and cost.total.marker_rms > WORTH_TELLING,
            "Next: if that matters, elastocal compensate corrects it with the same cell "
            "and result.",
        ),
    ):
        if wanted:
            screen.print(printable(sentence), markup=False)


def _loads(cost: Cost) -> str:
    if len(cost.forces) == 1:
        return f"a load of ({', '.join(f'{v:g}' for v in cost.forces[0])}) N"
    sizes = [math.hypot(*force) for force in cost.forces]
    return f"the {len(sizes)} loads measured, {min(sizes):.4g} to {max(sizes):.4g} N"


def _fit(refit: Refit | None) -> str:
    """How far the file is from the arm."""
    from elastocal.report.formatting import length

    if refit is None:
        return ""
    told = f"the markers are {length(refit.after)} rms off"
    if refit.correction is not None:
        told = f"{told}, with its joint correction {length(refit.correction)}"
    if refit.taken or refit.correction is not None:
        told = (
            f"Refitted to the calibrated arm at {refit.visits} measured visits: "
            f"{told}, with the values identified {length(refit.before)}"
        )
    else:
        told = f"Values as identified; no refit is better: {told}"
    worse = "" if refit.after < refit.nominal else "; it is worse than the nominal file"
    return f"{told}, the nominal file with base and tool placed {length(refit.nominal)}{worse}."


def _rounding(metres: float | None) -> str:
    """A length; what is below a nanometre is rounding and no number to read."""
    from elastocal.report.formatting import length

    return "< 0.001 µm" if not metres or metres < 1e-9 else length(metres)


def _cost_table(title: str, cost: Cost) -> Table:
    from elastocal.report import blocks
    from elastocal.report.formatting import length
    from elastocal.report.terminal import table_of
    from elastocal.text import printable

    rows = []
    every = [(e.effect.replace("_", " "), e.difference, e.note) for e in cost.effects]
    for name, d, note in [*every, ("all of it", cost.total, "")]:
        sizes = () if d is None else (d.marker_rms, d.marker_max, d.flange_rms, d.flange_max)
        cells = [length(size) for size in sizes] or [""] * 4
        rows.append((printable(name), *cells, printable(note)))
    heads = ("effect", "markers rms", "max", "flange rms", "max", "")
    return table_of(blocks.ShownTable(heads, rows, (0, 5), title=title))


# At the start of a sentence and in a title.
NAMES = {
    "urdf": ("The URDF", "a URDF"),
    "mjcf": ("The MJCF", "this MJCF"),
    "dh": ("The DH table", "a DH table"),
    "mdh": ("The DH table", "a DH table"),
    "yaml": ("Geometry alone", "geometry alone"),
    "json": ("Geometry alone", "geometry alone"),
    "corrections": ("Geometry alone", "geometry alone"),
}
