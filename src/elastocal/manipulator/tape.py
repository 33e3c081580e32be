"""Batch evaluation: CasADi's instruction tape replayed on numpy arrays.

A CasADi `SX` function is a list of scalar instructions.  Replaying each instruction once on an
array of all poses costs one numpy call per instruction and chunk instead of one CasADi call per
pose, and the same replay runs on complex arrays, which complex-step checks use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

CHUNK = 8192  # rows at a time: registers stay in cache, numpy's call overhead is spread


def _twice(x: Any, out: Any = None) -> Any:
    return np.multiply(x, 2.0, out=out)


def _if_else_zero(condition: Any, value: Any, out: Any = None) -> Any:
    # np.where and not a product: the branch not taken may be infinite or NaN.
    chosen = np.where(np.not_equal(condition, 0), value, 0.0)
    if out is None:
        return chosen[()]
    out[:] = chosen
    return out


def _abs(x: Any, out: Any = None) -> Any:
    # On complex numbers the analytic continuation, so that complex steps stay derivatives.
    if np.iscomplexobj(x):
        return np.multiply(x, np.where(np.real(x) < 0, -1.0, 1.0), out=out)
    return np.abs(x, out=out)


def _sign(x: Any, out: Any = None) -> Any:
    return np.multiply(np.sign(np.real(x)), 1.0, out=out)


def _not(x: Any, out: Any = None) -> Any:
    return np.multiply(np.logical_not(x), 1.0, out=out)


def _as_number(compare: Callable) -> Callable:
    def replay(a: Any, b: Any, out: Any = None) -> Any:
        return np.multiply(compare(a, b), 1.0, out=out)

    return replay


UNARY: dict[int, Any] = {
    ca.OP_NEG: np.negative, ca.OP_EXP: np.exp, ca.OP_LOG: np.log, ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square, ca.OP_SIN: np.sin, ca.OP_COS: np.cos, ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin, ca.OP_ACOS: np.arccos, ca.OP_ATAN: np.arctan, ca.OP_FABS: _abs,
    ca.OP_SIGN: _sign, ca.OP_SINH: np.sinh, ca.OP_COSH: np.cosh, ca.OP_TANH: np.tanh,
    ca.OP_INV: np.reciprocal, ca.OP_LOG1P: np.log1p, ca.OP_EXPM1: np.expm1,
    ca.OP_FLOOR: np.floor, ca.OP_CEIL: np.ceil, ca.OP_ASSIGN: np.positive,
    ca.OP_TWICE: _twice, ca.OP_NOT: _not,
}  # fmt: skip
BINARY: dict[int, Any] = {
    ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply, ca.OP_DIV: np.divide,
    ca.OP_POW: np.power, ca.OP_CONSTPOW: np.power, ca.OP_ATAN2: np.arctan2,
    ca.OP_FMIN: np.fmin, ca.OP_FMAX: np.fmax, ca.OP_HYPOT: np.hypot, ca.OP_FMOD: np.fmod,
    ca.OP_LT: _as_number(np.less), ca.OP_LE: _as_number(np.less_equal),
    ca.OP_EQ: _as_number(np.equal), ca.OP_NE: _as_number(np.not_equal),
    ca.OP_AND: _as_number(np.logical_and), ca.OP_OR: _as_number(np.logical_or),
    ca.OP_IF_ELSE_ZERO: _if_else_zero, ca.OP_COPYSIGN: np.copysign,
}  # fmt: skip


CONSTANT, READ, WRITE, UNARY_OP, BINARY_OP = range(5)


class Tape:
    """An `SX` expression list as a replayable tape.

    `inputs` and `outputs` are lists of SX vectors / matrices.  Calling the tape takes one array
    per input: (n, size) for a quantity that varies by row, (size,) for one that is the same in
    every row; it returns one array (n, rows, columns) per output.
    """

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        # cse: the derivative code repeats the chain's products many times over.
        function = ca.Function("tape", list(inputs), list(outputs), {"cse": True})
        self.shapes = [out.shape for out in outputs]
        self.n_registers = function.sz_w()
        self.n_instructions = function.n_instructions()
        self._program = [_step(function, k, self.shapes) for k in range(self.n_instructions)]

    def __call__(self, *inputs: NDArray, chunk: int = CHUNK) -> list[NDArray]:
        arrays = [np.asarray(a) for a in inputs]
        n = max((len(a) for a in arrays if a.ndim == 2), default=1)
        dtype = np.result_type(np.float64, *arrays)
        results = [np.zeros((n, r, c), dtype=dtype) for r, c in self.shapes]
        size = max(min(chunk, n), 1)
        buffer = np.empty((self.n_registers, size), dtype=dtype)
        stage = [np.zeros((r * c, size), dtype=dtype) for r, c in self.shapes]
        for start in range(0, n, size):
            m = min(size, n - start)
            self._replay(arrays, slice(start, start + m), buffer[:, :m], [s[:, :m] for s in stage])
            for result, s in zip(results, stage, strict=True):
                result.reshape(n, -1)[start : start + m] = s[:, :m].T
        return results

    def _replay(self, arrays: list[NDArray], rows: slice, buffer: NDArray, stage: list) -> None:
        columns = [a[rows].T.copy() if a.ndim == 2 else a for a in arrays]
        views = list(buffer)
        # A register holds a row of `buffer` where it varies by pose, else a scalar.
        register: list[Any] = [None] * self.n_registers
        varies = [False] * self.n_registers
        for kind, op, out, a, b in self._program:
            if kind == BINARY_OP:
                if varies[a] or varies[b]:
                    register[out] = op(register[a], register[b], out=views[out])
                    varies[out] = True
                else:
                    register[out] = op(register[a], register[b])
                    varies[out] = False
            elif kind == UNARY_OP:
                varies[out] = varies[a]
                register[out] = op(register[a], out=views[out]) if varies[a] else op(register[a])
            elif kind == READ:
                value = columns[a][b]
                varies[out] = value.ndim == 1
                if varies[out]:
                    views[out][:] = value
                    value = views[out]
                register[out] = value
            elif kind == WRITE:
                stage[a][b] = register[out]
            else:
                register[out], varies[out] = op, False


def _step(function: ca.Function, k: int, shapes: list[tuple[int, int]]) -> tuple:
    """Instruction k as (kind, operation or constant, register, first, second operand)."""
    code = function.instruction_id(k)
    into, out = function.instruction_input(k), function.instruction_output(k)
    if code == ca.OP_CONST:
        return (CONSTANT, np.float64(function.instruction_constant(k)), out[0], 0, 0)
    if code == ca.OP_INPUT:
        return (READ, None, out[0], into[0], into[1])
    if code == ca.OP_OUTPUT:
        sparsity = function.sparsity_out(out[0])
        row, column = sparsity.row()[out[1]], sparsity.get_col()[out[1]]
        return (WRITE, None, into[0], out[0], row * shapes[out[0]][1] + column)
    if code in BINARY:
        return (BINARY_OP, BINARY[code], out[0], into[0], into[1])
    if code in UNARY:
        return (UNARY_OP, UNARY[code], out[0], into[0], 0)
    raise NotImplementedError(f"CasADi operation {code} has no numpy counterpart in the tape")
