"""From exported files to a validated measurement table: the whole of `elastocal import`.

Joint values are read as the model counts them and joined with the points they belong to; both
become rows, which are judged by their units and by the robot of the cell.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from elastocal.cell import Cell
from elastocal.identification.mistakes import NominalFit, nominal_fit
from elastocal.importing import exports
from elastocal.importing.exports import FORCES, Records, joint_stems
from elastocal.importing.mapping_file import JoinTable, JointsTable, MappingTable, SourceTable
from elastocal.measurements import Measurements, families, read_measurements
from elastocal.messages import InputError, counted, length, listed, quoted, require, rounded
from elastocal.model.chain import beyond_limits
from elastocal.model.manipulator import load_chain
from elastocal.tables import Labels, column, csv_text
from elastocal.units import Array, IntArray


def with_joints(
    where: str, records: Records, joints: JointsTable, model_names: Sequence[str] = ()
) -> Records:
    """With q1 … qn as the robot model counts them: q_j = sign_j * c_{order(j)} + offset_j + Σ
    factor * q_i, c the controller's values and the sum over the couplings of joint j; q_i there is
    the value before any coupling, so the couplings do not depend on their order.  The order is that
    of [joints] order, else the joint names of the file (columns joint1 …) are brought into the
    order of [joints] names, else of `model_names` where the file has them all."""
    stems = joint_stems(records.numbers)
    if wrong := [stem for i, stem in enumerate(stems, 1) if stem != f"q{i}"]:
        raise InputError(
            f"{records.source}: the mapping fills {listed(stems)}, but not q"
            f"{int(wrong[0][1:]) - 1}; joints are numbered from 1 without gaps"
        )
    taken = _order(where, records, joints, model_names, len(stems))
    units = [records.units[stems[j]] for j in taken[0]]
    n, here = len(units), f"{where}: [joints]"
    for key in ("sign", "offset_deg", "offset_mm"):
        given = getattr(joints, key)
        size = n if given is None else len(given)
        told = f"{key} has {size} numbers, but there are {n} joints; give one per joint"
        require(size == n, f"{here} {told}")
        for j, (value, unit) in enumerate(zip(given or (), units, strict=False), 1):
            told = f"{here} sign takes 1 or -1 per joint; found {value:g}"
            require(key != "sign" or abs(value) == 1, told)
            told = f"{key} is {value:g} for joint {j}, which is in {unit}; give offset_{unit}"
            require(key == "sign" or not value or key.endswith(unit), f"{here} {told}")
    none = [0.0] * n
    offset = np.where(np.array(units) == "deg", joints.offset_deg or none, joints.offset_mm or none)
    before = np.take_along_axis(records.q, taken, axis=1) * (joints.sign or [1.0] * n) + offset
    q = before.copy()
    for k, coupling in enumerate(joints.coupling, 1):
        for name, number in (("joint", coupling.joint), ("of", coupling.of)):
            told = f"{name} = {number} of [joints] coupling no. {k}: the file has {n} joints"
            require(number <= n, f"{where}: {told}")
        j, i = coupling.joint - 1, coupling.of - 1
        require(
            units[j] == units[i],
            f"{here} coupling no. {k} joins a revolute and a prismatic joint; give the factor in "
            "other units outside the mapping",
        )
        q[:, j] += coupling.factor * before[:, i]
    numbers = {s: v for s, v in records.numbers.items() if s not in stems}
    numbers |= dict(zip(stems, q.T, strict=False))  # q1 … without those that the order leaves out
    of = records.units | dict(zip(stems, units, strict=False))
    return replace(records, numbers=numbers, units=of)


def _order(
    where: str, records: Records, joints: JointsTable, model_names: Sequence[str], n: int
) -> IntArray:
    """(rows, joints): the file's joint, from 0, for each joint of the robot."""
    order = joints.order or list(range(1, n + 1))
    told = f"{where}: [joints] order = {order} takes each of the file's {n} joints at most once"
    require(max(order) <= n and len(set(order)) == len(order), told)
    columns = [records.texts[f"joint{i}"] for i in range(1, n + 1) if f"joint{i}" in records.texts]
    named = joints.order is None and len(columns) == n
    require(
        named or joints.order is not None or joints.names is None,
        f'{where}: [joints] names needs the joint names of the file: add joint# = "name_#0" to '
        "[source.columns], or use order",
    )
    found = list(zip(*columns, strict=True)) if named else [()]
    wanted = joints.names or (model_names if set(model_names) <= set(found[0]) else None)
    if not named or not wanted:
        return np.tile(np.array(order) - 1, (len(records), 1))
    orders: dict[tuple[str, ...], list[int]] = {}
    for i, names in enumerate(found):
        if names not in orders:
            if absent := [name for name in wanted if name not in names]:
                raise InputError(
                    f"{records.where(i)}: no joint {listed(absent)}; the row has {listed(names)}: "
                    "correct [joints] names, or leave out messages of other joints"
                )
            orders[names] = [names.index(name) for name in wanted]
    return np.array([orders[names] for names in found])


def pooled(records: Sequence[Records]) -> Records:
    if any(r.load is not None for r in records):
        told = "says no load, other files do; give load in its [[source]], or a group (?P<load>…)"
        for r in records:
            require("load" in r.texts or r.load is not None, f"{r.source}: {told} in its pattern")
        records = [replace(r, texts={"load": [str(r.load)] * len(r)} | r.texts) for r in records]
    first = records[0]
    for other in records[1:]:
        for what, one, two in (
            ("columns", {*first.numbers}, {*other.numbers}),
            ("labels", {*exports.GROUPS} & {*first.texts}, {*exports.GROUPS} & {*other.texts}),
        ):
            has, lacks = (first, other) if one - two else (other, first)
            require(
                one == two,
                f"{lacks.source}: has no {listed(sorted(one ^ two))}, but {has.source} has; files "
                f"of one kind need the same {what}: correct [[source]], or import them one by one",
            )
    texts = {s: [text for r in records for text in r.texts.get(s, [""] * len(r))]
             for s in dict.fromkeys(stem for r in records for stem in r.texts)}  # fmt: skip
    return replace(
        first,
        file=[file for r in records for file in r.file],
        line=np.concatenate([r.line for r in records]),
        numbers={
            stem: np.concatenate([r.numbers[stem] for r in records]) for stem in first.numbers
        },
        texts=texts,
    )


CHUNK = 1024


def dwells(
    time: Array, q: Array, still: Array, shortest: float
) -> tuple[IntArray, IntArray, Array]:
    """The longest runs of rows in which no joint moves by more than `still`: the first and the last
    row of each (k,), and where the arm stands then (k, n), the median.  `time` (m,) s, rising; `q`
    (m, n); `still` (n,): the largest max - min within a dwell, in the unit of q; `shortest` s
    between its first and last row.  Runs are taken from the start of the log on, each as long as it
    can be; shorter ones count as motion."""
    found: list[tuple[int, int]] = []
    start, m = 0, len(time)
    while start + 1 < m:
        # The first row with which the run is long enough.
        end = max(int(np.searchsorted(time, time[start] + shortest)), start + 1)
        if end >= m:
            break
        moved = np.flatnonzero(_over(q[start : end + 1][::-1], still)[::-1])
        if len(moved):
            # From there to `end` is too much, and every run that starts before holds both.
            start += int(moved[-1]) + 1
            continue
        # Its last row: looked for in longer and longer pieces of the log.
        size = CHUNK
        while not (over := _over(q[start : start + size], still)).any() and start + size < m:
            size *= 2
        end = start + (int(np.argmax(over)) if over.any() else len(over)) - 1
        found.append((start, end))
        start = end + 1
    first, last = np.array(found, dtype=np.int64).reshape(-1, 2).T
    middle = [np.median(q[a : b + 1], axis=0) for a, b in found]
    return first, last, np.array(middle).reshape(len(found), q.shape[1])


def _over(q: Array, still: Array) -> NDArray[np.bool_]:
    """(rows,) whether any joint spans more than `still` over the rows so far."""
    spread = np.maximum.accumulate(q) - np.minimum.accumulate(q)
    return np.asarray((spread > still).any(axis=1))


SHOWN = 8


@dataclass(frozen=True)
class Joined:
    """`row` (points,) into the joint log, -1 without a partner; `q` (points, joints); `pose`
    (points,) names the pose where the log does.  `left_out` and `unused` say which points and which
    poses found no partner; `remarks` and `warnings` are for the preview."""

    how: str
    row: IntArray
    q: Array
    pose: list[str] | None = None
    left_out: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def join(points: Records, log: Records, settings: JoinTable) -> Joined:
    named = points.texts.get("configuration")
    obvious = "time" if "time" in points.numbers and "time" in log.numbers else "order"
    how = settings.by or ("name" if named and _keys(named, _names_of(log)) else obvious)
    if how in ("time", "standstill"):
        found = _by_clock(points, log, settings, how)
    else:
        found = (_by_name if how == "name" else _by_order)(points, log, settings)
    strict = bool(found.left_out) and settings.unmatched != "leave_out"
    if strict or (found.row < 0).all():
        some = f"{len(found.left_out)} of {len(points)} points have no joint values"
        lost = f": {listed(found.left_out, SHOWN)}" if strict else ""
        way = ', or set unmatched = "leave_out" in [join]' if strict else ""
        raise InputError(
            f"{points.source}: {some if strict else 'no point has joint values'} in "
            f"{listed(log.files, 3)} (joined by {how}){lost}; {_ADVICE[how]}{way}"
            f"{_likely_offset(points, log, settings, how)}"
        )
    return found


MOST_PAIRS = 1_000_000  # of points and standstills
MOST_POINTS_JOINED = 0.8  # a share from which an offset is worth telling


def _clocks(
    points: Records, log: Records, settings: JoinTable, how: str
) -> tuple[Array, Array, Array, IntArray]:
    """Times of the points, times of the log in order, its joints then, and its rows."""
    order = np.argsort(log.clock(how), kind="stable")
    return points.clock(how), log.clock(how)[order] + settings.offset_s, log.q[order], order


def _likely_offset(points: Records, log: Records, settings: JoinTable, how: str) -> str:
    """The offset of the log's clock at which most points fall into standstills, as a hint; "" where
    the join is not by clocks, few points would, or two offsets would do as well."""
    if how not in ("time", "standstill"):
        return ""
    at, clock, q, _ = _clocks(points, log, settings, how)
    still = log.spread(settings.still_deg, settings.still_mm)
    first, last, _ = dwells(clock, q, still, settings.still_s)
    if not len(first) or len(at) * len(first) > MOST_PAIRS:
        return ""
    ends = np.array([clock[first], clock[last]])
    tried = np.unique(np.round(at[:, None] - ends.mean(axis=0), 1))
    joined = np.array([(_nearest(at - offset, *ends)[1] == 0).sum() for offset in tried])
    best = tried[joined == joined.max()]
    if joined.max() < MOST_POINTS_JOINED * len(at) or np.ptp(best) > np.ptp(ends, axis=0).max():
        return ""
    offset = float(np.median(best)) + settings.offset_s
    return (
        f"; with offset_s = {offset:.1f} in [join] {joined.max()} of {len(at)} points are measured "
        "while the arm stands still"
    )


_ADVICE = {
    "order": "set points_per_pose in [join], or join by name",
    "name": "correct the patterns in [source.names], so that both files give the same names",
    "time": "correct offset_s or tolerance_s in [join]",
    "standstill": "correct offset_s, tolerance_s, still_deg or still_s in [join]",
}


def _names_of(log: Records) -> list[str]:
    return log.texts.get("configuration") or (log.names if any(log.names) else [])


def _key(name: str) -> str:
    """The same text for names that people take for one: P01, p1."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name.strip().casefold())


def _number(name: str) -> str:
    """The number at the end of a name: 7 for P07, pose_7 and 7."""
    found = re.search(r"(?<!\d)\d+$", _key(name))
    return found[0] if found else _key(name)


def _keys(ours: list[str], theirs: list[str]) -> Callable[[str], str] | None:
    """Whole names, else the numbers at their ends where these tell the names of each list apart."""
    for key in (_key, _number):
        mine, other = {key(n) for n in ours}, {key(n) for n in theirs}
        apart = all(len({key(n) for n in names}) == len({_key(n) for n in names})
                    for names in (ours, theirs))  # fmt: skip
        if mine & other and apart:
            return key
    return None


def _loads_apart(points: Records, log: Records) -> Iterator[tuple[str, IntArray, IntArray]]:
    loads = np.array(points.texts.get("load", [""] * len(points)), dtype=object)
    own = np.array(log.texts.get("load", ()) if "load" in points.texts else (), dtype=object)
    for load in dict.fromkeys(loads):
        rows = np.flatnonzero(own == load) if len(own) else np.arange(len(log))
        yield load, np.flatnonzero(loads == load), rows


def _visits(points: Records, chosen: IntArray, per_pose: int | None) -> IntArray:
    """(chosen,): points measured without moving the arm in between are of one visit."""
    n = len(chosen)
    if per_pose is not None:
        return np.arange(n) // per_pose
    if "configuration" in points.texts:
        names = [points.texts["configuration"][i] for i in chosen]
        return np.cumsum([k > 0 and names[k] != names[k - 1] for k in range(n)])
    markers = [points.texts["marker"][i] for i in chosen] if "marker" in points.texts else []
    if len(set(markers)) < 2:
        return np.arange(n)
    begins, measured = [], set[str]()
    for k, marker in enumerate(markers):
        begins.append(marker in measured and marker != markers[k - 1])
        if begins[-1]:
            measured = set()
        measured.add(marker)
    return np.cumsum(begins)


def _by_order(points: Records, log: Records, settings: JoinTable) -> Joined:
    row, per = np.full(len(points), -1), settings.points_per_pose
    for load, chosen, rows in _loads_apart(points, log):
        visits = _visits(points, chosen, per)
        sizes = np.bincount(visits)
        if len(sizes) != len(rows) or (per is not None and len(chosen) % per):
            of, hint, most = f" under load {load}" * bool(load), "", np.bincount(sizes).argmax()
            for odd in np.flatnonzero(sizes != most)[:1]:
                start = points.shown(int(chosen[np.argmax(visits == odd)]))
                hint = (
                    f"; the visit that begins at {start} has {sizes[odd]} points, most have {most}"
                )
            raise InputError(
                f"{points.source}: {len(chosen)} points{of} in {len(sizes)} visits, but "
                f"{listed(log.files, 3)} has {len(rows)} poses, and they are joined by "
                f"order{hint}; {_ADVICE['order']}"
            )
        row[chosen] = rows[visits]
    names = _names_of(log)
    return Joined("order", row, log.q[row], [names[r] for r in row] if names else None)


def _by_name(points: Records, log: Records, settings: JoinTable) -> Joined:
    names = _names_of(log)
    own = points.texts.get("configuration", [])
    for pool, has in ((log, names), (points, own)):
        require(
            has,
            f"{pool.source}: no names of poses, by which [join] is to join; map name or "
            "configuration in [source.columns], and a pattern in [source.names]",
        )
    q, row = log.q, np.full(len(points), -1)
    force = np.column_stack([np.zeros(len(log)), *(log.numbers[stem] for stem in log.forces)])
    markers, key = points.texts.get("marker", own), _keys(own, names) or _key
    unused: set[int] = set(range(len(log)))
    for _, chosen, rows in _loads_apart(points, log):
        known, taken = defaultdict[str, list[int]](list), defaultdict[tuple, list[int]](list)
        for r in rows:
            (visits := known[key(names[r])]).append(int(r))
            if not np.array_equal(q[visits[0]], q[r]):
                raise InputError(
                    f"{log.where(int(r))}: pose {names[r]} has other joint values than in line "
                    f"{log.line[visits[0]]}; name visits apart, or say which load each belongs to"
                )
        runs = _visits(points, chosen, None)
        for k, i in enumerate(chosen):
            taken[key(own[i]), markers[i]].append(k)
        for (name, _), some in taken.items():
            at, n = np.array(known.get(name, [-1])), len(some)
            states = len(np.unique(force[at], axis=0))
            at = at[: None if states > 1 else 1]
            nth = np.unique(runs[some], return_inverse=True)[1]
            if nth[-1] + 1 != (k := len(at)):  # as many each, if none is a half of a load's
                nth = np.arange(n) * k // n
                lines = listed((str(log.line[r]) for r in at), SHOWN)
                require(
                    n % k == 0 and (k in (n, states)),
                    f"{points.shown(int(chosen[some[0]]))}: {counted(n, 'reading')}, but "
                    f"{log.source} visits the pose under several loads (lines {lines}); give each "
                    "load's points in a file of its own, with load in its [[source]]",
                )
            row[chosen[some]] = at[nth]
        used = {key(own[i]) for i in chosen}
        unused -= {int(r) for r in rows if key(names[r]) in used}
    left_out = tuple(points.shown(int(i)) for i in np.flatnonzero(row < 0))
    spare = tuple(dict.fromkeys(log.shown(r) for r in sorted(unused)))
    remarks = tuple(
        f"by the numbers at the ends of the names ({own[i]} is {names[row[i]]})"
        for i in np.flatnonzero(row >= 0)[:1] if key is _number
    )  # fmt: skip
    return Joined("name", row, q[row], None, left_out, spare, remarks)


def _nearest(at: Array, first: Array, last: Array) -> tuple[IntArray, Array]:
    """Number of the stop, from `first` to `last` (k,) s, that is nearest to each time `at` (n,),
    and the time to its nearer end, 0 within it."""

    def apart(stop: IntArray) -> Array:
        return np.maximum(np.maximum(first[stop] - at, at - last[stop]), 0.0)

    after = np.clip(np.searchsorted(first, at), 0, len(first) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(apart(before) <= apart(after), before, after)
    return nearest, apart(nearest)


def _by_clock(points: Records, log: Records, settings: JoinTable, how: str) -> Joined:
    at, clock, q, order = _clocks(points, log, settings, how)
    still, shortest = log.spread(settings.still_deg, settings.still_mm), settings.still_s
    first, last, standing = np.arange(len(q)), np.arange(len(q)), q
    if how == "standstill":
        first, last, standing = dwells(clock, q, still, shortest)
        require(
            len(first),
            f"{log.source}: the arm never stood still for {shortest:g} s; correct still_s and "
            "still_deg in [join], or join by time",
        )
    stop, apart = _nearest(at, clock[first], clock[last])
    good = apart <= settings.tolerance_s
    unused, remarks, warnings = tuple[str, ...](), list[str](), list[str]()
    if how == "standstill":
        remarks += [f"{len(first)} standstills of {shortest:g} s or more in {len(log)} rows"]
        empty = np.setdiff1d(np.arange(len(first)), stop[good])
        unused = tuple(f"standstill {k + 1} (from line {log.line[order[first[k]]]})" for k in empty)
    else:
        # From the row before to the one after each point; rows of other stops say nothing of it.
        ends = [np.clip(stop + step, 0, len(q) - 1) for step in (-1, 1)]
        soon = [np.abs(clock[k] - at) <= 2 * settings.tolerance_s for k in ends]
        before, after = (np.where(near, k, stop) for near, k in zip(soon, ends, strict=True))
        moving = np.flatnonzero(good & (np.abs(q[after] - q[before]) > still).any(axis=1))
        if good.any():
            remarks += [f"clocks differ by {rounded(apart[good].max())} s at most, "
                        f"{rounded(np.median(apart[good]))} s in the median"]  # fmt: skip
        if len(moving):
            warnings.append(
                f"the arm moved while {len(moving)} points were measured: "
                f"{listed((points.shown(int(i)) for i in moving), SHOWN)}; set offset_s, or join "
                "by standstill"
            )
    what = " standstill" * (how == "standstill")
    left_out = tuple(
        f"{points.shown(int(i))}, {rounded(apart[i])} s from the nearest{what}"
        for i in np.flatnonzero(~good)
    )
    row = np.where(good, order[first[stop]], -1)
    return Joined(how, row, standing[stop], None, left_out, unused, tuple(remarks), tuple(warnings))


WHOLE = re.compile(r"-?[0-9]{1,15}")

# Header → n texts or numbers, in the order of the table; note_source says where each row is from.
Columns = dict[str, Sequence[str] | NDArray]


def assemble(
    where: str, points: Records, mapping: MappingTable
) -> tuple[Columns, tuple[str, ...], list[str]]:
    """A row for each point; the kind of each joint; sentences for the preview.  Configurations are
    those of the names, else of the joint log, else joint values that agree within same_pose_deg.
    Repeats are numbered in order where the file does not number them.  Times are counted from the
    first reading."""
    settings, n = mapping.join, len(points)
    numbers, units = dict(points.numbers), dict(points.units)
    stems = joint_stems(numbers)
    if not stems:
        raise InputError(
            f"{where}: no joint values; map q1_deg … in [source.columns], or add a [[source]] with "
            'role = "joints"'
        )
    kinds = tuple("revolute" if units[stem] == "deg" else "prismatic" for stem in stems)
    forces = exports.forces_of(where, points, mapping.loads)
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
            told = f"repeat {quoted(text)} is no whole number; correct the pattern or the column"
            raise InputError(f"{points.where(k)}: {told}")
        first = known.setdefault((*key, int(text)), k)
        if first != k:
            raise InputError(
                f"{points.where(k)}: repeat {text} of configuration {key[0]}"
                f"{f', marker {key[1]}' if key[1] else ''} stands in line {points.line[first]} "
                "too; leave the repeat out of the pattern to have shots numbered in order"
            )
    return np.array([int(text) for text in stated], dtype=np.int64)


# Industrial arms measured by trackers: radians of a campaign span more than this, degrees too.
SMALLEST_SPREAD_DEG = 7.0  # 2 pi: a column of radians read as degrees spans less
LARGEST_TURN_DEG = 720.0
FARTHEST_M, LARGEST_SPREAD_M, LEAST_SPREAD_M = 150.0, 30.0, 0.02
LARGEST_FORCE_N = 2e5
LARGEST_SIGMA_M = 5e-3


def plausibility(columns: Columns, table: Measurements, deflections: bool) -> list[str]:
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
        ((deflections and lonely,
          f"{len(lonely)} of {len(labels)} configurations were not measured both "
          f"unloaded and loaded, as deflections need: {listed(lonely, 8)}"),),
    )  # fmt: skip
    return [told for row in doubts for told in [text for so, text in row if so][:1]]


@dataclass(frozen=True)
class Imported:
    """`table` is the measurement table as `text` reads; `refused` says why the robot of the cell
    cannot have measured it."""

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
    """Nothing is written.  `cell`: the robot that the table must fit: number and kind of joints,
    markers, limits; `name`: what messages call the table."""
    where, table = mapping
    chain = None if cell is None else load_chain(cell)
    names = () if chain is None else tuple(joint.name for joint in chain.joints)
    by_role, understood, spherical = _by_role(where, files, table, names)
    told = [doubt for own in by_role.values() for records in own for doubt in records.doubts]
    by_role, warnings = exports.with_loads_of_names(by_role, table.loads)
    points = pooled(by_role["points"])
    log = pooled(by_role["joints"]) if by_role["joints"] else None
    joined = None
    if log is not None:
        lack = f"{log.source}: no joint values; map q1_deg … (or q#_deg) in its [source.columns]"
        require(log.q.shape[1], lack)
        if log.forces and ("load" in points.texts or points.forces):
            warnings.append(f"{log.source}: its loads are not taken, as the points state theirs")
            kept = {stem: v for stem, v in log.numbers.items() if stem not in FORCES}
            log = replace(log, numbers=kept)
        joined = join(points, log, table.join)
        points = _with_joint_values(points, log, joined)
    columns, kinds, doubts = assemble(where, points, table)
    # Numbers with the digits that read back exactly.
    cells = [[repr(v + 0) for v in values.tolist()] if isinstance(values, np.ndarray) else values
             for values in columns.values()]  # fmt: skip
    text = csv_text(columns, zip(*cells, strict=True))
    markers: tuple[str, ...] = ()
    observe = "position" if any(c.startswith("x_") for c in columns) else "distance"
    if cell is not None and chain is not None:
        kinds, markers, observe = chain.kinds, tuple(cell.tool.markers), cell.model.observe
    with _placed(points):  # as the reader of `identify` reads it, and as the cell asks for it
        measured = read_measurements(
            f"{name} (not written)", joint_kinds=kinds, marker_names=markers, observe=observe,
            text=text,
        )  # fmt: skip
    fit, refused = None, ""
    if cell is not None and chain is not None:
        if (beyond := beyond_limits(cell, chain, measured.q)) is not None:
            rows, _, why = beyond
            refused = (
                f"{columns['note_source'][rows[0]]}: {why} ({len(rows)} of {len(measured)} rows); "
                "correct unit, sign, offset_deg or order in [joints], or the limits of the cell"
            )
        fit = nominal_fit(chain, cell, measured, spherical)
    judged = plausibility(columns, measured, cell is not None and observe == "deflection")
    warnings += [*told, *(joined.warnings if joined else ()), *doubts, *judged]
    warnings += [fit.warning] if fit is not None and fit.warning else []
    return Imported(
        tuple(understood), columns, joined, text, measured, tuple(warnings), fit, refused
    )


def _by_role(
    where: str, files: Sequence[Path], table: MappingTable, names: tuple[str, ...]
) -> tuple[dict[str, list[Records]], list[dict[str, Any]], bool]:
    """Of each file among "points" or "joints", what is to be told of each, and whether any states
    angles in the place of positions."""
    by_role: dict[str, list[Records]] = {"points": [], "joints": []}
    understood, spherical = [], False
    for path, source in _assigned(where, files, table.source or ()):
        found = exports.read_records(where, path, source, table.units)
        found = exports.with_labels(where, found, source.names)
        spherical = spherical or not found.numbers.keys().isdisjoint(exports.SPHERICAL)
        found = exports.with_positions(found, clockwise=source.azimuth == "clockwise")
        role = source.role or ("both" if "x" in found.numbers or "distance" in found.numbers
                               else "joints")  # fmt: skip
        if role in ("joints", "both") and joint_stems(found.numbers):
            found = with_joints(where, found, table.joints, names)
        by_role["joints" if role == "joints" else "points"].append(found)
        read = {"role": role, "rows": len({*found.line}), "ignored": sorted(found.ignored)}
        understood.append(found.understood | read)
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
    """A file goes to the first source whose `files` pattern fits its name; sources without a
    pattern share the rest: one takes them all, several take one file each, in order."""
    chosen: dict[Path, SourceTable] = {}
    for i, path in enumerate(files):
        require(path not in files[:i], f"{path}: named twice; name each file once")
        for source in reversed(sources):
            if any(fnmatchcase(n, p) for p in source.files or () for n in (path.name, str(path))):
                chosen[path] = source
    rest = [path for path in files if path not in chosen]
    for source in sources:
        require(
            not source.files or source in chosen.values(),
            f"{where}: no file fits files = {listed(map(quoted, source.files or ()))}; the files "
            f"are {listed((p.name for p in files), 8)}",
        )
    free = [source for source in sources if not source.files]
    free = free * len(rest) if len(free) == 1 and rest else free
    require(
        len(free) == len(rest),
        f"{where}: {len(free)} sources without a files pattern for {len(rest)} files "
        f'({listed(map(str, rest), 8) or "none left"}); give files = ["pattern"] in each '
        "[[source]], or one preset per file",
    )
    chosen |= dict(zip(rest, free, strict=True))
    return [(path, chosen[path]) for path in files]
