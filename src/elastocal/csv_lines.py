"""The lines and cells of a CSV file: bounded, checked, counted, before anything is parsed."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import BinaryIO

from elastocal.errors import InputError
from elastocal.files import decoded
from elastocal.text import quoted

MAX_LINE = 64 * 1024
MAX_BLANK_LINES = 10_000
MAX_ROWS = 5_000_000
CHUNK_BYTES = 1 << 20
DELIMITERS = ",;\t"
BOM = b"\xef\xbb\xbf"
UTF16 = (b"\xff\xfe", b"\xfe\xff")
ARCHIVE = b"PK\x03\x04"
# pandas takes True and False for 1 and 0; "true" in any case it knows has one of these in it.
TRUTH_VALUES = (b"rue", b"RUE", b"alse", b"ALSE")
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][+-]?[0-9]+)?")
NOT_FINITE = re.compile(r"[+-]?(nan|na|n/a|null|none|inf|infinity|#n/?a|#num!)", re.IGNORECASE)
THOUSANDS = re.compile(r"[+-]?[0-9]+([.,' ][0-9]{3})*[.,][0-9]+")


@dataclass(frozen=True)
class Chunk:
    """Some consecutive data lines: their text and their `numbers` in the file.

    `truth_values`: whether True or False may stand in one of them.
    """

    data: bytes
    numbers: array[int]
    truth_values: bool


class CsvLines:
    """An open CSV file: `header` and `delimiter` from its first line, the others in chunks.

    Raises InputError where the file is empty, not UTF-8 text, or its first line is blank.
    """

    def __init__(
        self, source: str, handle: BinaryIO, what: str = "table", comments: bool = False
    ) -> None:
        self.source, self.handle, self.what, self.comments = source, handle, what, comments
        number, line = 1, self._line(1)
        while comments and line and not self._counts(line):
            number += 1
            line = self._line(number)
        if not line:
            raise InputError(f"{source}: empty file; the first line names the columns")
        if line.startswith(UTF16):
            raise InputError(f"{source}: is UTF-16; save the table as CSV in UTF-8")
        if line.startswith(ARCHIVE):
            raise InputError(f"{source}: is a workbook or archive; export the sheet as CSV")
        text = self._decoded(line, number).removeprefix("\ufeff").rstrip("\r\n")
        if not text.strip():
            raise InputError(f"{source}: line 1 is blank; the first line must name the columns")
        self.delimiter = max(DELIMITERS, key=text.count)
        self.header = tuple(name.strip() for name in self._cells(number, text))
        self._header_line, self._start = number, handle.tell()

    def chunks(self) -> Iterator[Chunk]:
        """All data lines, each with as many fields as the header, from the first one on.

        Raises InputError for NUL bytes, overlong lines, other encodings, stray carriage returns,
        wrong field counts, too many rows, and files without data; memory stays bounded.
        """
        self.handle.seek(self._start)
        delimiter, delimiters = self.delimiter.encode(), len(self.header) - 1
        blank = b" \r\n" if self.delimiter == "\t" else b" \t\r\n"
        number, blanks, rows, size = self._header_line, 0, 0, 0
        lines: list[bytes] = []
        numbers = array("q")
        while line := self._line(number := number + 1):
            if not line.strip(blank) or (self.comments and not self._counts(line)):
                blanks += 1
                if blanks > MAX_BLANK_LINES:
                    raise InputError(
                        f"{self.source}, line {number}: more than {MAX_BLANK_LINES} blank lines; "
                        f"this is no {self.what}"
                    )
                continue
            if line.count(delimiter) != delimiters or b'"' in line or not line.isascii():
                self._check_fields(line, number)
            lines.append(line)
            numbers.append(number)
            size += len(line)
            if size >= CHUNK_BYTES:
                rows += len(lines)
                yield _chunk(lines, numbers)
                lines, numbers, size = [], array("q"), 0
                if rows > MAX_ROWS:
                    raise InputError(
                        f"{self.source}: more than {MAX_ROWS:,} rows; split the table, or thin it "
                        "out"
                    )
        if lines:
            yield _chunk(lines, numbers)
        elif not rows:
            raise InputError(f"{self.source}: has a header but no rows; add them below it")

    def cells(self, chunk: Chunk) -> Iterator[tuple[int, list[str]]]:
        """(line number, cells) of every line of a chunk."""
        for number, line in zip(chunk.numbers, chunk.data.splitlines(), strict=True):
            yield number, self._cells(number, line.decode())

    def _counts(self, line: bytes) -> bool:
        """Whether a line has cells that are not empty, and is no comment."""
        bare = line.removeprefix(BOM).strip(b' \t\r\n,;"')
        return bool(bare) and not bare.startswith(b"#")

    def _check_fields(self, line: bytes, number: int) -> None:
        if not line.isascii():
            self._decoded(line, number)
        if b'"' in line:
            found = len(self._cells(number, self._decoded(line, number).rstrip("\r\n")))
        else:
            found = line.count(self.delimiter.encode()) + 1
        expected = len(self.header)
        if found != expected:
            commas = found > expected and self.delimiter == ","
            hint = "where decimals are written with a comma, separate the columns by ';'"
            raise InputError(
                f"{self.source}: line {number} has {found} fields, header has {expected}; "
                f"{hint if commas else 'correct the line'}"
            )

    def _cells(self, number: int, text: str) -> list[str]:
        """The cells of one line.  Raises InputError where quotes do not close or are stray."""
        try:
            return next(
                csv.reader([text], delimiter=self.delimiter, strict=True, skipinitialspace=True)
            )
        except csv.Error:
            raise InputError(
                f"{self.source}, line {number}: quotation marks do not match in {quoted(text)}; "
                "close them on the same line"
            ) from None

    def _line(self, number: int) -> bytes:
        line = self.handle.readline(MAX_LINE + 1)
        if b"\0" in line and not line.startswith((*UTF16, ARCHIVE)):
            raise InputError(
                f"{self.source}, line {number}: NUL bytes, so this is no UTF-8 text; save the "
                "table as CSV in UTF-8"
            )
        if len(line) > MAX_LINE:
            raise InputError(
                f"{self.source}, line {number}: longer than {MAX_LINE // 1024} KiB; this is no "
                f"{self.what}"
            )
        # A lone CR would end a line for some readers and not for others.
        if b"\r" in line and b"\r" in line.removesuffix(b"\n").removesuffix(b"\r"):
            raise InputError(
                f"{self.source}, line {number}: a carriage return inside the line; save the table "
                "with ordinary line ends (LF or CRLF)"
            )
        return line

    def _decoded(self, line: bytes, number: int) -> str:
        remedy = "save the table as CSV in UTF-8"
        text = decoded(self.source, line, remedy, codec="utf-8", line=number)
        if number > 1 and "\ufeff" in text:
            raise InputError(
                f"{self.source}, line {number}: a byte order mark inside the file; if files were "
                "joined, remove the second header"
            )
        return text


def _chunk(lines: list[bytes], numbers: array[int]) -> Chunk:
    data = b"".join(lines)
    return Chunk(data, numbers, any(word in data for word in TRUTH_VALUES))


def first_bad_cell(
    source: str,
    rows: Iterable[tuple[int, list[str]]],
    columns: Mapping[int, str],
    comma_allowed: bool,
    blanks: Container[str] = (),
) -> InputError | None:
    """What is wrong with the first bad cell of `rows` (line number, cells), or None.

    `columns`: field index → header of the number columns; `comma_allowed`: decimal commas may
    be used, then everywhere in the file; `blanks`: headers of columns whose cells may be empty.
    """
    marks: dict[str, str] = {}
    for number, cells in rows:
        for i, header in columns.items():
            cell = cells[i].strip()
            if not cell and header in blanks:
                continue
            problem = _problem(cell, comma_allowed)
            if problem is not None:
                return InputError(f"{source}, line {number}, column {header}: {problem}")
            mark = next((m for m in ".," if m in cell), None)
            if mark:
                marks.setdefault(mark, f"line {number}, column {header}: {quoted(cell)}")
            if len(marks) == 2:
                return InputError(
                    f"{source}: decimal points ({marks['.']}) and decimal commas ({marks[',']}) in "
                    "one file; use one of them throughout"
                )
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
        return f"{quoted(cell)} is not a finite number; write a number, or drop the line"
    if THOUSANDS.fullmatch(cell):
        return f"{quoted(cell)} has thousands separators; write it without them"
    return f"{quoted(cell)} is not a number; correct it"
