"""Which cell is it?  The first cell of a table that is no finite number, told in a sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

from elastocal.errors import InputError
from elastocal.nearest import quoted

NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][+-]?[0-9]+)?")
NOT_FINITE = re.compile(r"[+-]?(nan|na|n/a|null|none|inf|infinity|#n/?a|#num!)", re.IGNORECASE)
THOUSANDS = re.compile(r"[+-]?[0-9]+([.,' ][0-9]{3})*[.,][0-9]+")


def first_bad_cell(
    source: str,
    rows: Iterable[tuple[int, list[str]]],
    columns: Mapping[int, str],
    comma_allowed: bool,
) -> InputError | None:
    """What is wrong with the first bad cell of `rows` (line number, cells), or None.

    `columns`: field index → header of the number columns; `comma_allowed`: decimal commas may
    be used, then everywhere in the file.
    """
    marks: dict[str, str] = {}
    for number, cells in rows:
        for i, header in columns.items():
            cell = cells[i].strip()
            problem = _problem(cell, comma_allowed)
            if problem is None:
                mark = next((m for m in ".," if m in cell), None)
                if mark:
                    marks.setdefault(mark, f"line {number}, column {header}: {quoted(cell)}")
                if len(marks) < 2:
                    continue
                point, comma = marks["."], marks[","]
                return InputError(
                    f"{source}: decimal points ({point}) and decimal commas ({comma}) in one "
                    "file; use one of them throughout"
                )
            return InputError(f"{source}, line {number}, column {header}: {problem}")
    return None


def _problem(cell: str, comma_allowed: bool) -> str | None:
    if not cell:
        return "empty cell; fill it in, or drop the line"
    if NUMBER.fullmatch(cell):
        if "," in cell and not comma_allowed:
            return f"{quoted(cell)} has a decimal comma; write a point, or separate columns by ';'"
        if math.isfinite(float(cell.replace(",", "."))):
            return None
        return f"{quoted(cell)} is too large to be a number here; correct it"
    if NOT_FINITE.fullmatch(cell):
        return f"{quoted(cell)} is not a finite number; drop the line, or measure again"
    if THOUSANDS.fullmatch(cell):
        return f"{quoted(cell)} has thousands separators; write it without them"
    return f"{quoted(cell)} is not a number; correct it"
