"""Number cells: decimal points or commas, thousands separators, cells without a value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from elastocal.csv_lines import NUMBER, first_bad_cell
from elastocal.errors import InputError
from elastocal.text import quoted

MISSING = ("", "-", "--", "---", "n/a", "na", "nan", "none", "null")


class NumberCells:
    """How the numbers of one file are written."""

    def __init__(
        self, decimal: str, thousands: str, missing: Sequence[str], sample: Iterable[str]
    ) -> None:
        self.thousands = "" if thousands == "none" else thousands
        self.missing = {*MISSING, *(text.strip().casefold() for text in missing)}
        self.decimal = decimal
        if decimal == "auto":
            bare = [self._bare(cell) for cell in sample]
            # Where a cell has both, the last is the decimal mark and the other is told as wrong.
            both = next((cell for cell in bare if "." in cell and "," in cell), None)
            points = any("." in cell for cell in bare)
            commas = any("," in cell for cell in bare)
            self.decimal = "," if commas and not points else "."
            if both is not None:
                self.decimal = max(".,", key=both.rfind)

    def _bare(self, cell: str) -> str:
        text = cell.strip()
        return text.replace(self.thousands, "") if self.thousands else text

    def looks_numeric(self, cell: str) -> bool:
        """Whether a cell can be a number in some way of writing."""
        bare = self._bare(cell)
        return bool(NUMBER.fullmatch(bare)) or bare.casefold() in self.missing - {""}

    def value(self, cell: str) -> float | None:
        """The number, None for a cell without a value.  Raises ValueError for anything else."""
        text = self._bare(cell)
        if self.decimal == ",":
            if "." in text:
                raise ValueError(cell)
            text = text.replace(",", ".")
        try:
            number = float(text)
        except ValueError:
            if text.casefold() in self.missing:
                return None
            raise
        if "_" in text:  # float takes 1_000
            raise ValueError(cell)
        if math.isnan(number):
            return None
        if math.isinf(number):
            raise ValueError(cell)
        return number

    def complaint(self, source: str, number: int, cell: str, header: str) -> InputError:
        """What to say of a cell that `value` did not take."""
        where = f"{source}, line {number}, column {header}"
        if self.decimal == "," and "." in cell:
            return InputError(
                f"{where}: {quoted(cell)} has a decimal point, but the file is read with decimal "
                "commas; set decimal or thousands in [source.text]"
            )
        if self.decimal == "." and "," in cell and NUMBER.fullmatch(cell.strip()):
            return InputError(
                f"{where}: {quoted(cell)} has a comma, but the file is read with decimal points; "
                'set decimal = "," or thousands = "," in [source.text]'
            )
        found = first_bad_cell(source, [(number, [self._bare(cell)])], {0: header}, True)
        advice = "if such lines are no readings, pass over them with ignore in [source.text]"
        return InputError(f"{found or f'{where}: {quoted(cell)} is not a number'}; {advice}")
