"""The catalogue of effects, built in and registered.

An effect is known by its name everywhere; what else other modules must know of it they ask it: see
the traits of `base.Effect`.  A new one is a class in the room of its stage and a line below, or a
file of the user's own that calls `register`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import casadi as ca

from elastocal.cell import Cell, read_cell
from elastocal.files import load_installed, load_plugins, same_class
from elastocal.messages import InputError, check_known, require
from elastocal.model.chain import Chain
from elastocal.model.effects import geometry, smooth, statics
from elastocal.model.effects.base import Effect, ParameterSpec, check

# Effects act in this order: what sets a frame or a marker stands before what moves it.
CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in (
    geometry.BaseFrame(), geometry.JointOffset(), geometry.EncoderScale(),
    geometry.GearEccentricity(), geometry.GearSecondHarmonic(), geometry.GearRipple(),
    geometry.GearSpectrum(), smooth.JointCurve(), geometry.WristCoupling(), geometry.JointDrift(),
    geometry.EncoderJump(), geometry.MoveLag(), geometry.MoveHysteresis(), statics.GravitySag(),
    statics.TorqueCoupling(), geometry.LinkGeometry(), statics.TorqueTilt(),
    geometry.ThermalExpansion(), statics.JointCompliance(), statics.JointHardening(),
    geometry.Backlash(), geometry.Hysteresis(), smooth.TorqueResponse(), smooth.ApproachResponse(),
    statics.OffAxisCompliance(), statics.LinkBending(), statics.BaseCompliance(),
    smooth.LoadResponse(), statics.GravityCompensator(), statics.LinkGravity(),
    statics.LinkMassError(), statics.LinkWeights(), statics.Payload(), statics.PayloadError(),
    geometry.MarkerPosition(), geometry.MarkerSlip(), smooth.ResidualField(), smooth.ResidualStep(),
    geometry.MarkerOrientation(), geometry.BaseDrift(), geometry.FrameJump(),
    geometry.DistanceSensor(), geometry.TrackerDistortion(),
)}  # fmt: skip
BUILT_IN = frozenset(CATALOGUE)
# Probability that an effect is missing; in equal shares it is each of them, at each of its places.
SOMETHING = 0.5
UNKNOWN = Effect()  # what is known of an effect that the catalogue does not have


def effect_of(name: str) -> Effect:
    """The effect of that name for its traits; one with their defaults where there is none."""
    return CATALOGUE.get(name, UNKNOWN)


def register(effect: Effect) -> None:
    """Add an effect to the catalogue, behind the last one of its stage.

    Raises InputError where it is no effect, says too little, or has the name of another one; the
    same class (in an edited notebook cell, say) takes the place of its former self.
    """
    check(effect)
    known = CATALOGUE.get(effect.name)
    if known is not None:
        require(
            effect.name not in BUILT_IN and same_class(known, effect),
            f"there is an effect '{effect.name}' already; choose another name",
        )
        CATALOGUE[effect.name] = effect
        return
    order = list(CATALOGUE.values())
    last = max(k for k, other in enumerate(order) if other.stage == effect.stage)
    order.insert(last + 1, effect)
    CATALOGUE.clear()
    CATALOGUE.update({each.name: each for each in order})


# What a cell asks for of it: which effects, at which places, with which settings.


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
        load_plugins(Path(read.source), read.plugins, bool(plugins), fresh)
    if fresh:
        read.check(known_effects=tuple(CATALOGUE))
    return read


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
        _check_known("effects", "effect", choice.name, CATALOGUE, cell)
        wanted.setdefault(choice.name, []).append(choice.where)
    chosen = []
    for name, effect in CATALOGUE.items():
        asked = wanted.get(name, [])
        places = effect.places(chain, cell) if asked else ()
        if asked and not places:
            raise InputError(
                f"{cell.source}: [model] effects: {name} has no place on robot "
                f"'{chain.name}' with observe = \"{cell.model.observe}\"; leave it out"
            )
        for where in asked:
            if where is not None:
                _check_known("effects", f"place of {name}", where, places, cell)
        chosen += [(effect, place) for place in places if None in asked or place in asked]
    return chosen


def check_settings(chain: Chain, cell: Cell) -> None:
    """InputError where the cell sets, or states the size of, what no effect of the catalogue has
    on this arm."""
    nominal = cell.model.nominal
    for table, what, given, keys_of in (
        ("settings", "setting", nominal.settings, lambda e, *at: [s.key for s in e.settings(*at)]),
        # Shrunk parameters have their size from a setting.
        ("sizes", "parameter", nominal.sizes,
         lambda e, *at: [p.key for p in e.parameters(*at) if not p.shrunk]),
    ):  # fmt: skip
        known: dict[str, list[str]] = {}
        for effect in CATALOGUE.values() if given else ():
            for place in effect.places(chain, cell):
                if keys := keys_of(effect, place, chain, cell):
                    known.setdefault(place, []).extend(keys)
        for place, values in given.items():
            _check_known(f"nominal.{table}", "place", place, known, cell)
            for key in values:
                _check_known(f"nominal.{table}", f"{what} of {place}", key, known[place], cell)


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
        where = f"{cell.source}: [model.nominal.settings.{place}] {setting.key}"
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


def _check_known(key: str, what: str, found: str, valid: Collection[str], cell: Cell) -> None:
    told = f"{cell.source}: [model] {key}: unknown {what} '{found}'"
    check_known(found, valid, told, "valid:")
