"""Columns and types of the results: the same in every part, known before the first task runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError, require
from elastocal.studies.execution import Outcome
from elastocal.studies.job import RESERVED, Job

if TYPE_CHECKING:
    import pyarrow


def arrow() -> ModuleType:
    """pyarrow with its Parquet part.

    Raises InputError where it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            "the results of a study are a Parquet dataset, which needs pyarrow; "
            "run: pip install 'elastocal[parquet]'"
        ) from None
    module: ModuleType = pyarrow
    return module


class Table:
    """Rows of outcomes as Arrow tables of one schema.

    One line per row that a task returned; a task that returned none, or failed, has one line
    whose `task_row` is null.  Units stand in the fields' metadata.
    """

    def __init__(self, jobs: Sequence[Job], columns: Mapping[str, str], version: str) -> None:
        pa = arrow()
        for name in columns:
            require(
                name not in RESERVED,
                f"study.toml: columns.{name} cannot be a column; {', '.join(RESERVED)} are "
                "columns of every study",
            )
        self.jobs, self.columns, self.version = jobs, columns, version
        tasks = [job.task for job in jobs]
        names = dict.fromkeys(name for task in tasks for name in task)
        self._task_kind = {n: _kind(task.get(n) for task in tasks) for n in names}
        for name in names:
            require(
                name not in columns,
                f"study.toml: columns.{name} is also a value of the tasks; rename one of them",
            )
        types = {
            "yes/no": pa.bool_(), "count": pa.int64(), "text": pa.string(), "": pa.float64(),
            "json": pa.string(),
        }  # fmt: skip
        fields = [pa.field("task", pa.int64()), pa.field("task_hash", pa.string())]
        fields += [
            pa.field(name, types[kind], metadata={"json": "1"} if kind == "json" else None)
            for name, kind in self._task_kind.items()
        ]
        fields.append(pa.field("task_row", pa.int64()))
        fields += [
            pa.field(name, types.get(unit, pa.float64()), metadata={"unit": unit})
            for name, unit in columns.items()
        ]
        fields += [
            pa.field("task_seconds", pa.float64(), metadata={"unit": "s"}),
            pa.field("elastocal", pa.string()),
            pa.field("task_error", pa.string()),
        ]
        self.schema: pyarrow.Schema = pa.schema(fields)

    def of(self, outcomes: Iterable[Outcome]) -> pyarrow.Table:
        """The lines of these outcomes."""
        lines = [line for outcome in outcomes for line in self._lines(outcome)]
        table: pyarrow.Table = arrow().Table.from_pylist(lines, schema=self.schema)
        return table

    def _lines(self, outcome: Outcome) -> Iterable[dict[str, Any]]:
        job = self.jobs[outcome.index]
        task = job.task
        common: dict[str, Any] = {"task": job.index, "task_hash": job.hash}
        for name, kind in self._task_kind.items():
            value = task.get(name)
            text = json.dumps(value, sort_keys=True, allow_nan=False) if kind == "json" else value
            common[name] = text
        common |= {
            "task_seconds": outcome.seconds, "elastocal": self.version, "task_error": outcome.error
        }  # fmt: skip
        if not outcome.rows:
            yield common | {"task_row": None}
        for k, row in enumerate(outcome.rows):
            yield common | {"task_row": k} | row


def _kind(values: Iterable[Any]) -> str:
    """The type that all values of a task's key share; `json` where they share none."""
    kinds = {type(value) for value in values}
    if kinds <= {bool}:
        return "yes/no"
    if kinds <= {int}:
        return "count"
    if kinds <= {str}:
        return "text"
    return "" if kinds <= {int, float} else "json"
