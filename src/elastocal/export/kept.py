"""What of the calibrated model a file can hold, as a model of its own beside the full one.

A rigid format (URDF, DH table) holds geometry; MJCF also holds linear springs and weights.  The
full model less what it cannot hold is again a `Model`, of the same effects, so the cost of the
export is the difference of two predictions of one and the same machinery.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from elastocal.cell import Array, Cell
from elastocal.errors import option
from elastocal.manipulator.calibrated import CalibratedArm
from elastocal.manipulator.effects import CATALOGUE
from elastocal.manipulator.effects.base import Format
from elastocal.manipulator.effects.compliances import JointCompliance
from elastocal.manipulator.effects.loads import LinkGravity
from elastocal.manipulator.model import Model

# What a spring in a file cannot follow, named like effects among the omissions.
LEVELS, LINEAR, NEGATIVE = "levels of a joint", "linear deflections", "negative compliance"


@dataclass(frozen=True)
class Conditions:
    """What the arm is compared under: force (3,) N in the tracker frame at the load point, time
    in s and temperature in °C of the table's columns (None: not stated)."""

    force: Array = field(default_factory=lambda: np.zeros(3))
    time: float | None = None
    temperature: float | None = None

    def state(self, need: str) -> bool:
        """Is what an effect needs ("time", "temperature", …) stated here?"""
        return not (
            (need == "time" and self.time is None)
            or (need == "temperature" and self.temperature is None)
        )


@dataclass(frozen=True)
class Valued:
    """A model and the values x (parameters,) to evaluate it at."""

    model: Model
    x: Array

    @property
    def values(self) -> dict[str, float]:
        """Name → value in SI units."""
        return dict(zip(self.model.names, map(float, self.x), strict=True))

    @property
    def effects(self) -> list[str]:
        """Active effects in the catalogue's order, link weights included, the load left out."""
        spec = self.model.cell.model
        active = {choice.name for choice in spec.effects}
        if spec.link_gravity:
            active.add(LinkGravity.name)
        return [name for name in CATALOGUE if name in active]


@dataclass(frozen=True)
class Omission:
    """One thing that the file cannot hold; `without` is the full model without it.

    `without` is None where its cost cannot be stated, and `note` says why.
    """

    effect: str
    note: str
    without: Valued | None


@dataclass(frozen=True)
class Kept:
    """`full`: the calibrated arm; `exported`: what the file holds of it; `omissions` between.

    `of_the_measurement`: effects of the instrument, which are no part of the arm; neither model
    has them."""

    full: Valued
    exported: Valued
    conditions: Conditions
    omissions: tuple[Omission, ...]
    of_the_measurement: tuple[str, ...]


def keep(calibrated: CalibratedArm, elastic: bool, conditions: Conditions) -> Kept:
    """Split the calibrated model into what a rigid or an elastic format holds and the rest.

    Springs follow the load's torque at the deflected pose, whatever `[model] torque` says: a
    file has no column of measured torques.
    """
    cell = calibrated.model.cell
    chosen = Valued(calibrated.model, calibrated.x).effects
    instrument = tuple(name for name in chosen if CATALOGUE[name].of_the_measurement)
    unstated = {
        name: [need for need in CATALOGUE[name].needed(cell) if not conditions.state(need)]
        for name in chosen
        if name not in instrument
    }
    whole = [name for name, needs in unstated.items() if not needs]
    full = _part(calibrated, whole)
    format: Format = "elastic" if elastic else "rigid"
    dropped = _cannot_be_springs(full) if elastic else {}
    kept_names = [
        name for name in whole if format in CATALOGUE[name].formats and name not in dropped
    ]
    omissions = [
        Omission(name, dropped.get(name, ""), _part(calibrated, set(whole) - {name}))
        for name in whole
        if name not in kept_names
    ]
    omissions += [
        Omission(name, f"no cost without {' and '.join(map(_option, needs))}", None)
        for name, needs in unstated.items()
        if needs
    ]
    exported = full if len(kept_names) == len(whole) else _part(calibrated, kept_names)
    if elastic:
        exported, changed = _as_springs(exported)
        omissions += [
            Omission(effect, sentence, _as_springs(full, effect)[0]) for effect, sentence in changed
        ]
    return Kept(full, exported, conditions, tuple(omissions), instrument)


def _option(need: str) -> str:
    return option({"time": "time_s", "temperature": "temperature_c"}[need])


def _part(calibrated: CalibratedArm, names: Collection[str]) -> Valued:
    """The calibrated model with the effects `names` alone."""
    cell = calibrated.model.cell
    spec = cell.model
    spec = replace(
        spec,
        effects=tuple(choice for choice in spec.effects if choice.name in names),
        link_gravity=spec.link_gravity and LinkGravity.name in names,
        observe="position",
        torque="computed",
    )
    return _valued(calibrated.model, replace(cell, model=spec), calibrated.values)


def _valued(like: Model, cell: Cell, values: dict[str, float]) -> Valued:
    model = Model.assembled(like.chain, cell)
    return Valued(model, np.array([values[name] for name in model.names]))


def _cannot_be_springs(full: Valued) -> dict[str, str]:
    """Effects whose values no physical spring or body has, with the reason."""
    values, model = full.values, full.model
    reasons = {
        name: CATALOGUE[name].unphysical(values, model.chain, model.cell) for name in full.effects
    }
    return {name: reason for name, reason in reasons.items() if reason}


def _as_springs(part: Valued, only: str | None = None) -> tuple[Valued, list[tuple[str, str]]]:
    """One spring of positive stiffness per joint, and (effect, sentence) for what that changes.

    A joint split into levels gets their mean; a negative compliance becomes rigid; deflections
    are those at the deflected pose.  `only` makes the change of one of them alone.
    """
    cell, values = part.model.cell, part.values
    changed = []
    spec = cell.model
    if spec.compliance_levels and JointCompliance.name in part.effects and only in (None, LEVELS):
        for joint, levels in spec.compliance_levels.items():
            names = [f"{joint}.compliance_level{k + 1}" for k in range(len(levels))]
            if names[0] in values:
                values[f"{joint}.compliance"] = float(np.mean([values[name] for name in names]))
                told = f"one spring with the mean compliance of {joint}'s {len(names)} levels"
                changed.append((LEVELS, told))
        spec = replace(spec, compliance_levels={})
    if spec.deflection_model == "linear" and only in (None, LINEAR):
        spec = replace(spec, deflection_model="equilibrium")
        changed.append((LINEAR, "springs settle under the load at the deflected pose, eq. (3) not"))
    model = Model.assembled(part.model.chain, replace(cell, model=spec))
    negative = [p.name for p in model.parameters if p.lower == 0.0 and values[p.name] < 0.0]
    if negative and only in (None, NEGATIVE):
        values |= dict.fromkeys(negative, 0.0)
        changed.append((NEGATIVE, f"rigid, as no spring yields so: {', '.join(negative)}"))
    return Valued(model, np.array([values[name] for name in model.names])), _once(changed)


def _once(changed: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    told: dict[str, list[str]] = {}
    for effect, sentence in changed:
        told.setdefault(effect, []).append(sentence)
    return [(effect, "; ".join(sentences)) for effect, sentences in told.items()]
