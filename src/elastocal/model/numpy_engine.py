"""A CasADi function evaluated with numpy: one array call per instruction and block of rows."""

from __future__ import annotations

import io
import operator
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.model.function_cache import HashedFunction, content_key, fetch, row_by_row, store

# CasADi's scalar operations as numpy functions of arrays, real or complex.


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
    def evaluate(a: Any, b: Any, out: Any = None) -> Any:
        return np.multiply(compare(a, b), 1.0, out=out)

    return evaluate


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
# The same on single numbers, where Python's operators take a tenth of the time of a numpy function.
# Not division: Python refuses to divide by zero.
ON_NUMBERS: dict[Any, Any] = {
    np.negative: operator.neg, np.add: operator.add, np.subtract: operator.sub,
    np.multiply: operator.mul,
}  # fmt: skip


# CasADi's instructions of a function as arrays, kept in the cache where asking for them takes long.

CONSTANT, READ, WRITE, UNARY_OP, BINARY_OP = range(5)
SUFFIX = ".tape.npz"
# Asking CasADi for its instructions takes 15 µs for each, with their common subexpressions; what
# is made in less than 50 ms is not worth a file.
SMALLEST_CACHED = 4000


def instructions(function: HashedFunction) -> tuple[NDArray[np.int32], NDArray, int]:
    """Instructions (m, 5), constants (c,) and number of registers of a function; cached when long.

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
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            pass  # another process removed it, or it is none of ours
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


def _extracted(function: HashedFunction) -> tuple[NDArray[np.int32], NDArray, int]:
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
            raise NotImplementedError(f"CasADi operation {code} has no numpy counterpart")


# In which order instructions are carried out, and where their operands stand.


@dataclass(frozen=True)
class Steps:
    """Functions, the slots of their first and second operands (−1: none) and of their results.

    Four lists and not a tuple for every step: thousands of these would have Python look for
    garbage in all that is loaded, 0.07 s each time.
    """

    operation: list[Any] = field(default_factory=list)
    first: list[int] = field(default_factory=list)
    second: list[int] = field(default_factory=list)
    out: list[int] = field(default_factory=list)

    def add(self, operation: Any, first: int, second: int, out: int) -> None:
        self.operation.append(operation)
        self.first.append(first)
        self.second.append(second)
        self.out.append(out)

    def __len__(self) -> int:
        return len(self.out)

    def __iter__(self) -> Iterator[tuple[Any, int, int, int]]:
        return zip(self.operation, self.first, self.second, self.out, strict=True)


class EvaluationOrder:
    """What is done where the inputs `by_row` vary by row and the others do not.

    Slots hold, in this order: components of the inputs, components of the outputs, every value
    that is the same in all rows, and `n_registers` registers.  `constants` are the slots of
    constants with their numbers, `once` makes the other values in common, and `shared` lists
    those of both that rows need.  `steps` is what remains for a block of rows; a value that is an
    output is computed where it is put out.
    """

    def __init__(
        self, table: NDArray[np.int32], ends: Sequence[int], by_row: Sequence[bool]
    ) -> None:
        """`ends`: first slot of every input, of every output, and of the values in common."""
        self.once = Steps()
        self.constants: list[tuple[int, int]] = []
        self.first_common = free = ends[-1]
        steps = Steps()  # the k-th result of all rows is value `unplaced` + k
        unplaced = free + len(table)
        varies = [False] * unplaced  # of inputs and of values in common; results all do
        for k, rows in enumerate(by_row):
            varies[ends[k] : ends[k + 1]] = [rows] * (ends[k + 1] - ends[k])
        value = [0] * (1 + int(table[:, 2].max(initial=0)))  # what a register holds now
        home: dict[int, int] = {}  # the output's slot where a result is put out
        copies: list[tuple[int, int]] = []
        # Column by column: a list per instruction is garbage that the collector would count.
        for kind, code, out, a, b in zip(*(column.tolist() for column in table.T), strict=True):
            if kind >= UNARY_OP:
                first, second = value[a], -1
                per_row = first >= unplaced or varies[first]
                if kind == BINARY_OP:
                    second, operation = value[b], BINARY[code]
                    per_row = per_row or second >= unplaced or varies[second]
                else:
                    operation = UNARY[code]
                if per_row:
                    value[out] = unplaced + len(steps)
                    steps.add(operation, first, second, value[out])
                else:
                    operation = ON_NUMBERS.get(operation, operation)
                    self.once.add(operation, first, second, free)
                    value[out], free = free, free + 1
            elif kind == READ:
                value[out] = ends[a] + b
            elif kind == CONSTANT:
                self.constants.append((free, code))
                value[out], free = free, free + 1
            else:
                source, place = value[out], ends[len(by_row) + a] + b
                if source >= unplaced and source not in home:
                    home[source] = place
                else:
                    copies.append((home.get(source, source), place))
        self.n_common = free - self.first_common
        self.steps, self.n_registers = _placed(steps, home, unplaced, free)
        for source, place in copies:
            self.steps.add(np.positive, source, -1, place)
        read = {*self.steps.first, *self.steps.second}
        self.shared = sorted(slot for slot in read if self.first_common <= slot < free)


def _placed(steps: Steps, home: dict[int, int], unplaced: int, first: int) -> tuple[Steps, int]:
    """The steps with their results in output slots and registers `first`…, and how many of these.

    A register is free after the last step that reads it, and what became free last is taken
    first: it is in cache.
    """
    last = {slot: k for k, pair in enumerate(zip(steps.first, steps.second, strict=True))
            for slot in pair}  # fmt: skip
    slot_of = dict(home)
    placed = Steps()
    unused: list[int] = []
    count = 0
    for k, (operation, a, b, out) in enumerate(steps):
        x, y = a, b
        if a >= unplaced:
            x = slot_of[a]
            if x >= first and last[a] == k:
                unused.append(x)
        if b >= unplaced:
            y = slot_of[b]
            if y >= first and last[b] == k and b != a:
                unused.append(y)
        if out not in slot_of:
            if not unused:
                unused.append(first + count)
                count += 1
            slot_of[out] = unused.pop()
        placed.add(operation, x, y, slot_of[out])
    return placed, count


# Instructions carried out on numpy arrays, one call per instruction and block of rows.
#
# A CasADi `SX` function is a list of scalar instructions.  Carrying out each once on an
# array of all poses costs one numpy call per instruction and block instead of one CasADi call per
# pose, and the same runs on complex arrays, which complex-step checks use.


class NumpyFunction:
    """Instructions, and `evaluate`, which carries them out on whole blocks of rows.

    `n_registers` is the most that any plan needs.  Raises NotImplementedError for a CasADi
    operation that numpy has no counterpart for.
    """

    def __init__(
        self,
        function: HashedFunction,
        wider: NumpyFunction | None = None,
        columns: Sequence[int] = (),
    ) -> None:
        """`wider`, where given, evaluates the same with more columns in its last output: of its
        instructions, those for `columns` are taken instead of asking CasADi again."""
        self.shapes = function.shapes
        if wider is None:
            self._table, self._constants, self.n_registers = instructions(function)
        else:
            output, (_, width) = len(wider.shapes) - 1, wider.shapes[-1]
            self._table = of_columns(wider._table, output, width, columns)
            self._constants, self.n_registers = wider._constants, wider.n_registers
        widths = [*function.sizes, *[rows * columns for rows, columns in function.shapes]]
        self._ends = [int(end) for end in np.cumsum([0, *widths])]
        self._plans: dict[tuple[bool, ...], EvaluationOrder] = {}

    def _plan(self, by_row: tuple[bool, ...]) -> EvaluationOrder:
        if by_row not in self._plans:
            self._plans[by_row] = EvaluationOrder(self._table, self._ends, by_row)
        return self._plans[by_row]

    def evaluate(
        self, inputs: Sequence[NDArray], results: Sequence[NDArray], blocks: Sequence[slice]
    ) -> None:
        """Rows of `blocks` of `results` (n, rows, columns), all of one type."""
        if not results:
            return
        plan = self._plan(tuple(a.ndim == 2 for a in inputs))
        common = self._in_common(plan, inputs)
        size = max((block.stop - block.start for block in blocks), default=0)
        buffer = np.empty((plan.n_registers, size), dtype=results[0].dtype)
        flat = [r.reshape(len(r), r.shape[1] * r.shape[2]) for r in results]
        stage = [np.zeros((f.shape[1], size), dtype=f.dtype) for f in flat]
        for block in blocks:
            m = block.stop - block.start
            slots: list[Any] = []
            for a in inputs:
                slots += list(a[block].T.copy()) if a.ndim == 2 else _cells(a)
            for s in stage:
                slots += list(s[:, :m])
            slots += common
            slots += list(buffer[:, :m])
            for operation, first, second, out in plan.steps:
                if second >= 0:
                    operation(slots[first], slots[second], slots[out])
                else:
                    operation(slots[first], slots[out])
            for f, s in zip(flat, stage, strict=True):
                f[block] = s[:, :m].T

    def _in_common(self, plan: EvaluationOrder, inputs: Sequence[NDArray]) -> list[Any]:
        """The values that are the same in all rows; None where only `plan.once` reads them."""
        slots: list[Any] = [None] * (plan.first_common + plan.n_common)
        for start, a in zip(self._ends, inputs, strict=False):
            if a.ndim == 1:
                slots[start : start + len(a)] = a.tolist()
        constants = self._constants.tolist()
        for place, k in plan.constants:
            slots[place] = constants[k]
        for operation, first, second, out in plan.once:
            if second >= 0:
                slots[out] = operation(slots[first], slots[second])
            else:
                slots[out] = operation(slots[first])
        common: list[Any] = [None] * plan.n_common
        for slot in plan.shared:
            # numpy takes arrays without axes faster than scalars.
            common[slot - plan.first_common] = np.asarray(slots[slot])
        return common


def _cells(a: NDArray) -> list[NDArray]:
    """The numbers of `a` (n,) as arrays without axes."""
    return [a[k, ...] for k in range(len(a))]
