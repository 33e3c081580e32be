"""What a row stands for: point, marker, pose and load by name, its position from distance and
angles, joint values as the model counts them; and which joint values belong to which point."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from elastocal.importing import exports
from elastocal.importing.exports import Records, joint_stems
from elastocal.importing.mapping_file import JoinTable, JointsTable, NamesTable
from elastocal.messages import InputError, is_label, listed, quoted, rounded
from elastocal.units import Array, IntArray

HEIGHT = ("zenith", "elevation")
SPHERICAL = ("range", "azimuth", *HEIGHT)


def with_positions(records: Records, clockwise: bool = False) -> Records:
    """The records with x, y, z, where the file has spherical coordinates.

    With range d, azimuth α and zenith angle ζ (π/2 − elevation), in a right-handed frame with z up
    and x at azimuth zero:

        x = d sin ζ cos α,   y = d sin ζ sin α,   z = d cos ζ

    α counts counterclockwise seen from above; where `clockwise`, as theodolites count, y has the
    other sign.  Readings in the second face, ζ beyond 180° with α turned by 180°, come out right.
    """
    found = [stem for stem in SPHERICAL if stem in records.numbers]
    both = [stem for stem in "xyz" if stem in records.numbers]
    heights = [stem for stem in HEIGHT if stem in found]
    missing = [stem for stem in ("range", "azimuth") if stem not in found]
    missing += [] if heights else ["zenith or elevation"]
    if not found:
        return records
    if both:
        raise InputError(
            f"{records.source}: positions are mapped twice, as {listed(both)} and as "
            f"{listed(found)}; keep one of the two in [source.columns]"
        )
    if len(heights) > 1:
        raise InputError(
            f"{records.source}: both zenith and elevation are mapped; keep the one that the file "
            "gives (a level line has zenith 90° and elevation 0°)"
        )
    if missing:
        raise InputError(
            f"{records.source}: {listed(found)} without {listed(missing)}; map range_mm, "
            "azimuth_deg, and zenith_deg or elevation_deg in [source.columns]"
        )
    height, numbers = heights[0], dict(records.numbers)
    d = numbers.pop("range")
    alpha, angle = np.radians(numbers.pop("azimuth")), numbers.pop(height)
    if not (d > 0).all():
        i = int(np.argmin(d > 0))
        raise InputError(
            f"{records.where(i)}: a range of {d[i]:g} mm; a distance is "
            "positive: correct the line, or the column of range in [source.columns]"
        )
    low, high, other = (0.0, 360.0, "elevation") if height == "zenith" else (-90.0, 90.0, "zenith")
    off = (angle < low) | (angle > high)
    if off.any():
        i = int(np.argmax(off))
        raise InputError(
            f"{records.where(i)}: {height} of {angle[i]:.6g}°, which lies beyond {low:g}° to "
            f"{high:g}°; is it an angle of another unit, or {other}_deg?"
        )
    zeta = np.radians(angle if height == "zenith" else 90.0 - angle)
    level = d * np.sin(zeta)
    y = level * np.sin(alpha)
    numbers |= {"x": level * np.cos(alpha), "y": -y if clockwise else y, "z": d * np.cos(zeta)}
    kept = {stem: unit for stem, unit in records.units.items() if stem not in SPHERICAL}
    return replace(records, numbers=numbers, units=kept | dict.fromkeys("xyz", "mm"))


GROUPS = ("configuration", "marker", "repeat", "load")
NAMED = "write pattern in [source.names]"


def with_labels(where: str, records: Records, names: NamesTable) -> Records:
    """The records with the texts of GROUPS, from columns and, where a pattern is given, from names.

    A group that a column gives too is taken from the column.  A name that no pattern matches is
    an error, or with unmatched = "ignore" passed over and listed.
    """
    if names.pattern is not None and "name" in records.texts:
        records = _with_names_read(where, records, names)
    labels = {stem: records.texts[stem] for stem in GROUPS if stem in records.texts}
    if "marker" in labels:
        labels["marker"] = [names.markers.get(m, m) for m in labels["marker"]]
    if names.in_order and "marker" not in labels:
        n = len(names.in_order)
        labels["marker"] = [names.in_order[i % n] for i in range(len(records))]
        if len(records) % n:
            raise InputError(
                f"{records.source}: {len(records)} points, which is no multiple of the {n} markers "
                f"{listed(names.in_order)} of in_order; a point is missing or one too many: name "
                "the points"
            )
    for stem, texts in labels.items():
        for i, text in enumerate(texts):
            if not is_label(text):
                raise InputError(
                    f"{records.where(i)}: {stem} {quoted(text)} cannot stand in a table; correct "
                    f"the name, or {NAMED}"
                )
    return replace(records, texts=records.texts | labels)


def _with_names_read(where: str, records: Records, names: NamesTable) -> Records:
    named = records.texts["name"]
    patterns = [names.pattern] if isinstance(names.pattern, str) else list(names.pattern or ())
    expressions = [exports.compiled(where, "pattern", text) for text in patterns]
    for expression in expressions:
        if not set(expression.groupindex) & set(GROUPS):
            raise InputError(
                f"{where}: pattern = {quoted(expression.pattern)} has none of the groups "
                f"{listed(f'(?P<{g}>…)' for g in GROUPS)}; name the parts of the name so"
            )
    matches = [next((m for e in expressions if (m := e.search(n))), None) for n in named]
    groups = [match.groupdict() if match else {} for match in matches]
    bad = [i for i, match in enumerate(matches) if match is None]
    if bad and (names.unmatched != "ignore" or len(bad) == len(named)):
        more = {1: "", 2: ", nor does 1 other"}.get(len(bad), f", nor do {len(bad) - 1} others")
        raise InputError(
            f"{records.where(bad[0])}: the name {quoted(named[bad[0]])} matches no pattern "
            f'({listed(map(quoted, patterns), 3)}){more}; {NAMED}, or unmatched = "ignore" to '
            "leave such points out"
        )
    found = {stem: [(own.get(stem) or "").strip() for own in groups] for stem in GROUPS}
    present = {stem: texts for stem, texts in found.items() if any(texts)}
    for stem, texts in present.items():
        empty = [i for i, text in enumerate(texts) if not text and matches[i]]
        if empty and stem in ("configuration", "marker"):
            raise InputError(
                f"{records.where(empty[0])}: the name {quoted(named[empty[0]])} says no {stem}, "
                f"others do; {NAMED} that finds it in every name"
            )
        if empty:
            default = "0" if stem == "repeat" else "none"
            present[stem] = [text or default for text in texts]
    reasons = [(int(records.line[i]), f"{quoted(named[i])} matches no pattern") for i in bad]
    good = np.setdiff1d(np.arange(len(records)), bad)
    kept = replace(records, texts=present | records.texts).take(good)
    ignored = tuple(sorted([*records.understood["ignored"], *reasons]))
    return replace(kept, understood=kept.understood | {"rows": len(kept), "ignored": ignored})


def with_joints(
    where: str, records: Records, joints: JointsTable, model_names: Sequence[str] = ()
) -> Records:
    """The records with q1 … qn as the robot model counts them: order, sign, offset, coupling.

        q_j = sign_j * c_{order(j)} + offset_j + Σ factor * q_i

    with c the controller's values and the sum over the couplings of joint j; q_i there is the value
    before any coupling, so the couplings do not depend on their order.

    The order is that of [joints] order, else the joint names of the file (columns joint1 …) are
    brought into the order of [joints] names, else of `model_names` where the file has them all.
    """
    stems = joint_stems(records.numbers)
    if not stems:
        return records
    wrong = [stem for i, stem in enumerate(stems, 1) if stem != f"q{i}"]
    if wrong:
        raise InputError(
            f"{records.source}: the mapping fills {listed(stems)}, but not q"
            f"{int(wrong[0][1:]) - 1}; joints are numbered from 1 without gaps"
        )
    taken = _order(where, records, joints, model_names, len(stems))
    units = [records.units[stems[j]] for j in taken[0]]
    n = len(units)
    for key in ("sign", "offset_deg", "offset_mm"):
        given = getattr(joints, key)
        if given is not None and len(given) != n:
            raise InputError(
                f"{where}: [joints] {key} has {len(given)} numbers, but there are {n} joints; give "
                "one per joint"
            )
        for j, (value, unit) in enumerate(zip(given or (), units, strict=False), 1):
            if key == "sign" and abs(value) != 1:
                raise InputError(f"{where}: [joints] sign takes 1 or -1 per joint; found {value:g}")
            if key != "sign" and value and not key.endswith(unit):
                raise InputError(
                    f"{where}: [joints] {key} is {value:g} for joint {j}, which is in {unit}; give "
                    f"offset_{unit}"
                )
    none = [0.0] * n
    offset = np.where(np.array(units) == "deg", joints.offset_deg or none, joints.offset_mm or none)
    before = np.take_along_axis(records.q, taken, axis=1) * (joints.sign or [1.0] * n) + offset
    q = before.copy()
    for k, coupling in enumerate(joints.coupling):
        for name in ("joint", "of"):
            number = getattr(coupling, name)
            if number > n:
                raise InputError(
                    f"{where}: {name} = {number} of [joints] coupling no. {k + 1}: the file has "
                    f"{n} joints"
                )
        j, i = coupling.joint - 1, coupling.of - 1
        if units[j] != units[i]:
            raise InputError(
                f"{where}: [joints] coupling no. {k + 1} joins a revolute and a prismatic joint; "
                "give the factor in other units outside the mapping"
            )
        q[:, j] += coupling.factor * before[:, i]
    numbers = {s: v for s, v in records.numbers.items() if s not in stems}
    own = {s: u for s, u in records.units.items() if s not in stems}
    made = [f"q{j + 1}" for j in range(n)]
    return replace(
        records,
        numbers=numbers | dict(zip(made, q.T, strict=True)),
        units=own | dict(zip(made, units, strict=True)),
    )


def _order(
    where: str, records: Records, joints: JointsTable, model_names: Sequence[str], n: int
) -> IntArray:
    """(rows, joints): the file's joint, from 0, for each joint of the robot."""
    order = joints.order or list(range(1, n + 1))
    if max(order) > n or len(set(order)) != len(order):
        raise InputError(
            f"{where}: [joints] order = {order} takes each of the file's {n} joints at most once"
        )
    as_stated = np.tile(np.array(order) - 1, (len(records), 1))
    columns = [records.texts[f"joint{i}"] for i in range(1, n + 1) if f"joint{i}" in records.texts]
    if joints.order is not None or len(columns) != n:
        if joints.order is None and joints.names is not None:
            raise InputError(
                f"{where}: [joints] names needs the joint names of the file: add "
                'joint# = "name_#0" to [source.columns], or use order'
            )
        return as_stated
    found = list(zip(*columns, strict=True))
    wanted = joints.names or (model_names if set(model_names) <= set(found[0]) else None)
    if not wanted:
        return as_stated
    orders: dict[tuple[str, ...], list[int]] = {}
    rows = []
    for i, names in enumerate(found):
        if names not in orders:
            absent = [name for name in wanted if name not in names]
            if absent:
                raise InputError(
                    f"{records.where(i)}: no joint {listed(absent)}; the row has {listed(names)}: "
                    "correct [joints] names, or leave out messages of other joints"
                )
            orders[names] = [names.index(name) for name in wanted]
        rows.append(orders[names])
    return np.array(rows)


def pooled(records: Sequence[Records]) -> Records:
    if any(r.load is not None for r in records):
        for r in records:
            if "load" not in r.texts and r.load is None:
                raise InputError(
                    f"{r.source}: says no load, other files do; give load in its [[source]], or a "
                    "group (?P<load>…) in its pattern"
                )
        records = [replace(r, texts={"load": [str(r.load)] * len(r)} | r.texts) for r in records]
    first, *others = records
    for other in others:
        for what, one, two in (
            ("columns", set(first.numbers), set(other.numbers)),
            ("labels", {*GROUPS} & {*first.texts}, {*GROUPS} & {*other.texts}),
        ):
            if one != two:
                has, lacks = (first, other) if one - two else (other, first)
                raise InputError(
                    f"{lacks.source}: has no {listed(sorted(one ^ two))}, but {has.source} has; "
                    f"files of one kind need the same {what}: correct [[source]], or import them "
                    "one by one"
                )
    return Records.stacked(records)


CHUNK = 1024


def dwells(
    time: Array, q: Array, still: Array, shortest: float
) -> tuple[IntArray, IntArray, Array]:
    """The longest runs of rows in which no joint moves by more than `still`: the first and the
    last row of each (k,), and where the arm stands then (k, n), the median.

    `time` (m,) s, rising; `q` (m, n); `still` (n,): the largest max - min of each joint within a
    dwell, in the unit of q; `shortest` s between its first and last row.  Runs are taken from
    the start of the log on, each as long as it can be; shorter ones count as motion.
    """
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
    """`row` (points,) into the joint log, -1 without a partner; `q` (points, joints).

    `pose` (points,) names the pose where the log does, None where it does not; `left_out` and
    `unused` say which points and which poses found no partner; `remarks` and `warnings` are for
    the preview.
    """

    how: str
    row: IntArray
    q: Array
    pose: list[str] | None = None
    left_out: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def join(points: Records, log: Records, settings: JoinTable) -> Joined:
    """By name where names agree, by time where both have one, else by order, unless stated."""
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


def _likely_offset(points: Records, log: Records, settings: JoinTable, how: str) -> str:
    """The offset of the log's clock at which most points fall into standstills, as a hint.

    "" where the join is not by clocks, few points would, or two offsets would do as well.
    """
    if how not in ("time", "standstill"):
        return ""
    at, order = points.clock(how), np.argsort(log.clock(how), kind="stable")
    clock = log.clock(how)[order] + settings.offset_s
    still = log.spread(settings.still_deg, settings.still_mm)
    first, last, _ = dwells(clock, log.q[order], still, settings.still_s)
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
    """What two lists of names have in common: whole names, else the numbers at their ends where
    these tell the names of each list apart; None where there is nothing."""
    for key in (_key, _number):
        mine, other = {key(n) for n in ours}, {key(n) for n in theirs}
        apart = all(len({key(n) for n in names}) == len({_key(n) for n in names})
                    for names in (ours, theirs))  # fmt: skip
        if mine & other and apart:
            return key
    return None


def _loads_apart(points: Records, log: Records) -> Iterator[tuple[str, IntArray, IntArray]]:
    """Each load of the points, and the rows of both under it."""
    loads = np.array(points.texts.get("load", [""] * len(points)), dtype=object)
    own = np.array(log.texts.get("load", ()) if "load" in points.texts else (), dtype=object)
    for load in dict.fromkeys(loads):
        rows = np.flatnonzero(own == load) if len(own) else np.arange(len(log))
        yield load, np.flatnonzero(loads == load), rows


def _visits(points: Records, chosen: IntArray, per_pose: int | None) -> IntArray:
    """(chosen,) number of the visit: points measured without moving the arm in between."""
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
        count = int(visits.max()) + 1
        if count != len(rows) or (per is not None and len(chosen) % per):
            of, hint = f" under load {load}" if load else "", ""
            sizes = np.bincount(visits)
            most = np.bincount(sizes).argmax()
            for odd in np.flatnonzero(sizes != most)[:1]:
                start = points.shown(int(chosen[np.argmax(visits == odd)]))
                hint = (
                    f"; the visit that begins at {start} has {sizes[odd]} points, most have {most}"
                )
            raise InputError(
                f"{points.files[0]}: {len(chosen)} points{of} in {count} visits, but "
                f"{listed(log.files, 3)} has {len(rows)} poses, and they are joined by "
                f"order{hint}; {_ADVICE['order']}"
            )
        row[chosen] = rows[visits]
    names = _names_of(log)
    return Joined("order", row, log.q[row], [names[r] for r in row] if names else None)


def _by_name(points: Records, log: Records, settings: JoinTable) -> Joined:
    names = _names_of(log)
    for pool, has in ((log, bool(names)), (points, "configuration" in points.texts)):
        if not has:
            raise InputError(
                f"{pool.files[0]}: no names of poses, by which [join] is to join; map name or "
                "configuration in [source.columns], and a pattern in [source.names]"
            )
    q, row = log.q, np.full(len(points), -1)
    key = _keys(points.texts["configuration"], names) or _key
    unused: set[int] = set(range(len(log)))
    for _, chosen, rows in _loads_apart(points, log):
        known: dict[str, int] = {}
        for r in rows:
            first = known.setdefault(key(names[r]), int(r))
            if first != r and not np.array_equal(q[first], q[r]):
                raise InputError(
                    f"{log.where(int(r))}: pose {names[r]} has other joint values than in line "
                    f"{log.line[first]}; name visits apart, or say which load each belongs to"
                )
        for i in chosen:
            row[i] = known.get(key(points.texts["configuration"][i]), -1)
        used = {key(names[r]) for r in row[chosen] if r >= 0}
        unused -= {int(r) for r in rows if key(names[r]) in used}
    left_out = tuple(points.shown(int(i)) for i in np.flatnonzero(row < 0))
    spare = tuple(dict.fromkeys(log.shown(r) for r in sorted(unused)))
    remarks: tuple[str, ...] = ()
    for i in np.flatnonzero(row >= 0)[:1] if key is _number else ():
        told = f"{points.texts['configuration'][i]} is {names[row[i]]}"
        remarks = (f"by the numbers at the ends of the names ({told})",)
    return Joined("name", row, q[row], None, left_out, spare, remarks)


def _nearest(at: Array, first: Array, last: Array) -> tuple[IntArray, Array]:
    """Number of the stop, from `first` to `last` (k,) s, one after the other, that is nearest to
    each time `at` (n,), and the time to its nearer end, 0 within it."""

    def apart(stop: IntArray) -> Array:
        return np.maximum(np.maximum(first[stop] - at, at - last[stop]), 0.0)

    after = np.clip(np.searchsorted(first, at), 0, len(first) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(apart(before) <= apart(after), before, after)
    return nearest, apart(nearest)


def _by_clock(points: Records, log: Records, settings: JoinTable, how: str) -> Joined:
    at, order = points.clock(how), np.argsort(log.clock(how), kind="stable")
    clock = log.clock(how)[order] + settings.offset_s
    still, shortest = log.spread(settings.still_deg, settings.still_mm), settings.still_s
    q = log.q[order]
    first, last, standing = np.arange(len(q)), np.arange(len(q)), q
    if how == "standstill":
        first, last, standing = dwells(clock, q, still, shortest)
        if not len(first):
            raise InputError(
                f"{log.files[0]}: the arm never stood still for {shortest:g} s; correct still_s "
                "and still_deg in [join], or join by time"
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
