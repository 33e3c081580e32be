"""Columns of effects whose other parameters say nothing while the first is zero.

The geometry of a spring has no derivative at stiffness zero.  So the stiffness is estimated for
each start that the effect proposes, the best start is kept, and the geometry's columns are those
at that stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import observe

Array = NDArray[np.float64]

ROWS = 3000  # of the equations, as many as tell one start from another


def with_tangents(
    whole: Model, hypotheses: list[Hypothesis], base: Baseline, x: Array, B: Array
) -> Array:
    """B (n_rows, size, K) with the columns of such hypotheses replaced where x (K,) has none."""
    for h in hypotheses:
        own = own_columns(whole, h)
        shown = np.abs(B[:, :, own]).max(axis=(0, 1)) > 0
        if shown.all() or shown.sum() != 1:
            continue
        best = min(tangents(whole, h, base, x, B), key=lambda t: t.left)
        B = B.copy()
        B[:, :, own] = best.columns
    return B


@dataclass(frozen=True)
class Tangent:
    """Columns (n_rows, size, k) of an effect about one of its starts, at the amplitude that the
    residual asks for, and what is `left` of the residual's sum of squares."""

    left: float
    columns: Array


def tangents(whole: Model, h: Hypothesis, base: Baseline, x: Array, B: Array) -> Iterator[Tangent]:
    """One for each start that the effect proposes; x (K,) and B (n_rows, size, K) of `whole`.

    The effect's first parameter is the amplitude that the others have no columns without.
    """
    table, model = base.seen.table, base.model
    seen = observe(table, whole.observe)
    names = {name: k for k, name in enumerate(whole.names)}
    fitted, own = [names[name] for name in model.names], own_columns(whole, h)
    X = base.seen.apply(B[:, :, fitted]).reshape(len(base.residual), -1) * base.sizes
    # What is only planned has no residual yet that a spring could answer for.
    last = base.n_measured * base.seen.size - 1
    rows = np.unique(np.linspace(0, last, min(ROWS, last + 1)).astype(int))
    for start in h.effect.starts(h.where, model.chain, model.cell) or ({},):
        at = x.copy()
        for key, value in start.items():
            at[names[f"{h.where}.{key}"]] = value
        column = whole.regressor(table, at, np.array(own[:1]), seen).B
        c = base.seen.apply(column.reshape(len(table), seen.size, 1)).ravel()
        size = max(float(np.abs(c).max()), 1e-300)
        A = np.column_stack([X, c / size])[rows]
        solution, *_ = np.linalg.lstsq(A, base.residual[rows], rcond=1e-9)
        at[own[0]] += solution[-1] / size
        columns = whole.regressor(table, at, np.array(own), seen).B
        columns = columns.reshape(len(table), seen.size, -1)
        columns[:, :, 0] = column.reshape(len(table), seen.size)
        yield Tangent(float(((base.residual[rows] - A @ solution) ** 2).sum()), columns)


def own_columns(whole: Model, h: Hypothesis) -> list[int]:
    """Where the hypothesis' parameters stand among those of `whole`."""
    return [k for k, p in enumerate(whole.parameters) if (p.effect, p.where) == (h.name, h.where)]
