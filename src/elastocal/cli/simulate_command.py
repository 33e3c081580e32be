"""elastocal simulate and demo: measurements of a plan that were never made; the example."""

from __future__ import annotations

from pathlib import Path

from elastocal import verbs
from elastocal.cli.signatures import Asked, CellFile, Output, Run, Seed, command
from elastocal.errors import InputError
from elastocal.screen import say


@command(
    short_help="Simulate the measurements of a plan",
    verb=verbs.simulate,
    offers="draw load repeats seed",
    flags="plugins json",
)
def simulate(
    cell: CellFile,
    plan: Path,
    output: Output,
    set_: list[str] | None = None,
    truth: Path | None = None,
    no_noise: bool = False,
    *,
    asked: Asked,
    run: Run,
) -> None:
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
    from elastocal.files import together
    from elastocal.model.manipulator import Model
    from elastocal.saving import write_json

    run.writes(output, truth)
    model = Model(cell, plugins=run.plugins)
    run.reads(cell, plan, cell=model.cell)
    poses = model.read_plan(plan)
    values = dict(_assignment(text) for text in set_ or ())
    table, x = verbs.simulated(model, poses, **asked, values=values, noise=not no_noise)
    planned = model.cell.design.loads
    if "load" not in asked and not table.force.any() and planned is not None and planned.any():
        say(
            f"Warning: {plan} states no load and none is given, so every reading is unloaded; the "
            "cell plans some ([design] loads_N): simulate one by --load",
            error=True,
        )
    named = dict(zip(model.names, x.tolist(), strict=True))
    with together(run.written):
        table.save(output)
        if truth is not None:
            write_json(truth, named)
    summary = {"output": str(output), "readings": len(table), "poses": len(poses)}
    told = f"wrote {len(table)} readings of {len(poses)} poses to {output}"
    run.answer(
        lambda: summary | {"seed": asked["seed"], "truth": named}, lambda _: say(told), files=False
    )


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise InputError(
            f"--set takes NAME=VALUE with a number in SI units; found '{text}'"
        ) from None


@command(short_help="Simulate and calibrate a KR 270 (Klimchik et al. 2013)", flags="json quiet")
def demo(
    folder: Output = Path("demo_out"),
    seed: Seed = 2013,
    *,
    run: Run,
) -> None:
    """The KR 270 example of Klimchik et al. 2013, measured (simulated) and identified.

    Example: elastocal demo -o demo_out

    Args:
        folder: Folder for the example's files, data, result and report.
    """
    from elastocal.cli.identify_command import write_results
    from elastocal.demo.example import run_demo
    from elastocal.report.terminal import print_report

    with run.progress() as progress:
        done = run_demo(folder, seed, progress)
        report = folder / "report.html"
        inputs = [done.cell, done.plan, done.data]
        write_results(
            done.result, folder / "result.json", report, None, inputs, seed, done.truth,
            done.published,
        )  # fmt: skip
    if run.answer(
        lambda: done.result.to_json() | {"truth": done.truth},
        lambda screen: print_report(screen, done.result, details=False, truth=done.truth),
    ):
        say(
            f"\nTo repeat it by hand: elastocal identify {done.cell} {done.data} -o result.json\n"
            f"Report to open: {report.absolute()}"
        )
