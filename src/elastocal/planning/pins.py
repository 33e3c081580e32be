"""Poses that a plan must have, and poses that it must not: the rest is chosen around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError, option, require
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain, joint_index
from elastocal.model.manipulator import Model
from elastocal.planning.candidates import LEVEL_SLACK
from elastocal.planning.feasibility import Feasibility, Struck
from elastocal.planning.information import plan_forces
from elastocal.planning.setup import shares_of
from elastocal.text import did_you_mean, listed, quoted
from elastocal.units import Array, IntArray


@dataclass(frozen=True)
class Pins:
    """Poses that stay, `names` (k,) and `q` (k, n); those `struck` (m, n), near which no other may
    come.  `taken`: all names that these plans have."""

    names: tuple[str, ...]
    q: Array
    struck: Array
    taken: tuple[str, ...]

    @classmethod
    def of(
        cls,
        keep: tuple[Measurements, Sequence[str]] | None,
        strike: tuple[Measurements, Sequence[str]] | None,
    ) -> Pins | None:
        """Of the plans' poses with these names: those to keep (all, where none is named), and
        those to strike, of which plan all others are kept.  Raises InputError for a name that
        the plan lacks, and where nothing is named to strike."""
        names: list[str] = []
        rows, struck, taken = [], [], dict[str, None]()
        for given, stays in ((keep, True), (strike, False)):
            if given is None:
                continue
            table, named = given
            own = _poses(table)
            for name in named:
                require(
                    name in own,
                    f"{table.source}: there is no pose {quoted(name)}"
                    f"{did_you_mean(name, list(own))}; there are {listed(list(own))}",
                )
            require(bool(named) or stays, f"{option('strike')} takes poses, as in plan.csv:3,7")
            kept = [n for n in own if (n in named) == stays] if named else list(own)
            gone = [] if stays else [own[n] for n in named]
            struck += [table.q[row] for row in gone]
            clash = [name for name in kept if name in names]
            require(not clash, f"{table.source}: pose {listed(clash)} is to be kept twice")
            names += kept
            rows += [table.q[own[n]] for n in kept]
            taken |= dict.fromkeys(own)
        if not rows and not struck:
            return None
        n = len((struck or rows)[0])
        kept_at, struck_at = (np.array(lot).reshape(-1, n) for lot in (rows, struck))
        return cls(tuple(names), kept_at, struck_at, tuple(taken))

    def placed(self, cell: Cell, chain: Chain, rules: Feasibility) -> IntArray:
        """The level (k,) of each pose that stays.

        Raises InputError where one is at no level of the cell, or breaks a rule.
        """
        group = np.zeros(len(self.q), dtype=np.int64)
        for k, (label, q) in enumerate(zip(self.names, self.q, strict=True)):
            where = f"{cell.path or cell.name}: pose {quoted(label)}, which is to be kept,"
            for joint, levels in cell.design.levels.items():
                away = np.abs(np.array(levels) - q[joint_index(cell, chain, joint, "levels")])
                group[k] = int(away.argmin())
                require(away.min() < LEVEL_SLACK, f"{where} is at no level of {joint}")
            for force in plan_forces(cell):
                verdict = rules.check(q, force)
                # That it stands near one struck out is the user's choice.
                rules_of = zip(verdict.rules, verdict.broken[0], strict=True)
                broken = [name for name, hit in rules_of if hit and name != Struck.name]
                if broken:
                    raise InputError(
                        f"{where} breaks {broken[0]}; strike it ({option('strike')}), or relax the "
                        "rule in the cell"
                    )
        return group


def read_pins(
    cell: Cell, model: Model, keep: str | Path | None, strike: str | Path | None, sized: bool
) -> tuple[Cell, Pins | None]:
    """What stays and what is struck by the names of files, as in "plan.csv:3,7"; and the cell,
    which asks for as many poses as the plan had of which poses are struck, unless it is `sized`.

    Raises InputError as `Pins.of` does, and for files that cannot be read.
    """

    def read(text: str | Path) -> tuple[Measurements, tuple[str, ...]]:
        path, names = plan_and_names(text)
        return model.read_plan(path), names

    repaired = None if strike is None else read(strike)
    pins = Pins.of(None if keep is None else read(keep), repaired)
    if repaired is not None and not sized and cell.design.target is None:
        n = len(_poses(repaired[0]))
        if n != int(shares_of(cell).sum()):
            cell = replace(cell, design=replace(cell.design, poses=n, per_level=()))
    return cell, pins


def plan_and_names(text: str | Path) -> tuple[Path, tuple[str, ...]]:
    """ "plan.csv:3,7": a plan's file, and the poses named behind it."""
    path, colon, names = str(text).rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in names.split(",") if name.strip())


def _poses(table: Measurements) -> dict[str, int]:
    """Pose → its first row, in the order of the table.

    "7+" and "7-", the sides from which pose 7 is approached, are one; reference visits, "7r1",
    are none of the plan's own."""
    labels = table.configuration_labels
    found: dict[str, int] = {}
    for row, configuration in enumerate(table.configuration):
        name = labels[configuration]
        if name[-1] in "+-" and name[:-1] + "+" in labels and name[:-1] + "-" in labels:
            name = name[:-1]
        again = name.rpartition("r")
        if not (again[2].isdigit() and again[0] in found):
            found.setdefault(name, row)
    return found
