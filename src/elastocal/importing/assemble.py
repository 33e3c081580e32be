"""From exported files to a validated measurement table: the whole of `elastocal import`.

Points and their joint values become rows, which are judged by their units and by the robot of the
cell.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.identification.mistakes import NominalFit, nominal_fit
from elastocal.importing import joining
from elastocal.importing.exports import FORCES, Records, joint_stems, read_records
from elastocal.importing.joining import Joined
from elastocal.importing.mapping_file import LoadStatesTable, MappingTable, SourceTable
from elastocal.measurements import Measurements, families, read_measurements
from elastocal.messages import InputError, did_you_mean, length, listed, quoted, rounded
from elastocal.model.chain import beyond_limits
from elastocal.model.effects.statics import STANDARD_GRAVITY
from elastocal.model.manipulator import load_chain
from elastocal.tables import Labels, column, csv_text
from elastocal.units import Array, IntArray

UNLOADED = ("none", "unloaded", "0")


def forces_of(
    where: str, points: Records, loads: Mapping[str, Array | LoadStatesTable]
) -> Array | None:
    """(n, 3) N in the tracker's frame (z up) for each point; None where no load is told.

    A mass m hangs straight down: force (0, 0, -9.80665 m); so does a load whose name is a size, as
    "2600 N" or "2.5 kg", unless [loads] has it.  The names none, unloaded and 0 mean no force
    unless [loads] says otherwise.
    """
    named = points.texts.get("load")
    if named is None:
        if loads and not points.forces:
            raise InputError(
                f"{where}: [loads] names {listed(loads)}, but no file says which load it belongs "
                "to; give load in [[source]], or a group (?P<load>…) in a pattern"
            )
        return None
    if points.forces:
        raise InputError(
            f"{points.source}: the load is stated by name and in columns {listed(points.forces)}; "
            "keep one"
        )
    known = {name: np.zeros(3) for name in UNLOADED}
    for name, stated in loads.items():
        if isinstance(stated, LoadStatesTable):
            stated = np.array([0.0, 0.0, -stated.mass_kg * STANDARD_GRAVITY])
        known[name] = stated + 0.0  # no -0.0
    for i, name in enumerate(named):
        if name not in known and (size := load_in(name)):
            known[name] = np.array([0.0, 0.0, 0.0 - size[1]])
        if name not in known:
            raise InputError(
                f"{points.where(i)}: load {quoted(name)} is not in [loads] of {where}"
                f"{did_you_mean(name, known)}; there are {listed(known)}: add "
                f"{name} = [0, 0, -1000] in N, or {name} = {{ mass_kg = 100 }}"
            )
    return np.array([known[name] for name in named])


# A load in a file's name: log_2600N, payload_2p5kg, load2.6kN.  A number that follows a letter is a
# load only after a word for one; a small n counts something.
_SIZE = re.compile(
    r"(?:(?<![A-Za-z0-9.,])|(?<=load)|(?<=mass)|(?<=weight))(\d+(?:[.,p]\d+)?)[ _-]?"
    r"([kK][gG]|kN|N)(?![A-Za-z0-9])"
)
_WORD = re.compile(r"(?<!un)(?<!no)(?<!without)[ _-]?(?:pay)?load(?:ed)?(?![a-z])|weight", re.I)
_NEWTONS = {"kg": STANDARD_GRAVITY, "kn": 1e3, "n": 1.0}


def load_in(text: str) -> tuple[str, float] | None:
    """The load that a text states, as it is written and in N; None where none is."""
    found = _SIZE.search(text)
    if found is None:
        return None
    size = float(re.sub("[,p]", ".", found[1]))
    return f"{size:g} {found[2]}", size * _NEWTONS[found[2].lower()]


def with_loads_of_names(
    by_role: Mapping[str, list[Records]], loads: Mapping[str, Any]
) -> tuple[dict[str, list[Records]], list[str]]:
    """The records with the loads that their files are named for, where nothing else states any, and
    what to tell.  They hang straight down."""
    made, every = dict(by_role), [r for role in by_role.values() for r in role]
    if loads or any(r.load or "load" in r.texts or r.forces for r in every):
        return made, []
    named = {r.source: load_in(Path(r.source).stem) for r in every}
    if not any(named.values()):
        told = [r.source for r in every if _WORD.search(Path(r.source).stem)]
        told += [f"column {name} of {r.source}" for r in every
                 for name in r.understood["unused"] if _WORD.search(name)]  # fmt: skip
        return made, [
            f"{listed(told)}: named for a load that is not taken, and the rows are written "
            "unloaded; state it by load in [[source]] and [loads], or by load = \"…\" in "
            "[source.columns]"
        ] if told else []  # fmt: skip
    for role, files in by_role.items():
        made[role] = [replace(r, load=(named[r.source] or UNLOADED[1:])[0]) for r in files]
    if not any(named[r.source] for r in by_role["points"]):
        # The points are those of the joint logs.
        only = {r.load for r in made["joints"]}
        if len(only) > 1:
            raise InputError(
                f"{by_role['joints'][0].source}: joint logs are named for the loads "
                f"{listed(sorted(map(str, only)))} and the points for none; give load in the "
                "[[source]] of each file of points"
            )
        made["points"] = [replace(r, load=next(iter(only))) for r in by_role["points"]]
    elif not any(named[r.source] for r in by_role["joints"]):
        made["joints"] = list(by_role["joints"])  # one log for every load
    return made, [
        f"{r.source}: taken as measured under {found[0]} by its name, hanging straight down "
        f"(0, 0, {0.0 - found[1]:.6g}) N; load in [[source]] states another"
        for r in every
        if (found := named[r.source])
    ]


WHOLE = re.compile(r"-?[0-9]{1,15}")

# Header → n texts or numbers, in the order of the table; note_source says where each row is from.
Columns = dict[str, Sequence[str] | NDArray]


def assemble(
    where: str, points: Records, mapping: MappingTable
) -> tuple[Columns, tuple[str, ...], list[str]]:
    """A row for each point, in their order; the kind of each joint; sentences for the preview.

    Configurations are those of the names, else of the joint log, else joint values that agree
    within same_pose_deg.  Repeats are numbered in order where the file does not number them.  Times
    are counted from the first reading.
    """
    settings, n = mapping.join, len(points)
    numbers, units = dict(points.numbers), dict(points.units)
    stems = joint_stems(numbers)
    if not stems:
        raise InputError(
            f"{where}: no joint values; map q1_deg … in [source.columns], or add a [[source]] with "
            'role = "joints"'
        )
    kinds = tuple("revolute" if units[stem] == "deg" else "prismatic" for stem in stems)
    forces = forces_of(where, points, mapping.loads)
    if forces is not None:
        for k, stem in enumerate(FORCES):
            numbers[stem], units[stem] = forces[:, k], "N"
    spread = points.spread(settings.same_pose_deg, settings.same_pose_mm)
    configuration, warnings = _configurations(points, spread)
    stated = [stem for stem in FORCES if stem in numbers]
    if stated and (absent := [stem for stem in FORCES if stem not in stated]):
        numbers |= dict.fromkeys(absent, np.zeros(n))
        units |= dict.fromkeys(absent, "N")
        warnings.append(f"{listed(absent)} in no column: taken as 0 N beside {listed(stated)}")
    columns: Columns = {"configuration": configuration}
    marker = points.texts.get("marker")
    force = np.column_stack([numbers.get(stem, np.zeros(n)) for stem in FORCES])
    keys = zip(configuration, marker or [""] * n, map(tuple, force), strict=True)
    columns["repeat"] = _repeats(points, keys)
    if marker is not None:
        columns["marker"] = marker
    time = numbers.pop("time", None)
    for family in families(kinds).values():
        own = {column(s, units[s]): numbers[s] for s in family.units if s in numbers}
        missing = [stem for stem in family.units if stem not in numbers]
        if own and missing:
            raise InputError(
                f"{where}: {listed(own)} without {listed(missing)}; the table needs all columns of "
                f"the {family.meaning}: add them to [source.columns]"
            )
        columns |= own
    if time is not None:
        columns["time_s"] = np.round(time - time.min(), 6)
    if any(points.names):
        columns["note_point"] = points.names
    columns["note_source"] = [points.where(i) for i in range(n)]
    return columns, kinds, warnings


def _configurations(points: Records, spread: Array) -> tuple[list[str], list[str]]:
    names, q = points.texts.get("configuration"), points.q
    if names is None:
        known, codes = Labels.of(map(tuple, q.tolist())), list[int]()
        firsts, n = np.empty_like(q), 0  # of each configuration, and how many there are
        for row in q[np.unique(known.codes, return_index=True)[1]]:
            near = (np.abs(firsts[:n] - row) <= spread).all(axis=1)
            codes.append(int(np.argmax(near)) if near.any() else n)
            if not near.any():
                firsts[n] = row
                n += 1
        return [str(codes[code] + 1) for code in known.codes], []
    known = Labels.of(names)
    low = np.full((len(known.names), q.shape[1]), np.inf)
    high = -low
    np.minimum.at(low, known.codes, q)
    np.maximum.at(high, known.codes, q)
    span = high - low
    which = [known.names[c] for c in np.flatnonzero(np.any(span > spread, axis=1))]
    return names, [
        f"{len(which)} configurations have rows whose joint values differ by up to "
        f"{rounded(span.max())} (in the columns' unit): {listed(which, 8)}; if these are "
        "different poses, name them apart"
    ] if which else []  # fmt: skip


def _repeats(points: Records, keys: Iterable[tuple]) -> IntArray:
    stated, known = points.texts.get("repeat"), dict[tuple, int]()
    if stated is None:
        number = defaultdict[tuple, Iterator[int]](count)
        return np.array([next(number[key]) for key in keys], dtype=np.int64)
    for k, (text, key) in enumerate(zip(stated, keys, strict=True)):
        if not WHOLE.fullmatch(text):
            raise InputError(f"{points.where(k)}: repeat {quoted(text)} is no whole number; "
                             "correct the pattern or the column")  # fmt: skip
        first = known.setdefault((*key, int(text)), k)
        if first != k:
            raise InputError(
                f"{points.where(k)}: repeat {text} of configuration {key[0]}"
                f"{f', marker {key[1]}' if key[1] else ''} stands in line "
                f"{points.line[first]} too; leave the repeat out of the pattern to have "
                "shots numbered in order"
            )
    return np.array([int(text) for text in stated], dtype=np.int64)


# Whether an imported table can be right: its units, and whether the robot of a cell fits it.

# Industrial arms measured by trackers: radians of a campaign span more than this, degrees too.
SMALLEST_SPREAD_DEG = 7.0  # 2 pi: a column of radians read as degrees spans less
LARGEST_TURN_DEG = 720.0
FARTHEST_M, LARGEST_SPREAD_M, LEAST_SPREAD_M = 150.0, 30.0, 0.02
LARGEST_FORCE_N = 2e5
LARGEST_SIGMA_M = 5e-3


def plausibility(columns: Columns, table: Measurements, observe: str | None) -> list[str]:
    """Sentences about columns that are likely in another unit, and about pairs that are missing."""
    turning = table.q[:, np.array([kind == "revolute" for kind in table.kinds])]
    turned = float(np.degrees(np.abs(turning).max(initial=0.0)))
    span = float(np.degrees(np.ptp(turning, axis=0).max(initial=0.0)))
    several = turning.size > 0 and len(np.unique(table.q, axis=0)) >= 5
    still = [f"joint {j + 1}" for j in range(table.q.shape[1]) if np.ptp(table.q[:, j]) == 0]
    places = np.zeros((1, 3)) if table.position is None else table.position
    moved = float(np.ptp(table.q, axis=0).max(initial=0.0))
    with np.errstate(over="ignore"):  # numbers of 1e300 are told as implausible, too
        far = float(np.linalg.norm(places, axis=1).max())
        spread = float(np.linalg.norm(np.ptp(places, axis=0)))
        force = float(np.linalg.norm(table.force, axis=1).max())
    sigma = 0.0 if table.sigma is None else float(table.sigma.max())
    labels, loaded = table.configuration_labels, np.any(table.force != 0, axis=1)
    states = [set(loaded[table.configuration == code]) for code in range(len(labels))]
    lonely = [label for label, found in zip(labels, states, strict=True) if len(found) == 1]
    # Of each row the first that is so.
    doubts = (
        (
            (turned > LARGEST_TURN_DEG, f"a joint stands at {rounded(turned, 4)}°, more than two "
             "turns: degrees read as radians? Map q#_deg"),
            (several and "q1_deg" in columns and span < SMALLEST_SPREAD_DEG,
             f"no joint moves by more than {rounded(span)}°: radians read as degrees? Map q#_rad"),
            (several and still, f"{listed(still)} never moved; is it mapped to the right column?"),
        ),
        (
            (far > FARTHEST_M or spread > LARGEST_SPREAD_M,
             f"points lie up to {rounded(far)} m from the tracker and span {rounded(spread)} m: mm "
             "read as m? Map x_mm, y_mm, z_mm"),
            (table.position is not None and moved > 0.3 and spread < LEAST_SPREAD_M,
             f"all points lie within {length(spread)} although the arm moved: m read as "
             "mm? Map x_m, y_m, z_m"),
        ),
        ((force > LARGEST_FORCE_N,
          f"forces reach {rounded(force)} N, more than any arm carries; check [loads]"),),
        ((sigma > LARGEST_SIGMA_M,
          f"standard deviations reach {rounded(sigma * 1e3)} mm; are they in µm?"),),
        ((table.position is not None and bool(np.any(table.force[:, 2] > 0)),
          "some forces point up (+z of the tracker's frame); a hanging load is negative"),),
        ((observe == "deflection" and lonely,
          f"{len(lonely)} of {len(labels)} configurations were not measured both "
          f"unloaded and loaded, as deflections need: {listed(lonely, 8)}"),),
    )  # fmt: skip
    return [told for row in doubts for told in [text for so, text in row if so][:1]]


@dataclass(frozen=True)
class Imported:
    """What was read and made of it.

    `table` is the measurement table as `measurements.read_measurements` reads `text`;
    `refused` says why the robot of the cell cannot have measured it, "" where it can.
    """

    understood: tuple[dict[str, Any], ...]
    columns: Columns
    joined: Joined | None
    text: str
    table: Measurements
    warnings: tuple[str, ...]
    fit: NominalFit | None
    refused: str


def import_files(
    files: Sequence[Path], mapping: tuple[str, MappingTable], cell: Cell | None = None,
    name: str = "data.csv",
) -> Imported:  # fmt: skip
    """Read `files` as `mapping` says, join, convert, and validate the measurement table.

    `cell`: the robot that the table must fit: number and kind of joints, markers, limits;
    `name`: what messages call the table.  Nothing is written.
    """
    where, table = mapping
    chain = None if cell is None else load_chain(cell)
    names = () if chain is None else tuple(joint.name for joint in chain.joints)
    by_role, understood, spherical = _by_role(where, files, table, names)
    told = [doubt for own in by_role.values() for records in own for doubt in records.doubts]
    by_role, warnings = with_loads_of_names(by_role, table.loads)
    points = joining.pooled(by_role["points"])
    log = joining.pooled(by_role["joints"]) if by_role["joints"] else None
    joined = None
    if log is not None:
        if not log.q.shape[1]:
            raise InputError(
                f"{log.files[0]}: no joint values; map q1_deg … (or q#_deg) in its [source.columns]"
            )
        joined = joining.join(points, log, table.join)
        points = _with_joint_values(points, log, joined)
    columns, kinds, doubts = assemble(where, points, table)
    # Numbers with the digits that read back exactly.
    cells = [[repr(v + 0) for v in values.tolist()] if isinstance(values, np.ndarray) else values
             for values in columns.values()]  # fmt: skip
    text = csv_text(columns, zip(*cells, strict=True))
    read = partial(read_measurements, f"{name} (not written)", text=text)
    with _placed(points):  # as the reader of `identify` reads it, and as the cell asks for it
        if cell is None or chain is None:
            observe = "position" if any(c.startswith("x_") for c in columns) else "distance"
            measured = read(joint_kinds=kinds, marker_names=(), observe=observe)
        else:
            markers, observe = tuple(cell.tool.markers), cell.model.observe
            measured = read(joint_kinds=chain.kinds, marker_names=markers, observe=observe)
    fit, refused = None, ""
    if cell is not None and chain is not None:
        if (beyond := beyond_limits(cell, chain, measured.q)) is not None:
            rows, _, why = beyond
            refused = (
                f"{columns['note_source'][rows[0]]}: {why} ({len(rows)} of {len(measured)} rows); "
                "correct unit, sign, offset_deg or order in [joints], or the limits of the cell"
            )
        fit = nominal_fit(chain, cell, measured, spherical)
    warnings += [
        *told,
        *(() if joined is None else joined.warnings),
        *doubts,
        *plausibility(columns, measured, None if cell is None else cell.model.observe),
    ]
    warnings += [fit.warning] if fit is not None and fit.warning else []
    return Imported(
        tuple(understood), columns, joined, text, measured, tuple(warnings), fit, refused
    )


def _by_role(
    where: str, files: Sequence[Path], table: MappingTable, names: tuple[str, ...]
) -> tuple[dict[str, list[Records]], list[dict[str, Any]], bool]:
    """The records of each file among "points" or "joints", what is to be told of each file, and
    whether any states angles in the place of positions; `names` of the cell's joints."""
    by_role: dict[str, list[Records]] = {"points": [], "joints": []}
    understood, spherical = [], False
    for path, source in _assigned(where, files, table.source or ()):
        found = joining.with_labels(
            where, read_records(where, path, source, table.units), source.names
        )
        spherical = spherical or not found.numbers.keys().isdisjoint(joining.SPHERICAL)
        found = joining.with_positions(found, clockwise=source.azimuth == "clockwise")
        role = source.role or ("both" if "x" in found.numbers or "distance" in found.numbers
                               else "joints")  # fmt: skip
        if role in ("joints", "both") and joint_stems(found.numbers):
            found = joining.with_joints(where, found, table.joints, names)
        by_role["joints" if role == "joints" else "points"].append(found)
        understood.append(found.understood | {"role": role})
    if not by_role["points"]:
        raise InputError(
            f"{where}: no file with points among {listed(map(str, files), 5)}; add the tracker's "
            'export, or set role = "points" in its [[source]]'
        )
    return by_role, understood, spherical


@contextmanager
def _placed(points: Records) -> Iterator[None]:
    """Within it an error in a line of the table says where that line came from."""
    try:
        yield
    except InputError as error:
        row = int(line[1]) - 2 if (line := re.search(r"line (\d+)", str(error))) else -1
        told = f" (from {points.where(row)})" if 0 <= row < len(points) else ""
        raise InputError(f"{error}{told}") from None


def _with_joint_values(points: Records, log: Records, joined: Joined) -> Records:
    """The points that found joint values, with these and what else the log says there."""
    rows = np.flatnonzero(joined.row >= 0)
    pose = {} if joined.pose is None else {"configuration": [joined.pose[i] for i in rows]}
    own, theirs, stems = points.take(rows), log.take(joined.row[rows]), joint_stems(log.numbers)
    return replace(
        own,
        numbers=theirs.numbers | own.numbers | {s: joined.q[rows, j] for j, s in enumerate(stems)},
        units=theirs.units | own.units | {stem: log.units[stem] for stem in stems},
        texts=pose | own.texts,
    )


def _assigned(
    where: str, files: Sequence[Path], sources: Sequence[SourceTable]
) -> list[tuple[Path, SourceTable]]:
    """Each file with the source that reads it.

    A file goes to the first source whose `files` pattern fits its name; sources without a pattern
    share the rest: one takes them all, several take one file each, in order.
    """
    chosen: dict[int, SourceTable] = {}
    for i, path in enumerate(files):
        if path in files[:i]:
            raise InputError(f"{path}: named twice; name each file once")
        names = path.name, str(path)
        for source in reversed(sources):
            if any(fnmatchcase(name, p) for p in source.files or () for name in names):
                chosen[i] = source
    rest = [i for i in range(len(files)) if i not in chosen]
    for source in sources:
        if source.files and source not in chosen.values():
            raise InputError(
                f"{where}: no file fits files = {listed(map(quoted, source.files))}; the files are "
                f"{listed((p.name for p in files), 8)}"
            )
    free = [source for source in sources if not source.files]
    if len(free) == 1 and rest:
        chosen |= dict.fromkeys(rest, free[0])
    elif len(free) == len(rest):
        chosen |= dict(zip(rest, free, strict=True))
    else:
        left = listed((str(files[i]) for i in rest), 8)
        raise InputError(
            f"{where}: {len(free)} sources without a files pattern for {len(rest)} files "
            f'({left or "none left"}); give files = ["pattern"] in each [[source]], or one preset '
            "per file"
        )
    return [(path, chosen[i]) for i, path in enumerate(files)]
