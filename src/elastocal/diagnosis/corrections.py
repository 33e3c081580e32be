"""What corrects the arm beside a sum and names no cause: fields, steps, and responses to loads.

Each is scored at its place beside the whole sum by its evidence, sizes integrated out; those that
stand out join the sum as components and stay where they pay (`component_search`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from elastocal.diagnosis.component_families import (
    FIELD_LENGTHS,
    MOTION,
    MOVED,
    beside,
    family_of,
    field_block,
    field_component,
)
from elastocal.diagnosis.components import Component, FittedSum
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import CHANGE_TIMES, UNSIZED_SCALES, recorded
from elastocal.diagnosis.model_set import Item, packed_columns
from elastocal.diagnosis.unknown import Generic, wrenches
from elastocal.identification.start import as_placed
from elastocal.measurements import with_moves
from elastocal.model.effects.base import (
    BaseMotion,
    Effect,
    JointMotion,
    LinkFrame,
    index,
    turning_joints,
)
from elastocal.model.effects.gears import BY_ORDER
from elastocal.model.effects.smooth import (
    ApproachResponse,
    JointResponse,
    LoadResponse,
    ResidualField,
    ResidualStep,
    TorqueResponse,
)
from elastocal.units import Array


def without_a_name(
    dataset: DiagnosisData, found: FittedSum, most: int, without: Container[str] = ()
) -> list[Component]:
    """What corrects the arm beside the sum and names no cause, the most conspicuous first: smooth
    fields, steps in time, what a joint makes of its torque or last motion, base and links of the
    load; none of the effects `without` which to do."""
    sums, model = beside(dataset, found, found.noise), dataset.base.model
    chain, cell = model.chain, model.cell
    respond = partial(_response, dataset.columns.torques())
    wrench_at = {where: wrench for where, _, *wrench in wrenches(dataset)}
    tried: tuple[tuple[Effect, Search], ...] = (
        (ResidualStep(), _step), (TorqueResponse(), respond), (ApproachResponse(), respond),
        (LoadResponse(), partial(_yielding, wrench_at)),
    )  # fmt: skip
    taken = {(p.effect, p.where) for p in model.parameters}
    taken |= {(c.effect.name, c.where) for c in found.components}
    field, every = ResidualField(), list[Conspicuous]()
    for where in field.places(chain, cell):
        # Of one place at a time: what a large table's entries sum up to would fill the memory.
        grams = Grams(dataset, sums.data, sums.at)
        if field.name not in without:
            every += _fields(found, field, grams, where)
        for effect, search in tried:
            free = effect.name not in without and (effect.name, where) not in taken
            if free and where in effect.places(chain, cell):
                every += search(effect, grams, where)
    shown = sorted((c for c in every if c[0] > CONSPICUOUS), key=lambda c: -c[0])
    chosen = list(dict.fromkeys((where, of) for _, where, of, _ in shown))[:most]
    return [component() for _, where, of, component in shown if (where, of) in chosen]


CONSPICUOUS = 3.0  # nats of evidence, its size integrated out
Conspicuous = tuple[float, str, str, Callable[[], Component]]  # nats, place, what it follows
Search = Callable[[Any, Grams, str], Iterator[Conspicuous]]


def _fields(
    found: FittedSum, effect: ResidualField, grams: Grams, where: str
) -> Iterator[Conspicuous]:
    dataset = grams.dataset
    follow = ["time"] if recorded(dataset.table, "time") else []
    if not where.startswith("marker"):
        turning = turning_joints(dataset.base.model.chain)
        follow += [w for w in turning if np.ptp(dataset.table.q[:, index(w)]) > MOVED]
    known = {(c.where, c.follows) for c in found.components}
    for name in follow:
        if where != name and (where, name) not in known:
            coarse = field_block(dataset, effect, where, name, FIELD_LENGTHS[0] * 2)
            maker = partial(field_component, dataset, effect, where, name)
            yield float(grams.of(coarse).evidence()[0]), where, name, maker


def _step(effect: ResidualStep, grams: Grams, where: str) -> Iterator[Conspicuous]:
    """At the moment at which it explains most."""
    dataset = grams.dataset
    moments, time = dataset.moments, dataset.visit_table.time
    if time is None or not len(moments):
        return
    entry = effect.entry_at(where)
    moved, key = np.eye(entry.size) * MOTION, (entry.name, (where,))
    sums, visits = grams.entry(key), time.reshape(dataset.present.shape)

    def directions(tried: Array) -> Array:
        later = (visits[:, :, None] >= tried) & dataset.present[:, :, None]
        return later[:, :, None, :, None] * moved[:, None, :]

    def best(tried: Array) -> tuple[float, float]:
        pieces = (tried[some] for some in sums.pieces(len(tried), entry.size))
        each = [sums.driven(directions(some)).evidence(UNSIZED_SCALES) for some in pieces]
        evidence = np.concatenate(each)
        return float(evidence.max()), float(tried[np.argmax(evidence)])

    apart = math.ceil(len(moments) / CHANGE_TIMES)
    k = int(np.searchsorted(moments, best(moments[apart // 2 :: apart])[1]))
    evidence, moment = best(moments[max(k - apart, 0) : k + apart + 1])
    search, settings = math.log(len(moments)), {effect.constants[0].key: moment}
    block = Generic("", "", where, effect.stage, key, directions(np.array([moment]))[:, :, :, 0])
    maker = partial(_as_component, dataset, effect, block, settings, search)
    yield evidence - search, where, "time", maker


def _response(
    torque: Array, effect: JointResponse, grams: Grams, where: str
) -> Iterator[Conspicuous]:
    """Of a joint by its `torque` (n_rows, joints) or by its last motion."""
    dataset, i = grams.dataset, index(where)
    table, cell = dataset.table, dataset.base.model.cell
    if not all(recorded(table, need) for need in effect.needed(cell)):
        return
    tau, came = torque[:, i], table.approach
    if cell.model.approach == BY_ORDER:
        came = with_moves(table).direction
    largest = float(np.abs(tau).max(initial=0.0)) or 1.0
    F = effect.at_rows(tau / largest, np.ones_like(tau) if came is None else came[:, i])
    if np.ptp(F, axis=0).max() > 0:
        D = dataset.blocks.of_visits(F[dataset.lead])[:, :, None, :] * MOTION
        block = Generic("", "", where, effect.stage, (JointMotion.name, (where,)), D)
        yield _scored(grams, effect, block, {f"{effect.name}_Nm": largest})


def _yielding(
    wrench_at: Mapping[str, Sequence[Array]], effect: LoadResponse, grams: Grams, where: str
) -> Iterator[Conspicuous]:
    """Base or link by force and moment of the load, about the axes of the springs there."""
    base = grams.dataset.base
    if where not in wrench_at:
        return
    wrench = wrench_at[where]
    turned = as_placed(base.model, base.x).model.nominal.base_rotation
    R = np.eye(3) if where != "base" or turned is None else turned
    largest = [float(np.abs(part).max()) or 1.0 for part in wrench]
    D = np.zeros((*wrench[0].shape[:2], 6, 6))
    for own, part, most in zip((slice(3), slice(3, 6)), wrench, largest, strict=True):
        D[:, :, own, own] = R * (part @ R)[:, :, None, :] / most * MOTION
    settings = zip((s.key for s in effect.constants[1:]), largest, strict=True)
    entry = BaseMotion() if where == "base" else LinkFrame()
    block = Generic("", "", where, effect.stage, (entry.name, (where,)), D)
    yield _scored(grams, effect, block, dict(settings))


def _scored(
    grams: Grams, effect: Effect, block: Generic, settings: dict[str, float]
) -> Conspicuous:
    evidence = float(grams.of(block).evidence(UNSIZED_SCALES)[0])
    maker = partial(_as_component, grams.dataset, effect, block, settings)
    return evidence, block.where, effect.name, maker


def _as_component(
    dataset: DiagnosisData, effect: Effect, block: Generic, settings: dict[str, float],
    search: float = 0.0,
) -> Component:  # fmt: skip
    model = dataset.base.model
    return Component(
        family_of(effect, model.cell), effect, block.where,
        packed_columns(dataset, Item(block, np.zeros(0), 0.0)), settings=tuple(settings.items()),
        search=search, fellows=len(effect.places(model.chain, model.cell)),
    )  # fmt: skip
