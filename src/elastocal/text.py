"""Words in messages and files: the nearest name, lists, quoted text, labels, and strict JSON."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from difflib import get_close_matches
from typing import Any

SHOWN = 60


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.5) -> str | None:
    """The valid name closest to `name`, upper and lower case alike; None where none is near.

    Names that begin with `name` come first, the shortest of them: it was not typed to its end.
    """
    by_lower = {v.lower(): v for v in reversed(list(valid))}
    # difflib is quadratic, and a name this long is no typing error anyway.
    typed = name[:SHOWN].lower()
    begun = sorted(
        (v for v in by_lower if typed and v.startswith(typed)), key=lambda v: (len(v), v)
    )
    near = begun or get_close_matches(typed, by_lower, n=1, cutoff=cutoff)
    return by_lower[near[0]] if near else None


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """' (did you mean 'x'?)' for the nearest valid name, or '' where none is near."""
    near = nearest(name, valid)
    return f" (did you mean '{near}'?)" if near else ""


def listed(names: Iterable[str], limit: int = 40) -> str:
    return some(names, limit, more=", … ({} more)")


def some(names: Iterable[str], most: int, joint: str = ", ", more: str = " and {} more") -> str:
    """ "a, b and 3 more": the first of them, and how many there are besides."""
    names = list(names)
    rest = len(names) - most
    return joint.join(names[:most]) + (more.format(rest) if rest > 0 else "")


def counted(n: int, one: str, many: str | None = None) -> str:
    """ "1 pose", "2 poses"."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def significant(value: float, digits: int = 3) -> str:
    """A number of so many digits, without an exponent where it is readable: 1830, 0.120, 1.00."""
    if not 1e-5 < abs(value) < 1e10:
        return f"{value + 0.0:.{digits}g}"
    return f"{Decimal(f'{value:.{digits - 1}e}'):f}"


def rounded(value: float, digits: int = 3) -> str:
    """The same without zeros at its end: 1830, 0.12, 1."""
    told = significant(value, digits)
    return told.rstrip("0").rstrip(".") if "." in told and "e" not in told else told


SMALLEST_P = 1e-4  # a p-value that stands for itself and all that are smaller


def p_value(p: float) -> str:
    """Two digits, or that it is below the smallest that is told."""
    if not math.isfinite(p):
        return "–"
    return f"< {SMALLEST_P:.4f}" if p <= SMALLEST_P else significant(p, 2)


def size_of(p: float) -> str:
    """ "p = 0.02", "p < 0.0001"."""
    text = p_value(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


# A length or residual below this, in m, is rounding: no instrument resolves it.
EXACT = 1e-11


def length(metres: float, digits: int = 3) -> str:
    """A position error: µm below 1 mm, mm below 1 m, "not available" where there is no number."""
    if not math.isfinite(metres):
        return "not available"
    if abs(metres) < EXACT:
        return "0 µm"
    if abs(metres) < 0.9995e-3:
        return f"{significant(metres * 1e6, digits)} µm"
    if abs(metres) < 0.9995:
        return f"{significant(metres * 1e3, digits)} mm"
    return f"{significant(metres, digits)} m"


def newtons(force: Iterable[float]) -> str:
    """ "(0, 0, -2600) N"."""
    return f"({', '.join(rounded(v, 6) for v in force)}) N"


def load_text(force: Iterable[float]) -> str:
    return newtons(force) if any(force) else "unloaded"


def together(parts: Sequence[str], last: str = "and") -> str:
    """ "a, b and c"."""
    return f" {last} ".join([p for p in (", ".join(parts[:-1]), *parts[-1:]) if p])


def gathered(names: Iterable[str]) -> str:
    """Parameters by their places: "compliance of joints 1, 2 and 5, dx of link 3"."""
    found: dict[tuple[str, str], list[str]] = {}
    for name in names:
        where, _, what = name.rpartition(".")
        kind = where.rstrip("0123456789")
        found.setdefault((what, kind), []).append(where[len(kind) :])
    told = []
    for (what, kind), places in found.items():
        told.append(f"{what} of {kind}{'s' * (len(places) > 1)} {together(places)}".rstrip())
    return ", ".join(told)


def quoted(found: object) -> str:
    """`found` as a message shows it: quoted, on one line, cut when long."""
    text = found if isinstance(found, str) else str(found)
    text = repr(text[:SHOWN] + "…") if len(text) > SHOWN else repr(text)
    return text if isinstance(found, str) else text[1:-1]


def printable(text: str) -> str:
    """`text` with what a terminal would obey or a reader could not see as escapes: \\x1b, \\u202e.

    The one way in which names from files and arguments are shown.  Text that is shown already
    stays as it is.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode()
        for c in text
    )  # fmt: skip


def is_label(text: str) -> bool:
    """Can this text stand in a table cell and be read back as it is shown: one line, no blanks at
    its ends, nothing that cannot be seen?"""
    return bool(text) and text == text.strip() == printable(text)


# How a cell begins that a spreadsheet would work out, and the mark that stops it.
_FORMULA = re.compile(r"'*[=+\-@]")
_NUMBER = re.compile(r"[+-]?([0-9]+[.,]?[0-9]*|[.,][0-9]+)([eE][+-]?[0-9]+)?", re.ASCII)


def cell_text(cell: object) -> object:
    """A cell of a table as it is written: text that no spreadsheet takes for a formula.

    Text that begins with = + - @ and is no number gets an apostrophe before it, as spreadsheets
    write such text; `cell_meaning` takes it off again.
    """
    if not isinstance(cell, str) or _NUMBER.fullmatch(cell):
        return cell
    return f"'{printable(cell)}" if _FORMULA.match(cell) else printable(cell)


def cell_meaning(cell: str) -> str:
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


# The minus signs of text programs at the beginning of a number.
_MINUS = re.compile(r"^([ \t]*)[−–－](?=[\d.,])")


def plain_minus(cell: str) -> str:
    return cell if cell.isascii() else _MINUS.sub(r"\1-", cell)


def plain(value: Any) -> Any:
    """`value` with objects by their `to_json`, else dataclasses as their fields, numpy numbers and
    arrays as plain ones, and None for numbers not finite."""
    if hasattr(value, "to_json"):
        value = value.to_json()
    elif hasattr(value, "__dataclass_fields__"):
        value = vars(value)
    if isinstance(value, Mapping):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    # numpy's arrays and numbers, without loading numpy for it: --help comes by here.
    return plain(value.tolist()) if hasattr(value, "tolist") else value


def json_text(value: Any) -> str:
    """`value` as strict JSON over several lines, without a newline at its end.

    Numbers that do not exist become null; documentation of each key says what its null means.
    Raises TypeError for what JSON has no form for.
    """
    return json.dumps(plain(value), indent=1, allow_nan=False)
