"""What may be at work at once: components of joints, links, loads, base, tool and tracker; families
of lines of a joint's error that stand out beside a sum, and which order they have."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain
from typing import Any

import numpy as np
from scipy.special import logit, logsumexp, ndtri

from elastocal.cell import Cell
from elastocal.diagnosis.baseline import NoiseValues, log_prior, project
from elastocal.diagnosis.components import ALONE, Component, Family, FittedSum, presence_cost
from elastocal.diagnosis.diagnosis_data import DiagnosisData, wrenches
from elastocal.diagnosis.effect_search import settings_of
from elastocal.diagnosis.evidence import Grams, Item, direct
from elastocal.diagnosis.hypotheses import (
    NO_SETTINGS,
    SCALES,
    UNSIZED_SCALES,
    EntryKey,
    Hypothesis,
    RegressorDirection,
    recorded,
)
from elastocal.identification.start import as_placed
from elastocal.measurements import first_of_visit, with_moves
from elastocal.model.effects.base import Arm, Effect, JointMotion, Stage, index, turning_joints
from elastocal.model.effects.geometry import BY_ORDER, MOST_LINES, GearRipple, GearSpectrum
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
from elastocal.model.effects.statics import LoadedEffect
from elastocal.units import Array, BoolArray, IntArray

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
    places = Counter(h.name for h in dataset.hypotheses)
    for h in (h for h in dataset.hypotheses if not h.settings):
        c = component_of(dataset, Item(h, NO_SETTINGS.values[0], 0.0))
        if np.abs(c.columns).max(initial=0.0) > 0:
            search = -dataset.columns.shares.get(h.key, 0.0)
            yield replace(c, search=search, fellows=places[h.name])


def component_of(dataset: DiagnosisData, item: Item) -> Component:
    h, columns = item.what, dataset.packed(item.what, item.settings)
    if not isinstance(h, Hypothesis):
        return Component("pose", ResidualField(), h.where, columns, follows=h.covariate)
    family, settings, search = family_of(h.effect, dataset.base.model.cell), settings_of(item), 0.0
    if settings:
        grid = dataset.grids[h.key]
        search = -float(grid.log_prior[grid.nearest(item.settings)])
    return Component(family, h.effect, h.where, columns, settings=tuple(settings.items()),
                     hypothesis=h, search=search)  # fmt: skip


def drifts(dataset: DiagnosisData) -> Iterator[Component]:
    """A smooth motion of the base in the course of the campaign, where times are recorded."""
    time = dataset.table.time
    if recorded(dataset.table, "time") and time is not None and np.ptp(time) > 0:
        yield field_component(dataset, "base", "time")


def shorter(dataset: DiagnosisData, c: Component, log_length: float) -> Component | None:
    """A drift that varies over less time than its shortest so far, where that is its length; None
    where it is not, or no shorter one shows between the readings' times.  A campaign is as long as
    one likes, and what shares of it the base moves over nobody knows."""
    shortest, time = math.exp(c.lengths[0]), dataset.table.time
    if c.follows != "time" or time is None or log_length > c.lengths[0] + AT_END:
        return None
    resolved = RESOLVED * float(np.ptp(time)) / len(np.unique(time))
    share = shortest / float(np.ptp(time)) / SHORTER
    if shortest / SHORTER < resolved or share < LEAST_SHARE:
        return None
    return field_component(dataset, c.where, "time", share)


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


def field_component(
    dataset: DiagnosisData, where: str, name: str, shortest: float = FIELD_LENGTHS[0]
) -> Component:
    """A smooth motion of a place with what it follows, of lengths from the `shortest` share of its
    range: the same waves in each component of the motion."""
    entry, (x, waves) = FIELD.entry_at(where), _field_waves(dataset, name, shortest)
    low, high, span = float(x.min()), float(x.max()), float(np.ptp(x))
    D = np.asarray(np.kron(np.eye(entry.size), waves.at(x)[:, None, :] * MOTION), dtype=float)
    return Component(
        "time" if name == "time" else "pose", FIELD, where,
        moved(dataset, (entry.name, (where,)), D), MOTION, name, waves,
        (math.log(shortest * span), math.log(FIELD_LENGTHS[1] * span)), entry.size,
        ((f"field_{name}_low", low), (f"field_{name}_high", high)),
    )  # fmt: skip


def _field_waves(dataset: DiagnosisData, name: str, shortest: float) -> tuple[Array, Waves]:
    """What a field follows (n_rows,), the time or the angle of a joint, and its waves."""
    x = dataset.table.time if name == "time" else dataset.table.q[:, index(name)]
    assert x is not None
    low, high, span = float(x.min()), float(x.max()), float(np.ptp(x))
    return x, Waves.over(low, high, shortest * span, turns=name != "time")


# What corrects the arm beside a sum and names no cause: fields, steps, and responses to loads.
# Each is scored at its place beside the whole sum by its evidence, sizes integrated out; those that
# stand out join the sum as components and stay where they pay (`component_search`).


def without_a_name(
    dataset: DiagnosisData, found: FittedSum, most: int, without: Container[str] = ()
) -> list[Component]:
    """What corrects the arm beside the sum and names no cause, the most conspicuous first: smooth
    fields, steps in time, what a joint makes of its torque or last motion, base and links of the
    load; none of the effects `without`."""
    sums, model = beside(dataset, found, found.noise), dataset.base.model
    respond = partial(_response, dataset.columns.torques())
    tried: tuple[tuple[Effect, Search], ...] = (
        (ResidualStep(), _step), (TorqueResponse(), respond), (ApproachResponse(), respond),
        (LoadResponse(), partial(_yielding, dict(wrenches(dataset)))),
    )  # fmt: skip
    taken = {(p.effect, p.where) for p in model.parameters}
    taken |= {(c.effect.name, c.where) for c in found.components}
    shown: list[Conspicuous] = []

    for where in FIELD.places(model.chain, model.cell):
        # Of one place at a time: what its entries sum up to would fill the memory.
        grams, entry = Grams(dataset, sums.data, sums.at), FIELD.entry_at(where)
        for name in () if FIELD.name in without else _followed_by(dataset, found, where):
            coarse = FIELD_LENGTHS[0] * 2
            x, waves = _field_waves(dataset, name, coarse)
            size = MOTION * np.sqrt(waves.variances(1.0, coarse * float(np.ptp(x))))
            F = dataset.blocks.of_visits((waves.at(x) * size)[dataset.lead])
            nats = float(grams.entry((entry.name, (where,))).alike(F).evidence(SCALES)[0])
            # A large table's fields would fill the memory as well.
            shown.append((nats, (where, name), partial(field_component, dataset, where, name)))
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
                evidence = direct(sums.data.masked(columns), sums.at).evidence(UNSIZED_SCALES)
                of = "time" if c.family == "time" else effect.name
                shown.append((float(evidence[0]) - cost, (where, of), partial(replace, c)))
    shown = sorted((c for c in shown if c[0] > CONSPICUOUS), key=lambda c: -c[0])
    chosen = list(dict.fromkeys(of for _, of, _ in shown))[:most]
    return [component() for _, of, component in shown if of in chosen]


CONSPICUOUS = 3.0  # nats of evidence, its size integrated out
# Nats, place and what it follows, and the component.
Conspicuous = tuple[float, tuple[str, str], Callable[[], Component]]
# Columns, the constants of their effect, and what finding these cost in nats.
Tried = tuple[Array, dict[str, float], float]
Search = Callable[[Any, Grams, str], Tried | None]


def _followed_by(dataset: DiagnosisData, found: FittedSum, where: str) -> Iterator[str]:
    follow = ["time"] if recorded(dataset.table, "time") else []
    if not where.startswith("marker"):
        turning = turning_joints(dataset.base.model.chain)
        follow += [w for w in turning if np.ptp(dataset.table.q[:, index(w)]) > MOVED]
    known = {(c.where, c.follows) for c in found.components}
    return (name for name in follow if where != name and (where, name) not in known)


def _step(effect: ResidualStep, grams: Grams, where: str) -> Tried | None:
    """At the moment at which it explains most."""
    dataset = grams.dataset
    time = dataset.visit_table.time
    if time is None:
        return None
    moments, log_prior = dataset.moments
    entry, present = effect.entry_at(where), dataset.present
    key, when = (entry.name, (where,)), np.where(present, time.reshape(present.shape), -np.inf)
    evidence = grams.entry(key).steps(when, moments).evidence(MOTION * UNSIZED_SCALES)
    k = int(np.argmax(evidence + log_prior))
    moment = float(moments[k])
    begun = np.asarray(dataset.table.time)[first_of_visit(dataset.table)]
    D = (begun >= moment)[:, None, None] * MOTION * np.eye(entry.size)
    return moved(dataset, key, D), {effect.constants[0].key: moment}, -float(log_prior[k])


def _response(torque: Array, effect: JointResponse, grams: Grams, where: str) -> Tried | None:
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


# A joint's scatter of a visit and, as a multiple of it, that of a configuration.
Scatter = tuple[float, float]


def line_families(
    dataset: DiagnosisData, found: FittedSum
) -> list[tuple[float, Component, Scatter, tuple[Component, ...]]]:
    """The most conspicuous family of lines of every joint beside the sum, the best first: what it
    earns in nats less the search, itself, the joint's scatter beside it, and whom it replaces.
    What is not found yet counts as scatter of its joint, or as its curve: so a family is tried
    beside these, and in their place."""
    sums = beside(dataset, found, found.noise)
    out, now = [], sums.at.marginal
    multiples = MULTIPLES[:1] if len(dataset.blocks.member) > FEW_POSES else MULTIPLES
    for h in ripples(dataset):
        i = index(h.where)
        own = [c for c in found.components if c.where == h.where]
        lines = sum(len(c.settings) // 2 for c in own if isinstance(c.effect, GearSpectrum))
        if lines > MOST_FOUND:
            continue
        curves = tuple(c for c in own if isinstance(c.effect, JointCurve))
        scatter = scatter_of(found.noise, i)
        beneath = less_scatter(found.noise, i) or ([scatter] if curves else [])
        quieter = (
            (beside(dataset, found, with_scatter(found.noise, i, less), curves), less, curves)
            for less in beneath
        )
        tried = (
            (*_best_family(grams, h, m, now), less, instead_of)
            for grams, less, instead_of in chain([(sums, scatter, ())], quieter)
            for m in multiples
        )
        gain, of, less, instead_of = max(tried, key=lambda family: family[0])
        if gain > HOPELESS:
            out.append((gain, family_component(dataset, h.where, *of), less, instead_of))
    return sorted(out, key=lambda family: -family[0])


# A family that is this far (nats) from paying for its search beside the sum as it is may still pay
# once noise, sizes and the other orders have followed.
HOPELESS = -3.0


def with_scatter(noise: NoiseValues, i: int, scatter: Scatter) -> NoiseValues:
    joint, shared = noise.joint.copy(), noise.shared.copy()
    joint[i], shared[i] = scatter
    return replace(noise, joint=joint, shared=shared)


def scatter_of(noise: NoiseValues, i: int) -> Scatter:
    return float(noise.joint[i]), float(noise.shared[i])


def less_scatter(noise: NoiseValues, i: int) -> list[Scatter]:
    """Scatter that joint i (0-based) may have once its lines are known: half of it, as usual from
    pose to pose, and as usual from visit to visit as well."""
    s, c = scatter_of(noise, i)
    s_usual, c_usual = scatter_of(NoiseValues.usual(len(noise.joint)), i)
    s_least, c_least = min(s, s_usual), min(c, c_usual)
    half = (s, c / 2) if c > 1 else (s / 2, c)
    tried = {(max(half[0], s_least), max(half[1], c_least)), (s, c_least), (s_least, c_least)}
    return sorted(tried - {(s, c)}, reverse=True)


MOST_FOUND = MOST_LINES - 3


def _best_family(
    grams: Grams, h: Hypothesis, m: int, now: float
) -> tuple[float, tuple[float, int, float, float]]:
    """What the best family of m lines of a joint gains, its order, m, how well these data know the
    order, and what finding it cost; `now` is the log marginal likelihood of the sum as it is."""
    step = STEP * _apart(grams.dataset, h.where) / m
    orders = np.arange(LOWEST, HIGHEST / m, step)
    # An order of 10 to 20 is as probable as one of 100 to 200 beforehand.
    log_prior = -np.log(orders) - np.log((1 / orders).sum() * len(MULTIPLES))
    k = int(np.argmax(family_evidence(grams, h, orders, m) + log_prior))
    search = -float(log_prior[k])
    order, sd, evidence = refined_order(grams, h, float(orders[k]), m, step)
    return evidence - search + (grams.at.marginal - now), (order, m, sd, search)


def _apart(dataset: DiagnosisData, where: str) -> float:
    """1/range(q) of a joint, by which the orders of its lines are told apart."""
    return 1 / float(np.ptp(dataset.table.q[:, index(where)]))


def sharpened(dataset: DiagnosisData, found: FittedSum) -> list[Component] | None:
    """The components of a sum with the orders of all lines where they fit best together; None where
    they are there already.  Gauss–Newton in the orders N of all families at once, sizes and noise
    as they are: with amplitudes a_k, b_k at their posterior mean, a family's column is Σ_k k
    (q − q₀)(a_k cos kNq − b_k sin kNq), which is that of the amplitudes' shifts.  The posterior
    says how well each order is known."""
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
    most = STEP * np.array([_apart(dataset, where) for where in places])
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
            family = family_component(dataset, c.where, order, m, float(known), c.search)
            components[k] = replace(family, given=c.given)
        now = replace(now, sums=replace(now.sums, components=tuple(components)))
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

    def directions(some: slice) -> Array:
        # The amplitudes of multiples fall with their number, in the mean.
        D = [dataset.direction(h, orders[some, None] * k) / k for k in range(1, m + 1)]
        return np.concatenate(D, axis=4)

    return sums.each(len(orders), 2 * m, directions).evidence(scales)


def family_component(
    dataset: DiagnosisData, where: str, order: float, m: int, sd: float, search: float
) -> Component:
    effect = GearSpectrum()
    q = dataset.table.q[:, index(where)]
    settings = {"spectrum_size_rad": 1.0, "spectrum_centre_rad": float((q.max() + q.min()) / 2)}
    for k in range(1, m + 1):
        settings |= {f"order_{k}": k * order, f"order_sd_{k}": k * sd}
    # The cell with these constants is all that their direction asks of a model.
    chain, cell = dataset.base.model.chain, dataset.base.model.cell
    cell = replace(cell, model=replace(cell.model, nominal=cell.model.nominal.at(where, settings)))
    lines = Hypothesis(effect, where, effect.parameters(where, chain, cell), ())
    D = RegressorDirection(lines, Arm(chain, cell))(dataset.table, np.zeros((1, 0)))[:, 0]
    D = D * [LINE * (p.typical or 0.0) for p in lines.parameters]
    columns = moved(dataset, (JointMotion.name, (where,)), D)
    kept = tuple((key, v) for key, v in settings.items() if key.startswith("order"))
    return Component(
        "angle", effect, where, columns, LINE, settings=kept, search=search,
        fellows=len(turning_joints(chain)),
    )  # fmt: skip


# Which order the lines of a joint have, or whether there are any: all orders judged at once.
#
# Beside a sum of components, with the joint's own family left out, a family of lines at N and its
# multiples has the log evidence E(N) over none, its size integrated out under what those of the
# other joints let expect.  That k of n joints have a family says of the next one that it has: where
# any number of joints is equally probable beforehand, the share of joints with one Beta(1, 1), the
# odds are
#
#     (k + 1) : (n − k)
#
# (Laplace's rule of succession; Scott and Berger 2010, Annals of Statistics 38, 2587; see `Pool`).
# So the odds of N against no family are w(N) exp E(N) (k + 1)/(n − k), w its prior, and what the
# joint scatters by from pose to pose where its family is not found is summed over on both sides.
# Gears of one arm are alike: sizes, log N and the number of multiples have a prior about what the
# other joints have, as wide as these differ, and one more that is like any.  The rule is for joints
# beside others: where no family has been found by what it earns, none comes in by it.

# Of the grid, in units of 1/range(q) for the highest multiple.  Lowest orders that differ by less
# than π such units are one: over the joint's angles they part by half a period at most.
FINE, SAME = 0.5, math.pi
SIZES = 7  # of a family, equally probable
PEAKS = 40  # points of the grid that may be the middle of the most probable order
CERTAIN = 1 - 1e-9
# Logarithms: the middle of the orders and their spread, if any is as probable as any.
USUAL_ORDER = math.log(LOWEST * HIGHEST) / 2
ORDERS = math.log(HIGHEST / LOWEST) / math.sqrt(12)


class OrderPosterior:
    """Of the lines of the joint of the ripple `h` beside the sum without the family `own`: what the
    odds are against no family of `orders` (G,), the lowest one of `multiples` (G,) lines.
    `log_odds` (G,) has prior and width of the grid in it, of which `presence` is that of any
    family; `evidence` (G,) is over none.  `grams` score lines of these `scales` under the `scatter`
    of the joint that is the likeliest with them."""

    def __init__(
        self, dataset: DiagnosisData, found: FittedSum, h: Hypothesis,
        own: Sequence[Component] = (),
    ) -> None:  # fmt: skip
        i, unit = index(h.where), _apart(dataset, h.where)
        grid = [np.arange(LOWEST, HIGHEST / m, FINE * unit / m) for m in MULTIPLES]
        self.h, self.resolution, self.orders = h, SAME * unit, np.concatenate(grid)
        self.multiples = np.repeat(MULTIPLES, [len(part) for part in grid])
        fellows = [family for where, family in families_of(found).items() if where != h.where]
        mean, variance = alike(np.array([size for *_, size in fellows]), 0.0, ALONE)
        self.scales = np.exp(mean + np.sqrt(variance) * ndtri((np.arange(SIZES) + 0.5) / SIZES))
        n, k = len(turning_joints(dataset.base.model.chain)), len(fellows)
        self.presence = presence_cost(n, k) - presence_cost(n, k + 1)
        # What is not known of its lines counts as scatter of the joint.
        none, each, grams_of = [], [], []
        tried = [scatter_of(found.noise, i), *less_scatter(found.noise, i)]
        for scatter in tried:
            noise = with_scatter(found.noise, i, scatter)
            grams = beside(dataset, found, noise, own)
            none.append(grams.at.marginal - 0.5 * log_prior(grams.data.stated, noise))
            gains = [family_evidence(grams, h, part, m, self.scales)
                     for m, part in zip(MULTIPLES, grid, strict=True)]  # fmt: skip
            each.append(none[-1] + np.concatenate(gains))
            grams_of.append(grams)
        self.evidence = logsumexp(each, axis=0) - float(logsumexp(none))
        prior = log_prior_of(self.orders, self.multiples, unit, fellows)
        self.log_odds = self.evidence + self.presence + prior
        likeliest = int(np.argmax([e[np.argmax(self.log_odds)] for e in each]))
        self.grams, self.scatter = grams_of[likeliest], tried[likeliest]

    def odds_near(self, order: float, m: int | None = None) -> float:
        """Log odds of a family at this order, as far as these data resolve it, against none; of m
        lines, or of any number."""
        return self._odds(self._near(order, m))

    def _near(self, order: float, m: int | None = None) -> BoolArray:
        near = np.abs(self.orders - order) <= self.resolution
        return near if m is None else near & (self.multiples == m)

    def _odds(self, these: BoolArray) -> float:
        return float(logsumexp(self.log_odds[these])) if these.any() else -math.inf

    @cached_property
    def best(self) -> tuple[float, int]:
        """The most probable order, at its highest peak, and the most probable number of lines."""
        top = np.argsort(self.log_odds)[-PEAKS:]
        return self._at(max(self.orders[top].tolist(), key=self.odds_near))

    @cached_property
    def likeliest_line(self) -> tuple[float, int]:
        """The order that most probably has a line, of whichever family, and how many lines a family
        that begins there most probably has."""
        top = np.argsort(self.log_odds)[-PEAKS:]
        every = {k * order for order in self.orders[top].tolist() for k in MULTIPLES}
        return self._at(max((o for o in every if o <= HIGHEST), key=self.probability))

    def _at(self, middle: float) -> tuple[float, int]:
        m = max(MULTIPLES, key=lambda n: self.odds_near(middle, n))
        return float(self.orders[self._peak(middle, m)]), m

    def _peak(self, order: float, m: int) -> int:
        return int(np.argmax(np.where(self._near(order, m), self.log_odds, -np.inf)))

    def probability(self, order: float) -> float:
        """Of a line at this order, the lowest of its family or a multiple, beside all others and
        none: half an order with twice as many lines has it as well."""
        its = np.zeros(len(self.orders), dtype=bool)
        for k in MULTIPLES:
            its |= (np.abs(k * self.orders - order) <= self.resolution) & (self.multiples >= k)
        return math.exp(self._odds(its) - np.logaddexp(0.0, logsumexp(self.log_odds)))

    def family(self, order: float, m: int) -> Component:
        """The family of m lines near this order, where it fits best.  The nats that its search
        costs are those that make of its evidence, and of the odds that there is any family, its
        odds against none and all other orders; what is decided here is not asked again."""
        k = self._peak(order, m)
        width = FINE / SAME * self.resolution / m
        at = float(self.orders[k])
        lowest, sd, _ = refined_order(self.grams, self.h, at, m, width, self.scales)
        own = float(logit(min(self.probability(order), CERTAIN)))
        search = max(float(self.evidence[k]) + self.presence - own, 0.0)
        return replace(
            family_component(self.grams.dataset, self.h.where, lowest, m, sd, search), given=True
        )


def log_prior_of(
    orders: Array, multiples: IntArray, unit: float, fellows: Sequence[tuple[float, int, float]]
) -> Array:
    """Log prior (G,) of a family's lowest order and number of lines, from those of other joints.
    Orders: normal in log N.  A next multiple is there with odds k + 1 to n − k + 1 where k of n
    families that may have it have it."""
    mean, variance = alike(np.log([order for order, *_ in fellows]), USUAL_ORDER, ORDERS)
    each = np.log(FINE * unit / multiples / orders) - 0.5 * (np.log(orders) - mean) ** 2 / variance
    each -= logsumexp(each[multiples == 1])
    for m in MULTIPLES:
        own = multiples == m
        for last in MULTIPLES[1:]:
            may = [n for order, n, _ in fellows if n >= last - 1 and last * order <= HIGHEST]
            share = (sum(n >= last for n in may) + 1) / (len(may) + 2)
            if m >= last:
                each[own] += math.log(share)
            elif m == last - 1:
                each[own] += np.where(last * orders[own] <= HIGHEST, math.log1p(-share), 0.0)
    return np.asarray(each)


def alike(others: Array, usual: float, spread: float) -> tuple[float, float]:
    """Mean and variance of another one beside these (k,), normal about what they have in common.
    Their own spread counts with one like `usual` ± `spread`, as wide as any is beforehand."""
    k = len(others)
    mean = (float(others.sum()) + usual) / (k + 1)
    variance = (spread**2 + float(((others - mean) ** 2).sum()) + (usual - mean) ** 2) / (k + 1)
    return mean, variance * (1 + 1 / (k + 1))


def families_of(found: FittedSum) -> dict[str, tuple[float, int, float]]:
    """Of every joint with lines the largest family: its lowest order, how many lines it has, and
    the logarithm of their size."""
    sized = zip(found.sizes.size.tolist(), found.components, strict=True)
    return {
        c.where: (dict(c.settings)["order_1"], len(c.settings) // 2, size)
        for size, c in sorted(sized, key=lambda pair: pair[0]) if isinstance(c.effect, GearSpectrum)
    }  # fmt: skip


def ripples(dataset: DiagnosisData) -> list[Hypothesis]:
    return [
        h for h in dataset.hypotheses
        if isinstance(h.effect, GearRipple) and np.ptp(dataset.table.q[:, index(h.where)]) >= MOVED
    ]  # fmt: skip
