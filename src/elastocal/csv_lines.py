"""The lines of a delimited text file: bounded, checked, counted, before anything is parsed."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from elastocal.errors import InputError
from elastocal.nearest import quoted

MAX_LINE = 64 * 1024
MAX_BLANK_LINES = 10_000
MAX_ROWS = 5_000_000
CHUNK_BYTES = 1 << 20
DELIMITERS = ",;\t"
# pandas takes True and False for 1 and 0; "true" in any case it knows has one of these in it.
TRUTH_VALUES = (b"rue", b"RUE", b"alse", b"ALSE")


@dataclass(frozen=True)
class Dialect:
    """The header names, the delimiter, and the byte where the second line begins."""

    header: tuple[str, ...]
    delimiter: str
    start: int


def read_header(source: str, handle: BinaryIO) -> Dialect:
    """Names and delimiter from the first line of a file.

    Raises InputError where the file is empty, not UTF-8 text, or its first line is blank.
    """
    line = _bounded_line(source, handle, 1)
    if not line:
        raise InputError(f"{source}: empty file; the first line names the columns")
    if line.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{source}: is UTF-16; save the table as CSV in UTF-8")
    if line.startswith(b"PK\x03\x04"):
        raise InputError(f"{source}: is a workbook or archive; export the sheet as CSV")
    text = _decode(source, line, 1).removeprefix("\ufeff").rstrip("\r\n")
    if not text.strip():
        raise InputError(f"{source}: line 1 is blank; the first line must name the columns")
    delimiter = max(DELIMITERS, key=text.count)
    names = tuple(name.strip() for name in split(source, 1, text, delimiter))
    return Dialect(names, delimiter, handle.tell())


@dataclass(frozen=True)
class Chunk:
    """Some consecutive data lines: their text and their `numbers` in the file.

    `truth_values`: whether True or False may stand in one of them.
    """

    data: bytes
    numbers: array[int]
    truth_values: bool


def chunks(source: str, handle: BinaryIO, dialect: Dialect) -> Iterator[Chunk]:
    """All data lines from `dialect.start`, each with as many fields as the header, in chunks.

    Raises InputError for NUL bytes, overlong lines, other encodings, stray carriage returns,
    wrong field counts, too many rows, and files without data; memory stays bounded.
    """
    handle.seek(dialect.start)
    delimiter = dialect.delimiter.encode()
    expected = len(dialect.header)
    number, blanks, rows, size = 1, 0, 0, 0
    lines: list[bytes] = []
    numbers = array("q")
    while line := _bounded_line(source, handle, number := number + 1):
        if not line.strip(b" \r\n" if delimiter == b"\t" else b" \t\r\n"):
            blanks += 1
            if blanks > MAX_BLANK_LINES:
                raise InputError(f"{source}, line {number}: more than {MAX_BLANK_LINES} blank "
                                 "lines; this is no measurement table")  # fmt: skip
            continue
        if not line.isascii():
            _decode(source, line, number)
        if b'"' in line:
            text = _decode(source, line, number).rstrip("\r\n")
            found = len(split(source, number, text, dialect.delimiter))
        else:
            found = line.count(delimiter) + 1
        if found != expected:
            hint = "; where decimals are written with a comma, separate the columns by ';'"
            raise InputError(
                f"{source}: line {number} has {found} fields, header has {expected}"
                f"{hint if found > expected and delimiter == b',' else '; correct the line'}"
            )
        lines.append(line)
        numbers.append(number)
        size += len(line)
        if size >= CHUNK_BYTES:
            rows += len(lines)
            yield _chunk(lines, numbers)
            lines, numbers, size = [], array("q"), 0
            if rows > MAX_ROWS:
                raise InputError(
                    f"{source}: more than {MAX_ROWS:,} rows; split the table, or thin it out"
                )
    if lines:
        yield _chunk(lines, numbers)
    elif not rows:
        raise InputError(f"{source}: has a header but no rows; add measurements below it")


def _chunk(lines: list[bytes], numbers: array[int]) -> Chunk:
    data = b"".join(lines)
    return Chunk(data, numbers, any(word in data for word in TRUTH_VALUES))


def fields(source: str, chunk: Chunk, dialect: Dialect) -> Iterator[tuple[int, list[str]]]:
    """(line number, cells) of every line of a chunk."""
    for number, line in zip(chunk.numbers, chunk.data.splitlines(), strict=True):
        yield number, split(source, number, line.decode(), dialect.delimiter)


def split(source: str, number: int, text: str, delimiter: str) -> list[str]:
    """The cells of one line.  Raises InputError where its quotes do not close or are stray."""
    try:
        reader = csv.reader([text], delimiter=delimiter, strict=True, skipinitialspace=True)
        return next(reader)
    except csv.Error:
        raise InputError(
            f"{source}, line {number}: quotation marks do not match in {quoted(text)}; close "
            "them on the same line"
        ) from None


def _bounded_line(source: str, handle: BinaryIO, number: int) -> bytes:
    line = handle.readline(MAX_LINE + 1)
    if b"\0" in line and not line.startswith((b"\xff\xfe", b"\xfe\xff", b"PK\x03\x04")):
        raise InputError(
            f"{source}, line {number}: NUL bytes, so this is no UTF-8 text; save the table as "
            "CSV in UTF-8"
        )
    if len(line) > MAX_LINE:
        raise InputError(
            f"{source}, line {number}: longer than {MAX_LINE // 1024} KiB; this is no "
            "measurement table"
        )
    # A lone CR would end a line for some readers and not for others.
    if b"\r" in line and b"\r" in line.removesuffix(b"\n").removesuffix(b"\r"):
        raise InputError(
            f"{source}, line {number}: a carriage return inside the line; save the table with "
            "ordinary line ends (LF or CRLF)"
        )
    return line


def _decode(source: str, line: bytes, number: int) -> str:
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{source}, line {number}: not UTF-8 text (byte 0x{line[error.start]:02x}); save "
            "the table as CSV in UTF-8"
        ) from None
    if number > 1 and "\ufeff" in text:
        raise InputError(
            f"{source}, line {number}: a byte order mark inside the file; if files were joined, "
            "remove the second header"
        )
    return text
