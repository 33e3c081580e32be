"""Batch evaluation: a list of expressions on all rows of a table at once, behind one call."""

from __future__ import annotations

import contextvars
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.model.c_engine import (
    HOW_TO_GET_ONE,
    Compiled,
    NoCompiler,
    compile_function,
    find_compiled,
)
from elastocal.model.function_cache import HashedFunction, row_by_row
from elastocal.model.numpy_engine import NumpyFunction
from elastocal.text import did_you_mean

Item = TypeVar("Item")
Result = TypeVar("Result")

# Threads over blocks of rows, or over items one after the other: how many, and running them.


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


def ahead(work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """`work` on each of the items, results in order, while the next items are made.

    All items are made one after the other in the caller's thread: what they count and keep does
    not depend on which work is done first, nor does any result.
    """
    if threads == 1:
        yield from map(work, items)
        return
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


# Which engine evaluates a function: CasADi row by row, numpy or compiled C; asked for and reported.
#
# "auto" rents before it buys: few rows are evaluated by CasADi itself, where numpy's calls would
# cost more, many by numpy, until that has cost about as much more than compiled code as compiling
# costs, and compiled then.  What has been compiled before is used as soon as the others have cost
# more than looking for it.  All is counted in calls and rows and never timed, so that the same
# work with the same cache is evaluated by the same engine.

BACKENDS = ("auto", "numpy", "compiled")
VARIABLE = "ELASTOCAL_BACKEND"

# Seconds, on one core of a 2023 server.  Numpy costs a call per instruction and block and
# is then bound by the second-level cache; compiled code keeps most operands in registers.
NUMPY_CALL = 0.3e-6  # per instruction and block
NUMPY_ROW = 0.15e-9  # per instruction and row, above compiled code
CASADI_ROW = 4e-9  # the same of CasADi's own evaluation, which has no cost beside
COMPILE_START, COMPILE_INSTRUCTION = 0.2, 1.0e-4  # one run of the compiler, and for each
COMPILE_LENGTH = 4.4e-9  # instruction and each of the others in the same function
LOOKUP_START, LOOKUP_INSTRUCTION = 0.02, 1e-6  # hash, verify and load a library


def checked(name: str, source: str) -> str:
    """`name` where it is a backend; InputError that says where it comes from otherwise."""
    if name not in BACKENDS:
        raise InputError(
            f"{source}: unknown backend '{name}'{did_you_mean(name, list(BACKENDS))}; "
            f"valid: {', '.join(BACKENDS)}"
        )
    return name


def chosen_backend(name: str | None = None) -> str:
    """`name`, else ELASTOCAL_BACKEND, else "auto".

    Raises InputError for an unknown name.
    """
    if name is not None:
        return checked(name, "backend")
    return checked(os.environ.get(VARIABLE, "").strip() or "auto", f"{VARIABLE} in the environment")


@dataclass
class Work:
    """Seconds that numpy or CasADi has cost above compiled code of `instructions`, estimated."""

    instructions: int
    wasted: float = 0.0

    def add(self, rows: int, blocks: int) -> None:
        """One more call of `rows` rows in `blocks` blocks."""
        by_numpy = NUMPY_CALL * blocks + NUMPY_ROW * rows
        self.wasted += self.instructions * min(by_numpy, CASADI_ROW * rows)

    @staticmethod
    def few(rows: int, blocks: int) -> bool:
        """CasADi evaluates so few rows (up to 77 of one block) sooner than numpy."""
        return CASADI_ROW * rows <= NUMPY_CALL * blocks + NUMPY_ROW * rows

    @property
    def pays_to_look(self) -> bool:
        """A library that exists already pays by now."""
        return self.wasted >= LOOKUP_START + LOOKUP_INSTRUCTION * self.instructions

    @property
    def pays_to_compile(self) -> bool:
        """Compiling would have paid by now."""
        each = COMPILE_INSTRUCTION + COMPILE_LENGTH * self.instructions
        return self.wasted >= COMPILE_START + each * self.instructions


@dataclass(frozen=True)
class BackendReport:
    """What evaluated a function last.

    `backend` "casadi", "numpy" or "compiled" ("none" before the first call), `compiler` its path
    and version where compiled, `threads` used, `cached` True where the library was found and not
    compiled by this process, `reason` why it is not compiled.
    """

    backend: str
    compiler: str | None = None
    threads: int = 1
    cached: bool = False
    reason: str = ""

    def __str__(self) -> str:
        cores = f"{self.threads} thread{'s' if self.threads > 1 else ''}"
        if self.backend == "compiled":
            return f"compiled ({self.compiler}; {cores})"
        why = f"; {self.reason}" if self.reason else ""
        return f"{self.backend} ({cores}{why})"


def summary(reports: Iterable[BackendReport]) -> str:
    """One line for a report: every engine that was used, and by how many of the functions."""
    groups: dict[tuple[str, str | None, str], list[BackendReport]] = {}
    for report in reports:
        if report.backend != "none":
            key = (report.backend, report.compiler, report.reason)
            groups.setdefault(key, []).append(report)
    total = sum(len(group) for group in groups.values())
    lines = []
    for group in groups.values():
        threads = max(r.threads for r in group)
        share = f"{len(group)} of {total} expressions: " if len(groups) > 1 else ""
        lines.append(f"{share}{replace(group[0], threads=threads)}")
    return "; ".join(lines) or "nothing evaluated yet"


CHUNK = 8192  # rows at a time: registers stay in cache, numpy's call overhead is spread


class RowByRow:
    """A function evaluated by CasADi itself, one call for each row.

    A table of a few rows takes numpy one call per instruction, as one of thousands does: of 3600
    instructions one row takes CasADi 0.2 ms and numpy 2 to 3 ms, 16 rows 0.7 and 2.3 ms.
    """

    name, largest_block = "casadi", CHUNK

    def __init__(self, function: HashedFunction) -> None:
        self._function = function.function
        outputs = range(self._function.n_out())
        self._places = [row_by_row(self._function.sparsity_out(k)) for k in outputs]
        self._spans = _side_by_side(map(len, self._places))

    def threads(self, rows: int) -> int:
        """One: CasADi evaluates few rows, and holds the interpreter's lock."""
        return 1

    def evaluate(
        self, inputs: Sequence[NDArray], results: Sequence[NDArray], blocks: Sequence[slice]
    ) -> None:
        """Rows of `blocks` of `results` (n, rows, columns)."""
        call: Any
        call, run = self._function.buffer()
        # All that varies by row side by side, and all that is found: one copy each for a row.
        varying = [a for a in inputs if a.ndim == 2]
        rows = np.concatenate(varying, axis=1) if varying else np.zeros((1, 0))
        given, found = np.zeros(rows.shape[1]), np.zeros(sum(map(len, self._places)))
        spans = _side_by_side(a.shape[1] if a.ndim == 2 else 0 for a in inputs)
        held = [
            given[span] if a.ndim == 2 else a.copy() for a, span in zip(inputs, spans, strict=True)
        ]
        for k, array in enumerate(held):
            call.set_arg(k, array.data)
        for k, span in enumerate(self._spans):
            call.set_res(k, found[span].data)
        numbers = [i for block in blocks for i in range(block.start, block.stop)]
        all_found = np.empty((len(numbers), len(found)))
        for i, out in zip(numbers, all_found, strict=True):
            given[:] = rows[i]
            run()
            out[:] = found
        for result, places, span in zip(results, self._places, self._spans, strict=True):
            flat = result.reshape(len(result), result.shape[1] * result.shape[2])
            flat[np.ix_(numbers, places)] = all_found[:, span]


def _side_by_side(widths: Iterable[int]) -> list[slice]:
    """Where each of several pieces stands in a row of all."""
    return [slice(a, b) for a, b in pairwise(accumulate(widths, initial=0))]


Engine = RowByRow | NumpyFunction | Compiled


class BatchFunction:
    """An `SX` expression list, evaluated row by row on arrays.

    `inputs` and `outputs` are lists of SX vectors / matrices.  Calling it takes one array
    per input: (n, size) for a quantity that varies by row, (size,) for one that is the same in
    every row; it returns one array (n, rows, columns) per output, float64, or complex where an
    input is.  `backend` is "auto", "numpy" or "compiled"; None follows ELASTOCAL_BACKEND.
    Complex numbers are always evaluated by numpy; under "auto" few rows by CasADi.

    By numpy a call raises NotImplementedError for an operation that it lacks, by all ValueError
    for arrays of other shapes, InputError where `backend` is "compiled" and nothing can compile.
    """

    def __init__(
        self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX], backend: str | None = None
    ) -> None:
        self._asked = None if backend is None else checked(backend, "backend")
        self._function = HashedFunction(inputs, outputs)
        self.shapes = self._function.shapes
        self._sizes = self._function.sizes
        self.n_instructions = self._function.n_instructions
        self._forget()

    def _forget(self) -> None:
        self._lock = threading.Lock()
        self._work = Work(self.n_instructions)
        self._compiled: Compiled | None = None
        self._looked = False
        self._refused = ""
        self._report = BackendReport("none")

    def __getstate__(self) -> dict[str, Any]:
        """Expressions only: libraries, locks and instructions are found again where it goes."""
        kept = ("_asked", "_function", "shapes", "_sizes", "n_instructions")
        return {key: self.__dict__[key] for key in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()

    @cached_property
    def _by_numpy(self) -> NumpyFunction:
        return NumpyFunction(self._function)

    @cached_property
    def _by_casadi(self) -> RowByRow:
        return RowByRow(self._function)

    @property
    def report(self) -> BackendReport:
        """What evaluated the last call."""
        return self._report

    def __call__(self, *inputs: NDArray, chunk: int = CHUNK) -> list[NDArray]:
        arrays, n = self._rows(inputs)
        dtype = np.result_type(np.float64, *arrays)
        results = [np.zeros((n, r, c), dtype=dtype) for r, c in self.shapes]
        engine = self._engine(dtype, n, -(-n // max(chunk, 1)))
        blocks = row_blocks(n, min(chunk, engine.largest_block))
        threads = max(1, min(engine.threads(n), len(blocks), _threads_here()))
        self._note(engine, threads)
        run_blocks(lambda share: engine.evaluate(arrays, results, share), blocks, threads)
        return results

    def _rows(self, inputs: Sequence[NDArray]) -> tuple[list[NDArray], int]:
        """The inputs as arrays of the right shapes, and the number of rows."""
        arrays = [np.asarray(a) for a in inputs]
        arrays = [a if a.dtype.kind == "c" else a.astype(np.float64, copy=False) for a in arrays]
        n = max((len(a) for a in arrays if a.ndim == 2), default=1)
        shapes = [a.shape for a in arrays]
        per_row, common = [(n, size) for size in self._sizes], [(size,) for size in self._sizes]
        fit = [s in pair for s, *pair in zip(shapes, per_row, common, strict=False)]
        if len(shapes) != len(self._sizes) or not all(fit):
            raise ValueError(f"inputs of shapes {shapes}; it takes {self._sizes} per row")
        return arrays, n

    def _engine(self, dtype: np.dtype, rows: int, blocks: int) -> Engine:
        backend = chosen_backend(self._asked)
        if backend == "numpy" or dtype != np.float64:
            return self._by_numpy
        with self._lock:
            if self._compiled is None and backend == "compiled":
                try:
                    self._compiled = compile_function(self._function)
                except NoCompiler as error:
                    raise InputError(f"backend compiled: {error}; {HOW_TO_GET_ONE}") from None
            if self._compiled is None and not self._refused:
                self._compiled = self._where_it_pays(rows, blocks)
            if self._compiled is not None:
                return self._compiled
        return self._by_casadi if self._work.few(rows, blocks) else self._by_numpy

    def _where_it_pays(self, rows: int, blocks: int) -> Compiled | None:
        """Compiled code under "auto", this call counted; None where numpy is still cheaper."""
        self._work.add(rows, blocks)
        try:
            if self._work.pays_to_compile:
                return compile_function(self._function)
            if self._work.pays_to_look and not self._looked:
                self._looked = True
                return find_compiled(self._function)
        except NoCompiler as error:
            self._refused = str(error)
        return None

    def _note(self, engine: Engine, threads: int) -> None:
        if isinstance(engine, Compiled):
            compiler = str(engine.compiler)
            self._report = BackendReport(engine.name, compiler, threads, engine.cached)
        else:
            self._report = BackendReport(engine.name, threads=threads, reason=self._refused)


def _threads_here() -> int:
    """One in a thread of the caller's own: who started it has shared the work out already."""
    return thread_count() if threading.current_thread() is threading.main_thread() else 1
