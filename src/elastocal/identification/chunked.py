"""Passes over a table in parts: B is formed, used and dropped, one part at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from elastocal.identification.partition import Part, Partition
from elastocal.identification.triangle import Triangle, merge
from elastocal.manipulator.model import Model, Regression

Array = NDArray[np.float64]
Item = TypeVar("Item")
Result = TypeVar("Result")

# Two parts at a time: one is evaluated while the other is factorised (measured: a third one only
# waits for the interpreter, and each costs the memory of a part).
AT_ONCE = 2


@dataclass(frozen=True)
class Evaluation:
    """Residual (rows,), observed minus predicted and raw, and the triangle of whitened B and it.

    `wide` is the triangle of more columns, where they were evaluated with it.
    """

    residual: Array
    triangle: Triangle
    wide: Triangle | None = None


def evaluate(model: Model, parts: Partition, x: Array, columns: NDArray[np.integer]) -> Evaluation:
    """B of the `columns` at x and the residual, whitened and reduced to a triangle.

    Raises ElastocalError where a reading has no static equilibrium at x.
    """
    residual = np.empty(len(parts.seen.value))

    def reduced(part: Part) -> Triangle:
        at = regressor(model, part, x, columns)
        residual[part.rows] = at.residual
        return Triangle.of(part.weights.apply(at.B), part.weights.apply(at.residual))

    return Evaluation(residual, merge(each(parts, reduced)))


def residual_at(model: Model, parts: Partition, x: Array) -> Array:
    """Observed minus predicted (rows,) at x; NaN in readings without equilibrium."""
    residual = np.empty(len(parts.seen.value))

    def predicted(part: Part) -> None:
        seen = part.observations
        residual[part.rows] = seen.value - model.predict(seen.table, x, seen)

    for _ in each(parts, predicted):
        pass
    return residual


def regressor(model: Model, part: Part, x: Array, columns: NDArray[np.integer]) -> Regression:
    """B of a part, raw."""
    return model.regressor(part.observations.table, x, columns, part.observations)


def each(parts: Partition, work: Callable[[Part], Result]) -> Iterator[Result]:
    """`work` on every part, results in order."""
    return in_order(parts.spans, lambda span: work(parts.part(span)))


def in_order(items: Sequence[Item], work: Callable[[Item], Result]) -> Iterator[Result]:
    """`work` on every item, AT_ONCE at a time; results in the order of the items.

    What the results add up to so does not depend on which item is done first.  The first item is
    done alone: it builds what the others share (the model's tapes).
    """
    yield work(items[0])
    if len(items) == 1:
        return
    pool = ThreadPoolExecutor(AT_ONCE)
    try:
        yield from pool.map(work, items[1:])
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
