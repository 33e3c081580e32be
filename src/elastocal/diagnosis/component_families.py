"""What may be at work at once: components of joints, links, loads, base, tool and tracker."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.components import Component, Family
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Constants, Hypothesis, RegressorDirection, recorded
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, project
from elastocal.diagnosis.unknown import Generic
from elastocal.model.effects import CATALOGUE
from elastocal.model.effects.base import Effect, Stage, index, turning_joints
from elastocal.model.effects.driven import DrivenEffect
from elastocal.model.effects.gears import GearRipple, GearSpectrum
from elastocal.model.effects.smooth import JointCurve, ResidualField
from elastocal.model.manipulator import Model
from elastocal.units import Array

# Lengths in rad of a joint's curve that are tried; what the poses do not resolve is left to lines.
SHORTEST, LONGEST = 0.06, 3.0
RESOLVED = 2.0  # times the mean distance of a joint's angles
MOVED = 0.05  # rad that a joint has to move for its curve to be tried
CURVE, MOTION = 2e-4, 1e-4  # typical sizes of a curve in rad, of a field in m or rad
OF_STAGE: dict[Stage, Family] = {
    "transmission": "angle", "geometry": "pose", "load": "load", "compliance": "torque",
    "tool": "tool", "tracker": "pose",
}  # fmt: skip
OF_NEED: dict[str, Family] = {"time": "time", "temperature": "temperature", "approach": "move"}


def family_of(effect: Effect, cell: Cell) -> Family:
    """What an effect depends on in the first place."""
    if effect.family:
        return effect.family  # type: ignore[return-value]
    needed = effect.needed(cell)
    for need, family in OF_NEED.items():
        if need in needed:
            return family
    if effect.stage == "transmission" and "load" in needed:
        return "torque"
    return OF_STAGE[effect.stage]


def driven_columns(
    dataset: DiagnosisData, effect: DrivenEffect, where: str, settings: dict[str, float]
) -> Array:
    """Packed columns (C, m, k) of a driven effect at these settings, per parameter."""
    constants = Constants.of(dataset.base.model, where, settings)
    parameters = effect.parameters(where, constants.chain, constants.cell)
    direction = RegressorDirection(Hypothesis(effect, where, parameters, ()), constants)
    D = direction(dataset.table, np.zeros((1, 0)))[:, 0]
    entry = effect.entry_at(where)
    E = dataset.columns.entry((entry.name, effect.entered_at(where, constants.chain)))
    return dataset.pack(E @ D)


# What is tried from the start: a curve of every joint, and every effect that needs no search.


def joint_curves(dataset: DiagnosisData) -> Iterator[Component]:
    """An error of every joint against its own angle."""
    effect, model = JointCurve(), dataset.base.model
    n = len(dataset.blocks.member)
    for where in turning_joints(model.chain):
        if (effect.name, where) in {(p.effect, p.where) for p in model.parameters}:
            continue
        q = dataset.table.q[:, index(where)]
        span = float(np.ptp(q))
        distinct = min(n, len(np.unique(q.round(3))))
        shortest = max(SHORTEST, RESOLVED * span / max(distinct, 1))
        if span < MOVED or shortest > span / 2:
            continue
        longest = max(min(LONGEST, 2 * span), 2 * shortest)
        measured = {"curve_low_rad": float(q.min()), "curve_high_rad": float(q.max())}
        tried = {"curve_size_rad": 1.0, "curve_length_rad": shortest, **measured}
        constants = Constants.of(model, where, tried)
        yield Component(
            "angle", effect, where, driven_columns(dataset, effect, where, tried) * CURVE, CURVE,
            waves=effect.course(where, constants.chain, constants.cell).waves,
            lengths=(math.log(shortest), math.log(longest)), settings=tuple(measured.items()),
        )  # fmt: skip


def catalogue_components(dataset: DiagnosisData) -> Iterator[Component]:
    """Every hypothesis whose columns need no search."""
    cell = dataset.base.model.cell
    for h in dataset.hypotheses:
        if h.settings:
            continue
        columns = dataset.packed(h, np.zeros(0))
        if np.abs(columns).max(initial=0.0) > 0:
            yield Component(family_of(h.effect, cell), h.effect, h.where, columns, hypothesis=h)


def judged_together(model: Model, table: object) -> list[Hypothesis]:
    """Effects that are judged in the sum alone, but for the smooth ones, which have their own
    searches, at every place where the table can test them."""
    chain, cell = model.chain, model.cell
    active = {(p.effect, p.where) for p in model.parameters}
    return [
        Hypothesis(effect, where, parameters, ())
        for effect in CATALOGUE.values()
        if effect.together
        and not isinstance(effect, JointCurve | ResidualField | GearSpectrum)
        and all(recorded(table, need) for need in effect.needed(cell))  # type: ignore[arg-type]
        for where in effect.places(chain, cell)
        if (effect.name, where) not in active
        and (parameters := effect.parameters(where, chain, cell))
    ]


# What is looked for beside those: lines of a joint's error, and smooth fields without a name.

SCANNED = 1500  # configurations, at most, that a search looks at
LINES_AT_ONCE = 3  # of a joint, from one search
FIELD_LENGTHS = (0.25, 1.5)  # of the range of what a field follows
LEAST_SPAN = {"time": 60.0}


def lines(
    dataset: DiagnosisData, data: NoisyData, noise: NoiseValues, taken: Sequence[Component]
) -> list[Component]:
    """The most conspicuous lines of every joint beside what is in `data`, each clear of the others
    and of those `taken`."""
    grams, found = _grams(dataset, data, noise), []
    for h in dataset.hypotheses:
        if not isinstance(h.effect, GearRipple):
            continue
        grid = dataset.grids[h.key]
        each = grams.of_hypothesis(h).evidence(h.scales) + grid.log_prior
        orders = grid.values[:, 0]
        near = [dict(c.settings)[h.settings[0].key] for c in taken
                if isinstance(c.effect, GearRipple) and c.where == h.where]  # fmt: skip
        for k in np.argsort(-each)[:200]:
            if each[k] < 3.0 or len(near) >= 40:
                break
            if any(abs(orders[k] - other) < 2 * grid.step[k, 0] for other in near):
                continue
            order = _refined_order(grams, h, float(orders[k]), float(grid.step[k, 0]))
            near.append(order)
            columns = dataset.packed(h, np.array([order]))
            settings = ((h.settings[0].key, order),)
            found.append((float(each[k]), Component(
                "angle", h.effect, h.where, columns, settings=settings, hypothesis=h)))  # fmt: skip
            if sum(c.where == h.where for _, c in found) >= LINES_AT_ONCE:
                break
    return [c for _, c in sorted(found, key=lambda pair: -pair[0])]


def _refined_order(grams: Grams, h: Hypothesis, order: float, step: float) -> float:
    for width in step / 8.0 ** np.arange(3):
        trial = order + np.linspace(-width, width, 21)
        trial = np.clip(trial, h.settings[0].lower, h.settings[0].upper)
        order = float(
            trial[int(np.argmax(grams.of_hypothesis(h, trial[:, None]).evidence(h.scales)))]
        )
    return order


def _grams(dataset: DiagnosisData, data: NoisyData, noise: NoiseValues) -> Grams:
    return Grams(dataset, data, project(data, noise))


def fields(
    dataset: DiagnosisData, data: NoisyData, noise: NoiseValues, taken: Sequence[Component],
    most: int,
) -> list[Component]:  # fmt: skip
    """The smooth dependences without a name that explain most beside what is in `data`."""
    effect, model = ResidualField(), dataset.base.model
    chain, cell = model.chain, model.cell
    follow = [w for w in turning_joints(chain) if np.ptp(dataset.table.q[:, index(w)]) > MOVED]
    if recorded(dataset.table, "time"):
        follow.append("time")
    grams, found = _grams(dataset, data, noise), []
    known = {(c.where, c.follows) for c in taken}
    for where in effect.places(chain, cell):
        if where.startswith("marker") and "time" not in follow:
            continue
        for name in follow:
            own = where == name and where.startswith("joint")
            if own or (where, name) in known or (where.startswith("marker") and name != "time"):
                continue
            coarse = _field(dataset, effect, where, name, FIELD_LENGTHS[0] * 2)
            if coarse is None:
                continue
            evidence = float(grams.of_block(coarse).evidence()[0])
            if evidence > 3.0:
                found.append((evidence, where, name))
    best = sorted(found, reverse=True)[:most]
    return [_field_component(dataset, effect, where, name) for _, where, name in best]


def _range(dataset: DiagnosisData, name: str) -> Array:
    if name == "time":
        assert dataset.table.time is not None
        return dataset.table.time
    return dataset.table.q[:, index(name)]


def _field_settings(dataset: DiagnosisData, name: str, length: float) -> dict[str, float]:
    x = _range(dataset, name)
    keys = ("size", "length", "low", "high")
    values = (1.0, length * float(np.ptp(x)), float(x.min()), float(x.max()))
    return {f"field_{name}_{key}": value for key, value in zip(keys, values, strict=True)}


def _field(
    dataset: DiagnosisData, effect: ResidualField, where: str, name: str, length: float
) -> Generic | None:
    """A field as a block, for a search: its direction at every visit."""
    settings = _field_settings(dataset, name, length)
    constants = Constants.of(dataset.base.model, where, settings)
    parameters = effect.parameters(where, constants.chain, constants.cell)
    sd = np.array([p.typical for p in parameters])
    direction = RegressorDirection(Hypothesis(effect, where, parameters, ()), constants)
    D = direction(dataset.visit_table, np.zeros((1, 0)))[:, 0] * sd * MOTION
    D = D.reshape(*dataset.present.shape, *D.shape[1:]) * dataset.present[:, :, None, None]
    key = (effect.entry_at(where).name, (where,))
    return Generic("angle", name, where, "geometry", key, D)


def _field_component(
    dataset: DiagnosisData, effect: ResidualField, where: str, name: str
) -> Component:
    span = float(np.ptp(_range(dataset, name)))
    settings = _field_settings(dataset, name, FIELD_LENGTHS[0])
    constants = Constants.of(dataset.base.model, where, settings)
    (course,) = effect.courses(where, constants.chain, constants.cell)
    columns = driven_columns(dataset, effect, where, settings) * MOTION
    low, high = (math.log(share * span) for share in FIELD_LENGTHS)
    ranges = {k: v for k, v in settings.items() if k.endswith(("low", "high"))}
    return Component(
        "time" if name == "time" else "pose", effect, where, columns, MOTION, name, course.waves,
        (low, high), effect.entry_at(where).size, tuple(ranges.items()),
    )  # fmt: skip
