"""TOML files that users write: read with a bound on their size, and checked against tables of keys.

A table of the file is a `Table`, a pydantic model whose fields are its keys; the description of a
key says what it takes.  What pydantic finds wrong is told as one sentence: file, key, what the key
takes, what was found, and the nearest valid name.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationError
from pydantic_core import PydanticCustomError

from elastocal.errors import GONE, InputError
from elastocal.files import check_nesting, read_text
from elastocal.text import did_you_mean, listed, nearest, quoted
from elastocal.units import Array

MAX_BYTES = 1_000_000
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
UNIT_SUFFIX = re.compile(
    r"_(um|mm|cm|m|deg|rad|urad|mrad|ppm|N|kN|Nm|N_per_m|N_per_mm|s|min|si"
    r"|deg_per_s|rad_per_s|m_per_s|mm_per_s)$"
)

Keys = Sequence[str | int]


class Table(BaseModel):
    """A table of a TOML file; its fields are its keys."""

    model_config = STRICT | ConfigDict(frozen=True)


TableType = TypeVar("TableType", bound=Table)


def key(takes: str, default: Any = None) -> Any:
    """An optional key; `takes` completes the sentence 'key … takes …' in messages."""
    return Field(default=default, description=takes)


def required(takes: str) -> Any:
    """A key that must be there; `takes` as for `key`."""
    return Field(description=takes)


# --- What keys take ------------------------------------------------------------------------------


def numbers(
    count: int | None = None,
    *,
    least: float = -np.inf,
    above: float = -np.inf,
    one_for_all: bool = False,
) -> PlainValidator:
    """The validator of a list of finite numbers, which becomes an array (count,).

    None counts any number of them but zero.  `one_for_all` takes a single number too: as `count`
    equal ones, or as an array (1,).  Each is at least `least` and greater than `above`.
    """

    def check(value: object) -> Array:
        listing = value.tolist() if isinstance(value, np.ndarray) else value
        if one_for_all and is_number(listing):
            listing = [listing] * (count or 1)
        if isinstance(listing, list | tuple) and all(map(is_number, listing)):
            found = np.array(listing, dtype=float)
            right = len(found) == count if count else len(found) > 0
            if right and (found >= least).all() and (found > above).all():
                return found
        sign = "positive " if above == 0 else ""
        raise PydanticCustomError("numbers", f"{count or 'a list of'} {sign}numbers")

    return PlainValidator(check)


def is_number(value: object) -> bool:
    """Whether `value` is a finite number; true and false are none."""
    number = isinstance(value, int | float | np.integer | np.floating)
    return number and not isinstance(value, bool) and abs(value) <= sys.float_info.max  # type: ignore[arg-type]


Text = Annotated[str, Field(min_length=1, description="a text")]
Positive = Annotated[float, Field(gt=0, description="a positive number")]
NonNegative = Annotated[float, Field(ge=0, description="a number >= 0")]
Count = Annotated[int, Field(ge=1, le=10_000_000, description="a whole number >= 1")]
Numbers = Annotated[Array, numbers(), Field(description="a list of numbers")]
Vector2 = Annotated[Array, numbers(2), Field(description="two numbers")]
Vector3 = Annotated[Array, numbers(3), Field(description="three numbers")]


# --- Reading -------------------------------------------------------------------------------------


def read_toml(path: str | Path, what: str, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Returns the parsed TOML file of at most `max_bytes`; `what` names it in messages."""
    return parsed_toml(path, read_text(path, what, max_bytes))


def parsed_toml(path: str | Path, text: str) -> dict[str, Any]:
    """The same of the `text` of a file."""
    check_nesting(path, text)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path}: nested without end; check its brackets") from None
    except ValueError as error:
        reason = str(error)
        if "(at end of document)" in reason:
            lines = text.split("\n")
            end = f"(at line {len(lines)}, column {len(lines[-1]) + 1}, the end of the file)"
            reason = reason.replace("(at end of document)", end)
        if long := re.search(r"(?<!\d)\d{4300}", text):  # what Python refuses to read
            line = text.count("\n", 0, long.start()) + 1
            reason = f"a number of thousands of digits (at line {line})"
        raise InputError(f"{path}: not valid TOML: {reason}") from None


def checked(table: type[TableType], data: dict[str, Any], where: str | Path) -> TableType:
    """Returns parsed TOML as a `table`; `where` names its source in messages."""
    try:
        return table.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{where}: {_complaint(table, data, error)}") from None


# --- How messages name keys ----------------------------------------------------------------------


def dotted(keys: Sequence[str]) -> str:
    """Keys as TOML writes them: joined by dots, quoted where they are no bare keys."""
    return ".".join(k if re.fullmatch(r"[\w-]+", k, re.ASCII) else quoted(k) for k in keys)


def header(keys: Keys) -> str:
    """A table as a message names it: [design], or [[design.test_pose]] no. 2.

    A number (from 0) after a key says which of its tables [[…]] is meant.
    """
    names = dotted([k for k in keys if isinstance(k, str)])
    if keys and isinstance(keys[-1], int):
        return f"[[{names}]] no. {keys[-1] + 1}"
    return f"[{names}]"


def place(*keys: str | int) -> str:
    """A key as a message names it: design.poses, or q_deg of [[design.test_pose]] no. 2."""
    last = max((i for i, k in enumerate(keys) if isinstance(k, int)), default=-1)
    rest = dotted([k for k in keys[last + 1 :] if isinstance(k, str)])
    if last < 0:
        return rest
    table = header(keys[: last + 1])
    return f"{rest} of {table}" if rest else table


# --- Complaints ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Spot:
    """Where pydantic complains: the keys of the file that lead there and what stands there.

    `tables` may hold the last key, which takes `takes`; `name_above`: the key before the last is
    a name that the user chose.
    """

    keys: list[str | int]
    found: Any
    tables: list[type[BaseModel]]
    takes: str
    name_above: bool


def _complaint(root: type[BaseModel], data: dict[str, Any], error: ValidationError) -> str:
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key is the cause, the key then missing only its consequence.
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    spot = _spot(root, data, first["loc"])
    here = place(*spot.keys)
    if first["type"] == "extra_forbidden" and here in GONE:
        return f"key {here} is gone: {GONE[here]}"
    if first["type"] == "extra_forbidden":
        return f"unknown key {here}{_advice(spot, root)}"
    if first["type"] == "missing" and spot.found is None:
        return f"key {here} is missing; it takes {spot.takes}"
    hint = ""
    if first["type"] == "literal_error" and isinstance(spot.found, str):
        hint = did_you_mean(spot.found, re.findall(r'"(\w+)"', spot.takes))
    for table in spot.tables:
        if table.model_config.get("extra") == "allow" and spot.keys[-1] not in table.model_fields:
            hint = did_you_mean(str(spot.keys[-1]), table.model_fields)
    return f"key {here} takes {spot.takes}; found {shown(spot.found)}{hint}"


def shown(found: object) -> str:
    """`found` as a message shows it, true and false as TOML writes them."""
    return str(found).lower() if isinstance(found, bool) else quoted(found)


def _spot(root: type[BaseModel], data: Any, loc: Keys) -> _Spot:
    spot = _Spot([], data, [root], "a table", False)
    kinds: list[Any] = [root]
    chosen = False
    for part in loc:
        stated = part in spot.found if isinstance(spot.found, dict) else isinstance(part, int)
        tables = [kind for kind in kinds if is_table(kind)]
        fields = [t.model_fields[part] for t in tables if part in t.model_fields]
        inner = list(_inside(kinds, part, stated))
        if isinstance(part, int) and not any(map(is_table, inner)):
            break  # a number in a list: the list is shown whole
        if chosen and not tables:
            break  # a name in a table of the user's own: that table is shown whole
        if not (fields or inner or (stated and tables)):
            continue  # pydantic's name for a branch of a union
        takes = spot.takes
        if isinstance(part, int):
            takes = "a table"
        elif fields:
            takes = fields[0].description or takes
        found = spot.found[part] if stated else None
        spot = _Spot([*spot.keys, part], found, tables, takes, chosen)
        kinds, chosen = inner, isinstance(part, str) and not fields
    return spot


def _inside(kinds: Sequence[Any], part: str | int, stated: bool) -> Iterator[Any]:
    """What may stand under the key or number `part` of what is one of `kinds`."""
    for kind in kinds:
        inner: Any = ()
        if is_table(kind):
            inner = part in kind.model_fields and kind.model_fields[part].annotation
        elif get_origin(kind) is dict and isinstance(part, str) and stated:
            inner = get_args(kind)[1]
        elif get_origin(kind) is list and isinstance(part, int):
            inner = get_args(kind)[0]
        if inner:
            yield from alternatives(inner)


def is_table(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def alternatives(kind: Any) -> Iterator[Any]:
    """The members of a union, without their validators; the type itself where it is none."""
    if get_origin(kind) is Annotated:
        yield from alternatives(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for member in get_args(kind):
            yield from alternatives(member)
    else:
        yield kind


def tables_in(kind: Any) -> list[tuple[type[BaseModel], bool]]:
    """The tables that a type holds, and whether as a list of them, [[…]]."""
    found: list[tuple[type[BaseModel], bool]] = []
    for member in alternatives(kind):
        if is_table(member):
            found.append((member, False))
        else:
            many = get_origin(member) is list
            found += [(t, many) for inner in get_args(member) for t, _ in tables_in(inner)]
    return found


def _advice(spot: _Spot, root: type[BaseModel]) -> str:
    name, above = str(spot.keys[-1]), spot.keys[:-1]
    if spot.name_above and isinstance(spot.found, dict):
        table, full = [str(k) for k in above[:-1]], f"{above[-1]}.{name}"
        return f'; write a full name in quotes: [{dotted(table)}."{full}"]'
    valid = [field for table in spot.tables for field in table.model_fields]
    where = header(above).split(" no. ")[0] if above else "the top level"
    takes = f"{where} takes {listed(valid)}"
    for what, stem in (("missing", name), ("other", UNIT_SUFFIX.sub("", name))):
        stated = [v for v in valid if v.startswith(stem + "_") and UNIT_SUFFIX.sub("", v) == stem]
        if stated:
            return f"; {what} unit: did you mean {' or '.join(stated)}? {takes}"
    if homes := list(_homes_of(name, root, ())):
        return f"; did you mean it in {' or '.join(homes[:4])}? {takes}"
    near = nearest(name, valid)
    return f"; did you mean {near}? {takes}" if near else f"; {takes}"


def _homes_of(name: str, table: type[BaseModel], above: tuple[str, ...]) -> Iterator[str]:
    """The headers of the tables below the top level that take the key `name`."""
    for field, known in table.model_fields.items():
        for inner, many in tables_in(known.annotation):
            names = dotted((*above, field))
            if name in inner.model_fields:
                yield f"[[{names}]]" if many else f"[{names}]"
            yield from _homes_of(name, inner, (*above, field))
