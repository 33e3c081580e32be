"""The results of a study on disk: JSON lines, one for each task that ended, written by one process.

A line is written when its task ends and says all of it: whatever stops a run leaves whole lines and
at most the beginning of one, which the next run takes away.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError, option, require
from elastocal.files import atomic_write_text, read_bytes, read_json, read_text
from elastocal.screen import shown
from elastocal.studies.study_folder import KINDS, Row, Study

if TYPE_CHECKING:
    import pandas

MAX_BYTES = 100_000_000  # of the record
MOST_RESULTS = 10_000_000_000  # bytes
SCHEMA = "elastocal/study/1"
RESULTS, STATEMENT, FAILURES, LOCK = "results.jsonl", "_study.json", "_failures.log", ".lock"
WRITTEN = "_written.txt"  # digests of the pages that the study wrote
OURS = {RESULTS, STATEMENT, FAILURES, WRITTEN}


class StudyResults:
    """The lines of a study's results; use it in `with opened(folder)`, which locks the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / RESULTS

    def add(self, line: Row, version: str) -> None:
        """Write the line of a task that ended, made by `version`; its traceback goes to the log."""
        if trace := line.pop("trace", None):
            with open(self.folder / FAILURES, "a", encoding="utf-8") as log:
                log.write(shown(f"task {line['task']} {json.dumps(line['values'])}\n{trace}\n"))
        text = json.dumps(line | {"elastocal": version}, ensure_ascii=False, allow_nan=False)
        with open(self.path, "a", encoding="utf-8") as handle:
            handle.write(text + "\n")

    def lines(self) -> list[Row]:
        """Returns all lines in the order of their tasks.

        Raises InputError where one is damaged, or a task has more than one.
        """
        if not self.path.exists():
            return []
        found: dict[int, Row] = {}
        for number, text in enumerate(read_text(self.path, "results", MOST_RESULTS).split("\n"), 1):
            if not text:
                continue
            try:
                line = json.loads(text)
                index = int(line["task"])
            except (ValueError, KeyError, TypeError) as error:
                raise InputError(
                    f"{self.path}, line {number}: is damaged ({error}); delete it, and its task "
                    "runs again"
                ) from None
            require(
                index not in found,
                f"{self.path}, line {number}: task {index} has more than one result; results of "
                f"two runs were put together: remove one, or run with {option('restart', True)}",
            )
            found[index] = line
        return [found[index] for index in sorted(found)]

    def drop(self, failed: bool = False) -> None:
        """Take away the beginning of a line that a killed run left, and `failed` tasks' lines."""
        if not self.path.exists():
            return
        text = read_text(self.path, "results", MOST_RESULTS)
        kept = [line for line in text.split("\n")[:-1]
                if not failed or json.loads(line)["task_error"] is None]  # fmt: skip
        if (whole := "".join(f"{line}\n" for line in kept)) != text:
            atomic_write_text(self.path, whole)

    def clear(self) -> None:
        """Remove all results."""
        for name in (RESULTS, STATEMENT, FAILURES):
            (self.folder / name).unlink(missing_ok=True)

    def check_page(self, page: Path) -> None:
        """Raise InputError where `page` is there and not as a summary of the study wrote it."""
        if not page.exists():
            return
        digest = hashlib.sha256(read_bytes(page, "page", MAX_BYTES)).hexdigest()
        ledger = self.folder / WRITTEN
        require(
            ledger.exists() and digest in read_text(ledger, "record", MAX_BYTES).split(),
            f"{page}: would be written over, and is not as the study left it; move it "
            f"elsewhere, or name another folder with {option('output', 'NEW')}",
        )

    def write_page(self, page: Path, text: str) -> None:
        """Write the summary, and remember it: no other page is written over."""
        with open(self.folder / WRITTEN, "a", encoding="utf-8") as ledger:
            ledger.write(hashlib.sha256(text.encode()).hexdigest() + "\n")
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
    ours = OURS if results.stated().get("schema") == SCHEMA else set()
    visible = [p.name for p in sorted(folder.iterdir()) if not p.name.startswith(".")]
    foreign = [name for name in visible if name not in ours]
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
        results.drop()
        yield results


def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """Returns the rows of a study, sorted by task and row; failed tasks only where `failed`.

    Columns: task, task_hash, the task's values, task_row, the results, task_seconds,
    elastocal (version), task_error.
    Raises InputError where there are none, or a result is there twice.
    """
    import pandas as pd

    results = StudyResults(Path(folder))
    lines, columns = results.lines(), results.stated().get("columns", {})
    if not lines:
        raise InputError(f"{folder}: holds no results; run elastocal study first")
    values = list(dict.fromkeys(name for line in lines for name in line["values"]))
    names = ["task", "task_hash", *values, "task_row", *columns, "task_seconds", "elastocal"]
    wanted = [line for line in lines if (line["task_error"] is not None) == failed]
    rows = [row for line in wanted for row in _rows(line, failed)]
    frame = pd.DataFrame(rows, columns=[*names, "task_error"])
    numbers = [name for name, unit in columns.items() if unit not in KINDS]
    return frame.astype(dict.fromkeys(numbers, "float64"))


def _rows(line: Row, failed: bool) -> Iterable[Row]:
    common = {k: v for k, v in line.items() if k not in ("values", "rows")} | line["values"]
    if failed:
        return [common]
    return (common | {"task_row": k} | row for k, row in enumerate(line["rows"]))
