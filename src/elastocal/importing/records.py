"""One file as the mapping reads it: numbers with units, texts, times, and what was passed over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.importing.clock import Clock
from elastocal.importing.columns import Column, Wanted, lacking, no_header, resolve, wanted
from elastocal.importing.numbers import NumberCells
from elastocal.importing.patterns import unit_in_comments
from elastocal.importing.robot_text import krl_rows, rapid_rows
from elastocal.importing.schema import SourceTable, TextTable, UnitsTable
from elastocal.importing.table_text import SAMPLE, Table, table_rows
from elastocal.importing.text_file import Text, read_lines
from elastocal.importing.units import convert

Array = NDArray[np.float64]
MAX_ROWS = 2_000_000
DECIMAL_SAMPLE = 2000


@dataclass(frozen=True)
class Understood:
    """What was made of a file, for people.

    `columns`: (its name in the file, column of the measurement table, unit); `unused`: names of
    the file's other columns; `ignored`: (line, reason) of everything passed over.
    """

    path: str
    preset: str | None
    role: str
    encoding: str
    layout: str
    decimal: str
    columns: tuple[tuple[str, str, str], ...]
    unused: tuple[str, ...]
    rows: int
    ignored: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Records:
    """n rows of a file.  `line` (n,); `numbers` stem → (n,) in `units[stem]`; `texts` and
    `labels` (configuration, marker, repeat, load) → n texts; `time` (n,) s on the file's clock."""

    source: str
    line: NDArray[np.int64]
    numbers: dict[str, Array]
    units: dict[str, str]
    texts: dict[str, list[str]]
    time: Array | None
    understood: Understood
    load: str | None = None
    labels: dict[str, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.line)

    def where(self, i: int) -> str:
        """File and line of a row, as messages begin."""
        return f"{self.source}, line {self.line[i]}"

    def name(self, i: int) -> str:
        """The row's name in the file, or its line."""
        named = self.texts.get("name")
        return named[i] if named and named[i] else f"line {self.line[i]}"


def read_records(where: str, path: Path, source: SourceTable, units: UnitsTable) -> Records:
    """The rows of `path` as `source` of the mapping `where` describes them.

    A row with an empty cell where a number belongs is passed over and listed.
    Raises InputError that names file, line, column, what was found and what to do.
    """
    settings = source.text or TextTable()
    asked = wanted(where, source.columns or {}, source.optional or {})
    text = read_lines(path, settings.encoding or "auto")
    table = _table(text, settings, asked)
    rows = table.rows
    if len(rows.rows) > MAX_ROWS:
        raise InputError(f"{text.source}: more than {MAX_ROWS:,} rows; thin the export out")
    hint = unit_in_comments(where, settings.unit_comment, table.comments)
    width = len(rows.rows[0][1])
    columns = resolve(text.source, asked, rows.header, width, units, hint)
    numeric = [c for c in columns if not c.target.is_text]
    cells = NumberCells(
        settings.decimal or "auto",
        settings.thousands or "none",
        settings.missing or (),
        (row[c.index[0]] for _, row in rows.rows[:DECIMAL_SAMPLE]
         for c in numeric if c.index[0] < len(row)),
    )  # fmt: skip
    reader = _Reader(text.source, columns, cells, _formats(source))
    for number, row in rows.rows:
        reader.add(number, row)
    if not reader.line:
        number, reason = reader.ignored[0]
        raise InputError(
            f"{text.source}: none of its {len(rows.rows)} rows is complete (line {number}: "
            f"{reason}); correct the places in [source.columns]"
        )
    used = {i for c in columns for i in c.index}
    understood = Understood(
        path=text.source,
        preset=source.preset,
        role=source.role or "both",
        encoding=text.encoding,
        layout=_layout(settings, table),
        decimal=cells.decimal,
        columns=tuple((c.header, _filled(c), c.unit) for c in columns),
        unused=tuple(
            name or f"column {i + 1}" for i, name in enumerate(rows.header) if i not in used
        ),
        rows=len(reader.line),
        ignored=tuple(sorted([*rows.ignored, *reader.ignored])),
    )
    return reader.records(understood, source)


def _table(text: Text, settings: TextTable, asked: Wanted) -> Table:
    kind = settings.format or "table"
    if kind != "table":
        rows = (krl_rows if kind == "krl" else rapid_rows)(text)
        return Table(rows, 0, kind, ())
    guess = NumberCells("auto", settings.thousands or "none", settings.missing or (), ())
    places = [at for t, at in asked.required if not t.is_text and isinstance(at, int)]

    def is_header(cells: Sequence[str]) -> bool:
        return not lacking(asked, cells)

    def is_data(cells: Sequence[str]) -> bool:
        return all(at <= len(cells) and guess.looks_numeric(cells[at - 1]) for at in places)

    table = table_rows(text, settings, is_header if asked.by_name else None, is_data)
    if asked.by_name and not table.header_line:
        raise no_header(text.source, asked, table.rows.rows[:SAMPLE])
    return table


def _layout(settings: TextTable, table: Table) -> str:
    if (settings.format or "table") != "table":
        return {"krl": "KRL", "rapid": "RAPID"}[table.delimiter]
    head = f"header in line {table.header_line}" if table.header_line else "no header"
    mark = {"tab": "tabs", "space": "blanks"}.get(table.delimiter, f"{table.delimiter!r}")
    return f"columns split at {mark}, {head}"


def _filled(column: Column) -> str:
    stem, unit = column.target.stem, column.unit
    return f"{stem}_{unit}" if unit else stem


def _formats(source: SourceTable) -> tuple[str, ...]:
    given = source.time_format
    return () if given is None else (given,) if isinstance(given, str) else tuple(given)


class _Reader:
    """Gathers the cells of one file row by row."""

    def __init__(
        self, source: str, columns: Sequence[Column], cells: NumberCells, formats: Sequence[str]
    ) -> None:
        self.source, self.cells = source, cells
        self.clock = Clock(formats)
        self.line: list[int] = []
        self.ignored: list[tuple[int, str]] = []
        self.numeric = [c for c in columns if not c.target.is_text]
        self.textual = [c for c in columns if c.target.is_text]
        self.values: list[list[float]] = [[] for _ in self.numeric]
        self.texts: list[list[str]] = [[] for _ in self.textual]
        self.widest = max(columns, key=lambda c: max(c.index))

    def add(self, number: int, row: list[str]) -> None:
        if max(self.widest.index) >= len(row):
            raise InputError(
                f"{self.source}, line {number}: {len(row)} columns, but {self.widest.target.key} "
                f"is column {max(self.widest.index) + 1} ({self.widest.header}); correct the line, "
                "or pass over such lines with ignore in [source.text]"
            )
        found = []
        for column in self.numeric:
            cell = row[column.index[0]]
            try:
                value = self.cells.value(cell)
            except ValueError:
                raise self.cells.complaint(self.source, number, cell, column.header) from None
            if value is None:
                self.ignored.append((number, f"no value in column {column.header}"))
                return
            found.append(value)
        for values, value in zip(self.values, found, strict=True):
            values.append(value)
        for texts, column in zip(self.texts, self.textual, strict=True):
            glue = " " if column.target.stem == "time_text" else "::"
            texts.append(glue.join(row[i].strip() for i in column.index))
        self.line.append(number)

    def records(self, understood: Understood, source: SourceTable) -> Records:
        numbers: dict[str, Array] = {}
        units: dict[str, str] = {}
        time: Array | None = None
        for column, values in zip(self.numeric, self.values, strict=True):
            stem, array = column.target.stem, np.array(values, dtype=np.float64)
            if stem == "time":
                seconds = convert(array, column.unit, "s")
                time = seconds if time is None else time + seconds
                continue
            if stem.startswith("sigma_") and source.coverage_factor is not None:
                array = array / source.coverage_factor
            numbers[stem], units[stem] = array, column.unit
        texts = {c.target.stem: t for c, t in zip(self.textual, self.texts, strict=True)}
        written = texts.pop("time_text", None)
        if written is not None and time is None:
            time = self._times(written)
        line = np.array(self.line, dtype=np.int64)
        return Records(self.source, line, numbers, units, texts, time, understood, source.load)

    def _times(self, written: list[str]) -> Array:
        seconds = np.empty(len(written))
        for i, text in enumerate(written):
            try:
                seconds[i] = self.clock.seconds(text)
            except ValueError:
                raise self.clock.complaint(f"{self.source}, line {self.line[i]}", text) from None
        return seconds
