"""Joints by the names of the robot's file, beside joint1 … jointN in the order of the chain."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.model.chain import Chain
from elastocal.text import did_you_mean, listed, printable

Value = TypeVar("Value")


def file_names(chain: Chain) -> dict[str, str]:
    """jointN → the file's name, of those joints that the file calls otherwise."""
    both = ((f"joint{i}", joint.name) for i, joint in enumerate(chain.joints, start=1))
    return {number: name for number, name in both if name != number}


def clashing(chain: Chain) -> list[str]:
    """Names jointN that the file gives to another than its Nth joint."""
    numbers = {f"joint{i}" for i in range(1, chain.n_joints + 1)}
    return sorted(numbers.intersection(file_names(chain).values()))


def names_told(chain: Chain) -> str:
    """ "joint1 = shoulder_pan, joint2 = …", or "" where the file's names end with these numbers."""
    names = file_names(chain)
    ends = [re.search(r"[0-9]+$", name) for name in names.values()]
    if all(
        end and number == f"joint{int(end[0])}" for number, end in zip(names, ends, strict=True)
    ):
        return ""
    return listed(f"{number} = {printable(name)}" for number, name in names.items())


def numbered(cell: Cell, chain: Chain) -> Cell:
    """The cell with every joint that it names as jointN, N its place in the chain.

    A joint may be named as in the robot's file wherever jointN may stand.  Where the file calls
    another than the Nth joint jointN, `[robot] joint_names` says which is meant.

    Raises InputError for such a name without it, and for a joint that there is not.
    """
    one = _resolver(cell, chain)
    loose = _resolver(cell, chain, others=True)

    def keys(
        table: Mapping[str, Value], where: str, of: Callable[[str, str], str]
    ) -> dict[str, Value]:
        found = {of(name, where): value for name, value in table.items()}
        if len(found) < len(table):
            raise InputError(
                f"{cell.path or cell.name}: {where} names a joint twice, by its name in the "
                f"robot's file and by its number ({names_told(chain)}); keep one"
            )
        return found

    spec, wishes = cell.model, cell.design
    spring = spec.nominal.gravity_compensator
    where = "[model.nominal.gravity_compensator] joint"
    nominal = replace(
        spec.nominal,
        settings=keys(spec.nominal.settings, "[model.nominal.settings]", loose),
        sizes=keys(spec.nominal.sizes, "[model.nominal.sizes]", loose),
        gravity_compensator=spring and spring | {"joint": one(str(spring["joint"]), where)},
    )
    effects = tuple(
        e if e.where is None else replace(e, where=loose(e.where, "[model] effects"))
        for e in spec.effects
    )
    levels = keys(spec.compliance_levels, "[model.compliance_levels]", one)
    combination = {
        ".".join([loose(place, "[design] combination"), *rest]): value
        for name, value in wishes.combination.items()
        for place, *rest in [name.rsplit(".", 1)]
    }
    return replace(
        cell,
        limits=keys(cell.limits, "[limits]", one),
        model=replace(spec, nominal=nominal, effects=effects, compliance_levels=levels),
        design=replace(
            wishes,
            levels=keys(wishes.levels, "[design.levels]", one),
            interest=tuple(loose(name, "[design] interest") for name in wishes.interest),
            combination=combination,
        ),
    )


def _resolver(cell: Cell, chain: Chain, others: bool = False) -> Callable[[str, str], str]:
    """Name and where it stands → jointN; with `others` what is no joint stays."""
    by_file = {name: number for number, name in file_names(chain).items()}
    by_order = {f"joint{i}": f"joint{i}" for i in range(1, chain.n_joints + 1)}
    clash = clashing(chain) if cell.robot.joint_names is None else []
    known = by_order | by_file
    if cell.robot.joint_names == "order":
        known = by_file | by_order
    elif clashing(chain):  # by the file: a number that is no name there means nothing
        same = {joint.name: joint.name for joint in chain.joints if joint.name not in by_file}
        known = same | by_file

    def resolve(name: str, where: str) -> str:
        if name in clash:
            raise InputError(
                f"{cell.path or cell.name}: {where} names {name}, which in the robot's file is "
                f"joint number {by_file[name].removeprefix('joint')} of the arm "
                f'({names_told(chain)}); say which is meant: [robot] joint_names = "file" (names '
                'of the file) or "order" (jointN is the Nth)'
            )
        if name in known or others:
            return known.get(name, name)
        raise InputError(
            f"{cell.path or cell.name}: {where} names {name}, but robot '{chain.name}' has "
            f"{chain.n_joints} joints{did_you_mean(name, known)}; they are {listed(known)}"
        )

    return resolve
