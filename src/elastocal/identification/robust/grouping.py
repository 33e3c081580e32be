"""Groups of readings that may share an error: which of them to blame, and in what order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from elastocal.identification.outlier import blocks
from elastocal.identification.robust.screening import CleanFit, GroupTest, Mask

Level = Literal["reading", "marker", "configuration", "block"]

SMALLEST_BLOCK = 3
WORTH_A_BLOCK = 1.1  # a run of lines must explain that much more than the best named group


@dataclass(frozen=True)
class Group:
    """Observations `members` (n,) that may share an error."""

    level: Level
    name: str
    members: Mask


def groups_of(level: Level, labels: NDArray[Any]) -> list[Group]:
    """Every group with more than one reading and less than half of them."""
    names, code, count = np.unique(labels, return_inverse=True, return_counts=True)
    testable = np.flatnonzero((count > 1) & (2 * count < len(labels)))
    return [Group(level, str(names[k]), code == k) for k in testable]


def accepted_groups(
    clean_fit: Callable[[Mask], CleanFit],
    n: int,
    groups: list[Group],
    lines: NDArray[np.int64],
    adjust: dict[Level, int],
    false_alarm: float,
) -> tuple[CleanFit, list[tuple[Group, GroupTest, int]]]:
    """Groups beyond the noise, with how many of their readings are so alone, and the fit to the
    good readings outside them.

    One at a time, the one that explains most first, as long as a majority is left.  `adjust`
    holds the number of tests that a p-value of each level is multiplied by; runs of `lines` (n,)
    are tried where it has "block".  `clean_fit` makes the fit to the good ones among those (n,)
    that are still in question.
    """
    active = np.ones(n, dtype=bool)
    accepted: list[tuple[Group, GroupTest, int]] = []
    while True:
        fit = clean_fit(active)
        runs = _runs(fit, active, lines) if "block" in adjust else []
        tested = _tested(fit, active, groups + runs, adjust, false_alarm)
        significant = [t for t in tested if t[1].p_value * adjust[t[0].level] < false_alarm]
        if not significant:
            return fit, accepted
        group, test = max(significant, key=_weight)
        if 2 * (active & ~group.members).sum() <= n:
            return fit, accepted
        accepted.append((group, test, int((group.members & ~fit.good).sum())))
        active = active & ~group.members


def _runs(fit: CleanFit, active: Mask, lines: NDArray[np.int64]) -> list[Group]:
    """Runs of lines at least half of whose readings lie beyond the noise, and three or more."""
    beyond = active & ~fit.good
    found = []
    for first, last in blocks([int(k) for k in lines[beyond]]):
        run = active & (lines >= first) & (lines <= last)
        if (beyond & run).sum() >= max(SMALLEST_BLOCK, run.sum() / 2):
            found.append(Group("block", f"{first} to {last}", run))
    return found


def _tested(
    fit: CleanFit,
    active: Mask,
    groups: list[Group],
    adjust: dict[Level, int],
    false_alarm: float,
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
        whole = 2 * inside >= count and chance * adjust[group.level] < false_alarm
        if group.level == "block" and not whole:
            continue
        used = present if whole else present & fit.good
        test = fit.group_test(used) if used.sum() > 1 else None
        if test is not None:
            yield Group(group.level, group.name, present), test


def _weight(candidate: tuple[Group, GroupTest]) -> float:
    group, test = candidate
    return test.gain / (WORTH_A_BLOCK if group.level == "block" else 1.0)
