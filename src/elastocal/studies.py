"""Studies: many independent tasks, each result of which is kept as it comes.

A study's folder holds `study.py` (what to compute) and `study.toml` (seed, options, columns).  What
a worker needs of it travels as `Sources`; their hash, the seed and the task's values say whether a
result on disk is of this very task.  Only the process that the user started writes, a line of JSON
when a task ends: however a run ends, whole lines are left and at most the beginning of one, which
the next run takes away and goes on from there.
"""

from __future__ import annotations

import atexit
import gc
import hashlib
import importlib
import json
import logging
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
import tomllib
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from contextlib import closing, contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property, partial
from ipaddress import ip_address
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from elastocal import __version__, messages
from elastocal.above import checked_arguments, whole
from elastocal.config import Table, checked, read_toml
from elastocal.files import atomic_write, read_bytes, read_record, read_text
from elastocal.messages import ElastocalError, InputError, listed, option, quoted, require
from elastocal.screen import StudyStop, shown

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
Lines = Generator[Row, None, None]
_LOCK = threading.Lock()
_here: tuple[str, Path] | None = None  # digest and folder of the study that is loaded


class StudyFile(Table):
    title: str = Field("", description="text")
    seed: Annotated[int, Field(ge=0)] = Field(description="a whole number from 0")
    files: list[str] = Field([], description='a list of names, as in files = ["cell.toml"]')
    options: dict[str, Any] = Field({}, description="a table: write [options]")
    columns: Annotated[dict[str, str], Field(min_length=1)] = Field(
        description='the unit of what run() returns, as in rms_um = "µm" ("" for none, or text, '
        "yes/no, count)"
    )


@dataclass(frozen=True)
class Sources:
    """The .py files of a study's folder and the files that study.toml names, and what it states,
    with options and seed settled.  A worker that has the same folder with the same contents uses it
    there, any other unpacks this one, so a cluster needs no shared file system."""

    folder: Path
    contents: Mapping[str, bytes]
    stated: StudyFile
    version: str = __version__

    @cached_property
    def digests(self) -> dict[str, str]:
        return {name: hashlib.sha256(data).hexdigest() for name, data in self.contents.items()}

    @cached_property
    def digest(self) -> str:
        return _hash(*map(" ".join, sorted(self.digests.items())))


@dataclass(frozen=True)
class Study:
    """A study ready to run, with its tasks in their order: what their lines of results begin with
    (`task`, `task_hash`, `values`)."""

    folder: Path
    sources: Sources
    tasks: tuple[Row, ...]


@checked_arguments
def read_study(folder: str | Path, seed: int | None = None, options: Sequence[str] = ()) -> Study:
    """The study in `folder`, with another seed, and options as KEY=VALUE, where given."""
    folder = Path(folder)
    require(folder.is_dir(), f"{folder}: no such folder; name the folder of a study")
    for name, what in (("study.py", "tasks() and run()"), ("study.toml", "seed and columns")):
        told = f"{folder}: holds no {name}; a study has one, with its {what}"
        require((folder / name).is_file(), told)
    path, home = folder / "study.toml", folder.resolve()
    stated = checked(StudyFile, read_toml(path, "study file"), path)
    for name in stated.columns:
        require(name not in RESERVED, f"{path}: columns.{name} cannot be a column; {TAKEN}")
    chosen = _with_options(path, stated.options, options)
    for key, value in chosen.items():
        _json(f"{path}: key options.{quoted(key)} cannot be recorded", value)
    settled: dict[str, Any] = {"title": stated.title or home.name, "options": chosen}
    settled |= {} if seed is None else {"seed": seed}
    sources = Sources(home, _contents(home, stated, path), stated.model_copy(update=settled))
    return Study(folder, sources, tuple(_tasks(folder, load(sources), sources)))


def _contents(folder: Path, stated: StudyFile, path: Path) -> dict[str, bytes]:
    for name in stated.files:
        named = f"{path}: key files names {quoted(name)}"
        inside = (folder / name).resolve().is_relative_to(folder)
        told = "outside the folder; a cluster cannot reach it, copy it into the folder"
        require(inside, f"{named}, {told}")
        require((folder / name).is_file(), f"{named}, which is no file of the folder")
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py")}
    shown = {name for name in names if not re.search(r"(^|/)(\.|__pycache__)", name)}
    parts = sorted(shown | set(stated.files))
    return {name: read_bytes(folder / name, "file of a study", MOST_OF_A_FILE) for name in parts}


def _with_options(path: Path, defaults: Mapping[str, Any], given: Sequence[str]) -> dict[str, Any]:
    options = dict(defaults)
    for text in given:
        key, equals, written = (part.strip() for part in text.partition("="))
        here = option("options", text)
        require(equals, f"{option('options')} takes KEY=VALUE; found {quoted(text)}")
        messages.check_known(key, options, f"{here}: {path} has no option {quoted(key)}", "it has")
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


def _tasks(folder: Path, module: ModuleType, sources: Sources) -> Iterator[Row]:
    script, stated = folder / "study.py", sources.stated
    for name in ("tasks", "run"):
        told = f"defines no function {name}(); a study has tasks(options) and run(task, rng)"
        require(callable(getattr(module, name, None)), f"{script}: {told}")
    given = dict(stated.options)
    # Each as it comes: a dict may be yielded again and again, with other values.
    each = partial(map, deepcopy)
    found = calling(folder, "tasks()", lambda: [*islice(each(module.tasks(given)), MAX_TASKS + 1)])
    require(found, f"{script}: tasks() gives no task with these options; nothing to do")
    told = f"tasks() gives more than {MAX_TASKS} tasks with these options; let each do more"
    require(len(found) <= MAX_TASKS, f"{script}: {told}")
    for index, task in enumerate(found):
        where, kind = f"{script}, task {index}", type(task).__name__
        told = f"{where}: is a {kind}; tasks() gives a dict for each task"
        require(isinstance(task, Mapping), told)
        for key in task:
            told = f"{where}: {quoted(key)} cannot be a key; keys are text, and {TAKEN}"
            require(isinstance(key, str) and key not in RESERVED, told)
            told = f"{folder}/study.toml: columns.{key} is also a value of the tasks; rename one"
            require(key not in stated.columns, told)
        values = json.loads(_json(where, dict(task)))
        told = _task_hash(sources.digest, stated.seed, index, values)
        yield {"task": index, "task_hash": told, "values": values}


def _hash(*parts: object) -> str:
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()


def _task_hash(digest: str, seed: int, index: int, values: Row) -> str:
    return _hash(digest, seed, index, json.dumps(values, sort_keys=True))


def _json(where: str, value: Any) -> bytes:
    try:
        return json.dumps(value, allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError) as error:
        told = "finite numbers, text, true/false, lists and tables of them"
        raise InputError(f"{where}: {error}; use plain JSON values: {told}") from None


def load(sources: Sources) -> ModuleType:
    """The module study.py, imported once per process as long as no other study comes."""
    global _here
    with _LOCK:
        if _here is None or _here[0] != sources.digest:
            if _here is not None:
                # A worker outlives a study, and two may have a scenarios.py.
                for name, module in list(sys.modules.items()):
                    if Path(getattr(module, "__file__", None) or "/").is_relative_to(_here[1]):
                        del sys.modules[name]
                sys.path[:] = [place for place in sys.path if place != str(_here[1])]
                importlib.invalidate_caches()
            sys.modules.pop("study", None)  # of that name somebody else's
            _here = sources.digest, _standing(sources)
            sys.path.insert(0, str(_here[1]))
        # Nothing is left in the user's folder: no bytecode of its modules.
        before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            importing = partial(importlib.import_module, "study")
            found: ModuleType = calling(_here[1], "importing study.py", importing)
        finally:
            sys.dont_write_bytecode = before
        return found


def _standing(sources: Sources) -> Path:
    with suppress(OSError):
        if all((sources.folder / n).read_bytes() == d for n, d in sources.contents.items()):
            return sources.folder
    folder = Path(tempfile.mkdtemp(prefix="elastocal-study-")).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, data in sources.contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def calling(folder: Path, what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        own, nowhere = folder.resolve(), (folder.resolve() / "study.py", 1)
        file, line = messages.raised_at(error, lambda f: Path(f).is_relative_to(own)) or nowhere
        raise InputError(
            f"{file}, line {line}: {what} raised {type(error).__name__}: {error}; correct it there"
        ) from error


def line_of(task: Row, error: str | None = None, **found: Any) -> Row:
    """The line of results of a task; of one that failed with its `trace`."""
    line = {"rows": [], "task_seconds": 0.0, "elastocal": __version__, "task_error": error}
    return task | line | {"trace": error} | found


def execute(sources: Sources, task: Row) -> Row:
    """The line of results of a task, whose draws are those of child `task` of SeedSequence(seed),
    whoever computes it and however many there are."""
    begun = time.perf_counter()
    draws = np.random.SeedSequence(sources.stated.seed, spawn_key=(task["task"],))
    try:
        if sources.version != __version__:
            told = f"this worker has elastocal {__version__}, the study was started with"
            raise RuntimeError(f"{told} {sources.version}; install the same there")
        found = load(sources).run(deepcopy(task["values"]), np.random.default_rng(draws))
        line = line_of(task, rows=_checked_rows(found, sources.stated.columns, task["values"]))
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        told = messages.printable(" ".join([f"{type(error).__name__}:", *str(error).split()]))
        line = line_of(task, told, trace=traceback.format_exc())
    return line | {"task_seconds": time.perf_counter() - begun}


def _checked_rows(found: Any, columns: Mapping[str, str], task: Row) -> list[Row]:
    rows = [found] if isinstance(found, Mapping) else found
    if not isinstance(rows, list | tuple) or not all(isinstance(row, Mapping) for row in rows):
        told = f"run() returned {type(found).__name__}; it returns a dict or a list of them"
        raise TypeError(told)
    for name in (name for row in rows for name in row):
        if name in task:
            raise ValueError(f"run() returned {name!r}, which is a value of the task itself")
        if name not in columns:
            told = f"which [columns] of study.toml does not list (there are {listed(columns)})"
            hint = messages.did_you_mean(str(name), columns)
            raise ValueError(f"run() returned {name!r}{hint}, {told}")
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
    if kind is str:
        _json(f"column {name!r}", value)  # no half of a letter, as in a file's name
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"column {name!r} takes {takes}; found {type(value).__name__}")
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


MOST_RESULTS = 10_000_000_000  # bytes
SCHEMA = "elastocal/study/1"
RESULTS, STATEMENT, FAILURES, LOCK = "results.jsonl", "_study.json", "_failures.log", ".lock"
PAGE = "result.md"
OURS = {RESULTS, STATEMENT, FAILURES, PAGE, "_written.txt"}  # the last by earlier versions


@contextmanager
def opened(folder: Path) -> Iterator[None]:
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); name another") from None
    ours = OURS if read_record(folder / STATEMENT).get("schema") == SCHEMA else set()
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
    if trace := line.pop("trace", None):
        with open(folder / FAILURES, "a", encoding="utf-8") as log:
            told = f"task {line['task']} {json.dumps(line['values'])}\n{trace.rstrip()}\n\n"
            log.write(shown(told))
    with open(folder / RESULTS, "a", encoding="utf-8") as handle:
        handle.write(as_text(line))


def as_text(line: Row) -> str:
    return json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n"


def result_lines(folder: Path) -> list[Row]:
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
        if index in found:
            told = f"{here}: task {index} has more than one result; results of two runs were put"
            raise InputError(f"{told} together: remove one, or run with {option('restart', True)}")
        found[index] = line
    return [found[index] for index in sorted(found)]


@checked_arguments
def read_results(folder: str | Path, failed: bool = False) -> pandas.DataFrame:
    """The rows of a study, sorted by task and row; failed tasks only where `failed`.  Columns:
    task, task_hash, the task's values, task_row, the results, task_seconds, elastocal (version),
    task_error.  Raises InputError where there are none, or a result is there twice."""
    import pandas as pd

    found, stated = result_lines(Path(folder)), read_record(Path(folder) / STATEMENT)
    columns = stated.get("columns", {})
    require(found, f"{folder}: holds no results; run elastocal study first")
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


ANSWER = 10.0  # s in which a scheduler answers
MOST_PEM_BYTES = 1_000_000
TRIES = 3  # of a task whose process dies
DIED = "its worker process died {} times (out of memory, killed, or crashed in a library)"
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # in each process
IGNORING = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)  # of workers: Ctrl-C is for us


class ClusterLostError(ElastocalError):
    """The scheduler went away; what was done is kept."""

    exit_code = 1


def on_processes(study: Study, tasks: Sequence[Row], stop: StudyStop, jobs: int | None) -> Lines:
    """By default one per core; where one alone is asked for it is this process, for a debugger."""
    from joblib.externals import loky

    jobs = loky.cpu_count() if jobs in (None, -1) else jobs
    if jobs == 1:
        yield from (execute(study.sources, task) for task in tasks if not stop.asked)
        return
    env = {name: os.environ.get(name, "1") for name in ONE_THREAD}
    # Of a pool that is started anew where a process died.
    pool = partial(loky.get_reusable_executor, min(jobs, len(tasks)), initializer=IGNORING, env=env)
    try:
        yield from _lines(study, tasks, stop, lambda *call: pool().submit(*call), lambda: jobs)
    finally:
        if tasks:
            pool().shutdown(kill_workers=True)


def on_cluster(
    study: Study, tasks: Sequence[Row], stop: StudyStop, client: Any, tell: Callable[[str], None]
) -> Lines:
    """No task waits at a worker: what is out is what is waited for on Ctrl-C."""

    def room() -> int:
        # Without a limit a scheduler that goes away while it is asked is waited for for ever.
        threads = sum(client.nthreads(callback_timeout=6 * ANSWER).values())
        if not threads:
            tell("the cluster has no worker; waiting for one")
        return max(threads, 1)

    try:  # no call may answer for another one, so none is pure
        yield from _lines(study, tasks, stop, client.get_executor(pure=False).submit, room)
    except (CancelledError, OSError):
        raise ClusterLostError(
            f"the scheduler at {client.scheduler.address} went away or cancelled the tasks; "
            "what was done is kept, and the same command goes on with the rest"
        ) from None
    finally:
        client.close()


def _lines(
    study: Study, tasks: Sequence[Row], stop: StudyStop, submit: Callable[..., Future[Row]],
    room: Callable[[], int],
) -> Lines:  # fmt: skip
    """None twice; no task begins once `stop` is asked for.  Where a process dies joblib ends them
    all: what ran is repeated, one task after the other, so that it is known whose process dies each
    time.  Dask gives the tasks of a dead worker to another, and gives up a task that killed more
    than distributed.scheduler.allowed-failures."""
    waiting, out, died = deque(tasks), dict[Future[Row], Row](), Counter[int]()
    while out or (waiting and not stop.asked):
        # Those that were out when a process died wait in front.
        most = 0 if stop.asked or not waiting else 1 if died[waiting[0]["task"]] else room()
        while waiting and len(out) < most:
            task = waiting.popleft()
            out[submit(execute, study.sources, task)] = task
        for future in wait(out, return_when=FIRST_COMPLETED).done:
            task = out.pop(future)
            try:
                yield future.result()
            except BrokenExecutor:
                died[task["task"]] += 1
                if died[task["task"]] < TRIES:
                    waiting.appendleft(task)
                else:
                    yield line_of(task, DIED.format(TRIES))
            except (CancelledError, OSError):
                raise
            except Exception as error:  # execute() returns what a task raises
                deaths = getattr(error, "allowed_failures", None)  # as a KilledWorker has
                told = f"the worker could not run it: {type(error).__name__}: {error}"
                yield line_of(task, told if deaths is None else DIED.format(deaths + 1))


def _security(
    distributed: Any, address: str, unencrypted: bool = False, **files: Path | None
) -> Any:
    """With the `files` tls_ca, tls_cert and tls_key (PEM) or those of Dask's configuration.  Tasks
    and results are pickles, so another host is reached by TLS only, unless `unencrypted`."""
    keys = {"tls_ca": "tls_ca_file", "tls_cert": "tls_client_cert", "tls_key": "tls_client_key"}
    given = {}
    for name, path in files.items():
        if path is not None:
            read_bytes(path, f"file of {option(name)}", MOST_PEM_BYTES)
            given[keys[name]] = str(path)
    scheme, _, rest = address.rpartition("://")
    host = rest.rsplit(":", 1)[0].strip("[]")
    here = scheme == "inproc" or host == "localhost"
    with suppress(ValueError):  # a name, which may lead anywhere
        here = here or ip_address(host).is_loopback
    require(
        here or unencrypted or scheme in ("tls", "wss"),
        f"{option('cluster', address)}: leads beyond this host and is not encrypted, so "
        "whoever stands between could run code on both; use tls:// with "
        f"{option('tls_ca')}, {option('tls_cert')} and {option('tls_key')}, a tunnel to this "
        f"host, or allow it with {option('unencrypted', True)}",
    )
    return distributed.Security(**given)


def connect(address: str, **way: Any) -> Any:
    try:
        import dask
        import distributed
    except ImportError:
        told = f"{option('cluster', 'ADDRESS')} needs dask.distributed; run: pip install"
        raise InputError(f"{told} 'elastocal[cluster]'") from None
    where = dask.config.get("scheduler-address", None) if address == "config" else address
    require(
        where is not None,
        f"{option('cluster', 'config')}: Dask's configuration names no scheduler; set "
        "DASK_SCHEDULER_ADDRESS or scheduler-address, or give "
        f"{option('cluster', 'tcp://HOST:8786')}",
    )
    security = _security(distributed, str(where), **way)
    # Its log lines tell of dead workers with tracebacks; what matters is told by the study.
    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return distributed.Client(where, timeout=ANSWER, set_as_default=False, security=security)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        told = f"no scheduler answers ({error}); check the address, or start one here: dask"
    # What did not connect closes as it is collected: while another client starts, for whose lock it
    # would wait for ever.
    gc.collect()
    raise InputError(f"{option('cluster', where)}: {told} scheduler --host 127.0.0.1")


@dataclass(frozen=True)
class Ending:
    """Of `total` tasks (those asked for), `done` have a result and `failed` an error."""

    total: int
    before: int
    done: int
    failed: int
    stopped: bool

    @property
    def complete(self) -> bool:
        return self.done + self.failed == self.total


@checked_arguments
def run_study(
    study: Study, output: str | Path, *, jobs: int | None = None, cluster: str | None = None,
    only: int | None = None, restart: bool = False, retry_failed: bool = False,
    stop: StudyStop | None = None, progress: Callable[[int, int, int], None] = lambda *told: None,
    tell: Callable[[str], None] = print, tls_ca: Path | None = None, tls_cert: Path | None = None,
    tls_key: Path | None = None, unencrypted: bool = False,
) -> Ending:  # fmt: skip
    """Run the tasks that have no result yet (of the first `only`) and record what comes.  They run
    in `jobs` processes (by default, and for -1, one per core), or on the Dask scheduler at
    `cluster`.  `restart` discards the results in the folder `output`, `retry_failed` those that are
    errors, also where study.py was corrected since; `progress` takes the number of tasks, of those
    that ended and of those that failed.  Raises InputError where the results are of another study,
    or the cluster cannot be reached; ClusterLostError where the scheduler goes away."""
    folder, stop = Path(output), stop or StudyStop()
    way = {"tls_ca": tls_ca, "tls_cert": tls_cert, "tls_key": tls_key, "unencrypted": unencrypted}
    for name, count in (("jobs", None if jobs == -1 else jobs), ("only", only)):
        if count is not None:
            whole(name, count)
    with opened(folder):
        known, earlier = ([], []) if restart else _known(study, folder, retry_failed)
        kept = [line for line in known if not (retry_failed and line["task_error"])]
        there = {line["task"]: line["task_error"] is not None for line in kept}
        wanted = study.tasks[:only]
        left = [task for task in wanted if task["task"] not in there]
        runner = partial(on_processes, study, left, stop, jobs)
        if cluster is not None and left:
            # Before results are discarded: one that cannot be reached must not cost them.
            runner = partial(on_cluster, study, left, stop, connect(cluster, **way), tell)
        for name in OURS if restart else ():
            (folder / name).unlink(missing_ok=True)
        if left:  # without the beginning of a line
            atomic_write(folder / RESULTS, "".join(map(as_text, kept)))
        stated = study.sources.stated
        statement = {
            "schema": SCHEMA, "title": stated.title, "seed": stated.seed,
            "options": stated.options, "tasks": len(study.tasks), "columns": stated.columns,
            "sources": study.sources.digests, "elastocal": __version__,
        } | ({"earlier": earlier} if earlier else {})  # fmt: skip
        atomic_write(folder / STATEMENT, messages.json_text(statement) + "\n")
        total, before = len(wanted), len(wanted) - len(left)
        ended, failed = before, sum(there.get(task["task"], False) for task in wanted)
        progress(total, ended, failed)
        try:
            with closing(runner()) as lines:
                for line in lines:
                    stop.check()
                    add_line(folder, line)
                    failed += line["task_error"] is not None
                    ended += 1
                    progress(total, ended, failed)
        except KeyboardInterrupt:
            if not stop.asked:
                raise
    return Ending(total, before, ended - failed, failed, stop.asked)


def _known(study: Study, folder: Path, retry_failed: bool) -> tuple[list[Row], list[str]]:
    """The lines of results there are, and the digests of earlier sources that made some of them."""
    here = f"Run with {option('restart', True)} to discard them, or with {option('output', 'NEW')}"
    before, columns = read_record(folder / STATEMENT), study.sources.stated.columns
    told = f"{folder}: has other columns, types or units than the study now. {here}"
    require(before.get("columns", columns) == columns, told)
    lines, seed = result_lines(folder), study.sources.stated.seed
    failed = any(line["task_error"] for line in lines)
    earlier = list(before.get("earlier", []))
    if retry_failed and failed:
        earlier.append(_hash(*map(" ".join, sorted(before.get("sources", {}).items()))))
    for line in lines:
        at = line["task"]
        if at >= len(study.tasks) or study.tasks[at]["task_hash"] == line["task_hash"]:
            continue
        values = study.tasks[at]["values"]
        if line["task_hash"] not in [_task_hash(d, seed, at, values) for d in earlier]:
            changes = _changes(study, before) or [f"task {at} was another one"]
            told = f"{folder}: holds results of another study: {'; '.join(changes)}"
            retry = f", with {option('retry_failed', True)} to run tasks anew that failed"
            raise InputError(f"{told}. {here} to keep them{retry * failed}")
    return lines, sorted({*earlier} - {study.sources.digest})


def _changes(now: Study, before: dict[str, Any]) -> list[str]:
    stated, digests = now.sources.stated, now.sources.digests
    sources, options = before.get("sources", {}), before.get("options", {})
    changed = [n for n in sorted({*sources, *digests}) if sources.get(n) != digests.get(n)]
    told = [f"{', '.join(changed)} changed since"] if sources and changed else []
    both = {"the seed": (before.get("seed", stated.seed), stated.seed)}
    both |= {f"option {n}": (options.get(n, v), v) for n, v in stated.options.items()}
    was = (f"{name} was {quoted(old)}, now it is {quoted(new)}" for name, (old, new) in both.items()
           if old != new)  # fmt: skip
    return [*told, *was]


def summarise(study: Study, output: str | Path, page: str | Path) -> str | None:
    """What summary(frame) of study.py says of the rows in the order of their tasks, also written to
    `page`; None without one."""
    if (summary := getattr(load(study.sources), "summary", None)) is None:
        return None
    frame = read_results(output)
    frame = frame[frame["task"] < len(study.tasks)]
    text = calling(study.folder, "summary()", lambda: summary(frame))
    if not isinstance(text, str):
        kind = type(text).__name__
        raise InputError(f"{study.folder / 'study.py'}: summary() returned {kind}; it returns text")
    lines = map(messages.printable, text.rstrip("\n").split("\n"))
    atomic_write(page, "\n".join(lines).replace("\\t", "\t") + "\n")
    return text
