"""Which readings, markers, configurations and runs of lines lie beyond the noise.

All are judged against the fit of the majority: an MM-estimate, then least squares on what agrees
with it.  A reading is tested as if left out; a group by the error common to its readings, which
shows long before any one of them does, and by their errors whatever the direction.  Readings
beyond the noise count for their group only where they are most of it and far more frequent there
than elsewhere: scattered blunders make no bad marker.

The false-alarm rate holds for the whole report: it is shared between the levels tested, and
within a level between its tests (Bonferroni; for blocks between all possible runs of lines).  The
group that explains most is accepted first, its readings are set aside, and the rest is judged
anew, so that a displaced marker accuses neither each of its readings nor the configurations that
it was seen in.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from elastocal.errors import require
from elastocal.identification.outlier import FALSE_ALARM
from elastocal.identification.robust.design import Design, design
from elastocal.identification.robust.grouping import Group, Level, accepted_groups, groups_of
from elastocal.identification.robust.mm_estimate import mm_of
from elastocal.identification.robust.screening import CleanFit, Mask, screened

Array = NDArray[np.float64]


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
    pattern: Literal["single", "common", "scatter"]
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
    good: Mask
    tests: dict[str, int]
    false_alarm: float
    names: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, strings and lists; an unbounded influence is None."""
        listed = [asdict(f) for f in self.findings]
        for entry in listed:
            entry["readings"], entry["lines"] = list(entry["readings"]), list(entry["lines"])
            if not np.isfinite(entry["influence"]):
                entry["influence"] = None
            if self.names:
                entry["moves_most"] = self.names[entry.pop("column")]
        return {
            "findings": listed,
            "sigma": self.sigma,
            "dof": self.dof,
            "readings_used": int(self.good.sum()),
            "tests": dict(self.tests),
            "false_alarm": self.false_alarm,
        }


def outlier_report(
    B: ArrayLike,
    y: ArrayLike,
    *,
    size: int = 1,
    marker: ArrayLike | None = None,
    configuration: ArrayLike | None = None,
    line: ArrayLike | None = None,
    seed: int = 0,
    good: Mask | None = None,
    false_alarm: float = FALSE_ALARM,
) -> OutlierReport:
    """Find what is beyond the noise in y (n·size,) ≈ B (n·size, p) x, whitened.

    `marker` and `configuration` (n,) labels, `line` (n,) integer line of each observation (by
    default its number); a level without labels is not tested, and neither are groups of a single
    reading or of half the table.  `seed` fixes the search of the MM-estimate, `good` (n,) says
    which observations to rely on where that is known already; then nothing is searched for, and
    what is reported are the others, alone or as groups.

    Raises InputError for wrong shapes or dependent columns.
    """
    require(0 < false_alarm < 0.5, f"false_alarm lies between 0 and 0.5; found {false_alarm}")
    problem = design(B, y, size)
    n = problem.n
    lines = np.arange(n) if line is None else _labels("line", line, n)
    require(np.issubdtype(lines.dtype, np.integer), "line must hold integers")
    groups: list[Group] = []
    if marker is not None:
        groups += groups_of("marker", _labels("marker", marker, n))
    if configuration is not None:
        groups += groups_of("configuration", _labels("configuration", configuration, n))
    tests: dict[Level, int] = {"reading": n}
    for group in groups:
        tests[group.level] = tests.get(group.level, 0) + 1
    if line is not None:
        tests["block"] = n * (n + 1) // 2
    adjust = {level: count * len(tests) for level, count in tests.items()}

    if good is None:
        found, limit = mm_of(problem, seed), false_alarm / adjust["reading"]
        chosen = partial(screened, found, limit=limit)
    else:
        chosen = partial(_known, problem, good)
    fit, accepted = accepted_groups(chosen, n, groups, lines, adjust, false_alarm)
    findings = []
    active = np.ones(n, dtype=bool)
    for group, test, beyond in accepted:
        active &= ~group.members
        final = fit.group_test(group.members) or test  # against the fit without any of the others
        p = min(1.0, test.p_value * adjust[group.level])
        findings.append(
            _finding(fit, group, lines, beyond, p, final.shift if final.common else None)
        )
    p_reading = fit.reading_p()
    for i in np.flatnonzero(active & ~fit.good):
        alone = Group("reading", str(lines[i]), np.arange(n) == i)
        p = min(1.0, float(p_reading[i]) * adjust["reading"])
        findings.append(_finding(fit, alone, lines, 1, p, None))
    findings.sort(key=lambda f: (f.level == "reading", -f.sigmas))
    return OutlierReport(
        tuple(findings), problem.parameters(fit.z), fit.sigma, fit.dof, fit.good,
        {str(level): count for level, count in tests.items()}, false_alarm,
    )  # fmt: skip


def _known(problem: Design, good: Mask, active: Mask) -> CleanFit:
    return CleanFit(problem, good & active)


def _finding(
    fit: CleanFit,
    group: Group,
    lines: NDArray[np.int64],
    beyond: int,
    p: float,
    shift: Array | None,
) -> FaultyGroup:
    move = np.abs(fit.move(group.members))
    column = int(np.argmax(move))
    chosen = np.flatnonzero(group.members)
    error = float(np.sqrt((fit.e[chosen] ** 2).sum(axis=1).mean()))
    pattern: Literal["single", "common", "scatter"] = "scatter"
    if shift is not None:
        pattern, error = "common", float(np.linalg.norm(shift))
    elif group.level == "reading":
        pattern = "single"
    return FaultyGroup(
        group.level, group.name, pattern, tuple(chosen.tolist()), tuple(lines[chosen].tolist()),
        beyond, error, error / fit.sigma, p, float(move[column]), column,
    )  # fmt: skip


def _labels(name: str, given: ArrayLike, n: int) -> NDArray[Any]:
    labels = np.asarray(given)
    require(
        labels.shape == (n,), f"{name} needs one label per observation, ({n},); got {labels.shape}"
    )
    return labels
