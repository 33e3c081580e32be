"""The connection to a Dask scheduler: found, checked, and lost."""

from __future__ import annotations

import logging
from types import ModuleType
from typing import Any

from elastocal import __version__
from elastocal.errors import ElastocalError, InputError

ANSWER = 10.0  # s in which a scheduler answers


class ClusterLostError(ElastocalError):
    """The scheduler went away; what was done is kept."""

    exit_code = 1


def lost(client: Any) -> ClusterLostError:
    return ClusterLostError(
        f"the scheduler at {client.scheduler.address} went away or cancelled the tasks; what was "
        "done is kept, and the same command goes on with the rest"
    )


def connect(address: str) -> Any:
    """A client of the scheduler at `address`, or of the one in Dask's configuration ("config").

    Raises InputError where distributed is not installed, there is no scheduler, or a worker
    lacks this version of elastocal.
    """
    distributed = dask_distributed()
    import dask

    where = address
    if address == "config":
        where = dask.config.get("scheduler-address", None)
        if where is None:
            raise InputError(
                "--cluster config: Dask's configuration names no scheduler; set "
                "DASK_SCHEDULER_ADDRESS or scheduler-address, or give --cluster tcp://HOST:8786"
            )
    # Its log lines tell of dead workers with tracebacks; what matters is told by the study.
    for name in [n for n in logging.root.manager.loggerDict if n.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(where, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--cluster {where}: no scheduler answers ({error}); check the address, or start one "
            "with: dask scheduler"
        ) from None
    try:
        found = client.run(_version)
    except Exception as error:  # of the worker: whatever its Python lacks
        client.close()
        raise InputError(
            f"--cluster {where}: a worker cannot import elastocal ({error}); install "
            f"elastocal {__version__} where the workers run"
        ) from None
    wrong = {worker: version for worker, version in found.items() if version != __version__}
    if wrong:
        client.close()
        worker, version = next(iter(wrong.items()))
        raise InputError(
            f"--cluster {where}: worker {worker} has elastocal {version}, here it is "
            f"{__version__}; install the same there"
        )
    return client


def _version() -> str:
    return __version__


def dask_distributed() -> ModuleType:
    """The module distributed.

    Raises InputError where it is not installed.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            "--cluster needs dask.distributed; run: pip install 'elastocal[cluster]'"
        ) from None
    module: ModuleType = distributed
    return module
