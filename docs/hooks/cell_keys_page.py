"""Every key of the cell file as a page, from the classes that a cell is made of."""

from __future__ import annotations

from typing import Any

from elastocal.cell import Cell
from elastocal.config import keys_of, tables_in

HEAD = """# Keys of the cell file

Every key that a cell file may have, and what it takes. This page is made from the schema that reads
the file when the site is built; an unknown key is refused with the nearest valid one. A whole cell,
with what the keys mean, stands in [File formats](../file-formats.md).
"""


def page() -> str:
    """The page, a table of keys for each table of the file."""
    parts = [HEAD]
    for title, table in tables():
        parts += [f"## `{title}`\n", "| key | takes |", "|---|---|"]
        for key in keys_of(table):
            required = " (required)" if key.required else ""
            takes = key.takes.replace("|", "\\|").replace("…]]", f"{title[1:-1]}.{key.name}]]")
            parts.append(f"| `{key.name}`{required} | {takes} |")
        parts.append("")
    return "\n".join(parts)


def tables() -> list[tuple[str, Any]]:
    """Each table of the file as it is headed there, with its schema; the file itself first."""
    return [("cell.toml", Cell), *_inside(Cell, "")]


def _inside(table: Any, above: str) -> list[tuple[str, Any]]:
    found = []
    for key in keys_of(table):
        for inner, many in tables_in(key.kind):
            path = f"{above}{key.name}"
            found.append((f"[[{path}]]" if many else f"[{path}]", inner))
            found += _inside(inner, f"{path}.")
    return found
