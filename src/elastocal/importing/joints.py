"""From the joint values of a controller to those of the robot model: order, sign, offset, coupling.

    q_j = sign_j * c_{order(j)} + offset_j + Σ factor * q_i

with c the controller's values and the sum over the couplings of joint j; q_i there is the value
before any coupling, so the couplings do not depend on their order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from elastocal.errors import InputError, require
from elastocal.importing.records import Records
from elastocal.importing.schema import JointsTable
from elastocal.importing.units import convert, quantities
from elastocal.text import listed


def with_joints(
    where: str, records: Records, joints: JointsTable | None, model_names: Sequence[str] = ()
) -> Records:
    """The records with q1 … qn as the robot model counts them.

    The order is that of [joints] order, else the joint names of the file (columns joint1 …) are
    brought into the order of [joints] names, else of `model_names` where the file has them all.
    Raises InputError for gaps in the joint numbers and for lists of another length.
    """
    stems = _stems(records)
    if not stems:
        return records
    joints = joints or JointsTable()
    values = [records.numbers[stem] for stem in stems]
    units = [records.units[stem] for stem in stems]
    taken = _order(where, records, joints, model_names, len(stems))
    if taken is not None:
        per_row = np.stack(values)
        values = [per_row[taken[:, j], np.arange(len(records))] for j in range(taken.shape[1])]
        units = [units[int(taken[0, j])] for j in range(taken.shape[1])]
    n = len(values)
    _check_lengths(where, joints, n)
    for j in range(n):
        revolute = "angle" in quantities(units[j])
        if joints.sign is not None and joints.sign[j] != 1:
            values[j] = values[j] * joints.sign[j]
        given = joints.offset_deg if revolute else joints.offset_mm
        if given is not None and given[j] != 0:
            offset = convert(np.array([given[j]]), "deg" if revolute else "mm", units[j])
            values[j] = values[j] + offset
    before = list(values)
    for k, coupling in enumerate(joints.coupling or ()):
        for name in ("joint", "of"):
            number = getattr(coupling, name)
            require(
                number <= n,
                f"{where}: {name} = {number} of [joints] coupling no. {k + 1}: the file has {n} "
                "joints",
            )
        j, i = coupling.joint - 1, coupling.of - 1
        if quantities(units[j]) != quantities(units[i]):
            raise InputError(
                f"{where}: [joints] coupling no. {k + 1} joins a revolute and a prismatic joint; "
                "give the factor in other units outside the mapping"
            )
        values[j] = values[j] + coupling.factor * convert(before[i], units[i], units[j])
    numbers = {s: v for s, v in records.numbers.items() if s not in stems}
    own = {s: u for s, u in records.units.items() if s not in stems}
    for j in range(n):
        numbers[f"q{j + 1}"], own[f"q{j + 1}"] = values[j], units[j]
    return replace(records, numbers=numbers, units=own)


def joint_stems(numbers: Sequence[str]) -> list[str]:
    """q1, q2 … among the columns, in order."""
    found = [stem for stem in numbers if re.fullmatch(r"q\d+", stem)]
    return sorted(found, key=lambda stem: int(stem[1:]))


def _stems(records: Records) -> list[str]:
    stems = joint_stems(list(records.numbers))
    wrong = [stem for i, stem in enumerate(stems, 1) if stem != f"q{i}"]
    if wrong:
        raise InputError(
            f"{records.source}: the mapping fills {listed(stems)}, but not q"
            f"{int(wrong[0][1:]) - 1}; joints are numbered from 1 without gaps"
        )
    return stems


def _order(
    where: str, records: Records, joints: JointsTable, model_names: Sequence[str], n: int
) -> np.ndarray | None:
    """(rows, joints) which of the file's values is each joint; None for their own order."""
    if joints.order is not None:
        order = joints.order
        if max(order) > n or len(set(order)) < len(order):
            raise InputError(
                f"{where}: [joints] order = {order} takes each of the file's {n} joints at most "
                "once"
            )
        return np.tile(np.array(order) - 1, (len(records), 1))
    columns = [records.texts[f"joint{i}"] for i in range(1, n + 1) if f"joint{i}" in records.texts]
    if len(columns) != n:
        if joints.names is not None:
            raise InputError(
                f"{where}: [joints] names needs the joint names of the file: add "
                'joint# = "name_#0" to [source.columns], or use order'
            )
        return None
    seen = list(zip(*columns, strict=True))
    wanted = joints.names or (model_names if set(model_names) <= set(seen[0]) else None)
    if not wanted:
        return None
    orders: dict[tuple[str, ...], list[int]] = {}
    rows = []
    for i, names in enumerate(seen):
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


def _check_lengths(where: str, joints: JointsTable, n: int) -> None:
    for key in ("sign", "offset_deg", "offset_mm"):
        given = getattr(joints, key)
        if given is not None and len(given) != n:
            raise InputError(
                f"{where}: [joints] {key} has {len(given)} numbers, but there are {n} joints; give "
                "one per joint"
            )
    for value in joints.sign or ():
        require(abs(value) == 1, f"{where}: [joints] sign takes 1 or -1 per joint; found {value:g}")
