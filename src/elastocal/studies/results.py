"""The results of a study on disk: JSON lines, one for each task that ended, written by one process.

A line is written when its task ends and says all of it: whatever stops a run leaves whole lines and
at most the beginning of one, which the next run takes away.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal.errors import InputError, option, require
from elastocal.files import atomic_write_text, read_bytes, read_json, read_text
from elastocal.screen import shown
from elastocal.studies.study import KINDS, Row, Study

if TYPE_CHECKING:
    import pandas

MAX_BYTES = 100_000_000  # of the record
MOST_RESULTS = 10_000_000_000  # bytes
SCHEMA = "elastocal/study/1"
RESULTS, STATEMENT, FAILURES, LOCK = "results.jsonl", "_study.json", "_failures.log", ".lock"
WRITTEN = "_written.txt"  # digests of the pages that the study wrote
OURS = {RESULTS, STATEMENT, FAILURES, WRITTEN}


@contextmanager
def opened(folder: Path) -> Iterator[None]:
    """The results in `folder`, made where absent, with no other process writing to it.

    Raises InputError where the folder cannot be made, holds something else, or another run has
    it.  What a killed run left half-written is removed.
    """
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
    ours = OURS if stated(folder).get("schema") == SCHEMA else set()
    visible = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    foreign = ", ".join(sorted(visible - ours)[:3])
    told = f"{folder}: holds {foreign}, which no study wrote; name a folder of its own"
    require(not foreign, told)
    with open(folder / LOCK, "a", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"{folder}: another run of the study is writing there; wait for it, or name "
                f"another folder with {option('output', 'NEW')}"
            ) from None
        drop(folder)
        yield


def add(folder: Path, line: Row, version: str) -> None:
    """Write the line of a task that ended, made by `version`; its traceback goes to the log."""
    if trace := line.pop("trace", None):
        with open(folder / FAILURES, "a", encoding="utf-8") as log:
            log.write(shown(f"task {line['task']} {json.dumps(line['values'])}\n{trace}\n"))
    text = json.dumps(line | {"elastocal": version}, ensure_ascii=False, allow_nan=False)
    with open(folder / RESULTS, "a", encoding="utf-8") as handle:
        handle.write(text + "\n")


def drop(folder: Path, failed: bool = False) -> None:
    """Take away the beginning of a line that a killed run left, and `failed` tasks' lines."""
    if not (folder / RESULTS).exists():
        return
    text = read_text(folder / RESULTS, "results", MOST_RESULTS)
    kept = [line for line in text.split("\n")[:-1]
            if not failed or json.loads(line)["task_error"] is None]  # fmt: skip
    if (whole := "".join(f"{line}\n" for line in kept)) != text:
        atomic_write_text(folder / RESULTS, whole)


def clear(folder: Path) -> None:
    for name in (RESULTS, STATEMENT, FAILURES):
        (folder / name).unlink(missing_ok=True)


def lines(folder: Path) -> list[Row]:
    """Returns all lines in the order of their tasks.

    Raises InputError where one is damaged, or a task has more than one.
    """
    path, found = folder / RESULTS, dict[int, Row]()
    text = read_text(path, "results", MOST_RESULTS) if path.exists() else ""
    for number, written in enumerate(text.split("\n"), 1):
        if not written:
            continue
        here = f"{path}, line {number}"
        try:
            line = json.loads(written)
            index = int(line["task"])
        except (ValueError, KeyError, TypeError) as error:
            told = f"{here}: is damaged ({error}); delete it, and its task runs again"
            raise InputError(told) from None
        require(
            index not in found,
            f"{here}: task {index} has more than one result; results of two runs were put "
            f"together: remove one, or run with {option('restart', True)}",
        )
        found[index] = line
    return [found[index] for index in sorted(found)]


def state(folder: Path, study: Study, version: str) -> None:
    """Write down what the results are of: seed, options, hashes of the sources."""
    statement = {
        "schema": SCHEMA, "title": study.title, "seed": study.seed,
        "options": dict(study.options), "tasks": len(study.tasks),
        "columns": dict(study.sources.columns), "sources": study.sources.digests,
        "elastocal": version,
    }  # fmt: skip
    text = json.dumps(statement, indent=1, ensure_ascii=False, allow_nan=False)
    atomic_write_text(folder / STATEMENT, text + "\n")


def stated(folder: Path) -> dict[str, Any]:
    """Returns what `state` wrote; empty where there is none."""
    try:
        found = read_json(folder / STATEMENT, "record", MAX_BYTES, "remove it")
    except InputError:
        return {}
    return found if isinstance(found, dict) else {}


def check_page(folder: Path, page: Path) -> None:
    """Raise InputError where `page` is there and not as a summary of the study wrote it."""
    if not page.exists():
        return
    digest = hashlib.sha256(read_bytes(page, "page", MAX_BYTES)).hexdigest()
    ledger = folder / WRITTEN
    require(
        ledger.exists() and digest in read_text(ledger, "record", MAX_BYTES).split(),
        f"{page}: would be written over, and is not as the study left it; move it "
        f"elsewhere, or name another folder with {option('output', 'NEW')}",
    )


def write_page(folder: Path, page: Path, text: str) -> None:
    """Write the summary, and remember it: no other page is written over."""
    with open(folder / WRITTEN, "a", encoding="utf-8") as ledger:
        ledger.write(hashlib.sha256(text.encode()).hexdigest() + "\n")
    atomic_write_text(page, text)


def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """Returns the rows of a study, sorted by task and row; failed tasks only where `failed`.

    Columns: task, task_hash, the task's values, task_row, the results, task_seconds,
    elastocal (version), task_error.
    Raises InputError where there are none, or a result is there twice.
    """
    import pandas as pd

    found, columns = lines(Path(folder)), stated(Path(folder)).get("columns", {})
    require(bool(found), f"{folder}: holds no results; run elastocal study first")
    values = list(dict.fromkeys(name for line in found for name in line["values"]))
    names = ["task", "task_hash", *values, "task_row", *columns, "task_seconds", "elastocal"]
    rows = [
        line | line["values"] | row
        for line in found
        if (line["task_error"] is not None) == failed
        for row in ([{}] if failed else [{"task_row": k} | r for k, r in enumerate(line["rows"])])
    ]
    frame = pd.DataFrame(rows, columns=[*names, "task_error"])
    numbers = [name for name, unit in columns.items() if unit not in KINDS]
    return frame.astype(dict.fromkeys(numbers, "float64"))
