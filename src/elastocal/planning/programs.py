"""Robot programs of a plan: KRL and URScript."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from elastocal.errors import InputError, require
from elastocal.model.chain import Chain
from elastocal.planning.execution import Execution
from elastocal.units import Array

# Text and numbers as robot controllers read them.


def plain(text: str) -> str:
    """One line of printable ASCII without quotation marks, so that it can stand in a comment or
    a string of any controller; other characters become ?, quotation marks apostrophes."""
    line = " ".join(text.split()).replace('"', "'")
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in line)


def number(value: float, digits: int) -> str:
    """Decimal digits without exponent; no negative zero."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


# An execution as a list of what a robot program does: move, have the load changed, measure.

AXES = 6
TAKE_OFF = "take the load off"


# A move to joints (n,) rad with a note on what is there; a stop until someone has done what an
# order says; a stop of so many s while the tracker measures what the note says.
Step = (
    tuple[Literal["move"], Array, str]
    | tuple[Literal["load"], str]
    | tuple[Literal["measure"], float, str]
)


def steps_of(
    execution: Execution, configurations: Sequence[str], forces: Array | None = None
) -> Iterator[Step]:
    """Every step in order, beginning and ending at home where there is one.

    `configurations`: a name per pose; `forces` (L, 3) N per load state, None: no load at all.
    """
    loads = ["no load"] if forces is None else [load_name(force) for force in forces]
    loaded = [False] if forces is None else [bool(np.any(force)) for force in forces]
    home = execution.motion.home
    if home is not None:
        yield "move", home, "home"
    for stop in execution.stops:
        name = f"configuration {configurations[stop.pose]}"
        steps: list[Step] = [("move", q, "via point, not measured") for q in stop.via]
        steps.append(("move", stop.q, name))
        if stop.change_after is not None:
            hang = f"hang the {loads[stop.load]}" if loaded[stop.load] else TAKE_OFF
            steps.insert(stop.change_after, ("load", hang))
        yield from steps
        side = "" if stop.approach is None else f", approached from {('below', 'above')[stop.side]}"
        yield "measure", execution.motion.dwell, f"{name}, {loads[stop.load]}{side}"
    if execution.take_off:
        yield "load", TAKE_OFF
    if home is not None:
        for q in execution.home_via:
            yield "move", q, "via point, not measured"
        yield "move", home, "home"


def load_name(force: Array) -> str:
    """The load state in words: its force in N in the data's frame."""
    if not np.any(force):
        return "no load"
    return "load of ({:g}, {:g}, {:g}) N".format(*np.asarray(force, dtype=float) + 0.0)


def check_six_axes(chain: Chain, language: str) -> None:
    """Raise InputError unless the arm has six revolute joints, which is what `language` moves."""
    sliding = [joint.name for joint in chain.joints if joint.kind != "revolute"]
    if chain.n_joints != AXES or sliding:
        what = f"joint {', '.join(sliding)} slides" if sliding else f"it has {chain.n_joints}"
        raise InputError(
            f"robot '{chain.name}': a {language} program moves arms of {AXES} revolute joints, but "
            f"{what}; external axes are not written: take the joint values from the plan's table"
        )


# KUKA robot language: a .src file of PTP moves in axis angles.

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
            case "move", q, note:
                angles = ", ".join(f"A{i + 1} {number(v, 6)}" for i, v in enumerate(np.degrees(q)))
                lines += [f"; {plain(note)}", f"PTP {{{angles}}}"]
            case "load", order:
                lines += [f"; {plain(order)}, then start again", "HALT"]
            case "measure", dwell, note:
                lines += [f"; measure {plain(note)}", f"WAIT SEC {number(dwell, 3)}"]
    return "\n".join([*lines, "END"]) + "\n"


# URScript of Universal Robots: a function of movej moves.

URSCRIPT_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
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
        URSCRIPT_NAME.fullmatch(name) is not None,
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
            case "move", q, note:
                joints = ", ".join(number(v, 9) for v in q)
                lines += [f"  # {plain(note)}", f"  movej([{joints}], {motion})"]
            case "load", order:
                text = plain(order)
                lines.append(f'  popup("{text}, then continue", title="Load", blocking=True)')
            case "measure", dwell, note:
                lines += [f'  textmsg("measure {plain(note)}")', f"  sleep({number(dwell, 3)})"]
    return "\n".join([*lines, "end", "", f"{name}()"]) + "\n"
