"""What may be at work at once: components of joints, links, loads, base, tool and tracker."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.diagnosis.components import Component, Family, FittedSum
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis, RegressorDirection, cell_with, recorded
from elastocal.diagnosis.noise_floor import NoiseValues, project
from elastocal.diagnosis.unknown import Generic
from elastocal.measurements import Measurements
from elastocal.model.effects.base import DrivenEffect, Effect, Stage, index, turning_joints
from elastocal.model.effects.compliances import LoadedEffect
from elastocal.model.effects.gears import MOST_LINES, GearRipple, GearSpectrum
from elastocal.model.effects.smooth import JointCurve, ResidualField, Waves
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
    needed = effect.needed(cell)
    for need, family in OF_NEED.items():
        if need in needed:
            return family
    if effect.stage == "transmission" and isinstance(effect, LoadedEffect):
        return "torque"
    return OF_STAGE[effect.stage]


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
    n = len(dataset.blocks.member)
    for where in joints:
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
        columns = dataset.packed(h, np.zeros(0))
        if np.abs(columns).max(initial=0.0) > 0:
            search = -dataset.columns.shares.get(h.key, 0.0)
            yield Component(
                family_of(h.effect, cell), h.effect, h.where, columns, hypothesis=h, search=search,
                fellows=places[h.effect.name],
            )  # fmt: skip


def drifts(dataset: DiagnosisData) -> Iterator[Component]:
    """A smooth motion of the base in the course of the campaign, where times are recorded."""
    effect, model, time = ResidualField(), dataset.base.model, dataset.table.time
    places = effect.places(model.chain, model.cell)
    if recorded(dataset.table, "time") and time is not None and np.ptp(time) > 0:
        yield from (field_component(dataset, effect, w, "time") for w in places if w == "base")


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
    assert isinstance(c.effect, ResidualField)
    return field_component(dataset, c.effect, c.where, "time", share)


# What is looked for beside those: families of lines of a joint's error, and smooth fields.
#
# A wheel that turns N times per turn of the joint makes lines at N and its multiples: sought
# together they show where none of them would by itself.  The evidence of 2m columns at N, 2N, …,
# mN is that of any group; N runs over a grid as fine as the highest of them needs, and each point
# costs its share of the prior.

MULTIPLES = (1, 2, 3)  # lines of a family, up to so many times the lowest order
LOWEST, HIGHEST = 2.5, 250.0  # orders
STEP = 1.5  # of the highest order of a family, in units of 1/range(q)
# Up to so many poses lines are sought by families, and before curves; in more, single lines show.
FEW_POSES = 300
LINE = 5e-5  # rad, a typical line
LINE_SCALES = np.array([0.3, 1.0, 3.0, 10.0])


@dataclass(frozen=True)
class LineFamily:
    """Lines of the joint `where` at `order` and its multiples: `gain` in nats less the search,
    `sd` how well these data know the order, `search` what finding it cost, the joint's `scatter`
    beside them, of a visit and as a multiple of it that of a configuration, and the components
    that they are `instead_of`."""

    where: str
    order: float
    multiples: int
    gain: float
    sd: float
    search: float
    scatter: tuple[float, float] = (0.0, 0.0)
    instead_of: tuple[Component, ...] = ()
    component: Component | None = None


def line_families(dataset: DiagnosisData, found: FittedSum) -> list[LineFamily]:
    """The most conspicuous family of lines of every joint beside the sum, the best first.

    What is not found yet counts as scatter of its joint, or as its curve: so a family is tried
    beside these, and in their place.
    """
    sums = beside(dataset, found, found.noise)
    out, now = [], sums.at.marginal
    for h in dataset.hypotheses:
        if not isinstance(h.effect, GearRipple):
            continue
        i = index(h.where)
        if np.ptp(dataset.table.q[:, i]) < MOVED:
            continue
        own = [c for c in found.components if c.where == h.where]
        lines = sum(len(c.settings) // 2 for c in own if isinstance(c.effect, GearSpectrum))
        if lines > MOST_FOUND:
            continue
        tried = [_best(sums, h, 0.0, scatter_of(found.noise, i), ())]
        curves = tuple(c for c in own if isinstance(c.effect, JointCurve))
        now_scatter = [scatter_of(found.noise, i)] if curves else []
        for scatter in less_scatter(found.noise, i) or now_scatter:
            grams = beside(dataset, found, with_scatter(found.noise, i, scatter), curves)
            tried.append(_best(grams, h, grams.at.marginal - now, scatter, curves))
        best = max(tried, key=lambda family: family.gain)
        if best.gain > HOPELESS:
            out.append(replace(best, component=family_component(dataset, best)))
    return sorted(out, key=lambda family: -family.gain)


# A family that is this far (nats) from paying for its search beside the sum as it is may still pay
# once noise, sizes and the other orders have followed.
HOPELESS = -3.0


def with_scatter(noise: NoiseValues, i: int, scatter: tuple[float, float]) -> NoiseValues:
    joint, shared = noise.joint.copy(), noise.shared.copy()
    joint[i], shared[i] = scatter
    return replace(noise, joint=joint, shared=shared)


def scatter_of(noise: NoiseValues, i: int) -> tuple[float, float]:
    return float(noise.joint[i]), float(noise.shared[i])


def less_scatter(noise: NoiseValues, i: int) -> list[tuple[float, float]]:
    """Scatter that joint i (0-based) may have once its lines are known: half of it, as usual from
    pose to pose, and as usual from visit to visit as well."""
    s, c = scatter_of(noise, i)
    s_usual, c_usual = scatter_of(NoiseValues.usual(len(noise.joint)), i)
    s_least, c_least = min(s, s_usual), min(c, c_usual)
    half = (s, c / 2) if c > 1 else (s / 2, c)
    tried = {(max(half[0], s_least), max(half[1], c_least)), (s, c_least), (s_least, c_least)}
    return sorted(tried - {(s, c)}, reverse=True)


MOST_FOUND = MOST_LINES - 3


def _best(
    grams: Grams, h: Hypothesis, gain: float, scatter: tuple[float, float],
    curves: tuple[Component, ...],
) -> LineFamily:  # fmt: skip
    """The best family of a joint, of any number of multiples; `gain` is that of what it is in the
    place of."""
    tried = MULTIPLES[:1] if len(grams.dataset.blocks.member) > FEW_POSES else MULTIPLES
    families = [_best_family(grams, h, m) for m in tried]
    best = max(families, key=lambda family: family.gain)
    return replace(best, gain=best.gain + gain, scatter=scatter, instead_of=curves)


def _best_family(grams: Grams, h: Hypothesis, m: int) -> LineFamily:
    q = grams.dataset.table.q[:, index(h.where)]
    step = STEP / max(float(np.ptp(q)), 1e-3) / m
    orders = np.arange(LOWEST, HIGHEST / m, step)
    # An order of 10 to 20 is as probable as one of 100 to 200 beforehand.
    log_prior = -np.log(orders) - np.log((1 / orders).sum() * len(MULTIPLES))
    each = family_evidence(grams, h, orders, m) + log_prior
    k = int(np.argmax(each))
    search = -float(log_prior[k])
    order, sd, evidence = refined_order(grams, h, float(orders[k]), m, step)
    return LineFamily(h.where, order, m, evidence - search, sd, search)


def sharpened(dataset: DiagnosisData, found: FittedSum) -> list[Component] | None:
    """The components of a sum with the orders of all lines where they fit best together; None
    where they are there already.

    Gauss–Newton in the orders N of all families at once, sizes and noise as they are: with
    amplitudes a_k, b_k at their posterior mean, a family's column is
    Σ_k k (q − q₀)(a_k cos kNq − b_k sin kNq), which is that of the amplitudes' shifts.  The
    posterior says how well each order is known.
    """
    families = [k for k, c in enumerate(found.components) if isinstance(c.effect, GearSpectrum)]
    if not families:
        return None
    now, moved = found, False
    # Of each pair of amplitudes, sine and cosine, the columns and then those of their shifts.
    quads = [np.r_[found.spans[k]].reshape(-1, 4) for k in families]
    lines, shifts = ([quad[:, some].ravel() for quad in quads] for some in ([0, 1], [2, 3]))
    kept = np.ones(found.data.X.shape[2], dtype=bool)
    kept[np.concatenate(shifts)] = False
    places = [found.components[k].where for k in families]
    most = STEP / np.array([max(float(np.ptp(dataset.table.q[:, index(w)])), 1e-3) for w in places])
    best = -np.inf
    for _ in range(SHARPENINGS):
        X = now.data.X
        alone = replace(now.data, X=X[:, :, kept], precision=now.data.precision[kept])
        at = project(alone, now.noise)
        if at.marginal < best + SHARP:
            break
        best, moved, found = at.marginal, now is not found or moved, now
        amplitude = np.zeros(len(kept))
        amplitude[kept] = at.beta
        sd = [dict(now.components[k].settings)["order_sd_1"] for k in families]
        turned = [
            X[:, :, shift] @ amplitude[line] / d
            for line, shift, d in zip(lines, shifts, sd, strict=True)
        ]
        at = project(alone.with_columns(np.stack(turned, axis=2), 1 / most**2), now.noise)
        steps = np.clip(at.beta[-len(families) :], -most, most)
        spread = np.linalg.norm(at.beta_deviation[:, -len(families) :], axis=0)
        components = list(now.components)
        for k, step, known in zip(families, steps, spread, strict=True):
            c = components[k]
            m = c.width // 4
            order = min(max(dict(c.settings)["order_1"] + float(step), LOWEST), HIGHEST / m)
            family = LineFamily(c.where, order, m, 0.0, float(known), c.search)
            components[k] = replace(family_component(dataset, family), given=c.given)
        now = replace(now, components=tuple(components))
    return list(found.components) if moved else None


SHARPENINGS, SHARP = 6, 0.05  # nats that another step must gain


def refined_order(
    grams: Grams, h: Hypothesis, order: float, m: int, width: float, scales: Array = LINE_SCALES
) -> tuple[float, float, float]:
    """Lowest order of a family, its standard deviation and log evidence, sought within `width` of
    `order`: the curvature of the evidence says how well it is known."""
    for narrowed in width / 4.0 ** np.arange(3):
        trial = np.clip(order + np.linspace(-narrowed, narrowed, 17), LOWEST, HIGHEST / m)
        order = float(trial[int(np.argmax(family_evidence(grams, h, trial, m, scales)))])
    trial = np.linspace(-width, width, 33)
    each = family_evidence(grams, h, order + trial, m, scales)
    evidence = float(each[16])
    # The parabola through the highest five points, or all that are nearly as high.
    near = np.abs(trial) <= max(np.abs(trial[each > evidence - 2.0]).min(initial=0.0), trial[18])
    near |= (each > evidence - 2.0) & (np.abs(trial) < width / 2)
    curvature = -2 * np.polyfit(trial[near], each[near], 2)[0]
    sd = float(1 / np.sqrt(max(curvature, 1.0 / width**2)))
    return order, sd, evidence


def family_evidence(
    grams: Grams, h: Hypothesis, orders: Array, m: int, scales: Array = LINE_SCALES
) -> Array:
    """Log evidence (G,) of the families of m lines at `orders` (G,)."""
    dataset = grams.dataset
    sums = grams.entry(h.entry_key(dataset.base.model))
    out = []
    for piece in sums.pieces(len(orders), 2 * m):
        some = orders[piece, None]
        # The amplitudes of multiples fall with their number, in the mean.
        D = [dataset.direction(h, some * k) / k for k in range(1, m + 1)]
        out.append(sums.driven(np.concatenate(D, axis=4)).evidence(scales))
    return np.concatenate(out)


def family_component(dataset: DiagnosisData, family: LineFamily) -> Component:
    effect, where = GearSpectrum(), family.where
    q = dataset.table.q[:, index(where)]
    settings = {"spectrum_size_rad": 1.0, "spectrum_centre_rad": float((q.max() + q.min()) / 2)}
    for k in range(1, family.multiples + 1):
        settings |= {f"order_{k}": k * family.order, f"order_sd_{k}": k * family.sd}
    cell = cell_with(dataset.base.model.cell, where, settings)
    parameters = effect.parameters(where, dataset.base.model.chain, cell)
    typical = [p.typical or 0.0 for p in parameters]
    columns = driven_columns(dataset, effect, where, settings) * np.array(typical) * LINE
    kept = tuple((key, v) for key, v in settings.items() if key.startswith("order"))
    return Component(
        "angle", effect, where, columns, LINE, settings=kept, search=family.search,
        fellows=len(turning_joints(dataset.base.model.chain)),
    )  # fmt: skip


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


def _field_settings(dataset: DiagnosisData, name: str, length: float) -> dict[str, float]:
    x = _followed(dataset.table, name)
    keys = ("size", "length", "low", "high")
    values = (1.0, length * float(np.ptp(x)), float(x.min()), float(x.max()))
    return {f"field_{name}_{key}": value for key, value in zip(keys, values, strict=True)}


def field_block(
    dataset: DiagnosisData, effect: ResidualField, where: str, name: str, length: float
) -> Generic:
    """A field as a block, for a search: its direction at every visit, the same waves in each
    component of the motion."""
    cell = cell_with(dataset.base.model.cell, where, _field_settings(dataset, name, length))
    (function,) = effect.functions(where, dataset.base.model.chain, cell)
    waves = Waves.of(function)
    sd = np.sqrt(waves.variances(function.size, function.length))
    F = waves.at(_followed(dataset.visit_table, name)) * sd * MOTION
    F = F.reshape(*dataset.present.shape, -1) * dataset.present[:, :, None]
    entry = effect.entry_at(where)
    D = np.asarray(np.kron(np.eye(entry.size), F[:, :, None, :]), dtype=np.float64)
    return Generic("angle", name, where, "geometry", (entry.name, (where,)), D)


def _followed(table: Measurements, name: str) -> Array:
    """What a field follows in each row (n_rows,): the angle of a joint, or the time."""
    x = table.time if name == "time" else table.q[:, index(name)]
    assert x is not None  # a field follows what is recorded
    return x


def field_component(
    dataset: DiagnosisData, effect: ResidualField, where: str, name: str,
    shortest: float = FIELD_LENGTHS[0],
) -> Component:  # fmt: skip
    settings = _field_settings(dataset, name, shortest)
    span = settings[f"field_{name}_high"] - settings[f"field_{name}_low"]
    cell = cell_with(dataset.base.model.cell, where, settings)
    (function,) = effect.functions(where, dataset.base.model.chain, cell)
    columns = driven_columns(dataset, effect, where, settings) * MOTION
    low, high = (math.log(share * span) for share in (shortest, FIELD_LENGTHS[1]))
    ranges = {k: v for k, v in settings.items() if k.endswith(("low", "high"))}
    return Component(
        "time" if name == "time" else "pose", effect, where, columns, MOTION, name,
        Waves.of(function), (low, high), effect.entry_at(where).size, tuple(ranges.items()),
    )  # fmt: skip
