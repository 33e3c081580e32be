"""elastocal compensate: commands that put the real tool at its targets."""

from __future__ import annotations

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
from elastocal.cli.design_command import check_apart, files_of
from elastocal.errors import require
from elastocal.text import json_text

if TYPE_CHECKING:
    from elastocal.compensation.tool import Targets
    from elastocal.model.calibrated import CalibratedArm
    from elastocal.units import Array


@app.command()
@reporting_errors
def compensate(
    cell: CellFile,
    result: Annotated[Path, typer.Argument(help="Result of identify -o (JSON).")],
    targets: Annotated[
        Path | None,
        typer.Argument(help="Targets (CSV): x_mm, y_mm, z_mm, rx_deg, …, or q1_deg, …"),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Commands to write (CSV).")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z[,RX,RY,RZ]", help="One target instead, in mm and degrees."),
    ] = None,
    frame: Annotated[
        str, typer.Option(help="Frame of targets and forces: base (as identified) or tracker.")
    ] = "base",
    point: Annotated[
        str | None,
        typer.Option(
            metavar="POINT",
            help="Point of the tool: a marker, or x,y,z in m in the flange frame.",
        ),
    ] = None,
    load: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z", help="Force in N at the load point where the table states none."
        ),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(
            metavar="Q1,Q2,…",
            help="Joints in degrees (mm where prismatic) whose posture to begin near.",
        ),
    ] = None,
    partial: Annotated[
        bool, typer.Option("--partial", help="Write what is reached; leave other rows empty.")
    ] = False,
    table: Annotated[
        Path | None, typer.Option(help="Correction table to write (CSV), over --grid.")
    ] = None,
    grid: Annotated[
        str,
        typer.Option(metavar="N[,N…]", help="Levels per joint (or of x, y, z): 5 or 9,7,7,3,3,1."),
    ] = "5",
    box: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,Z0,X1,Y1,Z1",
            help="Grid over this box in mm in the base frame, not over the joints.",
        ),
    ] = None,
    rotation: Annotated[
        str | None,
        typer.Option(metavar="RX,RY,RZ", help="Rotation vector of the tool in --box, in degrees."),
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Which commands put the tool where it shall be?

    Solves the calibrated arm, under its load, for every target.  With --table it writes the
    corrections that a controller adds to its nominal targets.

    Example: elastocal compensate cell.toml result.json targets.csv -o commands.csv
    """
    from elastocal.cli.outputs import commands_of, read_near, read_table_grid, table_of
    from elastocal.compensation.tool import tool_point
    from elastocal.files import atomic_write_text
    from elastocal.model.arm import given_force
    from elastocal.model.calibrated import read_calibrated

    # What can be wrong with the options is told before any file is read.
    _check_targets(targets, target, frame, output, table)
    _check_grid(table, grid, box, rotation)
    force = given_force(load)
    written = [path for path in (output, table) if path is not None]
    check_outputs(*written)
    content, texts = {}, {}
    with progress_line(quiet) as progress:
        progress("reading")
        arm = read_calibrated(cell, result)
        check_apart(written, [cell, result, targets, *files_of(arm.model.cell)])
        where = tool_point(arm.model.cell, point)
        start = read_near(arm, near)
        lines = read_table_grid(arm, grid, box, rotation) if table is not None else None
        wanted = _targets(arm, targets, target, frame, force)
        if wanted is not None:
            from elastocal.compensation.compensate import compensate as run

            found = run(arm, wanted, where, start, seed, progress)
            content["commands"], text = commands_of(found, arm, output is None, partial)
            if output is not None:
                texts[output] = text
        if table is not None and lines is not None:
            from elastocal.compensation.correction_table import correction_table

            corrections = correction_table(arm, lines, where, force, start, seed, progress)
            content["table"], texts[table] = table_of(corrections, arm, partial)
        # Nothing is written before every answer is there: a refused table leaves no commands.
        for path, text in texts.items():
            atomic_write_text(path, text)
    if as_json:
        both = content.get("commands", {}) | {k: v for k, v in content.items() if k == "table"}
        typer.echo(json_text(both))
        return
    from elastocal.report.terminal import print_compensation

    print_compensation(console(), content)
    for path in written:
        typer.echo(f"wrote {path}")
    if output is not None:
        typer.echo(
            f"Next: run the commands of {output.name} (its q columns) and measure some: the tool "
            "should lie within two or three std_um, and the tracker's noise, of its targets."
        )


def _check_targets(
    targets: Path | None, target: str | None, frame: str, output: Path | None, table: Path | None
) -> None:
    from elastocal.compensation.tool import FRAMES

    require(frame in FRAMES, f"--frame takes base or tracker; found '{frame}'")
    require(
        targets is not None or target is not None or table is not None,
        "nothing to compensate: name a table of targets, or give --target x,y,z or --table FILE",
    )
    require(
        targets is None or target is None,
        f"both {targets} and --target are given; drop one of them",
    )
    require(
        output is None or targets is not None or target is not None,
        "-o writes the commands of targets; name a table of them, or give --target",
    )


def _check_grid(table: Path | None, grid: str, box: str | None, rotation: str | None) -> None:
    require(
        table is not None or (box is None and rotation is None and grid == "5"),
        "--grid, --box and --rotation belong to a correction table; give --table FILE",
    )
    require(rotation is None or box is not None, "--rotation belongs to --box")


def _targets(
    arm: CalibratedArm, path: Path | None, target: str | None, frame: str, force: Array | None
) -> Targets | None:
    from elastocal.compensation.tool import one_target, read_targets

    if path is not None:
        return read_targets(path, arm.model.chain.kinds, frame, force)  # type: ignore[arg-type]
    return None if target is None else one_target(target, frame, force)  # type: ignore[arg-type]
