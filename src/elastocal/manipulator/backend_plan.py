"""In which order a tape's instructions are replayed, and where their operands stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend_instructions import BINARY_OP, CONSTANT, READ, WRITE
from elastocal.manipulator.backend_operations import BINARY, ON_NUMBERS, UNARY

# A function, the slots of its first and second operand (−1: none) and of its result.
Step = tuple[Any, int, int, int]


class Plan:
    """What a tape does where the inputs `by_row` vary by row and the others do not.

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
        self.once: list[Step] = []
        self.constants: list[tuple[int, int]] = []
        self.first_common = free = ends[-1]
        steps: list[Step] = []  # every result under a number of its own, from `unplaced` on
        unplaced = free + len(table)
        value: dict[int, int] = {}  # what a register of the table holds at this instruction
        home: dict[int, int] = {}  # the output's slot where a result is put out
        for kind, code, out, a, b in table.tolist():
            if kind == READ:
                value[out] = ends[a] + b
            elif kind == WRITE:
                source, place = value[out], ends[len(by_row) + a] + b
                if source >= unplaced and source not in home:
                    home[source] = place
                else:
                    steps.append((np.positive, source, -1, place))
            elif kind == CONSTANT:
                self.constants.append((free, code))
                value[out], free = free, free + 1
            else:
                binary = kind == BINARY_OP
                operation = BINARY[code] if binary else UNARY[code]
                first, second = value[a], value[b] if binary else -1
                if _varies(first, ends, by_row, unplaced) or (
                    binary and _varies(second, ends, by_row, unplaced)
                ):
                    value[out] = unplaced + len(steps)
                    steps.append((operation, first, second, value[out]))
                else:
                    operation = ON_NUMBERS.get(operation, operation)
                    self.once.append((operation, first, second, free))
                    value[out], free = free, free + 1
        self.n_common = free - self.first_common
        self.steps, self.n_registers = _placed(steps, home, unplaced, free)
        read = {slot for _, first, second, _ in steps for slot in (first, second)}
        self.shared = sorted(slot for slot in read if self.first_common <= slot < free)


def _varies(source: int, ends: Sequence[int], by_row: Sequence[bool], unplaced: int) -> bool:
    """Whether a value differs from row to row: results of steps, and some of the inputs."""
    if source >= unplaced:
        return True
    return any(ends[k] <= source < ends[k + 1] for k, varies in enumerate(by_row) if varies)


def _placed(
    steps: Sequence[Step], home: dict[int, int], unplaced: int, first: int
) -> tuple[list[Step], int]:
    """The steps with their results in output slots and registers `first`…, and how many of these.

    A register is free after the last step that reads it, and what became free last is taken
    first: it is in cache.
    """
    last = {slot: k for k, step in enumerate(steps) for slot in step[1:3]}
    slot_of = dict(home)
    placed, unused, count = [], [], 0
    for k, (operation, a, b, out) in enumerate(steps):
        operands = [slot_of.get(v, v) for v in (a, b)]
        for v in {a, b}:
            if v >= unplaced and v not in home and last[v] == k:
                unused.append(slot_of[v])
        if out >= unplaced and out not in home:
            if not unused:
                unused.append(first + count)
                count += 1
            slot_of[out] = unused.pop()
        placed.append((operation, *operands, slot_of.get(out, out)))
    return placed, count
