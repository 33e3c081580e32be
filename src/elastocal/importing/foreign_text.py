"""Text of unknown origin: encodings, delimited tables in it, robot programs, number cells."""

from __future__ import annotations

import codecs
import csv
import math
import re
import signal
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from elastocal.errors import InputError
from elastocal.files import decoded, read_bytes
from elastocal.importing.mapping_file import TextSourceKeys
from elastocal.tables import MAX_LINE, NUMBER, first_bad_cell
from elastocal.text import quoted
from elastocal.units import known_unit

MAX_BYTES = 300_000_000
SAVE_AS = "set encoding in [source.text], or export as UTF-8"
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig", "UTF-8"),
    (codecs.BOM_UTF16_LE, "utf-16", "UTF-16"),
    (codecs.BOM_UTF16_BE, "utf-16", "UTF-16"),
)
_BINARY = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1", b"%PDF", b"#ROSBAG", b"SQLite format 3")
DELIMITER_NAMES = {"tab": "\t", ";": ";", ",": ",", "space": " "}
SAMPLE = 200  # lines that decide on the delimiter, and in which a header is looked for
SHOWN = 120

# Whether the cells of a line are the header that a mapping asks for, or numbers where it has them.
Judge = Callable[[Sequence[str]], bool]

MISSING = ("", "-", "--", "---", "n/a", "na", "nan", "none", "null")
ISO = "ISO 8601"


@dataclass(frozen=True)
class ForeignText:
    """`lines` without their ends; line k of the file is lines[k - 1]."""

    source: str
    encoding: str
    lines: list[str]


def read_lines(path: str | Path, encoding: str = "auto") -> ForeignText:
    """The lines of a text file of at most 300 MB.

    `encoding` "auto": by the byte order mark, else UTF-8 where the bytes allow, else UTF-16
    where every other byte is zero, else Windows-1252 (Latin-1 where that has no character).
    Raises InputError where the file cannot be read, is empty, no text, or not in `encoding`.
    """
    source = str(path)
    data = read_bytes(path, "export", MAX_BYTES)
    if not data.strip():
        raise InputError(f"{source}: empty file; export it again")
    if data.startswith(_BINARY):
        raise InputError(
            f"{source}: is a workbook, bag, archive or other binary file; export its table as text "
            "(CSV)"
        )
    text, name = _decode(source, data, encoding)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{source}, line {line}: NUL characters, so this is no text; export it "
                         "as text (CSV)")  # fmt: skip
    # Not splitlines: a form feed or U+2028 in a comment ends no line for an editor.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, content in enumerate(lines, start=1):
        if len(content) > MAX_LINE:
            raise InputError(f"{source}, line {number}: longer than {MAX_LINE // 1024} KiB; this "
                             "is no table of readings")  # fmt: skip
    return ForeignText(source, name, lines)


def _decode(source: str, data: bytes, encoding: str) -> tuple[str, str]:
    """The text, and what its encoding is called."""
    if encoding == "auto":
        for mark, codec, name in _MARKS:
            if data.startswith(mark):
                return decoded(source, data, SAVE_AS, codec, name), name
        wide = _wide(data)
        if wide:
            return decoded(source, data, SAVE_AS, wide, "UTF-16"), "UTF-16"
        plain = "ASCII" if data.isascii() else "UTF-8"
        for codec, name in (("utf-8", plain), ("cp1252", "Windows-1252")):
            with suppress(UnicodeDecodeError):
                return data.decode(codec), name
        return data.decode("latin-1"), "Latin-1"
    codec = {"utf-8": "utf-8-sig"}.get(encoding, encoding)
    if encoding == "utf-16" and not data.startswith(codecs.BOM_UTF16):
        codec = _wide(data) or "utf-16-le"
    return decoded(source, data, SAVE_AS, codec, encoding), encoding


def _wide(data: bytes) -> str | None:
    """UTF-16 without a byte order mark shows by zeros at every other place."""
    start = data[:4000]
    even, odd = start[0::2].count(0), start[1::2].count(0)
    for codec, many, few in (("utf-16-le", odd, even), ("utf-16-be", even, odd)):
        if many > 0.4 * len(start) / 2 and few < many / 4:
            return codec
    return None


def unit_in_comments(where: str, pattern: str | None, comments: Sequence[str]) -> str | None:
    """What the group `unit` of `pattern` finds in the first comment that it matches.

    Raises InputError for a pattern that is no regular expression or has no such group.
    """
    if pattern is None:
        return None
    expression = compiled(where, "unit_comment", pattern)
    if "unit" not in expression.groupindex:
        raise InputError(
            f"{where}: unit_comment = {quoted(pattern)} has no group (?P<unit>…); name the part "
            "that is the unit so"
        )
    with bounded_search(where) as search:
        for comment in comments:
            found = search(expression, comment)
            if found and found["unit"] and known_unit(found["unit"]):
                return found["unit"]
    return None


def compiled(where: str, key: str, pattern: str) -> re.Pattern[str]:
    """A regular expression of the mapping.  Raises InputError that names its key."""
    try:
        return re.compile(pattern)
    except re.error as error:
        raise InputError(
            f"{where}: {key} = {quoted(pattern)} is no regular expression: {error}"
        ) from None


PATIENCE = 2.0  # s of processor time; a letter and a text have theirs beside it
PER_LETTER, PER_TEXT = 2e-6, 2e-5  # s, twenty times what such expressions take

Search = Callable[[re.Pattern[str], str], re.Match[str] | None]


@contextmanager
def bounded_search(where: str) -> Iterator[Search]:
    """In a `with` block, Pattern.search for expressions of a mapping, which may be exponential.

    Raises InputError where it takes longer than PATIENCE and what any number of texts may take:
    in the main thread, and where the system has a timer.
    """
    now: tuple[str, str] | None = None
    letters = texts = 0
    begun = time.thread_time()

    def search(expression: re.Pattern[str], text: str) -> re.Match[str] | None:
        nonlocal now, letters, texts
        letters, texts = letters + len(text), texts + 1
        now = expression.pattern, text
        found = expression.search(text)
        now = None
        return found

    def look(number: int, frame: object) -> None:
        allowed = PATIENCE + PER_LETTER * letters + PER_TEXT * texts
        if now is not None and time.thread_time() - begun > allowed:
            raise InputError(
                f"{where}: the expression {quoted(now[0])} takes too long to tell whether it is "
                f"in {quoted(now[1])}; write it without repeats of repeats, as (a+)+"
            )

    main = threading.current_thread() is threading.main_thread()
    if not (main and hasattr(signal, "SIGVTALRM")):
        yield search
        return
    before = signal.signal(signal.SIGVTALRM, look)
    signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE / 4, PATIENCE / 4)
    try:
        yield search
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


@dataclass(frozen=True)
class Rows:
    """A table under `header`: (line number, cells) each; `ignored`: line and reason.

    `header_line` is 0 without a header; `split_at` names the delimiter, or the kind of program.
    """

    header: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    ignored: list[tuple[int, str]]
    header_line: int = 0
    split_at: str = ""
    comments: tuple[str, ...] = ()


def table_rows(
    text: ForeignText, settings: TextSourceKeys, is_header: Judge | None, is_data: Judge
) -> Rows:
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
    with bounded_search(text.source) as search:
        for number, line in enumerate(text.lines, start=1):
            bare = line.strip()
            if not bare:
                continue
            if marks and bare.startswith(marks):
                comments.append((number, bare))
            elif skip is not None and search(skip, line):
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
    told = tuple(line for _, line in comments)
    return Rows(tuple(header), rows, ignored, header_line, delimiter, told)


def _sniffed(
    content: list[tuple[int, str]],
    comments: list[tuple[int, str]],
    marks: tuple[str, ...],
    is_header: Judge | None,
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

    best = sorted(DELIMITER_NAMES, key=numbers, reverse=True)
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
        self.character = DELIMITER_NAMES[delimiter]

    def one(self, number: int, line: str) -> list[str]:
        return next(cells for _, cells in self.all([(number, line)]))

    def all(self, lines: Sequence[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
        """(line number, cells) of each line; a quotation mark that runs on is an error."""
        reader = csv.reader(
            (" ".join(line.split()) if self.name == "space" else line for _, line in lines),
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
    marks: tuple[str, ...], is_header: Judge,
) -> tuple[int, tuple[str, ...]]:  # fmt: skip
    # Some write the names of the columns as a comment.
    for some, off in ((content, ()), (comments, sorted(marks, key=len, reverse=True))):
        for number, line in some[:SAMPLE]:
            for mark in off:
                line = line.removeprefix(mark)
            cells = tuple(cell.strip() for cell in split.one(number, line))
            if is_header(cells):
                return number, cells
    return 0, ()


def _unnamed_header(
    text: ForeignText, split: _Splitter, content: list[tuple[int, str]], is_data: Judge
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


class Clock:
    """Texts → seconds since 1970 (UTC); a time without a zone is taken as UTC.

    The first of `formats` (strptime, or ISO 8601) that reads a column's first text reads all.
    """

    def __init__(self, formats: Sequence[str]) -> None:
        self.formats = tuple(formats)
        self.chosen: str | None = None

    def seconds(self, text: str) -> float:
        """Seconds of one text.  Raises ValueError where no format fits."""
        for candidate in (self.chosen,) if self.chosen else (*self.formats, ISO):
            with suppress(ValueError):
                value = _moment(text, candidate)
                self.chosen = candidate
                return value
        raise ValueError(text)

    def complaint(self, where: str, text: str) -> InputError:
        """What to say of a text that `seconds` did not take."""
        expected = self.chosen or " or ".join([*self.formats, ISO])
        return InputError(
            f"{where}: {quoted(text)} is no time of the form {expected}; set time_format in "
            "[[source]]"
        )


def _moment(text: str, form: str) -> float:
    bare = " ".join(text.split())
    moment = datetime.fromisoformat(bare) if form == ISO else datetime.strptime(bare, form)
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    try:
        return moment.timestamp()
    except OverflowError:
        raise ValueError(text) from None


KRL_AXES = tuple(f"{letter}{i}" for letter in "AE" for i in range(1, 7))
RAPID_AXES = (*(f"rax_{i}" for i in range(1, 7)), *(f"eax_{letter}" for letter in "abcdef"))
NOT_CONNECTED = 9e9  # what RAPID writes for an external axis that does not exist
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
# Names begin where a word does, and no part gives back what it took: a line that is no statement
# is looked through once, not from each of its letters.
_KRL = re.compile(r"(?:(?<![\w$])([$A-Za-z_][\w$]*+(?:\[\s*+\d++\s*+\])?)\s*+=\s*+)?\{([^{}]*+)\}")
_KRL_PART = re.compile(r"([A-Za-z_]\w*+(?:\[\s*+\])?)\s++(\S.*)")
_RAPID_NAME = re.compile(r"(?:\b(\w++)\s++)?\b([A-Za-z]\w*+)\s*+(\{[\d,\s]*+\})?\s*+:=")
_RAPID_PAIR = re.compile(r"\[\s*+\[([^\[\]]*+)\]\s*+,\s*+\[([^\[\]]*+)\]\s*+\]")


def krl_rows(text: ForeignText) -> Rows:
    """Every aggregate of A1, A2 … (and E1 …) of a KRL .dat or .src file, or of a log of them.

    Aggregates of FRAME, POS and E6POS (X, Y, Z) hold no joint values and are passed over, named.
    Raises InputError for a joint value that is no number and where no aggregate has any.
    """
    found = Rows(("name", *KRL_AXES), [], [], split_at="KRL")
    whole = "\n".join(_uncommented(line, ";") for line in text.lines)
    count = _line_counter(whole)
    for match in _KRL.finditer(whole):
        line = count(match.start(2))
        # The display of a variable writes the type too: {E6AXIS: A1 0.0, …}
        body = re.sub(r"^\s*E?\d?[A-Za-z]*\d*AXIS\s*:", "", match[2], flags=re.IGNORECASE)
        parts = [m for part in body.split(",") if (m := _KRL_PART.fullmatch(part.strip()))]
        values = {m[1].upper(): m[2].strip() for m in parts}
        if "A1" not in values:
            if "X" in values:
                name = match[1] or "an aggregate"
                found.ignored.append((line, f"{name} is a Cartesian position, not joint values"))
            continue
        given = [_value(text, line, axis, values[axis]) if axis in values else ""
                 for axis in KRL_AXES]  # fmt: skip
        found.rows.append((line, [match[1] or "", *given]))
    return _complete(text, found, "no {A1 …, A2 …} with joint values")


def rapid_rows(text: ForeignText) -> Rows:
    """Every jointtarget [[rax_1 … rax_6], [eax_a … eax_f]] of a RAPID module or a log of them.

    An array's members are named P{1}, P{2} …; robtargets hold no joint values, and o_jointtarget
    is the position before a correction: both are passed over, named.
    Raises InputError for a value that is no number and where there is no jointtarget.
    """
    found = Rows(("name", *RAPID_AXES), [], [], split_at="RAPID")
    whole = "\n".join(_uncommented(line, "!") for line in text.lines)
    count = _line_counter(whole)
    start = 0
    for statement in re.split(r";", whole):
        _rapid_statement(text, found, statement, start, count)
        start += len(statement) + 1
    return _complete(text, found, "no jointtarget [[…], […]]")


def _rapid_statement(
    text: ForeignText, found: Rows, statement: str, start: int, count: Callable[[int], int]
) -> None:
    declared = _RAPID_NAME.search(statement)
    kind = (declared[1] or "").lower() if declared else ""
    name = declared[2] if declared else ""
    if kind in ("robtarget", "o_robtarget", "o_jointtarget") and declared:
        reason = "the position before a correction" if kind[0:2] == "o_" else "no joint values"
        found.ignored.append((count(start + declared.start(2)), f"{name} is {kind}: {reason}"))
        return
    pairs = [
        (match, [[part.strip() for part in match[k].split(",")] for k in (1, 2)])
        for match in _RAPID_PAIR.finditer(statement)
    ]
    targets = [(m, parts) for m, parts in pairs if len(parts[0]) == 6 and len(parts[1]) == 6]
    several = bool(declared and declared[3])
    for k, (match, (robot, external)) in enumerate(targets, start=1):
        line = count(start + match.start())
        both = zip(RAPID_AXES, [*robot, *external], strict=True)
        given = [_value(text, line, axis, cell) for axis, cell in both]
        cells = ["" if float(cell) >= NOT_CONNECTED else cell for cell in given]
        label = f"{name}{{{k}}}" if several else name
        found.rows.append((line, [label, *cells]))


def _value(text: ForeignText, line: int, axis: str, cell: str) -> str:
    if not _NUMBER.fullmatch(cell):
        raise InputError(
            f"{text.source}, line {line}: {axis} is {quoted(cell)}, not a number; log values, not "
            "expressions"
        )
    return cell


def _complete(text: ForeignText, found: Rows, what: str) -> Rows:
    if not found.rows:
        n = len(found.ignored)
        passed_over = f" ({n} Cartesian positions passed over)" if n else ""
        raise InputError(
            f"{text.source}: {what} in {len(text.lines)} lines{passed_over}; check the file, or "
            "its format in [source.text]"
        )
    # Axes that no row has (E1 … of a robot without them) are no columns.
    names = range(len(found.header))
    used = [i for i in names if i == 0 or any(cells[i] for _, cells in found.rows)]
    rows = [(line, [cells[i] for i in used]) for line, cells in found.rows]
    return replace(found, header=tuple(found.header[i] for i in used), rows=rows)


def _uncommented(line: str, mark: str) -> str:
    """The line up to a comment mark outside quotation marks."""
    found = re.match(rf"""(?:[^"{mark}]|"[^"]*(?:"|$))*""", line)
    return found[0] if found else line


def _line_counter(text: str) -> Callable[[int], int]:
    """The line in which an offset into the text lies."""
    ends = [match.start() for match in re.finditer("\n", text)]
    return lambda offset: bisect_left(ends, offset) + 1
