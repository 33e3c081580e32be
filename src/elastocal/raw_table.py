"""Columns of numbers and labels as a file holds them, before units and rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.labels import Labels, is_label
from elastocal.measurement_header import Layout
from elastocal.nearest import quoted

ChooseLayout = Callable[[Sequence[str]], Layout]


@dataclass(frozen=True)
class RawTable:
    """n rows; `row` (n,) is the line (CSV) or row (Parquet) in the file, `noun` says which.

    `numbers`: header → (n,) finite floats in the file's unit; `labels`: header → Labels.
    """

    source: str
    noun: str
    row: NDArray[np.int64]
    layout: Layout
    numbers: Mapping[str, NDArray[np.float64]]
    labels: Mapping[str, Labels]

    def where(self, i: int, header: str) -> str:
        """File, line and column of row i, as messages begin."""
        return f"{self.source}, {self.noun} {self.row[i]}, column {header}"

    def check_labels(self) -> None:
        """Raises InputError for the first label that is empty or has control characters."""
        for header, labels in self.labels.items():
            for code, name in enumerate(labels.names):
                if not is_label(name):
                    i = int(np.argmax(labels.codes == code))
                    what = f"{quoted(name)} has control characters" if name else "empty cell"
                    raise InputError(f"{self.where(i, header)}: {what}; write a name or number")
