"""Reads a mapping file and the presets: TOML → checked tables, the user's keys on top."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from elastocal.config import place
from elastocal.errors import InputError
from elastocal.files import read_text
from elastocal.importing.schema import MappingTable, SourceTable
from elastocal.nearest import did_you_mean, listed, quoted

MAX_BYTES = 1_000_000
PRESETS = ("spatialanalyzer", "polyworks", "leica", "faro", "spherical", "kuka", "abb", "ros")
# A key of [source.columns] with its unit cut off: what two keys for the same column share.
_UNIT = re.compile(r"_[A-Za-z]+$")


@dataclass(frozen=True)
class Mapping:
    """`path` says in messages where it was stated; `sources` have their presets merged in."""

    path: str
    table: MappingTable
    sources: tuple[SourceTable, ...]


def preset_text(name: str) -> str:
    """The TOML of a preset.  Raises InputError for an unknown name."""
    if name not in PRESETS:
        raise InputError(
            f"no preset {quoted(name)}{did_you_mean(name, PRESETS)}; there are {listed(PRESETS)}"
        )
    folder = resources.files("elastocal.importing") / "presets"
    return (folder / f"{name}.toml").read_text(encoding="utf-8")


def read_mapping(path: str | Path | None, presets: Sequence[str] = ()) -> Mapping:
    """The mapping of a file, of presets (one source each), or of both.

    A mapping file without [[source]] tables says how to join and convert what `presets` read.
    Raises InputError that names file, key, what the key takes and what was found.
    """
    where = "--preset" if path is None else str(path)
    data: dict[str, Any] = {} if path is None else _parse(Path(path))
    if presets and data.get("source"):
        raise InputError(
            f"{where}: has [[source]] tables, so --preset {presets[0]} has no place; write "
            f'preset = "{presets[0]}" into the [[source]] it is for, or leave --preset out'
        )
    if presets:
        data = {**data, "source": [{"preset": name} for name in presets]}
    _check(where, data)
    if not data.get("source"):
        raise InputError(
            f'{where}: no [[source]] table; add one with preset = "{PRESETS[0]}" or columns, or '
            "give --preset"
        )
    merged = {**data, "source": [_with_preset(where, s) for s in data["source"]]}
    table = _check(where, merged)
    sources = table.source or []
    for k, source in enumerate(sources):
        if not source.columns:
            raise InputError(
                f"{where}: {place('source', k)} has neither preset nor columns; say where the "
                'numbers stand, as in x_mm = "X"'
            )
    return Mapping(where, table, tuple(sources))


def with_units(mapping: Mapping, length: str | None, angle: str | None) -> Mapping:
    """The mapping with the units of the command line, where given, instead of its own."""
    given = {k: v for k, v in (("length", length), ("angle", angle)) if v is not None}
    if not given:
        return mapping
    data = mapping.table.model_dump(exclude_none=True)
    data["units"] = data.get("units", {}) | given
    return replace(mapping, table=_check("--length-unit, --angle-unit", data))


def _parse(path: Path) -> dict[str, Any]:
    text = read_text(path, "mapping file", MAX_BYTES)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def _with_preset(where: str, source: dict[str, Any]) -> dict[str, Any]:
    name = source.get("preset")
    if name is None:
        return source
    try:
        base = tomllib.loads(preset_text(name))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    merged = {**base, **source}
    for part in ("text", "names"):
        merged[part] = base.get(part, {}) | source.get(part, {})
    # x_mm of the user replaces the preset's x_auto, whichever table either stands in.
    own = source.get("columns", {}) | source.get("optional", {})
    taken = {_UNIT.sub("", column) for column in own} | set(own)
    for part in ("columns", "optional"):
        kept = {
            column: at
            for column, at in base.get(part, {}).items()
            if _UNIT.sub("", column) not in taken and column not in taken
        }
        merged[part] = kept | source.get(part, {})
    return merged


def _check(where: str, data: dict[str, Any]) -> MappingTable:
    try:
        return MappingTable.model_validate(data)
    except ValidationError as error:
        raise _complaint(where, data, error) from None


def _complaint(where: str, data: dict[str, Any], error: ValidationError) -> InputError:
    """The first problem as a sentence: file, key, what it takes, what was found."""
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key is the cause, the key then missing only its consequence.
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    keys, tables, found = _trace(first["loc"], data)
    name = str(keys[-1])
    valid = [field for table in tables for field in table.model_fields]
    if first["type"] == "extra_forbidden":
        return InputError(
            f"{where}: unknown key {place(*keys)}{did_you_mean(name, valid)}; there "
            f"{'is' if len(valid) == 1 else 'are'} {listed(valid)}"
        )
    takes = next(
        (
            table.model_fields[k].description
            for k in reversed([str(k) for k in keys])
            for table in tables
            if k in table.model_fields
        ),
        "a table",
    )
    if first["type"] == "missing":
        return InputError(f"{where}: key {place(*keys)} is missing; it takes {takes}")
    shown = quoted(found) if not isinstance(found, bool) else str(found).lower()
    return InputError(f"{where}: key {place(*keys)} takes {takes}; found {shown}")


def _trace(
    loc: Sequence[int | str], data: Any
) -> tuple[list[str | int], list[type[BaseModel]], Any]:
    """The keys of a location as far as the file goes, the tables there, and what stands there."""
    keys: list[str | int] = []
    tables: list[type[BaseModel]] = [MappingTable]
    for part in loc:
        inside = isinstance(data, dict) and part in data
        if inside or (isinstance(data, list) and isinstance(part, int) and part < len(data)):
            data = data[part]
        elif any(part in table.model_fields for table in tables):
            data = None  # a key that is missing
        else:
            continue  # pydantic's name for a branch of a union
        if isinstance(part, str):
            found = [t.model_fields[part].annotation for t in tables if part in t.model_fields]
            tables = [inner for a in found for inner in _tables(a)] or tables
        if isinstance(part, str) or isinstance(data, dict):
            keys.append(part)
    return keys or [str(loc[0])], tables, data


def _tables(annotation: Any) -> list[type[BaseModel]]:
    from typing import get_args

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [inner for a in get_args(annotation) for inner in _tables(a)]
