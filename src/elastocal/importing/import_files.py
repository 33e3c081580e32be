"""From exported files to a validated measurement table: the whole of `elastocal import`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.importing.assemble import (
    Assembled,
    NominalFit,
    against_cell,
    assemble,
    plausibility,
    table_text,
    validated,
)
from elastocal.importing.joining import Joined, join, pooled, with_joints
from elastocal.importing.mapping_file import Mapping, SourceTable, UnitsTable
from elastocal.importing.records import (
    Records,
    Understood,
    is_spherical,
    read_records,
    with_labels,
    with_positions,
)
from elastocal.measurements import Measurements
from elastocal.text import listed, quoted


@dataclass(frozen=True)
class Imported:
    """What was read and made of it.

    `table` is the measurement table as `measurements.read_measurements` reads `text`;
    `refused` says why the robot of the cell cannot have measured it, "" where it can.
    """

    understood: tuple[Understood, ...]
    assembled: Assembled
    joined: Joined | None
    text: str
    table: Measurements
    warnings: tuple[str, ...]
    fit: NominalFit | None
    refused: str


def import_files(
    files: Sequence[Path], mapping: Mapping, cell: Cell | None = None, name: str = "data.csv"
) -> Imported:
    """Read `files` as `mapping` says, join, convert, and validate the measurement table.

    `cell`: the robot that the table must fit: number and kind of joints, markers, limits;
    `name`: what messages call the table.  Nothing is written.
    Raises InputError that names file, line, column, what was found and what to do.
    """
    where, table = mapping.path, mapping.table
    names: tuple[str, ...] = ()
    if cell is not None:
        from elastocal.model.choice import load_chain

        names = tuple(joint.name for joint in load_chain(cell).joints)
    units = table.units or UnitsTable()
    records: dict[str, list[Records]] = {"points": [], "joints": []}
    understood = []
    spherical = False
    for path, source in _assigned(where, files, mapping.sources):
        found = with_labels(where, read_records(where, path, source, units), source.names)
        spherical = spherical or is_spherical(found)
        found = with_positions(found, clockwise=source.azimuth == "clockwise")
        has_joints = any(stem[0] == "q" and stem[1:].isdigit() for stem in found.numbers)
        role = source.role or ("both" if "x" in found.numbers or "distance" in found.numbers
                               else "joints")  # fmt: skip
        if role in ("joints", "both") and has_joints:
            found = with_joints(where, found, table.joints, names)
        records["joints" if role == "joints" else "points"].append(found)
        understood.append(found.understood)
    if not records["points"]:
        raise InputError(
            f"{where}: no file with points among {listed(map(str, files), 5)}; add the tracker's "
            'export, or set role = "points" in its [[source]]'
        )
    points = pooled(records["points"])
    log = pooled(records["joints"]) if records["joints"] else None
    if log is not None and not log.q.shape[1]:
        raise InputError(
            f"{log.files[0]}: no joint values; map q1_deg … (or q#_deg) in its [source.columns]"
        )
    joined = None if log is None else join(where, points, log, table.join)
    made = assemble(where, points, log, joined, table)
    text = table_text(made)
    measured = validated(text, name, made, cell)
    fit, refused = against_cell(cell, measured, made, spherical) if cell is not None else (None, "")
    remarks = [] if joined is None else [r for r in joined.remarks if r.startswith("WARNING: ")]
    warnings = [*(r.removeprefix("WARNING: ") for r in remarks), *made.warnings]
    warnings += plausibility(made, measured, None if cell is None else cell.model.observe)
    if fit is not None and fit.warning:
        warnings.append(fit.warning)
    return Imported(tuple(understood), made, joined, text, measured, tuple(warnings), fit, refused)


def _assigned(
    where: str, files: Sequence[Path], sources: Sequence[SourceTable]
) -> list[tuple[Path, SourceTable]]:
    """Each file with the source that reads it.

    A file goes to the first source whose `files` pattern fits its name; sources without a pattern
    share the rest: one takes them all, several take one file each, in order.
    """
    if not files:
        raise InputError("no files to import; name the tracker's export and the joint log")
    observed: set[Path] = set()
    for path in files:
        if path in observed:
            raise InputError(f"{path}: named twice; name each file once")
        observed.add(path)
    chosen: dict[int, SourceTable] = {}
    for i, path in enumerate(files):
        for source in sources:
            if source.files and any(
                fnmatchcase(path.name, p) or fnmatchcase(str(path), p) for p in source.files
            ):
                chosen[i] = source
                break
    rest = [i for i in range(len(files)) if i not in chosen]
    for source in sources:
        if source.files and source not in chosen.values():
            raise InputError(
                f"{where}: no file fits files = {listed(map(quoted, source.files))}; the files are "
                f"{listed((p.name for p in files), 8)}"
            )
    free = [source for source in sources if not source.files]
    if len(free) == 1 and rest:
        chosen |= dict.fromkeys(rest, free[0])
    elif len(free) == len(rest):
        chosen |= dict(zip(rest, free, strict=True))
    else:
        left = listed((str(files[i]) for i in rest), 8)
        raise InputError(
            f"{where}: {len(free)} sources without a files pattern for {len(rest)} files "
            f'({left or "none left"}); give files = ["pattern"] in each [[source]], or one preset '
            "per file"
        )
    return [(path, chosen[i]) for i, path in enumerate(files)]
