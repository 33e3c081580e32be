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
from elastocal.diagnosis.diagnosis_data import DiagnosisData, wrenches
from elastocal.diagnosis.evidence import Grams, direct
from elastocal.diagnosis.hypotheses import CHANGE_TIMES, SCALES, UNSIZED_SCALES, EntryKey, recorded
from elastocal.diagnosis.noise_floor import NoiseValues, project
from elastocal.identification.start import as_placed
from elastocal.measurements import Measurements, first_of_visit, with_moves
from elastocal.model.effects.base import Effect, JointMotion, Stage, index, turning_joints
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


def moved(dataset: DiagnosisData, key: EntryKey, D: Array) -> Array:
    """Columns (C, m, k) of an entry's motions D (n_rows, d, k)."""
    return dataset.pack(dataset.columns.entry(key) @ D)


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
        low, high = float(q.min()), float(q.max())
        waves = Waves.over(low, high, shortest, turns=True)
        D = waves.at(q)[:, None, :] * CURVE
        yield Component(
            "angle", effect, where, moved(dataset, (JointMotion.name, (where,)), D), CURVE,
            waves=waves, lengths=(math.log(shortest), math.log(longest)),
            settings=(("curve_low_rad", low), ("curve_high_rad", high)), fellows=len(joints),
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


def _followed(table: Measurements, name: str) -> Array:
    """What a field follows in each row (n_rows,): the angle of a joint, or the time."""
    x = table.time if name == "time" else table.q[:, index(name)]
    assert x is not None  # a field follows what is recorded
    return x


def field_component(
    dataset: DiagnosisData, where: str, name: str, shortest: float = FIELD_LENGTHS[0]
) -> Component:
    """A smooth motion of a place with what it follows, of lengths from the `shortest` share of its
    range: the same waves in each component of the motion."""
    x, entry = _followed(dataset.table, name), FIELD.entry_at(where)
    low, high, span = float(x.min()), float(x.max()), float(np.ptp(x))
    waves = Waves.over(low, high, shortest * span, turns=name != "time")
    D = np.asarray(np.kron(np.eye(entry.size), waves.at(x)[:, None, :] * MOTION), dtype=float)
    return Component(
        "time" if name == "time" else "pose", FIELD, where,
        moved(dataset, (entry.name, (where,)), D), MOTION, name, waves,
        (math.log(shortest * span), math.log(FIELD_LENGTHS[1] * span)), entry.size,
        ((f"field_{name}_low", low), (f"field_{name}_high", high)),
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
    respond = partial(_response, dataset.columns.torques())
    tried: tuple[tuple[Effect, Search], ...] = (
        (ResidualStep(), _step), (TorqueResponse(), respond), (ApproachResponse(), respond),
        (LoadResponse(), partial(_yielding, dict(wrenches(dataset)))),
    )  # fmt: skip
    taken = {(p.effect, p.where) for p in model.parameters}
    taken |= {(c.effect.name, c.where) for c in found.components}
    shown: list[Conspicuous] = []

    def scored(
        c: Component, scales: Array, component: Callable[[], Component] | None = None
    ) -> None:
        columns = sums.data.masked(c.columns * c.scalings[0])
        nats = float(direct(columns, sums.at).evidence(scales)[0]) - c.search
        if nats > CONSPICUOUS:
            of = "time" if c.family == "time" else c.follows or c.effect.name
            shown.append((nats, (c.where, of), component or (lambda: c)))

    for where in FIELD.places(model.chain, model.cell):
        for name in () if FIELD.name in without else _followed_by(dataset, found, where):
            coarse = field_component(dataset, where, name, FIELD_LENGTHS[0] * 2)
            # A large table's fields would fill the memory.
            scored(coarse, SCALES, partial(field_component, dataset, where, name))
        # Of one place at a time: so would what its entries sum up to.
        grams = Grams(dataset, sums.data, sums.at)
        for effect, search in tried:
            free = effect.name not in without and (effect.name, where) not in taken
            if not free or where not in effect.places(model.chain, model.cell):
                continue
            if (it := search(effect, grams, where)) is not None:
                columns, settings, cost = it
                c = Component(
                    family_of(effect, model.cell), effect, where, columns, search=cost,
                    settings=tuple(settings.items()),
                    fellows=len(effect.places(model.chain, model.cell)),
                )  # fmt: skip
                scored(c, UNSIZED_SCALES)
    shown.sort(key=lambda c: -c[0])
    chosen = list(dict.fromkeys(of for _, of, _ in shown))[:most]
    return [component() for _, of, component in shown if of in chosen]


CONSPICUOUS = 3.0  # nats of evidence, its size integrated out
# Nats, place and what it follows, and the component.
Conspicuous = tuple[float, tuple[str, str], Callable[[], Component]]
# Columns, the constants of their effect, and what finding these cost in nats.
Tried = tuple[Array, dict[str, float], float]
Search = Callable[[Any, Grams, str], Tried | None]


def _followed_by(dataset: DiagnosisData, found: FittedSum, where: str) -> Iterator[str]:
    """What a place may follow and does not in the sum: the time, and joints that move."""
    follow = ["time"] if recorded(dataset.table, "time") else []
    if not where.startswith("marker"):
        turning = turning_joints(dataset.base.model.chain)
        follow += [w for w in turning if np.ptp(dataset.table.q[:, index(w)]) > MOVED]
    known = {(c.where, c.follows) for c in found.components}
    return (name for name in follow if where != name and (where, name) not in known)


def _step(effect: ResidualStep, grams: Grams, where: str) -> Tried | None:
    """At the moment at which it explains most."""
    dataset = grams.dataset
    moments, time = dataset.moments, dataset.visit_table.time
    if time is None or not len(moments):
        return None
    entry = effect.entry_at(where)
    key, visits = (entry.name, (where,)), time.reshape(dataset.present.shape)
    sums = grams.entry(key)

    def directions(tried: Array) -> Array:
        later = (visits[:, :, None] >= tried) & dataset.present[:, :, None]
        return later[:, :, None, :, None] * (MOTION * np.eye(entry.size))[:, None, :]

    def best(tried: Array) -> float:
        each = sums.each(len(tried), entry.size, lambda some: directions(tried[some]))
        return float(tried[np.argmax(each.evidence(UNSIZED_SCALES))])

    apart = math.ceil(len(moments) / CHANGE_TIMES)
    k = int(np.searchsorted(moments, best(moments[apart // 2 :: apart])))
    moment = best(moments[max(k - apart, 0) : k + apart + 1])
    begun = np.asarray(dataset.table.time)[first_of_visit(dataset.table)]
    D = (begun >= moment)[:, None, None] * MOTION * np.eye(entry.size)
    return moved(dataset, key, D), {effect.constants[0].key: moment}, math.log(len(moments))


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
    columns = moved(dataset, (JointMotion.name, (where,)), F[:, None, :] * MOTION)
    return columns, {f"{effect.name}_Nm": largest}, 0.0


def _yielding(
    wrench_at: Mapping[str, tuple[EntryKey, Array]], effect: LoadResponse, grams: Grams, where: str
) -> Tried | None:
    """Base or link by force and moment of the load, about the axes of the springs there."""
    dataset = grams.dataset
    base = dataset.base
    if where not in wrench_at:
        return None
    entry, wrench = wrench_at[where]
    turned = as_placed(base.model, base.x).model.nominal.base_rotation
    R = np.eye(3) if where != "base" or turned is None else turned
    parts = np.split(wrench, 2, axis=1)
    largest = [float(np.abs(part).max()) or 1.0 for part in parts]
    D = np.zeros((len(wrench), 6, 6))
    for own, part, most in zip((slice(3), slice(3, 6)), parts, largest, strict=True):
        D[:, own, own] = R * (part @ R)[:, None, :] / most
    settings = zip((s.key for s in effect.constants[1:]), largest, strict=True)
    return moved(dataset, entry, D * MOTION), dict(settings), 0.0
