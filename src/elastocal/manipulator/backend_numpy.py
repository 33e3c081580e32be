"""A tape replayed on numpy arrays, one numpy call per instruction and block of rows.

A CasADi `SX` function is a list of scalar instructions.  Replaying each instruction once on an
array of all poses costs one numpy call per instruction and block instead of one CasADi call per
pose, and the same replay runs on complex arrays, which complex-step checks use.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend_function import TapeFunction
from elastocal.manipulator.backend_instructions import instructions, of_columns
from elastocal.manipulator.backend_plan import Plan


class Replay:
    """A tape's instructions, and `evaluate`, which replays them on whole blocks of rows.

    `n_registers` is the most that any plan needs.  Raises NotImplementedError for a CasADi
    operation that numpy has no counterpart for.
    """

    def __init__(
        self, function: TapeFunction, whole: Replay | None = None, columns: Sequence[int] = ()
    ) -> None:
        """`whole`, where given, replays the same with more columns in its last output: of its
        instructions, those for `columns` are taken instead of asking CasADi again."""
        self.shapes = function.shapes
        if whole is None:
            self._table, self._constants, self.n_registers = instructions(function)
        else:
            output, (_, width) = len(whole.shapes) - 1, whole.shapes[-1]
            self._table = of_columns(whole._table, output, width, columns)
            self._constants, self.n_registers = whole._constants, whole.n_registers
        widths = [*function.sizes, *[rows * columns for rows, columns in function.shapes]]
        self._ends = [int(end) for end in np.cumsum([0, *widths])]
        self._plans: dict[tuple[bool, ...], Plan] = {}

    def _plan(self, by_row: tuple[bool, ...]) -> Plan:
        if by_row not in self._plans:
            self._plans[by_row] = Plan(self._table, self._ends, by_row)
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

    def _in_common(self, plan: Plan, inputs: Sequence[NDArray]) -> list[Any]:
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
