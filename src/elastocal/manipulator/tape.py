"""Batch evaluation: a list of expressions on all rows of a table at once, behind one call."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.manipulator.backend import BackendReport, Work, checked, chosen_backend
from elastocal.manipulator.backend_function import TapeFunction
from elastocal.manipulator.backend_numpy import Replay
from elastocal.manipulator.compiled import Compiled, compile_tape, find_compiled
from elastocal.manipulator.compiled_build import HOW_TO_GET_ONE, NoCompiler
from elastocal.manipulator.threads import row_blocks, run_blocks, thread_count

CHUNK = 8192  # rows at a time: registers stay in cache, numpy's call overhead is spread
COMPILED_CHUNK = 1024  # compiled code has no overhead to spread; small pieces share out evenly
LARGEST_BUFFER = 2**23  # numbers in the registers and outputs of one block
# Compiled code takes about 0.15 ns per instruction and row; a thread must have 0.5 ms to do.
WORK_OF_A_THREAD = 3_000_000  # instructions × rows


class Tape:
    """An `SX` expression list, evaluated row by row on arrays.

    `inputs` and `outputs` are lists of SX vectors / matrices.  Calling the tape takes one array
    per input: (n, size) for a quantity that varies by row, (size,) for one that is the same in
    every row; it returns one array (n, rows, columns) per output, float64, or complex where an
    input is.  `backend` is "auto", "numpy" or "compiled"; None follows `set_default_backend`.
    Complex numbers are always replayed.

    `whole`, where given, is a tape of the same inputs and outputs whose last output has more
    columns, and `columns` says which of them this one's are: where its instructions are known
    already, they serve here too.

    A call raises NotImplementedError where it replays an operation that numpy lacks, ValueError
    for arrays of other shapes, InputError where `backend` is "compiled" and nothing can compile.
    """

    def __init__(
        self,
        inputs: Sequence[ca.SX],
        outputs: Sequence[ca.SX],
        backend: str | None = None,
        whole: Tape | None = None,
        columns: Sequence[int] = (),
    ) -> None:
        self._asked = None if backend is None else checked(backend, "backend")
        self._function = TapeFunction(inputs, outputs)
        self.shapes = self._function.shapes
        self._sizes = self._function.sizes
        self.n_instructions = self._function.n_instructions
        self._forget()
        self._whole, self._columns = whole, tuple(columns)

    _whole: Tape | None
    _columns: tuple[int, ...]

    def _forget(self) -> None:
        self._lock = threading.Lock()
        self._whole, self._columns = None, ()
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
    def _replay(self) -> Replay:
        known = None if self._whole is None else self._whole.__dict__.get("_replay")
        return Replay(self._function, known, self._columns)

    @property
    def report(self) -> BackendReport:
        """What evaluated the last call."""
        return self._report

    def __call__(self, *inputs: NDArray, chunk: int = CHUNK) -> list[NDArray]:
        arrays, n = self._rows(inputs)
        dtype = np.result_type(np.float64, *arrays)
        results = [np.zeros((n, r, c), dtype=dtype) for r, c in self.shapes]
        engine = self._engine(dtype, n, -(-n // max(chunk, 1)))
        if isinstance(engine, Compiled):
            blocks = row_blocks(n, min(chunk, COMPILED_CHUNK))
            threads = 1 + n * self.n_instructions // WORK_OF_A_THREAD
        else:
            width = engine.n_registers + sum(r * c for r, c in self.shapes)
            blocks = row_blocks(n, min(chunk, max(LARGEST_BUFFER // max(width, 1), 1)))
            threads = len(blocks)
        threads = min(threads, len(blocks), _threads_here())
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
            raise ValueError(f"inputs of shapes {shapes}; this tape takes {self._sizes} per row")
        return arrays, n

    def _engine(self, dtype: np.dtype, rows: int, blocks: int) -> Replay | Compiled:
        backend = chosen_backend(self._asked)
        if backend == "numpy" or dtype != np.float64:
            return self._replay
        with self._lock:
            if self._compiled is None and backend == "compiled":
                try:
                    self._compiled = compile_tape(self._function)
                except NoCompiler as error:
                    raise InputError(f"backend compiled: {error}; {HOW_TO_GET_ONE}") from None
            if self._compiled is None and not self._refused:
                self._compiled = self._where_it_pays(rows, blocks)
            return self._compiled or self._replay

    def _where_it_pays(self, rows: int, blocks: int) -> Compiled | None:
        """Compiled code under "auto", this call counted; None where replaying is still cheaper."""
        self._work.add(rows, blocks)
        try:
            if self._work.pays_to_compile:
                return compile_tape(self._function)
            if self._work.pays_to_look and not self._looked:
                self._looked = True
                return find_compiled(self._function)
        except NoCompiler as error:
            self._refused = str(error)
        return None

    def _note(self, engine: Replay | Compiled, threads: int) -> None:
        threads = max(threads, 1)
        if isinstance(engine, Compiled):
            compiler = str(engine.compiler)
            self._report = BackendReport("compiled", compiler, threads, engine.cached)
        else:
            self._report = BackendReport("numpy", threads=threads, reason=self._refused)


def _threads_here() -> int:
    """One in a thread of the caller's own: who started it has shared the work out already."""
    return thread_count() if threading.current_thread() is threading.main_thread() else 1
