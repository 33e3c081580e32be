"""Out of a local optimum: exchange again after a few poses were changed at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from elastocal.design.exact.exchange import IMPROVEMENT, Exchanged, exchange
from elastocal.design.exact.pool import admissible, without
from elastocal.design.exact.regular import is_regular
from elastocal.design.problem import DesignProblem, IntArray

# Changes in vain after which a start is done, and how many poses each of them moves at most.
PATIENCE = 12
MOVED = 8
# Order of the power means that stand for a maximum: smooth, and within a few per cent of it.
SOFT = 30.0


def search(problem: DesignProblem, chosen: IntArray, rng: np.random.Generator) -> Exchanged:
    """Iterated local search (Lourenço, Martin & Stützle 2003) from a regular plan `chosen`.

    The best plan so far is changed in two to MOVED poses and exchanged anew, until PATIENCE
    changes in a row led to nothing better.  An exchange optimum is left where the better plan
    differs by two poses or more, which no single exchange can see.
    """
    best = _descended(problem, chosen)
    passes, failed = best.passes, 0
    while failed < PATIENCE:
        changed = _changed(problem, best.chosen, rng)
        failed += 1
        if not is_regular(problem.prior + problem.sum_of(changed)):
            continue
        found = _descended(problem, changed)
        passes += found.passes
        if found.value < best.value * (1 - IMPROVEMENT):
            best, failed = found, 0
    return Exchanged(best.chosen, best.value, passes)


def _descended(problem: DesignProblem, chosen: IntArray) -> Exchanged:
    """Exchanges on the softened criterion first, where Φ has kinks.

    What lowers a maximum is shut out wherever two of its arguments are equal and each exchange
    raises one of them; the softened criterion weighs them against each other.
    """
    passes, smooth = 0, problem.criterion.softened(SOFT)
    if smooth is not problem.criterion:
        first = exchange(replace(problem, criterion=smooth), chosen)
        chosen, passes = first.chosen, first.passes
    found = exchange(problem, chosen)
    return replace(found, passes=found.passes + passes)


def _changed(problem: DesignProblem, chosen: IntArray, rng: np.random.Generator) -> IntArray:
    """The plan with some of its poses replaced by random ones of their groups."""
    n = len(chosen)
    moved = rng.choice(chosen, min(int(rng.integers(2, MOVED + 1)), n), replace=False)
    for out in moved:
        rest = without(chosen, out)
        into = rng.choice(admissible(problem, rest, int(problem.group[out])))
        chosen = np.sort(np.append(rest, into))
    return chosen
