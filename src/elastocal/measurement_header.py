"""The header line of a measurement table: which column is what, in which unit."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from elastocal.errors import InputError
from elastocal.measurement_columns import OTHER_UNITS, Family, column, families
from elastocal.nearest import did_you_mean, listed, quoted

REQUIRED = {
    "position": (("position",),),
    "deflection": (("position",),),
    "pose": (("position",), ("rotation", "quaternion")),
    "distance": (("distance",),),
    "plan": (),
    "targets": (),
}
EXCLUSIVE = (("sigma_cartesian", "sigma_polar"), ("rotation", "quaternion"))
NUMBERED = re.compile(r"(q|torque_|approach_)([1-9][0-9]{0,3})(_[a-zA-Z]+)?", re.ASCII)
IGNORED = ("#", "_", "note")
PLANS = ("plan", "targets")
PLAN_ONLY = ("level", "order")
# What `compensate` writes beside its commands, which are a plan too.
BESIDE_COMMANDS = ("correction_", "error_", "std_", "status")


@dataclass(frozen=True)
class Column:
    header: str
    unit: str


@dataclass(frozen=True)
class Layout:
    """`columns`: the families present, each with its columns in the order of its stems."""

    columns: Mapping[str, tuple[Column, ...]]
    labels: tuple[str, ...]
    numbers: tuple[str, ...]


def layout_of(
    source: str, header: Sequence[str], joint_kinds: Sequence[str], observe: str
) -> Layout:
    """What the columns of a table mean.

    `joint_kinds`: "revolute" or "prismatic" per joint; `observe` decides what must be there.
    Raises InputError for unnamed, repeated, unknown, unitless, missing columns, mixed units,
    incomplete families and a joint count that is not the robot's.
    """
    _check_names(source, header)
    known = families(joint_kinds)
    meaning = {
        column(stem, unit): (name, stem, unit)
        for name, family in known.items()
        for stem, units in family.units.items()
        for unit in units
    }
    present: dict[str, dict[str, Column]] = {}
    for text in header:
        if text.startswith(IGNORED) or (observe in PLANS and _of_a_plan(text)):
            continue
        if text not in meaning:
            raise InputError(f"{source}: {_unknown(text, header, known, list(meaning))}")
        name, stem, unit = meaning[text]
        family = present.setdefault(name, {})
        _check_unit(source, known[name], family, stem, Column(text, unit))
        family[stem] = Column(text, unit)
    stated = observe != "targets" or "q" in present  # targets need no joints, perhaps no positions
    if joint_kinds and stated and len(present.get("q", {})) != len(joint_kinds):
        raise InputError(f"{source}: {_wrong_count(header, known['q'])}")
    for name, found in present.items():
        _check_complete(source, known[name], found)
    _check_required(source, present, known, observe)
    columns = {
        name: tuple(found[stem] for stem in known[name].units) for name, found in present.items()
    }
    labels = [c.header for name, cs in columns.items() if known[name].is_label for c in cs]
    numbers = [c.header for name, cs in columns.items() if not known[name].is_label for c in cs]
    return Layout(columns, tuple(labels), tuple(numbers))


def _of_a_plan(text: str) -> bool:
    return text in PLAN_ONLY or text.startswith(BESIDE_COMMANDS)


def _check_names(source: str, header: Sequence[str]) -> None:
    for i, text in enumerate(header, start=1):
        if not text:
            raise InputError(
                f"{source}: column {i} of {len(header)} has no name in the header; name it or "
                "remove the separator too many"
            )
    for text, count in Counter(header).items():
        if count > 1:
            raise InputError(f"{source}: column {quoted(text)} appears {count} times; keep one")


def _unknown(
    text: str, header: Sequence[str], known: Mapping[str, Family], valid: Sequence[str]
) -> str:
    ways = {
        stem: " or ".join(family.columns(stem))
        for family in known.values()
        for stem in family.units
    }
    if text in ways:
        return f"column {quoted(text)} has no unit; write {ways[text]}"
    numbered = NUMBERED.fullmatch(text)
    if numbered and numbered[1] + numbered[2] not in ways:
        if numbered[1] == "q":
            return _wrong_count(header, known["q"])
        n = len(known["q"].units)
        return f"column {quoted(text)} is of joint {numbered[2]}, but the robot has {n} joints"
    stem, _, unit = text.rpartition("_")
    if stem in ways and unit in OTHER_UNITS:
        return f"column {quoted(text)}: the unit {unit} is not taken here; write {ways[stem]}"
    return (
        f"unknown column {quoted(text)}{did_you_mean(text, valid)}; correct the name, or start "
        "it with '#', '_' or 'note' to have it ignored"
    )


def _wrong_count(header: Sequence[str], family: Family) -> str:
    n = len(family.units)
    found = [t for t in header if (m := NUMBERED.fullmatch(t)) and m[1] == "q"]
    stems = {"q" + NUMBERED.fullmatch(t)[2] for t in found}  # type: ignore[index]
    missing = [family.columns(stem)[0] for stem in family.units if stem not in stems]
    names = f" ({listed(found, 8)})" if found else ""
    remedy = f"; add {listed(missing, 8)}" if missing else ""
    return (
        f"{len(stems)} joint columns{names}, but the robot has {n} joints{remedy or '; drop the'}"
        f"{'' if remedy else ' columns too many, or use the cell of the right robot'}"
    )


def _check_unit(
    source: str, family: Family, found: Mapping[str, Column], stem: str, new: Column
) -> None:
    for other_stem, other in found.items():
        if family.units[other_stem] == family.units[stem] and other.unit != new.unit:
            raise InputError(
                f"{source}: columns {other.header} and {new.header} mix units; give all "
                f"{family.meaning} in one unit"
            )


def _check_complete(source: str, family: Family, found: Mapping[str, Column]) -> None:
    missing = [stem for stem in family.units if stem not in found]
    if missing:
        unit = next(iter(found.values())).unit
        absent = [column(s, unit if unit in family.units[s] else family.units[s][0])
                  for s in missing]  # fmt: skip
        raise InputError(
            f"{source}: {listed(c.header for c in found.values())} without {listed(absent)}; "
            f"the table needs all columns of the {family.meaning}, or none"
        )


def _check_required(
    source: str,
    present: Mapping[str, Mapping[str, Column]],
    known: Mapping[str, Family],
    observe: str,
) -> None:
    for one, other in EXCLUSIVE:
        if one in present and other in present:
            pair = [next(iter(present[name].values())).header for name in (one, other)]
            raise InputError(
                f"{source}: {pair[0]} … and {pair[1]} … say the same in two ways "
                f"({known[one].meaning}, {known[other].meaning}); keep one"
            )
    for choices in REQUIRED[observe]:
        if not any(name in present for name in choices):
            needed = " or ".join(
                ",".join(known[name].columns(stem)[0] for stem in known[name].units)
                for name in choices
            )
            found = listed((c.header for cs in present.values() for c in cs.values()), 12)
            raise InputError(
                f'{source}: the columns {needed} are missing, which observe = "{observe}" in '
                f"the cell file needs; found {found or 'no known column'}"
            )
