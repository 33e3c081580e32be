"""Delimited tables: one reader and one writer for all of them.

A table is CSV (UTF-8; comma, semicolon or tab between columns; decimal commas where columns are not
separated by them) or Parquet.  Its first line names the columns, and units stand in the names.
What a table may hold is stated as families of columns; numbers are returned in the file's own units
beside the line of each row, all else is refused.  A file is read piece by piece in little memory.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO, StringIO
from itertools import chain
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from elastocal.files import atomic_write, check_size, decoded, open_input
from elastocal.messages import (
    NUMBER,
    InputError,
    cell_meaning,
    cell_text,
    did_you_mean,
    is_label,
    listed,
    nearest,
    plain_minus,
    printable,
    quoted,
    require,
)
from elastocal.units import FACTORS, Array, IntArray, to_si

MAX_LINE = 64 * 1024
PIECE = 1 << 20  # bytes read at once
MAX_ROWS = 5_000_000
MOST_BYTES = 1_000_000_000  # of a table: 5 million rows of 200 characters
DELIMITERS = ",;\t"
UTF16 = (b"\xff\xfe", b"\xfe\xff")
ARCHIVE = b"PK\x03\x04"
SAYS_NOTHING = re.compile(r"""\ufeff?[ \t,;"]*(#.*)?""")  # a comment, or cells that are empty
NOT_FINITE = re.compile(r"[+-]?(nan|na|n/a|null|none|inf|infinity|#n/?a|#num!)", re.IGNORECASE)
ORDINARY = re.compile(r"[0-9.eE+ -]*")  # what numbers are made of that need no second look
THOUSANDS = re.compile(r"[+-]?[0-9]+([.,' ][0-9]{3})*[.,][0-9]+")

Row = tuple[int, list[str]]  # number of the line, its cells
Lines = Iterable[list[tuple[int, str]]]  # of a file, by number, thousands at a time


def csv_lines(
    source: str, handle: BinaryIO, what: str = "table", comments: bool = False
) -> tuple[tuple[str, ...], str, Lines]:
    """The header, what stands between columns, and the other lines that are not blank.
    `comments`: lines that begin with # are passed over, and lines of empty cells."""
    pieces = filter(None, _sound_lines(source, handle, what, comments))
    some = next(pieces, [])
    require(some, f"{source}: empty file; the first line names the columns")
    (number, first), *others = some
    first = first.removeprefix("\ufeff")
    stated = re.fullmatch(f'"?sep=([{DELIMITERS}])"?', first.rstrip(" "))  # as Excel has it
    if stated and others:
        (number, first), *others = others
    told = f"{source}: line {number} is blank; the first line must name the columns"
    require(first.strip(), told)
    delimiter = stated[1] if stated else max(DELIMITERS, key=first.count)
    header = tuple(name.strip() for name in _split(source, number, first, delimiter))
    blank = " " if delimiter == "\t" else " \t"
    lines = ([(k, t) for k, t in piece if t.strip(blank)] for piece in chain([others], pieces))
    return header, delimiter, filter(None, lines)


def _sound_lines(source: str, handle: BinaryIO, what: str, comments: bool) -> Lines:
    number, remedy = 1, "save the table as CSV in UTF-8"
    while lines := handle.readlines(PIECE):
        whole = b"".join(lines)
        if number == 1 and whole.startswith(UTF16):
            raise InputError(f"{source}: is UTF-16; {remedy}")
        if number == 1 and whole.startswith(ARCHIVE):
            raise InputError(f"{source}: is a workbook or archive; export the sheet as CSV")
        if b"\0" in whole or b"\r" in whole or max(map(len, lines)) > MAX_LINE:
            for k, line in enumerate(lines, number):
                if fault := _fault(line.removesuffix(b"\n"), what):
                    raise InputError(f"{source}, line {k}: {fault}")
        text = decoded(source, whole, remedy, "utf-8", line=number).replace("\r", "")
        found = enumerate(text.removesuffix("\n").split("\n"), number)
        yield [(k, t) for k, t in found if not (comments and SAYS_NOTHING.fullmatch(t))]
        number += len(lines)


def _fault(line: bytes, what: str) -> str:
    if b"\0" in line:
        return "NUL bytes, so this is no UTF-8 text; save the table as CSV in UTF-8"
    if len(line) > MAX_LINE:
        return f"longer than {MAX_LINE // 1024} KiB; this is no {what}"
    # A lone CR would end a line for some readers and not for others.
    inside = b"\r" in line.removesuffix(b"\r")
    told = "a carriage return inside the line; save the table with ordinary line ends (LF or CRLF)"
    return told if inside else ""


def _split(source: str, number: int, line: str, delimiter: str) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=True))
    except csv.Error:
        raise InputError(
            f"{source}, line {number}: quotation marks do not match in {quoted(line)}; close them "
            "on the same line"
        ) from None


def _split_all(source: str, lines: list[tuple[int, str]], width: int, delimiter: str) -> list[Row]:
    rows = [(number, _split(source, number, line, delimiter)) for number, line in lines]
    for number, cells in rows:
        if len(cells) != width:
            commas = len(cells) > width and delimiter == ","
            hint = "where decimals are written with a comma, separate the columns by ';'"
            raise InputError(
                f"{source}: line {number} has {len(cells)} fields, header has {width}; "
                f"{hint if commas else 'correct the line'}"
            )
    return rows


def first_bad_cell(
    source: str, rows: Iterable[Row], columns: Mapping[int, str], comma_allowed: bool,
    blanks: Container[str] = (), marks: dict[str, str] | None = None, noun: str = "line",
) -> InputError | None:  # fmt: skip
    """`columns`: field index → header of the number columns; `comma_allowed`: decimal commas may be
    used, then everywhere in the file; `blanks`: headers of columns whose cells may be empty;
    `marks`: where decimal points and commas were found in earlier rows."""
    marks = {} if marks is None else marks
    for number, cells in rows:
        for i, header in columns.items():
            cell = cells[i].strip()
            if not cell and header in blanks:
                continue
            if problem := _problem(cell, comma_allowed):
                return InputError(f"{source}, {noun} {number}, column {header}: {problem}")
            if mark := "." if "." in cell else "," if "," in cell else "":
                marks.setdefault(mark, f"{noun} {number}, column {header}: {quoted(cell)}")
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


NO_UNIT = ("",)
IGNORED = ("#", "_", "note")
# Seen in other people's tables: they make a name such as x_cm a wrong unit, not a typing error.
OTHER_UNITS = {unit for units in FACTORS.values() for unit in units if unit}
OTHER_UNITS |= {"km", "nm", "inch", "urad", "grad", "turn", "mNm"}


@dataclass(frozen=True)
class Family:
    """Columns that belong together: all of them or none.  `units`: stem → the units it may be
    written in; stems with the same choice share one unit.  `is_label`: texts instead of numbers;
    `optional`: stems that may be absent, and whose cells may be empty."""

    name: str
    meaning: str
    units: Mapping[str, tuple[str, ...]]
    is_label: bool = False
    optional: Container[str] = ()

    def columns(self, stem: str) -> tuple[str, ...]:
        return tuple(column(stem, unit) for unit in self.units[stem])

    @property
    def required(self) -> list[str]:
        return [stem for stem in self.units if stem not in self.optional]


@dataclass(frozen=True)
class Column:
    header: str
    stem: str
    unit: str
    is_label: bool = False
    may_be_blank: bool = False


def column(stem: str, unit: str) -> str:
    """The header of a column: x_mm, or approach_1 where there is no unit."""
    return f"{stem}_{unit}" if unit else stem


NUMBERING = "(id|no|nr|num|number|name)?"
# What other people's tables call a column, without its unit, _ and capitals → its stem.
CALLED = {
    rf"(pose|conf|config|configuration|point|posture){NUMBERING}": "configuration",
    rf"(marker|target|reflector|smr){NUMBERING}": "marker",
    r"(?:j|joint|axis|a|theta)(\d+)": r"q\1",
    r"(?:f|force)([xyz])": r"force_\1",
    r"(?:m|tau|trq|torque)(\d+)": r"torque_\1",
}
# The columns of a table by their families, each in the order of its stems.
Columns = Mapping[str, tuple[Column, ...]]
Choose = Callable[[Sequence[str]], Columns]  # by the header


def match_columns(
    source: str, header: Sequence[str], known: Mapping[str, Family],
    needed: Sequence[Sequence[str]], needed_by: str, exclusive: Sequence[tuple[str, str]] = (),
    passed_over: Callable[[str], bool] = lambda text: False,
    explain: Callable[[str], str | None] = lambda text: None,
    called: Mapping[str, str] = CALLED, valid: str = "",
) -> Columns:  # fmt: skip
    """Which column of a header is which of the `known` families, none of which is there in part.

    `needed`: of each entry one family must be there, because `needed_by` (as in "a DH table
    needs"); `exclusive`: pairs of families that say the same; `passed_over`: headers that mean
    nothing here; `explain`: what to say of an unknown one; `called`: what its name may mean, as
    CALLED; `valid`: what to say where it is like none."""
    for i, text in enumerate(header, start=1):
        told = "has no name in the header; name it or remove the separator too many"
        require(text, f"{source}: column {i} of {len(header)} {told}")
    for text, times in Counter(header).items():
        if times > 1:
            raise InputError(f"{source}: column {quoted(text)} appears {times} times; keep one")
    meaning = {
        column(stem, unit): (family, stem, unit)
        for family in known.values()
        for stem, units in family.units.items()
        for unit in units
    }
    present: dict[str, dict[str, Column]] = {}
    for text in header:
        if text.startswith(IGNORED) or passed_over(text):
            continue
        if text not in meaning:
            told = explain(text) or _unknown(text, known, header, called, valid)
            raise InputError(f"{source}: {told}")
        family, stem, unit = meaning[text]
        found = present.setdefault(family.name, {})
        if stem in found:
            raise InputError(
                f"{source}: columns {found[stem].header} and {text} say the same; keep one"
            )
        for other_stem, other in found.items():
            if family.units[other_stem] == family.units[stem] and other.unit != unit:
                raise InputError(
                    f"{source}: columns {other.header} and {text} mix units; give all "
                    f"{family.meaning} in one unit"
                )
        found[stem] = Column(text, stem, unit, family.is_label, stem in family.optional)
    columns = {
        name: tuple(found[stem] for stem in known[name].units if stem in found)
        for name, found in present.items()
    }
    _check_columns(source, columns, known, needed, needed_by, exclusive)
    return columns


def _check_columns(
    source: str, columns: Columns, known: Mapping[str, Family], needed: Sequence[Sequence[str]],
    needed_by: str, exclusive: Sequence[tuple[str, str]],
) -> None:  # fmt: skip
    for name, found in columns.items():
        family, unit, stems = known[name], found[0].unit, [c.stem for c in found]
        absent = [column(s, unit if unit in family.units[s] else family.units[s][0])
                  for s in family.required if s not in stems]  # fmt: skip
        if absent:
            raise InputError(
                f"{source}: {listed(c.header for c in found)} without {listed(absent)}; "
                f"the table needs all columns of the {family.meaning}"
                f"{'' if (name,) in needed else ', or none'}"
            )
    for one, other in exclusive:
        if one in columns and other in columns:
            pair = [columns[name][0].header for name in (one, other)]
            raise InputError(
                f"{source}: {pair[0]} … and {pair[1]} … say the same in two ways "
                f"({known[one].meaning}, {known[other].meaning}); keep one"
            )
    for choices in needed:
        if not any(name in columns for name in choices):
            wanted = " or ".join(
                ",".join(known[name].columns(stem)[0] for stem in known[name].required)
                for name in choices
            )
            there = listed((c.header for found in columns.values() for c in found), 12)
            raise InputError(
                f"{source}: the columns {wanted} are missing, which {needed_by}; found "
                f"{there or 'no known column'}"
            )


def _unknown(
    text: str, known: Mapping[str, Family], header: Sequence[str], called: Mapping[str, str],
    valid: str,
) -> str:  # fmt: skip
    ways: dict[str, list[str]] = {}
    for family in known.values():
        for stem in family.units:
            ways.setdefault(stem, []).extend(family.columns(stem))
    if text in ways:
        return f"column {quoted(text)} has no unit; write {' or '.join(ways[text])}"
    stem, _, unit = re.sub(r"\W+", "_", text).strip("_").rpartition("_")  # "theta (deg)" too
    unit = unit if unit in OTHER_UNITS else unit.lower()
    if unit in OTHER_UNITS and column(stem, unit) not in ways.get(stem, [column(stem, unit)]):
        return (
            f"column {quoted(text)}: the unit {unit} is not taken here; write "
            f"{' or '.join(ways[stem])}"
        )
    name = (stem if stem and unit in OTHER_UNITS else text).lower().replace("_", "")
    meant = (found.expand(own) for way, own in called.items() if (found := re.fullmatch(way, name)))
    # Where all are told, a unit in common makes no name like another.
    own = ways.get(next(meant, (nearest(name, ways) or "") if valid else ""), [])
    bare = name == text.lower()
    near = " or ".join(f"'{way}'" for way in own if bare or way.endswith(f"_{unit}"))
    hint = f" (did you mean {near or repr(own[0])}?)" if own and not {*own} & {*header} else ""
    if not own:
        hint = valid or did_you_mean(text, [way for each in ways.values() for way in each])
    return (
        f"unknown column {quoted(text)}{hint}; correct the name, or start "
        "it with '#', '_' or 'note' to have it ignored"
    )


@dataclass(frozen=True)
class Labels:
    """`codes` (n,) index into `names`, which stand in order of first appearance."""

    codes: IntArray
    names: tuple[str, ...]

    @classmethod
    def of(cls, cells: Iterable[object]) -> Labels:
        """The labels of a column; blanks at the ends of a name are cut off."""
        texts = list(map(str, cells))
        meant = {text: cell_meaning(text.strip()).strip() for text in dict.fromkeys(texts)}
        code = {name: k for k, name in enumerate(dict.fromkeys(meant.values()))}
        return cls(np.array([code[meant[text]] for text in texts], dtype=np.int64), tuple(code))


@dataclass(frozen=True)
class RawTable:
    """n rows; `row` (n,) is the line (CSV) or row (Parquet) in the file, `noun` says which.
    `numbers`: header → (n,) floats in the file's unit, NaN for a cell that is empty where it may
    be."""

    source: str
    noun: str
    row: IntArray
    columns: Columns
    numbers: Mapping[str, Array]
    labels: Mapping[str, Labels]

    def where(self, i: int, *headers: str) -> str:
        columns = f"column{'s' if len(headers) > 1 else ''} {' and '.join(headers)}"
        return f"{self.source}, {self.noun} {self.row[i]}, {columns}"

    def column(self, family: str, stem: str) -> Column | None:
        """None where the file has none."""
        found = self.columns.get(family, ())
        return next((column for column in found if column.stem == stem), None)

    def text(self, i: int, header: str) -> str:
        labels = self.labels.get(header)
        return "" if labels is None else labels.names[labels.codes[i]]

    def si(self, family: str) -> Array | None:
        """The columns of a family side by side (n, k) in SI units, None where there are none."""
        if family not in self.columns:
            return None
        with np.errstate(over="ignore"):
            values = np.column_stack(
                [to_si(self.numbers[c.header], c.unit) for c in self.columns[family]]
            )
        self.check(family, ~np.isinf(values), "too large to be a number here")
        return values

    def check(self, family: str, good: np.ndarray, rule: str) -> None:
        """Raises InputError with `rule` for the first cell (n, k) that is not good."""
        if good.all():
            return
        i, k = (int(v) for v in np.argwhere(~good)[0])
        header = self.columns[family][k].header
        raise InputError(
            f"{self.where(i, header)}: {rule}; found {self.numbers[header][i]:.6g}; correct or "
            f"drop the {self.noun}"
        )


PARQUET = (".parquet", ".pq")


def read_table(
    path: str | Path, choose: Choose, *, what: str = "measurement table", comments: bool = False,
    text: str | None = None, most: int = MOST_BYTES,
) -> RawTable:  # fmt: skip
    """The columns of a CSV or Parquet file that `choose` picks from its header.  `what` names the
    kind of table in messages; `comments` as of `csv_lines`.  With `text` the table is that CSV
    text, and `path` only its name; a file has `most` bytes."""
    source, noun = str(path), "line"
    if text is None and Path(path).suffix.lower() in PARQUET:
        text, noun = _parquet(source, what), "row"
    with open_input(path, what, most) if text is None else BytesIO(text.encode()) as handle:
        header, delimiter, lines = csv_lines(source, handle, what, comments)
        table = _read(source, noun, header, lines, choose, delimiter)
    for column in (c for own in table.columns.values() for c in own if c.is_label):
        labels = table.labels[column.header]
        for code, name in enumerate(labels.names):
            if not is_label(name) and (name or not column.may_be_blank):
                where = table.where(int(np.argmax(labels.codes == code)), column.header)
                what = f"{quoted(name)} has control characters" if name else "empty cell"
                raise InputError(f"{where}: {what}; write a name or number")
    return table


def _read(
    source: str, noun: str, header: Sequence[str], pieces: Lines, choose: Choose, delimiter: str
) -> RawTable:
    chosen = choose(header)
    every = {column.header: column for family in chosen.values() for column in family}
    columns = {i: name for i, name in enumerate(header) if name in every}
    numbers, labels = ({i: name for i, name in columns.items() if every[name].is_label == whether}
                       for whether in (False, True))  # fmt: skip
    blanks = {name for name, column in every.items() if column.may_be_blank}
    commas = delimiter != ","  # for decimals
    found, marks = list[int](), dict[str, str]()
    read: list[tuple[Array, np.ndarray]] = []
    for some in pieces:
        if noun == "row":  # the header is the line before the first of them
            some = [(number - 1, line) for number, line in some]
        found += [number for number, _ in some]
        told = f"{source}: more than {MAX_ROWS:,} rows; split the table, or thin it out"
        require(len(found) <= MAX_ROWS, told)
        rows = _split_all(source, some, len(header), delimiter)
        values = None if commas else _ordinary([cells[i] for _, cells in rows for i in numbers])
        if values is None:
            for _, cells in rows:
                for i in numbers:  # labels stay as they are written
                    cells[i] = plain_minus(cells[i])
            if problem := first_bad_cell(source, rows, numbers, commas, blanks, marks, noun):
                raise problem
            bare = (c[i].replace(",", ".").strip() or "nan" for _, c in rows for i in numbers)
            values = np.array(list(map(float, bare)))
        texts = np.array([[cells[i] for i in labels] for _, cells in rows], dtype=object)
        read.append((values.reshape(len(rows), -1), texts.reshape(len(rows), -1)))
    require(found, f"{source}: has a header but no rows; add them below it")
    values, texts = map(np.concatenate, zip(*read, strict=True))
    return RawTable(
        source, noun, np.array(found, dtype=np.int64), chosen,
        dict(zip(numbers.values(), values.T, strict=True)),
        dict(zip(labels.values(), map(Labels.of, texts.T), strict=True)),
    )  # fmt: skip


def _ordinary(cells: list[str]) -> Array | None:
    """Plain numbers, in a tenth of the time that it takes cell by cell; None of others."""
    try:
        values = np.array(list(map(float, cells)))
    except ValueError:
        return None
    return values if ORDINARY.fullmatch("".join(cells)) and np.isfinite(values).all() else None


def _parquet(source: str, what: str) -> str:
    """The table as CSV."""
    with open_input(source, what, MOST_BYTES) as handle:
        told = f"{source}: is not a Parquet file; check it, or name a CSV .csv"
        require(handle.read(4) == b"PAR1", told)
        try:
            from pyarrow.parquet import ParquetFile

            file = ParquetFile(handle)
            groups = map(file.metadata.row_group, range(file.num_row_groups))
            check_size(source, what, sum(group.total_byte_size for group in groups), MOST_BYTES)
            frame = file.read().to_pandas()
        except InputError:
            raise
        except ImportError:
            raise InputError(
                f"{source}: reading Parquet needs pyarrow; run 'pip install pyarrow', or save the "
                "table as CSV"
            ) from None
        except Exception as error:  # it has exceptions of its own
            raise InputError(f"{source}: damaged Parquet file ({error}); write it again") from None
    return str(frame.to_csv(index=any(frame.index.names), lineterminator="\n"))


def write_csv(
    handle: TextIO, header: Iterable[str], rows: Iterable[Iterable[object]],
    comments: Iterable[str] = (),
) -> None:  # fmt: skip
    handle.writelines(f"# {printable(comment)}\n" for comment in comments)
    writer = csv.writer(handle, lineterminator="\n")
    writer.writerow(map(cell_text, header))
    writer.writerows(map(cell_text, row) for row in rows)


def write_parquet(path: str | Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write a table as Parquet, which reads back bit for bit, where pandas finds an engine."""
    import pandas as pd

    texts = {name: map(cell_text, v) for name, v in columns.items() if v.dtype == object}
    frame, packed = pd.DataFrame(dict(columns) | {n: list(v) for n, v in texts.items()}), BytesIO()
    try:
        frame.to_parquet(packed, index=False)
    except ImportError:
        raise InputError(
            f"{path}: writing Parquet needs pyarrow; run 'pip install pyarrow', or save it .csv"
        ) from None
    atomic_write(path, packed.getvalue())


def csv_text(
    header: Iterable[str], rows: Iterable[Iterable[object]], comments: Iterable[str] = ()
) -> str:
    text = StringIO()
    write_csv(text, header, rows, comments)
    return text.getvalue()
