"""In which order a tape's instructions are replayed, and where their operands stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend_instructions import BINARY_OP, CONSTANT, READ, WRITE
from elastocal.manipulator.backend_operations import BINARY, UNARY

# A numpy function, the slots of its first and second operand (−1: none) and of its result.
Step = tuple[Any, int, int, int]


class Plan:
    """What a tape does where the inputs `by_row` vary by row and the others do not.

    Slots hold, in this order: registers, components of the inputs, components of the outputs,
    and every value that is the same in all rows.  `once` makes the latter; `steps` is what
    remains for a block of rows, `constants` the slots of constants with their numbers.
    """

    def __init__(
        self, table: NDArray[np.int32], ends: Sequence[int], by_row: Sequence[bool]
    ) -> None:
        """`ends`: first slot of every input, of every output, and of the values in common."""
        self.once: list[Step] = []
        self.steps: list[Step] = []
        self.constants: list[tuple[int, int]] = []
        self.first_common = free = ends[-1]
        slot = list(range(ends[0]))  # where each register's value stands
        varies = [False] * ends[0]
        for kind, code, out, a, b in table.tolist():
            if kind == READ:
                slot[out], varies[out] = ends[a] + b, by_row[a]
            elif kind == WRITE:
                self.steps.append((np.positive, slot[out], -1, ends[len(by_row) + a] + b))
            elif kind == CONSTANT:
                self.constants.append((free, code))
                slot[out], varies[out], free = free, False, free + 1
            else:
                binary = kind == BINARY_OP
                operation = BINARY[code] if binary else UNARY[code]
                first, second = slot[a], slot[b] if binary else -1
                if varies[a] or (binary and varies[b]):
                    self.steps.append((operation, first, second, out))
                    slot[out], varies[out] = out, True
                else:
                    self.once.append((operation, first, second, free))
                    slot[out], varies[out], free = free, False, free + 1
        self.n_common = free - self.first_common
