"""The records of several files of one kind as one list of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from elastocal.errors import InputError
from elastocal.importing.joints import joint_stems
from elastocal.importing.records import Records
from elastocal.importing.units import convert, quantities
from elastocal.text import listed

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# What columns whose files disagree, or whose unit the measurement table does not take, become.
DEFAULT = {
    "length": "mm", "angle": "deg", "time": "s", "force": "N", "torque": "Nm",
    "temperature": "C", "number": "",
}  # fmt: skip


@dataclass(frozen=True)
class Pool:
    """n rows of `files`; `file` (n,) and `line` (n,) say where each stands.

    `numbers` stem → (n,) in `units[stem]`; `labels` configuration, marker, repeat, load → n
    texts; `names` n texts; `time` (n,) s or None.
    """

    files: tuple[str, ...]
    file: IntArray
    line: IntArray
    numbers: dict[str, Array]
    units: dict[str, str]
    names: list[str]
    labels: dict[str, list[str]]
    time: Array | None

    def __len__(self) -> int:
        return len(self.line)

    def where(self, i: int) -> str:
        """File and line of row i, as messages begin."""
        return f"{self.files[self.file[i]]}, line {self.line[i]}"

    def shown(self, i: int) -> str:
        """Row i for a list in a message: its name and line."""
        name = self.names[i]
        return f"{name} (line {self.line[i]})" if name else f"line {self.line[i]}"

    @property
    def q(self) -> Array:
        """(n, joints) joint values in the units of their columns."""
        stems = joint_stems(list(self.numbers))
        return (
            np.column_stack([self.numbers[s] for s in stems]) if stems else np.zeros((len(self), 0))
        )

    @property
    def q_units(self) -> tuple[str, ...]:
        return tuple(self.units[stem] for stem in joint_stems(list(self.numbers)))

    def spread(self, deg: float, mm: float) -> Array:
        """(joints,) these tolerances in the unit of each joint."""
        sizes = [
            convert(np.array([deg]), "deg", u)[0] if "angle" in quantities(u)
            else convert(np.array([mm]), "mm", u)[0]
            for u in self.q_units
        ]  # fmt: skip
        return np.array(sizes)


def pooled(records: Sequence[Records]) -> Pool:
    """The rows of all files, in the order of the files.

    Raises InputError where the files do not have the same columns.
    """
    first = records[0]
    for other in records[1:]:
        _same("columns", first, other, set(first.numbers), set(other.numbers))
        loads = {"load"} if first.load is not None or other.load is not None else set()
        _same("labels", first, other, set(first.labels) - loads, set(other.labels) - loads)
        _same("times", first, other, {"time"} if first.time is not None else set(),
              {"time"} if other.time is not None else set())  # fmt: skip
    units = {stem: _common([r.units[stem] for r in records]) for stem in first.numbers}
    numbers = {
        stem: np.concatenate([convert(r.numbers[stem], r.units[stem], unit) for r in records])
        for stem, unit in units.items()
    }
    labels = {
        stem: [text for r in records for text in r.labels.get(stem, ())]
        for stem in first.labels
        if stem != "load"
    }
    if any(r.load is not None or "load" in r.labels for r in records):
        labels["load"] = [text for r in records for text in _loads(r)]
    times = [r.time for r in records if r.time is not None]
    return Pool(
        files=tuple(r.source for r in records),
        file=np.repeat(np.arange(len(records)), [len(r) for r in records]),
        line=np.concatenate([r.line for r in records]),
        numbers=numbers,
        units=units,
        names=[text for r in records for text in r.texts.get("name", [""] * len(r))],
        labels=labels,
        time=np.concatenate(times) if times else None,
    )


def _loads(records: Records) -> list[str]:
    """The load of each row: what its name or column says, else what its file is said to be."""
    named = records.labels.get("load")
    if named is None and records.load is None:
        raise InputError(
            f"{records.source}: says no load, other files do; give load in its [[source]], or a "
            "group (?P<load>…) in its pattern"
        )
    return named if named is not None else [str(records.load)] * len(records)


def _common(units: list[str]) -> str:
    return units[0] if len(set(units)) == 1 else DEFAULT[quantities(units[0])[0]]


def _same(what: str, first: Records, other: Records, one: set[str], two: set[str]) -> None:
    if one == two:
        return
    has, lacks = (first, other) if one - two else (other, first)
    raise InputError(
        f"{lacks.source}: has no {listed(sorted(one ^ two))}, but {has.source} has; files of one "
        f"kind need the same {what}: correct [[source]], or import them one by one"
    )
