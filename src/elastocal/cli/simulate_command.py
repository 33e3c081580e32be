"""elastocal simulate and demo: campaigns that were never measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
from elastocal.errors import InputError, require
from elastocal.text import json_text

# elastocal simulate: synthetic measurements of a plan.


@app.command(short_help="What would I measure, if …?")
@reporting_errors
def simulate(
    cell: CellFile,
    plan: Annotated[Path, typer.Argument(help="Poses (CSV): configuration, q1_deg, …")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Measurements to write (CSV).")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="True value in SI units; repeatable."),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="Write the true values used, as JSON {name: value}.")
    ] = None,
    draw: Annotated[
        float,
        typer.Option(
            metavar="FACTOR", help="Draw true values: typical size times this, at random."
        ),
    ] = 0.0,
    load: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z", help="Measure every pose unloaded and under this force in N."
        ),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Readings per pose and load state.")] = 1,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Exact readings.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Synthetic measurements from the cell's model, with chosen errors and noise.

    Example: elastocal simulate cell.toml plan.csv -o data.csv --set joint2.compliance=3e-7
    --load 0 0 -2600 --repeats 6
    """
    import numpy as np

    from elastocal.files import atomic_write_text
    from elastocal.identification.start import check_limits
    from elastocal.measurements import write_measurements
    from elastocal.model.arm import given_force
    from elastocal.model.manipulator import Model
    from elastocal.simulation.simulate import draw_errors, expand_plan, values_from
    from elastocal.simulation.simulate import simulate as run

    force = given_force(load)
    require(
        0 <= draw < float("inf"),
        f"--draw takes a factor of the typical sizes, 0 or more; found {draw:g}",
    )
    check_outputs(output, truth)
    model = Model(cell)
    check_apart([output, truth], [cell, plan, *files_of(model.cell)])
    poses = model.read_plan(plan)
    check_limits(model, poses)
    rng = np.random.default_rng(seed)
    values = draw_errors(model, draw, rng) if draw else {}
    values |= dict(_assignment(text) for text in set_ or ())
    x = values_from(model, values)
    rows = expand_plan(poses, tuple(model.cell.tool.markers), repeats, force)
    table = run(model, rows, x, rng, noise=not no_noise)
    write_measurements(table, output, model.chain.kinds)
    named = dict(zip(model.names, (float(v) for v in x), strict=True))
    if truth is not None:
        atomic_write_text(truth, json_text(named) + "\n")
    if as_json:
        summary = {"output": str(output), "readings": len(table), "poses": len(poses)}
        typer.echo(json_text(summary | {"seed": seed, "truth": named}))
        return
    typer.echo(f"wrote {len(table)} readings of {len(poses)} poses to {output}")


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise InputError(
            f"--set takes NAME=VALUE with a number in SI units; found '{text}'"
        ) from None


# elastocal demo: the worked example.


@app.command(short_help="See a KR 270 simulated and calibrated (Klimchik et al. 2013).")
@reporting_errors
def demo(
    folder: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the example's files.")
    ] = Path("demo_out"),
    seed: Seed = 2013,
    as_json: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """The KR 270 example of Klimchik et al. 2013, measured (simulated) and identified.

    Example: elastocal demo -o demo_out
    """
    from elastocal.cli.outputs import write_results
    from elastocal.demo import run_demo

    with progress_line(quiet) as progress:
        done = run_demo(folder, seed, progress)
        report = folder / "report.html"
        inputs = [done.cell, done.plan, done.data]
        write_results(
            done.result, folder / "result.json", report, None, inputs, done.truth, seed,
            done.published,
        )  # fmt: skip
    if as_json:
        typer.echo(json_text(done.result.to_json() | {"truth": done.truth}))
        return
    from elastocal.report.terminal import print_result

    print_result(console(), done.result, truth=done.truth)
    typer.echo(
        f"\nTo repeat it by hand: elastocal identify {done.cell} {done.data} -o result.json\n"
        f"Report to open: {report.absolute()}"
    )
