"""From a pydantic complaint to a sentence: file, key, what it takes, what was found."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from elastocal.cell_keys import dotted, header, place
from elastocal.cell_schema import CellTable
from elastocal.errors import InputError
from elastocal.text import did_you_mean, listed, nearest, quoted

UNIT_SUFFIX = re.compile(
    r"_(um|mm|cm|m|deg|rad|urad|mrad|ppm|N|kN|Nm|N_per_m|N_per_mm|s|min|si"
    r"|deg_per_s|rad_per_s|m_per_s|mm_per_s)$"
)


def complaint(path: Path, data: dict[str, Any], error: ValidationError) -> InputError:
    """The first problem pydantic found in the parsed TOML `data`, told as an InputError."""
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key is the cause, the key then missing only its consequence.
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    keys, table, takes = _trace(first["loc"])
    key = place(*keys)
    if first["type"] == "extra_forbidden":
        return InputError(f"{path}: unknown key {key}{_advice(keys, table)}")
    if first["type"] == "missing":
        return InputError(f"{path}: key {key} is missing; it takes {takes}")
    found: Any = data
    for name in keys:
        found = found[name]
    shown = quoted(found) if not isinstance(found, bool) else str(found).lower()
    hint = ""
    if first["type"] == "literal_error" and isinstance(found, str):
        hint = did_you_mean(found, re.findall(r'"(\w+)"', takes))
    elif table.model_config.get("extra") == "allow" and keys[-1] not in table.model_fields:
        hint = did_you_mean(str(keys[-1]), table.model_fields)
    return InputError(f"{path}: key {key} takes {takes}; found {shown}{hint}")


def _trace(loc: Sequence[int | str]) -> tuple[list[str | int], type[BaseModel], str]:
    """The keys of a location, the table of the last known one, and what that key takes."""
    keys: list[str | int] = []
    table: type[BaseModel] = CellTable
    inner: type[BaseModel] | None = CellTable
    listing, free_keys, takes = False, False, "a table"
    for part in loc:
        if listing and isinstance(part, int):  # one of the tables [[…]]
            keys.append(part)
            listing, takes = False, "a table"
        elif inner is not None and not listing:
            table, inner = inner, None
            keys.append(str(part))
            known = table.model_fields.get(str(part))
            if known is None:
                break
            takes = known.description or takes
            types = (known.annotation, *get_args(known.annotation))
            inner = next(_tables(known.annotation), None)
            listing = inner is not None and not any(_is_table(t) for t in types)
            free_keys = any(get_origin(t) is dict for t in types)
        elif free_keys and isinstance(part, str):
            keys.append(part)
            free_keys = False
        else:  # a list index, or pydantic's name for a branch of a union
            break
    return keys, table, takes


def _is_table(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _tables(annotation: Any) -> Iterator[type[BaseModel]]:
    """The tables that an annotation holds, in lists and unions too."""
    if _is_table(annotation):
        yield annotation
    for inner in get_args(annotation):
        yield from _tables(inner)


def _advice(keys: Sequence[str | int], table: type[BaseModel]) -> str:
    name, valid = str(keys[-1]), list(table.model_fields)
    where = header(keys[:-1]).split(" no. ")[0] if len(keys) > 1 else "the top level"
    takes = f"{where} takes {listed(valid)}"
    if with_unit := with_units(name, valid):
        return f"; missing unit: did you mean {' or '.join(with_unit)}? {takes}"
    stem = UNIT_SUFFIX.sub("", name)
    if stem != name and (with_unit := with_units(stem, valid)):
        return f"; other unit: did you mean {' or '.join(with_unit)}? {takes}"
    if homes := list(_homes_of(name, CellTable, ())):
        return f"; did you mean it in {' or '.join(homes[:4])}? {takes}"
    near = nearest(name, valid)
    return f"; did you mean {near}? {takes}" if near else f"; {takes}"


def with_units(stem: str, valid: Sequence[str]) -> list[str]:
    """The valid names that are `stem` and a unit."""
    return [v for v in valid if v.startswith(stem + "_") and UNIT_SUFFIX.sub("", v) == stem]


def _homes_of(name: str, table: type[BaseModel], above: tuple[str, ...]) -> Iterator[str]:
    """The headers of the tables below the top level that take the key `name`."""
    for key, known in table.model_fields.items():
        for inner in _tables(known.annotation):
            single = inner in (known.annotation, *get_args(known.annotation))
            names = dotted((*above, key))
            if name in inner.model_fields:
                yield f"[{names}]" if single else f"[[{names}]]"
            yield from _homes_of(name, inner, (*above, key))
