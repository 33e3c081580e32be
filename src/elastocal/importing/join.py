"""Which joint values belong to which point: by order, name, time or standstill."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from elastocal.errors import InputError
from elastocal.importing.pool import Array, IntArray, Pool
from elastocal.importing.schema import JoinTable
from elastocal.importing.standstill import standstills
from elastocal.text import listed

TOLERANCE_S, STILL_DEG, STILL_MM, STILL_S = 0.5, 0.01, 0.01, 1.0
SHOWN = 8


@dataclass(frozen=True)
class Joined:
    """`row` (points,) into the joint log, -1 without a partner; `q` (points, joints).

    `pose` (points,) names the pose where the log does, None where it does not; `left_out` and
    `unused` say which points and which poses found no partner; `remarks` are for the preview.
    """

    how: str
    row: IntArray
    q: Array
    pose: list[str] | None
    left_out: tuple[str, ...]
    unused: tuple[str, ...]
    remarks: tuple[str, ...]


def join(where: str, points: Pool, log: Pool, settings: JoinTable | None) -> Joined:
    """The joint values of every point.

    Raises InputError where points have no partner and [join] unmatched is not "leave_out", where
    the counts of an order do not agree, and where names or times are missing.
    """
    settings = settings or JoinTable()
    how = settings.by or _obvious(points, log)
    ways = {"order": _by_order, "name": _by_name, "time": _by_time, "standstill": _by_standstill}
    found = ways[how](where, points, log, settings)
    if found.left_out and settings.unmatched != "leave_out":
        raise InputError(
            f"{points.files[0]}: {len(found.left_out)} of {len(points)} points have no joint "
            f"values in {listed(log.files, 3)} (joined by {how}): {listed(found.left_out, SHOWN)}; "
            f'{_ADVICE[how]}, or set unmatched = "leave_out" in [join]'
        )
    if (found.row < 0).all():
        raise InputError(
            f"{points.files[0]}: no point has joint values in {listed(log.files, 3)} (joined by "
            f"{how}); {_ADVICE[how]}"
        )
    return found


_ADVICE = {
    "order": "set points_per_pose in [join], or join by name",
    "name": "correct the patterns in [source.names], so that both files give the same names",
    "time": "correct offset_s or tolerance_s in [join]",
    "standstill": "correct offset_s, tolerance_s, still_deg or still_s in [join]",
}


def _obvious(points: Pool, log: Pool) -> str:
    """By name where names agree, by time where both have one, else by order."""
    if "configuration" in points.labels and _keys(points.labels["configuration"], _names_of(log)):
        return "name"
    return "time" if points.time is not None and log.time is not None else "order"


def _names_of(log: Pool) -> list[str]:
    return log.labels.get("configuration") or (log.names if any(log.names) else [])


def _key(name: str) -> str:
    """The same text for names that people take for one: P01, p1."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name.strip().casefold())


def _number(name: str) -> str:
    """The number at the end of a name: 7 for P07, pose_7 and 7."""
    found = re.search(r"\d+$", _key(name))
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


def _loads_apart(points: Pool, log: Pool) -> list[tuple[str, IntArray, IntArray]]:
    """(load, points, rows of the log): a log without loads serves every load state."""
    if "load" not in points.labels:
        return [("", np.arange(len(points)), np.arange(len(log)))]
    loads = np.array(points.labels["load"], dtype=object)
    own = log.labels.get("load")
    parts = []
    for load in dict.fromkeys(points.labels["load"]):
        rows = np.arange(len(log)) if own is None else np.flatnonzero(np.array(own, object) == load)
        parts.append((load, np.flatnonzero(loads == load), rows))
    return parts


def _visits(points: Pool, chosen: IntArray, per_pose: int | None) -> IntArray:
    """(chosen,) number of the visit: points measured without moving the arm in between."""
    n = len(chosen)
    if per_pose is not None:
        return np.arange(n) // per_pose
    if "configuration" in points.labels:
        names = [points.labels["configuration"][i] for i in chosen]
        return np.cumsum([k > 0 and names[k] != names[k - 1] for k in range(n)])
    markers = [points.labels["marker"][i] for i in chosen] if "marker" in points.labels else []
    if len(set(markers)) < 2:
        return np.arange(n)
    visit, seen, codes = 0, set[str](), []
    for k, marker in enumerate(markers):
        if marker in seen and marker != markers[k - 1]:
            visit, seen = visit + 1, set()
        seen.add(marker)
        codes.append(visit)
    return np.array(codes)


def _by_order(where: str, points: Pool, log: Pool, settings: JoinTable) -> Joined:
    row = np.full(len(points), -1)
    for load, chosen, rows in _loads_apart(points, log):
        visits = _visits(points, chosen, settings.points_per_pose)
        count = int(visits.max()) + 1
        per = settings.points_per_pose
        if count != len(rows) or (per is not None and len(chosen) % per):
            of = f" under load {load}" if load else ""
            sizes = np.bincount(visits)
            odd = np.flatnonzero(sizes != np.bincount(sizes).argmax())
            start = chosen[np.flatnonzero(visits == odd[0])[0]] if len(odd) else None
            hint = "" if start is None else (
                f"; the visit that begins at {points.shown(int(start))} has {sizes[odd[0]]} "
                f"points, most have {np.bincount(sizes).argmax()}"
            )  # fmt: skip
            raise InputError(
                f"{points.files[0]}: {len(chosen)} points{of} in {count} visits, but "
                f"{listed(log.files, 3)} has {len(rows)} poses, and they are joined by "
                f"order{hint}; "
                f"{_ADVICE['order']}"
            )
        row[chosen] = rows[visits]
    names = _names_of(log)
    pose = [names[r] for r in row] if names else None
    return Joined("order", row, log.q[row], pose, (), (), ())


def _by_name(where: str, points: Pool, log: Pool, settings: JoinTable) -> Joined:
    names = _names_of(log)
    for pool, has in ((log, bool(names)), (points, "configuration" in points.labels)):
        if not has:
            raise InputError(
                f"{pool.files[0]}: no names of poses, by which [join] is to join; map name or "
                "configuration in [source.columns], and a pattern in [source.names]"
            )
    q, row = log.q, np.full(len(points), -1)
    key = _keys(points.labels["configuration"], names) or _key
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
            row[i] = known.get(key(points.labels["configuration"][i]), -1)
        used = {key(names[r]) for r in row[chosen] if r >= 0}
        unused -= {int(r) for r in rows if key(names[r]) in used}
    left_out = tuple(points.shown(int(i)) for i in np.flatnonzero(row < 0))
    spare = tuple(dict.fromkeys(log.shown(r) for r in sorted(unused)))
    pairs = [(points.labels["configuration"][i], names[row[i]]) for i in range(len(row))]
    told = next((f"{a} is {b}" for (a, b), r in zip(pairs, row, strict=True) if r >= 0), "")
    remarks = (f"by the numbers at the ends of the names ({told})",) if key is _number else ()
    return Joined("name", row, q[row], None, left_out, spare, remarks)


def _clocks(
    points: Pool, log: Pool, settings: JoinTable, how: str
) -> tuple[Array, Array, IntArray]:
    """Times of the points and, sorted and with the offset, of the log, and the log's rows so."""
    for pool in (points, log):
        if pool.time is None:
            raise InputError(
                f"{pool.files[0]}: no times, by which [join] is to join by {how}; map time_s or "
                "time_text in [source.columns], or join by order or name"
            )
    assert points.time is not None and log.time is not None
    order = np.argsort(log.time, kind="stable")
    return points.time, log.time[order] + (settings.offset_s or 0.0), order


def _by_time(where: str, points: Pool, log: Pool, settings: JoinTable) -> Joined:
    at, clock, order = _clocks(points, log, settings, "time")
    tolerance = TOLERANCE_S if settings.tolerance_s is None else settings.tolerance_s
    after = np.clip(np.searchsorted(clock, at), 1, max(len(clock) - 1, 1))
    after = np.minimum(after, len(clock) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(at - clock[before]) <= np.abs(clock[after] - at), before, after)
    apart = np.abs(clock[nearest] - at)
    row = np.where(apart <= tolerance, order[nearest], -1)
    good = row >= 0
    remarks = []
    if good.any():
        remarks.append(
            f"clocks differ by {apart[good].max():.3g} s at most, {np.median(apart[good]):.3g} s "
            "in the median"
        )
        still = log.spread(settings.still_deg or STILL_DEG, settings.still_mm or STILL_MM)
        q = log.q[order]
        around = np.abs(q[np.minimum(nearest + 1, len(q) - 1)] - q[np.maximum(nearest - 1, 0)])
        moving = np.flatnonzero(good & (around > still).any(axis=1))
        if len(moving):
            remarks.append(
                f"WARNING: the arm moved while {len(moving)} points were measured: "
                f"{listed((points.shown(int(i)) for i in moving), SHOWN)}; set offset_s, or join "
                "by standstill"
            )
    left_out = tuple(
        f"{points.shown(int(i))}, {apart[i]:.3g} s from the nearest"
        for i in np.flatnonzero(~good)
    )  # fmt: skip
    return Joined("time", row, log.q[row], None, left_out, (), tuple(remarks))


def _by_standstill(where: str, points: Pool, log: Pool, settings: JoinTable) -> Joined:
    at, clock, order = _clocks(points, log, settings, "standstill")
    tolerance = TOLERANCE_S if settings.tolerance_s is None else settings.tolerance_s
    still = log.spread(settings.still_deg or STILL_DEG, settings.still_mm or STILL_MM)
    shortest = STILL_S if settings.still_s is None else settings.still_s
    found = standstills(clock, log.q[order], still, shortest)
    if not found:
        raise InputError(
            f"{log.files[0]}: the arm never stood still for {shortest:g} s; correct still_s and "
            "still_deg in [join], or join by time"
        )
    first = np.array([clock[s.first] for s in found])
    last = np.array([clock[s.last] for s in found])
    # 0 within a standstill, else the time to its nearer end: (points, standstills) at most a few
    # thousand each.
    best = np.zeros(len(at), dtype=np.int64)
    apart = np.zeros(len(at))
    for i, t in enumerate(at):
        away = np.maximum(np.maximum(first - t, t - last), 0.0)
        best[i] = int(np.argmin(away))
        apart[i] = away[best[i]]
    good = apart <= tolerance
    q = np.array([s.q for s in found])[best]
    row = np.where(good, order[np.array([s.first for s in found])[best]], -1)
    left_out = tuple(
        f"{points.shown(int(i))}, {apart[i]:.3g} s from the nearest standstill"
        for i in np.flatnonzero(~good)
    )  # fmt: skip
    empty = np.setdiff1d(np.arange(len(found)), best[good])
    unused = tuple(
        f"standstill {k + 1} (from line {log.line[order[found[k].first]]})" for k in empty
    )
    remarks = (f"{len(found)} standstills of {shortest:g} s or more in {len(log)} rows",)
    return Joined("standstill", row, q, None, left_out, unused, remarks)
