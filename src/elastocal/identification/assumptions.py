"""What an identification takes for granted, looked at: findings of their own, each by a test.

Copies among the readings, loads in another unit, parameters that the readings hardly show, scatter
and drift that the weights leave out.  Each is found by chance in at most one clean table of a
hundred, or says nothing of chance at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from elastocal.identification.mistakes import CELL, KILOGRAMS, load_ratio
from elastocal.identification.noise_structure import JOINTS, TIME
from elastocal.identification.result import Calibration, Finding

LEVEL = 0.01  # p-value below which scatter and drift are there


def assumption_findings(result: Calibration, explained: bool) -> Iterator[Finding]:
    """All of these findings, those on the readings first; `explained`: the noise explains what the
    fit leaves."""
    yield from _copies(result)
    yield from _load_unit(result)
    yield from _hardly_shown(result)
    yield from _left_out(result)
    yield from _alike_in_time(result, explained)


def _copies(result: Calibration) -> Iterator[Finding]:
    if result.copies:
        n = len(result.copies)
        yield Finding(
            "copied_readings", "note",
            {"copies": n, "fitted": len(result.observations.lead), "lines": result.copies},
            "Find out how lines came to be in the table twice; readings that were rounded until "
            "they agree should be given with all their digits.",
        )  # fmt: skip


def _load_unit(result: Calibration) -> Iterator[Finding]:
    """Are all compliances about as much too large as kilograms for newtons make them, or too small?

    Without a load there is no unit of one.  On the scale of the logarithm the ratio has to lie
    nearer to that factor than to one.  By the links' weights alone, a rule of thumb, it is worth a
    look, and no more.
    """
    if not result.observations.table.force.any():
        return
    known = {e.name: e.value for e in result.ordinary if e.value is not None}
    found = load_ratio(result.model, known)
    if found is None:
        return
    ratio, by = found
    nearer = abs(abs(math.log(ratio)) - math.log(KILOGRAMS)) < math.log(KILOGRAMS) / 2
    if not nearer:
        return
    unit = "kilograms" if ratio > 1 else "newtons times 9.81"
    yield Finding(
        "load_unit", "care" if by == CELL else "note", {"ratio": ratio, "by": by, "unit": unit},
        f"Check the unit of the loads: the compliances are {ratio:.2g} times what {by} let expect, "
        f"as where forces in N hold {unit}.",
    )  # fmt: skip


def _hardly_shown(result: Calibration) -> Iterator[Finding]:
    names = tuple(e.name for e in result.ordinary if e.limits is not None)
    if names:
        yield Finding(
            "hardly_shown", "note", {"parameters": names},
            "Measure poses and loads that strain what the readings hardly show (elastocal design "
            "plans them), or give it a prior.",
        )  # fmt: skip


def _left_out(result: Calibration) -> Iterator[Finding]:
    """Scatter of joints, or drift, that a test finds and the noise model does not have."""
    sizes = result.noise.sizes or ()
    counted = {JOINTS: any(s.of_joints and s.sigma for s in sizes),
               TIME: result.noise.drift is not None}  # fmt: skip
    for test in result.noise.tests:
        if test.p < LEVEL and not counted.get(test.part, True):
            yield Finding(
                "scatter_not_counted", "care",
                {"part": "joints" if test.part == JOINTS else "time", "p": test.p},
                "Ask what the model lacks (elastocal diagnose): residuals change from visit to "
                "visit or in time, and noise that does so does not predict poses better.",
            )  # fmt: skip


def _alike_in_time(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Residuals of visits that follow each other, by a permutation test.

    Where the noise explains the residual, what they share is a small part of it, for which the
    error at new poses has room.
    """
    found = result.autocorrelation
    if found is None or found.p >= LEVEL:
        return
    counted = result.noise.drift is not None
    yield Finding(
        "autocorrelated", "note" if counted or explained else "care",
        {
            "lag1": found.correlations[0], "p": found.p, "visits": found.visits, "by": found.by,
            "counted": "yes" if counted else "no",
        },
        ""
        if counted
        else "Visit poses and loads in random order and return to a reference pose every ten "
        "poses: residuals of visits that follow each other are alike, as where something drifts, "
        "or where the model lacks what neighbouring poses have in common.",
    )  # fmt: skip
