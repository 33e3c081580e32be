"""elastocal compare: what has changed since the last calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import repeated
from elastocal.cli.signatures import FORCE, JsonFile, ReportFile, Run, Seed, command
from elastocal.errors import InputError
from elastocal.screen import complain


@command(short_help="What has changed since the last calibration?")
def compare(
    cell: Path,
    old: Path,
    new: Annotated[Path | None, typer.Argument()] = None,
    cell_of_old: Annotated[Path | None, typer.Option("--cell", hidden=True)] = None,
    output: JsonFile = None,
    report: ReportFile = None,
    load: FORCE | None = None,
    level: float = 0.05,
    poses: Annotated[int, typer.Option(min=2, max=100_000)] = 300,
    seed: Seed = 0,
    *,
    run: Run,
) -> None:
    """What has changed between two calibrations: by parameter, and how far the tool moved.

    Example: elastocal compare cell.toml january.json june.json --report changes.html

    Args:
        cell: Cell file (TOML) of both.
        old: Result of identify (JSON), the earlier one.
        new: Result of identify (JSON), the later one.
        cell_of_old: Cell file of both, in the old order OLD NEW.
        load: Force in N at the load point (tracker's axes); default: the measured loads.
        level: Probability of any finding if nothing has changed.
        poses: Random poses.
    """
    from elastocal.diagnosis.changes import compare as compared
    from elastocal.files import together
    from elastocal.model.calibrated import read_calibrated
    from elastocal.report.terminal import print_report
    from elastocal.saving import write_json

    if old_order := new is None:
        cell, old, new = _in_old_order(cell, old, cell_of_old)
    run.writes(output, report)
    inputs = run.reads(cell, old, new)
    with run.progress() as progress:
        progress("reading")
        arms = [read_calibrated(cell, path, run.plugins) for path in (old, new)]
        if old_order:
            complain(f"the cell comes first now: elastocal compare {cell} {old} {new}")
        run.reads(cell=arms[0].model.cell)
        progress("comparing")
        found = compared(*arms, load=load, level=level, poses=poses, seed=seed)
    with together(run.written):
        if output is not None:
            write_json(output, found.to_json())
        if report is not None:
            found.report(report, inputs=inputs, command=repeated(), seed=seed)
    run.answer(found.to_json, lambda screen: print_report(screen, found))


def _in_old_order(old: Path, new: Path, cell: Path | None) -> tuple[Path, Path, Path]:
    """Cell and both results where the cell does not come first, as it once did not."""
    if old.suffix.lower() == ".toml":
        raise InputError(
            f"the argument NEW is missing: elastocal compare {old} {new} NEW, the later result"
        )
    known = old.parent / "cell.toml" if cell is None else cell
    if cell is None and not known.is_file():
        raise InputError(
            f"there is no cell.toml beside {old}; name the cell first: elastocal compare CELL "
            f"{old} {new}"
        )
    return known, old, new
