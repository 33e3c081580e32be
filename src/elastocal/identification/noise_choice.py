"""Which noise model the readings support, its variances and its weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse, special

from elastocal.engine import ENOUGH, LogPrior, Mixed, MixedFit, Pack, Parts, least_norm
from elastocal.identification.least_squares import Covariance, orthogonal, root_of
from elastocal.identification.noise_structure import (
    CONFIGURATION,
    EACH,
    EACH_HAS,
    JOINTS,
    LONGEST,
    PARTS,
    STRUCTURES,
    TIME,
    Deviation,
    Kind,
    NoiseModel,
    Readings,
    ranked_within,
    stated_deviations,
    visit_record,
)
from elastocal.identification.weighted_problem import (
    Weights,
    block_diagonal,
    inverse_factor,
    same_size,
    stated_by_observation,
    whitener,
)
from elastocal.measurements import numbered
from elastocal.messages import ElastocalError, InputError, InsufficientDataError, option, require
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations, polar_axes
from elastocal.units import Array, IntArray

TINY = 1e-100  # stands for the variance of perfect data: its square is still a number
LEAST_START = 1e-6  # a variance of a former fit that is smaller beside a new start is no start
FEWEST_TELLING = 10  # degrees of freedom of repeats, from which on they tell the noise

# Readings as rows.  Of R repeats the mean, times √R, holds all of Δx and of what they share; R − 1
# contrasts between them hold their own noise alone.  Rows so turned are as good as those read: the
# turn is orthogonal.


class Sets:
    """Readings as sets of repeats: `of` (N,) the set of a reading, `root` (S,) √R, and the rows
    B (S, size, p), e (S, size) of their means times that; `contrasts` (N − S, size) of `sets`."""

    def __init__(self, readings: Readings, B: Array, apart: Sequence[IntArray]) -> None:
        self.of = numbered(readings.configuration, readings.load, readings.marker, *apart)
        self.n = int(self.of.max(initial=-1)) + 1
        self.first = np.unique(self.of, return_index=True)[1]
        repeats = np.bincount(self.of, minlength=self.n)
        self.root, self.order = np.sqrt(repeats), np.argsort(self.of, kind="stable")
        self.starts = np.cumsum(repeats) - repeats
        self.B = self.mean(B) * self.root[:, None, None]
        self.e = self.mean(readings.e) * self.root[:, None]
        e, set_of = readings.e[self.order], self.of[self.order]
        before = np.cumsum(e, axis=0) - e
        before -= before[self.starts][set_of]
        j = (np.arange(len(e)) - self.starts[set_of])[:, None]
        self.contrasts = ((before - j * e) / np.sqrt(np.maximum(j * (j + 1), 1)))[j[:, 0] > 0]
        self.sets = set_of[j[:, 0] > 0]

    def mean(self, values: Array) -> Array:
        total = np.add.reduceat(values[self.order], self.starts)
        return np.asarray(total / (self.root**2).reshape(-1, *[1] * (values.ndim - 1)))


class NoisyReadings:
    """Readings under a kind of noise, where what drifts is `lasting` so long, as a mixed model.
    Variances θ: those of single readings, then one for each of the `deviations` that they share."""

    def __init__(self, readings: Readings, kind: Kind, lasting: float | None = None) -> None:
        self.readings, self.kind, self.lasting = readings, kind, lasting
        self.structure = STRUCTURES[kind.own].structure(readings)
        self.own = len(self.structure.names)
        apart = []
        if kind.by_visit:
            if readings.visits is None:
                raise InputError(
                    f"'{kind.name}' needs the visits of the arm, which these readings do not tell"
                )
            apart.append(readings.visits.visit[:, 0])
        if kind.own == "stated":  # repeats that are stated alike
            stated = self.structure.matrix.reshape(len(readings), -1)
            apart.append(np.unique(stated, axis=0, return_inverse=True)[1].ravel())
        found = kind.deviations(readings, lasting)
        waves = [d.waves for d in found if d.waves is not None]
        self.sets = Sets(readings, np.concatenate([readings.B, *waves], axis=2), apart)
        # Nothing but repeats tells a deviation of each set from the noise of single readings, and a
        # few of them may agree by chance.
        own = [d for d in found if d.part == CONFIGURATION]
        if CONFIGURATION in kind.parts and not own:
            raise InputError(
                f"{option('noise', kind.name)} needs repeats or several markers in a "
                "configuration; this table has one reading in each"
            )
        if len(self.sets.contrasts) * readings.size < FEWEST_TELLING:
            own = [d for d in own if len(np.unique(d.unit)) < self.sets.n] or own
        self.deviations = [d for d in found if d.part != CONFIGURATION or d in own]

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.structure.names, *(d.name for d in self.deviations))

    def model(self, prior: LogPrior | None = None) -> Mixed:
        """Packs of clusters of the sets: readings of a configuration that share anything are one.
        With a course in time its coefficients are columns of B, which readings of zero with the
        unknown variance hold.  Restricted likelihood is then that of the course taken for noise
        (Henderson 1975), and nothing as large as the table squared is formed."""
        sets, packs = self.sets, []
        root, index = root_of(sets.mean(self.structure.matrix)), self.structure.index[sets.first]
        scale, (size, p) = sets.root[:, None, None, None], sets.B.shape[1:]
        turned = [
            replace(d, unit=d.unit[sets.first], loading=d.loading[sets.first] * scale)
            for d in self.deviations
        ]
        label = numbered(self.readings.configuration[sets.first]) if turned else np.arange(sets.n)
        for members in same_size(label):
            C, M = members.shape
            parts = [_own_parts(index, root, members)]
            for k, d in enumerate(turned, self.own):
                parts.append(Parts(np.full((C, 1), k), d.packed(members)[:, None]))
            B, e = sets.B[members].reshape(C, M * size, p), sets.e[members].reshape(C, M * size)
            packs.append(Pack(B, e, tuple(parts), np.zeros(e.shape, dtype=bool)))
        if len(e := sets.contrasts):
            own = _own_parts(index, root, sets.sets[:, None])
            packs.append(Pack(np.zeros((*e.shape, 0)), e, (own,), np.zeros(e.shape, dtype=bool)))
        held = np.repeat(
            np.arange(self.own, len(self.names)),
            [0 if d.waves is None else d.waves.shape[2] for d in self.deviations],
        )[:, None]
        if k := len(held):
            own, none = Parts(held, np.ones((k, 1, 1, 1))), np.zeros((k, 1))
            B = np.eye(k, p, p - k)[:, None]
            packs.append(Pack(B, none, (own,), none.astype(bool)))
        return Mixed(tuple(packs), len(self.names), np.zeros(p), prior)

    def start(self, like: Fitted | None = None) -> Array:
        """Variances (K,) of `like` where it has them; else own ones from the residuals, and shared
        ones a tenth of these."""
        sets, size, e2 = self.sets, self.readings.size, (self.sets.e**2).mean(axis=1)
        # Variance of one reading that θ = 1 would give: 1, but for noise that is stated.
        unit = np.trace(self.structure.matrix.sum(axis=1), axis1=1, axis2=2)[sets.first] / size
        own = float(np.median(e2 / unit))
        share = 0.1 * float((self.readings.e**2).mean())
        shared = [share * size / d.mean_square(size) for d in self.deviations]
        theta = np.maximum(np.concatenate([np.full(self.own, own), shared]), TINY)
        former = {} if like is None else dict(zip(like.noisy.names, like.theta, strict=True))
        known = np.array([former.get(name, 0.0) for name in self.names])
        return np.where(known > LEAST_START * theta, known, theta)


def _own_parts(index: IntArray, root: Array, members: IntArray) -> Parts:
    (C, M), (L, size) = members.shape, root.shape[1:3]
    own = index[members]  # (C, M, L)
    place = ranked_within(own.reshape(C, -1)).reshape(C, M, L)
    numbers = int(place.max()) + 1
    mine = place == np.arange(numbers)[:, None, None, None]  # (k, C, M, L)
    of = np.where(mine, own, 0).max(axis=(2, 3)).T
    loading, at = np.zeros((C, numbers, M, size, M, size)), np.arange(M)
    loading[:, :, at, :, at, :] = np.einsum("kcml,cmlij->mckij", mine, root[members])
    return Parts(of, loading.reshape(C, numbers, M * size, M * size))


class Fitted(MixedFit):
    """A kind of noise fitted to readings: the variances of single readings are its `own`, those of
    deviations `common`, and what drifts is `lasting` a share of the campaign (None: nothing)."""

    def __init__(
        self, noisy: NoisyReadings, prior: LogPrior | None, start: Array, enough: float
    ) -> None:
        # What is shared may be none, but not the prior of what drifts.
        shared = [k for k, d in enumerate(noisy.deviations, noisy.own) if d.waves is None]
        super().__init__(noisy.model(prior), start, shared, enough)
        self.noisy, self.lasting = noisy, noisy.lasting
        self.own, self.common = np.split(self.theta, [noisy.own])

    @property
    def found(self) -> list[tuple[Deviation, float]]:
        each = zip(self.noisy.deviations, self.common.tolist(), strict=True)
        return [(d, v) for d, v in each if v > 0 or d.waves is not None]

    @property
    def told(self) -> bool:
        """Whether readings tell each of its own variances.  Those of one axis that the parameters
        can all meet say nothing of theirs: it could be none, and they would decide all."""
        own = self.noisy.own if self.model.prior is None else 0
        share = np.diag(self.expected.information)[:own] / (0.5 * self.expected.known[:own])
        return own < 2 or bool(share.min() * self.noisy.readings.e.size / own >= FEWEST)

    @property
    def kind(self) -> Kind:
        """The kind without what was not found, with which it is the same model."""
        return self.noisy.kind.having(*(d.part for d, _ in self.found))

    def estimate(self, T: Array) -> tuple[Array, Array, Array]:
        """T x (p,) of the parameters x without the coefficients of a course in time, which come
        last; its covariance by Kenward and Roger, and degrees of freedom."""
        rows = np.pad(T, ((0, 0), (0, len(self.state.x) - len(T))))
        return rows @ self.state.x, *self.expected.kenward_roger(self.covariance, rows)

    def of(self, readings: Readings) -> list[tuple[Deviation, float]]:
        known = {d.name: v for d, v in self.found}
        others = self.kind.deviations(readings, self.lasting, every=True)
        return [(d, known[d.name]) for d in others if d.name in known]


def fitted(
    readings: Readings, kind: Kind, like: Fitted | None = None, lasting: float | None = None,
    enough: float = ENOUGH,
) -> Fitted:  # fmt: skip
    """A model's fit; the search starts from the variances of `like` where it has the same.  What
    drifts is `lasting` so long, as in `like`, or as is the most likely."""
    if TIME not in kind.parts:
        lasting = None
    elif (record := readings.visits) is not None:
        if not record.lasting:
            raise InputError(
                "no drift can be recognised in these readings: the model itself has what changes "
                "with time, or successive poses are near each other; visit poses in random order"
            )
        lasting = lasting or (None if like is None else like.lasting)
        if lasting is None:
            tried = [fitted(readings, kind, like, each, enough) for each in record.lasting]
            return max(tried, key=lambda one: one.log_likelihood)
    noisy = NoisyReadings(readings, kind, lasting)
    if not kind.shrunk:
        return Fitted(noisy, None, noisy.start(like), enough)
    if TIME in kind.parts:
        raise InputError(f"'{kind.own}' has a prior, with which no drift can be estimated")
    prior, start = prior_of_groups(noisy), noisy.start(like)
    start[: noisy.own] = np.exp(prior.mean)
    return Fitted(noisy, prior, start, enough)


# Many variances from few readings each: shrink their logarithms towards one another.
#
# Empirical Bayes in the spirit of Smyth 2004 (Stat. Appl. Genet. Mol. Biol. 3, 3), with a lognormal
# prior that knows the direction: log θ_ca ~ N(μ_a, ω).  A sample variance s² on f degrees of
# freedom has log s² = log θ + ψ(f/2) − log(f/2) plus scatter of variance ψ'(f/2).

FEWEST = 2.0  # degrees of freedom of a group, at the median, below which there is nothing to shrink
NARROWEST = 1e-3  # variance of log θ: equal to within 3 %


def prior_of_groups(noisy: NoisyReadings) -> LogPrior:
    """Prior of the group variances from the scatter of a group's readings about their own mean,
    less a plain fit; InsufficientDataError where groups hold too few readings."""
    readings, K, group = noisy.readings, noisy.own, noisy.structure.index.ravel()
    B, e, size = readings.B.reshape(-1, readings.n_parameters), readings.e.ravel(), readings.size
    residual = e - B @ least_norm(B, e)
    count = np.bincount(group, minlength=K)
    mean = np.bincount(group, residual, K) / count
    squares = np.bincount(group, (residual - mean[group]) ** 2, K)
    f = np.maximum(count - 1.0, 0.5)
    if np.median(f) < FEWEST or 3 * size > K:
        raise InsufficientDataError(
            "the groups of a configuration and a direction hold too few readings for variances of "
            "their own; repeat readings, or choose another noise model"
        )
    s2 = squares / np.maximum(count - 1.0, 1.0)
    # A lucky group of (near) equal readings says little about its variance, not minus infinity.
    s2 = np.maximum(s2, max(1e-6 * float(np.median(s2)), TINY))
    z = (np.log(s2) - special.digamma(f / 2) + np.log(f / 2)).reshape(-1, size)
    noise = special.polygamma(1, f / 2).reshape(z.shape)
    mean = np.average(z, axis=0, weights=1 / noise)
    omega = ((z - mean) ** 2).sum() / (z.size - size) - noise.mean()
    return LogPrior(np.tile(mean, len(z)), np.eye(K) / max(float(omega), NARROWEST))


def own_noise(found: Fitted, readings: Readings) -> tuple[Array, Array]:
    """Covariance (N, size, size) of single readings, be they those fitted or others, and degrees of
    freedom (N, size) behind it.  A variance that no reading of the fit has is the mean of all."""
    names = found.noisy.structure.names
    structure = STRUCTURES[found.noisy.kind.own].structure(readings, names)
    place = {name: k for k, name in enumerate(names)}
    known = np.array([place.get(name, -1) for name in structure.names])
    W = np.diag(found.covariance)[: found.noisy.own]
    covariance = structure.covariance(np.where(known >= 0, found.own[known], found.own.mean()))
    W = np.where(known >= 0, W[known], W.max())
    parts = np.diagonal(structure.matrix, axis1=2, axis2=3)  # (N, L, size)
    variance = np.einsum("nl,nla->na", W[structure.index], parts**2)
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    return covariance, np.maximum(2 * diagonal**2 / np.maximum(variance, 1e-300), 2.0)


# Which noise model: what the readings allow is tried, and an information criterion decides.
#
#     criterion = −2ℓ + k_own · log(rows − p) + 2 · k_shared
#
# For the structure of single readings the price per variance is Schwarz's (BIC): one that is not
# clearly better only makes the judgement of faulty readings erratic; so for joints told apart.  For
# shared effects it is Akaike's (AIC): one that is left out wrongly makes intervals too narrow.

ROUGHLY = 1e-2  # of −2ℓ: what decides between models need not be finer
# Readings, and those per parameter, that the choice is made from: so many tell a variance to 3 %.
CHOSEN_FROM, PER_PARAMETER = 2000, 20
# Scatter of the joints and a drift are added where a test finds a trace of them: a part that a test
# at this level does not find changes no interval.
TRACE = 0.05
MOST_TOGETHER = 300  # rows of a configuration, whose covariance is formed
FEWEST_VISITS, SEVERAL = 8, 2
ONLY = "the only model that the table supports"


@dataclass(frozen=True)
class Trial:
    kind: str
    variances: int
    criterion: float


@dataclass(frozen=True)
class NoiseTest:
    """A further part of the noise that was looked for, JOINTS or TIME, and the p-value of its being
    none beside the model that was chosen without it."""

    part: str
    p: float


@dataclass(frozen=True)
class NoiseFit:
    """The noise model that was chosen, the estimate under it, and what else was tried.  `fit` is in
    orthonormal parameters, B T with T (p, p), which shifts all its log-likelihoods by one constant.
    Neither the units of the parameters nor their correlation then cost digits, and columns that
    depend on each other are found out."""

    kind: str
    fit: Fitted
    T: Array
    trials: tuple[Trial, ...] = ()
    reason: str = "as asked for"
    tests: tuple[NoiseTest, ...] = ()
    to_longest: float = 0.0  # log-likelihood that the longest time tried is short of the best
    over_times: Covariance | None = None  # `covariance` as `not_knowing_times` makes it

    @cached_property
    def _estimate(self) -> tuple[Array, Array, Array]:
        return self.fit.estimate(self.T)

    @property
    def x(self) -> Array:
        """The generalised least-squares estimate (p,) of the readings' Δx."""
        return self._estimate[0]

    @property
    def covariance(self) -> Covariance:
        if self.over_times is not None:
            return self.over_times
        text = "weights estimated by restricted likelihood; covariance of Kenward and Roger"
        return Covariance("kenward-roger", *self._estimate[1:], text)

    @property
    def description(self) -> str:
        names: dict[str, list[str]] = {}
        for d, _ in self.fit.found:
            names.setdefault(d.part, []).append(d.name)
        text = STRUCTURES[self.fit.kind.own].description
        for part, own in names.items():
            named = " / ".join([own[0], *(name.removeprefix(EACH_HAS) for name in own[1:])])
            text += PARTS[part][0].format(named)
        return text


def estimate_noise(
    readings: Readings, kind: str = "auto", like: NoiseFit | None = None
) -> NoiseFit:
    """Variances of the chosen noise model by REML, and the estimate under it.

    `kind`: the name of a `Kind`, or "auto", unless it is that of `like`, a fit of nearly the same
    readings, where the search then starts.  Auto takes the noise of single readings with the
    smallest criterion that the table has the labels and the readings for, each with what a
    configuration may share, and then changes by one part what makes the criterion smaller, until
    nothing does; scatter of the joints and drift are tried where a test finds a trace of them.
    """
    Q, T = orthogonal(readings.B.reshape(-1, readings.n_parameters))
    basis = replace(readings, B=Q.reshape(readings.B.shape))
    if like is not None:
        found = fitted(basis, Kind.parsed(like.kind), like.fit)
        if like.trials and not found.told:
            return _chosen(basis, T)
        return replace(like, fit=found, T=T, to_longest=0.0, over_times=None)
    asked = Kind.of(kind)
    if kind == "auto":
        return _chosen(basis, T)
    model = STRUCTURES[asked.own]
    require(
        type(model).components is NoiseModel.components or model.supports(readings),
        f"{option('noise', kind)}: this table does not support the noise model '{asked.own}'; add "
        "the columns that it needs, or take another one",
    )
    return NoiseFit(kind, fitted(basis, asked), T)


def _chosen(readings: Readings, T: Array) -> NoiseFit:
    some = readings.sample(max(CHOSEN_FROM, PER_PARAMETER * readings.n_parameters))
    if some is readings:
        return _Choice(readings).result(T)
    try:
        found = _Choice(some, supported(readings)).result(T)
        again = fitted(readings, Kind.parsed(found.kind), found.fit, found.fit.lasting)
    except ElastocalError:  # the sample does not show all parameters, or not all labels
        return _Choice(readings).result(T)
    why = f"{found.reason}; chosen from {len(some)} readings at random, estimated from all"
    return replace(found, kind=again.kind.name, fit=again, reason=why)


def supported(readings: Readings) -> list[str]:
    """Structures whose variances the table can tell.  What is stated is believed until something
    else is better."""
    names = [name for name, model in STRUCTURES.items() if model.supports(readings)]
    return sorted(names, key=lambda name: name != "stated")


class _Choice:
    """The search for the model with the smallest criterion: the noise of single readings first,
    then one part more or less as long as the criterion falls."""

    def __init__(self, readings: Readings, names: list[str] | None = None) -> None:
        self.readings, self.names = readings, names or supported(readings)
        self.price = float(np.log(max(readings.e.size - readings.n_parameters, 3)))
        self.trials: dict[tuple[Kind, float | None], Trial] = {}
        self.tests: dict[Kind, NoiseTest] = {}
        self.best: Fitted | None = None
        self.least = math.inf

    def result(self, T: Array) -> NoiseFit:
        could_share = any(Kind("", (CONFIGURATION,)).deviations(self.readings, None))
        for name in self.names:
            self.attempt(Kind(name, (CONFIGURATION,) * could_share))
        if self.best is None:
            raise InsufficientDataError(
                "there are too few readings to estimate any noise from; measure more poses"
            )
        while self._changed():
            pass
        best = self.best
        trials, kind = tuple(self.trials.values()), best.kind.name
        again = fitted(self.readings, best.kind, best, best.lasting)
        tests = {test.part: test for test in self.tests.values()}  # the last one of each
        others = sorted((t for t in trials if t.kind != kind), key=lambda t: t.criterion)
        mine = min(t.criterion for t in trials if t.kind == kind)
        gaps = ", ".join(f"{t.kind} (+{t.criterion - mine:.1f})" for t in others)
        reason = f"among the models that the table supports; others: {gaps}"
        reason = f"smallest information criterion {reason}" if others else ONLY
        return NoiseFit(kind, again, T, trials, reason, tuple(tests.values()))

    def attempt(
        self, kind: Kind, lasting: float | None = None, found: Fitted | None = None
    ) -> None:
        """Fit a kind of noise, unless it is `found`, and keep it where it is better."""
        if (kind, lasting) in self.trials:
            return
        try:
            found = found or fitted(self.readings, kind, self.best, lasting, ROUGHLY)
        except InsufficientDataError:
            return
        own = self.readings.size + 1 if kind.shrunk else found.noisy.own  # of many their prior
        own += max(sum(d.part == EACH for d in found.noisy.deviations) - 1, 0)
        shared = {d.part if d.part == EACH else d.name for d, _ in found.found}
        spent = len(shared) + (found.lasting is not None)
        criterion = float(own * self.price + 2 * spent - 2 * found.log_likelihood)
        self.trials[kind, lasting] = Trial(found.kind.name, own + spent, criterion)
        if criterion < self.least and found.told:
            self.least, self.best = criterion, found

    def _changed(self) -> bool:
        before, record = self.least, self.readings.visits
        rows = np.bincount(self.readings.configuration).max() * self.readings.size
        visited = np.zeros(0, dtype=np.int64) if record is None else record.visit
        visits = np.unique(visited[visited >= 0], return_counts=True)[1]
        known = len(visits) >= FEWEST_VISITS and rows <= MOST_TOGETHER
        for part in PARTS:
            assert self.best is not None
            kind = self.best.kind
            if part in kind.parts:
                self.attempt(kind.without(part), self.best.lasting if part != TIME else None)
            elif not known or record is None or part == CONFIGURATION:
                continue
            elif part == EACH:
                if JOINTS in kind.parts:
                    self.attempt(kind.with_part(EACH), self.best.lasting)
            # One reading to a visit tells the joints' scatter from its own noise by nothing but how
            # both change from pose to pose, as the model's own errors do.
            elif part == JOINTS and EACH not in kind.parts and np.median(visits) >= SEVERAL:
                self._look_for(part, kind, (self.best.lasting,))
            elif part == TIME and record.lasting:
                self._look_for(part, kind, record.lasting)
        return self.least < before

    def _look_for(self, part: str, kind: Kind, lasting: Sequence[float | None]) -> None:
        """Try a part, with each of these times of what drifts, where the likelihood shows a trace
        of it beside what there is; many variances of single readings imitate it, and give way.

        Twice what it gains, against a mixture of χ² with as many degrees of freedom as of the k
        variances of the part are not at zero, a half of them on average (Self and Liang 1987, J.
        Am. Stat. Assoc. 82, 605).
        """
        less = self.best
        assert less is not None
        if kind.shrunk:
            kind = kind._replace(own=self.names[0])
            less = fitted(self.readings, kind, less, None, ROUGHLY)
        wanted = kind.with_part(part)
        if wanted in self.tests:
            return
        more = fitted(self.readings, wanted, less, lasting[0], ROUGHLY)
        k = np.arange(1, 1 + sum(d.part == part for d in more.noisy.deviations))
        gain = 2 * (more.log_likelihood - less.log_likelihood)
        share = special.binom(len(k), k) / 2 ** len(k)
        p = float(share @ special.chdtrc(k, gain)) if gain > ROUGHLY else 1.0
        self.tests[wanted] = NoiseTest(part, p)
        if p < TRACE:
            self.attempt(wanted, lasting[0], more)
            for each in lasting[1:]:
                self.attempt(wanted, each)


def not_knowing_times(found: NoiseFit) -> NoiseFit:
    """The same fit with a covariance that does not take for known how long what drifts lasts, where
    the cell does not say: the mean over the correlation times tried, Σ = Σ_m w_m Σ_m.  w_m ∝ the
    restricted likelihoods.  To what the degrees of freedom f_m leave unknown, Σ_m w_m/f_m, comes
    what the models differ by (`Covariance.tails`), most for base and tracker."""
    readings, T, fits = found.fit.noisy.readings, found.T, [found.fit]
    if found.fit.lasting is None or readings.visits is None:
        return found
    for lasting in readings.visits.lasting:
        if lasting != found.fit.lasting:
            with suppress(ElastocalError, np.linalg.LinAlgError):
                fits.append(fitted(readings, Kind.parsed(found.kind), found.fit, lasting))
    level = np.array([one.log_likelihood for one in fits])
    longest = [v for one, v in zip(fits, level, strict=True) if one.lasting == LONGEST]
    weight = np.exp(level - level.max()) / np.exp(level - level.max()).sum()
    _, matrices, dof = map(np.array, zip(*(one.estimate(T) for one in fits), strict=True))
    among = tuple(zip(weight.tolist(), matrices, strict=True))
    mean = replace(found.covariance, matrix=np.tensordot(weight, matrices, 1), among=among)
    between = 1 / replace(mean, dof=np.full(len(T), np.inf)).tails(np.eye(len(T))[:, None])[0]
    left = weight @ (1 / dof) + between
    dof = np.divide(1, left, out=np.full(len(left), np.inf), where=left > 0)
    short = float(level.max()) - max(longest, default=-math.inf)
    return replace(found, over_times=replace(mean, dof=dof), to_longest=short)


def linearised(model: Model, observed: Observations, x: Array, columns: IntArray) -> Readings:
    at = model.kept_regressor(observed, x, columns)
    n, size, table, sight, reach = len(observed.lead), observed.size, observed.table, None, None
    if table.position is not None and size == 3:
        offset = table.position[observed.lead] - model.cell.tracker.position
        length = np.linalg.norm(offset, axis=1)
        if (length > 0).all():
            sight, reach = polar_axes(offset), length
    return Readings(
        at.B.reshape(n, size, -1), at.residual.reshape(n, size), observed.configuration,
        observed.load, table.marker[observed.lead], sight, reach,
        stated_by_observation(observed, model.cell.tracker), table, observed.lead,
        visit_record(model, observed, x),
    )  # fmt: skip


def weights_of(noise: NoiseFit, readings: Readings, more: Array | float = 0.0) -> Weights:
    """Weights of the readings (N,) under an estimated noise; whitened residuals have size 1.
    `more` (N, size, size) comes to the covariance of single readings."""
    whiten = block_diagonal(inverse_factor(own_noise(noise.fit, readings)[0] + more))
    weights = Weights(noise.kind, whiten, True, noise.description)
    together, record = readings.configuration, readings.visits
    if noise.fit.lasting is not None and record is not None:
        together = record.blocks(together, noise.fit.lasting)
    return weights_sharing(weights, noise.fit.of(readings), together)


def weights_sharing(
    own: Weights, deviations: Sequence[tuple[Deviation, float]], together: IntArray
) -> Weights:
    """The weights `own` of single readings where these share deviations of such variances besides,
    Σ = Σ_own + Σ_k τ_k² Z_k Z_kᵀ; where all share waves, readings are judged by those that are not
    `together` (N,) with them."""
    if not deviations or own.whiten is None:
        return own
    Z = own.whiten @ sparse.hstack([np.sqrt(v) * d.columns() for d, v in deviations], format="csr")
    beside = whitener(sparse.csr_array(sparse.eye_array(Z.shape[0]) + Z @ Z.T))
    own = replace(own, whiten=sparse.csr_array(beside @ own.whiten))
    waves = [np.sqrt(v) * d.waves for d, v in deviations if d.waves is not None]
    if not waves:
        return own
    common = np.concatenate(waves, axis=2).reshape(Z.shape[0], -1)
    return replace(own, common=common, together=together)


def with_stated_sharing(own: Weights, model: Model, observed: Observations, x: Array) -> Weights:
    """The weights `own` of single readings with what `[noise]` of the cell says that they share."""
    if not model.cell.noise.shared or own.whiten is None or not own.absolute:
        return own
    stated = [(d, 1.0) for d in stated_deviations(model, observed, x)]
    return weights_sharing(own, stated, observed.configuration)
