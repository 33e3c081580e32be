"""A delimited table inside a text file: comments, preamble, header, delimiter, rows."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from elastocal.csv_lines import NUMBER
from elastocal.errors import InputError
from elastocal.importing.patterns import compiled
from elastocal.importing.robot_text import Rows
from elastocal.importing.schema import TextTable
from elastocal.importing.text_file import Text
from elastocal.text import quoted

DELIMITERS = {"tab": "\t", ";": ";", ",": ",", "space": " "}
SAMPLE = 200  # lines that decide on the delimiter, and in which a header is looked for
SHOWN = 120

# Whether a list of cells is the header that a mapping asks for.
IsHeader = Callable[[Sequence[str]], bool]
# Whether cells hold numbers where a mapping expects them.
IsData = Callable[[Sequence[str]], bool]


@dataclass(frozen=True)
class Table:
    """`rows` with the header's line (0 without one), the delimiter's name, and the comments."""

    rows: Rows
    header_line: int
    delimiter: str
    comments: tuple[str, ...]


def table_rows(
    text: Text, settings: TextTable, is_header: IsHeader | None, is_data: IsData
) -> Table:
    """The rows of a delimited table.

    `is_header` recognises the header where columns are asked for by name; without it the table
    begins at the first line that `is_data`, and the line before it is its header if it has as
    many cells.  Lines above the table, repeated headers and lines that match `ignore` are passed
    over and listed.  Raises InputError where there is no header or no data, and where quotation
    marks do not match.
    """
    marks = tuple(settings.comments or ())
    skip = None if settings.ignore is None else compiled(text.source, "ignore", settings.ignore)
    content, comments, ignored = [], [], []
    for number, line in enumerate(text.lines, start=1):
        bare = line.strip()
        if not bare:
            continue
        if marks and bare.startswith(marks):
            comments.append((number, bare))
        elif skip is not None and skip.search(line):
            ignored.append((number, f"matches ignore: {bare[:SHOWN]}"))
        else:
            content.append((number, line))
    if not content:
        raise InputError(f"{text.source}: only comments and blank lines; export the points again")
    delimiter: str = settings.delimiter or "auto"
    if delimiter == "auto":
        delimiter = _sniffed(content[:SAMPLE], comments[:SAMPLE], marks, is_header)
    split = _Splitter(text.source, delimiter)
    if is_header is not None:
        header_line, header = _named_header(split, content, comments, marks, is_header)
    else:
        header_line, header = _unnamed_header(text, split, content, is_data)
    rows: list[tuple[int, list[str]]] = []
    for number, cells in split.all(content):
        if is_header is None and header_line == 0 and not rows and not is_data(cells):
            ignored.append((number, "stands above the first reading"))
        elif number < header_line:
            ignored.append((number, "stands above the header"))
        elif number == header_line:
            pass
        elif header and [c.strip() for c in cells] == list(header):
            ignored.append((number, "repeats the header"))
        elif any(cell.strip() for cell in cells):
            rows.append((number, cells))
    if not rows:
        raise InputError(f"{text.source}: a header but no readings below it; export the points")
    found = Rows(tuple(header), rows, ignored)
    return Table(found, header_line, delimiter, tuple(line for _, line in comments))


def _sniffed(
    content: list[tuple[int, str]],
    comments: list[tuple[int, str]],
    marks: tuple[str, ...],
    is_header: IsHeader | None,
) -> str:
    """The delimiter that leaves the most cells that are numbers; commas may be decimal marks.

    Where a header is looked for, it must show with that delimiter.
    """

    def numbers(delimiter: str) -> int:
        split = _Splitter("", delimiter)
        counts = []
        for _, line in content:
            with suppress(InputError):
                cells = split.one(0, line)
                counts.append(sum(bool(NUMBER.fullmatch(cell.strip())) for cell in cells))
        return sorted(counts)[len(counts) // 2] if counts else 0

    best = sorted(DELIMITERS, key=numbers, reverse=True)
    if is_header is not None:
        for delimiter in best:
            with suppress(InputError):
                split = _Splitter("", delimiter)
                if _named_header(split, content, comments, marks, is_header)[0]:
                    return delimiter
    return best[0]


class _Splitter:
    def __init__(self, source: str, delimiter: str) -> None:
        self.source, self.name = source, delimiter
        self.character = DELIMITERS[delimiter]

    def _prepared(self, line: str) -> str:
        return " ".join(line.split()) if self.name == "space" else line

    def one(self, number: int, line: str) -> list[str]:
        return next(cells for _, cells in self.all([(number, line)]))

    def all(self, lines: Sequence[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
        """(line number, cells) of each line; a quotation mark that runs on is an error."""
        reader = csv.reader(
            (self._prepared(line) for _, line in lines),
            delimiter=self.character, skipinitialspace=True,
        )  # fmt: skip
        before = 0
        for cells in reader:
            number, line = lines[before]
            if reader.line_num != before + 1:
                raise InputError(
                    f"{self.source}, line {number}: quotation marks do not match in "
                    f"{quoted(line.strip())}; close them on the same line"
                )
            before = reader.line_num
            yield number, cells


def _named_header(
    split: _Splitter, content: list[tuple[int, str]], comments: list[tuple[int, str]],
    marks: tuple[str, ...], is_header: IsHeader,
) -> tuple[int, tuple[str, ...]]:  # fmt: skip
    for number, line in content[:SAMPLE]:
        cells = tuple(cell.strip() for cell in split.one(number, line))
        if is_header(cells):
            return number, cells
    # Some write the names of the columns as a comment.
    for number, line in comments[:SAMPLE]:
        bare = line
        for mark in sorted(marks, key=len, reverse=True):
            bare = bare.removeprefix(mark)
        cells = tuple(cell.strip() for cell in split.one(number, bare))
        if is_header(cells):
            return number, cells
    return 0, ()


def _unnamed_header(
    text: Text, split: _Splitter, content: list[tuple[int, str]], is_data: IsData
) -> tuple[int, tuple[str, ...]]:
    before: tuple[int, list[str]] | None = None
    for number, line in content[:SAMPLE]:
        cells = split.one(number, line)
        if is_data(cells):
            if before is not None and len(before[1]) == len(cells):
                return before[0], tuple(cell.strip() for cell in before[1])
            return 0, ()
        before = number, cells
    number, line = content[0]
    raise InputError(
        f"{text.source}, line {number}: no numbers where the mapping has them, in "
        f"{quoted(line.strip())} and the {min(len(content), SAMPLE) - 1} lines after it (columns "
        f"split at {split.name!r}); correct the places or the delimiter in [source]"
    )
