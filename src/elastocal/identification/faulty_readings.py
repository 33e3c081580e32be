"""What is wrong with the readings: single ones, a marker, a configuration, a run of lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.identification.least_squares import f_test
from elastocal.identification.noise_choice import NoiseFit, linearised, own_noise, weights_of
from elastocal.identification.outliers import (
    FALSE_ALARM,
    TINY,
    FitToGood,
    blocks,
    median_scale,
    named_runs,
    prior_widths,
)
from elastocal.identification.solve import Solution
from elastocal.identification.start import FITS, Registration
from elastocal.identification.weighted_problem import block_diagonal, inverse_factor
from elastocal.measurements import Measurements
from elastocal.messages import length, listed
from elastocal.model.effects.geometry import MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.units import Array, BoolArray, IntArray

# Which readings, markers, configurations and runs of lines lie beyond the noise.
#
# All are judged against the fit to the good readings, those that agree with the majority.  One is
# tested as if left out; a group by the error common to its readings, which shows long before any
# one of them does, and by their errors whatever the direction.  Readings beyond the noise count for
# their group only where they are most of it and far more frequent there than elsewhere: scattered
# blunders make no bad marker.
#
# The false-alarm rate holds for the whole report: it is shared between the levels tested, and
# within a level between its tests (Bonferroni; for blocks between all possible runs of lines).  The
# group that explains most is accepted first, its readings are set aside, and the rest is judged
# anew, so that a displaced marker accuses neither each of its readings nor the configurations that
# it was seen in.

Level = Literal["reading", "marker", "configuration", "block"]
Pattern = Literal["single", "common", "scatter"]

SMALLEST_BLOCK = 3
WORTH_A_BLOCK = 1.1  # a run of lines must explain that much more than the best named group
ABSORBED = 1e-6  # share of a group's error that must be left after the model has followed it
OPEN = 0.5  # of a parameter's prior deviation: what is no better known is undetermined


@dataclass(frozen=True)
class FaultyGroup:
    """One thing that is wrong.

    `readings` (k,) are its observations, of which `beyond` lie beyond the noise on their own.
    `pattern`: whether a group errs in common, a displacement, or by scatter; `error` is the length
    in m of the median error or the rms length, of poses the position's, `sigmas` that of the
    whitened errors over the noise of a row.  `p_value` is adjusted for all tests of the report;
    `p_left` is that of what one common shift leaves of the errors, by the noise of the others.
    `influence` is the largest change of a parameter, `moves_most`, in its standard deviations, if
    the readings were fitted along.
    """

    level: Level
    name: str
    pattern: Pattern
    readings: tuple[int, ...]
    lines: tuple[int, ...]
    beyond: int
    error: float
    sigmas: float
    p_value: float
    influence: float
    moves_most: str
    p_left: float = 0.0

    def __str__(self) -> str:
        name = {"block": f"lines {self.name}"}.get(self.level, f"{self.level} {self.name}")
        return f"{name} by {length(self.error)}"


@dataclass(frozen=True)
class OutlierReport:
    """Findings, groups before readings and the largest first, and what is left without them.
    `sigma` is the noise of a whitened row.  `tests` says how many were made per level, `good` (n,)
    which observations the fit rests on."""

    findings: tuple[FaultyGroup, ...]
    sigma: float
    dof: int
    good: BoolArray
    tests: dict[Level, int]
    false_alarm: float = FALSE_ALARM

    @property
    def shifted(self) -> list[FaultyGroup]:
        """Groups, most of them beyond the noise, whose errors one common shift accounts for."""
        common = (f for f in self.findings if f.pattern == "common" and f.p_left >= FALSE_ALARM)
        return [f for f in common if 2 * f.beyond >= len(f.readings)]

    def blocks(self, table: Measurements) -> list[FaultyGroup]:
        """Those of `shifted` that are lines of several configurations: what is common to the
        readings of one may be an error of the arm there."""
        runs = (f for f in self.shifted if f.level == "block")
        visits = ((f, table.configuration[np.isin(table.row, f.lines)]) for f in runs)
        return [f for f, visited in visits if len(np.unique(visited)) >= SMALLEST_BLOCK]

    def to_json(self) -> dict[str, Any]:
        told = {k: v for k, v in vars(self).items() if k != "good"}
        return told | {"readings_used": int(self.good.sum())}


class Group(NamedTuple):
    """Observations `members` (n,) that may share an error.  A marker whose position is fitted may
    not shift: what its readings then have in common is an error of the arm, which they see as the
    others do."""

    level: Level
    name: str
    members: BoolArray
    may_shift: bool = True


def group_test(
    fit: FitToGood, used: BoolArray, may_shift: bool
) -> tuple[float, float, Array | None, float]:
    """The smaller p-value of two F-tests of the `used` (n,) members of a group, 1 where neither can
    be made; by how much more than by noise the sum of squares falls where they are told apart; the
    error (size,) common to them, None where they err in different directions; the p-value of what
    it leaves.

    With A = Σ T_iᵀT_i over the good ones less or plus the members, the model is fitted with them
    (rss₁), without them (rss₀), and with them and a common shift (rss₁ − gain):

        F_common = (gain/size)/((rss₁ − gain)/dof),   F_any = ((rss₁ − rss₀)/m)/(rss₀/dof₀)

    A common error that the model's own parameters can follow is not tested, nor any where the
    others do not determine what the members touch.
    """
    size, n = fit.e.shape[1], int(used.sum())
    rss_with, dof_with, G, c = _changed(fit, used & ~fit.good, 1)
    S, e = fit.T[used].sum(axis=0), fit.e[used].sum(axis=0)
    solved = np.linalg.solve(G, np.column_stack([S.T, c]))
    M = n * np.eye(size) - S @ solved[:, :size]
    shift, gain, p_common, p_left = np.zeros(size), 0.0, 1.0, 0.0
    if may_shift and dof_with > size and np.linalg.eigvalsh(M)[0] > ABSORBED * n:
        b = e - S @ solved[:, size]
        shift = np.linalg.solve(M, b)
        gain = float(b @ shift)
        rest = max(rss_with - gain, TINY)
        p_common = float(f_test(gain, size, rest, dof_with - size)[1])
        added = int((used & ~fit.good).sum()) - 1
        if added > 0 and fit.dof > 0:
            left = max(rss_with - gain - fit.rss, 0.0)
            p_left = float(f_test(left, size * added, max(fit.rss, TINY), fit.dof)[1])
    excess, p_any = 0.0, 1.0
    rss_without, dof_without, G, _ = _changed(fit, used & fit.good, -1)
    if dof_without > 0 and np.linalg.eigvalsh(G)[0] > ABSORBED:
        drop, rest = max(rss_with - rss_without, 0.0), max(rss_without, TINY)
        p_any = float(f_test(drop, n * size, rest, dof_without)[1])
        excess = drop - n * size * rest / dof_without
    common = may_shift and gain >= excess / 2
    p = min(1.0, 2 * min(p_common, p_any))
    return p, max(gain, excess), shift if common else None, p_left


def _changed(fit: FitToGood, members: BoolArray, sign: int) -> tuple[float, float, Array, Array]:
    """rss, dof, Σ TᵀT and Σ Tᵀe of the fit with `members` added (+1) or removed (−1)."""
    T, e = fit.T[members], fit.e[members]
    G = np.eye(fit.T.shape[2]) + sign * np.einsum("nij,nik->jk", T, T)
    c = np.einsum("nij,ni->j", T, e)
    rss = fit.rss + sign * float((e**2).sum())
    if np.linalg.eigvalsh(G)[0] > ABSORBED:
        rss -= float(c @ np.linalg.solve(G, c))
    return max(rss, 0.0), fit.dof + sign * e.size, G, c


class _Judged:
    """Readings y (n, size) ≈ B z, whitened, B (n, size, p) per prior deviation of the parameters
    `names`; `off` (n, …) are their errors in m, `good` (n,) those to rely on."""

    def __init__(
        self, whole: Solution, clean: Solution, noise: NoiseFit | None, good: BoolArray,
        residual: Array | None,
    ) -> None:  # fmt: skip
        problem, columns = whole.problem, clean.fit.columns
        if residual is not None:
            columns = columns[~np.isin(columns, clean.reduction.with_prior)]
        observed, table = problem.observations, problem.observations.table
        readings = linearised(problem.model, observed, clean.fit.x, columns)
        if residual is not None:
            readings = replace(readings, e=residual)
        width = prior_widths(clean.problem)[columns]
        B, e = readings.B.reshape(len(observed.value), -1) * width, readings.e.ravel()
        shared = noise is not None and (
            bool((noise.fit.common > 0).any()) or noise.fit.lasting is not None
        )
        if noise is None:
            B, e = problem.weights.apply(B), problem.weights.apply(e)
        else:
            own, weights = own_noise(noise.fit, readings)[0], weights_of(noise, readings)
            if shared and weights.whiten is not None:
                e = block_diagonal(own) @ (weights.whiten.T @ weights.beside(weights.apply(e)))
            root = block_diagonal(inverse_factor(own))
            B, e = root @ B, root @ e
        lead, fitted = observed.lead, [problem.model.parameters[c] for c in columns]
        own_places = {p.where.partition(":")[2] for p in fitted if p.effect == MarkerPosition.name}
        self.B, self.y = B.reshape(len(lead), observed.size, -1), e.reshape(len(lead), -1)
        self.off, self.good, self.names = readings.e[:, :3], good, [p.name for p in fitted]
        self.lines, self.marker = table.row[lead], np.array(table.marker_names)[table.marker[lead]]
        visited = np.array(table.configuration_labels)[table.configuration[lead]]
        by: list[tuple[Level, NDArray[Any]]] = [("marker", self.marker), ("configuration", visited)]
        self.groups = list[Group]()
        for level, labels in by[:1] if shared else by:
            names, code, count = np.unique(labels, return_inverse=True, return_counts=True)
            for k in np.flatnonzero((count > 1) & (2 * count < len(labels))):
                may_shift = level != "marker" or names[k] not in own_places
                self.groups.append(Group(level, str(names[k]), code == k, may_shift))

    @cached_property
    def tests(self) -> dict[Level, int]:
        lengths = (len(run) for _, run in self._ordered(self.marker))
        blocks: dict[Level, int] = {"block": sum(k * (k + 1) // 2 for k in lengths)}
        return {"reading": len(self.y), **Counter(g.level for g in self.groups), **blocks}

    def adjusted(self, p: float, level: Level) -> float:
        return min(1.0, p * self.tests[level] * len(self.tests))

    def _ordered(self, markers: NDArray[Any]) -> Iterator[tuple[str, IntArray]]:
        """In the order of the lines: all, and where there are several markers, each of
        `markers`."""
        order = np.argsort(self.lines, kind="stable")
        yield "", order
        if (self.marker != self.marker[0]).any():
            for m in np.unique(markers):
                yield f" of {m}", order[self.marker[order] == m]

    def _runs(self, beyond: BoolArray, active: BoolArray) -> Iterator[Group]:
        """Runs of active lines, of all markers and of each, at least half of them `beyond` the
        noise."""
        for of, order in self._ordered(self.marker[beyond]):
            for first, last in blocks(np.flatnonzero(beyond[order]).tolist()):
                run = np.zeros_like(active)
                run[order[first : last + 1]] = True
                run &= active
                if (beyond & run).sum() >= max(SMALLEST_BLOCK, run.sum() / 2):
                    a, b = self.lines[order[[first, last]]]
                    yield Group("block", f"{a} to {b}{of}", run)

    def blamed(self, fit: FitToGood, active: BoolArray) -> tuple[Group, float] | None:
        """The group that explains most, with its adjusted p-value; None where none is beyond noise.
        Where most of a group is beyond the noise, and that is no chance, all of it that is active
        is tested, else what is not beyond."""
        beyond, found = active & ~fit.good, []
        for group in (*self.groups, *self._runs(beyond, active)):
            present = active & group.members
            inside, outside = int((beyond & present).sum()), int((beyond & ~present).sum())
            count, others = int(present.sum()), int((active & ~present).sum())
            rate = (outside + 1) / (others + 1)
            chance = float(special.bdtrc(inside - 1, count, rate)) if inside else 1.0
            whole = 2 * inside >= count and self.adjusted(chance, group.level) < FALSE_ALARM
            used = present if whole else present & fit.good
            if used.sum() < 2 or (group.level == "block" and not whole):
                continue
            p, gain, *_ = group_test(fit, used, group.may_shift)
            if (p := self.adjusted(p, group.level)) < FALSE_ALARM:
                gain /= WORTH_A_BLOCK if group.level == "block" else 1.0
                found.append((gain, group._replace(members=present), p))
        return max(found, key=lambda one: one[0])[1:] if found else None

    def finding(self, fit: FitToGood, group: Group, p: float, beyond: int) -> FaultyGroup:
        # Change (p,) of the parameters in their standard deviations if the members were fitted
        # along as read; infinite of one that the good ones leave undetermined.
        _, _, G, c = _changed(fit, group.members & ~fit.good, 1)
        root, sigma = np.linalg.inv(fit.R), float(np.sqrt(fit.variance))
        deviation = np.linalg.norm(root, axis=1) * sigma
        move = np.where(deviation > OPEN, np.inf, np.abs(root @ np.linalg.solve(G, c)) / deviation)
        chosen, column = np.flatnonzero(group.members), int(np.argmax(move))
        pattern: Pattern = "single"
        shift, p_left = None, 0.0
        if group.level != "reading":
            *_, shift, p_left = group_test(fit, group.members, group.may_shift)
            pattern = "scatter" if shift is None else "common"
        if shift is None:
            square = ((e[chosen] ** 2).sum(axis=1).mean() for e in (fit.e, self.off))
            own, error = np.sqrt(list(square)).tolist()
        else:
            own = float(np.linalg.norm(shift))
            error = float(np.linalg.norm(np.median(self.off[chosen], axis=0)))
        return FaultyGroup(
            group.level, group.name, pattern, tuple(chosen.tolist()),
            tuple(self.lines[chosen].tolist()), beyond, error,
            own / sigma, p, float(move[column]), self.names[column], p_left,
        )  # fmt: skip


def report_faulty(
    whole: Solution, clean: Solution, noise: NoiseFit | None, good: BoolArray,
    residual: Array | None = None,
) -> OutlierReport | None:  # fmt: skip
    """The readings that are not `good` (N,), under the `noise` of the method, alone or as groups,
    and groups of good ones that err together; None for a table too large for B.

    Readings are linearised at a fit that faulty ones do not bend (`clean`), B and residual whitened
    by the noise of single readings, D.  Where a configuration's readings share a deviation, what is
    looked at is D V⁻¹ e, the residual less that deviation's best prediction, and configurations are
    not tested: that they deviate is part of the noise.  Where smooth functions were fitted,
    `residual` (N, size) is free of their part, and the ordinary parameters alone may follow a
    group's error.
    """
    if whole.problem.large:
        return None
    judged = _Judged(whole, clean, noise, good, residual)
    B, y, n = judged.B, judged.y, len(good)
    variance = max(median_scale(np.linalg.norm(y, axis=1), y.shape[1]) ** 2, TINY)
    active, accepted = np.ones(n, dtype=bool), []
    while True:
        fit = FitToGood(B, y, good & active, variance)
        blamed = judged.blamed(fit, active)
        if blamed is None or 2 * (active & ~blamed[0].members).sum() <= n:
            break
        group, p = blamed
        accepted.append((group, p, int((group.members & ~fit.good).sum())))
        active = active & ~group.members
    alone = fit.p_values(fit.T, fit.e, fit.good)
    for i in np.flatnonzero(active & ~fit.good):
        reading = Group("reading", str(judged.lines[i]), np.arange(n) == i)
        accepted.append((reading, judged.adjusted(float(alone[i]), "reading"), 1))
    findings = [judged.finding(fit, *one) for one in accepted]
    findings.sort(key=lambda f: (f.level == "reading", -f.sigmas))
    sigma = float(np.sqrt(fit.variance))
    return OutlierReport(tuple(findings), sigma, round(fit.dof), fit.good, judged.tests)


# Markers whose names are exchanged: readings that lie where another marker is.
#
# The names of the majority place base and markers.  A reading that is not where its own marker is,
# but where another one is, has that one's name.  How near a reading lies to the nearest marker says
# what the arm's own errors are, σ by the median; a reading farther off than χ₃ σ at FALSE_ALARM / n
# is not its marker's.  Where each of two markers lies where the cell states the other, the majority
# has them exchanged: the sums of squares of both, three numbers a marker, are compared by F.

MOST = 80  # % of the readings, which what they fit to is told of
FEWEST_POSES = 8  # base (6) and a marker (3) from fewer fit anything
MOST_READINGS, PASSES = 200_000, 10
# Poses err unlike each other: the other marker is near within this many limits, and this many times
# nearer.  A reading that is wrong by r is as near to it by chance once in (r/least)³.
BESIDE, NEARER = 3.0, 5.0
SHOWN = 6  # runs of lines, and configurations, that are named


def exchanged(model: Model, table: Measurements) -> tuple[IntArray, tuple[str, ...], str] | None:
    """Rows (k,) with the name of another marker, the markers mixed up, and what to do."""
    names, n = table.marker_names, len(table)
    few = n > MOST_READINGS or len(np.unique(table.q, axis=0)) < FEWEST_POSES
    if table.position is None or len(names) < 2 or few:
        return None
    flange, row = model.rigid.flange_poses(table), np.arange(n)
    marker, far = table.marker, np.sqrt(special.chdtri(3, FALSE_ALARM / n))
    for _ in range(PASSES):  # base and markers by the names as they should be
        found = Registration.of(model, replace(table, marker=marker))
        places = np.stack([found.places(flange, np.full(n, m)) for m in range(len(names))], axis=1)
        distance = np.linalg.norm(table.position[:, None] - places, axis=2)
        nearest = distance.argmin(axis=1)
        least = distance[row, nearest]
        limit = far * np.median(least) / np.sqrt(special.chdtri(3, 0.5))
        own = distance[row, table.marker]
        other = (own > limit) & (own > NEARER * least) & (least <= BESIDE * limit)
        before, marker = marker, np.where(other, nearest, table.marker)
        if np.array_equal(marker, before):
            break
    if np.percentile(distance[row, marker], MOST) > FITS:
        return None  # of an arm that fits nowhere readings lie near another marker by chance
    best, places, known = np.arange(len(names)), found.markers, model.cell.tool.markers
    pairs = list(combinations([m for m, name in enumerate(names) if name in known], 2))
    level = special.fdtri(6, 6, 1 - FALSE_ALARM / max(len(pairs), 1))
    for a, b in pairs:
        off = places[[a, b]] - np.array([known[names[m]] for m in (a, b)])
        crossed = places[[a, b]] - np.array([known[names[m]] for m in (b, a)])
        if (off**2).sum() > level * (crossed**2).sum():
            best[[a, b]] = best[[b, a]]
    meant = best[marker]
    rows = np.flatnonzero(meant != table.marker)
    if not len(rows):
        return None
    mixed = np.unique([*table.marker[rows], *meant[rows]])
    markers = tuple(names[m] for m in mixed)
    words = (
        f"Markers {listed(markers)} lie where [tool.markers_m] states each other: their names are "
        "exchanged in all rows of the table, or in the cell. Exchange them in one of the two."
    )
    if len(rows) < np.isin(table.marker, mixed).sum():
        lines = named_runs(table.row[rows].tolist())
        labels = dict.fromkeys(table.configuration_labels[c] for c in table.configuration[rows])
        words = (
            f"The names of markers {listed(markers)} are exchanged in {len(rows)} rows (lines "
            f"{listed(lines, SHOWN)}; configuration{'s' * (len(labels) > 1)} "
            f"{listed(labels, SHOWN)}): each reading there lies where the other marker is. "
            "Exchange the names in these rows."
        )
    return rows, markers, words


# Runs of rows in frames of their own: the tracker stood elsewhere, or the arm did.

CONVERT = "Measure common points from each station to convert them, or give each part by itself"


def in_one_frame(
    model: Model, table: Measurements, visit: IntArray
) -> tuple[str, Measurements] | None:
    """The table with runs of rows that fit the nominal arm each in a frame of its own brought into
    that of the first, after words that say so, {} being what it then fits to; None where there are
    no such runs.  `table` has positions; `visit` (n,) counts them in its order."""
    flange, position = model.rigid.flange_poses(table), np.array(table.position)
    starts, of = [0], list[Registration]()
    while (first := starts[-1]) < len(table):
        end = int(np.searchsorted(visit, visit[first] + FEWEST_POSES))
        for _ in range(2):  # of few poses, then of all that these have found
            found = Registration.of(model, table.take(np.arange(first, end)))
            places = found.places(flange[first:], table.marker[first:])
            off = np.linalg.norm(position[first:] - places, axis=1) > FITS
            # So that least of the run is off, and least of what follows is not.
            end = first + int(np.cumsum(np.r_[0, 2 * off - 1]).argmin())
            if end == first or visit[end - 1] - visit[first] + 1 < FEWEST_POSES:
                return None
        of.append(found)
        back = (position[first:end] - found.translation) @ found.rotation
        position[first:end] = back @ of[0].rotation.T + of[0].translation
        starts.append(end)
    if len(of) == 1:
        return None
    words = (
        f"from {listed([f'line {line}' for line in table.row[starts[1:-1]]])} on they stand in "
        "another frame, as of a tracker that was moved; brought into the first they would fit to "
        f"{{}}. {CONVERT}"
    )
    return words, replace(table, position=position)
