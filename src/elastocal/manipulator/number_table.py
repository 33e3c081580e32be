"""A small CSV of names and numbers with units in its header, checked cell by cell.

For robot descriptions of a few rows (DH tables, link masses); every complaint names file, row
(line in the file, header included) and column.  Rows that begin with # are comments.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from elastocal.errors import InputError
from elastocal.nearest import did_you_mean, listed

SI = {"rad": 1.0, "deg": math.pi / 180.0, "m": 1.0, "mm": 1e-3, "kg": 1.0}
MAX_BYTES = 10_000_000


@dataclass(frozen=True)
class Quantity:
    """A number column `header_unit`; columns of one `family` must be in the same unit.

    `name` is the key in Row.numbers; two quantities may share a header (limits in rad and in m).
    """

    name: str
    units: tuple[str, ...]
    family: str
    required: bool = True
    shared_header: str | None = None

    @property
    def header(self) -> str:
        return self.shared_header or self.name

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(f"{self.header}_{unit}" for unit in self.units)


@dataclass(frozen=True)
class Row:
    """One line: `where` names file and row; numbers in SI (None: blank); texts as written."""

    where: str
    numbers: Mapping[str, float | None]
    texts: Mapping[str, str]

    def require(self, quantity: str, column: str) -> float:
        """The number of a required quantity; InputError if its cell is blank."""
        value = self.numbers[quantity]
        if value is None:
            raise InputError(f"{self.where}, column {column}: blank; write a number, 0 if none")
        return value


@dataclass(frozen=True)
class Table:
    """`column_of`: quantity name → its column header in this file."""

    rows: tuple[Row, ...]
    column_of: Mapping[str, str]


def read_table(path: Path, quantities: Sequence[Quantity], texts: Sequence[str]) -> Table:
    """The rows of a CSV with the given number columns and optional text columns.

    Raises InputError for an unreadable or empty file, unknown, repeated, missing or unitless
    columns, mixed units, and cells that are not finite numbers.
    """
    lines = [(n, cells) for n, cells in _lines(path) if any(cell.strip() for cell in cells)]
    if not lines:
        example = ",".join(q.columns[0] for q in quantities if q.required)
        raise InputError(f"{path}: empty; the first row names the columns, e.g. {example}")
    header = [cell.strip() for cell in lines[0][1]]
    column_of = _match_columns(path, header, quantities, texts)
    rows = []
    for number, cells in lines[1:]:
        where = f"{path}: row {number}"
        if len(cells) != len(header):
            raise InputError(
                f"{where}: {len(cells)} cells, the header has {len(header)}; "
                "separate them by commas and write decimals with a point"
            )
        cell_of = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        values = {name: _value(where, col, cell_of[col]) for name, col in column_of.items()}
        rows.append(Row(where, values, {text: cell_of.get(text, "") for text in texts}))
    return Table(tuple(rows), column_of)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a directory; give the CSV file itself")
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: too large for a table of a few rows; check the path")
        text = path.read_text(encoding="utf-8-sig")
        reader = csv.reader(text.splitlines(), strict=True)
        lines = [(reader.line_num, cells) for cells in reader]
        return [(n, cells) for n, cells in lines if not (cells and cells[0].startswith("#"))]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; save it as CSV in UTF-8") from None
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None


def _match_columns(
    path: Path, header: list[str], quantities: Sequence[Quantity], texts: Sequence[str]
) -> dict[str, str]:
    if len(header) == 1 and ";" in header[0]:
        raise InputError(f"{path}: columns are separated by ';'; use commas")
    valid = [column for q in quantities for column in q.columns] + list(texts)
    for column in header:
        if header.count(column) > 1:
            raise InputError(f"{path}: column '{column}' appears twice; keep one")
        if column in valid:
            continue
        with_unit = [name for q in quantities if q.header == column for name in q.columns]
        if with_unit:
            raise InputError(
                f"{path}: column '{column}' has no unit; call it {' or '.join(with_unit)}"
            )
        raise InputError(
            f"{path}: unknown column '{column}'{did_you_mean(column, valid)}; "
            f"valid: {listed(valid)}"
        )
    column_of: dict[str, str] = {}
    unit_of: dict[str, tuple[str, str]] = {}
    for quantity in quantities:
        found = [column for column in quantity.columns if column in header]
        if len(found) > 1:
            raise InputError(f"{path}: columns {' and '.join(found)} say the same; keep one")
        if not found:
            if quantity.required:
                raise InputError(
                    f"{path}: no column {' or '.join(quantity.columns)}; columns found: "
                    f"{listed(header)}"
                )
            continue
        unit = found[0].rpartition("_")[2]
        other_unit, other = unit_of.setdefault(quantity.family, (unit, found[0]))
        if other_unit != unit:
            raise InputError(
                f"{path}: columns {other} and {found[0]} mix units; give both in the same unit"
            )
        column_of[quantity.name] = found[0]
    return column_of


def _value(where: str, column: str, text: str) -> float | None:
    if not text:
        return None
    try:
        value = float(text) if "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}, column {column}: '{text}' is not a finite number")
    return value * SI[column.rpartition("_")[2]]
