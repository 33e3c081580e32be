"""Studies: many independent tasks, each result of which is kept as it comes.

    study = read_study("experiment_design/coverage", options=["replicates=200"])
    run_study(study, "look", jobs=4)  # of elastocal.study_runs
    frame = read_results("look")

A study's folder holds `study.py` (what to compute) and `study.toml` (seed, options, columns).  What
a worker needs of it travels as `Sources`; their hash, the seed and the task's values say
whether a result on disk is of this very task.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib
import json
import math
import shutil
import sys
import tempfile
import threading
import time
import tomllib
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from itertools import islice
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
from pydantic import Field

from elastocal import __version__
from elastocal.config import Table, checked, read_toml
from elastocal.errors import InputError, option, require
from elastocal.files import atomic_write_text, read_bytes, read_json, read_text
from elastocal.screen import shown
from elastocal.text import did_you_mean, listed, quoted

if TYPE_CHECKING:
    import pandas

MAX_TASKS = 200_000  # each is kept in memory, and has a row or more in the results
RESERVED = ("task", "task_hash", "task_row", "task_seconds", "elastocal", "task_error")
TAKEN = f"{', '.join(RESERVED)} are columns of every study"
MOST_OF_A_FILE = 1_000_000_000  # of a file that study.toml names: a table, at most
# What a column takes, by its unit in study.toml; every other unit is that of a number.
KINDS: dict[str, tuple[type, str]] = {
    "yes/no": (bool, "true or false"), "count": (int, "a whole number"), "text": (str, "text"),
}  # fmt: skip
ASKED_FOR = {**dict(KINDS.values()), float: "a number"}  # how a type is asked for

Row = dict[str, Any]
_LOCK = threading.Lock()
_here: tuple[str, Path, ModuleType] | None = None  # digest, folder and study.py of what is loaded


@dataclass(frozen=True)
class Sources:
    """The .py files of a study's folder and the files that study.toml names, by their names.

    Sent to each worker: one that has the same folder with the same contents uses it there, any
    other unpacks this one, so a cluster needs no shared file system.  `columns` maps each column
    of the results to its unit, or to `text`, `yes/no` or `count`, which are types.
    """

    folder: Path
    contents: Mapping[str, bytes]
    columns: Mapping[str, str]
    version: str = __version__

    @cached_property
    def digests(self) -> dict[str, str]:
        return {name: hashlib.sha256(data).hexdigest() for name, data in self.contents.items()}

    @cached_property
    def digest(self) -> str:
        lines = [f"{name} {value}" for name, value in sorted(self.digests.items())]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


@dataclass(frozen=True)
class StudyTask:
    """One task: its place in the study, its values as JSON text, and what makes it the same."""

    index: int
    text: str
    seed: int
    hash: str

    def line(self) -> Row:
        return {
            "task": self.index, "task_hash": self.hash, "values": json.loads(self.text),
            "rows": [], "task_seconds": 0.0, "elastocal": __version__, "task_error": None,
        }  # fmt: skip

    def rng(self) -> np.random.Generator:
        """Child `index` of SeedSequence(seed), whoever computes it and however many there are."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(self.index,)))


@dataclass(frozen=True)
class Study:
    """A study ready to run, with seed and options settled and its tasks in their order."""

    folder: Path
    title: str
    seed: int
    options: Mapping[str, Any]
    sources: Sources
    module: ModuleType
    tasks: tuple[StudyTask, ...]


class StudyFile(Table):
    title: str = Field("", description="text")
    seed: Annotated[int, Field(ge=0)] = Field(description="a whole number from 0")
    files: list[str] = Field([], description='a list of names, as in files = ["cell.toml"]')
    options: dict[str, Any] = Field({}, description="a table: write [options]")
    columns: Annotated[dict[str, str], Field(min_length=1)] = Field(
        description='the unit of what run() returns, as in rms_um = "µm" ("" for none, or text, '
        "yes/no, count)",
    )


def read_study(folder: str | Path, seed: int | None = None, options: Iterable[str] = ()) -> Study:
    """Returns the study in `folder`, with another seed, and options as KEY=VALUE, where given.

    Raises InputError where the folder, study.toml, study.py, an option or a task is wrong.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"{folder}: no such folder; name the folder of a study")
    for name, what in (("study.py", "tasks() and run()"), ("study.toml", "seed and columns")):
        told = f"{folder}: holds no {name}; a study has one, with its {what}"
        require((folder / name).is_file(), told)
    path = folder / "study.toml"
    stated = checked(StudyFile, read_toml(path, "study file", 1_000_000), path)
    for name in stated.columns:
        require(name not in RESERVED, f"{path}: columns.{name} cannot be a column; {TAKEN}")
    chosen = _with_options(path, stated.options, options)
    for key, value in chosen.items():
        _json(f"{path}: key options.{quoted(key)} cannot be recorded", value)
    sources = Sources(folder.resolve(), _contents(folder.resolve(), stated, path), stated.columns)
    seed = stated.seed if seed is None else seed
    module = load(sources)
    tasks = tuple(_tasks(folder, module, chosen, sources, seed))
    return Study(
        folder, stated.title or folder.resolve().name, seed, chosen, sources, module, tasks
    )


def _contents(folder: Path, stated: StudyFile, path: Path) -> dict[str, bytes]:
    """The files of the study as its folder stands now, without hidden folders and caches."""
    for name in stated.files:
        named = f"{path}: key files names {quoted(name)}"
        inside = not PurePosixPath(name).is_absolute() and ".." not in PurePosixPath(name).parts
        told = "outside the folder; a cluster cannot reach it, copy it into the folder"
        require(inside, f"{named}, {told}")
        require((folder / name).is_file(), f"{named}, which is no file of the folder")
    names = {path.relative_to(folder) for path in folder.rglob("*.py")}
    hidden = {n for n in names if any(p.startswith(".") or p == "__pycache__" for p in n.parts)}
    parts = sorted({n.as_posix() for n in names - hidden} | set(stated.files))
    return {name: read_bytes(folder / name, "file of a study", MOST_OF_A_FILE) for name in parts}


def _with_options(path: Path, defaults: Mapping[str, Any], given: Iterable[str]) -> dict[str, Any]:
    """The defaults, with KEY=VALUE in their place; a value is of its default's type."""
    options = dict(defaults)
    for text in given:
        key, equals, written = (part.strip() for part in text.partition("="))
        here = option("options", text)
        require(bool(equals), f"{option('options')} takes KEY=VALUE; found {quoted(text)}")
        require(
            key in options,
            f"{here}: {path} has no option {quoted(key)}{did_you_mean(key, options)}; "
            f"it has {listed(options) or 'none'}",
        )
        default, value = defaults[key], None
        with suppress(tomllib.TOMLDecodeError):
            value = tomllib.loads(f"value = {written}")["value"]
        if isinstance(default, str) and not written.startswith(('"', "'")):
            value = written
        if type(default) is float and type(value) is int:
            value = float(value)
        kind = ASKED_FOR.get(type(default), f"a TOML value like {quoted(default)}")
        require(type(value) is type(default), f"{here}: takes {kind}, as in study.toml")
        options[key] = value
    return options


def _tasks(
    folder: Path, module: ModuleType, options: Mapping[str, Any], sources: Sources, seed: int
) -> Iterator[StudyTask]:
    script = folder / "study.py"
    for name in ("tasks", "run"):
        told = f"defines no function {name}(); a study has tasks(options) and run(task, rng)"
        require(callable(getattr(module, name, None)), f"{script}: {told}")
    found = calling(
        folder, "tasks()", lambda: list(islice(module.tasks(dict(options)), MAX_TASKS + 1))
    )
    require(bool(found), f"{script}: tasks() gives no task with these options; nothing to do")
    told = f"tasks() gives more than {MAX_TASKS} tasks with these options; let each do more"
    require(len(found) <= MAX_TASKS, f"{script}: {told}")
    for index, task in enumerate(found):
        where = f"{script}, task {index}"
        if not isinstance(task, Mapping):
            kind = type(task).__name__
            raise InputError(f"{where}: is a {kind}; tasks() gives a dict for each task")
        for key in task:
            require(
                isinstance(key, str) and key not in RESERVED,
                f"{where}: {quoted(key)} cannot be a key; keys are text, and {TAKEN}",
            )
            told = f"study.toml: columns.{key} is also a value of the tasks; rename one of them"
            require(key not in sources.columns, told)
        text = _json(where, dict(task))
        whole = f"{sources.digest}\n{seed}\n{index}\n{json.dumps(json.loads(text), sort_keys=True)}"
        yield StudyTask(index, text, seed, hashlib.sha256(whole.encode()).hexdigest())


def _json(where: str, value: Any) -> str:
    """`value` as JSON text; raises InputError where it has no such form."""
    try:
        return json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        told = "finite numbers, text, true/false, lists and tables of them"
        raise InputError(f"{where}: {error}; use plain JSON values: {told}") from None


def load(sources: Sources) -> ModuleType:
    """Returns the module study.py, imported once per process as long as no other study comes.

    Raises InputError with file and line where importing it fails.
    """
    global _here
    with _LOCK:
        if _here is None or _here[0] != sources.digest:
            if _here is not None:
                _forget(_here[1])
            folder = _standing(sources)
            sys.path.insert(0, str(folder))
            name = f"elastocal_study_{sources.digest[:16]}"
            loader = SourceFileLoader(name, str(folder / "study.py"))
            module = module_from_spec(cast(ModuleSpec, spec_from_loader(name, loader)))
            sys.modules[name] = module  # dataclasses and pickle look a class's module up there
            _here = sources.digest, folder, module
            # No bytecode in the user's folder: it would be left, half written, by a kill.
            before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
            try:
                calling(folder, "importing study.py", lambda: loader.exec_module(module))
            finally:
                sys.dont_write_bytecode = before
        return _here[2]


def _standing(sources: Sources) -> Path:
    """The study's folder where it stands here with these very contents, else a copy of it."""
    with suppress(OSError):
        if all((sources.folder / n).read_bytes() == d for n, d in sources.contents.items()):
            return sources.folder
    folder = Path(tempfile.mkdtemp(prefix="elastocal-study-")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, data in sources.contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def _forget(folder: Path) -> None:
    """Drop what an earlier study imported: a worker outlives it; two may have a scenarios.py."""
    for name, module in list(sys.modules.items()):
        if Path(getattr(module, "__file__", None) or "/").is_relative_to(folder):
            del sys.modules[name]
    sys.path[:] = [place for place in sys.path if place != str(folder)]
    importlib.invalidate_caches()


def calling(folder: Path, what: str, call: Callable[[], Any]) -> Any:
    """Returns the value of `call`, which is code of the study in `folder`."""
    try:
        return call()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        file, line = str(folder.resolve() / "study.py"), 1
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if Path(f.filename).is_relative_to(folder.resolve())]
        if isinstance(error, SyntaxError) and error.filename:
            file, line = error.filename, error.lineno or 1
        elif own:
            file, line = own[-1].filename, own[-1].lineno or 1
        raise InputError(
            f"{file}, line {line}: {what} raised {type(error).__name__}: {error}; correct it there"
        ) from error


def execute(sources: Sources, task: StudyTask) -> Row:
    """Returns the line of results that came of the task, whatever its code raises.

    Of a task that failed it has the `trace` (the traceback) beside `task_error`.
    """
    line = task.line()
    begun = time.perf_counter()
    try:
        if sources.version != __version__:
            raise RuntimeError(
                f"this worker has elastocal {__version__}, the study was started with "
                f"{sources.version}; install the same there"
            )
        found = load(sources).run(json.loads(task.text), task.rng())
        line["rows"] = _checked_rows(found, sources.columns, line["values"])
    except (Exception, SystemExit) as caught:
        line["task_error"] = f"{type(caught).__name__}: {caught}"
        line["trace"] = traceback.format_exc()
    line["task_seconds"] = time.perf_counter() - begun
    return line


def _checked_rows(found: Any, columns: Mapping[str, str], task: Row) -> list[Row]:
    """What run() returned, as rows of plain values of the types that `columns` states."""
    rows = [found] if isinstance(found, Mapping) else found
    if not isinstance(rows, list | tuple) or not all(isinstance(row, Mapping) for row in rows):
        told = f"run() returned {type(found).__name__}; it returns a dict or a list of them"
        raise TypeError(told)
    for name in (name for row in rows for name in row):
        if name in task:
            raise ValueError(f"run() returned {name!r}, which is a value of the task itself")
        if name not in columns:
            raise ValueError(
                f"run() returned {name!r}{did_you_mean(str(name), columns)}, which [columns] "
                f"of study.toml does not list (there are {listed(columns)})"
            )
    return [{n: _plain(n, row.get(n), unit) for n, unit in columns.items()} for row in rows]


def _plain(name: str, value: Any, unit: str) -> Any:
    """`value` after the column's unit, as JSON can hold it: NaN as None, infinity as its name."""
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        value = value.item()
    if value is None:
        return None
    kind, takes = KINDS.get(unit, (float, "a number"))
    if type(value) is int and kind is float:
        value = float(value)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"column {name!r} takes {takes}; found {type(value).__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


# The results on disk: JSON lines, one for each task that ended, written by one process.
#
# A line is written when its task ends and says all of it: whatever stops a run leaves whole lines
# and at most the beginning of one, which the next run takes away.

MAX_BYTES = 100_000_000  # of the record
MOST_RESULTS = 10_000_000_000  # bytes
SCHEMA = "elastocal/study/1"
RESULTS, STATEMENT, FAILURES, LOCK = "results.jsonl", "_study.json", "_failures.log", ".lock"
PAGE = "result.md"
OURS = {RESULTS, STATEMENT, FAILURES, PAGE, "_written.txt"}  # the last was kept by earlier versions


@contextmanager
def opened(folder: Path) -> Iterator[None]:
    """The results in `folder`, made where absent, with no other process writing to it."""
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
    ours = OURS if statement_of(folder).get("schema") == SCHEMA else set()
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
        yield


def add_line(folder: Path, line: Row) -> None:
    """Write the line of a task that ended; its traceback goes to the log."""
    if trace := line.pop("trace", None):
        with open(folder / FAILURES, "a", encoding="utf-8") as log:
            log.write(shown(f"task {line['task']} {json.dumps(line['values'])}\n{trace}\n"))
    with open(folder / RESULTS, "a", encoding="utf-8") as handle:
        handle.write(as_text(line))


def as_text(line: Row) -> str:
    return json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n"


def result_lines(folder: Path) -> list[Row]:
    """Returns all whole lines in the order of their tasks: a killed run may leave the beginning of
    one.
    """
    path, found = folder / RESULTS, dict[int, Row]()
    text = read_text(path, "results", MOST_RESULTS) if path.exists() else ""
    for number, written in enumerate(text.split("\n")[:-1], 1):
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


def write_statement(folder: Path, study: Study) -> None:
    statement = {
        "schema": SCHEMA, "title": study.title, "seed": study.seed,
        "options": dict(study.options), "tasks": len(study.tasks),
        "columns": dict(study.sources.columns), "sources": study.sources.digests,
        "elastocal": __version__,
    }  # fmt: skip
    text = json.dumps(statement, indent=1, ensure_ascii=False, allow_nan=False)
    atomic_write_text(folder / STATEMENT, text + "\n")


def statement_of(folder: Path) -> dict[str, Any]:
    """Returns what `write_statement` wrote; empty where there is none."""
    try:
        found = read_json(folder / STATEMENT, "record", MAX_BYTES, "remove it")
    except InputError:
        return {}
    return found if isinstance(found, dict) else {}


def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """Returns the rows of a study, sorted by task and row; failed tasks only where `failed`.

    Columns: task, task_hash, the task's values, task_row, the results, task_seconds,
    elastocal (version), task_error.
    Raises InputError where there are none, or a result is there twice.
    """
    import pandas as pd

    found, columns = result_lines(Path(folder)), statement_of(Path(folder)).get("columns", {})
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
