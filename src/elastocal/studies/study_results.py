"""The results of a study on disk: a folder of Parquet parts, written by one process.

Columns and types are known before the first task runs and the same in every part; what is read
is checked, so that no task counts twice.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Self

from elastocal.errors import InputError, option, require
from elastocal.files import (
    atomic_binary_writer,
    atomic_write_text,
    read_bytes,
    read_json,
    read_text,
    remove_abandoned,
)
from elastocal.screen import shown
from elastocal.studies.study_folder import Outcome, Study

if TYPE_CHECKING:
    import pandas
    import pyarrow

# Names with a leading underscore or dot are no parts to those who read the folder as a dataset.
MAX_BYTES = 100_000_000  # of the record
SCHEMA = "elastocal/study/1"
STATEMENT, FAILURES, LOCK = "_study.json", "_failures.log", ".lock"
WRITTEN = "_written.txt"  # names of the parts and digests of the page that the study wrote
SOONEST, LATEST = 5.0, 60.0  # s between parts; a long run writes fewer, or there are thousands


def arrow() -> ModuleType:
    """Returns pyarrow with its Parquet part.

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


def schema_of(study: Study) -> pyarrow.Schema:
    """Returns the columns of the study's results: the tasks' values and what run() returns.

    Units stand in the fields' metadata; values of no common type are JSON text.
    """
    pa = arrow()
    types = {"yes/no": pa.bool_(), "count": pa.int64(), "text": pa.string()}

    def field(name: str, kind: str, **metadata: str) -> Any:
        return pa.field(name, types.get(kind, pa.float64()), metadata=metadata or None)

    values = [task.values for task in study.tasks]
    kinds = {
        name: _kind(task.get(name) for task in values)
        for name in dict.fromkeys(name for task in values for name in task)
    }
    fields = [field("task", "count"), field("task_hash", "text")]
    fields += [
        field(name, "text", json="1") if kind == "json" else field(name, kind)
        for name, kind in kinds.items()
    ]
    fields.append(field("task_row", "count"))
    fields += [field(name, unit, unit=unit) for name, unit in study.sources.columns.items()]
    fields += [field("task_seconds", "", unit="s"), field("elastocal", "text")]
    return pa.schema([*fields, field("task_error", "text")])


def _kind(values: Iterable[Any]) -> str:
    """The type that all values of a task's key share; `json` where they share none."""
    kinds = {type(value) for value in values}
    shared = ({bool}, "yes/no"), ({int}, "count"), ({str}, "text"), ({int, float}, "")
    return next((kind for types, kind in shared if kinds <= types), "json")


def _is_json(field: pyarrow.Field) -> bool:
    return b"json" in (field.metadata or {})


class StudyResults:
    """Parts of a study's results; use it in `with opened(folder)`, which locks the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def parts(self) -> list[Path]:
        """Returns the files of the results."""
        return sorted(self.folder.glob("part-*.parquet"))

    def new_part(self) -> Path:
        """Returns the path of the part that comes next."""
        numbers = [path.stem.partition("-")[2] for path in self.parts()]
        number = max((int(number) for number in numbers if number.isdigit()), default=0) + 1
        return self.folder / f"part-{number:06d}.parquet"

    def note(self, written: str) -> None:
        """Remember what is about to be written: nothing else is removed or replaced."""
        if written not in self.noted():
            with open(self.folder / WRITTEN, "a", encoding="utf-8") as ledger:
                ledger.write(f"{written}\n")

    def noted(self) -> list[str]:
        """Returns what `note` was told."""
        try:
            return read_text(self.folder / WRITTEN, "record", MAX_BYTES).split()
        except InputError:
            return []

    def write(self, path: Path, lines: pyarrow.Table) -> None:
        """Write the part `path` (again), whole or not at all."""
        self.note(path.name)
        with atomic_binary_writer(path) as handle:
            arrow().parquet.write_table(lines, handle, compression="zstd")

    def read(self, study: Study | None = None) -> pyarrow.Table | None:
        """Returns all lines, or None where there is no part yet.

        Raises InputError where a part is damaged, has other columns than `study` (or than the
        first part), or two lines are the same row of the same task.
        """
        pa, tables = arrow(), []
        schema = None if study is None else schema_of(study)
        for path in self.parts():
            try:
                table = pa.parquet.ParquetFile(path).read()
            except (pa.ArrowException, OSError) as error:
                raise InputError(
                    f"{path}: damaged Parquet file ({error}); delete it, and its tasks run again"
                ) from None
            schema = table.schema if schema is None else schema
            require(
                table.schema.equals(schema, check_metadata=True),
                f"{path}: has other columns, types or units than the study now; "
                f"run with {option('restart', True)}, or with {option('output', 'NEW')}",
            )
            tables.append(table)
        if not tables:
            return None
        lines = pa.concat_tables(tables)
        frame = lines.select(["task", "task_hash", "task_row"]).to_pandas()
        twice = frame.duplicated(["task", "task_row"])
        hashes = frame.groupby("task")["task_hash"].nunique()
        alone = frame["task_row"].isna() & frame["task"].duplicated(keep=False)
        wrong = set(frame.loc[twice | alone, "task"]) | set(hashes.index[hashes > 1])
        require(
            not wrong,
            f"{self.folder}: task {min(wrong, default=0)} has more than one result; parts of two "
            f"runs were put together: remove those of one, or run with {option('restart', True)}",
        )
        return lines

    def drop_failed(self) -> None:
        """Remove the lines of failed tasks, part by part."""
        pa = arrow()
        for path in self.parts():
            table = pa.parquet.ParquetFile(path).read()
            good = table.filter(table["task_error"].is_null())
            if not good.num_rows:
                path.unlink()
            elif good.num_rows < table.num_rows:
                self.write(path, good)

    def clear(self) -> None:
        """Remove all results; InputError where there are parts that the study did not write."""
        noted = self.noted()
        foreign = [path.name for path in self.parts() if path.name not in noted]
        require(
            not foreign,
            f"{self.folder}: holds {', '.join(foreign[:3])}, which the study did not write; move "
            f"it elsewhere, or name another folder with {option('output', 'NEW')}",
        )
        for path in [*self.parts(), self.folder / STATEMENT, self.folder / FAILURES]:
            path.unlink(missing_ok=True)

    def check_page(self, page: Path) -> None:
        """Raise InputError where `page` is there and not as a summary of the study wrote it."""
        if page.exists():
            digest = hashlib.sha256(read_bytes(page, "page", MAX_BYTES)).hexdigest()
            require(
                digest in self.noted(),
                f"{page}: would be written over, and is not as the study left it; move it "
                f"elsewhere, or name another folder with {option('output', 'NEW')}",
            )

    def write_page(self, page: Path, text: str) -> None:
        """Write the summary."""
        self.note(hashlib.sha256(text.encode()).hexdigest())
        atomic_write_text(page, text)

    def state(self, study: Study, version: str) -> None:
        """Write down what the results are of: seed, options, hashes of the sources."""
        statement = {
            "schema": SCHEMA,
            "title": study.title,
            "seed": study.seed,
            "options": dict(study.options),
            "tasks": len(study.tasks),
            "columns": dict(study.sources.columns),
            "sources": study.sources.digests,
            "elastocal": version,
        }
        text = json.dumps(statement, indent=1, ensure_ascii=False, allow_nan=False)
        atomic_write_text(self.folder / STATEMENT, text + "\n")

    def stated(self) -> dict[str, Any]:
        """Returns what `state` wrote; empty where there is none."""
        try:
            found = read_json(self.folder / STATEMENT, "record", MAX_BYTES, "remove it")
        except InputError:
            return {}
        return found if isinstance(found, dict) else {}


class Recorder:
    """Collects outcomes in a `with` block and writes them; at its end all of them are written.

    One line per row that a task returned; a task that returned none, or failed, has one line
    whose `task_row` is null.  A thread writes too, so that a result is kept although the next one
    takes an hour.  Whatever interrupts a write, the same batch is written again under the same
    name, so nothing is lost and nothing is there twice.
    """

    def __init__(
        self, results: StudyResults, study: Study, version: str, soonest: float = SOONEST
    ) -> None:
        self._results, self._tasks, self._version = results, study.tasks, version
        self._schema, self._soonest = schema_of(study), soonest
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._failure: BaseException | None = None
        # The open part and what goes into it.  One attribute: an interrupt that fell between a
        # new part and a new list would write the batch twice.
        self._open: tuple[Path, list[Outcome]] = (results.new_part(), [])

    def add(self, outcome: Outcome) -> None:
        """Take an outcome; raises what an earlier write of the thread raised."""
        if self._failure is not None:
            raise self._failure
        with self._lock:
            self._open[1].append(outcome)

    def flush(self) -> None:
        """Write what is open."""
        with self._lock:
            part, outcomes = self._open
            if not outcomes:
                return
            for outcome in outcomes:
                if outcome.error is not None:
                    task = self._tasks[outcome.index].text
                    with open(self._results.folder / FAILURES, "a", encoding="utf-8") as log:
                        log.write(shown(f"task {outcome.index} {task}\n{outcome.trace}\n"))
            lines = [line for outcome in outcomes for line in self._lines(outcome)]
            self._results.write(part, arrow().Table.from_pylist(lines, schema=self._schema))
            self._open = (self._results.new_part(), [])

    def _lines(self, outcome: Outcome) -> Iterator[dict[str, Any]]:
        task = self._tasks[outcome.index]
        values = task.values
        common: dict[str, Any] = values | {
            "task": task.index, "task_hash": task.hash, "task_row": None,
            "task_seconds": outcome.seconds, "elastocal": self._version,
            "task_error": outcome.error,
        }  # fmt: skip
        for field in filter(_is_json, self._schema):
            value = values.get(field.name)
            common[field.name] = json.dumps(value, sort_keys=True, allow_nan=False)
        yield from (common | {"task_row": k} | row for k, row in enumerate(outcome.rows))
        if not outcome.rows:
            yield common

    def _now_and_then(self) -> None:
        begun, wait = time.monotonic(), self._soonest
        try:
            while not self._done.wait(wait):
                self.flush()
                wait = max(self._soonest, min((time.monotonic() - begun) / 50, LATEST))
        except BaseException as error:
            self._failure = error

    def __enter__(self) -> Self:
        threading.Thread(target=self._now_and_then, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self.flush()


@contextmanager
def opened(folder: Path) -> Iterator[StudyResults]:
    """The results in `folder`, made where absent, with no other process writing to it.

    Raises InputError where the folder cannot be made, holds something else, or another run has
    it.  What a killed run left half-written is removed.
    """
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
    results = StudyResults(folder)
    ours = results.stated().get("schema") == SCHEMA
    visible = [p.name for p in sorted(folder.iterdir()) if not p.name.startswith(".")]
    foreign = [
        name
        for name in visible
        if not (
            ours
            and (name.startswith("_") or (name.startswith("part-") and name.endswith(".parquet")))
        )
    ]
    require(
        not foreign,
        f"{folder}: holds {', '.join(foreign[:3])}, which no study wrote; name a folder of its own",
    )
    with open(folder / LOCK, "a", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"{folder}: another run of the study is writing there; wait for it, or name "
                f"another folder with {option('output', 'NEW')}"
            ) from None
        remove_abandoned(folder, r"part-.*")
        yield results


def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """Returns the rows of a study, sorted by task and row; failed tasks only where `failed`.

    Columns: task, task_hash, the task's values, task_row, the results, task_seconds,
    elastocal (version), task_error.
    Raises InputError where there are none, or a result is there twice.
    """
    lines = StudyResults(Path(folder)).read()
    if lines is None:
        raise InputError(f"{folder}: holds no results; run elastocal study first")
    frame = lines.to_pandas()
    for field in filter(_is_json, lines.schema):
        frame[field.name] = frame[field.name].map(json.loads)
    wanted = frame["task_error"].notna() if failed else frame["task_row"].notna()
    frame = frame[wanted].sort_values(["task", "task_row"], ignore_index=True)
    return frame if failed else frame.astype({"task_row": "int64"})
