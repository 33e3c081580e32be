"""URScript of Universal Robots: a function of movej moves."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from elastocal.design.order.execution import Execution
from elastocal.design.programs.steps import ChangeLoad, Measure, Move, check_six_axes, steps_of
from elastocal.design.programs.text import number, plain
from elastocal.errors import require
from elastocal.manipulator.chain import Chain

Array = NDArray[np.float64]

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
SPEED, ACCELERATION = 0.5, 0.5  # rad/s, rad/s² of the leading axis


def urscript_program(
    execution: Execution,
    chain: Chain,
    configurations: Sequence[str],
    forces: Array | None = None,
    *,
    name: str = "elastocal_plan",
    speed: float = SPEED,
    acceleration: float = ACCELERATION,
) -> str:
    """The text of a script: moves, sleep where the tracker measures, a popup for the load.

    Joint values in rad, in the order of the chain; `speed` rad/s and `acceleration` rad/s² of
    the leading axis.  Moves are without blend radius, so the checked paths are those that are
    driven.  Raises InputError for an arm of other joints than six revolute ones, for a name that
    is no function's name, and for a speed or acceleration below 0.001.
    """
    check_six_axes(chain, "URScript")
    require(
        NAME.fullmatch(name) is not None,
        f"{name!r} is no name of a URScript function; use letters, digits and underscores",
    )
    require(
        speed >= 1e-3 and acceleration >= 1e-3,
        f"speed and acceleration must be at least 0.001; found {speed:g} and {acceleration:g}",
    )
    lines = [
        f"# elastocal: {len(execution.stops)} readings of robot {plain(chain.name)}",
        "# Joint values in rad as the robot description counts them: before the first run,",
        "# compare signs and zeros with the controller, and run at reduced speed.",
        "# The first move begins wherever the arm stands; only the moves after it were checked.",
        f"def {name}():",
    ]
    motion = f"a={number(acceleration, 4)}, v={number(speed, 4)}"
    for step in steps_of(execution, configurations, forces):
        match step:
            case Move(q, note):
                joints = ", ".join(number(v, 9) for v in q)
                lines += [f"  # {plain(note)}", f"  movej([{joints}], {motion})"]
            case ChangeLoad(order):
                text = plain(order)
                lines.append(f'  popup("{text}, then continue", title="Load", blocking=True)')
            case Measure(dwell, note):
                lines += [f'  textmsg("measure {plain(note)}")', f"  sleep({number(dwell, 3)})"]
    return "\n".join([*lines, "end", "", f"{name}()"]) + "\n"
