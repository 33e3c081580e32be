"""What a result says of noise and residuals: model, sizes, repeats, and whether they look alike."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from elastocal.cell import Cell
from elastocal.identification.least_squares import ALONE, f_test
from elastocal.identification.noise_choice import (
    NoiseFit,
    NoiseTest,
    Trial,
    linearised,
    own_noise,
    with_stated_sharing,
)
from elastocal.identification.noise_structure import CONFIGURATION, TURNED
from elastocal.identification.outliers import kept_of
from elastocal.identification.solve import MethodResult
from elastocal.identification.weighted_problem import (
    inverse_factor,
    stated_by_observation,
    weights_for,
)
from elastocal.measurements import Measurements, numbered, visits
from elastocal.messages import InputError, load_text
from elastocal.model.observations import COMPONENTS, Observations, pure_error
from elastocal.units import Array, BoolArray, IntArray, microns

# What single readings scatter by, whatever the arm does: of repeats, or of markers of one pose.
#
# The flange takes all markers along as one rigid body.  Of k markers that are read in one visit,
# 3k − 6 numbers (1 of two markers) know nothing of where the arm is, and scatter by the instrument
# alone; so do repeats, by the arm's repeatability besides.  Beside the stated noise they say if it
# is stated right, and the rest of the residual, if the model lacks something.

FEWEST = 35  # degrees of freedom, from which a scatter is known to a factor of 1.25 (95 %)
BEYOND = 0.005  # chance that so much scatter has the stated noise
REST = 0.01  # p-value below which the rest of the residual is more than single readings explain
MOST = 20_000  # readings that are looked at
MOST_NUMBERS = 30_000_000  # of B held at once, to weight readings by what they share


@dataclass(frozen=True)
class SingleReadings:
    """Scatter of single readings in units of the stated noise: `ratio`, with `dof` degrees of
    freedom, `by` what, and the p-value `rest` of the rest of the residual being no more."""

    ratio: float
    dof: int
    by: str
    rest: float

    @property
    def above(self) -> bool:
        return self.ratio**2 * self.dof > float(special.chdtri(self.dof, BEYOND))

    @property
    def explains(self) -> bool:
        return self.above and self.rest >= REST


def single_readings(
    observed: Observations, residual: Array, stated: Array, spent: int, repeats: bool = True
) -> SingleReadings | None:
    """From the `residual` (N·3,) of positions, the noise `stated` (N, 3, 3) for each, and how many
    parameters were `spent` on them; None where neither markers nor, if asked, `repeats` tell."""
    n = len(observed.lead)
    if observed.kind != "position" or n > MOST:
        return None
    root = inverse_factor(stated)
    e = np.einsum("nij,nj->ni", root, residual.reshape(n, 3))
    visit = visits(observed.table)[observed.lead]
    square, dof, by = *_of_bodies(observed, root, e, visit), "markers of one pose"
    if dof < FEWEST and repeats:
        square, dof = pure_error(observed.place, e)
        by = "repeats"
    rest = residual.size - spent - dof
    if dof < FEWEST or rest < 1 or square <= 0:
        return None
    p = f_test(max(float((e**2).sum()) - square, 0.0), rest, square, dof)[1]
    return SingleReadings(float(np.sqrt(square / dof)), dof, by, float(p))


def _of_bodies(observed: Observations, root: Array, e: Array, visit: IntArray) -> tuple[float, int]:
    """Sum of squares and degrees of freedom of whitened e (N, 3) off rigid motions of the markers
    of each visit, the markers' own places on the tool being fitted."""
    table, lead = observed.table, observed.lead
    p = np.asarray(table.position)[lead]
    square, dof = 0.0, 0
    order = np.argsort(visit, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(visit[order])) + 1):
        if len(rows) < 2:
            continue
        turn = np.cross(np.eye(3), (p[rows] - p[rows].mean(axis=0))[:, None, :])
        columns = np.concatenate(
            [np.broadcast_to(np.eye(3), turn.shape), turn.transpose(0, 2, 1)], axis=2
        )
        Q, size, _ = np.linalg.svd((root[rows] @ columns).reshape(-1, 6), full_matrices=False)
        Q = Q[:, size > 1e-9 * size.max()]
        own = e[rows].ravel()
        square += float(own @ own - ((Q.T @ own) ** 2).sum())
        dof += len(own) - Q.shape[1]
    markers = len(np.unique(table.marker[lead]))
    return square, dof - max(3 * markers - 6, min(markers - 1, 1))


TOO_LARGE_IN_COMMON = (
    "Configurations scatter {:.2g} times as much as [noise] configuration_um of the cell states: "
    "correct it, for behind noise stated too large a missing effect does not show."
)


def less_in_common(observed: Observations, residual: Array, cell: Cell, spent: int) -> float | None:
    """Scatter of the mean residual of each configuration, which the `spent` parameters are taken to
    have followed alone, in units of what the cell states of it; None where chance makes it as
    little, or what is stated is mostly that of single readings."""
    common, stated = cell.noise.configuration, stated_by_observation(observed, cell.tracker)
    if stated is None or not common or observed.kind not in ("position", "pose"):
        return None
    of = numbered(observed.configuration)
    count = np.bincount(of)[:, None]
    mean, own = np.zeros((len(count), 3)), np.zeros((len(count), 3, 3))
    np.add.at(mean, of, residual.reshape(len(of), -1)[:, :3])
    np.add.at(own, of, stated[:, :3, :3])
    own, dof = own / count[:, None] ** 2, mean.size - spent
    if dof < 1 or common**2 < np.trace(own, axis1=1, axis2=2).mean() / 3:
        return None
    e = inverse_factor(own + common**2 * np.eye(3)) @ (mean / count)[..., None]
    square = float((e**2).sum())
    return math.sqrt(square / dof) if square < special.chdtri(dof, 1 - BEYOND) else None


@dataclass(frozen=True)
class LackOfFit:
    """F = (SS_between / dof_between) / (SS_pure / dof_pure), its p-value, and both dofs."""

    F: float
    p: float
    dof_between: int
    dof_pure: int


def lack_of_fit(observed: Observations, whitened: Array, n_parameters: int) -> LackOfFit | None:
    """F-test of the residual between configurations against pure error from repeats, observations
    of the same configuration, marker and force (Draper and Smith 1998, section 2.1).  Within them
    the whitened residual (rows,) scatters by pure error, SS_pure with Σ (repeats − 1) · size
    degrees of freedom. None where nothing is repeated, or no degree of freedom is left."""
    residual = whitened.reshape(-1, observed.size)
    pure, dof_pure = pure_error(observed.place, residual)
    dof_between = len(whitened) - n_parameters - dof_pure
    if dof_pure < 1 or dof_between < 1 or pure <= 0:
        return None
    between = max(float((residual**2).sum()) - pure, 0.0)
    F, p = f_test(between, dof_between, pure, dof_pure)
    return LackOfFit(float(F), float(p), dof_between, dof_pure)


NUMBERED = re.compile(r"^(marker|configuration) (\d+)")
TOO_LARGE = (
    "the table is too large for a choice among noise models; stated noise, or equal noise "
    "where none is stated, is scaled to the residual"
)


@dataclass(frozen=True)
class NoiseSize:
    """An estimated standard deviation `sigma` in m, or rad where it `turns`, or the `factor` on the
    stated noise.  `part` says what of PARTS it is, "" for single readings, `joints` are those whose
    scatter it is, `relative` is the standard error of σ² over σ²."""

    name: str
    sigma: float | None
    factor: float | None = None
    part: str = ""
    joints: tuple[int, ...] = ()
    turns: bool = False
    relative: float = 0.0

    def agrees_with(self, stated: float) -> bool:
        """Whether it is the `stated` standard deviation within its 99 % interval, that of log σ²;
        a variance whose uncertainty is not known contradicts nothing."""
        if not self.sigma or not stated:
            return False
        off = abs(2 * math.log(self.sigma / stated))
        return not self.relative or off <= float(special.ndtri(0.995)) * self.relative

    def to_json(self) -> dict[str, Any]:
        unit = "sigma_urad" if self.joints and self.turns else "sigma_um"
        size: dict[str, Any] = {"name": self.name, unit: microns(self.sigma)}
        return size if self.factor is None else size | {"factor": self.factor}


LIKELY = 0.5 * float(special.chdtri(1, 0.05))  # nats within which a likelihood has its 95 %


@dataclass(frozen=True)
class Drift:
    """The correlation time of what drifts, as a `share` of the campaign and in `seconds`; None
    where the table has no times, and the order of its rows was taken for that of the visits.
    `ends`: whether the times as likely as 95 % ask for leave out the longest one tried, whose
    likelihood is that of a random walk."""

    share: float
    seconds: float | None
    ends: bool = True


@dataclass(frozen=True)
class Noise:
    """The noise that an identification rests on.

    `kind` and `description` name the weights.  `sigma` (m) is the noise of a reading's component
    where one number says it, `ratio_to_stated` the residual over the stated noise where any was
    stated, and `single` that of repeats or of markers of one pose alone.  `interval_kind` and
    `interval_description` say how intervals follow from it.  Where the noise was estimated there
    are its `sizes` and the models `tried`; `reason` says why this one.
    `tests` are those for joints that settle anew at each visit and for a drift, `drift` says of a
    course in time how long it lasts.
    """

    kind: str
    description: str
    sigma: float | None = None
    ratio_to_stated: float | None = None
    lack_of_fit: LackOfFit | None = None
    interval_kind: str = "classical"
    interval_description: str = ""
    reason: str | None = None
    sizes: tuple[NoiseSize, ...] | None = None
    tried: tuple[Trial, ...] | None = None
    tests: tuple[NoiseTest, ...] = ()
    drift: Drift | None = None
    single: SingleReadings | None = None

    @property
    def estimated(self) -> bool:
        return bool(self.sizes)

    def scatter(self, n_joints: int) -> tuple[Array, float]:
        """What a visit scatters by: joints (joints,) in rad or m, and m on each axis in common."""
        joints, common = np.zeros(n_joints), 0.0
        for size in self.sizes or ():
            if size.joints:
                joints[list(size.joints)] = size.sigma
            elif size.part == CONFIGURATION and size.sigma is not None:
                common = float(np.hypot(common, size.sigma))
        return joints, common

    @property
    def held_out_by(self) -> str:
        """What is left out at a time to judge predictions: whole blocks in time where something
        drifts, since neighbours in time err alike; the error is then that of another day."""
        return "configurations" if self.drift is None else "blocks in time"

    def to_json(self) -> dict[str, Any]:
        known = {
            "single_readings": self.single, "reason": self.reason, "variances": self.sizes,
            "tests": self.tests or None, "drift": self.drift, "tried": self.tried,
        }  # fmt: skip
        return {
            "kind": self.kind, "description": self.description, "sigma_um": microns(self.sigma),
            "ratio_to_stated": self.ratio_to_stated, "lack_of_fit": self.lack_of_fit,
            "held_out_by": self.held_out_by,
            "intervals": {"kind": self.interval_kind, "description": self.interval_description},
            **{name: value for name, value in known.items() if value is not None},
        }  # fmt: skip


def noise_of(found: MethodResult, sigma: float) -> tuple[Noise, dict[str, float]]:
    """The noise that a method found, and its parts: mean square 3-D noise (m²) of single
    "readings", and what readings of "visits" share; `sigma` is that of a whitened row.  Where no
    noise was estimated, all of the residual is taken for that of single readings."""
    solution, estimated = found.solution, found.noise
    problem, residual = solution.problem, solution.fit.residual
    observed, cell, weights = problem.observations, problem.model.cell, problem.weights
    stated, size = stated_by_observation(observed, cell.tracker), observed.size
    spent, single = (found.effective if found.smooth else None), None
    spent = len(solution.fit.columns) if spent is None else spent
    if stated is not None and cell.noise.tails is None:
        told = not cell.noise.shared  # else repeats scatter by more than the instrument
        single = single_readings(observed, residual, stated, spent, told)
    whitened = weights.apply(residual)
    if estimated is None:
        squared = residual.reshape(-1, size)[:, :3] ** 2
        spare = len(residual) / max(len(residual) - spent, 1)
        parts = {"readings": float(squared.sum()) / len(squared) * spare}
    else:
        bare = linearised(problem.model, observed, solution.fit.x, np.zeros(0, dtype=np.int64))
        own = own_noise(estimated.fit, bare)[0]
        alone = np.diagonal(own, axis1=1, axis2=2)[:, :3].sum(axis=1).mean()
        visits = sum(variance * d.mean_square(3) for d, variance in estimated.fit.of(bare))
        parts = {"readings": float(alone), "visits": float(visits)}
        if estimated.fit.common.any():
            whitened = (inverse_factor(own) @ residual.reshape(-1, size, 1)).ravel()
    noise = Noise(
        weights.kind, weights.description, sigma=None if weights.absolute else sigma,
        ratio_to_stated=_ratio_to_stated(found, sigma, spent),
        lack_of_fit=lack_of_fit(observed, whitened, spent), single=single,
        interval_kind=found.spread.kind, interval_description=found.spread.description,
        reason=TOO_LARGE if estimated is None and problem.large else None,
    )  # fmt: skip
    return (noise if estimated is None else _estimated(noise, estimated, observed.table)), parts


def _estimated(noise: Noise, found: NoiseFit, table: Measurements) -> Noise:
    fit, own, sigma = found.fit, found.fit.noisy.own, np.sqrt(found.fit.theta).tolist()
    labels = {"marker": table.marker_names, "configuration": table.configuration_labels}

    def label(numbered: re.Match[str]) -> str:
        return f"{numbered[1]} {labels[numbered[1]][int(numbered[2])]}"

    structure, sizes = fit.noisy.structure, list[NoiseSize]()
    kind = fit.kind.own
    error = np.sqrt(np.diagonal(fit.covariance)) / np.maximum(fit.theta, 1e-300)
    for name, s, r in zip(structure.names, sigma[:own], error[:own].tolist(), strict=True):
        size, factor = (None, s) if kind == "stated" else (s, None)
        name = NUMBERED.sub(label, name)
        sizes.append(NoiseSize(name, size, factor, turns=name in TURNED, relative=r))
    for d, s, r in zip(fit.noisy.deviations, sigma[own:], error[own:].tolist(), strict=True):
        sizes.append(NoiseSize(d.name, s, None, d.part, d.joints, d.turns, r))
    drift, record = None, fit.noisy.readings.visits
    if fit.lasting is not None and record is not None:
        seconds = fit.lasting * record.span if record.timed else None
        drift = Drift(fit.lasting, seconds, found.to_longest > LIKELY)
    return replace(
        noise, kind=found.kind, description=found.description, reason=found.reason,
        sigma=sigma[0] if kind == "independent" and own == 1 else None, sizes=tuple(sizes),
        tried=found.trials, tests=found.tests, drift=drift,
    )  # fmt: skip


def _ratio_to_stated(found: MethodResult, sigma: float, spent: int) -> float | None:
    """Root mean square of the residual in units of the stated noise, per degree of freedom; of
    stated tails, in units of what is left of that noise where far readings are set apart.  Readings
    that share some of it are weighted as they share it, and what the parameters take of the
    residual at these weights is taken: only then does it have the expectation 1."""
    solution = found.solution
    problem, fit = solution.problem, solution.fit
    observed, model, unit = problem.observations, problem.model, 1.0
    noise = model.cell.noise
    if noise.tails is not None and not found.good.all():
        unit = kept_of(noise.tails, len(found.good) * observed.size, observed.size).sigma
    shared = noise.shared and len(fit.residual) * len(fit.columns) <= MOST_NUMBERS
    if found.method == "wls" and problem.weights.absolute and not shared:
        return sigma / unit
    try:
        stated = weights_for(observed, model.cell.tracker)
    except InputError:
        return None
    if not stated.absolute:
        return None
    if shared and stated.whiten is not None:
        stated = replace(stated, whiten=stated.whiten / unit)
        stated, unit = with_stated_sharing(stated, model, observed, fit.x), 1.0
    e = stated.apply(fit.residual)
    if shared:
        Q, _ = np.linalg.qr(stated.apply(fit.B))
        e = e - Q @ (Q.T @ e)
    return float(np.sqrt(e @ e / max(len(e) - spent, 1))) / unit


# Ordered residuals against normal order statistics, with a band that holds for all of them.
#
# The i-th smallest of n standard normal values stands beside its expectation, by Blom's formula
#
#     m_i = Φ⁻¹((i − 3/8) / (n + 1/4))                    (Blom 1958, Statistical Estimates, p. 71)
#
# Its probability U_(i) ~ Beta(i, n + 1 − i).  The band takes the same local level η at every i, so
# that it looks as sharply into the tails as into the middle, and η such that all n points together
# stay inside with 95 % (Aldor-Noiman et al. 2013, Am. Stat. 67, 249).  A pointwise band would be
# left by one point in twenty, neighbours together, and seem to accuse where nothing is wrong.

# Local levels of a simultaneous 5 % in small samples, from 1e5 simulated ones each; between them
# log η is interpolated in log n.
SMALL_N = (8.0, 12.0, 20.0, 32.0, 50.0, 100.0, 200.0)
SMALL_ETA = (0.00880, 0.00661, 0.00471, 0.00371, 0.00295, 0.00219, 0.00173)


@dataclass(frozen=True)
class NormalScores:
    """Points (k,) in ascending order: expected and observed value, and the band at each.  `n`
    values were ordered; k ≤ n of them are given, evenly spaced over the expected values. `inside`
    says whether every given point lies in the simultaneous 95 % band."""

    n: int
    expected: Array
    observed: Array
    low: Array
    high: Array
    inside: bool


def normal_scores(z: Array, most: int) -> NormalScores:
    """Normal scores of z (n,), at least 8 that should be standard normal, at most `most` of them,
    chosen evenly over the expected values, so that both tails keep their single values."""
    n = z.size
    rank = np.arange(1, n + 1)
    if n > most:
        end = special.ndtri((n - 0.375) / (n + 0.25))
        share = special.ndtr(np.linspace(-end, end, most))
        rank = np.unique(np.clip(np.rint(share * (n + 0.25) + 0.375), 1, n).astype(np.int64))
    half = simultaneous_level(n) / 2
    observed = np.partition(z, rank - 1)[rank - 1] if n > most else np.sort(z)
    low = special.ndtri(special.betaincinv(rank, n + 1 - rank, half))
    # The complement of the mirrored point: 1 − u near one has no digits to spare.
    high = -special.ndtri(special.betaincinv(n + 1 - rank, rank, half))
    inside = bool(((low <= observed) & (observed <= high)).all())
    expected = special.ndtri((rank - 0.375) / (n + 0.25))
    return NormalScores(n, expected, observed, low, high, inside)


def simultaneous_level(n: int) -> float:
    """Local level η at which all n order statistics stay in their bands with 95 %.  From n = 200
    on, η = −ln 0.95 / (2 ln n · lln n) · (1 − 1.3 llln n / lln n), with lln = ln ln (Weine, McPeek
    and Abney 2023, J. Stat. Softw. 106(10)); below, a table."""
    if n < SMALL_N[-1]:
        return float(np.exp(np.interp(np.log(n), np.log(SMALL_N), np.log(SMALL_ETA))))
    log = np.log(n)
    twice = np.log(log)
    return float(-np.log(0.95) / (2 * log * twice) * (1 - 1.3 * np.log(twice) / twice))


def groupings(
    observed: Observations, chosen: BoolArray | slice
) -> Iterator[tuple[str, NDArray[np.integer], NDArray[np.object_]]]:
    """By what the `chosen` rows (rows,) fall into more than one group, the number of each row's
    group and the groups' names, in the table's order."""
    table, size = observed.table, observed.size
    load, force = observed.load, table.force[observed.lead]
    loads = tuple(map(load_text, force[np.unique(load, return_index=True)[1]]))
    coded: list[tuple[str, IntArray, tuple[str, ...]]] = [
        ("component", np.arange(size)[None], COMPONENTS[observed.kind]),
        ("marker", table.marker[observed.lead][:, None], table.marker_names),
        ("configuration", observed.configuration[:, None], table.configuration_labels),
        ("load state", load[:, None], loads),
    ]
    for by, own, names in coded:
        code = np.broadcast_to(own, (len(observed.lead), size)).ravel()[chosen]
        used, first = np.unique(code, return_index=True)
        order = used[np.argsort(first)]
        if len(order) > 1:
            place = np.empty(len(names), dtype=np.int32)  # of a million readings three times
            place[order] = np.arange(len(order))
            yield by, place[code], np.array(names, dtype=object)[order]


# Do the residuals look as the noise model says?  For the whole table and by group.
#
# Under the model the whitened residuals e (rows,) have covariance I − H, H the hat matrix of the
# whitened B.  With the leverages h = diag H,
#
#     z_i = e_i / √(1 − h_i)
#
# is standard normal, and the mean square Σ e² / Σ (1 − h) of any group of rows has expectation 1.
# On f = Σ (1 − h) degrees of freedom it is judged by χ²: exactly for the whole table; for a group
# the eigenvalues of its block of I − H are at most 1, which makes χ² with f err on the safe side.
# Where only the shape of the noise is known, the common variance is s² = Σ e² / f over the table.

FEWEST_VALUES = 8  # values that a group needs to be looked at on its own
MOST_LISTED = 12  # groups of a grouping that are given in full, the most conspicuous ones
MOST_BINS = 81
GROUP_POINTS = 50  # normal scores of a group
FEWEST_FOR_SHAPE = 20  # values from which the omnibus test keeps its level
SIGNIFICANT = 0.05


@dataclass(frozen=True)
class GroupSummary:
    """The standardised residuals z of some rows.

    `counts` and `expected` (bins,) lie over the edges of the grouping, `beyond` values outside
    them.  `mean_square` has expectation 1 on `dof` degrees of freedom, with the two-sided χ²
    p-value `p`, and `p_holm` adjusted over all groups of all groupings (the whole table stands for
    itself).  `normality_p` is the
    omnibus test K² of D'Agostino and Pearson (1973) on skewness and kurtosis, None below 20
    values.  `held_out_mean_square` is that of the whitened held-out residuals, None without.
    """

    name: str
    n: int
    counts: IntArray
    expected: Array
    beyond: int
    scores: NormalScores
    skewness: float
    excess_kurtosis: float
    normality_p: float | None
    mean_square: float
    dof: float
    p: float
    p_holm: float
    held_out_mean_square: float | None = None

    @property
    def deviates(self) -> bool:
        """Whether the group scatters more or less than the model says, at 5 % over all groups."""
        return self.p_holm < SIGNIFICANT


@dataclass(frozen=True)
class Grouping:
    """The rows by component, marker, configuration or load state, over common bin `edges`.  Of
    `n_groups` groups, `n_small` have fewer than 8 values and `n_deviating` scatter more or less
    than the model says; `groups` are at most 12, those of the smallest p, in the table's order."""

    by: str
    edges: Array
    groups: tuple[GroupSummary, ...]
    n_groups: int
    n_small: int
    n_deviating: int


@dataclass(frozen=True)
class ResidualSummary:
    """Standardised residuals of the whole table over `edges`, and by group.  `absolute` says
    whether the size of the noise was stated or estimated as part of the model; else the residuals
    told it, and the whole table's mean square is 1.  `n_alone` rows have no residual of their own,
    because they alone determine something."""

    whole: GroupSummary
    edges: Array
    groupings: tuple[Grouping, ...]
    absolute: bool
    n_alone: int

    @property
    def deviating(self) -> tuple[tuple[str, GroupSummary], ...]:
        """(grouping, group) of those listed that scatter more or less than the model says.
        Smallest p first: a loud configuration makes its markers and components loud as well."""
        found = [(g.by, group) for g in self.groupings for group in g.groups if group.deviates]
        return tuple(sorted(found, key=lambda pair: pair[1].p))


def summarise_residuals(
    observed: Observations, whitened: Array, leverage: Array | None = None,
    held_out: Array | None = None, *, absolute: bool = True,
) -> ResidualSummary | None:  # fmt: skip
    """Histograms, normal scores and tests of the whitened residuals (rows,) of `observed`.

    `leverage` (rows,) is diag H of the whitened B, by default zero; `held_out` (rows,) the
    whitened residuals of fits to the other configurations, infinite where there is none.
    `absolute` False: the noise is known up to a common factor only, which the residuals tell.
    None where fewer than 8 rows have a residual, or all residuals are zero.
    """
    spare = np.broadcast_to(1.0, whitened.shape) if leverage is None else 1 - leverage
    alone = spare <= ALONE
    free: BoolArray | slice = ~alone if alone.any() else slice(None)  # of a large table no copies
    e, spare = whitened[free], spare[free]
    if len(e) < FEWEST_VALUES or not e @ e > 0:
        return None
    if not absolute:
        e = e / np.sqrt((e @ e) / float(spare.sum()))
    held = np.full(len(e), np.inf) if held_out is None else held_out[free]
    z, judged = e / np.sqrt(spare), []
    for by, code, names in groupings(observed, free):
        total, f = (np.bincount(code, v, len(names)) for v in (e**2, spare))
        count = np.bincount(code)
        p = np.where(count >= FEWEST_VALUES, _two_sided(total, f), np.nan)
        judged.append((by, code, names, count, p))
    of_all = holm(np.concatenate([p for *_, p in judged] or [np.zeros(0)]))
    found = []
    for by, code, names, count, p in judged:
        adjusted, of_all = of_all[: len(p)], of_all[len(p) :]
        large = np.flatnonzero(count >= FEWEST_VALUES)
        shown = np.sort(large[np.argsort(adjusted[large], kind="stable")][:MOST_LISTED])
        edges = _edges(z, int(np.median(count[large])) if len(large) else FEWEST_VALUES)
        members = ((k, np.flatnonzero(code == k)) for k in shown)
        groups = tuple(
            _summary(names[k], e[rows], spare[rows], held[rows], edges, float(adjusted[k]))
            for k, rows in members
        )
        deviating = int((adjusted[large] < SIGNIFICANT).sum())
        found.append(
            Grouping(by, edges, groups, len(count), len(count) - len(large), deviating)
        )  # fmt: skip
    edges = _edges(z, len(z))
    whole = _summary("all", e, spare, held, edges, None)
    return ResidualSummary(whole, edges, tuple(found), absolute, int(alone.sum()))


def _edges(z: Array, n: int) -> Array:
    """Bin edges about 0 by Freedman and Diaconis, width 2 IQR n^(−1/3) for n values each, to the
    largest value, or to 6 robust deviations where some lie far beyond."""
    low, high = np.quantile(z, [0.25, 0.75])
    largest = float(np.abs(z).max())
    spread = float(high - low) or largest
    reach = min(1.0001 * largest, 6 * spread / 1.349)
    bins = int(np.clip(np.ceil(reach / (spread * n ** (-1 / 3))), 3, MOST_BINS))
    return np.linspace(-reach, reach, (bins | 1) + 1)  # 0 in the middle of a bin


def _summary(
    name: str, e: Array, spare: Array, held: Array, edges: Array, adjusted: float | None
) -> GroupSummary:
    """Of rows with a residual e, 1 − h, and held out; the whole table has no `adjusted` p."""
    z, total, f = e / np.sqrt(spare), float(e @ e), float(spare.sum())
    counts, p = np.histogram(z, edges)[0], float(_two_sided(total, f))
    unit = z / (np.abs(z).max() or 1.0)  # no power of it overflows
    shape, omnibus, away = (0.0, 0.0), None, unit - unit.mean()
    if np.ptp(unit) >= 1e-10:
        square = away**2  # products: of other powers numpy takes the logarithm
        kurtosis = float((square @ square) / len(z) / (variance := square.mean()) ** 2 - 3)
        shape = float((square @ away) / len(z) / variance**1.5), kurtosis
        omnibus = _p_normal(*shape, len(z)) if len(z) >= FEWEST_FOR_SHAPE else None
    held = held[np.isfinite(held)]
    points = GROUP_POINTS if adjusted is not None else 4 * GROUP_POINTS
    return GroupSummary(
        name, len(z), counts, len(z) * np.diff(special.ndtr(edges)), int(len(z) - counts.sum()),
        normal_scores(z, points), *shape, omnibus, total / f, f, p,
        p if adjusted is None else adjusted, float(np.mean(held**2)) if held.size else None,
    )  # fmt: skip


def _two_sided(total: ArrayLike, f: ArrayLike) -> Array:
    smaller = np.minimum(special.chdtr(f, total), special.chdtrc(f, total))
    return np.where(np.asarray(f) > 0, np.minimum(2 * smaller, 1.0), np.nan)


def _p_normal(skewness: float, kurtosis: float, n: int) -> float:
    """p-value of D'Agostino and Pearson's K² (1973, Biometrika 60, 613), χ² with 2 degrees of
    freedom: skewness as D'Agostino (1970), kurtosis as Anscombe and Glynn (1983) make it normal.
    Written out since scipy.stats takes a third of a second to import."""
    spread = 6 * (n - 2) / ((n + 1) * (n + 3))  # variance of the skewness
    fourth = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3)
    W2 = np.sqrt(2 * (fourth / ((n - 2) * (n + 5) * (n + 7) * (n + 9)) - 1)) - 1
    z1 = np.arcsinh(skewness * np.sqrt((W2 - 1) / 2 / spread)) / np.sqrt(np.log(W2) / 2)
    spread = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis + 6 / (n + 1)) / np.sqrt(spread)
    skewed = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
    skewed *= np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    A = 6 + 8 / skewed * (2 / skewed + np.sqrt(1 + 4 / skewed**2))
    root = np.cbrt((1 - 2 / A) / (1 + x * np.sqrt(2 / (A - 4))))
    z2 = (1 - 2 / (9 * A) - root) / np.sqrt(2 / (9 * A))
    return float(special.chdtrc(2, z1**2 + z2**2))


def holm(p: Array) -> Array:
    """Holm's adjusted p-values (1979, Scand. J. Stat. 6, 65): valid under any dependence."""
    adjusted = np.full(len(p), np.nan)
    order = np.flatnonzero(np.isfinite(p))
    order = order[np.argsort(p[order])]
    steps = p[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
