"""The user's cell file with the effects found by a diagnosis switched on."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from elastocal.cell.work_cell import Cell, read_cell
from elastocal.diagnosis.diagnosis import FoundEffect
from elastocal.files import atomic_write_text
from elastocal.plugin_loader import is_plugin_file

# Tables of the cell file, and the keys in them whose values are paths.  A list of tables counts
# as each of its members.
PATHS = (
    (("robot",), ("urdf", "dh", "masses")),
    (("workspace", "obstacle"), ("file",)),
    (("workspace", "body"), ("file",)),
    (("workspace", "load"), ("file",)),
    (("design", "test_path"), ("file",)),
)


def write_extended_cell(
    source: str | Path,
    target: str | Path,
    found: Sequence[FoundEffect],
    model_keys: Mapping[str, str] | None = None,
) -> Cell:
    """Write the cell file `source` to `target` with the effects `found` switched on; read it back.

    Each effect joins `[model] effects` as "effect:where", its searched constants join
    `[model.nominal.settings]`.  Relative paths are rewritten so that they lead from `target`'s
    folder to the same files; a cell without a name keeps the one that its old file gave it.
    `model_keys` join [model] as they are.  Comments are not carried over.  Without effects the
    model is the one that was read.

    Raises InputError where `source` is no valid cell file or `target` cannot be written.
    """
    source, target = Path(source), Path(target)
    cell = read_cell(source)
    text = source.read_text(encoding="utf-8-sig")
    data = {"name": cell.name} | tomllib.loads(text)
    _redirect(data, source.parent, target.parent)
    if found:
        _switch_on(data.setdefault("model", {}), found)
        data["model"] |= dict(model_keys or {})
    atomic_write_text(target, tomli_w.dumps(data))
    return read_cell(target)


def _switch_on(model: dict[str, Any], found: Sequence[FoundEffect]) -> None:
    effects = model.setdefault("effects", [])
    for f in found:
        if (entry := f"{f.effect}:{f.where}") not in effects:
            effects.append(entry)
        if f.settings:
            places = model.setdefault("nominal", {}).setdefault("settings", {})
            places[f.where] = places.get(f.where, {}) | f.settings


def _redirect(data: dict[str, Any], old: Path, new: Path) -> None:
    """Make relative paths, which lead from the folder `old`, lead from `new` to the same files."""
    # The real folders: ".." of a link to a folder is not where the link stands.
    folder = os.path.realpath(new)

    def redirected(path: str) -> str:
        if os.path.isabs(path):
            return path
        return Path(os.path.relpath(os.path.realpath(old / path), folder)).as_posix()

    for table, keys in PATHS:
        _change(data, table, keys, redirected)
    if modules := data.get("plugins", {}).get("modules"):
        data["plugins"]["modules"] = [redirected(m) if is_plugin_file(m) else m for m in modules]


def _change(
    data: Any, table: Sequence[str], keys: Sequence[str], changed: Callable[[str], str]
) -> None:
    """Replace the values of `keys` in the table reached by the names `table`, where it exists."""
    if isinstance(data, list):
        for member in data:
            _change(member, table, keys, changed)
    elif table:
        if table[0] in data:
            _change(data[table[0]], table[1:], keys, changed)
    else:
        data.update({key: changed(data[key]) for key in keys if key in data})
