"""Threads over blocks of rows: how many, how rows are cut, and running them."""

from __future__ import annotations

import contextvars
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise


def thread_count() -> int:
    """OMP_NUM_THREADS where that is a positive number, else the cores this process may use."""
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))  # a container's or a batch system's share
    return os.cpu_count() or 1


def row_blocks(n: int, size: int) -> list[slice]:
    """`n` rows as contiguous blocks of at most `size`, equal to within one row.

    They depend on n and size alone, so no result can depend on the number of threads.
    """
    count = -(-n // max(size, 1))
    edges = [n * k // count for k in range(count + 1)] if count else [0]
    return [slice(a, b) for a, b in pairwise(edges)]


def run_blocks(
    work: Callable[[Sequence[slice]], None], blocks: Sequence[slice], threads: int
) -> None:
    """`work` on contiguous shares of `blocks`, one share per thread; what one raises is raised.

    Every thread runs in a copy of the caller's context, which holds `numpy.errstate`.
    """
    threads = max(1, min(threads, len(blocks)))
    if threads == 1:
        work(blocks)
        return
    shares = [blocks[s] for s in row_blocks(len(blocks), -(-len(blocks) // threads))]
    with ThreadPoolExecutor(threads, thread_name_prefix="rows") as pool:
        running = [pool.submit(contextvars.copy_context().run, work, share) for share in shares]
        for future in running:
            future.result()
