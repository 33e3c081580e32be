"""Batch evaluation: a list of expressions on all rows of a table at once, behind one call."""

from __future__ import annotations

import contextvars
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.messages import InputError, check_known

# CasADi's scalar operations as numpy functions of arrays, real or complex.


def _as_number(compare: Callable) -> Callable:
    return lambda *given: compare(*given) * 1.0


UNARY: dict[int, Any] = {
    ca.OP_NEG: np.negative, ca.OP_EXP: np.exp, ca.OP_LOG: np.log, ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square, ca.OP_SIN: np.sin, ca.OP_COS: np.cos, ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin, ca.OP_ACOS: np.arccos, ca.OP_ATAN: np.arctan,
    ca.OP_SINH: np.sinh, ca.OP_COSH: np.cosh, ca.OP_TANH: np.tanh, ca.OP_INV: np.reciprocal,
    ca.OP_LOG1P: np.log1p, ca.OP_EXPM1: np.expm1, ca.OP_FLOOR: np.floor, ca.OP_CEIL: np.ceil,
    ca.OP_ASSIGN: np.positive,
    # On complex numbers the analytic continuation, so that complex steps stay derivatives.
    ca.OP_FABS: lambda x:
        x * np.where(np.real(x) < 0, -1.0, 1.0) if np.iscomplexobj(x) else np.abs(x),
    ca.OP_SIGN: lambda x: np.sign(np.real(x)),
    ca.OP_TWICE: lambda x: 2.0 * x,
    ca.OP_NOT: _as_number(np.logical_not),
}  # fmt: skip
BINARY: dict[int, Any] = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide,
    ca.OP_POW: np.power, ca.OP_CONSTPOW: np.power, ca.OP_ATAN2: np.arctan2,
    ca.OP_FMIN: np.fmin, ca.OP_FMAX: np.fmax, ca.OP_HYPOT: np.hypot, ca.OP_FMOD: np.fmod,
    ca.OP_LT: _as_number(np.less), ca.OP_LE: _as_number(np.less_equal),
    ca.OP_EQ: _as_number(np.equal), ca.OP_NE: _as_number(np.not_equal),
    ca.OP_AND: _as_number(np.logical_and), ca.OP_OR: _as_number(np.logical_or),
    ca.OP_COPYSIGN: np.copysign,
    # Not a product: the branch not taken may be infinite or NaN.
    ca.OP_IF_ELSE_ZERO: lambda condition, x: np.where(np.not_equal(condition, 0), x, 0.0),
}  # fmt: skip
# A CasADi `SX` function is a list of scalar instructions.  Carrying out each once on an
# array of all poses costs one numpy call per instruction and block instead of one CasADi call per
# pose, and the same runs on complex arrays, which complex-step checks use.

CONSTANT, READ, WRITE, UNARY_OP, BINARY_OP = range(5)
# Common subexpressions are not looked for: that takes 7 µs per instruction, as long as all the rest
# before the first row, and would save 2 to 14 % of the instructions of B.
LARGEST_BUFFER = 2**23  # numbers in the registers and outputs of one block


def instructions(f: ca.Function) -> Iterator[tuple[int, Any, int, int, int]]:
    """Kind, operation or constant, register, first and second operand of each instruction: of READ
    input and component, of WRITE output and place row by row.  NotImplementedError for a CasADi
    operation that numpy has no counterpart for."""
    # Where each nonzero of an output, in CasADi's order, stands in its matrix written row by row.
    outputs = [f.sparsity_out(k) for k in range(f.n_out())]
    places = [
        [r * s.size2() + c for r, c in zip(s.row(), s.get_col(), strict=True)] for s in outputs
    ]
    for k in range(f.n_instructions()):
        code = f.instruction_id(k)
        if code == ca.OP_CONST:
            yield CONSTANT, f.instruction_constant(k), f.instruction_output(k)[0], 0, 0
        elif code in BINARY:
            a, b = f.instruction_input(k)
            yield BINARY_OP, BINARY[code], f.instruction_output(k)[0], a, b
        elif code in UNARY:
            (a,) = f.instruction_input(k)
            yield UNARY_OP, UNARY[code], f.instruction_output(k)[0], a, 0
        elif code == ca.OP_OUTPUT:
            output, nonzero = f.instruction_output(k)
            yield WRITE, None, f.instruction_input(k)[0], output, places[output][nonzero]
        elif code == ca.OP_INPUT:
            source, component = f.instruction_input(k)
            yield READ, None, f.instruction_output(k)[0], source, component
        else:
            raise NotImplementedError(f"CasADi operation {code} has no numpy counterpart")


Item = TypeVar("Item")
Result = TypeVar("Result")


def thread_count() -> int:
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))  # a container's or a batch system's share
    return os.cpu_count() or 1


def row_blocks(n: int, size: int) -> list[slice]:
    """`n` rows as contiguous blocks of at most `size`, equal to within one row.  They depend on n
    and size alone, so no result can depend on the number of threads."""
    count = -(-n // max(size, 1))
    edges = [n * k // count for k in range(count + 1)] if count else [0]
    return [slice(a, b) for a, b in pairwise(edges)]


def ahead(work: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """`work` on each of the items, results in order, while the next items are made: one after the
    other in the caller's thread, so that what they count and keep does not depend on which work is
    done first, nor does any result."""
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


# Which engine evaluates a function: numpy, or under "auto" CasADi itself where rows are so few that
# numpy's calls would cost more.  That is counted and never timed, so that the same work is
# evaluated by the same engine.

BACKENDS = ("auto", "numpy")
ONCE = "once"  # as "auto", of a function that is asked once: the program's own, no user's
VARIABLE = "ELASTOCAL_BACKEND"
# A row takes CasADi 5 ns per instruction and as much as BESIDE of them; numpy pays 0.36 µs per
# instruction and block, and 3 µs before the first one (one core of a 2023 server).
FEW, FEW_ONCE, BESIDE = 77, 670, 80  # rows of a block, of many instructions


def checked(name: str, source: str) -> str:
    """`name` where it is a backend; InputError that says where it comes from otherwise."""
    if name == "compiled":
        gone = "the backend 'compiled' is gone, as numpy evaluates tables nearly as fast"
        raise InputError(f"{source}: {gone}; take auto, or leave it out")
    check_known(name, BACKENDS, f"{source}: unknown backend '{name}'", "valid:")
    return name


def chosen_backend(name: str | None = None) -> str:
    if name is not None:
        return checked(name, "backend")
    return checked(os.environ.get(VARIABLE, "").strip() or "auto", f"{VARIABLE} in the environment")


CHUNK = 8192  # rows at a time: registers stay in cache, numpy's call overhead is spread


class BatchFunction:
    """An `SX` expression list, evaluated row by row on arrays.

    `inputs` and `outputs` are lists of SX vectors / matrices.  Calling it takes one array per
    input: (n, size) for a quantity that varies by row, (size,) for one that is the same in every
    row; it returns one array (n, rows, columns) per output, float64, or complex where an input is.
    `backend` is "auto" or "numpy"; None follows ELASTOCAL_BACKEND.  Complex numbers are always
    evaluated by numpy; under "auto" few rows by CasADi.  By numpy a call raises NotImplementedError
    for an operation that it lacks, by both ValueError for arrays of other shapes.
    """

    def __init__(
        self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX], backend: str | None = None
    ) -> None:
        by_casadi = chosen_backend(None if backend == ONCE else backend) == "auto"
        self._function = f = ca.Function("rows", list(inputs), list(outputs))
        share = f.n_instructions() / (BESIDE + f.n_instructions())
        self._most = (FEW_ONCE if backend == ONCE else FEW) * by_casadi * share  # rows of a block
        self.shapes = [f.size_out(k) for k in range(f.n_out())]
        self._sizes = [f.nnz_in(k) for k in range(f.n_in())]

    @cached_property
    def _by_numpy(self) -> list[tuple[int, Any, int, int, int]]:
        return [*instructions(self._function)]

    def __call__(self, *inputs: NDArray, chunk: int = CHUNK) -> list[NDArray]:
        arrays = [np.asarray(a) for a in inputs]
        arrays = [a if a.dtype.kind == "c" else a.astype(np.float64, copy=False) for a in arrays]
        n = max((len(a) for a in arrays if a.ndim == 2), default=1)
        shapes, sizes = [a.shape for a in arrays], self._sizes
        fit = [s in ((n, size), (size,)) for s, size in zip(shapes, sizes, strict=False)]
        if len(shapes) != len(sizes) or not all(fit):
            raise ValueError(f"inputs of shapes {shapes}; it takes {sizes} per row")
        dtype = np.result_type(np.float64, *arrays)
        results = [np.zeros((n, r, c), dtype=dtype) for r, c in self.shapes]
        if n <= self._most * -(-n // max(chunk, 1)) and dtype == np.float64:
            # It takes rows side by side, and what is the same in all of them once.
            found = self._function.call([ca.DM(a.T if a.ndim == 2 else a) for a in arrays])
            for result, value in zip(results, found, strict=True):
                if result.size:
                    side_by_side = value.full().reshape(result.shape[1], -1, result.shape[2])
                    result[:] = side_by_side.transpose(1, 0, 2)
            return results
        # CasADi gave the instructions registers, of which few are in use at a time.
        width = self._function.sz_w() + sum(r * c for r, c in self.shapes)
        blocks = row_blocks(n, min(chunk, max(LARGEST_BUFFER // max(width, 1), 1)))
        # In a thread of the caller's own one: who started it has shared the work out already.
        alone = threading.current_thread() is not threading.main_thread()
        threads = 1 if alone else max(1, min(len(blocks), thread_count()))
        # Each runs in a copy of the caller's context, which holds `numpy.errstate`.
        work = ((contextvars.copy_context(), block) for block in blocks)
        list(ahead(lambda w: w[0].run(self._carry_out, arrays, results, w[1]), work, threads))
        return results

    def _carry_out(
        self, inputs: Sequence[NDArray], results: Sequence[NDArray], block: slice
    ) -> None:
        """A block's rows of `results` (n, rows, columns), all of one type: registers are as long as
        it, so that they stay in cache.  What is the same in all rows is one number."""
        held: list[Any] = [None] * self._function.sz_w()
        given = [a[block].T.copy() if a.ndim == 2 else a.tolist() for a in inputs]
        flat = [r.reshape(len(r), r.shape[1] * r.shape[2])[block].T for r in results]
        for kind, what, out, a, b in self._by_numpy:
            if kind == BINARY_OP:
                held[out] = what(held[a], held[b])
            elif kind == UNARY_OP:
                held[out] = what(held[a])
            elif kind == READ:
                held[out] = given[a][b]
            elif kind == CONSTANT:
                held[out] = what
            else:
                flat[a][b] = held[out]
