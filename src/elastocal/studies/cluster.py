"""Tasks on a Dask cluster.

`distributed` itself rather than joblib's backend for it: each task has its own future, so one
that killed its workers fails alone, where joblib gives up the whole run.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from types import ModuleType
from typing import Any

from elastocal.studies.cluster_client import connect, dask_distributed, lost
from elastocal.studies.execution import Outcome, execute
from elastocal.studies.job import Job
from elastocal.studies.local import killed
from elastocal.studies.package import Package
from elastocal.studies.stopping import Stop

PATIENCE = 60.0  # s without a scheduler before the run gives up


def run_at(
    address: str,
    package: Package,
    digest: str,
    jobs: Sequence[Job],
    stop: Stop,
    tell: Callable[[str], None],
) -> Generator[Outcome, None, None]:
    """`run_cluster` on the cluster at `address` (see `connect`), where there is a job at all."""
    if not jobs:
        return
    client = connect(address)
    try:
        yield from run_cluster(client, package, digest, jobs, stop, tell)
    finally:
        client.close()


def run_cluster(
    client: Any,
    package: Package,
    digest: str,
    jobs: Sequence[Job],
    stop: Stop,
    tell: Callable[[str], None],
) -> Generator[Outcome, None, None]:
    """Outcomes as they come, none twice; no new task goes out once `stop` is asked for.

    As many tasks are out as the workers have threads.  Dask gives the tasks of a dead worker to
    another one.  A task whose workers died more often than the cluster allows
    (distributed.scheduler.allowed-failures) is an outcome with an error; where a worker runs
    several tasks at once it may have died of another one, so the task has a last try alone.
    Raises ClusterLostError where the scheduler is gone for PATIENCE seconds.
    """
    distributed = dask_distributed()
    run = uuid.uuid4().hex[:12]  # no future of another run may answer for ours
    waiting, suspects = deque(jobs), deque[Job]()
    out: dict[Any, Job] = {}
    tried: Counter[int] = Counter()
    crew = Crew(client, tell)
    try:
        while True:
            crew.look()
            while not stop.asked and len(out) < crew.threads:
                if not waiting and suspects and not out:
                    waiting.append(suspects.popleft())
                if not waiting:
                    break
                job = waiting.popleft()
                key = f"elastocal-study-{run}-{job.index}-{tried[job.index]}"
                out[client.submit(execute, package, digest, job, key=key, pure=False)] = job
                if tried[job.index]:
                    break
            if not out and (stop.asked or not (waiting or suspects)):
                return
            for future in _finished(distributed, client, list(out)):
                job = out.pop(future)
                killer = distributed.scheduler.KilledWorker
                try:
                    yield future.result()
                except killer as error:
                    tries = error.allowed_failures + 1
                    tried[job.index] += tries
                    if crew.shared and tried[job.index] == tries:
                        suspects.append(job)
                    else:
                        yield killed(job.index, f"{tried[job.index]} times", str(error))
                except (distributed.CancelledError, OSError):
                    raise lost(client) from None  # execute() returns what a task raises
                except Exception as error:
                    line = f"{type(error).__name__}: {error}"
                    yield Outcome(job.index, error=f"the worker could not run it: {line}")
    finally:
        if out and client.status == "running":
            client.cancel(list(out), force=True)


class Crew:
    """The workers as last seen: `threads` in all, and whether some run several tasks at once."""

    def __init__(self, client: Any, tell: Callable[[str], None]) -> None:
        self.threads, self.shared = 0, False
        self._client, self._tell, self._told = client, tell, False
        self._seen, self._looked = time.monotonic(), float("-inf")

    def look(self) -> None:
        """Look again, at most once a second.

        Raises ClusterLostError where the scheduler is gone for PATIENCE seconds.
        """
        now = time.monotonic()
        if self._client.status != "running":
            if now - self._seen > PATIENCE or self._client.status == "closed":
                raise lost(self._client)
            time.sleep(0.1)
            return
        self._seen = now
        if now - self._looked < 1.0:
            return
        threads = self._client.nthreads().values()
        self.threads, self.shared, self._looked = sum(threads), max(threads, default=0) > 1, now
        if not threads and not self._told:
            self._tell("the cluster has no worker; waiting for one")
        self._told = not threads


def _finished(distributed: ModuleType, client: Any, out: list[Any]) -> Iterable[Any]:
    """The futures that ended, after waiting a second at most."""
    if not out:
        time.sleep(0.1)
        return ()
    try:
        with client.as_current():
            waited = distributed.wait(out, timeout=1.0, return_when="FIRST_COMPLETED")
    except distributed.TimeoutError:
        return ()
    except distributed.CancelledError:
        raise lost(client) from None
    ended: Iterable[Any] = waited.done
    return ended
