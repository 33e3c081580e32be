"""A measurement table from a CSV file: comma, semicolon or tab between columns."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from elastocal.csv_cells import first_bad_cell
from elastocal.csv_lines import Chunk, Dialect, chunks, fields, read_header
from elastocal.errors import InputError
from elastocal.files import open_input
from elastocal.labels import LabelCollector
from elastocal.measurement_header import Layout
from elastocal.raw_table import ChooseLayout, RawTable

if TYPE_CHECKING:
    import pandas as pd


def read_csv(path: str | Path, choose: ChooseLayout) -> RawTable:
    """The number and label columns that `choose` picks from the header.

    The header is judged before the rest is looked at, and the rest is read in chunks, so a
    large file that is no table is refused early and in little memory.
    Raises InputError that names file, line, column and the offending text.
    """
    source = str(path)
    with open_input(path, "measurement table") as handle:
        dialect = read_header(source, handle)
        layout = choose(dialect.header)
        parser = _Parser(source, handle, dialect, layout)
        rows: list[np.ndarray] = []
        numbers: dict[str, list[np.ndarray]] = {name: [] for name in layout.numbers}
        labels = {name: LabelCollector() for name in layout.labels}
        for chunk in chunks(source, handle, dialect):
            frame = parser.parse(chunk)
            rows.append(np.array(chunk.numbers, dtype=np.int64))
            for name in layout.numbers:
                numbers[name].append(frame[name].to_numpy())
            for name in layout.labels:
                labels[name].add(*frame[name].factorize())
    table = RawTable(
        source,
        "line",
        np.concatenate(rows),
        layout,
        {name: np.concatenate(numbers.pop(name)) for name in layout.numbers},
        {name: collector.labels() for name, collector in labels.items()},
    )
    table.check_labels()
    return table


class _Parser:
    """Chunks of text → data frames, with one decimal mark throughout the file."""

    def __init__(self, source: str, handle: BinaryIO, dialect: Dialect, layout: Layout) -> None:
        import pandas as pd

        self.source, self.handle, self.dialect = source, handle, dialect
        self.decimals = "." if dialect.delimiter == "," else ".,"
        self.first = True
        self.columns = {
            i: name for i, name in enumerate(dialect.header) if name in set(layout.numbers)
        }
        # Not "category": pandas would take the labels 00 and 01 for the numbers 0 and 1.
        types: dict[str, Any] = dict.fromkeys(layout.numbers, np.float64)
        types |= dict.fromkeys(layout.labels, object)
        self.options: dict[str, Any] = dict(
            sep=dialect.delimiter,
            header=None,
            names=list(dialect.header),
            usecols=list(types),
            index_col=False,
            dtype=types,
            na_filter=False,
            keep_default_na=False,
            skipinitialspace=True,
            engine="c",
            encoding="utf-8",
        )
        if tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1):
            self.options["float_precision"] = "round_trip"  # from 3.1 on always so, and deprecated

    def parse(self, chunk: Chunk) -> pd.DataFrame:
        """The columns of a chunk, numbers finite; raises InputError for the first bad cell."""
        if chunk.truth_values and (problem := self._problem([chunk])):
            raise problem
        frame = self._frame(chunk)
        if not all(np.isfinite(frame[name].to_numpy()).all() for name in self.columns.values()):
            raise self._problem([chunk]) or self._unclear("not finite")
        self.first = False
        return frame

    def _frame(self, chunk: Chunk) -> pd.DataFrame:
        import pandas as pd

        reason = "no decimal mark fits"
        for decimal in self.decimals:
            try:
                frame = pd.read_csv(BytesIO(chunk.data), decimal=decimal, **self.options)
            except ValueError as error:
                reason = str(error)
                continue
            if len(frame) != len(chunk.numbers):
                raise self._unclear("line ends")
            if decimal == "," and len(self.decimals) > 1:
                # Earlier chunks were read with points: fine only if they had none.
                if not self.first and (problem := self._problem_anywhere()):
                    raise problem
                self.decimals = ","
            return frame
        raise self._problem([chunk]) or self._problem_anywhere() or self._unclear(reason)

    def _problem_anywhere(self) -> InputError | None:
        here = self.handle.tell()
        try:
            return self._problem(chunks(self.source, self.handle, self.dialect))
        finally:
            self.handle.seek(here)

    def _problem(self, some: Iterable[Chunk]) -> InputError | None:
        rows = (row for chunk in some for row in fields(self.source, chunk, self.dialect))
        comma_allowed = self.dialect.delimiter != ","
        return first_bad_cell(self.source, rows, self.columns, comma_allowed)

    def _unclear(self, reason: str) -> InputError:
        return InputError(f"{self.source}: cannot be read as a table ({reason}); check its format")
