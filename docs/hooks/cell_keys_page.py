"""Every key of the cell file as a page, from the classes that a cell is made of."""

from __future__ import annotations

from pydantic import BaseModel

from elastocal.cell.work_cell import Cell
from elastocal.config import table_of, tables_in

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
        for name, field in table.model_fields.items():
            required = " (required)" if field.is_required() else ""
            description = (field.description or "").replace("|", "\\|")
            parts.append(f"| `{name}`{required} | {description} |")
        parts.append("")
    return "\n".join(parts)


def tables() -> list[tuple[str, type[BaseModel]]]:
    """Each table of the file as it is headed there, with its schema; the file itself first."""
    return [("cell.toml", table_of(Cell)), *_inside(table_of(Cell), "")]


def _inside(table: type[BaseModel], above: str) -> list[tuple[str, type[BaseModel]]]:
    found = []
    for name, field in table.model_fields.items():
        for inner, many in tables_in(field.annotation):
            path = f"{above}{name}"
            found.append((f"[[{path}]]" if many else f"[{path}]", inner))
            found += _inside(inner, f"{path}.")
    return found
