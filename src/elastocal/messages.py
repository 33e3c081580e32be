"""What a message is made of: the words it shares with reports and files, and the errors it ends in.

A message says what is wrong, where (file, row, column or key), what was found, and what to do.
Errors have one root, for whatever a user can cause or must act on; the command line turns
`InputError` into exit code 2, `InsufficientDataError` into exit code 1, both without a traceback.
Whatever reads a file or takes an argument raises `InputError` for what is wrong with it;
docstrings inside do not repeat that.

A message that speaks of an option of a verb names it by `option`: in Python the keyword
argument, on the command line the flag.
"""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from difflib import get_close_matches
from typing import Any

SHOWN = 60


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.5) -> str | None:
    """The valid name closest to `name`, upper and lower case alike.  Names that begin with `name`
    come first, the shortest of them: it was not typed to its end."""
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
    return f"{n} {one if n == 1 else many or one + 's'}"


def significant(value: float, digits: int = 3) -> str:
    """A number of so many digits, without an exponent where it is readable: 1830, 0.120, 1.00."""
    if not 1e-5 < abs(value) < 1e10:
        return f"{value + 0.0:.{digits}g}"
    return f"{Decimal(f'{value:.{digits - 1}e}'):f}"


def rounded(value: float, digits: int = 3) -> str:
    told = significant(value, digits)
    return told.rstrip("0").rstrip(".") if "." in told and "e" not in told else told


SMALLEST_P = 1e-4  # a p-value that stands for itself and all that are smaller


def p_value(p: float) -> str:
    if not math.isfinite(p):
        return "–"
    return f"< {SMALLEST_P:.4f}" if p <= SMALLEST_P else significant(p, 2)


def size_of(p: float) -> str:
    text = p_value(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


# A length or residual below this, in m, is rounding: no atom is as small.
EXACT = 1e-10


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
    return f"({', '.join(rounded(v, 6) for v in force)}) N"


def load_text(force: Iterable[float]) -> str:
    return newtons(force) if any(force) else "unloaded"


def together(parts: Sequence[str], last: str = "and") -> str:
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
    Names from files and arguments are shown in no other way."""
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode()
        for c in text
    )  # fmt: skip


def is_label(text: str) -> bool:
    """One line, no blanks at its ends, nothing that cannot be seen: a cell that reads back."""
    return bool(text) and text == text.strip() == printable(text)


# How a cell begins that a spreadsheet would work out, and the mark that stops it.
_FORMULA = re.compile(r"'*[=+\-@]")
NUMBER = re.compile(r"[+-]?([0-9]+[.,]?[0-9]*|[.,][0-9]+)([eE][+-]?[0-9]+)?", re.ASCII)


def cell_text(cell: object) -> object:
    """As a table is written: text that begins with = + - @ and is no number gets an apostrophe, so
    that no spreadsheet takes it for a formula; `cell_meaning` takes it off."""
    if not isinstance(cell, str) or NUMBER.fullmatch(cell):
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
    """Strict JSON over several lines; numbers that do not exist become null."""
    return json.dumps(plain(value), indent=1, allow_nan=False)


# Keyword arguments whose flag is another word; everywhere else joint1_x is --joint1-x.
FLAGS = {
    "fixed": "--fix", "options": "--set", "values": "--set", "presets": "--preset",
    "extra_poses": "--poses",
}  # fmt: skip
# Options of the command line alone, and what stands for them in Python.
IN_PYTHON = {"cell_out": 'save("found.toml")', "plan": "extra_poses"}
# Keyword arguments that take a list, and flags that are repeated.
LISTS = ("fixed", "without", "options", "presets")

# How messages name options now: by their flags, and which are given in the place of a key.
_said: dict[str, Any] = {"flags": False, "given": frozenset()}

# Keys of cells, and keywords of verbs, that there were, and what does it instead.
GONE = {
    "design.load_choice": (
        "every pose is read under each load; let [design.choose] loads pick fewer of them"
    ),
    "design.doubts": (
        "for effects that the model may lack measure, and ask next, or diagnose with a plan of "
        "extra poses"
    ),
    "design.robust": "plans are made for the arm as identified so far (augment); drop the key",
    "design.robust_samples": "it went with design.robust; drop it",
}
LONGEST = 4000  # nobody reads more


class ElastocalError(Exception):
    """Root of all errors that elastocal raises on purpose."""

    exit_code = 2

    def __init__(self, message: object = "") -> None:
        text, half = str(message), LONGEST // 2
        super().__init__(text if len(text) <= LONGEST else f"{text[:half]} … {text[-half:]}")


class InputError(ElastocalError):
    """The input is wrong: a file, a key, a column, a unit, a value."""


class InsufficientDataError(ElastocalError):
    """The input is well formed, but the data do not support an answer."""

    exit_code = 1


class NotAcceptedError(ElastocalError):
    """The calibration is done and written, but does not keep what was required of it."""

    exit_code = 3


class UnknownNameError(InputError, KeyError):
    """A name that is not there, looked up in a result or a model.  It is a KeyError too."""

    __str__ = Exception.__str__  # a KeyError would show its message in quotes

    @classmethod
    def of(cls, what: str, name: object, there: Collection[str]) -> UnknownNameError:
        """The error for `name`, which is no `what`: with the nearest name, and what there is."""
        hint = did_you_mean(str(name), there)
        return cls(f"no {what} {quoted(name)}{hint}; there are {listed(there)}")


def flag_of(keyword: str) -> str:
    return FLAGS.get(keyword, "--" + keyword.replace("_", "-"))


def option(keyword: str, value: object = None) -> str:
    """An option of a verb as a message names it: in Python its keyword argument, `seed` or
    outliers='drop'; where flags are said --seed or --outliers drop.  It is worded where the message
    is made, since messages end in results, their files and reports too."""
    if _said["flags"]:
        flag = flag_of(keyword)
        if value is False:
            return f"--no-{flag[2:]}"
        return flag if value is None or value is True else f"{flag} {value}"
    if value is None:
        return f"`{IN_PYTHON.get(keyword, keyword)}`"
    return f"{keyword}=[{value!r}]" if keyword in LISTS else f"{keyword}={value!r}"


@contextmanager
def saying(**how: Any) -> Iterator[None]:
    """Within it messages name options by their `flags`, as the command line has them, and those
    that are `given` in the place of a key of the cell where `wish` names that."""
    before = _said.copy()
    _said.update(how)
    try:
        yield
    finally:
        _said.update(before)


def wish(keyword: str, key: str) -> str:
    """The option where one is given in the place of a key of the cell, else the `key`."""
    return option(keyword) if keyword in _said["given"] else key


def raised_at(error: BaseException, own: Callable[[str], bool]) -> tuple[str, int] | None:
    """File and line of the last of a traceback's frames whose file is somebody's `own`, of a
    SyntaxError those that it names; None where there is none."""
    import traceback

    if isinstance(error, SyntaxError) and error.filename:
        return error.filename, error.lineno or 1
    frames = traceback.extract_tb(error.__traceback__)
    return next(((f.filename, f.lineno or 1) for f in frames[::-1] if own(f.filename)), None)


@contextmanager
def said_of(where: object) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def require(condition: object, message: str) -> None:
    if not condition:
        raise InputError(message)


def check_known(name: str, there: Collection[str], told: str, them: str = "there are") -> None:
    """Behind what is `told` of an unknown name stand the nearest of what is `there`, and all."""
    if name not in there:
        raise InputError(f"{told}{did_you_mean(name, there)}; {them} {listed(there) or 'none'}")
