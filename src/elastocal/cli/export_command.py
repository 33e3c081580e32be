"""elastocal export: the calibrated arm for other programs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from elastocal.cli.signatures import FORCE, CellFile, Output, ResultFile, Run, Seed, command

if TYPE_CHECKING:
    from elastocal.export.export import Exported
    from elastocal.export.exportable import Cost
    from elastocal.export.refit import Refit
    from elastocal.report.blocks import Block


WORTH_TELLING = 10e-6  # m, as for what compensate leaves open


@command(short_help="Write the calibrated model: URDF, MuJoCo, DH table")
def export(
    cell: CellFile,
    result: ResultFile,
    output: Output,
    format: str | None = None,
    load: FORCE | None = None,
    frames: Annotated[bool, typer.Option("--frames/--no-frames")] = True,
    base_frame: bool = False,
    joint_correction: Path | None = None,
    temperature_c: float | None = None,
    time_s: float | None = None,
    poses: Annotated[int, typer.Option(min=2, max=1_000_000)] = 500,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """Write the calibrated arm as URDF, MJCF, DH table or parameters, and state the loss.

    Example: elastocal export cell.toml result.json -o calibrated.urdf --load 0 0 -2600

    Args:
        output: File to write: .urdf, .xml or .mjcf, .csv (DH), .yaml, .json.
        format: urdf, mjcf, dh, mdh (modified DH), yaml, json, or corrections (smooth functions
            as CSV); default: by the ending.
        load: Force in N at the load point (tracker's axes) for costs and fit.
        frames: URDF: links for markers and load point.
        base_frame: Put the tracker's frame above the robot's base.
        joint_correction: Write the joint correction for simulators (CSV); the file is fitted
            with it.
        temperature_c: Temperature in °C to export at.
        time_s: Time in s, as in the data, to export at.
        poses: Random poses to find costs at.
    """
    from elastocal.export.export import export as exported
    from elastocal.export.export import write
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.terminal import print_blocks
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
    run.answer(
        lambda: {"output": str(output)} | done.to_json(),
        lambda screen: print_blocks(screen, _tell(done)),
    )


def _tell(done: Exported) -> Iterator[Block]:
    """What the file holds and what not, for people."""
    from elastocal.report.blocks import Sentence, ShownTable
    from elastocal.report.formatting import length

    def rounding(metres: float) -> str:  # what is below a nanometre is no number to read
        return "< 0.001 µm" if metres < 1e-9 else length(metres)

    cost, (name, in_title) = done.cost, NAMES[done.format]
    if cost.effects:
        every = [(e.effect.replace("_", " "), e.difference, e.note) for e in cost.effects]
        rows = []
        for effect, d, note in [*every, ("all of it", cost.total, "")]:
            sizes = () if d is None else (d.marker_rms, d.marker_max, d.flange_rms, d.flange_max)
            rows.append((effect, *([length(size) for size in sizes] or [""] * 4), note))
        heads = ("effect", "markers rms", "max", "flange rms", "max", "")
        yield ShownTable(heads, rows, (0, 5), title=f"What {in_title} cannot hold")
        yield Sentence(
            f"Costs: differences from the calibrated model at {cost.poses} random poses within the "
            f"joint {'ranges measured' if cost.measured else 'limits'} under "
            f"{_loads(cost)}, each effect left out alone."
        )
    else:
        yield Sentence(f"{name} holds all of the calibrated model.")
    if done.refit is not None:
        yield Sentence(_fit(done.refit))
    if done.checked is not None:
        yield Sentence(f"Read back with {done.checked_with}: {rounding(done.checked)} at most.")
    if done.without_beta is not None:
        yield Sentence(f"Without the column beta_rad: {rounding(done.without_beta)} at most.")
    if held := list(done.held):
        more = f" and {len(held) - 8} more" if len(held) > 8 else ""
        yield Sentence(
            "Not determined by the data, at the values that the identification predicts with: "
            f"{', '.join(held[:8])}{more}."
        )
    if done.of_the_measurement:
        left = ", ".join(done.of_the_measurement)
        yield Sentence(f"Left out, effects of the measurement: {left}.")
    for warning in done.warnings:
        yield Sentence(f"Note: {warning}.")
    if cost.total.marker_rms > WORTH_TELLING:
        yield Sentence(
            "Next: if that matters, elastocal compensate corrects it with the same cell and result."
        )


def _loads(cost: Cost) -> str:
    if len(cost.forces) == 1:
        return f"a load of ({', '.join(f'{v:g}' for v in cost.forces[0])}) N"
    sizes = [math.hypot(*force) for force in cost.forces]
    return f"the {len(sizes)} loads measured, {min(sizes):.4g} to {max(sizes):.4g} N"


def _fit(refit: Refit) -> str:
    """How far the file is from the arm."""
    from elastocal.report.formatting import length

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


# At the start of a sentence and in a title.
NAMES = {
    "urdf": ("The URDF", "a URDF"),
    "mjcf": ("The MJCF", "this MJCF"),
    **dict.fromkeys(("dh", "mdh"), ("The DH table", "a DH table")),
    **dict.fromkeys(("yaml", "json", "corrections"), ("Geometry alone", "geometry alone")),
}
