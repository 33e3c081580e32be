"""Every result as a file, in the form that its verb of the command line writes, and back; a plan as
a robot program too.

`Result.save` and `CalibratedArm.save` find `save` by name (elastocal.above); the command line
calls the function of the kind.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from elastocal.above import checked_arguments, sources
from elastocal.cell import files_of
from elastocal.files import apart, atomic_write, read_record
from elastocal.measurements import DEFAULT_MARKER, Measurements, write_measurements
from elastocal.messages import (
    ElastocalError,
    InputError,
    json_text,
    newtons,
    option,
    printable,
    require,
    rounded,
)
from elastocal.model.calibrated import CalibratedArm, read_calibrated
from elastocal.model.manipulator import Model
from elastocal.tables import PARQUET, Labels, csv_text
from elastocal.units import Array

if TYPE_CHECKING:
    from elastocal.cell import Cell
    from elastocal.compensation import Compensation
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.result import Calibration
    from elastocal.model.chain import Chain
    from elastocal.planning.execution import Execution
    from elastocal.planning.plan import Plan

# One verb's result should not load another verb: each function imports what it needs.


@checked_arguments
def save(result: Any, path: str | Path, **how: Any) -> None:
    """`how`: options of the writer.  A name without ending is of the first kind that there is."""
    path, kind = Path(path), type(result).__name__
    by_ending = WRITERS[kind]
    write = by_ending.get(path.suffix.lower() or next(iter(by_ending)), by_ending.get(ANY))
    if write is None:
        raise InputError(f"{path}: {kind} is saved as {' or '.join(by_ending)}; name the file so")
    if kind != "Measurements":  # which may take the place of their file
        model = getattr(getattr(result, "old", result), "model", None)
        outputs = [p for p in (path, how.get("joint_correction")) if isinstance(p, str | Path)]
        apart(outputs, sources(result) + ([] if model is None else files_of(model.cell)))
    write(result, path, **how)


def write_json(path: Path, content: Any) -> None:
    atomic_write(path, json_text(content) + "\n")


def save_published(result: Any, path: Path) -> None:
    write_json(path, result.to_json())


def save_residuals(fit: Calibration, path: Path) -> None:
    rows = fit.residual_table()
    atomic_write(path, csv_text(list(rows[0]), [list(row.values()) for row in rows]))


def beside(path: Path) -> Path:
    """Where the summary (JSON) of the plan `path` is written, which nobody names."""
    require(path.suffix.lower() != ".json", f"{path}: name the plan .csv; .json goes beside it")
    summary = path.with_suffix(".json")
    if summary.exists():
        require(
            str(read_record(summary).get("schema")).startswith("elastocal/"),
            f"{summary}: goes beside {path} and would be written over, but elastocal did not "
            "write it; move it, or name the plan otherwise",
        )
    return summary


def save_plan(plan: Plan, path: Path, command: str | None = None) -> None:
    """plan.csv, which people measure by, and plan.json (schema elastocal/plan/1) beside it;
    `command` is the command line that repeats the design."""
    from elastocal.planning.plan import SCHEMA, write_plan

    summary = beside(path)
    write_plan(path, *plan.rows, forces=plan.stated_forces is not None)
    repeat = {"command": command, "backend": plan.model.backend_report()}
    write_json(summary, {"schema": SCHEMA, **plan.to_json(), **repeat})


def save_found_cell(diagnosis: Diagnosis, path: Path) -> Cell:
    """The cell file that was diagnosed with the effects found added; it is returned as written."""
    from elastocal.cell import read_cell
    from elastocal.diagnosis.diagnose import write_extended_cell
    from elastocal.model.chain import numbered

    assert diagnosis.model is not None  # `diagnose` states it
    cell, chain = diagnosis.model.cell, diagnosis.model.chain
    if cell.path is None or repr(numbered(read_cell(cell.path), chain).model) != repr(cell.model):
        raise InputError(
            f"{path}: the model diagnosed is not that of a cell file, which what was found could "
            "join; write the cell as a file (TOML), and diagnose that"
        )
    extra = (*diagnosis.effects, *diagnosis.slight, *diagnosis.fields)
    return write_extended_cell(cell.path, path, extra, diagnosis.model_keys)


def save_compensation(found: Compensation, path: Path, partial: bool = False) -> None:
    """The rows of targets that are not reached stay empty where `partial`; else they are an
    error."""
    from elastocal.compensation import check_reached, commands_csv

    if not partial:
        check_reached(found)
    atomic_write(path, commands_csv(found))


@checked_arguments
def save_arm(
    arm: CalibratedArm, path: Path, joint_correction: str | Path | None = None, **how: Any
) -> None:
    """`how` as for `Wish`."""
    from elastocal.export.export import Wish, export, write

    wish = Wish(path, **how, correct_joints=joint_correction is not None)
    write(export(arm, wish), path, joint_correction)


def save_extra_poses(path: str | Path, plan: Measurements, kinds: Sequence[str]) -> None:
    """Visits (rows of `plan`, in the order of measuring) as plan.csv, which `simulate` reads.  A
    pose that is visited again under the same force is a configuration of its own: 4, 4/2, …."""
    from elastocal.planning.plan import write_plan

    names = []
    visits: Counter[tuple[int, bytes]] = Counter()
    for code, force in zip(plan.configuration, plan.force + 0.0, strict=True):
        visits[key := (int(code), force.tobytes())] += 1
        again = f"/{visits[key]}" if visits[key] > 1 else ""
        names.append(plan.configuration_labels[code] + again)
    visited = Labels.of(names)
    table = replace(
        plan, configuration=visited.codes, configuration_labels=visited.names,
        marker=np.zeros(len(plan), dtype=np.int64), marker_names=(DEFAULT_MARKER,),
        joint_kinds=tuple(kinds),
    )  # fmt: skip
    order = list(map(str, range(1, len(plan) + 1)))
    write_plan(path, table, {"level": ["1"] * len(plan), "order": order})


ANY = "any ending"  # of an arm the formats know theirs
WRITERS: dict[str, dict[str, Callable[..., Any]]] = {
    "Comparison": {".json": save_published},
    "Calibration": {".json": save_published, ".csv": save_residuals},
    "Plan": {".csv": save_plan},
    "Diagnosis": {".json": save_published, ".toml": save_found_cell},
    "Compensation": {".csv": save_compensation},
    "CalibratedArm": {ANY: save_arm},
    "Measurements": dict.fromkeys((".csv", *PARQUET), write_measurements),
    "NextPoses": {".csv": lambda found, path: save_plan(found.plan, path) if found.plan else None},
}


@checked_arguments
def load(path: str | Path, cell: str | Path | None = None) -> Model | CalibratedArm | Measurements:
    """Read a file by what it is.

    Args:
        path: A cell file (.toml), which becomes a `Model`; a result of identify (.json), which
            becomes the `CalibratedArm`; or a table (.csv, .parquet), which becomes `Measurements`.
        cell: The cell file of a result or a table; None takes cell.toml beside it.

    Returns:
        The `Model`, `CalibratedArm` or `Measurements`.

    Raises:
        InputError: The file is none of these or is wrong, or there is no cell file.

    Examples:
        >>> model = ec.load("cell.toml")
        >>> ec.identify(model, ec.load("data.csv")).save("result.json")
        >>> ec.load("result.json")
        <CalibratedArm kuka_kr270_2: 9 of 10 parameters determined, from result.json>
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind == ".toml":
        return Model(path)
    told = "give a cell file (.toml), a result of identify (.json) or a table (.csv, .parquet)"
    require(kind in (".json", ".csv", *PARQUET), f"{path}: {told}")
    of = path.parent / "cell.toml" if cell is None else Path(cell)
    told = f"there is no cell.toml beside {path}; name the cell file by {option('cell')}"
    require(cell is not None or of.is_file(), told)
    return read_calibrated(of, path) if kind == ".json" else Model(of).read(path)


# Robot programs of a plan: KRL and URScript, written, read back and compared with the plan.
#
# A program moves a machine, so nothing of a file's names can become a line of it, every joint value
# lies inside the robot's limits, speeds have a bound, and what was written is read again: another
# line than those of a language's texts, or a move that is off by more than 1e-6 rad, is an error.

AXES = 6
TAKE_OFF = "take the load off"
VIA = "via point, not measured"
SAME = 1e-6  # rad, between a value of the plan and of the program
DIGIT = 1e-8  # rad, more than half of the last digit of a program, 1e-6° or 1e-9 rad
LONGEST_STOP = 86_400.0  # s
LONGEST = 100  # characters of a note; controllers cut or refuse long lines
LONGEST_NAME = 24
# Words of both languages that no module or function can be called; upper and lower case alike.
RESERVED = frozenset(re.findall(r"\w+", """
    and break codes continue def do else elif end endfor endif endswitch endwhile enddat enddefct
    exit for function global goto halt if import in interrupt is local loop endloop main movec movej
    movel movep not on or pass popup print ptp lin circ pulse repeat resume return run signal sleep
    socket struct switch textmsg then thread to true false trigger until wait while with bool int
    real char frame axis e6axis pos e6pos decl const enum
"""))  # fmt: skip

# A move to joints (n,) rad with a note on what is there; a stop until someone has done what the
# note says; a stop of so many s (1,) while the tracker measures what the note says.
Step = tuple[Literal["move", "load", "measure"], Array, str]


class Language(NamedTuple):
    """The texts before, at and behind the steps; {} is a number.  Moves are exact stops, without
    blend, so that the checked paths are those that are driven."""

    title: str
    digits: int  # of a joint value
    per_radian: float
    texts: dict[str, str]


# Joint values are A1 … A6 = joints 1 … 6; of the greatest axis speed and acceleration 10 %.
KRL = Language("KUKA KRL", 6, 180 / math.pi, {
    "head": """\
&ACCESS RVP
&REL 1
DEF {name}()
; {told}
; This is module {name}: on the controller its file must be {name}.src.
; Units: axis angles in degrees, stops in s, loads in N along x, y, z of the data's
; frame.  Axis moves: neither $BASE nor $TOOL changes where they lead.
; Inside the limits in degrees: {limits}.
; Speed and acceleration: 10 % of the axes' greatest.
; Axis angles in degrees as the robot description counts them: before the first run,
; compare signs and zeros with the controller, and run in T1.
; The first move begins wherever the arm stands; only the moves after it were checked.
DECL INT AXIS_NO
FOR AXIS_NO = 1 TO 6
  $VEL_AXIS[AXIS_NO] = 10
  $ACC_AXIS[AXIS_NO] = 10
ENDFOR
""",
    "move": "; {note}\nPTP {{A1 {}, A2 {}, A3 {}, A4 {}, A5 {}, A6 {}}}\n",
    "load": "; {note}, then start again\nHALT\n",
    "measure": "; measure {note}\nWAIT SEC {}\n",
    "foot": "END\n",
})  # fmt: skip
# a and v are rad/s² and rad/s of the leading axis.
URSCRIPT = Language("URScript", 9, 1.0, {
    "head": """\
# {told}
# Joint values in rad as the robot description counts them: before the first run,
# compare signs and zeros with the controller, and run at reduced speed.
# The first move begins wherever the arm stands; only the moves after it were checked.
# Units: rad, rad/s, rad/s^2, s; loads in N along x, y, z of the data's frame.  Joint
# moves: neither the TCP nor a feature plane changes where they lead.
# Inside the limits in degrees: {limits}.
def {name}():
""",
    "move": "  # {note}\n  movej([{}, {}, {}, {}, {}, {}], a=0.5, v=0.5)\n",
    "load": '  popup("{note}, then continue", title="Load", blocking=True)\n',
    "measure": '  textmsg("measure {note}")\n  sleep({})\n',
    "foot": "end\n\n{name}()\n",
})  # fmt: skip
LANGUAGES = {".src": KRL, ".script": URSCRIPT}
# What stands in the place of a text's nothing, {} and {name}, and of all else: `plain` ASCII.
HELD = {None: "", "": r"(-?[0-9]+(?:\.[0-9]+)?)", "name": r"\w+"}
PLAIN = r"[ !#-\[\]-~]*"


def plain(text: str) -> str:
    """One line of printable ASCII without quotation marks, as controllers take it."""
    line = " ".join(text.split()).replace('"', "'").replace("\\", "/")[:LONGEST]
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in line)


def number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


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


def program_steps(text: str) -> list[tuple[str, Array]]:
    """The texts that a program written here consists of, in their order, with their numbers:
    ("move", joints (6,) rad), ("measure", seconds (1,)), and others without any."""
    language = KRL if text.startswith("&ACCESS") else URSCRIPT
    kinds = {}
    for kind, template in language.texts.items():
        parts = Formatter().parse(template)
        way = "".join(re.escape(words) + HELD.get(field, PLAIN) for words, field, *_ in parts)
        kinds[kind] = re.compile(way, re.ASCII)
    steps, at = [], 0
    while at < len(text):
        found = {kind: match for kind, way in kinds.items() if (match := way.match(text, at))}
        if not found:
            line = text.count("\n", 0, at) + 1
            raise ElastocalError(
                f"the robot program's line {line} is none that is written: "
                f"{printable(text[at:].partition(chr(10))[0])}; do not run it"
            )
        ((kind, match),) = found.items()
        values = np.array(match.groups(), dtype=float)
        steps.append((kind, values / language.per_radian if kind == "move" else values))
        at = match.end()
    return steps


def check_program(text: str, planned: Sequence[Step]) -> None:
    """Raise ElastocalError unless the program, read back, does what the plan's `steps_of` say:
    the same steps in the same order, every joint within 1e-6 rad, every stop within 1 ms."""
    found = program_steps(text)
    same = [kind for kind, _ in found] == ["head", *(kind for kind, _, _ in planned), "foot"]
    for (kind, values), (_, wanted, _) in zip(found[1:-1], planned, strict=False):
        same = same and bool((np.abs(values - wanted) <= (SAME if kind == "move" else 1e-3)).all())
    if not same:
        raise ElastocalError("the robot program does not do what the plan says; do not run it")


def check_six_axes(chain: Chain, language: str) -> None:
    sliding = [joint.name for joint in chain.joints if joint.kind != "revolute"]
    if chain.n_joints != AXES or sliding:
        what = f"joint {sliding[0]} slides" if sliding else f"it has {chain.n_joints}"
        what = f"joints {', '.join(sliding)} slide" if len(sliding) > 1 else what
        raise InputError(
            f"robot '{chain.name}': a {language} program moves arms of {AXES} revolute joints, but "
            f"{what}; external axes are not written: take the plan, with the via points of its JSON"
        )


def robot_program(
    suffix: str, execution: Execution, chain: Chain, configurations: Sequence[str],
    forces: Array, limits: tuple[Array, Array], name: str,
) -> str:  # fmt: skip
    """The text of NAME.src (KRL) or NAME.script (URScript); joint values inside `limits` (lower,
    upper) in rad, in the order of the chain.  Read back, it is the plan, or an ElastocalError."""
    language = LANGUAGES[suffix.lower()]
    check_six_axes(chain, language.title)
    steps = driven(steps_of(execution, configurations, forces), *limits)
    told = f"elastocal: {len(execution.stops)} stops of robot {plain(chain.name)}"
    ranges = [f"{rounded(low, 4)} to {rounded(high, 4)}" for low, high in np.degrees(limits).T]
    inside = ", ".join(f"J{i} {told}" for i, told in enumerate(ranges, 1))
    of_all = {"name": program_name(name), "told": told, "limits": inside}
    texts = [language.texts["head"].format(**of_all)]
    for kind, values, note in steps:
        if kind == "move":
            held = [number(value, language.digits) for value in values * language.per_radian]
        else:
            held = [number(value, 3) for value in values]
        texts.append(language.texts[kind].format(*held, note=plain(note)))
    text = "".join(texts) + language.texts["foot"].format(**of_all)
    check_program(text, steps)
    return text
