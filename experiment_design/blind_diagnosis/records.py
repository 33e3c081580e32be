"""Results as JSON lines: a file per suite, a line per world, appended as they come."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Record = dict[str, Any]
CANDIDATES = 10
KEPT = (
    "verdict", "p_value", "probability_nothing", "probability_unknown", "gap", "effects",
    "indistinguishable", "location", "noise", "extra_plan", "warnings",
)  # fmt: skip


def append(folder: Path, record: Record) -> None:
    """Add a line to the record's suite."""
    path = _path(folder, record["suite"])
    with open(path, "a", encoding="utf-8") as handle:
        handle.write(json.dumps(record) + "\n")


def read(folder: Path, suite: str) -> list[Record]:
    """The suite's records; a last line that an interruption left unfinished is cut off the file."""
    path = _path(folder, suite)
    if not path.exists():
        return []
    whole, newline, rest = path.read_text(encoding="utf-8").rpartition("\n")
    if rest:
        path.write_text(whole + newline, encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]


def shortened(diagnosis: Mapping[str, Any]) -> Record:
    """The part of a diagnosis that is kept: without curves, tests and hopeless candidates."""
    kept = {key: diagnosis[key] for key in KEPT}
    kept["candidates"] = diagnosis["candidates"][:CANDIDATES]
    return kept


def _path(folder: Path, suite: str) -> Path:
    return folder / f"{suite}.jsonl"
