"""KUKA robot language: a .src file of PTP moves in axis angles."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.execution import Execution
from elastocal.design.programs.steps import (
    AXES,
    ChangeLoad,
    Measure,
    Move,
    check_six_axes,
    steps_of,
)
from elastocal.design.programs.text import number, plain
from elastocal.errors import require
from elastocal.manipulator.chain import Chain

Array = NDArray[np.float64]

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,23}", re.ASCII)
PERCENT = 10  # of the axes' greatest speed and acceleration


def krl_program(
    execution: Execution,
    chain: Chain,
    configurations: Sequence[str],
    forces: Array | None = None,
    *,
    name: str = "elastocal_plan",
    percent: int = PERCENT,
) -> str:
    """The text of NAME.src: moves, WAIT SEC where the tracker measures, HALT for the load.

    Axis angles are the plan's joint values in degrees, A1 … A6 being joints 1 … 6.  `percent` of
    the axes' greatest speed and acceleration.  Moves are exact stops (no C_PTP), so the checked
    paths are those that are driven.  No .dat file is needed.  Raises InputError for an arm of
    other joints than six revolute ones, and for a name that is no module's name.
    """
    check_six_axes(chain, "KRL")
    require(
        NAME.fullmatch(name) is not None,
        f"{name!r} is no name of a KRL module, which is also its file's name; use a letter and up "
        "to 23 letters, digits or underscores",
    )
    require(1 <= percent <= 100, f"the speed is 1 to 100 % of the axes' greatest; found {percent}")
    lines = [
        "&ACCESS RVP",
        "&REL 1",
        f"DEF {name}()",
        f"; elastocal: {len(execution.stops)} readings of robot {plain(chain.name)}",
        "; Axis angles in degrees as the robot description counts them: before the first run,",
        "; compare signs and zeros with the controller, and run in T1.",
        "; The first move begins wherever the arm stands; only the moves after it were checked.",
        "DECL INT AXIS_NO",
        f"FOR AXIS_NO = 1 TO {AXES}",
        f"  $VEL_AXIS[AXIS_NO] = {percent}",
        f"  $ACC_AXIS[AXIS_NO] = {percent}",
        "ENDFOR",
    ]
    for step in steps_of(execution, configurations, forces):
        match step:
            case Move(q, note):
                angles = ", ".join(f"A{i + 1} {number(v, 6)}" for i, v in enumerate(np.degrees(q)))
                lines += [f"; {plain(note)}", f"PTP {{{angles}}}"]
            case ChangeLoad(order):
                lines += [f"; {plain(order)}, then start again", "HALT"]
            case Measure(dwell, note):
                lines += [f"; measure {plain(note)}", f"WAIT SEC {number(dwell, 3)}"]
    return "\n".join([*lines, "END"]) + "\n"
