"""How far the gap shrinks at poses that had no part in the fit, with its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from elastocal.diagnosis.diagnosis import FittedParameter, Gap
from elastocal.diagnosis.diagnosis_data import DiagnosisData
from elastocal.diagnosis.effect_search import SelectedEffects
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import (
    Item,
    ModelSet,
    beside,
    fit_extended,
    fit_set,
    signal_of,
    spans_of,
    with_items,
)
from elastocal.diagnosis.noise_floor import NoisyData, Projection, covariance, project
from elastocal.diagnosis.stated_floor import (
    left_out_residual,
    left_out_together,
    squared_lengths,
    supported_floor,
)
from elastocal.identification.scrutiny import BudgetStep, resampled_rms, stage_of
from elastocal.model.effects.loads import PayloadError
from elastocal.model.effects.placements import BaseFrame
from elastocal.units import Array, BoolArray, IntArray


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
# A configuration c that is left out of a fit is a new pose for it.  The error of a model there is
# its prediction less the true arm's, without noise:
#
#     before   e_c = X_c β̂₋c − W_c θ*,    after   e_c = W_c (θ̂ − θ*),
#
# each fitted by the instrument's noise, as a calibration would that knows nothing of the joints'
# scatter.  θ* is drawn from the posterior given all data, its spread about what is most probable at
# c as large as without c.  W are the columns of what is held to be true: at times a rival or
# another constant, as probable as each is, which charges the interval for the selection.
# The remaining fraction is the ratio of the rms errors over a set of NEW_POSES, drawn anew for
# every θ* from a population that is itself known from the campaign's poses only (Bayesian
# bootstrap, Rubin 1981).

BOOTSTRAP_DRAWS = 400
NEW_POSES = 100  # in the set that the intervals are for
WORTH_A_DRAW = 0.01  # probability from which a rival may be drawn as true


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
class Truth:
    """What may be true: the most probable readings (readings, components) without noise, which
    move by `spread` (readings, components, k) times standard normal numbers."""

    readings: Array
    spread: Array
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
    predicted: tuple[Array, Array], truths: Sequence[Truth], pose: IntArray, unnamed: float,
    change: Change, rng: np.random.Generator,
) -> Shrinkage:  # fmt: skip
    """Reduction of the rms error from before to after, one of the truths being true.

    `predicted` (readings, components) before and after, at the configurations `pose` (readings,);
    `unnamed` (m²) the mean squared length of what is known to be there
    without a name: neither model has it.
    """
    weights = np.array([truth.probability for truth in truths])
    which = rng.choice(len(truths), BOOTSTRAP_DRAWS, p=weights / weights.sum())
    _, at, count = np.unique(pose, return_inverse=True, return_counts=True)
    parts = []
    for k in np.unique(which):
        truth, n = truths[k], int((which == k).sum())
        moved = truth.spread @ rng.normal(size=(truth.spread.shape[2], n))
        chosen = rng.multinomial(NEW_POSES, rng.dirichlet(np.ones(len(count)), n))
        before, after = (
            _mean_square(each - truth.readings, moved, at, chosen, count) + unnamed
            for each in predicted
        )
        times = round(NEW_POSES * change.visits)
        late = rng.binomial(times, change.share * rng.random(n)) / times
        after = after + late * change.square
        parts.append(1 - np.sqrt(after / np.maximum(before, 1e-300)))
    return Shrinkage.of(np.concatenate(parts))


def _mean_square(
    error: Array, moved: Array, at: IntArray, chosen: IntArray, count: IntArray
) -> Array:
    """Mean squared length (n,) per reading of errors (readings, components) less what the draws
    have `moved` (readings, components, n), in n sets of poses, each `chosen` (n, poses) times."""
    squares = ((error[:, :, None] - moved) ** 2).sum(axis=1)
    total = np.zeros((len(count), squares.shape[1]))
    np.add.at(total, at, squares)
    return np.asarray((chosen.T * total).sum(axis=0) / (chosen @ count))


@dataclass(frozen=True)
class Confirmation:
    """What the set says of its known items: parameters, and how far each lowers the error."""

    dataset: DiagnosisData
    chosen: ModelSet

    @classmethod
    def of(cls, found: SelectedEffects) -> Confirmation:
        """Without the load point's tolerance: what is only uncertain of it is no error of the
        model."""
        dataset, data = found.dataset, found.dataset.data
        own = np.array([name != PayloadError.name for name in dataset.fitted])
        data = replace(data, X=data.X[:, :, own], precision=data.precision[own])
        return cls(replace(dataset, data=data), found.chosen)

    @cached_property
    def _refitted(self) -> dict[str, float]:
        """Values by name of the exact model with all items that have a name, fitted to the
        readings: where a geometry is sought, its columns are no line to it."""
        known = [self.chosen.items[n] for n in self._known]
        fitted = fit_extended(self.dataset, self.chosen, known)
        return dict(zip(fitted.model.names, fitted.x.tolist(), strict=True))

    @cached_property
    def _whole(self) -> tuple[Projection, Projection]:
        """The data with all items under all the noise, and under the instrument's alone."""
        chosen = self.chosen
        data = with_items(self.dataset, chosen.items, _wide(chosen.scales))
        return project(data, chosen.noise), project(data, chosen.noise.of_instrument())

    def parameters(self, k: int) -> tuple[FittedParameter, ...]:
        """The values of item k's parameters: of the exact fit by the instrument's noise, and one
        step from there by all the noise that was found."""
        items, what, (at, plain) = self.chosen.items, self.chosen.items[k].what, self._whole
        assert isinstance(what, Hypothesis)
        span, size = self._span(items, k), self.dataset.sizes[what.key]
        step = (at.beta - plain.beta)[span] * size
        std = np.linalg.norm(at.beta_deviation[:, span], axis=0) * size
        named = [(f"{what.where}.{p.key}", p.unit) for p in what.parameters]
        return tuple(
            FittedParameter(name, self._refitted[name] + float(more), unit, float(s))
            for (name, unit), more, s in zip(named, step, std, strict=True)
        )

    def reduction(
        self, k: int, rivals: Sequence[tuple[Item, float]], stays: float, rng: np.random.Generator
    ) -> Shrinkage:
        """By how much the error falls with item k, if what is true is that item at any plausible
        setting or one of its `rivals`, of which itself is the first, with their probabilities.

        `stays` (m²) is what is there without a name.
        """
        dataset, chosen, scales = self.dataset, self.chosen, self.chosen.scales
        predicted = self._before([n for n in self._known if n != k]), self._after
        truths = [
            self._truth(self._instead(k, item), scales, rivals[0][1] * share)
            for item, share in other_settings(dataset, chosen, k)
        ]
        for item, share in rivals[1:]:
            if share >= WORTH_A_DRAW and item.known:
                rival = fit_set(dataset, self._instead(k, item), chosen.noise)
                truths.append(self._truth(rival.items, rival.scales, share))
        pose, change = np.nonzero(self._used)[0], between_visits(dataset, chosen, k)
        return shrinkage(predicted, truths, pose, stays, change, rng)

    @property
    def _known(self) -> list[int]:
        return [n for n, item in enumerate(self.chosen.items) if item.known]

    def _instead(self, k: int, item: Item) -> tuple[Item, ...]:
        return (*self.chosen.items[:k], item, *self.chosen.items[k + 1 :])

    def _span(self, items: Sequence[Item], k: int) -> slice:
        """Where item k's coefficients stand behind the fitted parameters'."""
        widths = [item.width for item in items]
        return spans_of(widths, self.dataset.data.X.shape[2] + sum(widths))[k]

    @cached_property
    def _used(self) -> BoolArray:
        """Readings (C, M) that count."""
        blocks = self.dataset.blocks
        left_out = self.chosen.data.left_out.reshape(*blocks.member.shape, blocks.size)
        return np.asarray(~left_out[:, :, 0])

    def _lengths(self, packed: Array) -> Array:
        """Packed (C, m, …) → what counts of positions or distances (readings, components, …)."""
        size = self.dataset.blocks.size
        rows = packed.reshape(*self._used.shape, size, *packed.shape[2:])[self._used]
        return np.asarray(rows[:, : min(size, 3)])

    def _before(self, members: Sequence[int]) -> Array:
        """What the model with these items alone predicts of each configuration that is left out."""
        data, at = self._fit(members)
        together = left_out_together(self.dataset, self.chosen)
        return self._lengths(data.r - left_out_residual(at, together))

    @cached_property
    def _after(self) -> Array:
        """What the model with all items that have a name predicts."""
        data, at = self._fit(self._known)
        return self._lengths(data.X @ at.beta)

    def _fit(self, members: Sequence[int]) -> tuple[NoisyData, Projection]:
        chosen = self.chosen
        items = tuple(chosen.items[n] for n in members)
        data = with_items(self.dataset, items, _wide([chosen.scales[n] for n in members]))
        return data, project(data, chosen.noise.of_instrument())

    def _truth(self, items: tuple[Item, ...], scales: Sequence[float], probability: float) -> Truth:
        """If that set is true."""
        data, noise = with_items(self.dataset, items, _wide(scales)), self.chosen.noise
        at = project(data, noise)
        # What has no name stays with both models, and is told by its size.
        own = np.ones(data.X.shape[2], dtype=bool)
        for n, other in enumerate(items):
            own[self._span(items, n)] = other.known
        W = self._lengths(data.X)[:, :, own]
        spread = W @ at.beta_deviation[:, own].T
        return Truth(W @ at.beta[own], spread * self._grown(at, spread), probability)

    def _grown(self, at: Projection, spread: Array) -> Array:
        """By how much (readings, 1, 1) more is uncertain of each configuration where it is left
        out of the fit: its readings less what they are predicted to be have covariance P_cc⁻¹."""
        all_ = self._of_readings(np.asarray(np.linalg.inv(at.P)))
        pose = np.nonzero(self._used)[0]
        own, left_out = (
            np.bincount(pose, each) for each in ((spread**2).sum(axis=(1, 2)), all_ - self._noise)
        )
        return np.asarray(np.sqrt(left_out / np.maximum(own, 1e-300))[pose, None, None])

    @cached_property
    def _noise(self) -> Array:
        return self._of_readings(covariance(self.chosen.data, self.chosen.noise))

    def _of_readings(self, variance: Array) -> Array:
        """Of packed covariances (C, m, m) the sum (readings,) over a reading's components."""
        return np.asarray(self._lengths(np.diagonal(variance, axis1=1, axis2=2)).sum(axis=1))

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


def _wide(scales: Sequence[float]) -> tuple[float, ...]:
    """Typical sizes, or larger where the readings prefer that: a tie to the usual size would make
    what is true smaller than what was found."""
    return tuple(max(scale, 1.0) for scale in scales)


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
