"""The order of execution of a selection, and what becomes of poses that no move reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from elastocal.design.feasibility.feasibility import Feasibility
from elastocal.design.order.blockers import Blockers
from elastocal.design.order.execution import Execution
from elastocal.design.order.reach import Unreachable
from elastocal.design.order.schedule import schedule
from elastocal.design.select import Selection
from elastocal.design.setup import Pool, Setup
from elastocal.manipulator.limits import joint_limits

IntArray = NDArray[np.int64]
Progress = Callable[[str], None]

MOST_REPLACED = 50  # poses that cannot be reached, before that is said instead
VIA = 200  # candidates through which a blocked move may go


def ordered(
    setup: Setup,
    found: Selection,
    shares: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
) -> tuple[Selection, Execution, list[str]]:
    """The selection in the order of its levels, its execution, and warnings.

    Poses that no chain of free moves reaches are replaced by the best others.  Raises
    InsufficientDataError where that does not end.
    """
    lost = 0
    while True:
        # In the order of levels, so that the table reads like Table 2.
        chosen = found.chosen[np.lexsort((found.chosen, found.pool.group[found.chosen]))]
        try:
            execution = _execution(setup, found.pool, chosen, feasibility, seed, progress)
        except Unreachable as error:
            if lost >= MOST_REPLACED:
                raise
            lost += len(error.poses)
            found = found.without(np.unique(chosen[error.poses]), setup, shares)
            continue
        return replace(found, chosen=chosen), execution, _warnings(lost, execution)


def _execution(
    setup: Setup,
    pool: Pool,
    chosen: IntArray,
    feasibility: Feasibility,
    seed: int,
    progress: Progress,
) -> Execution:
    cell, states = feasibility.cell, setup.information.states
    return schedule(
        pool.q[chosen], cell.design.motion, feasibility,
        loads=states.forces,
        load=pool.load[chosen] if states.chosen else None,
        limits=joint_limits(cell, feasibility.chain),
        via=pool.q[:: max(len(pool) // VIA, 1)],
        blockers=Blockers(feasibility),
        seed=seed, progress=progress,
    )  # fmt: skip


def _warnings(lost: int, execution: Execution) -> list[str]:
    warnings = []
    if lost:
        warnings.append(f"{lost} better poses were left out, as no free move reaches them")
    if execution.one_sided:
        told = ", ".join(str(k + 1) for k in execution.one_sided)
        warnings.append(f"approached from one side only, as the other is blocked: {told}")
    return warnings
