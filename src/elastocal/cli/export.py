"""elastocal export: the calibrated arm for other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from elastocal.errors import InputError

if TYPE_CHECKING:
    from elastocal.export.export import Exported


@app.command()
@reporting_errors
def export(
    cell: CellFile,
    result: Annotated[Path, typer.Argument(help="Result of identify (JSON).")],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="File to write: .urdf, .xml or .mjcf, .csv (DH), .yaml, .json."
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(help="urdf, mjcf, dh, mdh (modified DH), yaml, json; default: by the ending."),
    ] = None,
    load: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Force in N at the load point (tracker's axes) to state costs under."),
    ] = None,
    frames: Annotated[
        bool,
        typer.Option("--frames/--no-frames", help="URDF: links for markers and load point."),
    ] = True,
    base_frame: Annotated[
        bool,
        typer.Option("--base-frame", help="Put the tracker's frame above the robot's base."),
    ] = False,
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
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Write the calibrated arm as URDF, MJCF, DH table or parameters, and say what that loses.

    Example: elastocal export cell.toml result.json -o calibrated.urdf --load 0 0 -2600
    """
    import numpy as np

    from elastocal.export.export import Wish
    from elastocal.export.export import export as run
    from elastocal.export.formats import format_of
    from elastocal.export.kept import Conditions
    from elastocal.export.urdf import Frames
    from elastocal.files import atomic_write_text
    from elastocal.manipulator.calibrated import read_calibrated

    chosen = format_of(output, format)
    check_outputs(output)
    for name, value in (("--temperature-c", temperature_c), ("--time-s", time_s)):
        if value is not None and not np.isfinite(value):
            raise InputError(f"{name} takes a finite number; found {value}")
    force = np.zeros(3) if load is None else np.array(load)
    if not np.isfinite(force).all():
        raise InputError(f"--load takes three finite numbers in N; found {force.tolist()}")
    wish = Wish(
        format=chosen,
        frames=Frames(tool=frames, base=base_frame),
        conditions=Conditions(force, time_s, temperature_c),
        poses=poses,
        seed=seed,
    )
    with progress_line(quiet) as progress:
        progress("reading")
        calibrated = read_calibrated(cell, result)
        _keep_inputs(output, cell, result, calibrated.model.cell.robot)
        done = run(calibrated, wish, progress)
    atomic_write_text(output, done.text)
    if as_json:
        typer.echo(json.dumps({"output": str(output)} | done.to_json(), indent=1, allow_nan=False))
        return
    _tell(done)
    typer.echo(f"wrote {output}")


def _keep_inputs(output: Path, *inputs: object) -> None:
    """Refuse to write over what the calibration was read from."""
    for given in inputs:
        paths = [given] if isinstance(given, Path) else [given.urdf, given.dh]  # type: ignore[attr-defined]
        for path in paths:
            if path is not None and output.exists() and output.samefile(path):
                raise InputError(
                    f"{output}: is an input of this export; write to another file, so that the "
                    "nominal robot is kept"
                )


def _tell(done: Exported) -> None:
    from elastocal.report.console_table import titled
    from elastocal.report.units import length
    from elastocal.report.words import printable

    screen = console()

    def say(text: str) -> None:
        screen.print(printable(text), markup=False)

    cost = done.cost
    if cost.effects:
        table = titled(f"What {NAMES[done.format]} cannot hold")
        for head in ("effect", "markers rms", "max", "flange rms", "max", ""):
            table.add_column(head, justify="left" if head in ("effect", "") else "right")
        for e in cost.effects:
            d = e.difference
            cells = [""] * 4 if d is None else [length(v) for v in (
                d.marker_rms, d.marker_max, d.flange_rms, d.flange_max)]  # fmt: skip
            table.add_row(printable(e.effect.replace("_", " ")), *cells, printable(e.note))
        t = cost.total
        total = [length(v) for v in (t.marker_rms, t.marker_max, t.flange_rms, t.flange_max)]
        table.add_section()
        table.add_row("all of it", *total, "")
        screen.print(table)
    else:
        say(f"{NAMES[done.format].capitalize()} holds all of the calibrated model.")
    force = ", ".join(f"{v:g}" for v in cost.force)
    say(
        f"Costs: differences from the calibrated model at {cost.poses} random poses within the "
        f"joint limits under a load of ({force}) N, each effect left out alone."
    )
    if done.checked is not None:
        say(f"Read back with {done.checked_with}: {length(done.checked)} at most.")
    if done.without_beta is not None:
        say(f"Without the column beta_rad: {length(done.without_beta)} at most.")
    if done.held:
        names = list(done.held)
        shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        say(
            f"Held, as the data do not determine them on their own, at the values that the "
            f"identification predicts with: {shown}."
        )
    if done.of_the_measurement:
        say(
            f"Not of the arm and left out: {', '.join(done.of_the_measurement)} "
            "(of the measurement)."
        )
    for warning in done.warnings:
        say(f"Note: {warning}.")


NAMES = {
    "urdf": "a URDF",
    "mjcf": "this MJCF",
    "dh": "a DH table",
    "mdh": "a DH table",
    "yaml": "geometry alone",
    "json": "geometry alone",
}
