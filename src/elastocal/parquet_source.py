"""A measurement table from a Parquet file, where pandas finds an engine to read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from elastocal.errors import InputError
from elastocal.files import open_input
from elastocal.labels import LabelCollector, Labels
from elastocal.raw_table import ChooseLayout, RawTable


def read_parquet(path: str | Path, choose: ChooseLayout) -> RawTable:
    """The number and label columns that `choose` picks from the column names; rows from 1.

    Raises InputError where no engine is installed, the file is damaged, or a value is missing
    or of the wrong type.
    """
    import pandas as pd

    source = str(path)
    with open_input(path, "measurement table") as handle:
        if handle.read(4) != b"PAR1":
            raise InputError(f"{source}: is not a Parquet file; check it, or name a CSV .csv")
    try:
        frame = pd.read_parquet(path)
    except ImportError:
        raise InputError(
            f"{source}: reading Parquet needs pyarrow; run 'pip install pyarrow', or save the "
            "table as CSV"
        ) from None
    except Exception as error:  # each engine has its own exceptions
        raise InputError(f"{source}: damaged Parquet file ({error}); write it again") from None
    layout = choose([str(name) for name in frame.columns])
    frame.columns = [str(name) for name in frame.columns]
    if not len(frame):
        raise InputError(f"{source}: has columns but no rows; add measurements")
    numbers, labels = {}, {}
    for name in layout.numbers:
        column = frame[name]
        if not pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
            raise InputError(
                f"{source}, column {name}: holds {column.dtype}, not numbers; convert it"
            )
        values = column.to_numpy(dtype=np.float64, na_value=np.nan)
        if not np.isfinite(values).all():
            i = int(np.argmin(np.isfinite(values)))
            raise InputError(
                f"{source}, row {i + 1}, column {name}: {values[i]} is not a finite number; "
                "drop the row, or measure again"
            )
        numbers[name] = values
    for name in layout.labels:
        labels[name] = _labels(source, name, frame[name])
    rows = np.arange(1, len(frame) + 1)
    table = RawTable(source, "row", rows, layout, numbers, labels)
    table.check_labels()
    return table


def _labels(source: str, name: str, column) -> Labels:  # type: ignore[no-untyped-def]
    if column.isna().any():
        i = int(np.argmax(column.isna().to_numpy()))
        raise InputError(
            f"{source}, row {i + 1}, column {name}: empty cell; write a name or number"
        )
    collector = LabelCollector()
    collector.add(*column.astype(str).factorize())
    return collector.labels()
