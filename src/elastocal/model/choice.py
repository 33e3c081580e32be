"""What the cell asks for: which robot, which effects, at which places."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import casadi as ca

from elastocal.cell.work_cell import Cell, read_cell
from elastocal.errors import InputError
from elastocal.model.arm import ParameterSpec
from elastocal.model.chain import Chain
from elastocal.model.effects.base import Effect
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.plausible import plausible
from elastocal.plugin_loader import load_installed, load_named
from elastocal.text import did_you_mean, listed, printable


def cell_of(cell: Cell | str | Path, plugins: bool | None = False) -> Cell:
    """The cell itself, or that of a cell file; its plug-ins run where `plugins` or the environment
    allows it.

    `plugins` None: they are done without where the catalogue has all effects of its model.  Raises
    InputError where the file is wrong, or names plug-ins that may not run.
    """
    fresh = not isinstance(cell, Cell)
    read = cell if isinstance(cell, Cell) else read_cell(cell)
    load_installed()
    if plugins is not None or any(each.name not in CATALOGUE for each in read.model.effects):
        load_named(read.path or Path(read.name), read.plugins, bool(plugins), fresh)
    if fresh:
        read.check(known_effects=tuple(CATALOGUE))
    return read


def load_chain(cell: Cell) -> Chain:
    """The nominal chain of the cell's robot, from its URDF, MuJoCo model, DH table or factory
    calibration."""
    from elastocal.model import ur_table
    from elastocal.model.dh import read_dh
    from elastocal.model.mjcf import read_mjcf
    from elastocal.model.urdf import read_urdf

    robot = cell.robot
    if robot.mjcf is not None:
        return plausible(read_mjcf(robot.mjcf, robot.base, robot.flange), robot.mjcf)
    if robot.urdf is not None:
        return plausible(read_urdf(robot.urdf, robot.base, robot.flange), robot.urdf)
    if robot.dh is not None and robot.dh.suffix.lower() in ur_table.ENDINGS:
        if robot.masses is not None:
            raise InputError(f"{robot.dh}: takes no [robot] masses; state the arm as a DH table")
        return plausible(ur_table.read_ur_table(robot.dh, robot.ur_model), robot.dh)
    if robot.dh is not None:
        chain = read_dh(robot.dh, convention=robot.dh_convention, masses_path=robot.masses)
        return plausible(chain, robot.masses or robot.dh)
    raise InputError(f"{cell.path}: [robot] needs urdf, mjcf or dh")


def choose_effects(chain: Chain, cell: Cell) -> list[tuple[Effect, str]]:
    """(effect, place) for everything active, in the catalogue's order.

    The table's force always acts (`payload`); link weights act where `link_gravity` says so.
    Raises InputError for an unknown effect, place or setting, with the nearest valid one, and
    for an effect that has no place on this arm.
    """
    check_settings(chain, cell)
    wanted: dict[str, list[str | None]] = {
        name: [None] for name, effect in CATALOGUE.items() if effect.acts_unasked(cell)
    }
    for choice in cell.model.effects:
        if choice.name not in CATALOGUE:
            raise InputError(_unknown("effects", "effect", choice.name, list(CATALOGUE), cell))
        wanted.setdefault(choice.name, []).append(choice.where)
    chosen = []
    for name, effect in CATALOGUE.items():
        places = effect.places(chain, cell)
        asked = wanted.get(name, [])
        if asked and not places:
            raise InputError(
                f"{cell.path or cell.name}: [model] effects: {name} has no place on robot "
                f"'{chain.name}' with observe = \"{cell.model.observe}\"; leave it out"
            )
        for where in asked:
            if where is not None and where not in places:
                raise InputError(_unknown("effects", f"place of {name}", where, list(places), cell))
        chosen += [(effect, place) for place in places if None in asked or place in asked]
    return chosen


def check_settings(chain: Chain, cell: Cell) -> None:
    """InputError where the cell sets, or states the size of, what no effect of the catalogue has
    on this arm."""
    nominal = cell.model.nominal
    if nominal.settings:
        _check_keys("settings", "setting", nominal.settings, _keys_of_settings, chain, cell)
    if nominal.sizes:
        _check_keys("sizes", "parameter", nominal.sizes, _keys_of_sizes, chain, cell)


def _keys_of_settings(effect: Effect, place: str, chain: Chain, cell: Cell) -> list[str]:
    return [setting.key for setting in effect.settings(place, chain, cell)]


def _keys_of_sizes(effect: Effect, place: str, chain: Chain, cell: Cell) -> list[str]:
    """Shrunk parameters have their size from a setting; an effect that this arm cannot have (masses
    that nobody stated) has none."""
    try:
        return [p.key for p in effect.parameters(place, chain, cell) if not p.shrunk]
    except InputError:
        return []


def _check_keys(
    table: str, what: str, given: Mapping[str, Mapping[str, float]],
    keys_of: Callable[[Effect, str, Chain, Cell], list[str]], chain: Chain, cell: Cell,
) -> None:  # fmt: skip
    """InputError where a key of [model.nominal.`table`] is not one that some effect has there."""
    known: dict[str, list[str]] = {}
    for effect in CATALOGUE.values():
        for place in effect.places(chain, cell):
            if keys := keys_of(effect, place, chain, cell):
                known.setdefault(place, []).extend(keys)
    for place, values in given.items():
        if place not in known:
            raise InputError(_unknown(f"nominal.{table}", "place", place, list(known), cell))
        for key in values:
            if key not in known[place]:
                kind = f"{what} of {place}"
                raise InputError(_unknown(f"nominal.{table}", kind, key, known[place], cell))


def sized_parameters(
    effect: Effect, place: str, chain: Chain, cell: Cell
) -> tuple[ParameterSpec, ...]:
    """The effect's parameters at a place, of the typical sizes that the cell states."""
    stated = cell.model.nominal.sizes.get(place, {})
    return tuple(
        replace(p, typical=stated[p.key]) if p.key in stated and not p.shrunk else p
        for p in effect.parameters(place, chain, cell)
    )


def set_constants(effect: Effect, place: str, chain: Chain, cell: Cell) -> dict[str, ca.SX]:
    """Values of the effect's settings at a place: the cell's, else their defaults.

    Raises InputError where one has neither, or lies outside its range.
    """
    given = cell.model.nominal.settings.get(place, {})
    values = {}
    for setting in effect.settings(place, chain, cell):
        value = given.get(setting.key, setting.default)
        where = f"{cell.path or cell.name}: [model.nominal.settings.{place}] {setting.key}"
        if value is None:
            raise InputError(
                f"{where} is missing, which {effect.name} at {place} needs; `elastocal diagnose` "
                "searches for it"
            )
        if not setting.lower <= value <= setting.upper:
            raise InputError(
                f"{where} takes {setting.lower:g} to {setting.upper:g}; found {value:g}"
            )
        values[setting.key] = ca.SX(value)
    return values


def _unknown(key: str, what: str, found: str, valid: list[str], cell: Cell) -> str:
    return (
        f"{cell.path or cell.name}: [model] {key}: unknown {what} '{found}'"
        f"{did_you_mean(found, valid)}; valid: {listed(valid)}"
    )


# Joints by the names of the robot's file, beside joint1 … jointN in the order of the chain.

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
