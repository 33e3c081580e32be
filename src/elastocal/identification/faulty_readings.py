"""What is wrong with the readings: single ones, a marker, a configuration, a run of lines."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.errors import ElastocalError
from elastocal.identification.noise_choice import NoiseFit, linearised, weights_of
from elastocal.identification.noisy_readings import own_noise
from elastocal.identification.outliers import FALSE_ALARM, blocks, studentised
from elastocal.identification.residuals import f_test
from elastocal.identification.robust import Design, design
from elastocal.identification.solve import Solution
from elastocal.identification.weighted_problem import block_diagonal, inverse_factor
from elastocal.model.effects.placements import MarkerPosition
from elastocal.model.manipulator import Model
from elastocal.units import Array, BoolArray, IntArray

# Tests of single readings and of groups against the fit to the readings held to be good.

ABSORBED = 1e-6  # share of a group's error that must be left after the model has followed it
NOTHING = 1e-9  # share of a direction's information below which it is undetermined


@dataclass(frozen=True)
class GroupTest:
    """Two F-tests of a group: of one error `shift` (size,) common to its readings, and of any.

    `p_common` and `p_any` are their p-values (1 where untestable), `gain` what the more telling
    of the two takes off the rss beyond what noise would.  `common` says whether the shift
    explains at least half of what is wrong; if not, the readings err in different directions.
    """

    shift: Array
    p_common: float
    p_any: float
    gain: float
    common: bool

    @property
    def p_value(self) -> float:
        """The smaller of the two, for two tests."""
        return min(1.0, 2 * min(self.p_common, self.p_any))


class CleanFit:
    """Least squares on the `good` observations (n,), and tests of everything against it.

    `T` (n, size, p) are the rows of B in coordinates where those of the good ones are
    orthonormal, so that T_i T_jᵀ is the covariance of two predictions in units of σ²; directions
    that the good ones leave undetermined have none.  `e` (n, size) is y less its prediction.
    """

    def __init__(self, problem: Design, good: BoolArray) -> None:
        n, size, p = problem.n, problem.size, problem.p
        Q3 = problem.Q.reshape(n, size, p)
        Qg = Q3[good].reshape(-1, p)
        values, vectors = np.linalg.eigh(Qg.T @ Qg)
        known = values > NOTHING
        self.problem, self.good = problem, good
        self.to_z = vectors[:, known] / np.sqrt(values[known])
        self.T = Q3 @ self.to_z
        open_ = np.abs(Q3 @ vectors[:, ~known]).max(axis=(1, 2), initial=0.0)
        self.undetermined: BoolArray = open_ > np.sqrt(NOTHING)
        y = problem.y.reshape(n, size)
        fitted = np.einsum("nij,ni->j", self.T[good], y[good])
        self.z = self.to_z @ fitted
        self.e = y - self.T @ fitted
        self.rss = float((self.e[good] ** 2).sum())
        self.dof = int(good.sum()) * size - int(known.sum())

    @property
    def sigma(self) -> float:
        """Standard deviation of a whitened row."""
        return max(float(np.sqrt(self.rss / max(self.dof, 1))), self.problem.floor)

    def reading_p(self) -> Array:
        """p-value (n,) of every observation's error, as if it had been left out of the fit.

        A good one has eᵀ(I − H)⁻¹e, any other eᵀ(I + H)⁻¹e; both over size · s², s² without the
        observation, follow F.  1 where the others do not predict it.
        """
        size = self.problem.size
        drop = studentised(self.T, self.e, self.good, np.zeros((len(self.e), size, 0)))
        drop[self.undetermined] = 0.0
        dof = self.dof - size * self.good
        floor = len(drop) * self.problem.floor**2
        rest = np.maximum(self.rss - np.where(self.good, drop, 0.0), floor)
        p = f_test(drop, size, rest, np.maximum(dof, 1))[1]
        return np.where(dof < 1, 1.0, p)

    def group_test(self, members: BoolArray, may_shift: bool = True) -> GroupTest | None:
        """Test the observations `members` (n,) together, whether good ones or not; for a common
        shift only where they `may_shift`.

        With A = Σ T_iᵀT_i over the good ones less or plus the members, the model is fitted with
        them (rss₁), without them (rss₀), and with them and a common shift (rss₁ − gain):

            F_common = (gain/size)/((rss₁ − gain)/dof),   F_any = ((rss₁ − rss₀)/m)/(rss₀/dof₀)

        None where they touch what the others leave undetermined, or where the model's own
        parameters absorb a shift (the position of a marker that is itself fitted) and any error.
        """
        if (self.undetermined & members).any():
            return None
        size, n = self.problem.size, int(members.sum())
        floor = len(self.e) * self.problem.floor**2
        rss_with, dof_with, G, c = self._changed(members & ~self.good, 1.0)
        S, e = self.T[members].sum(axis=0), self.e[members].sum(axis=0)
        solved = np.linalg.solve(G, np.column_stack([S.T, c]))
        M = n * np.eye(size) - S @ solved[:, :size]
        shift, gain, p_common = np.zeros(size), 0.0, 1.0
        if may_shift and dof_with > size and np.linalg.eigvalsh(M)[0] > ABSORBED * n:
            b = e - S @ solved[:, size]
            shift = np.linalg.solve(M, b)
            gain = float(b @ shift)
            p_common = float(f_test(gain, size, max(rss_with - gain, floor), dof_with - size)[1])
        excess, p_any = 0.0, 1.0
        rss_without, dof_without, G, _ = self._changed(members & self.good, -1.0)
        if dof_without > 0 and np.linalg.eigvalsh(G)[0] > ABSORBED:
            drop, rest = max(rss_with - rss_without, 0.0), max(rss_without, floor)
            p_any = float(f_test(drop, n * size, rest, dof_without)[1])
            excess = drop - n * size * rest / dof_without
        if p_common == p_any == 1.0:
            return None
        common = may_shift and gain >= excess / 2
        return GroupTest(shift, p_common, p_any, max(gain, excess), common)

    def _changed(self, members: BoolArray, sign: float) -> tuple[float, int, Array, Array]:
        """rss, dof, Σ TᵀT and Σ Tᵀe of the fit with `members` added (+1) or removed (−1)."""
        T, e = self.T[members], self.e[members]
        G = np.eye(self.T.shape[2]) + sign * np.einsum("nij,nik->jk", T, T)
        c = np.einsum("nij,ni->j", T, e)
        rss = self.rss + sign * float((e**2).sum())
        if np.linalg.eigvalsh(G)[0] > ABSORBED:
            rss -= float(c @ np.linalg.solve(G, c))
        return max(rss, 0.0), self.dof + int(sign) * e.size, G, c

    def move(self, members: BoolArray) -> Array:
        """Change (p,) of x̂ in its standard deviations if `members` were fitted along as read.

        Infinite where they touch what the good ones leave undetermined.
        """
        extra = members & ~self.good
        if (self.undetermined & extra).any():
            return np.full(self.problem.p, np.inf)
        Tx = self.T[extra]
        G = np.eye(self.T.shape[2]) + np.einsum("nij,nik->jk", Tx, Tx)
        moved = np.linalg.solve(G, np.einsum("nij,ni->j", Tx, self.e[extra]))
        P = self.problem.V @ self.to_z
        return P @ moved / (self.sigma * np.linalg.norm(P, axis=1))


# Groups of readings that may share an error: which of them to blame, and in what order.

Level = Literal["reading", "marker", "configuration", "block"]
Pattern = Literal["single", "common", "scatter"]

SMALLEST_BLOCK = 3
WORTH_A_BLOCK = 1.1  # a run of lines must explain that much more than the best named group


@dataclass(frozen=True)
class Group:
    """Observations `members` (n,) that may share an error, and whether that may be one shift,
    common to all.

    A marker whose position is fitted has none: what its readings then have in common is an error
    of the arm, which they see as the others do.
    """

    level: Level
    name: str
    members: BoolArray
    may_shift: bool = True


def groups_of(
    level: Level, labels: NDArray[Any] | None, without_shift: Collection[str] = ()
) -> list[Group]:
    """Every group with more than one reading and less than half of them."""
    if labels is None:
        return []
    names, code, count = np.unique(labels, return_inverse=True, return_counts=True)
    testable = np.flatnonzero((count > 1) & (2 * count < len(labels)))
    return [Group(level, str(names[k]), code == k, names[k] not in without_shift) for k in testable]


def accepted_groups(
    problem: Design,
    good: BoolArray,
    groups: list[Group],
    lines: NDArray[np.int64],
    adjust: dict[Level, int],
) -> tuple[CleanFit, list[tuple[Group, GroupTest, int]]]:
    """Groups beyond the noise, with how many of their readings are so alone, and the fit to the
    good readings outside them.

    One at a time, the one that explains most first, as long as a majority is left.  `adjust`
    holds the number of tests that a p-value of each level is multiplied by; runs of `lines` (n,)
    are tried as well.
    """
    n, active = problem.n, np.ones(problem.n, dtype=bool)
    accepted: list[tuple[Group, GroupTest, int]] = []
    while True:
        fit = CleanFit(problem, good & active)
        runs = _runs(fit, active, lines)
        tested = _tested(fit, active, groups + runs, adjust)
        significant = [t for t in tested if t[1].p_value * adjust[t[0].level] < FALSE_ALARM]
        if not significant:
            return fit, accepted
        group, test = max(significant, key=_weight)
        if 2 * (active & ~group.members).sum() <= n:
            return fit, accepted
        accepted.append((group, test, int((group.members & ~fit.good).sum())))
        active = active & ~group.members


def _runs(fit: CleanFit, active: BoolArray, lines: NDArray[np.int64]) -> list[Group]:
    """Runs of lines at least half of whose readings lie beyond the noise, and three or more."""
    beyond = active & ~fit.good
    found = []
    for first, last in blocks([int(k) for k in lines[beyond]]):
        run = active & (lines >= first) & (lines <= last)
        if (beyond & run).sum() >= max(SMALLEST_BLOCK, run.sum() / 2):
            found.append(Group("block", f"{first} to {last}", run))
    return found


def _tested(
    fit: CleanFit, active: BoolArray, groups: list[Group], adjust: dict[Level, int]
) -> Iterator[tuple[Group, GroupTest]]:
    """Tests of all groups still active, on all of their readings where most are beyond the noise
    and that is no chance, else on those that are not."""
    beyond = active & ~fit.good
    for group in groups:
        present = active & group.members
        inside, outside = int((beyond & present).sum()), int((beyond & ~present).sum())
        count, others = int(present.sum()), int((active & ~present).sum())
        rate = (outside + 1) / (others + 1)
        chance = float(special.bdtrc(inside - 1, count, rate)) if inside else 1.0
        whole = 2 * inside >= count and chance * adjust[group.level] < FALSE_ALARM
        if group.level == "block" and not whole:
            continue
        used = present if whole else present & fit.good
        test = fit.group_test(used, group.may_shift) if used.sum() > 1 else None
        if test is not None:
            yield Group(group.level, group.name, present, group.may_shift), test


def _weight(candidate: tuple[Group, GroupTest]) -> float:
    group, test = candidate
    return test.gain / (WORTH_A_BLOCK if group.level == "block" else 1.0)


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


@dataclass(frozen=True)
class FaultyGroup:
    """One thing that is wrong.

    `readings` (k,) indices of its observations and `lines` their lines; `beyond` how many of
    these lie beyond the noise on their own.  `pattern` says whether a group errs in common, a
    displacement, or by scatter; `error` is the length of the common error or the rms length, in
    the units of y, `sigmas` the same over the noise of a row.  `p_value` is adjusted for all
    tests of the report.  `influence` is the largest change of a parameter, in its standard
    deviations, if the readings were fitted along, and `column` that parameter.
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
    column: int


@dataclass(frozen=True)
class OutlierReport:
    """Findings, groups before readings and the largest first, and what is left without them.

    `x` (p,) is the estimate without them and `sigma` the noise of a whitened row.  `tests` says
    how many were made per level, `good` (n,) which observations x rests on, `names` (p,) those of
    the parameters where they have any.
    """

    findings: tuple[FaultyGroup, ...]
    x: Array
    sigma: float
    dof: int
    good: BoolArray
    tests: dict[Level, int]
    false_alarm: float = FALSE_ALARM
    names: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; an unbounded influence is None."""
        listed = [asdict(f) for f in self.findings]
        for entry in listed:
            entry |= {"readings": list(entry["readings"]), "lines": list(entry["lines"])}
            if not np.isfinite(entry["influence"]):
                entry["influence"] = None
            if self.names:
                entry["moves_most"] = self.names[entry.pop("column")]
        return {
            "findings": listed, "sigma": self.sigma, "dof": self.dof,
            "readings_used": int(self.good.sum()), "tests": dict(self.tests),
            "false_alarm": self.false_alarm,
        }  # fmt: skip


def outlier_report(
    problem: Design,
    good: BoolArray,
    lines: NDArray[np.int64],
    marker: NDArray[Any] | None = None,
    configuration: NDArray[Any] | None = None,
    fitted_markers: Collection[str] = (),
) -> OutlierReport:
    """What is wrong with the readings of y ≈ B x, whitened.

    `good` (n,) says which observations to rely on; reported are the others, alone or as groups,
    and groups of good ones that err together.

    Markers whose positions are among the parameters, `fitted_markers`, have no common shift.
    `marker` and `configuration` (n,) are labels, `lines` (n,) the line of each observation; a
    level without labels is not tested, nor are groups of a single reading or of half the table.
    """
    n = problem.n
    groups = groups_of("marker", marker, fitted_markers)
    groups += groups_of("configuration", configuration)
    tests: dict[Level, int] = {"reading": n}
    for group in groups:
        tests[group.level] = tests.get(group.level, 0) + 1
    tests["block"] = n * (n + 1) // 2
    adjust = {level: count * len(tests) for level, count in tests.items()}

    fit, accepted = accepted_groups(problem, good, groups, lines, adjust)
    p_reading, left, findings = fit.reading_p(), np.ones(n, dtype=bool), []
    for group, test, beyond in accepted:
        left &= ~group.members
        # Against the fit without any of the others.
        final = fit.group_test(group.members, group.may_shift) or test
        shift = final.shift if final.common else None
        p = min(1.0, test.p_value * adjust[group.level])
        findings.append(_finding(fit, group, lines, beyond, p, shift))
    for i in np.flatnonzero(left & ~fit.good):
        alone = Group("reading", str(lines[i]), np.arange(n) == i)
        p = min(1.0, float(p_reading[i]) * adjust["reading"])
        findings.append(_finding(fit, alone, lines, 1, p, None))
    findings.sort(key=lambda f: (f.level == "reading", -f.sigmas))
    return OutlierReport(
        tuple(findings), problem.V @ fit.z, fit.sigma, fit.dof, fit.good, dict(tests)
    )


def _finding(
    fit: CleanFit, group: Group, lines: NDArray[np.int64], beyond: int, p: float,
    shift: Array | None,
) -> FaultyGroup:  # fmt: skip
    move = np.abs(fit.move(group.members))
    column = int(np.argmax(move))
    chosen = np.flatnonzero(group.members)
    error = float(np.sqrt((fit.e[chosen] ** 2).sum(axis=1).mean()))
    pattern: Pattern = "single" if group.level == "reading" else "scatter"
    if shift is not None:
        pattern, error = "common", float(np.linalg.norm(shift))
    return FaultyGroup(
        group.level, group.name, pattern, tuple(chosen.tolist()), tuple(lines[chosen].tolist()),
        beyond, error, error / fit.sigma, p, float(move[column]), column,
    )  # fmt: skip


# The readings of an identification, under the noise that its method found.


def report_faulty(
    whole: Solution,
    clean: Solution,
    noise: NoiseFit | None,
    good: BoolArray,
    residual: Array | None = None,
) -> OutlierReport | None:
    """The report of the readings that are not `good` (N,), under the `noise` of the method.

    Readings are linearised at a fit that faulty ones do not bend (`clean`), B and residual whitened
    by the noise of single readings, D.  Where a configuration's readings share a deviation, what is
    looked at is D V⁻¹ e, the residual less that deviation's best prediction, and configurations are
    not tested: that they deviate is part of the noise.

    Where smooth functions were fitted, `residual` (N, size) is free of their part in it, and the
    ordinary parameters alone may follow a group's error.

    None for a table too large for B, and where the good readings do not determine the fit.
    """
    problem, columns = whole.problem, clean.fit.columns
    if residual is not None:
        columns = columns[~np.isin(columns, clean.reduction.with_prior)]
    if problem.large:
        return None
    observed, table = problem.observations, problem.observations.table
    readings = linearised(problem.model, observed, clean.fit.x, columns)
    if residual is not None:
        readings = readings.moved(residual)
    size = clean.sizes[columns]
    B, e = readings.B.reshape(len(observed.value), -1) * size, readings.e.ravel()
    shared = noise is not None and (bool((noise.fit.common > 0).any()) or noise.lasting is not None)
    if noise is None:
        B, e = problem.weights.apply(B), problem.weights.apply(e)
    else:
        own, whiten = own_noise(noise.fit, readings)[0], weights_of(noise, readings).whole
        if shared and whiten is not None:
            e = block_diagonal(own) @ (whiten.T @ (whiten @ e))
        root = block_diagonal(inverse_factor(own))
        B, e = root @ B, root @ e
    lead = observed.lead
    marker = _labels(table.marker_names, table.marker[lead])
    visited = _labels(table.configuration_labels, table.configuration[lead])
    try:
        report = outlier_report(
            design(B, e, observed.size), good, table.row[lead], marker,
            None if shared else visited, _fitted_markers(problem.model, columns),
        )  # fmt: skip
    except (ElastocalError, np.linalg.LinAlgError):
        return None
    return replace(report, names=tuple(problem.model.names[c] for c in columns))


def _fitted_markers(model: Model, columns: NDArray[np.int64]) -> set[str]:
    """Names of the markers whose positions are among the fitted parameters."""
    fitted = [model.parameters[c] for c in columns]
    return {p.where.partition(":")[2] for p in fitted if p.effect == MarkerPosition.name}


def _labels(names: tuple[str, ...], codes: IntArray) -> NDArray[Any] | None:
    """Labels (N,), None where all are the same."""
    return np.array(names)[codes] if len(np.unique(codes)) > 1 else None
