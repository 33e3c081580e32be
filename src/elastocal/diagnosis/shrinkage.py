"""How far the gap shrinks at poses that had no part in the fit, with its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.spatial import cKDTree

from elastocal.diagnosis.baseline import Baseline, from_centre, prior_deviations
from elastocal.diagnosis.diagnosis import FittedParameter, Gap
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import SelectedEffects
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import (
    Item,
    ModelSet,
    beside,
    extended,
    fit_extended,
    fit_set,
    signal_of,
    under_other_backlash_model,
    with_items,
)
from elastocal.diagnosis.noise_floor import NoiseValues, NoisyData, noise_draws, project
from elastocal.diagnosis.stated_floor import (
    left_out_residual,
    left_out_together,
    nearest,
    squared_lengths,
    supported_floor,
)
from elastocal.identification.error_budget import BudgetStep, resampled_rms
from elastocal.identification.scrutiny import stage_of
from elastocal.measurements import Measurements, visits
from elastocal.model.effects.placements import BaseFrame
from elastocal.model.effects.play import Backlash
from elastocal.model.manipulator import Model, Regression
from elastocal.model.observations import Observations, observe
from elastocal.units import Array, IntArray


def rms_with_interval(
    data: NoisyData, packed: Array, rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    """3-D rms in m of residuals (C, m) and its 95 % interval by resampling configurations."""
    return resampled_rms(*squared_lengths(data, packed), rng)


# The gap, step by step: from the nominal arm through the fitted effects to the noise floor.


def budget(
    dataset: DiagnosisData, found: SelectedEffects, rng: np.random.Generator
) -> tuple[Gap, tuple[BudgetStep, ...]]:
    """Held-out 3-D errors of each step, and the gap they add up to.

    `dataset` is about the fit without further effects.  Where an effect goes with time, what is
    left out are tenths of the time: between neighbours a drift needs no model.
    """
    chosen = found.chosen
    together = left_out_together(dataset, chosen)
    steps = first_steps(dataset, found.nothing, together, rng)
    known = [k for k, item in enumerate(chosen.items) if item.known]
    for n, last in enumerate(known, 1):
        items = tuple(chosen.items[k] for k in known[:n])
        scales = tuple(chosen.scales[k] for k in known[:n])
        data = with_items(found.dataset, items, scales)
        name = ":".join(chosen.items[last].key)
        steps.append(_step(name, data, chosen, together, rng))
    # Where the noise model does not fit, the readings still say what scatter they leave.
    left = rms_with_interval(chosen.data, left_out_residual(chosen.at, together), rng)[0]
    calibrated = steps[len(steps) - len(known) - 1].heldout_rms
    nominal, explained = steps[0].heldout_rms, steps[-1].heldout_rms
    unknown = [item.what.where for item in chosen.items if not item.known]
    if unknown:
        # What a smooth curve without a name takes away: no explanation, but how much is at stake.
        steps.append(_step("unknown:" + "+".join(unknown), chosen.data, chosen, together, rng))
    best = min([left, *(step.heldout_rms for step in steps)])
    supported = supported_floor(found.dataset, chosen.data, chosen.noise, best)
    floor = supported.noise
    gap = Gap(nominal, calibrated, explained, floor, supported.unexplained)
    return gap, (*steps, BudgetStep("noise_floor", floor, (floor, floor)))


def first_steps(
    dataset: DiagnosisData, nothing: ModelSet, together: IntArray | None, rng: np.random.Generator
) -> list[BudgetStep]:
    """The nominal arm, base and markers placed as the baseline left it, and the fitted effects."""
    placed = dataset.blocks.pack(dataset.base.nominal.reshape(-1, dataset.blocks.size, 1))[:, :, 0]
    steps = [BudgetStep(BaseFrame.name, *rms_with_interval(dataset.data, placed, rng))]
    fitted = _fitted_steps(dataset)
    return steps + [_step(name, data, nothing, together, rng) for name, data in fitted]


def _step(
    name: str, data: NoisyData, fitted: ModelSet, together: IntArray | None,
    rng: np.random.Generator,
) -> BudgetStep:  # fmt: skip
    # Weights of an ordinary calibration: the scatter of joints that is fitted beside a missing
    # effect is that effect, and weights by it would spare it.
    residual = left_out_residual(project(data, fitted.noise.of_instrument()), together)
    return BudgetStep(name, *rms_with_interval(data, residual, rng))


def _fitted_steps(dataset: DiagnosisData) -> Iterator[tuple[str, NoisyData]]:
    """The model's own effects, stage by stage, those of the later step held at nominal."""
    data, effects = dataset.data, {p.name: p.effect for p in dataset.base.model.parameters}
    stage = np.array([stage_of(effects.get(name, name)) for name in dataset.fitted])
    for k, name in ((1, "geometry"), (2, "compliance")):
        if (stage == k).any():
            free = stage <= k
            yield name, replace(data, X=data.X[:, :, free], precision=data.precision[free])


# How far the gap shrinks on poses that had no part in choosing or fitting the effect.
#
# The error of a model at a new pose is its prediction less the true arm's, without noise:
#
#     e(θ*) = f(q, x̂) − h(q, θ*),    θ* ~ posterior given all data,
#
# where f is the model before and after the effect is added, each fitted by the instrument's noise
# as a calibration would, and h what is held to be true: at times a rival or another constant,
# as probable as each is, which charges the interval for the selection.  The remaining fraction is
# the ratio of the rms errors over a set of NEW_POSES, drawn anew for every θ* from a population
# that is itself known from the campaign's poses only (Bayesian bootstrap, Rubin 1981).

BOOTSTRAP_DRAWS = 400
NEW_POSES = 100  # in the set that the intervals are for


class Shrinkage(NamedTuple):
    """Fraction by which the error at new poses falls: best value, `ci90` and `ci95`."""

    reduction: float
    ci90: tuple[float, float]
    ci95: tuple[float, float]

    @classmethod
    def of(cls, drawn: Array) -> Shrinkage:
        """The median and the intervals of draws (n,)."""
        low95, low90, middle, high90, high95 = np.quantile(
            drawn, [0.025, 0.05, 0.5, 0.95, 0.975]
        ).tolist()
        return cls(middle, (low90, high90), (low95, high95))


@dataclass(frozen=True)
class PosteriorDraw:
    """A draw from the posterior predictive, at its most probable values: errors (rows, components)
    of the models `before` and `after` at new poses if it is true.  It moves by `spread` (rows,
    components, k) times standard normal numbers.  `pose` (rows,) numbers each reading's pose."""

    before: Array
    after: Array
    spread: Array
    pose: NDArray[np.int64]
    probability: float


@dataclass(frozen=True)
class Change:
    """A change that happened in a pause between visits: how far (m² per reading) one on its wrong
    side is off, the largest `share` of the time that may be on it, and the number of `visits` of
    a pose: the readings of a visit are on the same side."""

    square: float = 0.0
    share: float = 0.0
    visits: float = 1.0


def shrinkage(
    posterior_draws: Sequence[PosteriorDraw], measured: int, unnamed: float, change: Change,
    rng: np.random.Generator,
) -> Shrinkage:  # fmt: skip
    """Reduction of the rms error from before to after, one of the draws being true.

    `measured` is the number of poses that tell what poses there are; `unnamed` (m²) the mean
    squared length of what is known to be there without a name: neither model has it, and it is
    taken to be as large at new poses as it was at the measured ones.
    """
    weights = np.array([draw.probability for draw in posterior_draws])
    which = rng.choice(len(posterior_draws), BOOTSTRAP_DRAWS, p=weights / weights.sum())
    parts = [
        _reductions(posterior_draws[k], int((which == k).sum()), measured, unnamed, change, rng)
        for k in np.unique(which)
    ]
    return Shrinkage.of(np.concatenate(parts))


def _reductions(
    draw: PosteriorDraw, n: int, measured: int, unnamed: float, change: Change,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    moved = draw.spread @ rng.normal(size=(draw.spread.shape[2], n))
    poses, at, count = np.unique(draw.pose, return_inverse=True, return_counts=True)
    share = rng.dirichlet(np.full(len(poses), measured / len(poses)), n)
    chosen = rng.multinomial(NEW_POSES, share)
    mean = []
    for error in (draw.before, draw.after):
        squares = ((error[:, :, None] - moved) ** 2).sum(axis=1)
        total = np.zeros((len(poses), n))
        np.add.at(total, at, squares)
        readings = chosen @ count
        mean.append((chosen.T * total).sum(axis=0) / readings + unnamed)
    times = round(NEW_POSES * change.visits)
    late = rng.binomial(times, change.share * rng.random(n)) / times
    mean[1] = mean[1] + late * change.square
    return np.asarray(1 - np.sqrt(mean[1] / np.maximum(mean[0], 1e-300)))


# Poses that had no part in a fit: those that another campaign of the same kind might visit.

CANDIDATES = 10  # times as many poses as are wanted
UNLIKE = 0.01  # chance of poses so unlike the measured ones, if all came from one population
PERMUTED = 199  # allotments of the names "measured" and "new" that it is judged by
NEIGHBOURS = 4  # of a pose, between which and itself a new one may lie
ROUNDS, HEAVIEST = 20, 20.0  # of raking, and how many times the mean weight a pose may count


def new_pose_table(
    model: Model, table: Measurements, n: int, rng: np.random.Generator
) -> Measurements:
    """n new configurations like those of the table.

    Each repeats the load states, repeats and markers of one that was measured.  Every joint's
    angle (with the side it came from, and the torque at it) is that of another one drawn at
    random, independently of the other joints, and all markers stay inside the box that the
    measured ones show: floor and fixtures keep new poses out of the same regions (unless
    hardly any is inside).  Of those, angles that lead out of the box more often are chosen more
    often, until every joint is as far from its middle as it was in the campaign.  Times are
    uniform over the campaign's.  Readings are left as they are and mean nothing.

    Where the campaign's joints depend on each other (a grid of positions, the tool held upright),
    such poses are unlike the measured ones; then each lies near a measured one instead, up to half
    the way towards or away from one of its neighbours.
    """
    drawn, donors = _recombined(table, CANDIDATES * n, rng)
    inside = _inside(model, table, drawn, n)
    chosen = rng.choice(inside, n, replace=False, p=_raked(donors[inside]))
    new = drawn.take(np.isin(drawn.configuration, chosen))
    if _unlike(_joints(table), _joints(new), rng):
        drawn = _beside_measured(table, CANDIDATES * n, rng)
        chosen = rng.choice(_inside(model, table, drawn, n), n, replace=False)
        new = drawn.take(np.isin(drawn.configuration, chosen))
    return new


def _inside(model: Model, table: Measurements, drawn: Measurements, n: int) -> IntArray:
    """Configurations of `drawn` inside the table's box; all of them where fewer than n are."""
    low, high = _box(model.target_poses(table)[1], table.configuration)
    at = model.target_poses(drawn)[1]
    outside = ((at < low) | (at > high)).any(axis=1)
    inside = np.setdiff1d(drawn.configuration, drawn.configuration[outside])
    return inside if len(inside) >= n else np.unique(drawn.configuration)


def _joints(table: Measurements) -> Array:
    return table.q[np.unique(table.configuration, return_index=True)[1]]


def _unlike(measured: Array, new: Array, rng: np.random.Generator) -> bool:
    """Whether poses `new` (m, joints) are of another population than the `measured` (n, joints).

    By how many have their nearest neighbour among their own kind (Schilling 1986, J. Am. Stat.
    Assoc. 81), against the same names allotted at random.
    """
    if len(measured) > len(new):
        measured = measured[rng.choice(len(measured), len(new), replace=False)]
    both = np.concatenate([measured, new])
    near = nearest(both / np.maximum(measured.std(axis=0), 1e-12))[0][:, 1]
    kind = np.arange(len(both)) < len(measured)
    own = int((kind == kind[near]).sum())
    allotted = rng.permuted(np.tile(kind, (PERMUTED, 1)), axis=1)
    as_many = (allotted == allotted[:, near]).sum(axis=1) >= own
    return bool((1 + as_many.sum()) / (1 + PERMUTED) <= UNLIKE)


def _beside_measured(table: Measurements, n: int, rng: np.random.Generator) -> Measurements:
    """n poses, each a measured one moved by up to half the way to one of its neighbours, or by as
    much away from it."""
    codes, first = np.unique(table.configuration, return_index=True)
    q = table.q[first]
    scaled = q / np.maximum(q.std(axis=0), 1e-12)
    k = min(NEIGHBOURS, len(q) - 1)
    near = cKDTree(scaled).query(scaled, k=k + 1)[1]
    own = rng.integers(len(codes), size=n)
    other = near[own, rng.integers(1, k + 1, n)]
    step = rng.uniform(-0.5, 0.5, (n, 1)) * (q[other] - q[own])
    rows_of = [np.flatnonzero(table.configuration == c) for c in codes]
    new, _ = _repeated(table, [rows_of[c] for c in own])
    new = replace(new, q=new.q + step[new.configuration])
    return _timed(new, table, rng)


def _repeated(table: Measurements, rows: list[IntArray]) -> tuple[Measurements, IntArray]:
    """A configuration for each of the groups of rows, with fresh numbers; and each row's place
    in its group."""
    n = len(rows)
    configuration = np.repeat(np.arange(n), [len(r) for r in rows])
    labels = tuple(str(c + 1) for c in range(n))
    new = table.take(np.concatenate(rows))
    new = replace(new, configuration=configuration, configuration_labels=labels)
    return new, np.concatenate([np.arange(len(r)) for r in rows])


def _raked(donors: IntArray) -> Array:
    """Probabilities (n,) of poses so that each donor of a joint's angle, `donors` (n, joints), is
    as probable as the others: raking (Deming and Stephan 1940, Ann. Math. Stat. 11)."""
    weight = np.full(len(donors), 1 / len(donors))
    for _ in range(ROUNDS):
        for of_joint in donors.T:
            share = np.bincount(of_joint, weight)
            wanted = 1 / np.count_nonzero(share)
            weight *= (wanted / np.where(share > 0, share, 1.0))[of_joint]
        weight = np.minimum(weight, HEAVIEST / len(weight))
        weight /= weight.sum()
    return weight


def _box(at: Array, configuration: IntArray) -> tuple[Array, Array]:
    """Ends (3,) of the box that positions `at` (n_rows, 3) were drawn from.

    n draws leave a part of 1/(n + 1) beyond each end on average, as long as the step from the last
    configuration to the one before it; without it the poses that err most would be missing.
    """
    codes = np.unique(configuration)
    low = np.sort([at[configuration == c].min(axis=0) for c in codes], axis=0)
    high = np.sort([at[configuration == c].max(axis=0) for c in codes], axis=0)
    return 2 * low[0] - low[min(1, len(low) - 1)], 2 * high[-1] - high[max(-2, -len(high))]


# What a table says of each joint by itself.
OF_JOINTS = ("q", "approach", "torque", "move", "direction")


def _recombined(
    table: Measurements, n: int, rng: np.random.Generator
) -> tuple[Measurements, IntArray]:
    """n poses, and which measured configuration (n, joints) each joint's angle is from."""
    codes = np.unique(table.configuration)
    rows_of = [np.flatnonzero(table.configuration == c) for c in codes]
    new, place = _repeated(table, [rows_of[k] for k in rng.integers(len(codes), size=n)])
    configuration = new.configuration
    own = {name: getattr(new, name) for name in OF_JOINTS}
    donors = rng.integers(len(codes), size=(n, table.q.shape[1]))
    count, every = np.array([len(rows) for rows in rows_of]), np.concatenate(rows_of)
    begin = np.cumsum(count) - count
    for j, of_joint in enumerate(donors.T):
        of = of_joint[configuration]
        source = every[begin[of] + place % count[of]]
        for name, values in own.items():
            if values is not None:
                values[:, j] = getattr(table, name)[source, j]
    return _timed(new, table, rng), donors


def _timed(new: Measurements, table: Measurements, rng: np.random.Generator) -> Measurements:
    """`new` at times uniform over those of the table, as warm as it was then."""
    if table.time is None:
        return new
    at = visits(new)
    time = rng.uniform(table.time.min(), table.time.max(), at.max() + 1)[at]
    warmth = None
    if table.temperature is not None:
        order = np.argsort(table.time)
        warmth = np.interp(time, table.time[order], table.temperature[order])
    return replace(new, time=time, temperature=warmth)


# The nonlinear fit of the model with the found effects in it, weighted by the fitted noise.


def posteriors(
    dataset: DiagnosisData, base: Baseline, at: Regression, noises: Sequence[NoiseValues],
    further: Array | None = None, prior: Mapping[str, float] | None = None,
) -> Iterator[tuple[Array, Array]]:  # fmt: skip
    """One step from the fit `base`, at which the model is evaluated, to the readings of `dataset`
    under each of the noises: x (parameters,) and S (parameters, k), so that x + S z with standard
    normal z is a draw from what the data leave possible.

    `further` (rows, k) columns of constants that are not among the model's parameters, scaled to
    their prior deviations, stand last: at zero in x.  `prior` holds standard deviations of
    parameters by name, where they are not wide.
    """
    wide = dict(zip(base.model.names, prior_deviations(base), strict=True))
    width = np.array([(prior or {}).get(name, wide[name]) for name in wide])
    B = at.B * width
    away = from_centre(base)
    # What no reading shows and nobody has sized, as friction that grows with a load where there is
    # none, has no width: it stays.
    residual = at.residual + B @ np.divide(away, width, out=np.zeros_like(away), where=width > 0)
    centre = base.x - away
    if further is not None:
        k = further.shape[1]
        B, width = np.hstack([B, further]), np.append(width, np.ones(k))
        centre = np.append(centre, np.zeros(k))
    pack, size = dataset.blocks.pack, base.observed.size
    data = replace(
        dataset.data, r=pack(residual.reshape(-1, size, 1))[:, :, 0],
        X=pack(B.reshape(-1, size, B.shape[1])), precision=np.ones(B.shape[1]),
    )  # fmt: skip
    for noise in noises:
        fit = project(data, noise)
        spread = linalg.solve_triangular(fit.factor, np.diag(width), lower=True).T
        yield centre + width * fit.beta, spread


# What an effect's searched constants may be instead, and what that does at new poses.

MOST = 6  # settings that are kept
WORTH = 0.02  # probability from which one is


def other_settings(dataset: DiagnosisData, chosen: ModelSet, k: int) -> list[tuple[Item, float]]:
    """Item k at each of its plausible settings, its own first, and their probabilities.

    Only the item itself where it has none.
    """
    item = chosen.items[k]
    what = item.what
    if not isinstance(what, Hypothesis) or not what.driven or not what.settings:
        return [(item, 1.0)]
    data = beside(dataset, chosen, k)
    grid = dataset.grids[what.key]
    grams = Grams(dataset, data, project(data, chosen.noise))
    own = float(grams.of(what, item.settings[None]).evidence(item.scales)[0])
    each = grams.of(what).evidence(item.scales)
    # The chosen one stands for the point of the grid that it was refined from.
    nearest = grid.nearest(item.settings)
    each[nearest] = own
    share = np.exp(each - each.max())
    share /= share.sum()
    others = [int(i) for i in np.argsort(-share)[:MOST] if share[i] > WORTH and i != nearest]
    out = [(item, float(share[nearest]))]
    return out + [(replace(item, settings=grid.values[i]), float(share[i])) for i in others]


def between_visits(dataset: DiagnosisData, chosen: ModelSet, k: int) -> Change:
    """How far readings on the wrong side of a change are off, and how many there may be.

    A change between two visits is put into the middle of the pause; new readings that fall
    between that and the true moment, a share of up to half the pause over the duration, are
    off by the whole change.  Nothing for effects that do not change once.
    """
    what = chosen.items[k].what
    time = dataset.table.time
    kinds = [s.kind for s in what.settings] if isinstance(what, Hypothesis) else []
    if "change_time" not in kinds or time is None:
        return Change()
    moments = np.unique(time)
    changed = chosen.items[k].settings[kinds.index("change_time")]
    later = int(np.searchsorted(moments, changed))
    if not 0 < later < len(moments):
        return Change()
    pause = float(moments[later] - moments[later - 1]) / float(np.ptp(moments))
    squares, count = squared_lengths(dataset.data, signal_of(dataset, chosen, k))
    shown = squares > 0
    per_reading = float(squares[shown].sum() / max(count[shown].sum(), 1))
    return Change(per_reading, pause / 2, float(dataset.present.sum() / len(dataset.present)))


# What may be true at new poses, given what was found: each as probable as it is.

DRAWN = 200  # new poses that the sets are drawn from
NOISES = 10  # values of the noise that what may be true is drawn under
NUDGE = 0.01  # of a setting's grid step: a difference quotient in constants that are not parameters
WORTH_A_DRAW = 0.01  # probability from which a rival may be drawn as true


@dataclass(frozen=True)
class Confirmation:
    """Models before and after effects are added, and new poses to compare them at.

    `fitted` is the exact model with all known effects, fitted to the readings; `plain` the cell's
    own model.
    """

    dataset: DiagnosisData
    chosen: ModelSet
    plain: Baseline
    fitted: Baseline
    observed: Observations
    noise: tuple[NoiseValues, ...]

    @classmethod
    def of(cls, found: SelectedEffects, plain: Baseline, rng: np.random.Generator) -> Confirmation:
        chosen, dataset = found.chosen, found.dataset
        fitted = fit_extended(dataset, chosen, _known(chosen.items))
        table = new_pose_table(plain.model, plain.observed.table, DRAWN, rng)
        observed = observe(table, plain.model.observe)
        noise = noise_draws(chosen.data, chosen.noise, NOISES, rng)
        return cls(dataset, chosen, plain, fitted, observed, tuple(noise))

    @cached_property
    def parameters(self) -> dict[tuple[str, str], tuple[FittedParameter, ...]]:
        """The exact model's values by effect and place, weighted by all the noise that was
        found."""
        measured, noise = self._regressions(self.fitted)[0], self.chosen.noise
        values, spreads = next(posteriors(self.dataset, self.fitted, measured, [noise]))
        out: dict[tuple[str, str], tuple[FittedParameter, ...]] = {}
        for p, x, spread in zip(self.fitted.model.parameters, values, spreads, strict=True):
            found = FittedParameter(p.name, float(x), p.unit, float(np.linalg.norm(spread)))
            out[p.effect, p.where] = (*out.get((p.effect, p.where), ()), found)
        return out

    @cached_property
    def _known_regressions(self) -> dict[tuple[Model, bytes], tuple[Regression, Regression]]:
        return {}

    def _regressions(self, base: Baseline) -> tuple[Regression, Regression]:
        """A model at the measured rows and at the new ones; kept, since the draws of all items
        begin with the one that was fitted."""
        key = base.model, base.x.tobytes()
        if key not in self._known_regressions:
            measured, new = (
                base.model.regressor(observed.table, base.x, observations=observed)
                for observed in (base.observed, self.observed)
            )
            self._known_regressions[key] = measured, new
        return self._known_regressions[key]

    def posterior_draws(
        self, k: int, rivals: tuple[tuple[Item, float], ...]
    ) -> list[PosteriorDraw]:
        """Errors without and with item k if what is true is item k at any plausible setting, or
        one of its `rivals`, of which itself is the first, with their probabilities.

        Before it the model is fitted as a calibration would that knows nothing of the joints'
        scatter: the scatter fitted beside a missing effect is the effect, which weights by it
        would spare.
        """
        others = _known(self.chosen.without(k))
        plain = fit_extended(self.dataset, self.chosen, others) if others else self.plain
        before = plain.model.predict(self.observed.table, plain.x, self.observed)
        out = []
        for item, share in other_settings(self.dataset, self.chosen, k):
            like = replace(self.chosen, items=self._with(k, item))
            at = replace(self.fitted, model=extended(self.plain.model, _known(like.items)))
            out += self._draws(at, like, item, before, rivals[0][1] * share)
        out = self._under_both_backlash_models(k, before, out)
        for item, share in rivals[1:]:
            if share < WORTH_A_DRAW or not item.known:
                continue
            rival = fit_set(self.dataset, self._with(k, item), self.chosen.noise)
            at = fit_extended(self.dataset, rival, _known(rival.items))
            out += self._draws(at, rival, item, before, share)
        return out

    def _under_both_backlash_models(
        self, k: int, before: Array, posterior_draws: list[PosteriorDraw]
    ) -> list[PosteriorDraw]:
        """What is true if item k, where it is play, follows its law, and if it follows another."""
        doubt, item = self.dataset.other_backlash, self.chosen.items[k]
        if not (isinstance(item.what, Hypothesis) and item.what.name == Backlash.name and doubt):
            return posterior_draws
        held = [replace(d, probability=d.probability * (1 - doubt)) for d in posterior_draws]
        other = extended(under_other_backlash_model(self.plain.model), _known(self.chosen.items))
        share = doubt * sum(d.probability for d in posterior_draws)
        at = replace(self.fitted, model=other)
        return held + self._draws(at, self.chosen, item, before, share)

    def _with(self, k: int, item: Item) -> tuple[Item, ...]:
        return (*self.chosen.items[:k], item, *self.chosen.items[k + 1 :])

    @cached_property
    def unnamed(self) -> float:
        """Mean squared length (m²) of what is in the set without a name, of each block what the
        fitted parameters cannot follow: the error of configurations left out of a fit to it."""
        total = 0.0
        for k, item in enumerate(self.chosen.items):
            if not item.known:
                signal = signal_of(self.dataset, self.chosen, k)
                alone = replace(beside(self.dataset, self.chosen, k), r=signal)
                error = left_out_residual(project(alone, self.chosen.noise.of_instrument()))
                squares, count = squared_lengths(alone, alone.masked(error))
                total += float(squares.sum() / count.sum())
        return total

    def _draws(
        self, base: Baseline, true: ModelSet, item: Item, before: Array, probability: float
    ) -> list[PosteriorDraw]:
        """If that set is true, fitted as `base`, under each of the noises."""
        measured, new = self._by_constant(base, _known(true.items), item)
        here, at = self._regressions(base)
        B = np.hstack([at.B, new])
        start = np.append(base.x, np.zeros(measured.shape[1]))
        size = self.observed.size

        def lengths(rows: Array) -> Array:
            return rows.reshape(-1, size, *rows.shape[1:])[:, : min(size, 3)]

        out = []
        prior, after = self._prior(true), self._regressions(self.fitted)[1].prediction
        for x, spread in posteriors(self.dataset, base, here, self.noise, measured, prior):
            readings = at.prediction + B @ (x - start)
            errors = lengths(before - readings), lengths(after - readings)
            pose, share = self.observed.configuration, probability / len(self.noise)
            out.append(PosteriorDraw(*errors, lengths(B @ spread), pose, share))
        return out

    def _prior(self, true: ModelSet) -> dict[str, float]:
        """Prior deviations of the set's parameters: their typical sizes, times the scale that the
        readings prefer where the effect is larger than usual; a tie to the usual size would make
        what is true smaller than what was found."""
        out = {}
        for item, scale in zip(true.items, true.scales, strict=True):
            if isinstance(item.what, Hypothesis):
                size = self.dataset.sizes[item.what.key] * max(scale, 1.0)
                for p, s in zip(item.what.parameters, size, strict=True):
                    out[f"{item.what.where}.{p.key}"] = float(s)
        return out

    def _by_constant(self, base: Baseline, known: list[Item], item: Item) -> list[Array]:
        """Difference quotients (rows, k) in the item's constants that vary smoothly, of the
        measured readings and of the new ones, each by the step of the grid it was searched on:
        it is not known better than the data tell."""
        what = item.what
        assert isinstance(what, Hypothesis)
        sets = (self.dataset.base.observed, self.observed)
        columns = [np.zeros((observed.size * len(observed.lead), 0)) for observed in sets]
        for s, setting in enumerate(what.settings):
            if setting.kind == "change_time":
                continue
            grid = self.dataset.grids[what.key]
            step = float(grid.step[grid.nearest(item.settings), s])
            # At a bound, where the search may well end, the quotient is one-sided.
            near = item.settings[s] + NUDGE * step * np.array([1.0, -1.0])
            near = np.clip(near, setting.lower, setting.upper)
            ends = []
            for value in near:
                moved = item.settings.copy()
                moved[s] = value
                items = [replace(i, settings=moved) if i.same_as(item) else i for i in known]
                model = extended(self.plain.model, items)
                ends.append([model.predict(observed.table, base.x, observed) for observed in sets])
            apart = float(near[0] - near[1]) / step
            slopes = [(up - down) / apart for up, down in zip(*ends, strict=True)]
            columns = [np.column_stack(pair) for pair in zip(columns, slopes, strict=True)]
        return columns


def _known(items: tuple[Item, ...]) -> list[Item]:
    return [item for item in items if item.known]
