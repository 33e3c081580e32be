"""elastocal simulate and demo: measurements of a plan that were never made; the example."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import (
    CellFile,
    Json,
    Plugins,
    Quiet,
    Seed,
    check_apart,
    check_outputs,
    command,
    console,
)
from elastocal.errors import InputError
from elastocal.screen import progress_line, say
from elastocal.text import json_text


@command(short_help="Simulate the measurements of a plan")
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
    plugins: Plugins = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Simulate measurements from the cell's model, with chosen errors and noise.

    Example: elastocal simulate cell.toml plan.csv -o data.csv --set joint2.compliance=3e-7
    --load 0 0 -2600 --repeats 6
    """
    from elastocal.files import together
    from elastocal.model.manipulator import Model
    from elastocal.saving import write_json
    from elastocal.verbs import simulated

    written = check_outputs(output, truth)
    model = Model(cell, plugins=plugins)
    check_apart(written, [cell, plan], model.cell)
    poses = model.read_plan(plan)
    table, x = simulated(
        model, poses, values=dict(_assignment(text) for text in set_ or ()), draw=draw, load=load,
        repeats=repeats, noise=not no_noise, seed=seed,
    )  # fmt: skip
    planned = model.cell.design.loads
    if load is None and not table.force.any() and planned is not None and planned.any():
        say(
            f"Warning: {plan} states no load and none is given, so every reading is unloaded; the "
            "cell plans some ([design] loads_N): simulate one by --load",
            error=True,
        )
    named = dict(zip(model.names, x.tolist(), strict=True))
    with together(written):
        table.save(output)
        if truth is not None:
            write_json(truth, named)
    if as_json:
        summary = {"output": str(output), "readings": len(table), "poses": len(poses)}
        say(json_text(summary | {"seed": seed, "truth": named}))
        return
    say(f"wrote {len(table)} readings of {len(poses)} poses to {output}")


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise InputError(
            f"--set takes NAME=VALUE with a number in SI units; found '{text}'"
        ) from None


@command(short_help="Simulate and calibrate a KR 270 (Klimchik et al. 2013)")
def demo(
    folder: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="Folder for the example's files, data, result and report."
        ),
    ] = Path("demo_out"),
    seed: Seed = 2013,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """The KR 270 example of Klimchik et al. 2013, measured (simulated) and identified.

    Example: elastocal demo -o demo_out
    """
    from elastocal.cli.identify_command import write_results
    from elastocal.demo.example import run_demo

    with progress_line(quiet) as progress:
        done = run_demo(folder, seed, progress)
        report = folder / "report.html"
        inputs = [done.cell, done.plan, done.data]
        write_results(
            done.result, folder / "result.json", report, None, inputs, seed, done.truth,
            done.published,
        )  # fmt: skip
    if as_json:
        say(json_text(done.result.to_json() | {"truth": done.truth}))
        return
    from elastocal.report.terminal import print_result

    print_result(console(), done.result, truth=done.truth)
    say(
        f"\nTo repeat it by hand: elastocal identify {done.cell} {done.data} -o result.json\n"
        f"Report to open: {report.absolute()}"
    )
