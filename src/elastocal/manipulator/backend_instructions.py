"""CasADi's instructions of a tape as arrays, kept in the cache where asking for them takes long."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend_function import TapeFunction, row_by_row
from elastocal.manipulator.backend_operations import BINARY, UNARY
from elastocal.manipulator.tape_cache import content_key, fetch, store

CONSTANT, READ, WRITE, UNARY_OP, BINARY_OP = range(5)
SUFFIX = ".tape.npz"
# Asking CasADi for its instructions takes 15 µs for each, with their common subexpressions; what
# is made in less than 50 ms is not worth a file.
SMALLEST_CACHED = 4000


def instructions(function: TapeFunction) -> tuple[NDArray[np.int32], NDArray, int]:
    """Instructions (m, 5), constants (c,) and number of registers of a tape; cached when long.

    An instruction is kind, operation or constant's index, register, first and second operand;
    of READ the operands are input and component, of WRITE output and place row by row.
    """
    if function.n_instructions < SMALLEST_CACHED:
        return _extracted(function)
    key = content_key("instructions", function.digest)
    found = fetch(key, SUFFIX)
    if found is not None:
        try:
            with np.load(found, allow_pickle=False) as saved:
                return saved["table"], saved["constants"], int(saved["registers"])
        except (OSError, ValueError, KeyError):
            pass  # another process removed it
    table, constants, registers = _extracted(function)
    data = io.BytesIO()
    np.savez(data, table=table, constants=constants, registers=registers)
    store(key, SUFFIX, data.getvalue())
    return table, constants, registers


def of_columns(
    table: NDArray[np.int32], output: int, width: int, columns: Sequence[int]
) -> NDArray[np.int32]:
    """The instructions of `table` that make the `columns` of its last output, `output`.

    That output has `width` columns; the others stay whole.  What remains is in the same order, so
    the values are the same to the last digit.
    """
    position = {c: k for k, c in enumerate(columns)}
    live: set[int] = set()
    kept: list[int] = []
    places: list[int] = []
    rows = zip(*(column.tolist() for column in table[::-1].T), strict=True)
    for back, (kind, _, register, a, b) in enumerate(rows):
        if kind == WRITE:
            if a == output:
                row, column = divmod(b, width)
                if column not in position:
                    continue
                b = row * len(columns) + position[column]
            live.add(register)
        elif register in live:
            live.remove(register)
            if kind >= UNARY_OP:
                live.add(a)
                if kind == BINARY_OP:
                    live.add(b)
        else:
            continue
        kept.append(len(table) - 1 - back)
        places.append(b)
    chosen = table[kept[::-1]]
    chosen[:, 4] = places[::-1]
    return chosen


def _extracted(function: TapeFunction) -> tuple[NDArray[np.int32], NDArray, int]:
    reduced = function.reduced
    constants: list[float] = []
    steps = list(_steps(reduced, constants))
    table = np.array(steps, dtype=np.int32).reshape(-1, 5)
    return table, np.array(constants), int(reduced.sz_w())


def _steps(f: ca.Function, constants: list[float]) -> Iterator[tuple[int, int, int, int, int]]:
    places = [row_by_row(f.sparsity_out(k)) for k in range(f.n_out())]
    for k in range(f.n_instructions()):
        code = f.instruction_id(k)
        if code == ca.OP_CONST:
            constants.append(f.instruction_constant(k))
            yield CONSTANT, len(constants) - 1, f.instruction_output(k)[0], 0, 0
        elif code in BINARY:
            a, b = f.instruction_input(k)
            yield BINARY_OP, code, f.instruction_output(k)[0], a, b
        elif code in UNARY:
            yield UNARY_OP, code, f.instruction_output(k)[0], f.instruction_input(k)[0], 0
        elif code == ca.OP_OUTPUT:
            output, nonzero = f.instruction_output(k)
            yield WRITE, 0, f.instruction_input(k)[0], output, places[output][nonzero]
        elif code == ca.OP_INPUT:
            source, component = f.instruction_input(k)
            yield READ, 0, f.instruction_output(k)[0], source, component
        else:
            raise NotImplementedError(
                f"CasADi operation {code} has no numpy counterpart in the tape"
            )
