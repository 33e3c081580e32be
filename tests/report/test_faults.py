"""Groups of wrong readings in words: which, how far off, and what they do to the fit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from elastocal.identification.faulty_readings import FaultyGroup, OutlierReport
from elastocal.identification.outliers import Outlier
from elastocal.report.page import page_of

BLOCK = FaultyGroup(
    "block", "142 to 507", "common", tuple(range(366)), tuple(range(142, 508)), 366, 8.8, 8.8,
    1e-12, 23.0, 0,
)  # fmt: skip


def outliers(lines: range, residual: float = 4.5e-3) -> tuple[Outlier, ...]:
    return tuple(Outlier(line, "7", "M1", residual, 9.0) for line in lines)


def with_findings(result: Any, *findings: FaultyGroup, named: bool = True, **to: Any) -> Any:
    good = np.ones(len(result.observations.lead), dtype=bool)
    names = tuple(result.determined) if named else ()
    report = OutlierReport(findings, 1.0, 100, good, {}, 0.01, names)
    return replace(result, **{"method": "reml", "outliers": (), "excluded": ()} | to,
                   faulty_report=report)  # fmt: skip


def test_page_lists_every_group_beside_the_single_readings(case: Any, no_figures: None) -> None:
    groups = [replace(BLOCK, level="configuration", name=f"<b>{k}\x1b") for k in range(9)]
    page = page_of(with_findings(case.result, *groups, excluded=outliers(range(142, 508))))
    section = page[page.index("<summary>Outliers (366)") : page.index("<summary>Which conf")]
    assert section.count("<li>") == 9
    assert "at most 1 %" in section
    assert "and 266 more" in section
    assert "<b>" not in page
    assert "\x1b" not in page
