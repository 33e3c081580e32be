"""Exported files of unknown origin: encodings, tables and robot programs in them; their rows as a
mapping reads them, in numbers, texts and times, and what a row stands for."""

from __future__ import annotations

import codecs
import csv
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from elastocal import messages
from elastocal.files import decoded, read_bytes
from elastocal.importing import mapping_file
from elastocal.importing.mapping_file import ColumnKey, SourceTable, UnitsTable, compiled
from elastocal.messages import ElastocalError, InputError, did_you_mean, listed, quoted, require
from elastocal.model.effects.statics import STANDARD_GRAVITY
from elastocal.tables import MAX_LINE, NUMBER, column
from elastocal.units import FACTORS, Array, IntArray, convert, quantities

MAX_BYTES = 300_000_000
SAVE_AS = "set encoding in [source.text], or export as UTF-8"
_MARKS = (
    (codecs.BOM_UTF8, "UTF-8"), (codecs.BOM_UTF16_LE, "UTF-16"), (codecs.BOM_UTF16_BE, "UTF-16"),
)  # fmt: skip
_BINARY = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1", b"%PDF", b"#ROSBAG", b"SQLite format 3")
DELIMITER_NAMES = {"tab": "\t", ";": ";", ",": ",", "space": " "}
SAMPLE = 200  # lines that decide on the delimiter, and in which a header is looked for
SHOWN = 120

Line = tuple[int, list[str]]  # its number and cells


def read_lines(path: str | Path, encoding: str = "auto") -> tuple[list[str], str]:
    """The lines of a text file without their ends, and its encoding.  `encoding` "auto": by the
    byte order mark, else UTF-8 where the bytes allow, else Windows-1252 (Latin-1 where that has no
    character)."""
    source = str(path)
    data = read_bytes(path, "export", MAX_BYTES)
    require(data.strip(), f"{source}: empty file; export it again")
    told = "is a workbook, bag, archive or other binary file; export its table as text (CSV)"
    require(not data.startswith(_BINARY), f"{source}: {told}")
    text, name = _decode(source, data, encoding)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        told = "NUL characters, so this is no text, or UTF-16 without its mark; export it as text"
        raise InputError(f"{source}, line {line}: {told} (CSV), or set encoding")
    # Not splitlines: a form feed or U+2028 in a comment ends no line for an editor.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, content in enumerate(lines, start=1):
        if len(content) > MAX_LINE:
            told = f"longer than {MAX_LINE // 1024} KiB; this is no table of readings"
            raise InputError(f"{source}, line {number}: {told}")
    return lines, name


def _decode(source: str, data: bytes, encoding: str) -> tuple[str, str]:
    marked = (name for mark, name in _MARKS if encoding == "auto" and data.startswith(mark))
    if (name := next(marked, encoding)) != "auto":
        codec = "utf-8-sig" if name.lower() == "utf-8" else name
        return decoded(source, data, SAVE_AS, codec, name), name
    plain = "ASCII" if data.isascii() else "UTF-8"
    for codec, name in (("utf-8", plain), ("cp1252", "Windows-1252")):
        with suppress(UnicodeDecodeError):
            return data.decode(codec), name
    return data.decode("latin-1"), "Latin-1"


@dataclass(frozen=True)
class Rows:
    """A table under `header`: (line number, cells) each; `ignored`: line and reason; `layout`: how
    its columns stand, or the kind of program."""

    header: tuple[str, ...]
    rows: list[Line]
    ignored: list[tuple[int, str]]
    layout: str
    comments: tuple[str, ...] = ()


def table_rows(
    source: str, lines: list[str], settings: mapping_file.TextSourceKeys, asked: Sequence[ColumnKey]
) -> Rows:
    """Where columns are asked for by name the header is the line that has them; else the table
    begins at the first line with numbers where they are asked for, and the line before it is its
    header if it has as many cells.  Lines above the table, repeated headers and lines that match
    `ignore` are passed over and listed."""
    guess = mapping_file.NumberCells("auto", settings.thousands, settings.missing, ())
    numbers = (c.at[0] for c in asked if c.required and c.quantities)
    places = [at for at in numbers if isinstance(at, int)]
    named = any(isinstance(part, str) for c in asked if c.required for part in c.at)
    content, comments, ignored = _sorted_lines(source, lines, settings)
    tried = _by_numbers(content) if settings.delimiter == "auto" else [settings.delimiter]
    # Some write the names of the columns as a comment.
    marks = sorted(settings.comments, key=len, reverse=True)
    mark = re.compile("".join(f"(?:{re.escape(m)})?" for m in marks))
    plain = [(number, mark.sub("", line, count=1)) for number, line in comments[:SAMPLE]]
    delimiter, begin, header_line, header = tried[0], 0, 0, list[str]()
    for way, (number, line) in product(tried, [*content[:SAMPLE], *plain]) if named else ():
        cells = _cells(way, line) or []
        if not mapping_file.lacking(asked, cells):
            delimiter, header_line, header = way, number, cells
            break
    table = list(_split(source, delimiter, content))
    if not named:
        first = next(
            (k for k, (_, cells) in enumerate(table[:SAMPLE])
             if all(at <= len(cells) and guess.looks_numeric(cells[at - 1]) for at in places)),
            None,
        )  # fmt: skip
        if first is None:
            number, line = content[0]
            raise InputError(
                f"{source}, line {number}: no numbers where the mapping has them, in "
                f"{quoted(line.strip())} and the {min(len(content), SAMPLE) - 1} lines after it "
                f"(columns split at {delimiter!r}); correct the places or the delimiter in [source]"
            )
        begin = table[first][0]
        if first and len(table[first - 1][1]) == len(table[first][1]):
            header_line, header = table[first - 1]
    above = f"stands above the {'header' if header_line else 'first reading'}"
    rows: list[Line] = []
    for number, cells in table:
        if number < (header_line or begin):
            ignored.append((number, above))
        elif header and cells == header and number != header_line:
            ignored.append((number, "repeats the header"))
        elif any(cells) and number != header_line:
            rows.append((number, cells))
    if not rows:
        raise InputError(f"{source}: a header but no readings below it; export the points")
    if named and not header_line:  # which line comes nearest, and what it lacks
        lacks = [(mapping_file.lacking(asked, row[1]), row) for row in rows[:SAMPLE]]
        least, (number, cells) = min(lacks, key=lambda one: (len(one[0]), -len(one[1][1])))
        raise InputError(
            f"{source}: no line has all the columns that the mapping names; line {number} has "
            f"{listed(map(quoted, cells), 12)}, but not {listed(least, 8)}: correct "
            "the names, the delimiter or the comments in [source], or give columns by number"
        )
    at = {"tab": "tabs", "space": "blanks"}.get(delimiter, f"{delimiter!r}")
    head = f"header in line {header_line}" if header_line else "no header"
    told = tuple(line for _, line in comments)
    return Rows(tuple(header), rows, ignored, f"columns split at {at}, {head}", told)


Numbered = list[tuple[int, str]]  # lines with their numbers


def _sorted_lines(
    source: str, lines: list[str], settings: mapping_file.TextSourceKeys
) -> tuple[Numbered, Numbered, Numbered]:
    marks = tuple(settings.comments)
    skip = None if settings.ignore is None else compiled(source, "ignore", settings.ignore)
    content, comments, ignored = Numbered(), Numbered(), Numbered()
    for number, line in enumerate(lines, start=1):
        bare = line.strip()
        if marks and bare.startswith(marks):
            comments.append((number, bare))
        elif bare and skip is not None and skip.search(line):
            ignored.append((number, f"matches ignore: {bare[:SHOWN]}"))
        elif bare:
            content.append((number, line))
    if not content:
        raise InputError(f"{source}: only comments and blank lines; export the points again")
    return content, comments, ignored


def _split(source: str, delimiter: str, lines: Numbered) -> Iterator[Line]:
    for number, line in lines:
        if (cells := _cells(delimiter, line)) is None:
            raise InputError(
                f"{source}, line {number}: quotation marks do not match in "
                f"{quoted(line.strip())}; close them on the same line"
            )
        yield number, cells


def _cells(delimiter: str, line: str) -> list[str] | None:
    """None where a quotation mark runs on beyond the line."""
    text = " ".join(line.split()) if delimiter == "space" else line
    reader = csv.reader([text, ""], delimiter=DELIMITER_NAMES[delimiter], skipinitialspace=True)
    cells = next(reader)
    return [cell.strip() for cell in cells] if reader.line_num == 1 else None


def _by_numbers(content: Numbered) -> list[str]:
    """By how many cells that are numbers they leave in a line of the median; commas may be decimal
    marks."""

    def numbers(delimiter: str) -> int:
        lines = (_cells(delimiter, line) or [] for _, line in content[:SAMPLE])
        counts = sorted(sum(bool(NUMBER.fullmatch(cell)) for cell in cells) for cells in lines)
        return counts[len(counts) // 2]

    found = {delimiter: numbers(delimiter) for delimiter in DELIMITER_NAMES}
    found["space"] *= not found["tab"]  # between tabs blanks are part of names
    return sorted(found, key=lambda delimiter: found[delimiter], reverse=True)


KRL_AXES = tuple(f"{letter}{i}" for letter in "AE" for i in range(1, 7))
RAPID_AXES = (*(f"rax_{i}" for i in range(1, 7)), *(f"eax_{letter}" for letter in "abcdef"))
NOT_CONNECTED = 9e9  # what RAPID writes for an external axis that does not exist
NO_JOINTS = dict.fromkeys(("o_robtarget", "o_jointtarget"), "the position before a correction")
NO_JOINTS["robtarget"] = "no joint values"
# Names begin where a word does, and no part gives back what it took: a line that is no statement
# is looked through once, not from each of its letters.
_KRL = re.compile(r"(?:(?<![\w$])([$A-Za-z_][\w$]*+(?:\[\s*+\d++\s*+\])?)\s*+=\s*+)?\{([^{}]*+)\}")
_KRL_PART = re.compile(r"([A-Za-z_]\w*+(?:\[\s*+\])?)\s++(\S.*)")
# Above a move and below it in a program of `design`.
_OF_DESIGN = re.compile("; (?:configuration (.+)|via point|home$)")
_MEASURED = re.compile(r"; measure configuration (.*), (?:no|load of \((.+), (.+), (.+)\) N)")
_RAPID_NAME = re.compile(r"(?:\b(\w++)\s++)?\b([A-Za-z]\w*+)\s*+(\{[\d,\s]*+\})?\s*+:=")
_RAPID_PAIR = re.compile(r"\[\s*+\[([^\[\]]*+)\]\s*+,\s*+\[([^\[\]]*+)\]\s*+\]")


def program_rows(source: str, lines: list[str], kind: str) -> Rows:
    """The joint values in a robot program, KRL or RAPID, or in a log of its variables.  KRL: every
    aggregate of A1, A2 … (and E1 …); FRAME, POS and E6POS (X, Y, Z) are passed over.  RAPID: every
    jointtarget [[rax_1 … rax_6], [eax_a … eax_f]], an array's members named P{1}, P{2} …;
    robtargets hold no joint values and o_jointtarget is the position before a correction: both are
    passed over, and named, as are via points of a program of `design`, whose comments name poses
    and loads."""
    axes, mark, read, what = {
        "krl": (KRL_AXES, ";", _krl, "no {A1 …, A2 …} with joint values"),
        "rapid": (RAPID_AXES, "!", _rapid, "no jointtarget [[…], […]]"),
    }[kind]
    hung = [f"{stem}_N" for stem in FORCES]
    # Comments, outside quotation marks, go.
    bare = re.compile(rf"""(?:[^"{mark}]|"[^"]*(?:"|$))*""")
    whole = "\n".join(found[0] for line in lines if (found := bare.match(line)))
    ends = [match.start() for match in re.finditer("\n", whole)]
    rows: list[tuple[int, dict[str, str]]] = []
    ignored: list[tuple[int, str]] = []
    for offset, name, values in read(whole):
        line = bisect_left(ends, offset) + 1
        if isinstance(values, str):
            ignored.append((line, f"{name} {values}"))
            continue
        for axis, cell in values.items():
            if not NUMBER.fullmatch(cell):
                raise InputError(
                    f"{source}, line {line}: {axis} is {quoted(cell)}, not a number; log "
                    "values, not expressions"
                )
        if own := _OF_DESIGN.match(lines[line - 2] if line > 1 else ""):
            if own[1] is None:
                ignored.append((line, "home or a via point, not measured"))
                continue
            name = name or own[1]
        kept = {axis: v for axis, v in values.items() if kind == "krl" or float(v) < NOT_CONNECTED}
        for load in filter(None, map(_MEASURED.match, lines[line : line + 3])):
            if own and load[1] == own[1]:  # at once, or after a stop to change the load
                kept |= dict(zip(hung, load.groups("0")[1:], strict=True))
        rows.append((line, {"name": name} | kept))
    passed_over = f" ({len(ignored)} Cartesian positions passed over)" if ignored else ""
    if not rows:
        raise InputError(
            f"{source}: {what} in {len(lines)} lines{passed_over}; check the file, or "
            "its format in [source.text]"
        )
    # Axes that no row has (E1 … of a robot without them) are no columns.
    header = tuple(h for h in ("name", *axes, *hung) if any(h in own for _, own in rows))
    cells = [(line, [own.get(h, "") for h in header]) for line, own in rows]
    return Rows(header, cells, ignored, kind.upper())


# Offset into the text, name, and the values by axis or why there are none.
Found = Iterator[tuple[int, str, dict[str, str] | str]]


def _krl(whole: str) -> Found:
    for match in _KRL.finditer(whole):
        # The display of a variable writes the type too: {E6AXIS: A1 0.0, …}
        body = re.sub(r"^\s*E?\d?[A-Za-z]*\d*AXIS\s*:", "", match[2], flags=re.IGNORECASE)
        parts = [m for part in body.split(",") if (m := _KRL_PART.fullmatch(part.strip()))]
        values = {m[1].upper(): m[2].strip() for m in parts}
        if "A1" in values:
            known = {axis: values[axis] for axis in KRL_AXES if axis in values}
            yield match.start(2), match[1] or "", known
        elif "X" in values:
            told = "is a Cartesian position, not joint values"
            yield match.start(2), match[1] or "an aggregate", told


def _rapid(whole: str) -> Found:
    start = 0
    for statement in whole.split(";"):
        declared = _RAPID_NAME.search(statement)
        kind, name, several = declared.groups() if declared else ("", "", "")
        if declared and (why := NO_JOINTS.get((kind or "").lower())):
            yield start + declared.start(2), name, f"is {kind.lower()}: {why}"
        else:
            k = 0
            for match in _RAPID_PAIR.finditer(statement):
                cells = [[part.strip() for part in match[i].split(",")] for i in (1, 2)]
                if list(map(len, cells)) == [6, 6]:
                    k += 1
                    values = dict(zip(RAPID_AXES, cells[0] + cells[1], strict=True))
                    yield start + match.start(), f"{name}{{{k}}}" if several else name, values
        start += len(statement) + 1


FORCES = tuple(f"force_{axis}" for axis in "xyz")
MAX_ROWS = 2_000_000
DECIMAL_SAMPLE = 2000
UNIT_OF_LOAD = r"[ _([](kg|kN|N)[])]?$"  # payload_kg, Load [N]: its cells are sizes


@dataclass(frozen=True)
class Records:
    """n rows of exported files; `file` (n,) and `line` (n,) say where each stands.  `numbers` stem
    → (n,) in `units[stem]`, the units of the table to be written; `texts` (name, configuration,
    marker, repeat, load) → n texts; `load` of all rows, where one is stated; `understood`: what was
    made of the file, for people; `ignored`: line and reason; `doubts`: what to warn of."""

    file: list[str]
    line: IntArray
    numbers: dict[str, Array]
    units: dict[str, str]
    texts: dict[str, list[str]]
    understood: dict[str, Any]
    ignored: set[tuple[int, str]]
    load: str | None = None
    doubts: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.line)

    @property
    def files(self) -> list[str]:
        return list(dict.fromkeys(self.file))

    @property
    def source(self) -> str:
        return self.file[0]

    @property
    def names(self) -> list[str]:
        return self.texts.get("name", [""] * len(self))

    def where(self, i: int) -> str:
        return f"{self.file[i]}, line {self.line[i]}"

    @property
    def forces(self) -> list[str]:
        return [stem for stem in FORCES if stem in self.numbers]

    def shown(self, i: int) -> str:
        name = self.names[i]
        return f"{name} (line {self.line[i]})" if name else f"line {self.line[i]}"

    def clock(self, how: str) -> Array:
        """(n,) s on the file's clock, by which rows are to be joined."""
        if "time" not in self.numbers:
            raise InputError(
                f"{self.source}: no times, by which [join] is to join by {how}; map time_s or "
                "time_text in [source.columns], or join by order or name"
            )
        return self.numbers["time"]

    @property
    def q(self) -> Array:
        """(n, joints) in the units of their columns."""
        stems = joint_stems(self.numbers)
        return np.column_stack([np.zeros((len(self), 0)), *(self.numbers[s] for s in stems)])

    def spread(self, deg: float, mm: float) -> Array:
        """(joints,) these tolerances in the unit of each joint."""
        units = (self.units[stem] for stem in joint_stems(self.numbers))
        return np.array([deg if unit == "deg" else mm for unit in units])

    def take(self, rows: IntArray) -> Records:
        return replace(
            self,
            file=[self.file[i] for i in rows],
            line=self.line[rows],
            numbers={stem: values[rows] for stem, values in self.numbers.items()},
            texts={stem: [own[i] for i in rows] for stem, own in self.texts.items()},
        )


def joint_stems(numbers: Iterable[str]) -> list[str]:
    found = [stem for stem in numbers if re.fullmatch(r"q\d+", stem)]
    return sorted(found, key=lambda stem: int(stem[1:]))


def read_records(where: str, path: Path, source: SourceTable, units: UnitsTable) -> Records:
    """One for each marker where a row has several.  A row with an empty cell where a number belongs
    is passed over and listed; of a marker without a value that one alone."""
    settings, name = source.text, str(path)
    asked = mapping_file.wanted(where, source.columns, source.optional)
    lines, encoding = read_lines(path, settings.encoding)
    if settings.format != "table":
        table = program_rows(name, lines, settings.format)
    else:
        table = table_rows(name, lines, settings, asked)
    if len(table.rows) > MAX_ROWS:
        raise InputError(f"{name}: more than {MAX_ROWS:,} rows; thin the export out")
    hint = mapping_file.unit_in_comments(where, settings.unit_comment, table.comments)
    width = len(table.rows[0][1])
    columns = {
        marker: mapping_file.resolve(
            name, [c.of_marker(marker) for c in asked], table.header, width, units, hint
        )
        for marker in mapping_file.markers_of_row(name, asked, table.header) or [""]
    }
    no_unit = {c.header: c for own in columns.values() for c in own if c.unit == mapping_file.AUTO}
    columns = {m: tuple(c for c in own if c.header not in no_unit) for m, own in columns.items()}
    every = [c for own in columns.values() for c in own]
    cells = mapping_file.NumberCells(
        settings.decimal, settings.thousands, settings.missing,
        (row[c.index[0]] for _, row in table.rows[:DECIMAL_SAMPLE]
         for c in every if c.quantities and c.index[0] < len(row)),
    )  # fmt: skip
    kept, numbers, of, ignored = _rows(name, table, columns, cells, source.coverage_factor)
    texts = {}
    for c in (c for c in next(iter(columns.values())) if not c.quantities):
        glue = " " if c.stem == "time_text" else "::"
        texts[c.stem] = [glue.join(row[i].strip() for i in c.index) for _, row, *_ in kept]
        # A load that is a bare size gets the unit in its header.
        if c.stem == "load" and (unit := re.search(UNIT_OF_LOAD, c.header)):
            bare = re.compile(r"[\d.,]+")
            texts["load"] = [f"{t} {unit[1]}" if bare.fullmatch(t) else t for t in texts["load"]]
    if "" not in columns:
        texts["marker"] = [marker for _, _, marker, _ in kept]
    line = np.array([number for number, *_ in kept], dtype=np.int64)
    written = texts.pop("time_text", None)
    if written is not None and "time" not in numbers:
        form = source.time_format or ()
        formats = [form] if isinstance(form, str) else form
        seconds = mapping_file.seconds_of(name, line.tolist(), written, formats)
        numbers["time"], of["time"] = np.array(seconds), "s"
    used = {i for c in every for i in c.index}
    understood = {
        "file": name, "preset": source.preset, "role": "",
        "encoding": encoding, "layout": table.layout, "decimal": cells.decimal,
        "columns": [
            {"from": header, "to": column(stem, unit), "unit": unit}
            for header, stem, unit in dict.fromkeys((c.header, c.stem, c.unit) for c in every)
        ],
        "unused": tuple(n or f"column {i}" for i, n in enumerate(table.header, 1)
                        if i - 1 not in used),
    }  # fmt: skip
    told = f"{name}: column %r states no unit and is not read; name it with one, as %s [%s]"
    doubts = [told % (n, c.stem, next(iter(FACTORS[c.quantities[0]]))) for n, c in no_unit.items()]
    return Records(
        [name] * len(line), line, numbers, of, texts, understood, {*table.ignored, *ignored},
        source.load, doubts,
    )  # fmt: skip


KeptRow = tuple[int, list[str], str, list[float]]  # line, cells, marker, and its numbers


def _rows(
    name: str, table: Rows, columns: Mapping[str, Sequence[ColumnKey]],
    cells: mapping_file.NumberCells, coverage: float,
) -> tuple[list[KeptRow], dict[str, Array], dict[str, str], list[tuple[int, str]]]:  # fmt: skip
    """Complete rows, their numbers by column and the units of the measurement table that these are
    in; what is passed over and why."""
    widest = max((c for own in columns.values() for c in own), key=lambda c: max(c.index))
    kept, ignored = list[KeptRow](), list[tuple[int, str]]()
    for number, row in table.rows:
        at = max(widest.index) + 1
        what = f"{widest.key} is column {at} ({widest.header})" if at > len(row) else ""
        if table.header and any(row[len(table.header) :]):  # which of them is more, nobody knows
            what = f"the header has {len(table.header)} ({table.layout})"
        if what:
            raise InputError(
                f"{name}, line {number}: {len(row)} columns, but {what}; correct the line or the "
                "delimiter, or pass over such lines with ignore in [source.text]"
            )
        for marker, own in columns.items():
            found = []
            for c in (c for c in own if c.quantities):
                value = cells.value(name, number, c.header, row[c.index[0]])
                if value is None:
                    ignored.append((number, f"no value in column {c.header}"))
                    break
                found.append(value)
            else:
                kept.append((number, row, marker, found))
    if not kept:
        number, reason = ignored[0]
        raise InputError(
            f"{name}: none of its {len(table.rows)} rows is complete (line {number}: "
            f"{reason}); correct the places in [source.columns]"
        )
    of_row, numbers, of = np.array([row[2] for row in kept]), dict[str, Array](), dict[str, str]()
    for marker, own in columns.items():
        rows = np.flatnonzero(of_row == marker)
        for k, c in enumerate(c for c in own if c.quantities):
            sigma = c.stem.startswith("sigma_")
            of[c.stem] = "um" if sigma else next(iter(FACTORS[quantities(c.unit)[0]]))
            values = np.array([kept[i][3][k] for i in rows])
            values = convert(values, c.unit, of[c.stem]) / (coverage if sigma else 1.0)
            # Seconds and nanoseconds of a time add up.
            numbers.setdefault(c.stem, np.zeros(len(kept)))[rows] += values
    return kept, numbers, of, ignored


def likely_presets(path: Path) -> list[str]:
    rows = dict[str, int]()
    for name in mapping_file.PRESETS:
        where, mapping = mapping_file.read_mapping(None, [name], "mm", "deg")
        for source in mapping.source or ():
            with suppress(ElastocalError):
                rows[name] = len(read_records(where, path, source, mapping.units))
    return [name for name, n in rows.items() if n == max(rows.values())]


HEIGHT = ("zenith", "elevation")
SPHERICAL = ("range", "azimuth", *HEIGHT)


def with_positions(records: Records, clockwise: bool = False) -> Records:
    """With x, y, z where the file has range d, azimuth α and zenith angle ζ (π/2 − elevation), in a
    right-handed frame with z up and x at azimuth zero:

        x = d sin ζ cos α,   y = d sin ζ sin α,   z = d cos ζ

    α counts counterclockwise seen from above; where `clockwise`, as theodolites count, y has the
    other sign.  Readings in the second face, ζ beyond 180° with α turned by 180°, come out right.
    """
    found = [stem for stem in SPHERICAL if stem in records.numbers]
    both = [stem for stem in "xyz" if stem in records.numbers]
    heights = [stem for stem in HEIGHT if stem in found]
    missing = [stem for stem in ("range", "azimuth") if stem not in found]
    missing += [] if heights else ["zenith or elevation"]
    if not found:
        return records
    for wrong, told in (
        (both, f"positions are mapped twice, as {listed(both)} and as {listed(found)}; keep one of "
         "the two in [source.columns]"),
        (len(heights) > 1, "both zenith and elevation are mapped; keep the one that the file gives "
         "(a level line has zenith 90° and elevation 0°)"),
        (missing, f"{listed(found)} without {listed(missing)}; map range_mm, azimuth_deg, and "
         "zenith_deg or elevation_deg in [source.columns]"),
    ):  # fmt: skip
        require(not wrong, f"{records.source}: {told}")
    height, numbers = heights[0], dict(records.numbers)
    d = numbers.pop("range")
    alpha, angle = np.radians(numbers.pop("azimuth")), numbers.pop(height)
    low, high, other = (0.0, 360.0, "elevation") if height == "zenith" else (-90.0, 90.0, "zenith")
    # Of each the first row, if any.
    for i in np.flatnonzero(~(d > 0))[:1]:
        raise InputError(
            f"{records.where(i)}: a range of {d[i]:g} mm; a distance is positive: correct the "
            "line, or the column of range in [source.columns]"
        )
    for i in np.flatnonzero((angle < low) | (angle > high))[:1]:
        raise InputError(
            f"{records.where(i)}: {height} of {angle[i]:.6g}°, which lies beyond {low:g}° to "
            f"{high:g}°; is it an angle of another unit, or {other}_deg?"
        )
    zeta = np.radians(angle if height == "zenith" else 90.0 - angle)
    level = d * np.sin(zeta)
    y = level * np.sin(alpha)
    numbers |= {"x": level * np.cos(alpha), "y": -y if clockwise else y, "z": d * np.cos(zeta)}
    kept = {stem: unit for stem, unit in records.units.items() if stem not in SPHERICAL}
    return replace(records, numbers=numbers, units=kept | dict.fromkeys("xyz", "mm"))


GROUPS = ("configuration", "marker", "repeat", "load")
NAMED = "write pattern in [source.names]"


def with_labels(where: str, records: Records, names: mapping_file.NamesTable) -> Records:
    """With the texts of GROUPS, from columns and, where a pattern is given, from names, if no
    column gives them.  A name that no pattern matches is an error, or with unmatched = "ignore"
    passed over and listed."""
    if names.pattern is not None and "name" in records.texts:
        records = _with_names_read(where, records, names)
    labels = {stem: records.texts[stem] for stem in GROUPS if stem in records.texts}
    if "marker" in labels:
        labels["marker"] = [names.markers.get(m, m) for m in labels["marker"]]
    elif names.in_order:
        times, more = divmod(len(records), len(names.in_order))
        labels["marker"] = names.in_order * times
        require(
            not more,
            f"{records.source}: {len(records)} points, which is no multiple of the "
            f"{len(names.in_order)} markers {listed(names.in_order)} of in_order; a point is "
            "missing or one too many: name the points",
        )
    for stem, texts in labels.items():
        for i, text in enumerate(texts):
            if not messages.is_label(text):
                told = f"cannot stand in a table; correct the name, or {NAMED}"
                raise InputError(f"{records.where(i)}: {stem} {quoted(text)} {told}")
    return replace(records, texts=records.texts | labels)


def _with_names_read(where: str, records: Records, names: mapping_file.NamesTable) -> Records:
    named = records.texts["name"]
    patterns = [names.pattern] if isinstance(names.pattern, str) else list(names.pattern or ())
    expressions = [compiled(where, "pattern", text) for text in patterns]
    for expression in expressions:
        require(
            set(expression.groupindex) & set(GROUPS),
            f"{where}: pattern = {quoted(expression.pattern)} has none of the groups "
            f"{listed(f'(?P<{g}>…)' for g in GROUPS)}; name the parts of the name so",
        )
    matches = [next((m for e in expressions if (m := e.search(n))), None) for n in named]
    groups = [match.groupdict() if match else {} for match in matches]
    bad = [i for i, match in enumerate(matches) if match is None]
    if bad and (names.unmatched != "ignore" or len(bad) == len(named)):
        more = {1: "", 2: ", nor does 1 other"}.get(len(bad), f", nor do {len(bad) - 1} others")
        raise InputError(
            f"{records.where(bad[0])}: the name {quoted(named[bad[0]])} matches no pattern "
            f'({listed(map(quoted, patterns), 3)}){more}; {NAMED}, or unmatched = "ignore" to '
            "leave such points out"
        )
    found = {stem: [(own.get(stem) or "").strip() for own in groups] for stem in GROUPS}
    present = {stem: texts for stem, texts in found.items() if any(texts)}
    unsaid = {"repeat": "0", "load": "none"}
    for stem, texts in present.items():
        for i, text in enumerate(texts):
            if not text and matches[i] and stem not in unsaid:
                raise InputError(
                    f"{records.where(i)}: the name {quoted(named[i])} says no {stem}, others do; "
                    f"{NAMED} that finds it in every name"
                )
        present[stem] = [text or unsaid.get(stem, "") for text in texts]
    reasons = {(int(records.line[i]), f"{quoted(named[i])} matches no pattern") for i in bad}
    good = np.setdiff1d(np.arange(len(records)), bad)
    made = replace(records, texts=present | records.texts, ignored=records.ignored | reasons)
    return made.take(good)


UNLOADED = ("none", "unloaded", "0")


def forces_of(
    where: str, points: Records, loads: Mapping[str, Array | mapping_file.LoadStatesTable]
) -> Array | None:
    """(n, 3) N in the tracker's frame (z up) for each point; None where no load is told.  A mass m
    hangs straight down: force (0, 0, -9.80665 m); so does a load whose name is a size, as "2600 N"
    or "2.5 kg", unless [loads] has it."""
    named = points.texts.get("load")
    if named is None:
        require(
            not loads or points.forces,
            f"{where}: [loads] names {listed(loads)}, but no file says which load it belongs to; "
            "give load in [[source]], or a group (?P<load>…) in a pattern",
        )
        return None
    told = f"the load is stated by name and in columns {listed(points.forces)}; keep one"
    require(not points.forces, f"{points.source}: {told}")
    known = {name: np.zeros(3) for name in UNLOADED}
    for name, stated in loads.items():
        if isinstance(stated, mapping_file.LoadStatesTable):
            stated = np.array([0.0, 0.0, -stated.mass_kg * STANDARD_GRAVITY])
        known[name] = stated + 0.0  # no -0.0
    for i, name in enumerate(named):
        if name not in known and (size := load_in(name)):
            known[name] = np.array([0.0, 0.0, 0.0 - size[1]])
        if name not in known:
            told = f"{points.where(i)}: load {quoted(name)} is not in [loads] of {where}"
            add = f"add {name} = [0, 0, -1000] in N, or {name} = {{ mass_kg = 100 }}"
            raise InputError(f"{told}{did_you_mean(name, known)}; there are {listed(known)}: {add}")
    return np.array([known[name] for name in named])


# A load in a file's name: log_2600N, payload_2p5kg, load2.6kN.  A number that follows a letter is a
# load only after a word for one; a small n counts something.
_SIZE = re.compile(
    r"(?:(?<![A-Za-z0-9.,])|(?<=load)|(?<=mass)|(?<=weight))(\d+(?:[.,p]\d+)?)[ _-]?"
    r"([kK][gG]|kN|N)(?![A-Za-z0-9])"
)
_WORD = re.compile(r"(?<!un)(?<!no)(?<!without)[ _-]?(?:pay)?load(?:ed)?(?![a-z])|weight", re.I)
_NEWTONS = {"kg": STANDARD_GRAVITY, "kn": 1e3, "n": 1.0}


def load_in(text: str) -> tuple[str, float] | None:
    found = _SIZE.search(text)
    if found is None:
        return None
    size = float(re.sub("[,p]", ".", found[1]))
    return f"{size:g} {found[2]}", size * _NEWTONS[found[2].lower()]


def with_loads_of_names(
    by_role: Mapping[str, list[Records]], loads: Mapping[str, Any]
) -> tuple[dict[str, list[Records]], list[str]]:
    """With the loads that their files are named for, hanging straight down, where nothing else
    states any, and what to tell."""
    every = [r for role in by_role.values() for r in role]
    named = {r.source: load_in(Path(r.source).stem) for r in every}
    # A log's forces are what was planned: names of files win.
    forces = [*by_role["points"], *([] if any(named.values()) else by_role["joints"])]
    if loads or any(r.load or "load" in r.texts for r in every) or any(r.forces for r in forces):
        return dict(by_role), []
    if not any(named.values()):
        told = [r.source for r in every if _WORD.search(Path(r.source).stem)]
        told += [f"column {name} of {r.source}" for r in every
                 for name in r.understood["unused"] if _WORD.search(name)]  # fmt: skip
        return dict(by_role), [
            f"{listed(told)}: named for a load that is not taken, and the rows are written "
            "unloaded; state it by load in [[source]] and [loads], or by load = \"…\" in "
            "[source.columns]"
        ] if told else []  # fmt: skip
    made = {role: [replace(r, load=(named[r.source] or UNLOADED[1:])[0]) for r in files]
            for role, files in by_role.items()}  # fmt: skip
    if not any(named[r.source] for r in by_role["points"]):
        # The points are those of the joint logs.
        only = {r.load for r in made["joints"]}
        if len(only) > 1:
            raise InputError(
                f"{by_role['joints'][0].source}: joint logs are named for the loads "
                f"{listed(sorted(map(str, only)))} and the points for none; give load in the "
                "[[source]] of each file of points"
            )
        made["points"] = [replace(r, load=next(iter(only))) for r in by_role["points"]]
    elif not any(named[r.source] for r in by_role["joints"]):
        made["joints"] = list(by_role["joints"])  # one log for every load
    return made, [
        f"{r.source}: taken as measured under {found[0]} by its name, hanging straight down "
        f"(0, 0, {0.0 - found[1]:.6g}) N; load in [[source]] states another"
        for r in every
        if (found := named[r.source])
    ]
