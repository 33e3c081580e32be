"""Joint values in robot programs: KUKA KRL (AXIS, E6AXIS) and ABB RAPID (jointtarget)."""

from __future__ import annotations

import re
from bisect import bisect_left
from dataclasses import dataclass

from elastocal.errors import InputError
from elastocal.importing.text_file import Text
from elastocal.text import quoted

KRL_AXES = tuple(f"{letter}{i}" for letter in "AE" for i in range(1, 7))
RAPID_AXES = (*(f"rax_{i}" for i in range(1, 7)), *(f"eax_{letter}" for letter in "abcdef"))
NOT_CONNECTED = 9e9  # what RAPID writes for an external axis that does not exist
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_KRL = re.compile(r"(?:([$A-Za-z_][\w$]*(?:\[\s*\d+\s*\])?)\s*=\s*)?\{([^{}]*)\}")
_KRL_PART = re.compile(r"([A-Za-z_]\w*(?:\[\s*\])?)\s+(\S.*)")
_RAPID_NAME = re.compile(r"(?:\b(\w+)\s+)?\b([A-Za-z]\w*)\s*(\{[\d,\s]*\})?\s*:=")
_RAPID_PAIR = re.compile(r"\[\s*\[([^\[\]]*)\]\s*,\s*\[([^\[\]]*)\]\s*\]")


@dataclass(frozen=True)
class Rows:
    """A table under `header`: (line number, cells) each; `ignored`: line and reason."""

    header: tuple[str, ...]
    rows: list[tuple[int, list[str]]]
    ignored: list[tuple[int, str]]


def krl_rows(text: Text) -> Rows:
    """Every aggregate of A1, A2 … (and E1 …) of a KRL .dat or .src file, or of a log of them.

    Aggregates of FRAME, POS and E6POS (X, Y, Z) hold no joint values and are passed over, named.
    Raises InputError for a joint value that is no number and where no aggregate has any.
    """
    found = Rows(("name", *KRL_AXES), [], [])
    whole = "\n".join(_uncommented(line, ";") for line in text.lines)
    count = _LineCounter(whole)
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
        for axis in KRL_AXES:
            if axis in values and not _NUMBER.fullmatch(values[axis]):
                raise InputError(
                    f"{text.source}, line {line}: {axis} is {quoted(values[axis])}, not a number; "
                    "log values, not expressions"
                )
        cells = [match[1] or "", *(values.get(axis, "") for axis in KRL_AXES)]
        found.rows.append((line, cells))
    return _complete(text, found, "no {A1 …, A2 …} with joint values")


def rapid_rows(text: Text) -> Rows:
    """Every jointtarget [[rax_1 … rax_6], [eax_a … eax_f]] of a RAPID module or a log of them.

    An array's members are named P{1}, P{2} …; robtargets hold no joint values, and o_jointtarget
    is the position before a correction: both are passed over, named.
    Raises InputError for a value that is no number and where there is no jointtarget.
    """
    found = Rows(("name", *RAPID_AXES), [], [])
    whole = "\n".join(_uncommented(line, "!") for line in text.lines)
    count = _LineCounter(whole)
    start = 0
    for statement in re.split(r";", whole):
        _rapid_statement(text, found, statement, start, count)
        start += len(statement) + 1
    return _complete(text, found, "no jointtarget [[…], […]]")


def _rapid_statement(
    text: Text, found: Rows, statement: str, start: int, count: _LineCounter
) -> None:
    declared = _RAPID_NAME.search(statement)
    kind = (declared[1] or "").lower() if declared else ""
    name = declared[2] if declared else ""
    if kind in ("robtarget", "o_robtarget", "o_jointtarget") and declared:
        reason = "the position before a correction" if kind[0:2] == "o_" else "no joint values"
        found.ignored.append((count(start + declared.start(2)), f"{name} is {kind}: {reason}"))
        return
    pairs = [
        (match, [_split(match[1]), _split(match[2])]) for match in _RAPID_PAIR.finditer(statement)
    ]
    targets = [(m, parts) for m, parts in pairs if len(parts[0]) == 6 and len(parts[1]) == 6]
    several = bool(declared and declared[3])
    for k, (match, (robot, external)) in enumerate(targets, start=1):
        line = count(start + match.start())
        cells = []
        for axis, cell in zip(RAPID_AXES, [*robot, *external], strict=True):
            if not _NUMBER.fullmatch(cell):
                raise InputError(
                    f"{text.source}, line {line}: {axis} is {quoted(cell)}, not a number; log "
                    "values, not expressions"
                )
            cells.append("" if float(cell) >= NOT_CONNECTED else cell)
        label = f"{name}{{{k}}}" if several else name
        found.rows.append((line, [label, *cells]))


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",")]


def _complete(text: Text, found: Rows, what: str) -> Rows:
    if not found.rows:
        raise InputError(
            f"{text.source}: {what} in {len(text.lines)} lines"
            f"{_passed_over(found)}; check the file, or its format in [source.text]"
        )
    # Axes that no row has (E1 … of a robot without them) are no columns.
    used = [i for i in range(len(found.header)) if any(cells[i] for _, cells in found.rows)]
    used = sorted({0, *used})
    rows = [(line, [cells[i] for i in used]) for line, cells in found.rows]
    return Rows(tuple(found.header[i] for i in used), rows, found.ignored)


def _passed_over(found: Rows) -> str:
    return f" ({len(found.ignored)} Cartesian positions passed over)" if found.ignored else ""


def _uncommented(line: str, mark: str) -> str:
    """The line up to a comment mark outside quotation marks."""
    if mark not in line:
        return line
    inside = False
    for i, character in enumerate(line):
        if character == '"':
            inside = not inside
        elif character == mark and not inside:
            return line[:i]
    return line


class _LineCounter:
    """The line in which an offset into a text lies."""

    def __init__(self, text: str) -> None:
        self._ends = [match.start() for match in re.finditer("\n", text)]

    def __call__(self, offset: int) -> int:
        return bisect_left(self._ends, offset) + 1
