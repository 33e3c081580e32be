"""elastocal import: tracker exports and joint logs → the measurement table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from elastocal.cli.app import console
from elastocal.cli.signatures import AnyOutput, Run, command
from elastocal.errors import InputError, require
from elastocal.screen import say
from elastocal.text import json_text

PRESET_NAMES = "spatialanalyzer, polyworks, leica, faro, spherical, wide, kuka, abb, ros"


@command(
    "import",
    short_help="Convert tracker exports and joint logs to the measurement table",
    flags="json",
)
def import_(
    files: Annotated[list[Path] | None, typer.Argument()] = None,
    output: AnyOutput = None,
    mapping: Annotated[Path | None, typer.Option("--map")] = None,
    preset: list[str] | None = None,
    show_preset: str | None = None,
    preview: bool = False,
    cell: Path | None = None,
    length_unit: str | None = None,
    angle_unit: str | None = None,
    *,
    run: Run,
) -> None:
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
    from elastocal.cell.work_cell import read_cell
    from elastocal.cli.import_preview import left_out, print_preview, summary
    from elastocal.importing.assemble import import_files
    from elastocal.importing.mapping_file import preset_text, read_mapping, with_units

    if show_preset is not None:
        say(preset_text(show_preset), end="")
        return
    paths = list(files or ())
    require(
        bool(paths),
        "the argument FILES is missing: the tracker's export, and the log of the joints",
    )
    require(
        output is not None or preview or run.json,
        "import needs -o data.csv to write to, or --preview to only look",
    )
    if mapping is None and not preset:
        raise InputError(
            f"import needs --map mapping.toml, or --preset: {PRESET_NAMES}{_suggestion(paths)}"
        )
    run.writes(output)
    run.reads(*paths, mapping, cell)
    read = with_units(read_mapping(mapping, preset or ()), length_unit, angle_unit)
    known = None if cell is None else read_cell(cell)
    run.reads(cell=known)
    found = import_files(paths, read, known, str(output or "the table"))
    if run.json:
        say(json_text(summary(found, output)))
    elif preview:
        print_preview(console(), found)
    else:
        for warning in found.warnings:
            say(f"Warning: {warning}", error=True)
        for line in left_out(found):
            say(line, error=True)
    if found.refused:
        raise InputError(found.refused)
    if output is None:
        return
    from elastocal.files import atomic_write_text

    atomic_write_text(output, found.text)
    if not run.json:
        table = found.table
        say(
            f"wrote {len(table)} readings of {len(table.configuration_labels)} configurations to "
            f"{output}"
        )


def _suggestion(paths: list[Path]) -> str:
    """The presets that read the files, as a hint."""
    from elastocal.importing.records import likely_presets

    told = []
    for path in paths:
        if path.is_file() and (found := likely_presets(path)):
            told.append(f"{path} as --preset {' or '.join(found)}")
    return f"; what reads your files: {', '.join(told)}" if told else ""
