"""TOML files that users write: read with a bound on their size, and checked against tables of keys.

A table of the file is a `Table`, a pydantic model whose fields are its keys; the description of a
key says what it takes.  What pydantic finds wrong is told as one sentence: file, key, what the key
takes, what was found, and the nearest valid name.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, wraps
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import (
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    create_model,
)
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic_core import PydanticCustomError

from elastocal.errors import GONE, InputError, require
from elastocal.files import check_exists, check_nesting, read_text
from elastocal.text import did_you_mean, listed, nearest, quoted
from elastocal.units import Array, rotation_from_rpy, to_si

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
    for one, known in table.model_fields.items():
        for inner, many in tables_in(known.annotation):
            names = dotted((*above, one))
            if name in inner.model_fields:
                yield f"[[{names}]]" if many else f"[{names}]"
            yield from _homes_of(name, inner, (*above, one))


# --- Records -------------------------------------------------------------------------------------
#
# A class of the cell is a `record`: a frozen dataclass in SI units whose fields pydantic checks.  A
# field that a file may state is `keyed`: its name and unit there, and what it takes.  From these
# keys come the table that a file is checked against (`table_of`), the record of a checked table
# (`from_table`), and what is said of a wrong argument in Python.

Record = TypeVar("Record")
Member = TypeVar("Member")
FARTHEST = 1e4  # m; no cell is as large, and a move of a tool that long is checked for minutes
JOINT_UNITS = ("deg", "rad", "m", "mm")
JOINT_KEY = re.compile(r"(.+)_(deg|rad|mm|m)", re.ASCII)
# Units that key names end with, in words, and the SI unit in its place in Python.
UNITS = {
    "m": ("m", "m"),
    "si": ("rad or m", "rad or m"),
    "um": ("µm", "m"),
    "mm": ("mm", "m"),
    "ppm": ("µm per m", "m per m"),
    "deg": ("degrees", "rad"),
    "urad": ("µrad", "rad"),
    "deg_per_s": ("°/s", "rad/s"),
}


@dataclass(frozen=True)
class Spot:
    """A table of the cell file `path`: the keys that lead to it."""

    path: Path
    keys: tuple[str | int, ...] = ()

    def __truediv__(self, part: str | int) -> Spot:
        return Spot(self.path, (*self.keys, part))

    def key(self, name: str) -> str:
        """The key `name` of this table as a message names it."""
        return place(*self.keys, name)

    def require(self, condition: object, sentence: str) -> None:
        """Raises InputError with the file and `sentence` unless `condition` holds."""
        require(bool(condition), f"{self.path}: {sentence}")


@dataclass(frozen=True)
class Key:
    """A key of the cell file; `takes` completes the sentence 'key … takes …'.

    `form`: the type of its value there, None where it is the field's.  `into`: makes the field's
    value of it, its table and its name; None converts from the unit that the name ends with.
    """

    name: str
    takes: str
    form: Any = None
    into: Callable[[Any, Spot, str], Any] | None = None
    required: bool = False

    @property
    def unit(self) -> str:
        """The unit of its value, "" where that is SI or has none."""
        return max((u for u in UNITS if self.name.endswith("_" + u)), key=len, default="")


@dataclass(frozen=True)
class FromFile:
    """In the Annotated of a type: the `form` and `into` of its keys, as of `Key`."""

    form: Any
    into: Callable[[Any, Spot, str], Any]


def keyed(
    takes: str = "",
    *names: str,
    form: Any = None,
    into: Callable[[Any, Spot, str], Any] | None = None,
    keys: Sequence[Key] = (),
    required: bool = False,
    **default: Any,
) -> Any:
    """A field of a record that a cell file states; `default` or `default_factory` as of `field`.

    `names` of its key, which end with their unit, {} in `takes`; none is the field's own name, and
    of several the user chooses one.  Without `takes` it is one of a Literal, or true or false.
    `keys` in their place where several state the field together; then `from_keys` of the record
    puts them together.  The others are as of `Key`.
    """
    own = [Key(name, takes, form, into, required) for name in names or ("",)]
    return field(metadata={"keys": tuple(keys or own)}, **default)


# Arrays in a union; each is checked by a validator of its own.
CONFIG = STRICT | ConfigDict(arbitrary_types_allowed=True)


@dataclass_transform(frozen_default=True, field_specifiers=(field, keyed))
def record(cls: type[Record]) -> type[Record]:
    """Make a class a frozen dataclass whose fields are checked, in SI units.

    A wrong argument is an InputError that names class, field, what it takes and what was found.
    """
    made: Any = pydantic_dataclass(frozen=True, config=CONFIG)(cls)
    checked_init = made.__init__

    @wraps(checked_init)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            checked_init(self, *args, **kwargs)
        except ValidationError as error:
            raise InputError(_wrong_argument(made, error)) from None

    made.__init__ = init
    return made


def _wrong_argument(cls: Any, error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    kind, name, own, fields = first["type"], first["loc"][0], cls.__name__, list(fields_of(cls))
    if kind == "unexpected_keyword_argument":
        return f"{own} has no {name}{did_you_mean(str(name), fields)}; it takes {listed(fields)}"
    if kind == "unexpected_positional_argument":
        return f"{own} takes at most {len(fields)} values: {listed(fields)}"
    if kind == "missing":
        return f"{own}: {name} is missing; it takes {listed(fields)}"
    name = fields[name] if isinstance(name, int) else name
    told = first["msg"].removeprefix("Input should be ")
    for known in fields_of(cls)[name][:1]:
        if known.form is None and kind != "matrix" and "dataclass" not in kind:
            told = known.takes.replace(*UNITS.get(known.unit, ("", "")))
    words = re.findall(r'"(\w+)"', told) if kind == "literal_error" else ()
    hint = did_you_mean(str(first["input"]), words)
    return f"{own}: {name} takes {told}; found {shown(first['input'])}{hint}"


@cache
def _hints_of(cls: Any) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _fields_of(cls: Any) -> dict[str, tuple[Key, ...]]:
    hints = _hints_of(cls)
    found = {}
    for name, one in cls.__dataclass_fields__.items():
        how = next((note for note in _notes(hints[name]) if isinstance(note, FromFile)), None)
        found[name] = tuple(
            replace(
                known,
                name=known.name or name,
                takes=known.takes.replace("{}", UNITS[known.unit][0] if known.unit else "")
                or _choice(known.form or hints[name]),
                into=known.into or (how and how.into),
            )
            for known in one.metadata.get("keys", ())
        )
    return found


fields_of: Callable[[Any], dict[str, tuple[Key, ...]]] = cache(_fields_of)


def _choice(hint: Any) -> str:
    """The members of a Literal as a sentence lists them, or true or false."""
    if get_origin(hint) is not Literal:
        return "true or false"
    *first, last = (f'"{name}"' for name in get_args(hint))
    return f"{', '.join(first)} or {last}"


def _notes(hint: Any) -> Iterator[Any]:
    """What stands in the Annotated of a type, or of a member of a union."""
    yield from getattr(hint, "__metadata__", ())
    if get_origin(hint) in (Union, UnionType):
        for member in get_args(hint):
            yield from _notes(member)


# --- From the file -------------------------------------------------------------------------------


class RecordTable(Table):
    """A table of the cell file from which a record is built."""

    record: ClassVar[Any]


def keys_of(*records: Any, without: Sequence[str] = ()) -> list[Key]:
    """The keys that state records in a cell file, each with its type there."""
    return [
        replace(known, form=known.form or _form(_hints_of(one)[name]))
        for one in records
        for name, keys in fields_of(one).items()
        for known in keys
        if known.name not in without
    ]


def _form(hint: Any) -> Any:
    for note in _notes(hint):
        if isinstance(note, FromFile):
            return note.form
    for kind in alternatives(hint):
        if _is_record(kind):
            return table_of(kind)
        if get_origin(kind) is tuple and _is_record(get_args(kind)[0]):
            return list[table_of(get_args(kind)[0])]  # type: ignore[misc]
    return hint


def _is_record(kind: Any) -> bool:
    return hasattr(kind, "__dataclass_fields__")


def _table_of(cls: Any) -> type[RecordTable]:
    fields: dict[str, Any] = {
        k.name: (k.form, Field(... if k.required else None, description=k.takes))
        for k in keys_of(cls)
    }
    made = create_model(f"{cls.__name__}Table", __base__=RecordTable, **fields)
    made.record = cls
    return made


table_of: Callable[[Any], type[RecordTable]] = cache(_table_of)


def from_table(cls: type[Record], table: RecordTable, spot: Spot, **values: Any) -> Record:
    """The record that a checked table states, in SI units; `values` are known otherwise.

    `cls.from_keys(table, spot)`, where there is one, gives the fields that several keys state
    together; each other field is stated by one of its keys.
    """
    known: Any = cls
    if hasattr(cls, "from_keys"):
        values |= known.from_keys(table, spot)
    for name, keys in fields_of(known).items():
        if name not in values and (given := stated(table, spot, keys)):
            values[name] = given[0]
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(f"{spot.path}: {error}") from None


def stated(table: Table, spot: Spot, keys: Sequence[Key]) -> tuple[Any, str] | None:
    """The value in SI units and name of the one of `keys` that the table states, None for none."""
    given = [known for known in keys if getattr(table, known.name, None) is not None]
    names = " and ".join(spot.key(known.name) for known in given)
    spot.require(len(given) < 2, f"{names} say the same in two units; keep one of them")
    for known in given:
        return _value(getattr(table, known.name), known, spot), known.name
    return None


def _value(found: Any, known: Key, spot: Spot) -> Any:
    if isinstance(found, RecordTable):
        return from_table(found.record, found, spot / known.name)
    if isinstance(found, list) and found and isinstance(found[0], RecordTable):
        tables = enumerate(found)
        return tuple(from_table(t.record, t, spot / known.name / i) for i, t in tables)
    if known.into is not None:
        return known.into(found, spot, known.name)
    if not known.unit:
        return found
    several = isinstance(found, Mapping)
    values = {k: to_si(v, known.unit) for k, v in (found if several else {"": found}).items()}
    if UNITS[known.unit][1] == "m":
        for name, value in values.items():
            far = float(np.max(np.abs(value), initial=0.0))
            key = spot.key(known.name) + (f".{dotted((name,))}" if several else "")
            spot.require(
                far <= FARTHEST, f"key {key}: {far:g} m reaches beyond any cell; correct it"
            )
    return values if several else values[""]


def existing_file(found: str, spot: Spot, name: str) -> Path:
    """The file that a key names relative to the cell file; raises InputError where it is none."""
    return check_exists(spot.path.parent / found, spot.key(name), spot.path)


def direction(vector: Array, spot: Spot, name: str) -> Array:
    """A vector (3,) at unit length; raises InputError that names the key where it is zero."""
    unit = _unit_vector(np.asarray(vector, dtype=float))
    if unit is None:
        what = f"key {spot.key(name)} is zero; give a direction, as in [0, 0, 1]"
        raise InputError(f"{spot.path}: {what}")
    return unit


def joint_values(
    table: Mapping[str, Sequence[float]], spot: Spot, name: str, others: tuple[str, ...] = ()
) -> dict[str, tuple[float, ...]]:
    """Values in SI units per joint name, from keys such as joint2_deg of the table `name`.

    `others`: further keys of that table, which a misspelt one may have been meant for.  A joint may
    be named as in the robot's file, which `model.joint_names` looks into.
    """
    values: dict[str, tuple[float, ...]] = {}
    above = spot.key(name)
    for key, stated_values in table.items():
        match = JOINT_KEY.fullmatch(key)
        if match is None:
            hint = did_you_mean(key, others) or (
                f"; missing unit: {' or '.join(f'{key}_{u}' for u in JOINT_UNITS)}"
            )
            raise InputError(
                f"{spot.path}: unknown key {above}.{dotted((key,))}{hint}; [{above}] takes "
                "keys such as joint1_deg or joint1_rad, for a prismatic joint joint3_m or joint3_mm"
            )
        joint, unit = match.groups()
        spot.require(joint not in values, f"[{above}] gives {joint} in two units; keep one of them")
        values[joint] = tuple(to_si(float(v), unit) for v in stated_values)
    return values


# --- What fields take ----------------------------------------------------------------------------


def _tuple(value: object) -> object:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(value) if isinstance(value, list) else value


def matrix(rows: int | None, columns: int) -> PlainValidator:
    """The validator of an array (rows, columns) of finite numbers; None counts any but zero."""
    one_row: Any = numbers(columns).func

    def check(value: object) -> Array:
        listing = value.tolist() if isinstance(value, np.ndarray) else value
        if isinstance(listing, list | tuple) and len(listing) == (rows or len(listing) or 1):
            with suppress(PydanticCustomError):
                return np.array([one_row(row) for row in listing])
        raise PydanticCustomError("matrix", f"an array ({rows or 'n'}, {columns})")

    return PlainValidator(check)


def _unit_vector(vector: Array) -> Array | None:
    """`vector` at unit length, None where it is zero."""
    largest = np.abs(vector).max()
    if largest == 0:
        return None
    # First by the largest entry, whose square cannot overflow or vanish.
    scaled = vector / largest
    return np.asarray(scaled / np.linalg.norm(scaled))


def _direction(value: object) -> Array:
    check: Any = numbers(3).func
    vector: Array = check(value)
    unit = _unit_vector(vector)
    if unit is None:
        raise PydanticCustomError("zero", "a direction, as in [0, 0, 1]")
    # What has unit length already stays as it is, digit for digit.
    return vector if np.abs(vector - unit).max() < 1e-12 else unit


TUPLE = BeforeValidator(_tuple)
AnyFloat = Annotated[float, AllowInfNan(True)]
Many = Annotated[tuple[Member, ...], TUPLE]
AS_PATH = BeforeValidator(lambda value: Path(value) if isinstance(value, str) else value)
File = Annotated[Path, AS_PATH, FromFile(Text, existing_file)]
Rotation = Annotated[
    Array, matrix(3, 3), FromFile(Vector3, lambda rpy, *_: rotation_from_rpy(np.radians(rpy)))
]
Transform = Annotated[Array, matrix(4, 4)]
Direction = Annotated[Array, PlainValidator(_direction), FromFile(Vector3, direction)]
