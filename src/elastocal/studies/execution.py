"""One task carried out, in whatever process: rows, or what went wrong."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from elastocal import __version__
from elastocal.studies.job import Job
from elastocal.studies.package import Package, load
from elastocal.text import did_you_mean, listed

Row = dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """What became of a task: its rows, or `error` (one line) and `trace` (the traceback)."""

    index: int
    rows: tuple[Row, ...] = ()
    seconds: float = 0.0
    error: str | None = None
    trace: str = ""


def execute(package: Package, digest: str, job: Job) -> Outcome:
    """Run the task; whatever its code raises becomes an outcome, and the study goes on."""
    begun = time.perf_counter()
    try:
        if package.version != __version__:
            raise RuntimeError(
                f"this worker has elastocal {__version__}, the study was started with "
                f"{package.version}; install the same there"
            )
        found = load(package, digest).run(job.task, job.rng())
        rows = checked_rows(found, package.columns, job.task)
    except (Exception, SystemExit) as error:
        line = f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - begun
        return Outcome(job.index, (), seconds, line, traceback.format_exc())
    return Outcome(job.index, rows, time.perf_counter() - begun)


def checked_rows(found: Any, columns: Mapping[str, str], task: Row) -> tuple[Row, ...]:
    """What run() returned, as rows of plain values of the types that `columns` states.

    Raises TypeError or ValueError that names the column.
    """
    rows = [found] if isinstance(found, Mapping) else found
    if not isinstance(rows, list | tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise TypeError(
            f"run() returned {type(found).__name__}; it returns a dict or a list of them"
        )
    for row in rows:
        for name in row:
            if name in task:
                raise ValueError(f"run() returned {name!r}, which is a value of the task itself")
            if name not in columns:
                raise ValueError(
                    f"run() returned {name!r}{did_you_mean(str(name), columns)}, which [columns] "
                    f"of study.toml does not list (there are {listed(columns)})"
                )
    return tuple(
        {name: _plain(name, row.get(name), unit) for name, unit in columns.items()} for row in rows
    )


def _plain(name: str, value: Any, unit: str) -> Any:
    """`value` as bool, int, float or str after the column's unit; None stays None."""
    if value is None:
        return None
    is_bool = isinstance(value, bool | np.bool_)
    if unit == "yes/no" and is_bool:
        return bool(value)
    if unit == "count" and not is_bool and isinstance(value, int | np.integer):
        return int(value)
    if unit == "text" and isinstance(value, str):
        return str(value)
    if unit not in ("yes/no", "count", "text") and not is_bool:
        if isinstance(value, np.ndarray) and value.ndim == 0:
            value = value.item()
        if isinstance(value, int | float | np.integer | np.floating):
            return float(value)
    kind = {"yes/no": "true or false", "count": "a whole number", "text": "text"}
    raise TypeError(
        f"column {name!r} takes {kind.get(unit, 'a number')}; found {type(value).__name__}"
    )
