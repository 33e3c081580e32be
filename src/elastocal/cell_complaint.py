"""From a pydantic complaint to a sentence: file, dotted key, what it takes, what was found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from elastocal.cell_schema import CellTable
from elastocal.errors import InputError
from elastocal.nearest import did_you_mean, listed, nearest, quoted

UNIT_SUFFIX = re.compile(r"_(um|mm|cm|m|deg|rad|urad|mrad|ppm|N|kN|N_per_m|N_per_mm|s)$")


def complaint(path: Path, data: dict[str, Any], error: ValidationError) -> InputError:
    """The first problem pydantic found in the parsed TOML `data`, told as an InputError."""
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key is the cause, the key then missing only its consequence.
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    keys, tables, takes = _trace(first["loc"])
    key = dotted(keys)
    if first["type"] == "extra_forbidden":
        return InputError(f"{path}: unknown key {key}{_advice(keys, tables)}")
    if first["type"] == "missing":
        return InputError(f"{path}: key {key} is missing; it takes {takes}")
    found: Any = data
    for name in keys:
        found = found[name]
    shown = quoted(found) if not isinstance(found, bool) else str(found).lower()
    hint = ""
    if first["type"] == "literal_error" and isinstance(found, str):
        hint = did_you_mean(found, re.findall(r'"(\w+)"', takes))
    return InputError(f"{path}: key {key} takes {takes}; found {shown}{hint}")


def dotted(keys: Sequence[str]) -> str:
    """Keys as TOML writes them: joined by dots, quoted where they are no bare keys."""
    return ".".join(k if re.fullmatch(r"[\w-]+", k, re.ASCII) else quoted(k) for k in keys)


def _trace(loc: Sequence[int | str]) -> tuple[list[str], type[BaseModel], str]:
    """The keys of a location, the table of the last known one, and what that key takes."""
    keys: list[str] = []
    table: type[BaseModel] = CellTable
    inner: type[BaseModel] | None = CellTable
    free_keys, takes = False, "a table"
    for part in loc:
        if inner is not None:
            table = inner
            keys.append(str(part))
            known = table.model_fields.get(str(part))
            if known is None:
                break
            takes = known.description or takes
            types = (known.annotation, *get_args(known.annotation))
            inner = next((t for t in types if _is_table(t)), None)
            free_keys = any(get_origin(t) is dict for t in types)
        elif free_keys and isinstance(part, str):
            keys.append(part)
            free_keys = False
        else:  # a list index, or pydantic's name for a branch of a union
            break
    return keys, table, takes


def _is_table(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _advice(keys: list[str], table: type[BaseModel]) -> str:
    name, valid = keys[-1], list(table.model_fields)
    where = f"[{dotted(keys[:-1])}]" if len(keys) > 1 else "the top level"
    takes = f"{where} takes {listed(valid)}"
    if with_unit := with_units(name, valid):
        return f"; missing unit: did you mean {' or '.join(with_unit)}? {takes}"
    stem = UNIT_SUFFIX.sub("", name)
    if stem != name and (with_unit := with_units(stem, valid)):
        return f"; other unit: did you mean {' or '.join(with_unit)}? {takes}"
    if home := _home_of(name, CellTable, ()):
        return f"; did you mean it in [{home}]? {takes}"
    near = nearest(name, valid)
    return f"; did you mean {near}? {takes}" if near else f"; {takes}"


def with_units(stem: str, valid: Sequence[str]) -> list[str]:
    """The valid names that are `stem` and a unit."""
    return [v for v in valid if v.startswith(stem + "_") and UNIT_SUFFIX.sub("", v) == stem]


def _home_of(name: str, table: type[BaseModel], above: tuple[str, ...]) -> str | None:
    """The dotted table that takes the key `name`, if any below the top level does."""
    if above and name in table.model_fields:
        return dotted(above)
    for key, known in table.model_fields.items():
        for inner in (known.annotation, *get_args(known.annotation)):
            if _is_table(inner) and (home := _home_of(name, inner, (*above, key))):
                return home
    return None
