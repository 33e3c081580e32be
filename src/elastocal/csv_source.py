"""A measurement table from a CSV file: comma, semicolon or tab between columns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from elastocal.csv_cells import first_bad_cell
from elastocal.csv_lines import Dialect, count_rows, fields, read_header
from elastocal.errors import InputError
from elastocal.files import open_input
from elastocal.labels import in_order
from elastocal.measurement_header import Layout
from elastocal.raw_table import ChooseLayout, RawTable

if TYPE_CHECKING:
    import pandas as pd


def read_csv(path: str | Path, choose: ChooseLayout) -> RawTable:
    """The number and label columns that `choose` picks from the header.

    The header is judged before the rest is looked at, the lines before anything is parsed, so
    a large file that is no table is refused early and in little memory.
    Raises InputError that names file, line, column and the offending text.
    """
    source = str(path)
    with open_input(path, "measurement table") as handle:
        dialect = read_header(source, handle)
        layout = choose(dialect.header)
        lines = count_rows(source, handle, dialect)
        rows = np.frombuffer(lines.numbers, dtype=np.int64)
        if lines.truth_values and (problem := _find_bad_cell(source, handle, dialect, layout)):
            raise problem
        frame = _parse(source, handle, dialect, layout)
        numbers = {name: frame[name].to_numpy() for name in layout.numbers}
        if not all(np.isfinite(values).all() for values in numbers.values()):
            raise _bad_cell(source, handle, dialect, layout, "not finite")
    if len(frame) != len(rows):
        raise InputError(f"{source}: changed while it was read; try again")
    labels = {name: in_order(*frame[name].factorize()) for name in layout.labels}
    table = RawTable(source, "line", rows, layout, numbers, labels)
    table.check_labels()
    return table


def _parse(source: str, handle: BinaryIO, dialect: Dialect, layout: Layout) -> pd.DataFrame:
    import pandas as pd

    options: dict[str, Any] = {}
    if tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1):
        options["float_precision"] = "round_trip"  # from 3.1 on exact anyway, and deprecated
    # Not "category": pandas would take the labels 00 and 01 for the numbers 0 and 1.
    types: dict[str, Any] = dict.fromkeys(layout.numbers, np.float64)
    types |= dict.fromkeys(layout.labels, object)
    for decimal in "." if dialect.delimiter == "," else ".,":
        handle.seek(dialect.start)
        try:
            return pd.read_csv(
                handle,
                sep=dialect.delimiter,
                decimal=decimal,
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
                **options,
            )
        except MemoryError:
            raise InputError(
                f"{source}: too large for this computer's memory; split the table"
            ) from None
        except ValueError as error:
            reason = str(error)
    raise _bad_cell(source, handle, dialect, layout, reason)


def _bad_cell(
    source: str, handle: BinaryIO, dialect: Dialect, layout: Layout, reason: str
) -> InputError:
    return _find_bad_cell(source, handle, dialect, layout) or InputError(
        f"{source}: cannot be read as numbers ({reason}); check the table"
    )


def _find_bad_cell(
    source: str, handle: BinaryIO, dialect: Dialect, layout: Layout
) -> InputError | None:
    columns = {i: name for i, name in enumerate(dialect.header) if name in set(layout.numbers)}
    rows = fields(source, handle, dialect)
    return first_bad_cell(source, rows, columns, comma_allowed=dialect.delimiter != ",")
