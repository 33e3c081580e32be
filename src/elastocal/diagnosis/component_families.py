"""What may be at work at once: components of joints, links, loads, base, tool and tracker."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.components import Component, Family, FittedSum
from elastocal.diagnosis.diagnosis_data import DiagnosisData, Generic, wrenches
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import (
    CHANGE_TIMES,
    UNSIZED_SCALES,
    Hypothesis,
    RegressorDirection,
    cell_with,
    recorded,
)
from elastocal.diagnosis.noise_floor import NoiseValues, project
from elastocal.identification.start import as_placed
from elastocal.measurements import Measurements, with_moves
from elastocal.model.effects.base import (
    DrivenEffect,
    Effect,
    JointMotion,
    SmoothFunction,
    Stage,
    index,
    turning_joints,
)
from elastocal.model.effects.compliances import LoadedEffect
from elastocal.model.effects.gears import BY_ORDER
from elastocal.model.effects.smooth import (
    ApproachResponse,
    JointCurve,
    JointResponse,
    LoadResponse,
    ResidualField,
    ResidualStep,
    TorqueResponse,
    Waves,
)
from elastocal.units import Array

# Lengths in rad of a joint's curve that are tried; what the poses do not resolve is left to lines.
SHORTEST, LONGEST = 0.06, 3.0
RESOLVED = 2.0  # times the mean distance of a joint's angles
MOVED = 0.05  # rad that a joint has to move for its curve and lines to be tried
CURVE, MOTION = 2e-4, 1e-4  # typical sizes of a curve in rad, of a field in m or rad
OF_STAGE: dict[Stage, Family] = {
    "transmission": "angle", "geometry": "pose", "load": "load", "compliance": "torque",
    "tool": "tool", "tracker": "pose",
}  # fmt: skip
OF_NEED: dict[str, Family] = {"time": "time", "temperature": "temperature", "approach": "move"}


def family_of(effect: Effect, cell: Cell) -> Family:
    if effect.family:
        return effect.family  # type: ignore[return-value]
    loaded = effect.stage == "transmission" and isinstance(effect, LoadedEffect)
    needed = (family for need, family in OF_NEED.items() if need in effect.needed(cell))
    return next(needed, "torque" if loaded else OF_STAGE[effect.stage])


def driven_columns(
    dataset: DiagnosisData, effect: DrivenEffect, where: str, settings: dict[str, float]
) -> Array:
    chain, cell = dataset.base.model.chain, cell_with(dataset.base.model.cell, where, settings)
    h = Hypothesis(effect, where, effect.parameters(where, chain, cell), ())
    D = RegressorDirection(h, chain, cell)(dataset.table, np.zeros((1, 0)))[:, 0]
    return dataset.pack(dataset.columns.entry(h.entry_key(dataset.base.model)) @ D)


# What is tried from the start: a curve of every joint, and every effect that needs no search.


def joint_curves(dataset: DiagnosisData) -> Iterator[Component]:
    effect, model = JointCurve(), dataset.base.model
    joints = turning_joints(model.chain)
    for where in joints:
        if (effect.name, where) in {(p.effect, p.where) for p in model.parameters}:
            continue
        q = dataset.table.q[:, index(where)]
        span = float(np.ptp(q))
        distinct = min(len(dataset.blocks.member), len(np.unique(q.round(3))))
        shortest = max(SHORTEST, RESOLVED * span / max(distinct, 1))
        if span < MOVED or shortest > span / 2:
            continue
        longest = max(min(LONGEST, 2 * span), 2 * shortest)
        measured = {"curve_low_rad": float(q.min()), "curve_high_rad": float(q.max())}
        tried = {"curve_size_rad": 1.0, "curve_length_rad": shortest, **measured}
        cell = cell_with(model.cell, where, tried)
        yield Component(
            "angle", effect, where, driven_columns(dataset, effect, where, tried) * CURVE, CURVE,
            waves=Waves.of(effect.functions(where, model.chain, cell)[0]),
            lengths=(math.log(shortest), math.log(longest)), settings=tuple(measured.items()),
            fellows=len(joints),
        )  # fmt: skip


def catalogue_components(dataset: DiagnosisData) -> Iterator[Component]:
    cell = dataset.base.model.cell
    places = Counter(h.effect.name for h in dataset.hypotheses)
    for h in dataset.hypotheses:
        if h.settings:
            continue
        columns = dataset.packed(h)
        if np.abs(columns).max(initial=0.0) > 0:
            search = -dataset.columns.shares.get(h.key, 0.0)
            yield Component(
                family_of(h.effect, cell), h.effect, h.where, columns, hypothesis=h, search=search,
                fellows=places[h.effect.name],
            )  # fmt: skip


def drifts(dataset: DiagnosisData) -> Iterator[Component]:
    """A smooth motion of the base in the course of the campaign, where times are recorded."""
    time = dataset.table.time
    if recorded(dataset.table, "time") and time is not None and np.ptp(time) > 0:
        yield field_component(dataset, "base", "time")


def shorter(dataset: DiagnosisData, c: Component, log_length: float) -> Component | None:
    """A drift that varies over less time than its shortest so far, where that is its length; None
    where it is not, or no shorter one shows between the readings' times.

    A campaign is as long as one likes, and what shares of it the base moves over nobody knows.
    """
    shortest, time = math.exp(c.lengths[0]), dataset.table.time
    if c.follows != "time" or time is None or log_length > c.lengths[0] + AT_END:
        return None
    resolved = RESOLVED * float(np.ptp(time)) / len(np.unique(time))
    share = shortest / float(np.ptp(time)) / SHORTER
    if shortest / SHORTER < resolved or share < LEAST_SHARE:
        return None
    return field_component(dataset, c.where, "time", share)


# Smooth fields.

FIELD_LENGTHS = (0.25, 1.5)  # of the range of what a field follows
# What a drift's shortest length is divided by where it is not short enough, the least share of a
# campaign, for which it takes forty waves, and of a length's logarithm: as good as its end.
SHORTER, LEAST_SHARE, AT_END = 2.0, 0.03, 0.05


def beside(
    dataset: DiagnosisData, found: FittedSum, noise: NoiseValues, some: Sequence[Component] = ()
) -> Grams:
    """What scores columns beside all of a sum but some of its components."""
    data = found.without_these(some)
    return Grams(dataset, data, project(data, noise))


FIELD = ResidualField()


def _field(
    dataset: DiagnosisData, where: str, name: str, length: float
) -> tuple[SmoothFunction, dict[str, float]]:
    """A field's function of what it follows, and its settings."""
    x = _followed(dataset.table, name)
    values = {"size": 1.0, "length": length * np.ptp(x), "low": x.min(), "high": x.max()}
    settings = {f"field_{name}_{key}": float(value) for key, value in values.items()}
    cell = cell_with(dataset.base.model.cell, where, settings)
    (function,) = FIELD.functions(where, dataset.base.model.chain, cell)
    return function, settings


def field_block(dataset: DiagnosisData, where: str, name: str, length: float) -> Generic:
    """A field as a block, for a search: its direction at every visit, the same waves in each
    component of the motion."""
    function, _ = _field(dataset, where, name, length)
    waves = Waves.of(function)
    sd = np.sqrt(waves.variances(function.size, function.length))
    F = waves.at(_followed(dataset.visit_table, name)) * sd * MOTION
    F = F.reshape(*dataset.present.shape, -1) * dataset.present[:, :, None]
    entry = FIELD.entry_at(where)
    D = np.asarray(np.kron(np.eye(entry.size), F[:, :, None, :]), dtype=np.float64)
    return Generic("angle", name, where, "geometry", (entry.name, (where,)), D)


def _followed(table: Measurements, name: str) -> Array:
    """What a field follows in each row (n_rows,): the angle of a joint, or the time."""
    x = table.time if name == "time" else table.q[:, index(name)]
    assert x is not None  # a field follows what is recorded
    return x


def field_component(
    dataset: DiagnosisData, where: str, name: str, shortest: float = FIELD_LENGTHS[0]
) -> Component:
    function, settings = _field(dataset, where, name, shortest)
    columns = driven_columns(dataset, FIELD, where, settings) * MOTION
    span = function.high - function.low
    low, high = (math.log(share * span) for share in (shortest, FIELD_LENGTHS[1]))
    return Component(
        "time" if name == "time" else "pose", FIELD, where, columns, MOTION, name,
        Waves.of(function), (low, high), FIELD.entry_at(where).size, tuple(settings.items())[2:],
    )  # fmt: skip


# What corrects the arm beside a sum and names no cause: fields, steps, and responses to loads.
# Each is scored at its place beside the whole sum by its evidence, sizes integrated out; those that
# stand out join the sum as components and stay where they pay (`component_search`).


def without_a_name(
    dataset: DiagnosisData, found: FittedSum, most: int, without: Container[str] = ()
) -> list[Component]:
    """What corrects the arm beside the sum and names no cause, the most conspicuous first: smooth
    fields, steps in time, what a joint makes of its torque or last motion, base and links of the
    load; none of the effects `without` which to do."""
    sums, model = beside(dataset, found, found.noise), dataset.base.model
    chain, cell = model.chain, model.cell
    respond = partial(_response, dataset.columns.torques())
    wrench_at = {where: wrench for where, *wrench in wrenches(dataset)}
    tried: tuple[tuple[Effect, Search], ...] = (
        (ResidualStep(), _step), (TorqueResponse(), respond), (ApproachResponse(), respond),
        (LoadResponse(), partial(_yielding, wrench_at)),
    )  # fmt: skip
    taken = {(p.effect, p.where) for p in model.parameters}
    taken |= {(c.effect.name, c.where) for c in found.components}
    every: list[Conspicuous] = []
    for where in FIELD.places(chain, cell):
        # Of one place at a time: what a large table's entries sum up to would fill the memory.
        grams = Grams(dataset, sums.data, sums.at)
        if FIELD.name not in without:
            every += _fields(found, grams, where)
        for effect, search in tried:
            free = effect.name not in without and (effect.name, where) not in taken
            if not free or where not in effect.places(chain, cell):
                continue
            if (it := search(effect, grams, where)) is not None:
                block, settings, cost = it
                evidence = float(grams.of(block).evidence(UNSIZED_SCALES)[0]) - cost
                maker = partial(_as_component, dataset, effect, block, settings, cost)
                every.append((evidence, where, block.covariate, maker))
    shown = sorted((c for c in every if c[0] > CONSPICUOUS), key=lambda c: -c[0])
    chosen = list(dict.fromkeys((where, of) for _, where, of, _ in shown))[:most]
    return [component() for _, where, of, component in shown if (where, of) in chosen]


CONSPICUOUS = 3.0  # nats of evidence, its size integrated out
Conspicuous = tuple[float, str, str, Callable[[], Component]]  # nats, place, what it follows
# A block, the constants of its effect, and what finding them cost in nats.
Tried = tuple[Generic, dict[str, float], float]
Search = Callable[[Any, Grams, str], Tried | None]


def _fields(found: FittedSum, grams: Grams, where: str) -> Iterator[Conspicuous]:
    dataset = grams.dataset
    follow = ["time"] if recorded(dataset.table, "time") else []
    if not where.startswith("marker"):
        turning = turning_joints(dataset.base.model.chain)
        follow += [w for w in turning if np.ptp(dataset.table.q[:, index(w)]) > MOVED]
    known = {(c.where, c.follows) for c in found.components}
    for name in follow:
        if where != name and (where, name) not in known:
            coarse = field_block(dataset, where, name, FIELD_LENGTHS[0] * 2)
            maker = partial(field_component, dataset, where, name)
            yield float(grams.of(coarse).evidence()[0]), where, name, maker


def _step(effect: ResidualStep, grams: Grams, where: str) -> Tried | None:
    """At the moment at which it explains most."""
    dataset = grams.dataset
    moments, time = dataset.moments, dataset.visit_table.time
    if time is None or not len(moments):
        return None
    entry = effect.entry_at(where)
    moved, key = np.eye(entry.size) * MOTION, (entry.name, (where,))
    sums, visits = grams.entry(key), time.reshape(dataset.present.shape)

    def directions(tried: Array) -> Array:
        later = (visits[:, :, None] >= tried) & dataset.present[:, :, None]
        return later[:, :, None, :, None] * moved[:, None, :]

    def best(tried: Array) -> float:
        each = sums.each(len(tried), entry.size, lambda some: directions(tried[some]))
        return float(tried[np.argmax(each.evidence(UNSIZED_SCALES))])

    apart = math.ceil(len(moments) / CHANGE_TIMES)
    k = int(np.searchsorted(moments, best(moments[apart // 2 :: apart])))
    moment = best(moments[max(k - apart, 0) : k + apart + 1])
    D = directions(np.array([moment]))[:, :, :, 0]
    block = Generic("", "time", where, effect.stage, key, D)
    return block, {effect.constants[0].key: moment}, math.log(len(moments))


def _response(torque: Array, effect: JointResponse, grams: Grams, where: str) -> Tried | None:
    """Of a joint by its `torque` (n_rows, joints) or by its last motion."""
    dataset, i = grams.dataset, index(where)
    table, cell = dataset.table, dataset.base.model.cell
    if not all(recorded(table, need) for need in effect.needed(cell)):
        return None
    tau, came = torque[:, i], table.approach
    if cell.model.approach == BY_ORDER:
        came = with_moves(table).direction
    largest = float(np.abs(tau).max(initial=0.0)) or 1.0
    F = effect.at_rows(tau / largest, np.ones_like(tau) if came is None else came[:, i])
    if np.ptp(F, axis=0).max() == 0:
        return None
    D = dataset.blocks.of_visits(F[dataset.lead])[:, :, None, :] * MOTION
    block = Generic("", effect.name, where, effect.stage, (JointMotion.name, (where,)), D)
    return block, {f"{effect.name}_Nm": largest}, 0.0


def _yielding(
    wrench_at: Mapping[str, Sequence[Any]], effect: LoadResponse, grams: Grams, where: str
) -> Tried | None:
    """Base or link by force and moment of the load, about the axes of the springs there."""
    base = grams.dataset.base
    if where not in wrench_at:
        return None
    entry, *wrench = wrench_at[where]
    turned = as_placed(base.model, base.x).model.nominal.base_rotation
    R = np.eye(3) if where != "base" or turned is None else turned
    largest = [float(np.abs(part).max()) or 1.0 for part in wrench]
    D = np.zeros((*wrench[0].shape[:2], 6, 6))
    for own, part, most in zip((slice(3), slice(3, 6)), wrench, largest, strict=True):
        D[:, :, own, own] = R * (part @ R)[:, :, None, :] / most * MOTION
    settings = zip((s.key for s in effect.constants[1:]), largest, strict=True)
    return Generic("", effect.name, where, effect.stage, entry, D), dict(settings), 0.0


def _as_component(
    dataset: DiagnosisData, effect: Effect, block: Generic, settings: dict[str, float],
    search: float,
) -> Component:  # fmt: skip
    model = dataset.base.model
    return Component(
        family_of(effect, model.cell), effect, block.where,
        dataset.packed(block), settings=tuple(settings.items()),
        search=search, fellows=len(effect.places(model.chain, model.cell)),
    )  # fmt: skip
