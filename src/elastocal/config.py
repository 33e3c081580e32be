"""TOML files that users write: read with a bound on their size, and checked key by key.

A table of a file is a `Record`, a frozen dataclass in SI units that Python code may build as well,
or a `Table`, a pydantic model of what only files state.  Either says of each key what it takes, and
`checked` reads a table by walking through its keys.  What is wrong is told as one sentence: file,
key, what the key takes, what was found, and the nearest valid name.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial, wraps
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)  # fmt: skip

import numpy as np
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationError,
)  # fmt: skip
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic_core import PydanticCustomError

from elastocal.above import ByValue
from elastocal.files import DEEPEST, check_exists, read_text
from elastocal.messages import (
    GONE,
    InputError,
    did_you_mean,
    listed,
    nearest,
    quoted,
    require,
    said_of,
    wish,
)
from elastocal.units import Array, rotation_from_rpy, to_si

MAX_BYTES = 1_000_000
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
FARTHEST = 1e4  # m; no cell is as large, and a move of a tool that long is checked for minutes
# A key of DEEPEST parts where a key may begin, for which tomllib takes time that grows with their
# square.
_DOTTED = re.compile(
    r"""(?:^|[{,])[ \t]*+\[{0,2}+(?:[ \t]*+(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.)"""
    rf"{{{DEEPEST - 1}}}",
    re.MULTILINE,
)
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
    "s": ("s", "s"),
    "N": ("N", "N"),
    "Nm": ("N m", "N m"),
}

WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}

Stated = TypeVar("Stated")
Member = TypeVar("Member")
Into = Callable[[Any, "Spot", str], Any]


# --- What a file may state -----------------------------------------------------------------------


class Table(BaseModel):
    """A table of a TOML file; its fields are its keys."""

    model_config = STRICT | ConfigDict(frozen=True)


def key(takes: str, default: Any = None) -> Any:
    """A key of a `Table`; `takes` completes the sentence 'key … takes …'.  One whose `default` is
    ... must be there."""
    return Field(default=default, description=takes)


@dataclass(frozen=True)
class Key:
    """A key of a file; `takes` completes the sentence 'key … takes …', "" for what its type takes
    in the unit that its name ends with, and the `note` behind that.  `form`: the type of its value
    there, None where it is the field's.  `into`: makes the field's value of it, its table and its
    name; None converts from the unit.  `kind`: the type that is checked, as `fields_of` finds it.
    """

    name: str = ""
    takes: str = ""
    form: Any = None
    into: Into | None = None
    required: bool = False
    note: str = ""
    kind: Any = None

    @property
    def unit(self) -> str:
        """The unit of its value, "" where that is SI or has none."""
        return max((u for u in UNITS if self.name.endswith("_" + u)), key=len, default="")

    def of(self, field: str, hint: Any) -> Key:
        known = replace(self, name=self.name or field, kind=self.kind or self.form or hint)
        unit = f" in {UNITS[known.unit][0]}" if known.unit else ""
        return replace(known, takes=known.takes or f"{described(known.kind)}{unit}{known.note}")


def keyed(
    *names: str, takes: str = "", note: str = "", form: Any = None, into: Into | None = None,
    keys: Sequence[Key] = (), required: bool | None = None, **default: Any,
) -> Any:  # fmt: skip
    """A field of a record that a file states; `default` or `default_factory` as of `field`.
    `names` of its key end with their unit; none is the field's own name, and of several the user
    chooses one.  `keys` in their place where several state the field together; then `from_keys` of
    the record puts them together.  What has no default is `required`, if nothing else is said."""
    needed = not default if required is None else required
    own = [Key(name, takes, form, into, needed, note) for name in names or ("",)]
    return field(metadata={"keys": tuple(keys or own)}, **default)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, keyed))
class Record(ByValue):
    """Each class derived from it is a frozen dataclass whose fields are checked, in SI units.  A
    wrong argument is an InputError that names class, field, what it takes and what was found."""

    def __init_subclass__(cls) -> None:
        made: Any = pydantic_dataclass(frozen=True, eq=False, config=STRICT)(cls)
        checked_init = made.__init__

        @wraps(checked_init)
        def init(self: Any, *args: Any, **kwargs: Any) -> None:
            try:
                checked_init(self, *args, **kwargs)
            except ValidationError as error:
                raise InputError(_wrong_argument(made, error)) from None

        made.__init__ = init


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
        by_type = known.form is not None or kind == "matrix" or "dataclass" in kind
        if kind == "rule" or not by_type:
            told = known.takes.replace(*UNITS.get(known.unit, ("", "")))
    words = re.findall(r'"(\w+)"', told) if kind == "literal_error" else ()
    hint = did_you_mean(str(first["input"]), words)
    key = wish(str(name), f"{own}: {name}")
    return f"{key} takes {told}; found {shown(first['input'])}{hint}"


def _fields_of(cls: Any) -> dict[str, tuple[Key, ...]]:
    hints = get_type_hints(cls, include_extras=True)
    if issubclass(cls, BaseModel):
        of = cls.model_fields
        keys = {name: Key(name, one.description or "") for name, one in of.items()}
        return {
            name: (replace(one.of(name, hints[name]), required=of[name].is_required()),)
            for name, one in keys.items()
        }
    return {
        name: tuple(known.of(name, hints[name]) for known in one.metadata.get("keys", ()))
        for name, one in cls.__dataclass_fields__.items()
    }


# Field of a table or record → the keys that state it.
fields_of: Callable[[Any], dict[str, tuple[Key, ...]]] = cache(_fields_of)


def keys_of(*classes: Any, without: Sequence[str] = ()) -> list[Key]:
    every = (known for one in classes for keys in fields_of(one).values() for known in keys)
    return [known for known in every if known.name not in without]


def described(kind: Any) -> str:
    """A type in words: its own, the members of a Literal, of a dict or union the first one's."""
    stated = [getattr(one, "func", one) for one in getattr(kind, "__metadata__", ())]
    own = [told for one in stated if (told := getattr(one, "description", None))]
    inner = get_args(kind)
    if own or is_table(kind) or not inner:
        return own[0] if own else WORDS.get(kind, "a table")
    if get_origin(kind) is Literal:
        *first, last = (f'"{name}"' for name in inner)
        return f"{', '.join(first)} or {last}"
    if tables_in(kind) and get_origin(kind) is tuple:
        return "tables, each headed [[…]]"
    return described(inner[get_origin(kind) is dict])


def is_table(kind: object) -> bool:
    records = hasattr(kind, "__dataclass_fields__")
    return isinstance(kind, type) and (records or issubclass(kind, BaseModel))


def alternatives(kind: Any) -> Iterator[Any]:
    """The members of a union, without their validators; the type itself where it is none."""
    if get_origin(kind) is Annotated:
        yield from alternatives(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for member in get_args(kind):
            yield from alternatives(member)
    else:
        yield kind


def tables_in(kind: Any) -> list[tuple[Any, bool]]:
    """The tables and records that a type holds, and whether as a list of them, [[…]]."""
    found: list[tuple[Any, bool]] = []
    for member in alternatives(kind):
        if is_table(member):
            found.append((member, False))
        else:
            many = get_origin(member) in (list, tuple)
            found += [(t, many) for inner in get_args(member) for t, _ in tables_in(inner)]
    return found


# --- Reading -------------------------------------------------------------------------------------


def read_toml(path: str | Path, what: str, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    text = read_text(path, what, max_bytes)
    if found := _DOTTED.search(text):
        line = text.count("\n", 0, found.end()) + 1
        raise InputError(
            f"{path}, line {line}: nested more than {DEEPEST} deep; no key needs more than a few "
            "levels, so check the dots there"
        )
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path}: nested without end; check its brackets") from None
    except ValueError as error:
        lines = text.split("\n")
        end = f"(at line {len(lines)}, column {len(lines[-1]) + 1}, the end of the file)"
        reason = str(error).replace("(at end of document)", end)
        raise InputError(f"{path}: not valid TOML: {reason}") from None


@dataclass(frozen=True)
class Spot:
    """A table of the file `path`, whose top level is `root`: the keys that lead to it, the last a
    name that the user chose where `named`."""

    path: Any
    keys: tuple[str | int, ...] = ()
    root: Any = None
    named: bool = False

    def __truediv__(self, part: str | int) -> Spot:
        return replace(self, keys=(*self.keys, part), named=False)

    def key(self, name: str) -> str:
        return place(*self.keys, name)


def checked(table: type[Stated], data: Mapping[str, Any], where: str | Path) -> Stated:
    with said_of(where):
        found: Stated = _table(table, data, Spot(where, root=table), "a table")
    return found


def _table(cls: Any, data: Mapping[str, Any], spot: Spot, takes: str) -> Any:
    known, found = [one.name for one in keys_of(cls)], {}
    more = getattr(cls, "more", "forbid")  # of a record
    more = cls.model_config.get("extra") if issubclass(cls, BaseModel) else more
    others = [name for name in data if name not in known]
    for name in others if more == "forbid" else ():
        raise InputError(_unknown(cls, name, data[name], spot))
    for name in others if more == "allow" else ():
        kind = get_args(get_type_hints(cls, include_extras=True)["__pydantic_extra__"])[1]
        found[name] = _value(kind, data[name], spot / name, takes, did_you_mean(name, known))
    for keys in fields_of(cls).values():
        in_a_unit = all(one.required for one in keys) and any(one.name in data for one in keys)
        for one in keys:
            told = f"key {spot.key(one.name)} is missing; it takes {one.takes}"
            require(one.name in data or in_a_unit or not one.required, told)
            if one.name in data:
                found[one.name] = _value(one.kind, data[one.name], spot / one.name, one.takes)
    if issubclass(cls, BaseModel):
        return cls.model_construct(**found)
    return from_table(cls, found, spot)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind, config=STRICT)


def _value(kind: Any, found: Any, spot: Spot, takes: str, hint: str = "") -> Any:
    members = list(alternatives(kind))
    for member in members:
        inner, origin = get_args(member), get_origin(member)
        if is_table(member) and isinstance(found, dict):
            return _table(member, found, spot, takes)
        if inner and tables_in(member) and isinstance(found, dict) and origin is dict:
            found = {
                name: _value(inner[1], value, replace(spot / name, named=True), takes)
                for name, value in found.items()
            }
        elif inner and tables_in(member) and isinstance(found, list) and origin in (list, tuple):
            found = [_value(inner[0], v, spot / i, "a table") for i, v in enumerate(found)]
    keys, problem = spot.keys, ""
    if not is_table(members[0]):
        try:
            return _adapter(kind).validate_python(found)
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False)[0]
            problem, path = first["type"], first["loc"]
            hint = first["msg"] if problem == "repeated" else hint
            # A name in a table of the user's own; what stands below it is shown whole.
            for name in [p for p in path if isinstance(found, dict) and p in found][:1]:
                keys, found = (*keys, name), found[name]
    if problem == "literal_error" and isinstance(found, str):
        hint = did_you_mean(found, re.findall(r'"(\w+)"', takes))
    takes = takes.replace("[[…]]", f"[[{place(*keys)}]]")
    raise InputError(f"key {place(*keys)} takes {takes}; found {shown(found)}{hint}")


def from_table(cls: type[Stated], table: Mapping[str, Any], spot: Spot, **values: Any) -> Stated:
    """The record that the checked values of a table state, in SI units; `values` are known.
    `cls.from_keys(table, spot)`, where there is one, gives the fields that several keys state
    together; each other field is stated by one of its keys."""
    known: Any = cls
    values |= known.from_keys(table, spot) if hasattr(cls, "from_keys") else {}
    for name, keys in fields_of(known).items():
        if name not in values and (given := stated(table, spot, keys)):
            values[name] = given[0]
    return cls(**values)


def stated(table: Mapping[str, Any], spot: Spot, keys: Sequence[Key]) -> tuple[Any, str] | None:
    """The value in SI units and name of the one of `keys` that the table states, None for none."""
    given = [known for known in keys if known.name in table]
    if len(given) > 1:
        names = " and ".join(spot.key(known.name) for known in given)
        raise InputError(f"{names} say the same in two units; keep one of them")
    if not given:
        return None
    known = given[0]
    found, unit = table[known.name], known.unit
    if known.into is not None:
        return known.into(found, spot, known.name), known.name
    if not unit:
        return found, known.name
    several = isinstance(found, Mapping)
    values = {k: to_si(v, unit) for k, v in (found if several else {"": found}).items()}
    for name, value in values.items() if UNITS[unit][1] == "m" else ():
        far = float(np.max(np.abs(value), initial=0.0))
        here = spot.key(known.name) + (f".{dotted((name,))}" if several else "")
        require(far <= FARTHEST, f"key {here}: {far:g} m reaches beyond any cell; correct it")
    return values if several else values[""], known.name


def joint_values(
    table: Mapping[str, Sequence[float]], spot: Spot, name: str, others: tuple[str, ...] = ()
) -> dict[str, tuple[float, ...]]:
    """In SI units per joint name, from keys such as joint2_deg of the table `name`, whose further
    keys are the `others`.  Joints may be named as in the robot's file: `model.joint_names`."""
    values: dict[str, tuple[float, ...]] = {}
    above = spot.key(name)
    for key, stated_values in table.items():
        match = JOINT_KEY.fullmatch(key)
        if match is None:
            hint = did_you_mean(key, others) or (
                f"; missing unit: {' or '.join(f'{key}_{u}' for u in JOINT_UNITS)}"
            )
            raise InputError(
                f"unknown key {above}.{dotted((key,))}{hint}; [{above}] takes "
                "keys such as joint1_deg or joint1_rad, for a prismatic joint joint3_m or joint3_mm"
            )
        joint, unit = match.groups()
        require(joint not in values, f"[{above}] gives {joint} in two units; keep one of them")
        values[joint] = tuple(to_si(float(v), unit) for v in stated_values)
    return values


# --- How messages name keys ----------------------------------------------------------------------


def shown(found: object) -> str:
    """`found` as a message shows it, true and false as TOML writes them."""
    return str(found).lower() if isinstance(found, bool) else quoted(found)


def dotted(keys: Sequence[str]) -> str:
    return ".".join(k if re.fullmatch(r"[\w-]+", k, re.ASCII) else quoted(k) for k in keys)


def header(keys: Sequence[str | int]) -> str:
    """[design], or [[design.test_pose]] no. 2, by a number (from 0) after its key."""
    names = dotted([k for k in keys if isinstance(k, str)])
    if keys and isinstance(keys[-1], int):
        return f"[[{names}]] no. {keys[-1] + 1}"
    return f"[{names}]"


def place(*keys: str | int) -> str:
    """design.poses, or q_deg of [[design.test_pose]] no. 2."""
    last = max((i for i, k in enumerate(keys) if isinstance(k, int)), default=-1)
    rest = dotted([k for k in keys[last + 1 :] if isinstance(k, str)])
    if last < 0:
        return rest
    table = header(keys[: last + 1])
    return f"{rest} of {table}" if rest else table


def _unknown(cls: Any, name: str, found: Any, spot: Spot) -> str:
    here, above, valid = spot.key(name), spot.keys, [one.name for one in keys_of(cls)]
    if here in GONE:
        return f"key {here} is gone: {GONE[here]}"
    if spot.named and isinstance(found, dict):
        table, full = [str(k) for k in above[:-1]], f"{above[-1]}.{name}"
        return f'unknown key {here}; write a full name in quotes: [{dotted(table)}."{full}"]'
    where = header(above).split(" no. ")[0] if above else "the top level"
    # First what it lacks but the unit, then where else it stands.
    units = near = [v for v in valid if v.startswith(f"{name}_")]
    near = near or [f"it in {home}" for home in _homes_of(name, spot.root, ())][:4]
    near = near or [v for v in [nearest(name, valid)] if v]
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    hint = f"missing unit: {hint}" if units else hint
    return f"unknown key {here}; {hint}{where} takes {listed(valid)}"


def _homes_of(name: str, table: Any, above: tuple[str, ...]) -> Iterator[str]:
    for one in keys_of(table):
        for inner, many in tables_in(one.kind):
            names = dotted((*above, one.name))
            if name in [known.name for known in keys_of(inner)]:
                yield f"[[{names}]]" if many else f"[{names}]"
            yield from _homes_of(name, inner, (*above, one.name))


# --- What keys and fields take -------------------------------------------------------------------


def is_number(value: object) -> bool:
    number = isinstance(value, int | float | np.integer | np.floating)
    return number and not isinstance(value, bool) and abs(value) <= sys.float_info.max  # type: ignore[arg-type]


def numbers(
    *shape: int | None, least: float = -np.inf, above: float = -np.inf, one_for_all: bool = False
) -> PlainValidator:
    """The validator of finite numbers in lists, or lists of lists, which become an array.  In its
    `shape` None stands for any number but zero; `one_for_all` takes a single number too, as that of
    all.  Each is at least `least` and greater than `above`."""
    n, *columns = wanted = shape or (None,)
    kind, few = "numbers", {2: "two", 3: "three", None: "a list of"}.get(n, f"{n}")
    size = "positive " * (above == 0)
    takes = f"a {size}number" if one_for_all else f"{few} {size}numbers"
    if columns:
        kind, takes = "matrix", f"an array ({n or 'n'}, {columns[0]})"

    def check(value: object) -> Array:
        given = np.array(value, dtype=object)  # texts and truths stay what they are
        if one_for_all and not given.ndim:
            given = np.full(n or 1, given)
        shaped = tuple(m or k for m, k in zip(wanted, given.shape, strict=False)) == given.shape
        if given.size and shaped and given.ndim == len(wanted) and all(map(is_number, given.flat)):
            found = given.astype(float)
            if (found >= least).all() and (found > above).all():
                return found
        raise PydanticCustomError(kind, takes)

    check.description = takes  # type: ignore[attr-defined]
    return PlainValidator(check)


def holding(rule: Callable[[Any], object]) -> AfterValidator:
    """The validator of values for which a rule, told in the note of their key, returns something
    true, and raises no ValueError."""

    def check(value: Any) -> Any:
        if not rule(value):
            raise PydanticCustomError("rule", "")
        return value

    return AfterValidator(check)


def _all_differ(values: Any) -> Any:
    listing = (values + 0.0).tolist() if isinstance(values, np.ndarray) else values
    if twice := [name for name, n in Counter(map(str, listing)).items() if n > 1]:
        raise PydanticCustomError("repeated", f", with {listed(twice)} more than once")
    return values


def _direction(value: object) -> Array:
    check: Any = numbers(3).func
    vector: Array = check(value)
    if not vector.any():
        raise PydanticCustomError("zero", "a direction, as in [0, 0, 1]")
    # First by the largest entry, whose square cannot overflow or vanish.
    scaled = vector / np.abs(vector).max()
    unit: Array = scaled / np.linalg.norm(scaled)
    # What has unit length already stays as it is, digit for digit.
    return vector if np.abs(vector - unit).max() < 1e-12 else unit


def existing_file(found: str, spot: Spot, name: str) -> Path:
    return check_exists(spot.path.parent / found, f"key {spot.key(name)}")


def _as_tuple(value: object) -> object:
    listing = value.tolist() if isinstance(value, np.ndarray) else value
    return tuple(listing) if isinstance(listing, list) else listing


Text = Annotated[str, Field(min_length=1, description="a text")]
Positive = Annotated[float, Field(gt=0, description="a positive number")]
NonNegative = Annotated[float, Field(ge=0, description="a number >= 0")]
Count = Annotated[int, Field(ge=1, le=10_000_000, description="a whole number >= 1")]
Numbers = Annotated[Array, numbers()]
Positives = Annotated[Array, numbers(above=0)]
Vector3 = Annotated[Array, numbers(3)]
DISTINCT = AfterValidator(_all_differ)
RISING = holding(lambda ends: bool(np.less(ends[0], ends[-1]).all()))
TUPLE = BeforeValidator(_as_tuple)
AnyFloat = Annotated[float, AllowInfNan(True)]
Many = Annotated[tuple[Member, ...], TUPLE]
Levels = Annotated[Many[float], DISTINCT]
File = Annotated[Path, BeforeValidator(lambda path: Path(path) if isinstance(path, str) else path)]
Rotation = Annotated[Array, numbers(3, 3)]
Transform = Annotated[Array, numbers(4, 4)]
Direction = Annotated[Array, PlainValidator(_direction), Field(description="three numbers")]
# Fields that need not be stated: None, nothing by name, and none of a list.
optional = partial(keyed, default=None)
by_name = partial(keyed, default_factory=dict)
several = partial(keyed, default=())
# Those of two types, which a file states otherwise.
file_key = partial(optional, form=Text, into=existing_file)
turn_key = partial(optional, form=Vector3, into=lambda v, *_: rotation_from_rpy(np.radians(v)))


# --- Writing -------------------------------------------------------------------------------------

WIDE = 90  # characters of a list on one line


def toml_value(value: Any) -> str:
    import tomlkit  # slow to load, seldom asked for

    return str(folded(tomlkit.item(value)).as_string())


def toml_key(name: str) -> str:
    import tomlkit

    return str(tomlkit.key(name).as_string())


def rewritten_toml(text: str, change: Callable[[Any], None]) -> str:
    """The TOML `text` after a `change` of what it says, which is made in place: all other lines
    stay, with the comments around them."""
    import tomlkit

    data, document = tomllib.loads(text), tomlkit.parse(text)
    change(data)
    with suppress(tomlkit.exceptions.TOMLKitError, ValueError):
        change(document)
        if tomllib.loads(found := tomlkit.dumps(document)) == data:
            return found
    return tomlkit.dumps(data)


def folded(item: Any) -> Any:
    """A list of a document, over several lines where it is long."""
    if isinstance(item, list) and len(getattr(item, "as_string", str)()) > WIDE:
        item.multiline(True)  # type: ignore[attr-defined]
    return item
