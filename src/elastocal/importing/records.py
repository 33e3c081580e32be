"""One exported file as the mapping reads it: columns, numbers with units, texts, times."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from elastocal.errors import ElastocalError, InputError
from elastocal.importing import foreign_text, mapping_file
from elastocal.importing.foreign_text import ForeignText, NumberCells, Rows
from elastocal.importing.mapping_file import ColumnKey, FileColumn, SourceTable, UnitsTable
from elastocal.tables import column
from elastocal.text import is_label, listed, quoted
from elastocal.units import Array, IntArray, convert, quantities

MAX_ROWS = 2_000_000
DECIMAL_SAMPLE = 2000
UNIT_OF_LOAD = r"[ _([](kg|kN|N)[])]?$"  # payload_kg, Load [N]: its cells are sizes


@dataclass(frozen=True)
class Understood:
    """What was made of a file, for people.

    `columns`: (its name in the file, column of the measurement table, unit); `unused`: names of
    the file's other columns; `ignored`: (line, reason) of everything passed over.
    """

    path: str
    preset: str | None
    role: str
    encoding: str
    layout: str
    decimal: str
    columns: tuple[tuple[str, str, str], ...]
    unused: tuple[str, ...]
    rows: int
    ignored: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Records:
    """n rows of `files`; `file` (n,) and `line` (n,) say where each stands.

    `numbers` stem → (n,) in `units[stem]`, the units of the table to be written; `texts` and
    `labels` (configuration, marker, repeat, load) → n texts; `load` of all rows, where one is
    stated.
    """

    files: tuple[str, ...]
    file: IntArray
    line: IntArray
    numbers: dict[str, Array]
    units: dict[str, str]
    texts: dict[str, list[str]]
    understood: Understood
    load: str | None = None
    labels: dict[str, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.line)

    @property
    def source(self) -> str:
        return self.files[0]

    @property
    def names(self) -> list[str]:
        return self.texts.get("name", [""] * len(self))

    def where(self, i: int) -> str:
        return f"{self.files[self.file[i]]}, line {self.line[i]}"

    def shown(self, i: int) -> str:
        """Row i for a list in a message: its name and line."""
        name = self.names[i]
        return f"{name} (line {self.line[i]})" if name else f"line {self.line[i]}"

    @property
    def time(self) -> Array | None:
        """(n,) s on the file's clock."""
        return self.numbers.get("time")

    @property
    def q(self) -> Array:
        """(n, joints) joint values in the units of their columns."""
        stems = joint_stems(self.numbers)
        return np.column_stack([np.zeros((len(self), 0)), *(self.numbers[s] for s in stems)])

    @property
    def q_units(self) -> tuple[str, ...]:
        return tuple(self.units[stem] for stem in joint_stems(self.numbers))

    def spread(self, deg: float, mm: float) -> Array:
        """(joints,) these tolerances in the unit of each joint."""
        return np.array([deg if unit == "deg" else mm for unit in self.q_units])

    def take(self, rows: IntArray) -> Records:
        return replace(
            self,
            file=self.file[rows],
            line=self.line[rows],
            numbers={stem: values[rows] for stem, values in self.numbers.items()},
            texts=_taken(self.texts, rows),
            labels=_taken(self.labels, rows),
        )

    @classmethod
    def stacked(cls, parts: Sequence[Records]) -> Records:
        """The rows of all parts, which have the same numbers in the same units."""
        sizes = [len(part.files) for part in parts]
        first = np.repeat(np.cumsum([0, *sizes[:-1]]), [len(part) for part in parts])
        return replace(
            parts[0],
            files=tuple(file for part in parts for file in part.files),
            file=np.concatenate([part.file for part in parts]) + first,
            line=np.concatenate([part.line for part in parts]),
            numbers={s: np.concatenate([p.numbers[s] for p in parts]) for s in parts[0].numbers},
            texts=_stacked([(part.texts, len(part)) for part in parts]),
            labels=_stacked([(part.labels, len(part)) for part in parts]),
        )


def _taken(texts: dict[str, list[str]], rows: IntArray) -> dict[str, list[str]]:
    return {stem: [own[i] for i in rows] for stem, own in texts.items()}


def _stacked(parts: Sequence[tuple[dict[str, list[str]], int]]) -> dict[str, list[str]]:
    stems = dict.fromkeys(stem for part, _ in parts for stem in part)
    return {s: [text for part, n in parts for text in part.get(s, [""] * n)] for s in stems}


# Units of the measurement table that import writes.
_UNITS = {
    "length": "mm", "angle": "deg", "time": "s", "force": "N", "torque": "Nm",
    "temperature": "C", "number": "",
}  # fmt: skip


def table_unit(stem: str, unit: str) -> str:
    """The unit in which a column that a file has in `unit` is written."""
    return "um" if stem.startswith("sigma_") else _UNITS[quantities(unit)[0]]


def joint_stems(numbers: Iterable[str]) -> list[str]:
    """q1, q2 … among the columns, in order."""
    found = [stem for stem in numbers if re.fullmatch(r"q\d+", stem)]
    return sorted(found, key=lambda stem: int(stem[1:]))


def read_records(where: str, path: Path, source: SourceTable, units: UnitsTable) -> Records:
    """The rows of `path` as `source` of the mapping `where` describes them.

    A row with an empty cell where a number belongs is passed over and listed.
    """
    settings = source.text or mapping_file.TextSourceKeys()
    asked = mapping_file.wanted(where, source.columns or {}, source.optional or {})
    text = foreign_text.read_lines(path, settings.encoding or "auto")
    table = _table(text, settings, asked)
    if len(table.rows) > MAX_ROWS:
        raise InputError(f"{text.source}: more than {MAX_ROWS:,} rows; thin the export out")
    hint = foreign_text.unit_in_comments(where, settings.unit_comment, table.comments)
    markers = mapping_file.markers_of_row(text.source, asked, table.header)
    parts = [
        _read(text, table, [c.of_marker(name) for c in asked], source, units, hint)
        for name in markers or [""]
    ]
    return _side_by_side(parts, markers) if markers else parts[0]


def _read(
    text: ForeignText, table: Rows, asked: Sequence[ColumnKey], source: SourceTable,
    units: UnitsTable, hint: str | None,
) -> Records:  # fmt: skip
    settings, name = source.text or mapping_file.TextSourceKeys(), text.source
    columns = mapping_file.resolve(name, asked, table.header, len(table.rows[0][1]), units, hint)
    numeric = [c for c in columns if not c.target.is_text]
    cells = NumberCells(
        settings.decimal or "auto",
        settings.thousands or "none",
        settings.missing or (),
        (row[c.index[0]] for _, row in table.rows[:DECIMAL_SAMPLE]
         for c in numeric if c.index[0] < len(row)),
    )  # fmt: skip
    kept, values, ignored = _rows(name, table, columns, cells)
    if not kept:
        number, reason = ignored[0]
        raise InputError(
            f"{name}: none of its {len(table.rows)} rows is complete (line {number}: "
            f"{reason}); correct the places in [source.columns]"
        )
    used = {i for c in columns for i in c.index}
    head = f"header in line {table.header_line}" if table.header_line else "no header"
    mark = {"tab": "tabs", "space": "blanks"}.get(table.split_at, f"{table.split_at!r}")
    program = table.split_at in ("KRL", "RAPID")
    understood = Understood(
        path=name,
        preset=source.preset,
        role=source.role or "both",
        encoding=text.encoding,
        layout=table.split_at if program else f"columns split at {mark}, {head}",
        decimal=cells.decimal,
        columns=tuple((c.header, column(c.target.stem, c.unit), c.unit) for c in columns),
        unused=tuple(n or f"column {i + 1}" for i, n in enumerate(table.header) if i not in used),
        rows=len(kept),
        ignored=tuple(sorted([*table.ignored, *ignored])),
    )
    line = np.array([number for number, _ in kept], dtype=np.int64)
    numbers, of = dict[str, Array](), dict[str, str]()
    for c, own in zip(numeric, np.array(values).reshape(len(kept), -1).T, strict=True):
        stem = c.target.stem
        spread = stem.startswith("sigma_") and source.coverage_factor
        of[stem] = table_unit(stem, c.unit)
        found = convert(own, c.unit, of[stem]) / (spread or 1.0)
        numbers[stem] = found + numbers.get(stem, 0.0)  # seconds and nanoseconds of a time add up
    texts = _texts([row for _, row in kept], columns)
    written = texts.pop("time_text", None)
    if written is not None and "time" not in numbers:
        form = source.time_format or ()
        formats = [form] if isinstance(form, str) else form
        seconds = foreign_text.seconds_of(name, line.tolist(), written, formats)
        numbers["time"], of["time"] = np.array(seconds), "s"
    file = np.zeros(len(line), dtype=np.int64)
    return Records((name,), file, line, numbers, of, texts, understood, source.load)


def _rows(
    name: str, table: Rows, columns: Sequence[FileColumn], cells: NumberCells
) -> tuple[list[tuple[int, list[str]]], list[list[float]], list[tuple[int, str]]]:
    numeric = [c for c in columns if not c.target.is_text]
    widest = max(columns, key=lambda c: max(c.index))
    kept, values, ignored = [], [], []
    for number, row in table.rows:
        if max(widest.index) >= len(row):
            raise InputError(
                f"{name}, line {number}: {len(row)} columns, but {widest.target.key} "
                f"is column {max(widest.index) + 1} ({widest.header}); correct the line, "
                "or pass over such lines with ignore in [source.text]"
            )
        found = []
        for c in numeric:
            cell = row[c.index[0]]
            try:
                value = cells.value(cell)
            except ValueError:
                raise cells.complaint(name, number, cell, c.header) from None
            if value is None:
                ignored.append((number, f"no value in column {c.header}"))
                break
            found.append(value)
        else:
            kept.append((number, row))
            values.append(found)
    return kept, values, ignored


def _texts(rows: Sequence[list[str]], columns: Sequence[FileColumn]) -> dict[str, list[str]]:
    """The texts by column; a load that is a bare size gets the unit in its header."""
    loads = (re.search(UNIT_OF_LOAD, c.header) for c in columns if c.target.stem == "load")
    unit = next((found[1] for found in loads if found), "")
    texts = {}
    for c in (c for c in columns if c.target.is_text):
        glue = " " if c.target.stem == "time_text" else "::"
        found = [glue.join(row[i].strip() for i in c.index) for row in rows]
        if c.target.stem == "load":
            found = [f"{t} {unit}".strip() if re.fullmatch(r"[\d.,]+", t) else t for t in found]
        texts[c.target.stem] = found
    return texts


def _side_by_side(parts: Sequence[Records], markers: Sequence[str]) -> Records:
    """One row for each marker of a row; of a marker without a value that one alone is left out."""
    every = Records.stacked(
        [
            replace(part, texts=part.texts | {"marker": [name] * len(part)})
            for part, name in zip(parts, markers, strict=True)
        ]
    )
    seen = [part.understood for part in parts]
    unused = set.intersection(*(set(understood.unused) for understood in seen))
    understood = replace(
        seen[0],
        columns=tuple(dict.fromkeys(column for u in seen for column in u.columns)),
        unused=tuple(name for name in seen[0].unused if name in unused),
        rows=len(every),
        ignored=tuple(sorted({each for u in seen for each in u.ignored})),
    )
    one = replace(every, files=parts[0].files, file=np.zeros(len(every), dtype=np.int64))
    return replace(one.take(np.argsort(one.line, kind="stable")), understood=understood)


def likely_presets(path: Path) -> list[str]:
    """The presets that read most rows of a file; none where no preset reads it."""
    rows = dict[str, int]()
    for name in mapping_file.PRESETS:
        mapping = mapping_file.read_mapping(None, [name])
        try:
            read = read_records(mapping.path, path, mapping.sources[0], UnitsTable())
        except ElastocalError:
            continue
        rows[name] = len(read)
    return [name for name, n in rows.items() if n == max(rows.values())]


def _table(
    text: ForeignText, settings: mapping_file.TextSourceKeys, asked: Sequence[ColumnKey]
) -> Rows:
    if settings.format in ("krl", "rapid"):
        return foreign_text.program_rows(text, settings.format)
    guess = NumberCells("auto", settings.thousands or "none", settings.missing or (), ())
    named = mapping_file.by_name(asked)
    places = [c.at for c in asked if c.required and not c.is_text and isinstance(c.at, int)]

    def is_header(cells: Sequence[str]) -> bool:
        return not mapping_file.lacking(asked, cells)

    def is_data(cells: Sequence[str]) -> bool:
        return all(at <= len(cells) and guess.looks_numeric(cells[at - 1]) for at in places)

    table = foreign_text.table_rows(text, settings, is_header if named else None, is_data)
    if named and not table.header_line:
        raise mapping_file.no_header(text.source, asked, table.rows[: foreign_text.SAMPLE])
    return table


HEIGHT = ("zenith", "elevation")
SPHERICAL = ("range", "azimuth", *HEIGHT)


def is_spherical(records: Records) -> bool:
    """Does the file give any spherical coordinate?"""
    return any(stem in records.numbers for stem in SPHERICAL)


def with_positions(records: Records, clockwise: bool = False) -> Records:
    """The records with x, y, z, where the file has spherical coordinates.

    With range d, azimuth α and zenith angle ζ (π/2 − elevation), in a right-handed frame with z up
    and x at azimuth zero:

        x = d sin ζ cos α,   y = d sin ζ sin α,   z = d cos ζ

    α counts counterclockwise seen from above; where `clockwise`, as theodolites count, y has the
    other sign.  Readings in the second face, ζ beyond 180° with α turned by 180°, come out right.
    """
    if not is_spherical(records):
        return records
    height = _height(records)
    numbers = dict(records.numbers)
    d = numbers.pop("range")
    alpha, angle = np.radians(numbers.pop("azimuth")), numbers.pop(height)
    _check_spherical(records, d, height, angle)
    zeta = np.radians(angle if height == "zenith" else 90.0 - angle)
    level = d * np.sin(zeta)
    y = level * np.sin(alpha)
    numbers |= {"x": level * np.cos(alpha), "y": -y if clockwise else y, "z": d * np.cos(zeta)}
    kept = {stem: unit for stem, unit in records.units.items() if stem not in SPHERICAL}
    return replace(records, numbers=numbers, units=kept | dict.fromkeys("xyz", "mm"))


def _height(records: Records) -> str:
    found = [stem for stem in SPHERICAL if stem in records.numbers]
    both = [stem for stem in "xyz" if stem in records.numbers]
    if both:
        raise InputError(
            f"{records.source}: positions are mapped twice, as {listed(both)} and as "
            f"{listed(found)}; keep one of the two in [source.columns]"
        )
    heights = [stem for stem in HEIGHT if stem in found]
    if len(heights) == 2:
        raise InputError(
            f"{records.source}: both zenith and elevation are mapped; keep the one that the file "
            "gives (a level line has zenith 90° and elevation 0°)"
        )
    missing = [stem for stem in ("range", "azimuth") if stem not in found]
    missing += [] if heights else ["zenith or elevation"]
    if missing:
        raise InputError(
            f"{records.source}: {listed(found)} without {listed(missing)}; map range_mm, "
            "azimuth_deg, and zenith_deg or elevation_deg in [source.columns]"
        )
    return heights[0]


def _check_spherical(records: Records, d: Array, height: str, angle: Array) -> None:
    if not (d > 0).all():
        i = int(np.argmin(d > 0))
        raise InputError(
            f"{records.where(i)}: a range of {d[i]:g} mm; a distance is "
            "positive: correct the line, or the column of range in [source.columns]"
        )
    low, high, other = (0.0, 360.0, "elevation") if height == "zenith" else (-90.0, 90.0, "zenith")
    off = (angle < low) | (angle > high)
    if off.any():
        i = int(np.argmax(off))
        raise InputError(
            f"{records.where(i)}: {height} of {angle[i]:.6g}°, which lies beyond {low:g}° to "
            f"{high:g}°; is it an angle of another unit, or {other}_deg?"
        )


GROUPS = ("configuration", "marker", "repeat", "load")
ADVICE = "write pattern in [source.names]"


def with_labels(where: str, records: Records, names: mapping_file.NamesTable | None) -> Records:
    """The records with `labels` from their columns, and from their names where a pattern is given.

    A group that a column gives too is taken from the column.  A name that no pattern matches is
    an error, or with unmatched = "ignore" passed over and listed.
    """
    names = names or mapping_file.NamesTable()
    labels = {stem: records.texts[stem] for stem in GROUPS if stem in records.texts}
    named = records.texts.get("name")
    if names.pattern is not None and named is not None:
        found, bad = _labels_of_names(where, records, names, named)
        if bad:
            keep = np.setdiff1d(np.arange(len(records)), bad)
            reasons = [
                (int(records.line[i]), f"{quoted(named[i])} matches no pattern") for i in bad
            ]
            before = records.understood
            ignored = tuple(sorted([*before.ignored, *reasons]))
            understood = replace(before, rows=len(keep), ignored=ignored)
            records = replace(records.take(keep), understood=understood)
            labels, found = _taken(labels, keep), _taken(found, keep)
        labels = found | labels
    if names.markers and "marker" in labels:
        labels["marker"] = [names.markers.get(m, m) for m in labels["marker"]]
    if names.in_order and "marker" not in labels:
        n = len(names.in_order)
        labels["marker"] = [names.in_order[i % n] for i in range(len(records))]
        if len(records) % n:
            raise InputError(
                f"{records.source}: {len(records)} points, which is no multiple of the {n} markers "
                f"{listed(names.in_order)} of in_order; a point is missing or one too many: name "
                "the points"
            )
    for stem, texts in labels.items():
        for i, text in enumerate(texts):
            if not is_label(text):
                raise InputError(
                    f"{records.where(i)}: {stem} {quoted(text)} cannot stand in a table; correct "
                    f"the name, or {ADVICE}"
                )
    return replace(records, labels=labels)


def _labels_of_names(
    where: str, records: Records, names: mapping_file.NamesTable, named: list[str]
) -> tuple[dict[str, list[str]], list[int]]:
    patterns = [names.pattern] if isinstance(names.pattern, str) else list(names.pattern or ())
    expressions = [foreign_text.compiled(where, "pattern", text) for text in patterns]
    for expression in expressions:
        if not set(expression.groupindex) & set(GROUPS):
            raise InputError(
                f"{where}: pattern = {quoted(expression.pattern)} has none of the groups "
                f"{listed(f'(?P<{g}>…)' for g in GROUPS)}; name the parts of the name so"
            )
    found: dict[str, list[str]] = {stem: [] for stem in GROUPS}
    bad: list[int] = []
    with foreign_text.bounded(where, named):
        for i, name in enumerate(named):
            match = next((m for e in expressions if (m := e.search(name))), None)
            if match is None:
                bad.append(i)
            groups = match.groupdict() if match else {}
            for stem in GROUPS:
                found[stem].append((groups.get(stem) or "").strip())
    if bad and (names.unmatched != "ignore" or len(bad) == len(named)):
        raise InputError(
            f"{records.where(bad[0])}: the name {quoted(named[bad[0]])} matches no pattern "
            f"({listed(map(quoted, patterns), 3)}), as do not {len(bad) - 1} others; {ADVICE}, or "
            'unmatched = "ignore" to leave such points out'
        )
    unnamed = set(bad)
    present = {stem: texts for stem, texts in found.items() if any(texts)}
    for stem, texts in present.items():
        empty = [i for i, text in enumerate(texts) if not text and i not in unnamed]
        if empty and stem in ("configuration", "marker"):
            raise InputError(
                f"{records.where(empty[0])}: the name {quoted(named[empty[0]])} says no {stem}, "
                f"others do; {ADVICE} that finds it in every name"
            )
        if empty:
            default = "0" if stem == "repeat" else "none"
            present[stem] = [text or default for text in texts]
    return present, bad
