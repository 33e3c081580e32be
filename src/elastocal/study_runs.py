"""A study run: tasks on joblib's processes or a Dask cluster, recorded as they come, stopped.

Workers know nothing of what a task computes, and only the one process that the user started
writes.  However a run ends, what was done by then is kept, and the next one goes on from there.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from types import FrameType
from typing import Any, Self

from elastocal import studies
from elastocal.errors import ElastocalError, InputError, option, require
from elastocal.files import atomic_write_text, read_bytes
from elastocal.studies import Row, Study, StudyTask
from elastocal.text import printable, quoted

GRACE = 30.0  # s that running tasks are waited for
ANSWER = 10.0  # s in which a scheduler answers
MOST_PEM_BYTES = 1_000_000
# What limits threads of linear algebra: the processes share the cores.
THREADS = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS", "NUMEXPR_NUM_THREADS",
)  # fmt: skip

Lines = Generator[Row, None, None]


class StudyStop:
    """Ctrl-C and SIGTERM: in a `with` block, `asked` says that no more tasks may be handed out.

    A second signal, or `grace` seconds after the first, raises KeyboardInterrupt, and `check`
    raises it again: CasADi catches one inside a solver and returns where the search stood, and
    such a result must not be kept.
    """

    def __init__(self, grace: float = GRACE, tell: Callable[[str], None] | None = None) -> None:
        self.asked = self._now = False
        # In a signal handler the buffer of sys.stderr may be in use by what was interrupted.
        self._tell = tell or (lambda text: os.write(2, f"\nelastocal: {text}\n".encode()) and None)
        self._grace = grace
        self._before: dict[int, Any] = {}

    def check(self) -> None:
        """Raise KeyboardInterrupt where it came to that before."""
        if self._now:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # only it may set handlers
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
                if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        while self._before:
            signal.signal(*self._before.popitem())

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            self._now = True
            raise KeyboardInterrupt
        self.asked = True
        self._tell(
            f"stopping: the running tasks have {self._grace:.0f} s to end (Ctrl-C again: at once)"
        )
        signal.setitimer(signal.ITIMER_REAL, self._grace)


class Processes:
    """A process of joblib's for each task that is out, which takes one after the other."""

    tries = 3  # of a task whose process dies

    def __init__(self, number: int) -> None:
        from joblib import cpu_count

        self.places = number
        self._pools, self._free = list[Any](), list[Any]()
        threads = str(max(cpu_count() // number, 1))
        self._env = {name: os.environ.get(name, threads) for name in THREADS}

    def submit(self, *call: Any) -> Any:
        from joblib.externals.loky import ProcessPoolExecutor

        if not self._free:
            ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for us
            self._pools.append(ProcessPoolExecutor(1, initializer=ignore, env=self._env))
            self._free.append(self._pools[-1])
        pool = self._free.pop()
        future = pool.submit(*call)

        def ended(future: Any) -> None:
            if not future.cancelled() and future.exception() is None:  # the process lives
                self._free.append(pool)

        future.add_done_callback(ended)
        return future

    def deaths(self, error: Exception) -> int:
        return int(isinstance(error, BrokenProcessPool))

    def close(self, out: list[Any]) -> None:
        for pool in self._pools:
            pool.shutdown(kill_workers=bool(out))


class DaskWorkers:
    """The workers of a Dask cluster, which gives the tasks of a dead one to another, and gives up a
    task that killed more than the cluster allows (distributed.scheduler.allowed-failures)."""

    tries = 1

    def __init__(self, client: Any, tell: Callable[[str], None]) -> None:
        self._client, self._tell, self._told = client, tell, False

    @property
    def places(self) -> int:
        """The threads of all workers; raises ClusterLostError without a scheduler."""
        if self._client.status != "running":
            raise self._lost()
        threads = sum(self._client.nthreads().values())
        if not threads and not self._told:
            self._tell("the cluster has no worker; waiting for one")
        self._told = not threads
        return threads

    def submit(self, *call: Any) -> Any:
        return self._client.submit(*call, pure=False)  # no other call may answer for this one

    def deaths(self, error: Exception) -> int:
        if isinstance(error, CancelledError | OSError):
            raise self._lost() from None
        return int(getattr(error, "allowed_failures", -1)) + 1  # as a KilledWorker has

    def close(self, out: list[Any]) -> None:
        if out and self._client.status == "running":
            self._client.cancel(out, force=True)
        self._client.close()

    def _lost(self) -> ClusterLostError:
        return ClusterLostError(
            f"the scheduler at {self._client.scheduler.address} went away or cancelled the tasks; "
            "what was done is kept, and the same command goes on with the rest"
        )


class ClusterLostError(ElastocalError):
    """The scheduler went away; what was done is kept."""

    exit_code = 1


def hand_out(
    crew: Processes | DaskWorkers, study: Study, tasks: Sequence[StudyTask], stop: StudyStop
) -> Lines:
    """Lines of results as they come, none twice; none new begins once `stop` is asked for.

    No task waits at a worker: what is out is what is waited for on Ctrl-C.
    """
    waiting, out = deque(tasks), dict[Any, StudyTask]()
    ended, died = queue.SimpleQueue[Any](), Counter[int]()
    try:
        while out or (waiting and not stop.asked):
            while waiting and not stop.asked and len(out) < crew.places:
                task = waiting.popleft()
                future = crew.submit(studies.execute, study.sources, task)
                out[future] = task
                future.add_done_callback(ended.put)
            try:
                future = ended.get(timeout=1.0 if out else 0.1)
            except queue.Empty:
                continue
            task = out.pop(future)
            try:
                line = future.result()
            except Exception as error:  # execute() returns what a task raises
                deaths = crew.deaths(error)
                died[task.index] += deaths
                if deaths and died[task.index] < crew.tries:
                    waiting.appendleft(task)
                    continue
                told = f"the worker could not run it: {type(error).__name__}: {error}"
                if deaths:
                    told = (
                        f"its worker process died {died[task.index]} times (out of memory, killed, "
                        "or crashed in a library)"
                    )
                line = task.line() | {"task_error": told, "trace": f"{told}\n{error}\n"}
            yield line
    finally:
        crew.close(list(out))


def run_local(study: Study, tasks: Sequence[StudyTask], jobs: int | None, stop: StudyStop) -> Lines:
    """Runs tasks on the cores of this machine; with `jobs` of 1 in this process."""
    import joblib

    jobs = min(jobs or joblib.cpu_count(), len(tasks))
    if jobs > 1:
        yield from hand_out(Processes(jobs), study, tasks, stop)
        return
    for task in tasks:
        if stop.asked:
            return
        yield studies.execute(study.sources, task)


def _security(
    distributed: Any, address: str, unencrypted: bool = False, **files: Path | None
) -> Any:
    """Dask's Security for a client of `address`: with the `files` tls_ca, tls_cert and tls_key
    (PEM) or those of Dask's configuration.

    Whoever stands between could run code of their own here and there: tasks and results are
    pickles.  So another host is reached by TLS only, unless `unencrypted` allows it.
    """
    given = {name: path for name, path in files.items() if path is not None}
    for name, path in given.items():
        read_bytes(path, f"file of {option(name)}", MOST_PEM_BYTES)
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
    keys = {"tls_ca": "tls_ca_file", "tls_cert": "tls_client_cert", "tls_key": "tls_client_key"}
    return distributed.Security(**{keys[name]: str(path) for name, path in given.items()})


def connect(address: str, **way: Any) -> Any:
    """Returns a client of the scheduler at `address`, or in Dask's configuration ("config")."""
    try:
        import dask
        import distributed
    except ImportError:
        here = option("cluster", "ADDRESS")
        raise InputError(
            f"{here} needs dask.distributed; run: pip install 'elastocal[cluster]'"
        ) from None
    where = dask.config.get("scheduler-address", None) if address == "config" else address
    require(
        where is not None,
        f"{option('cluster', 'config')}: Dask's configuration names no scheduler; set "
        "DASK_SCHEDULER_ADDRESS or scheduler-address, or give "
        f"{option('cluster', 'tcp://HOST:8786')}",
    )
    here, security = option("cluster", where), _security(distributed, str(where), **way)
    # Its log lines tell of dead workers with tracebacks; what matters is told by the study.
    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return distributed.Client(where, timeout=ANSWER, set_as_default=False, security=security)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"{here}: no scheduler answers ({error}); check the address, or "
            "start one for this host alone: dask scheduler"
        ) from None


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


def run_study(
    study: Study,
    output: str | Path,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    only: int | None = None,
    restart: bool = False,
    retry_failed: bool = False,
    stop: StudyStop | None = None,
    progress: Callable[[int, int, int], None] = lambda total, ended, failed: None,
    tell: Callable[[str], None] = print,
    **way: Any,
) -> Ending:
    """Run the tasks that have no result yet (of the first `only`) and record what comes.

    They run in `jobs` processes (by default one per core), on the Dask scheduler at `cluster`,
    reached this `way` (tls_ca, tls_cert, tls_key, unencrypted).  `restart`
    discards the results in the folder `output`, `retry_failed` those that are errors; `progress`
    takes the number of tasks, of those that ended and of those that failed.  However the run ends,
    what was done is written.

    Raises InputError where the results in `output` are of another seed, source or task, or the
    cluster cannot be reached; ClusterLostError where the scheduler goes away.
    """
    folder, stop = Path(output), stop or StudyStop()
    with studies.opened(folder):
        known = [] if restart else _known(study, folder)
        kept = [line for line in known if not (retry_failed and line["task_error"])]
        there = {line["task"]: line["task_error"] is not None for line in kept}
        wanted = study.tasks[:only]
        left = [task for task in wanted if task.index not in there]
        runner = partial(run_local, study, left, jobs, stop)
        if cluster is not None and left:
            # Before results are discarded: one that cannot be reached must not cost them.
            crew = DaskWorkers(connect(cluster, **way), tell)
            runner = partial(hand_out, crew, study, left, stop)
        for name in (
            (studies.RESULTS, studies.STATEMENT, studies.FAILURES, studies.PAGE) if restart else ()
        ):
            (folder / name).unlink(missing_ok=True)
        if left:  # without the beginning of a line
            atomic_write_text(folder / studies.RESULTS, "".join(map(studies.as_text, kept)))
        studies.write_statement(folder, study)
        total, before = len(wanted), len(wanted) - len(left)
        ended, failed = before, sum(there.get(task.index, False) for task in wanted)
        progress(total, ended, failed)
        try:
            with closing(runner()) as lines:
                for line in lines:
                    stop.check()
                    studies.add_line(folder, line)
                    failed += line["task_error"] is not None
                    ended += 1
                    progress(total, ended, failed)
        except KeyboardInterrupt:
            if not stop.asked:
                raise
    return Ending(total, before, ended - failed, failed, stop.asked)


def _known(study: Study, folder: Path) -> list[Row]:
    """The lines that the results hold."""
    here = f"Run with {option('restart', True)} to discard them, or with {option('output', 'NEW')}"
    before, columns = studies.statement_of(folder), dict(study.sources.columns)
    require(
        before.get("columns", columns) == columns,
        f"{folder}: has other columns, types or units than the study now. {here}",
    )
    lines = studies.result_lines(folder)
    for line in lines:
        at = line["task"]
        if at < len(study.tasks) and study.tasks[at].hash != line["task_hash"]:
            changes = _changes(study, before) or [f"task {at} was another one"]
            told = f"{folder}: holds results of another study: {'; '.join(changes)}"
            raise InputError(f"{told}. {here} to keep them")
    return lines


def _changes(now: Study, before: dict[str, Any]) -> list[str]:
    """What differs from the study that the results are of, in words."""
    told = []
    sources, digests = before.get("sources", {}), now.sources.digests
    changed = [n for n in sorted({*sources, *digests}) if sources.get(n) != digests.get(n)]
    if sources and changed:
        told.append(f"{', '.join(changed)} changed since")
    if before.get("seed", now.seed) != now.seed:
        told.append(f"the seed was {before['seed']}, now it is {now.seed}")
    options = before.get("options", {})
    for name, value in now.options.items():
        if options.get(name, value) != value:
            told.append(f"option {name} was {quoted(options[name])}, now it is {quoted(value)}")
    return told


def summarise(study: Study, output: str | Path, page: str | Path) -> str | None:
    """Returns what summary(frame) of study.py says, also written to `page`; None without one.

    `frame` has the rows of the study's tasks in their order.  Raises InputError with file and
    line where summary() raises or gives no text.
    """
    summary = getattr(study.module, "summary", None)
    if summary is None:
        return None
    frame = studies.read_results(output)
    frame = frame[frame["task"] < len(study.tasks)]
    text = studies.calling(study.folder, "summary()", lambda: summary(frame))
    if not isinstance(text, str):
        kind = type(text).__name__
        raise InputError(f"{study.folder / 'study.py'}: summary() returned {kind}; it returns text")
    lines = (printable(line).replace("\\t", "\t") for line in text.rstrip("\n").split("\n"))
    atomic_write_text(page, "\n".join(lines) + "\n")
    return text
