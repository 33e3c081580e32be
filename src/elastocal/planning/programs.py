"""Robot programs of a plan: KRL and URScript, written, read back and compared with the plan.

A program moves a machine, so nothing of a file's names can become a line of it, every joint value
lies inside the robot's limits, speeds have a bound, and what was written is read again line by
line: another kind of line than those here, or a move that is off by more than 1e-6 rad, is an
error.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from typing import Literal

import numpy as np

from elastocal.messages import ElastocalError, InputError, newtons, printable, require, rounded
from elastocal.model.chain import Chain
from elastocal.planning.execution import Execution
from elastocal.units import Array

# Text and numbers as robot controllers read them.


def plain(text: str) -> str:
    """One line of printable ASCII without quotation marks, for comments and strings of
    controllers."""
    line = " ".join(text.split()).replace('"', "'").replace("\\", "/")[:LONGEST]
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in line)


def number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


# An execution as a list of what a robot program does: move, have the load changed, measure.

AXES = 6
TAKE_OFF = "take the load off"


# A move to joints (n,) rad with a note on what is there; a stop until someone has done what the
# note says; a stop of so many s (1,) while the tracker measures what the note says.
Step = tuple[Literal["move", "load", "measure"], Array, str]
VIA = "via point, not measured"


def steps_of(execution: Execution, configurations: Sequence[str], forces: Array) -> list[Step]:
    home, dwell, nothing = execution.motion.home, execution.motion.dwell, np.zeros(0)
    steps: list[Step] = [] if home is None else [("move", home, "home")]
    for stop in execution.stops:
        name, force = f"configuration {stop.name(configurations)}", forces[stop.load]
        load = f"load of {newtons(force)}" if force.any() else "no load"
        moves: list[Step] = [("move", q, VIA) for q in stop.via] + [("move", stop.q, name)]
        if stop.change_after is not None:
            hang = f"hang the {load}" if force.any() else TAKE_OFF
            moves.insert(stop.change_after, ("load", nothing, hang))
        side = "" if stop.approach is None else f", approached from {('below', 'above')[stop.side]}"
        part = ", once more" if stop.part else ""
        steps += [*moves, ("measure", np.array([dwell]), f"{name}, {load}{side}{part}")]
    if execution.take_off:
        steps.append(("load", nothing, TAKE_OFF))
    if home is not None:
        steps += [*(("move", q, VIA) for q in execution.home_via), ("move", home, "home")]
    return steps


LONGEST = 100  # characters of a note; controllers cut or refuse long lines
LONGEST_NAME = 24
# Words of both languages that no module or function can be called; upper and lower case alike.
RESERVED = frozenset(
    re.findall(
        r"\w+",
        """
        and break codes continue def do else elif end endfor endif endswitch endwhile
        enddat enddefct exit for function global goto halt if import in interrupt is
        local loop endloop main movec movej movel movep not on or pass popup print ptp
        lin circ pulse repeat resume return run signal sleep socket struct switch
        textmsg then thread to true false trigger until wait while with bool int real
        char frame axis e6axis pos e6pos decl const enum
        """,
    )
)


def program_name(text: str) -> str:
    """`text` reduced to a name that KRL and URScript allow, none of their own words."""
    ascii_only = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_]+", "_", ascii_only).strip("_")
    name = (name if name[:1].isalpha() else f"p_{name}")[:LONGEST_NAME].rstrip("_")
    return f"{name}_plan"[:LONGEST_NAME] if name.lower() in RESERVED or name == "p" else name


def driven(steps: Sequence[Step], lower: Array, upper: Array) -> list[Step]:
    """The steps, with moves to a limit so far inside that their last digit lies inside too."""
    for k, (kind, values, _) in enumerate(steps):
        if kind == "measure":
            require(0 <= values[0] <= LONGEST_STOP, f"a stop of {values[0]:g} s; give 0 to 86400 s")
        elif kind == "move":
            inside = (values >= lower - SAME) & (values <= upper + SAME)
            j = int(np.argmin(inside))
            value, low, high = np.degrees([values[j], lower[j], upper[j]])
            require(
                bool(inside[j]),
                f"step {k + 1} moves joint {j + 1} to {value:.6g}°, outside its limits "
                f"[{low:.6g}, {high:.6g}]°; give poses inside them",
            )
    inner = np.minimum(lower + DIGIT, upper), np.maximum(upper - DIGIT, lower)  # some stand still
    return [(kind, np.clip(v, *inner) if kind == "move" else v, note) for kind, v, note in steps]


def limits_text(lower: Array, upper: Array) -> str:
    shown = []
    for i, (low, high) in enumerate(zip(lower, upper, strict=True), 1):
        told = [f"from {rounded(math.degrees(low), 4)}"] if math.isfinite(low) else []
        told += [f"to {rounded(math.degrees(high), 4)}"] if math.isfinite(high) else []
        shown.append(f"J{i} {' '.join(told).removeprefix('from ' * (len(told) == 2)) or 'any'}")
    return ", ".join(shown)


# What was written, read back.

SAME = 1e-6  # rad, between a value of the plan and of the program
DIGIT = 1e-8  # rad, more than half of the last digit of a program, 1e-6° or 1e-9 rad
LONGEST_STOP = 86_400.0  # s
_NUMBER = r"-?[0-9]+(?:\.[0-9]+)?"
_NOTE = r"[ !#-\[\]-~]*"  # printable ASCII without quotation marks and backslashes
# Every kind of line that a program has; the first group of a move holds its numbers.
_KRL_LINES = {
    "move": rf"PTP \{{((?:A[1-6] {_NUMBER}(?:, )?){{6}})\}}",
    "load": "HALT",
    "measure": rf"WAIT SEC ({_NUMBER})",
    "": r"&ACCESS RVP|&REL 1|DEF \w+\(\)|END|DECL INT AXIS_NO|FOR AXIS_NO = 1 TO 6|ENDFOR"
    rf"|  \$(?:VEL|ACC)_AXIS\[AXIS_NO\] = [0-9]+|; {_NOTE}",
}
_URSCRIPT_LINES = {
    "move": rf"  movej\(\[((?:{_NUMBER}(?:, )?){{6}})\], a={_NUMBER}, v={_NUMBER}\)",
    "load": rf'  popup\("{_NOTE}", title="Load", blocking=True\)',
    "measure": rf"  sleep\(({_NUMBER})\)",
    "": rf'(?:  )?# {_NOTE}|def \w+\(\):|end||\w+\(\)|  textmsg\("{_NOTE}"\)',
}


def program_steps(text: str) -> list[tuple[str, Array]]:
    """The steps of a program that was written here: ("move", joints (6,) rad), ("load", empty) or
    ("measure", seconds (1,)), in their order."""
    krl = text.startswith("&ACCESS")
    kinds = _KRL_LINES if krl else _URSCRIPT_LINES
    steps = []
    for number_of, line in enumerate(text.removesuffix("\n").split("\n"), start=1):
        found = {k: m for k in kinds if (m := re.fullmatch(kinds[k], line, re.ASCII))}
        if not found:
            raise ElastocalError(
                f"the robot program's line {number_of} is none that is written: {printable(line)}; "
                "do not run it"
            )
        kind, match = next(iter(found.items()))
        if kind:
            held = re.findall(rf"(?<!A){_NUMBER}", match[1]) if match.re.groups else ()
            values = np.array([float(v) for v in held])
            steps.append((kind, np.radians(values) if krl and kind == "move" else values))
    return steps


def check_program(text: str, planned: Sequence[Step]) -> None:
    """Raise ElastocalError unless the program, read back, does what the plan's `steps_of` say:
    the same steps in the same order, every joint within 1e-6 rad, every stop within 1 ms."""
    found = program_steps(text)
    same = [kind for kind, _ in found] == [kind for kind, _, _ in planned]
    for (kind, values), (_, wanted, _) in zip(found, planned, strict=False):
        same = same and bool((np.abs(values - wanted) <= (SAME if kind == "move" else 1e-3)).all())
    if not same:
        raise ElastocalError("the robot program does not do what the plan says; do not run it")


def check_six_axes(chain: Chain, language: str) -> None:
    sliding = [joint.name for joint in chain.joints if joint.kind != "revolute"]
    if chain.n_joints != AXES or sliding:
        what = f"joint {', '.join(sliding)} slides" if sliding else f"it has {chain.n_joints}"
        raise InputError(
            f"robot '{chain.name}': a {language} program moves arms of {AXES} revolute joints, but "
            f"{what}; external axes are not written: take the joint values from the plan's table"
        )


# The two languages: what stands before, at and behind the steps.  Moves are exact stops, without
# blend, so that the checked paths are those that are driven.

PERCENT = 10  # of a KUKA's greatest axis speed and acceleration
MOTION = "a=0.5, v=0.5"  # rad/s², rad/s of the leading axis of a Universal Robot
FIRST = "The first move begins wherever the arm stands; only the moves after it were checked."


def robot_program(
    suffix: str, execution: Execution, chain: Chain, configurations: Sequence[str],
    forces: Array, limits: tuple[Array, Array], name: str,
) -> str:  # fmt: skip
    """The text of NAME.src (KRL) or NAME.script (URScript): moves, stops in which the tracker
    measures, and halts for the load; joint values inside `limits` (lower, upper) in rad, in the
    order of the chain.  Read back, it is the plan, or an ElastocalError."""
    language, write = LANGUAGES[suffix.lower()]
    check_six_axes(chain, language)
    steps = driven(steps_of(execution, configurations, forces), *limits)
    told = f"elastocal: {len(execution.stops)} readings of robot {plain(chain.name)}"
    text = "\n".join(write(program_name(name), told, limits_text(*limits), steps)) + "\n"
    check_program(text, steps)
    return text


def _krl(module: str, told: str, limits: str, steps: Sequence[Step]) -> list[str]:
    """Axis angles in degrees, A1 … A6 being joints 1 … 6.  No .dat file is needed."""
    lines = [
        "&ACCESS RVP",
        "&REL 1",
        f"DEF {module}()",
        f"; {told}",
        f"; This is module {module}: on the controller its file must be {module}.src.",
        "; Units: axis angles in degrees, stops in s, loads in N along x, y, z of the data's",
        "; frame.  Axis moves: neither $BASE nor $TOOL changes where they lead.",
        f"; Inside the limits in degrees: {limits}.",
        f"; Speed and acceleration: {PERCENT} % of the axes' greatest.",
        "; Axis angles in degrees as the robot description counts them: before the first run,",
        "; compare signs and zeros with the controller, and run in T1.",
        f"; {FIRST}",
        "DECL INT AXIS_NO",
        f"FOR AXIS_NO = 1 TO {AXES}",
        f"  $VEL_AXIS[AXIS_NO] = {PERCENT}",
        f"  $ACC_AXIS[AXIS_NO] = {PERCENT}",
        "ENDFOR",
    ]
    for kind, values, note in steps:
        if kind == "move":
            angles = ", ".join(f"A{i} {number(v, 6)}" for i, v in enumerate(np.degrees(values), 1))
            lines += [f"; {plain(note)}", f"PTP {{{angles}}}"]
        elif kind == "load":
            lines += [f"; {plain(note)}, then start again", "HALT"]
        else:
            lines += [f"; measure {plain(note)}", f"WAIT SEC {number(values[0], 3)}"]
    return [*lines, "END"]


def _urscript(function: str, told: str, limits: str, steps: Sequence[Step]) -> list[str]:
    lines = [
        f"# {told}",
        "# Joint values in rad as the robot description counts them: before the first run,",
        "# compare signs and zeros with the controller, and run at reduced speed.",
        f"# {FIRST}",
        "# Units: rad, rad/s, rad/s^2, s; loads in N along x, y, z of the data's frame.  Joint",
        "# moves: neither the TCP nor a feature plane changes where they lead.",
        f"# Inside the limits in degrees: {limits}.",
        f"def {function}():",
    ]
    for kind, values, note in steps:
        text = plain(note)
        if kind == "move":
            joints = ", ".join(number(v, 9) for v in values)
            lines += [f"  # {text}", f"  movej([{joints}], {MOTION})"]
        elif kind == "load":
            lines.append(f'  popup("{text}, then continue", title="Load", blocking=True)')
        else:
            lines += [f'  textmsg("measure {text}")', f"  sleep({number(values[0], 3)})"]
    return [*lines, "end", "", f"{function}()"]


LANGUAGES = {".src": ("KRL", _krl), ".script": ("URScript", _urscript)}
