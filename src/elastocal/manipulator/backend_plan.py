"""In which order a tape's instructions are replayed, and where their operands stand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.manipulator.backend_instructions import BINARY_OP, CONSTANT, READ, UNARY_OP
from elastocal.manipulator.backend_operations import BINARY, ON_NUMBERS, UNARY


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
