"""What might be missing from the model: every effect at every place, and its columns."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np
from scipy.special import logsumexp

from elastocal.cell_tables import EffectChoice
from elastocal.diagnosis.baseline import Baseline, from_centre, made_once, prior_deviations
from elastocal.diagnosis.diagnosis import FoundEffect, Untested
from elastocal.engine import climb
from elastocal.measurements import Measurements, by_rows, in_any_order
from elastocal.messages import listed, require
from elastocal.model.effects.base import (
    Arm,
    BaseMotion,
    DrivenEffect,
    Effect,
    Entry,
    JointMotion,
    LinkFrame,
    LinkLength,
    MarkerMotion,
    ParameterSpec,
    Setting,
    Stage,
    index,
    row_inputs,
)
from elastocal.model.effects.catalogue import CATALOGUE, set_constants
from elastocal.model.effects.geometry import (
    BY_ORDER,
    Backlash,
    GearSpectrum,
    Hysteresis,
    Jump,
    ThermalExpansion,
)
from elastocal.model.effects.smooth import JointCurve
from elastocal.model.effects.statics import JointCompliance
from elastocal.model.evaluate import ONCE, BatchFunction
from elastocal.model.manipulator import Model, no_number
from elastocal.model.observations import observe
from elastocal.units import Array, BoolArray, IntArray

# What each need of an effect asks the user to record.
RECORD = {
    "time": ("the table has no time column", "record time_s or time_min of every reading"),
    "approach": (
        "the table does not say from which side each joint came to rest",
        "record approach_1 … (+1 or -1), and visit some poses from both sides",
    ),
    "temperature": ("the table has no temperature column", "record temperature_C"),
    "load": (
        "no reading is loaded, and the model has no weights",
        # Not "give the links' masses": those of public files are wrong by half, and what they leave
        # looks like another spring.
        "measure some poses with and without a load",
    ),
    "station": (
        "the readings do not tell where the instrument stands: they are deflections, or lie around "
        "the origin of their frame",
        "state the tracker position ([tracker] position_m)",
    ),
    "torque": ("the table has no torque columns", "record torque_1_Nm … of every joint"),
}


# Scales of an effect's prior size, in typical sizes; one that nobody has stated is known to an
# order of magnitude at best.  A gear of 101 teeth for 100, or a tripod that was moved, is a hundred
# times as far off as is usual.
SCALES = np.array([0.3, 1.0, 3.0])
UNSIZED_SCALES = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
ANY_SCALES = np.array([0.3, 1.0, 3.0, 10.0, 30.0, 100.0])

EntryKey = tuple[str, tuple[str, ...]]


@dataclass(frozen=True)
class Hypothesis:
    """One effect at one place that the model does not have."""

    effect: Effect
    where: str
    parameters: tuple[ParameterSpec, ...]
    settings: tuple[Setting, ...]
    any_size: bool = False  # beyond what is typical

    known: ClassVar[bool] = True

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def stage(self) -> Stage:
        return self.effect.stage

    @property
    def label(self) -> str:
        return ":".join(self.key)

    @property
    def key(self) -> tuple[str, str]:
        return self.name, self.where

    @property
    def driven(self) -> bool:
        return isinstance(self.effect, DrivenEffect)

    @property
    def width(self) -> int:
        return len(self.parameters)

    @property
    def bounded(self) -> BoolArray:
        """Which parameters (k,) cannot be below nominal, as no compliance is below zero."""
        return np.array([p.lower == p.nominal for p in self.parameters], dtype=bool)

    @property
    def scales(self) -> Array:
        """Scales of the size prior: wider where no typical size is known."""
        if self.any_size:
            return ANY_SCALES
        return UNSIZED_SCALES if any(p.typical is None for p in self.parameters) else SCALES

    def starts(self, model: Model) -> tuple[dict[str, float], ...]:
        """Values from which its geometry is sought; none where that is not needed."""
        return self.effect.starts(self.where, model.chain, model.cell)

    def entry_key(self, model: Model) -> EntryKey:
        assert isinstance(self.effect, DrivenEffect)
        entry = self.effect.entry_at(self.where)
        return entry.name, self.effect.entered_at(self.where, model.chain)


def possible(
    model: Model, table: Measurements, without: Container[str] = (), together: bool = False
) -> tuple[list[Hypothesis], list[Untested]]:
    """Hypotheses that the table's columns can test, and the effects it cannot, with advice; those
    that are judged by themselves, or those that are judged `together` in a sum alone, but for the
    smooth ones, which have their own searches."""
    chain, cell = model.chain, model.cell
    active = {(p.effect, p.where) for p in model.parameters}
    unread = {f"marker:{n}" for n in set(table.marker_names).difference(table.markers_read)}
    hypotheses: list[Hypothesis] = []
    untested: list[Untested] = []
    for name, effect in CATALOGUE.items():
        asked = effect.may_be_missing(cell)
        if together:
            asked = effect.together and not (asked or corrects(effect))
        if name in without or not asked or (effect.unless and recorded(table, effect.unless)):
            continue
        places = [
            w for w in effect.places(chain, cell)
            if (name, w) not in active and effect.acts(w, chain, cell)
            and w not in unread
        ]  # fmt: skip
        settings = {w: effect.settings(w, chain, cell) for w in places}
        # Only a driven effect can be evaluated at many settings; others' stay as the model has
        # them.
        searched = isinstance(effect, DrivenEffect) and not effect.together
        kinds = {s.kind for each in settings.values() for s in each} if searched else set()
        needed = [*effect.needed(cell), *["time"] * bool(kinds & {"change_time", "time_constant"})]
        if kinds == {"change_time"} and cell.model.clock == "rows":
            needed = [need for need in needed if need != "time"]
        if lacking := [need for need in needed if not recorded(table, need)]:
            reason, advice = RECORD[lacking[0]]
            untested += [Untested(name, w, reason, advice) for w in places]
            continue
        for where, held in settings.items():
            given = cell.model.nominal.settings.get(where, {})
            unset = [s.key for s in held if s.default is None and s.key not in given]
            if unset and not searched:
                reason = (
                    f"{unset[0]} is not known, and only settings of a driven effect are searched"
                )
                advice = f"state {unset[0]} in [model.nominal.settings.{where}]"
                untested.append(Untested(name, where, reason, advice))
            elif parameters := effect.parameters(where, chain, cell):
                hypotheses.append(Hypothesis(effect, where, parameters, held if searched else ()))
    return hypotheses, untested


def corrects(effect: Effect) -> bool:
    """Whether it may stand for any cause: what has no name, and curves and lines of a gear."""
    return effect.nameless or isinstance(effect, JointCurve | GearSpectrum)


def recorded(table: Measurements, need: str) -> bool:
    """Whether the table says what an effect needs, with more than one value of it; of the station,
    which no cell states, whether it may be the origin."""
    if need == "load":
        return bool(np.any(table.force != 0))
    if need == "station":
        if table.position is None:
            return False
        # Who stands nearer to the middle of the points than the farthest of these stands where the
        # arm reaches.
        points = table.position[:, :2]
        middle = points.mean(axis=0)
        return bool(np.linalg.norm(middle) >= np.linalg.norm(points - middle, axis=1).max())
    values = getattr(table, need)
    return values is not None and bool(np.any(values != values[:1]))


# Effects of the last move that take it from the order of the visits.
BY_LAST_MOVE = tuple(
    name for name, effect in CATALOGUE.items()
    if effect.family == "move" and "approach" not in effect.needs
)  # fmt: skip
OUT_OF_ORDER = (
    ". What goes with the last move was left out; give the joints of the pose before each as "
    "before_1_deg …, or the table as it was measured"
)

# Key of [model], its value, the column that allows it, and the effect that it is about.
CHOICES = (
    ("thermal_driver", "temperature", "temperature", ThermalExpansion.name),
    ("play_side", "load_and_approach", "approach", Backlash.name),
)


def with_recorded_drivers(model: Model, table: Measurements) -> Model:
    """The model with effects driven by the best that the table records, but for those that the cell
    has active: growth follows a measured temperature rather than a warm-up curve, and play rests
    where the last motion left it where that is known.  Where there are no times, what changes once
    does so between rows, if the poses are in any order."""
    active = {p.effect for p in model.parameters}
    keys = {
        key: value
        for key, value, column, effect in CHOICES
        if recorded(table, column) and effect not in active
    }
    if table.time is None and in_any_order(table):
        keys["clock"] = "rows"
    elif table.time is not None and model.cell.model.clock == "rows":
        by_rows = listed(sorted(name for name in active if isinstance(CATALOGUE[name], Jump)))
        told = (
            f"{model.cell.source}: key model.clock: {by_rows} is by rows of a table without times"
        )
        require(not by_rows, f"{told}, which this one has; take it out, or diagnose that table")
        keys["clock"] = "column"
    if "clock" in keys:  # which effects that are active may read
        return model.specified(replace(model.cell.model, **keys))  # type: ignore[arg-type]
    return model.stating(**keys) if keys else model


def model_keys(model: Model, found: tuple[FoundEffect, ...]) -> dict[str, str]:
    names, spec = {f.effect for f in found}, model.cell.model
    used = [(key, value) for key, value, _, effect in CHOICES if effect in names]
    keys = {key: value for key, value in used if getattr(spec, key) == value}
    if spec.approach == BY_ORDER and names & {Backlash.name, Hysteresis.name}:
        keys |= {"approach": BY_ORDER}
    changes = any(s.kind == "change_time" for n in names for s in CATALOGUE[n].constants)
    return keys | {"clock": spec.clock} if changes and spec.clock != "column" else keys


Moments = tuple[Array, Array]  # at which something may have changed, and their log prior
CHANGE_TIMES = 120  # at most; more moments are refined after the search
TIME_CONSTANTS = 8
HIGHEST_ORDER, LOWEST_ORDER = 600.0, 2.5
# Step of the orders in units of 1/range(q): half a step off, a ripple keeps 0.95 of its size.
ORDER_STEP = 1.5
RANGE_VALUES = 25
MOST_POINTS = 20_000  # of several settings together
KNOWN_SHARE = 0.5  # of the prior, on orders the cell names


@dataclass(frozen=True)
class SettingsGrid:
    """Values (G, settings) to try, and the log prior of each, which sum to one."""

    values: Array
    log_prior: Array
    step: Array

    def nearest(self, settings: Array) -> int:
        """The point that stands for `settings` (settings,), which were refined from it."""
        return int(np.abs(self.values - settings).sum(axis=1).argmin())


NO_SETTINGS = SettingsGrid(np.zeros((1, 0)), np.zeros(1), np.zeros((1, 0)))


def grid_of(hypothesis: Hypothesis, visits: Measurements, moments: Moments) -> SettingsGrid:
    """Grid of a hypothesis' settings for these visits; one empty point where it has none.  Of
    several settings, which are independent, it holds every combination.  Where those are more than
    MOST_POINTS, of each setting every k-th value is tried, and its step is k times as long."""
    axes = [_axis(setting, hypothesis.where, visits, moments) for setting in hypothesis.settings]
    if not axes:
        return NO_SETTINGS
    count = [len(axis.values) for axis in axes]
    k = math.ceil((math.prod(count) / MOST_POINTS) ** (1 / len(axes)))
    chosen = k * np.indices([-(-n // k) for n in count]).reshape(len(axes), -1)
    picked = list(zip(axes, chosen, strict=True))
    log_prior = np.sum([axis.log_prior[at] for axis, at in picked], axis=0)
    return SettingsGrid(
        np.concatenate([axis.values[at] for axis, at in picked], axis=1),
        log_prior - logsumexp(log_prior) if k > 1 else log_prior,
        np.concatenate([axis.step[at] * k for axis, at in picked], axis=1),
    )


def _axis(setting: Setting, where: str, visits: Measurements, moments: Moments) -> SettingsGrid:
    if setting.kind == "order":
        return _orders(setting, where, visits)
    prior = None  # of the moments alone; of all else any value is as probable
    if setting.kind == "range":
        values = np.linspace(setting.lower, setting.upper, RANGE_VALUES)
    elif setting.kind == "change_time":
        values, prior = moments
        if len(values) > CHANGE_TIMES:  # as many between any two by their prior
            sum_to = np.cumsum(np.exp(prior))
            at = np.linspace(sum_to[0], sum_to[-1], CHANGE_TIMES)
            k = np.unique(np.interp(at, sum_to, np.arange(len(values))).round().astype(int))
            values, prior = values[k], prior[k] - logsumexp(prior[k])
    else:
        span = float(np.ptp(times_of(visits)))
        low, high = max(span / 20, setting.lower), min(3 * span, setting.upper)
        values = np.geomspace(min(low, high), high, TIME_CONSTANTS)
    step = np.gradient(values) if len(values) > 1 else np.ones(1)
    alike = np.full(len(values), -np.log(len(values)))
    return SettingsGrid(values[:, None], alike if prior is None else prior, step[:, None])


def times_of(visits: Measurements) -> Array:
    return by_rows(visits) if visits.time is None else visits.time


def moments_of_change(time: Array, visit: IntArray) -> Moments:
    """Every moment (n,) between two visits, three at least on either side (a frame that jumps
    explains whatever two say of one marker), and the log of its prior: half alike for all, half by
    how long there was for a change, as between sessions.  By the `time` (readings,) and the `visit`
    of each: none is cut in two, unless others were made meanwhile."""
    order = np.lexsort((time, visit))
    t, last = time[order], np.flatnonzero(np.diff(visit[order], append=-1))
    begun, ended = t[np.append(0, last[:-1] + 1)], t[last]
    order = np.argsort(begun, kind="stable")
    low, high, ended = begun[order][2:-3], begun[order][3:-2], ended[order][2:-3]
    moments, k = np.unique((np.where(ended < high, ended, low) + high) / 2, return_index=True)
    if not len(moments):
        return np.array([begun.mean()]), np.zeros(1)
    share = (high - low)[k] / max((high - low)[k].sum(), 1e-300)
    return moments, np.log((1 / len(moments) + share) / 2)


def _orders(setting: Setting, where: str, visits: Measurements) -> SettingsGrid:
    """Orders of a joint's angle; at another place than a joint, of the one that moves most."""
    moved = np.ptp(visits.q, axis=0)
    spread = max(float(moved[index(where)] if where.startswith("joint") else moved.max()), 1e-3)
    step = ORDER_STEP / spread
    values = np.arange(LOWEST_ORDER, HIGHEST_ORDER, step)
    known = [] if setting.default is None else [setting.default]
    share = KNOWN_SHARE if known else 0.0
    prior = np.append(np.full(len(known), share), np.full(len(values), (1 - share) / len(values)))
    values = np.append(known, values)[:, None]
    return SettingsGrid(values, np.log(prior), np.full((len(prior), 1), step))


# Columns of effects whose other parameters say nothing while the first is zero.
#
# The geometry of a spring has no derivative at stiffness zero.  So the stiffness is estimated for
# each start that the effect proposes, the best start is kept, and the geometry's columns are those
# at that stiffness.  An effect that knows the torque about its joint, its profile, is tried from
# hundreds of them by a product of matrices each: the column is the joint's motion times the profile
# and the compliance.  The evidence is then that of the mean over all starts, as with settings.

KEPT_STARTS, AT_ONCE = 12, 50
ALIKE = 0.99  # correlation of what two starts leave beside the fitted parameters
MOST_STEPS, ENOUGH = 40, 1e-8  # of the refinement, and of χ²
STEP = 1e-6  # by which it differentiates, in widths of the starts
SAME = 0.05  # of χ²: a difference that is none

Start = Mapping[str, float]


class StartSearch:
    """The starts of one hypothesis against the residual of the fitted arm, `columns` about it.

    Equations are those of the readings that were measured over the noise, by which `whitening`
    (N, size, size) divides, and one for the prior of each fitted parameter.  Of the effect's
    parameters the first is the amplitude that the others have no columns without."""

    def __init__(self, columns: Columns, h: Hypothesis) -> None:
        self.h, self.at = h, columns
        base, model = columns.base, columns.base.model
        geometry, self.nominal = h.parameters[1:], h.parameters[0].nominal
        starts: tuple[dict[str, float], ...] = h.starts(model) or ({},)
        self.starts = [{p.key: p.nominal for p in geometry} | start for start in starts]
        fitted, width = [columns.full.names.index(n) for n in model.names], prior_deviations(base)
        # What is only planned has no residual yet that a spring could answer for.
        self.whitening = np.linalg.inv(np.linalg.cholesky(base.covariance[: base.n_measured]))
        B = base.observed.apply(columns.rows[:, :, fitted]) * width
        r = base.residual.reshape(*B.shape[:2], 1) + B @ (from_centre(base) / width)[:, None]
        X, r = (np.vstack([self._white(B), np.eye(len(width))]), self._white(r)[:, 0])
        self.dof, r = max(len(r) - 1, 1), np.append(r, np.zeros(len(width)))
        U, s, _ = np.linalg.svd(X, full_matrices=False)
        self._span: Array = U[:, s > 1e-9 * s.max(initial=0.0)]
        self._unexplained = r - self._span @ (self._span.T @ r)

    def _white(self, columns: Array) -> Array:
        """Columns (N, size, k) of the observations over the noise (equations, k)."""
        measured = self.whitening @ columns[: len(self.whitening)]
        return np.asarray(measured.reshape(-1, columns.shape[2]))

    def tangents(self) -> Iterator[tuple[Array, Array]]:
        """About the best starts, the best first, at the amplitude that the residual asks for: the
        effect's parameters (k,) and their columns (n_rows, size, k)."""
        for start in self.screened[0]:
            column = self._columns([start])
            values = np.array([self.nominal + self._fits(column)[1][0], *start.values()])
            C = self._of_model(values, len(values))
            C[:, :, :1] = column
            yield values, C

    def _of_model(self, values: Array, k: int) -> Array:
        """The first k of the columns (n_rows, size, k) at the values, by the whole model."""
        full, own, table = self.at.full, self.at.places[self.h.key], self.at.base.observed.table
        x, observed = self.at.x.copy(), observe(table, full.observe)
        x[own] = values
        B = full.regressor(table, x, own.start + np.arange(k), observed).B
        return np.asarray(B.reshape(len(table), observed.size, k))

    @cached_property
    def screened(self) -> tuple[list[Start], float]:
        """The best starts, the first refined, and the log of the mean likelihood over the best."""
        starts = self.starts
        blocks = [slice(k, k + AT_ONCE) for k in range(0, len(starts), AT_ONCE)]
        each = [self._left(starts[block]) for block in blocks]
        left = np.concatenate([one for one, _ in each])
        beside = np.concatenate([C for _, C in each], axis=1)
        variance = max(float(left.min()), 1e-300) / self.dof
        share = float(np.log(np.exp((left.min() - left) / (2 * variance)).mean()))
        # Starts that say the same stand in their own order, whatever the rounding.
        order = np.argsort(np.round((left - left.min()) / (SAME * variance)), kind="stable")
        kept: list[int] = []
        for k in order:
            if len(kept) == KEPT_STARTS:
                break
            if np.abs(beside[:, kept].T @ beside[:, k]).max(initial=0.0) < ALIKE:
                kept.append(int(k))
        best = self._refined(starts[kept[0]], np.sqrt(variance))
        return [best, *(starts[k] for k in kept[1:])], share

    def _refined(self, best: Start, noise: float) -> Start:
        """The start near `best` that leaves the least: least squares with the amplitude solved for
        (variable projection; Golub and Pereyra 1973).  Where the residual, over `noise`, does not
        ask for another value, a value stays: each is tied to that of `best` by a spread of all."""
        if self._factor is None:
            return best  # each step would take an evaluation of the whole model
        keys = list(best)
        width = np.array([np.std([start[key] for start in self.starts]) for key in keys])
        x0 = np.array([best[key] for key in keys])

        def start_of(values: Array) -> dict[str, float]:
            return dict(zip(keys, map(float, x0 + width * values), strict=True))

        def objective(values: Array) -> tuple[float, Array, Array]:
            tried = values + np.vstack([np.zeros(len(keys)), STEP * np.eye(len(keys))])
            left, C = self._left([start_of(each) for each in tried])
            own = C * (left < self._unexplained @ self._unexplained)  # amplitudes that it can have
            e = self._unexplained[:, None] - own * (self._unexplained @ own)
            e = np.vstack([e / noise, tried.T])
            J = (e[:, 1:] - e[:, :1]) / STEP
            return float(e[:, 0] @ e[:, 0]), 2 * J.T @ e[:, 0], 2 * J.T @ J

        far = np.full(len(keys), np.inf)
        return start_of(climb(objective, np.zeros(len(keys)), -far, far, ENOUGH, MOST_STEPS)[0])

    @cached_property
    def _factor(self) -> Array | None:
        """(n_rows, size): what a profile is to be multiplied with for the amplitude's column; None
        where the effect knows no profiles.  The compliance is one, or one at each level."""
        where, at, base = self.h.where, self.at, self.at.base
        motion, own = at.places.get((JointMotion.name, where)), at.places[self.h.key]
        table, names = base.observed.table, list(self.starts[0])
        here = dict(zip(names, at.x[own][1:].tolist(), strict=True))
        profiles = self.h.effect.profiles(where, [here], table.q)
        if motion is None or profiles is None:
            return None
        E, profile = at.rows[:, :, motion][:, :, 0], profiles[:, 0]
        levels = np.array(base.model.cell.model.compliance_levels.get(where, (0.0,)))
        level = np.abs(table.q[:, [index(where)]] - levels).argmin(axis=1)
        shown = np.bincount(level, (at.rows[:, :, own.start] * E).sum(axis=1) * profile)
        most = np.bincount(level, (E**2).sum(axis=1) * profile**2)
        return np.asarray(E * (shown / np.maximum(most, 1e-300))[level, None])

    def _columns(self, starts: Sequence[Start]) -> Array:
        """The amplitude's (n_rows, size, starts) about each start."""
        if self._factor is not None:
            q = self.at.base.observed.table.q
            profiles = self.h.effect.profiles(self.h.where, starts, q)
            assert profiles is not None
            return np.asarray(self._factor[:, :, None] * profiles[:, None, :])
        each = (np.array([self.nominal, *start.values()]) for start in starts)
        return np.concatenate([self._of_model(values, 1) for values in each], axis=2)

    def _left(self, starts: Sequence[Start]) -> tuple[Array, Array]:
        """What is left of the residual's sum of squares (starts,), all of it where the amplitude
        is one that the effect cannot have, and the unit columns (rows, starts)."""
        left, amplitudes, C = self._fits(self._columns(starts))
        name = f"{self.h.where}.{self.h.parameters[0].key}"
        chain, cell = self.at.base.model.chain, self.at.base.model.cell
        for k, amplitude in enumerate(amplitudes):
            if self.h.effect.unphysical({name: float(amplitude)}, chain, cell):
                left[k] = self._unexplained @ self._unexplained
        return left, C

    def _fits(self, columns: Array) -> tuple[Array, Array, Array]:
        """Of each of the columns (n_rows, size, k) by itself what it leaves of the residual's sum
        of squares (k,), its amplitude (k,), and itself of unit length beside the span (rows, k)."""
        C = self._white(self.at.base.observed.apply(columns))
        C = np.vstack([C, np.zeros((len(self._span) - len(C), C.shape[1]))])
        C -= self._span @ (self._span.T @ C)
        size = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
        C /= size
        explained = C.T @ self._unexplained
        return self._unexplained @ self._unexplained - explained**2, explained / size, C


KEPT = 20_000_000  # numbers of regressor directions that are kept from scan to scan
ENTRIES: tuple[Entry, ...] = (
    JointMotion(), LinkLength(), LinkFrame(), BaseMotion(), MarkerMotion()
)  # fmt: skip


@dataclass(frozen=True)
class Columns:
    """B of the model, of direct hypotheses and of the chain's entries, row by row of the table.
    `rows` (n_rows, size, K) at the fitted values, raw; `places` says which columns of it belong to
    an effect (or entry) at a place.  `full` is the model with all of them, at x (K,); `shares` are
    of effects that were looked for from many starts the logarithms of their mean likelihood over
    all of these relative to that at the best one, which is in x."""

    base: Baseline
    rows: Array
    places: dict[tuple[str, str], slice]
    full: Model
    x: Array
    shares: dict[tuple[str, str], float]
    # What was packed and evaluated of them, whatever hypotheses and noise stand beside them: of
    # entries and hypotheses, of driven hypotheses, and at settings, KEPT numbers of these.
    packed: dict[EntryKey | tuple[str, str], Array] = field(init=False, default_factory=dict)
    regressors: dict[tuple[str, str], RegressorDirection] = field(init=False, default_factory=dict)
    directions: dict[tuple[str, str, bytes], Array] = field(init=False, default_factory=dict)

    def of(self, hypothesis: Hypothesis) -> Array:
        """Columns (n_rows, size, k) of a hypothesis that is not driven."""
        return self.rows[:, :, self.places[hypothesis.key]]

    def torques(self) -> Array:
        """The load's torque τ (n_rows, joints) on every joint, zero where nothing depends on it.
        δq = k τ, so ∂(reading)/∂k = ∂(reading)/∂q · τ."""
        n = self.base.model.chain.n_joints
        tau = np.zeros((len(self.rows), n))
        for i in range(n):
            span = self.places.get((JointCompliance.name, f"joint{i + 1}"))
            if span is None:
                continue
            by_k = self.rows[:, :, span].sum(axis=2)
            by_q = self.rows[:, :, self.places["joint_motion", f"joint{i + 1}"]][:, :, 0]
            squared = (by_q**2).sum(axis=1)
            along = (by_k * by_q).sum(axis=1)
            tau[:, i] = np.divide(along, squared, out=np.zeros(len(along)), where=squared > 1e-12)
        return tau

    def entry(self, key: EntryKey) -> Array:
        """∂(reading)/∂u (n_rows, size, d) of the entry's motions at its places, stacked."""
        name, places = key
        return np.concatenate([self.rows[:, :, self.places[name, w]] for w in places], axis=2)


def compute_columns(
    base: Baseline, hypotheses: list[Hypothesis], found: dict[str, float] | None = None,
    entries: Sequence[Entry] = ENTRIES,
) -> Columns:  # fmt: skip
    """One evaluation of B of the fitted arm with every hypothesis and entry at zero; without
    entries the hypotheses' columns alone, others are zero.

    `found` are parameters of hypotheses that are not at zero, by name.

    Deflections enter by eq. (3), the load's torques at the undeflected pose: the columns differ
    from those of the equilibrium by the ratio of deflection to lever arm, a part in a thousand."""
    table = base.observed.table
    chain, cell = base.model.chain, base.model.cell
    direct = [h for h in hypotheses if not h.driven]
    spec = replace(
        cell.model,
        effects=(*cell.model.effects, *(EffectChoice(*h.key) for h in direct)),
        observe="position" if cell.model.observe == "deflection" else cell.model.observe,
        deflection_model="linear",
    )
    whole = replace(cell, model=spec)
    extra = [(e, w) for e in entries for w in e.places(chain, cell)]
    key = "columns", spec.effects, len(extra)
    full = made_once(base.model, key, lambda: Model.assembled(chain, whole, extra, ONCE))
    at = dict(zip(base.model.names, base.x, strict=True)) | (found or {})
    x = np.array([at.get(p.name, p.nominal) for p in full.parameters])
    observed, keys = observe(table, full.observe), {h.key for h in direct}
    asked = np.array([bool(entries) or (p.effect, p.where) in keys for p in full.parameters])
    B = np.zeros((len(table), observed.size, len(x)))
    shown = full.regressor(table, x, np.flatnonzero(asked), observed).B
    B[:, :, asked] = shown.reshape(len(table), observed.size, -1)
    spans: dict[tuple[str, str], list[int]] = {}
    for k, p in enumerate(full.parameters):
        spans.setdefault((p.effect, p.where), []).append(k)
    places = {key: slice(v[0], v[-1] + 1) for key, v in spans.items()}
    columns = Columns(base, B, places, full, x, {})
    for h in direct:
        own = places[h.key]
        shown = np.abs(B[:, :, own]).max(axis=(0, 1)) > 0
        if not shown.all() and shown.sum() == 1:
            search = StartSearch(columns, h)
            columns.shares[h.key] = search.screened[1]
            x[own], B[:, :, own] = next(search.tangents())
    return columns


class RegressorDirection:
    """D(row, settings) = ∂u/∂p (d, k) of a driven hypothesis, from its CasADi expression.  The base
    of the `arm` stands as its cell says; so do the effect's settings where none is searched."""

    def __init__(self, hypothesis: Hypothesis, arm: Arm) -> None:
        effect, where = hypothesis.effect, hypothesis.where
        self._name = f"{effect.name} at {where}"
        assert isinstance(effect, DrivenEffect)
        fitted = {s.key: ca.SX.sym(s.key) for s in hypothesis.parameters}
        searched = {s.key: ca.SX.sym(s.key) for s in hypothesis.settings}
        held = {} if searched else set_constants(effect, where, arm.chain, arm.cell)
        u = effect.motion(arm, where, {**held, **fitted, **searched})
        D = ca.jacobian(u, ca.vertcat(*fitted.values()))
        constants = ca.vertcat(ca.SX.zeros(0, 1), *searched.values())
        # Most directions ask for one or two numbers of a row: evaluated at thousands of settings,
        # all that the arm declared would be copied as many times.
        felt = {name: x for name, x in arm.inputs.items() if ca.depends_on(D, x)}
        declared = ca.vertcat(ca.SX.zeros(0, 1), *felt.values())
        used = [k for k in range(declared.numel()) if ca.depends_on(D, declared[k])]
        self._arm, self._felt, self._used = arm, tuple(felt), np.array(used, dtype=np.int64)
        asked = ca.vertcat(ca.SX.zeros(0, 1), *(declared[k] for k in used))
        self._compiled = BatchFunction([asked, constants], [D], ONCE)

    def asked(self, table: Measurements) -> Array:
        """What D depends on in each row of the table (n_rows, quantities)."""
        felt = row_inputs(self._arm, table, self._felt)
        return np.concatenate([np.zeros((len(table), 0)), *felt], axis=1)[:, self._used]

    def __call__(self, table: Measurements, settings: Array) -> Array:
        """D (n_rows, G, d, k) at each of the `settings` (G, number of settings)."""
        G, n = len(settings), len(table)
        D = self._compiled(np.repeat(self.asked(table), G, axis=0), np.tile(settings, (n, 1)))[0]
        if not np.isfinite(D.sum()):
            row = np.isfinite(D.reshape(n, -1)).all(axis=1).argmin()
            no_number(table, int(row), self._name)
        return np.asarray(D.reshape(n, G, *D.shape[1:]))
