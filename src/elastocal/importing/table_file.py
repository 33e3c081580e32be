"""The text of a measurement table, and its validation by the reader that will read it."""

from __future__ import annotations

import csv
import io
import re
import tempfile
from pathlib import Path

import numpy as np

from elastocal.cell import Cell
from elastocal.errors import InputError
from elastocal.importing.assemble import Assembled
from elastocal.measurements import Measurements, read_measurements


def table_text(made: Assembled) -> str:
    """The CSV of docs/file-formats.md; numbers with the digits that read back exactly."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(made.columns)
    writer.writerows(zip(*(_texts(values) for values in made.columns.values()), strict=True))
    return buffer.getvalue()


def _texts(values: object) -> list[str]:
    if isinstance(values, np.ndarray):
        return [repr(v + 0) for v in values.tolist()]
    return [str(v) for v in values]  # type: ignore[attr-defined]


def validated(text: str, name: str, made: Assembled, cell: Cell | None) -> Measurements:
    """The table as the reader of `identify` reads it.

    With `cell`, joints, markers and columns must be those that it asks for.  Raises InputError
    as the reader does, about the table `name`.
    """
    kinds = made.kinds
    markers: tuple[str, ...] = ()
    observe = "position" if any(c.startswith("x_") for c in made.columns) else "distance"
    if cell is not None:
        from elastocal.manipulator.choice import load_chain

        kinds = load_chain(cell).kinds
        markers = tuple(cell.tool.markers)
        observe = cell.model.observe
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        path.write_text(text, encoding="utf-8", newline="")
        try:
            table = read_measurements(
                path, joint_kinds=kinds, marker_names=markers, observe=observe
            )
        except InputError as error:
            message = str(error).replace(str(path), f"{name} (not written)")
            raise InputError(f"{message}{_meant(made, message)}") from None
    return table


def _meant(made: Assembled, message: str) -> str:
    """Where the line that a message names comes from."""
    found = re.search(r"line (\d+)", message)
    row = int(found[1]) - 2 if found else -1
    return f" (from {made.origin[row]})" if 0 <= row < len(made) else ""
