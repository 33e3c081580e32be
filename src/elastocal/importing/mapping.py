"""Reads a mapping file and the presets: TOML → checked tables, the user's keys on top."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from elastocal.config import checked, place, read_toml
from elastocal.errors import InputError
from elastocal.importing.schema import MappingTable, SourceTable
from elastocal.text import did_you_mean, listed, quoted

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
    data: dict[str, Any] = {} if path is None else read_toml(path, "mapping file", MAX_BYTES)
    if presets and data.get("source"):
        raise InputError(
            f"{where}: has [[source]] tables, so --preset {presets[0]} has no place; write "
            f'preset = "{presets[0]}" into the [[source]] it is for, or leave --preset out'
        )
    if presets:
        data = {**data, "source": [{"preset": name} for name in presets]}
    checked(MappingTable, data, where)
    if not data.get("source"):
        raise InputError(
            f'{where}: no [[source]] table; add one with preset = "{PRESETS[0]}" or columns, or '
            "give --preset"
        )
    merged = {**data, "source": [_with_preset(where, s) for s in data["source"]]}
    table = checked(MappingTable, merged, where)
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
    return replace(mapping, table=checked(MappingTable, data, "--length-unit, --angle-unit"))


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
