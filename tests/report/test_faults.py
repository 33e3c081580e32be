"""Groups of wrong readings in words: which, how far off, and what they do to the fit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from elastocal.identification.faulty_readings import FaultyGroup, OutlierReport
from elastocal.identification.outliers import Outlier
from elastocal.report.identification_view import summary_lines
from elastocal.report.method_and_noise import MOST_TOLD, fault_lines
from elastocal.report.page import page_of

BLOCK = FaultyGroup(
    "block", "142 to 507", "common", tuple(range(366)), tuple(range(142, 508)), 366, 8.8, 8.8,
    1e-12, 23.0, 0,
)  # fmt: skip


def outliers(lines: range, residual: float = 4.5e-3) -> tuple[Outlier, ...]:
    return tuple(Outlier(line, "7", "M1", residual, 9.0) for line in lines)


def with_findings(result: Any, *findings: FaultyGroup, named: bool = True, **to: Any) -> Any:
    n = len(result.determined)
    good = np.ones(len(result.observations.lead), dtype=bool)
    names = tuple(result.determined) if named else ()
    report = OutlierReport(findings, np.zeros(n), 1.0, 100, good, {}, 0.01, names)
    return replace(result, **{"method": "reml", "outliers": (), "excluded": ()} | to,
                   faulty_report=report)  # fmt: skip


def test_block_that_was_set_apart(case: Any) -> None:
    result = with_findings(case.result, BLOCK, excluded=outliers(range(142, 508)))
    assert fault_lines(result) == [
        "Block of lines 142 to 507: 366 readings err in common by 4.50 mm (8.8 times the noise); "
        f"fitted along they would move {case.result.determined[0]} by 23 standard deviations."
    ]


def test_millimetres_only_where_the_readings_are_listed_and_do_not_bend_the_fit(
    case: Any, pose: Any
) -> None:
    every = outliers(range(142, 508))

    def line(result: Any, **to: Any) -> str:
        return fault_lines(with_findings(result, BLOCK, **to))[0]

    assert "by 4.50 mm" in line(case.result, outliers=every, method="tukey")
    for other in (
        line(case.result, excluded=every[:100]),
        line(case.result, outliers=every),
        line(pose.result, excluded=every),
    ):
        assert "err in common by 8.8 times the noise;" in other
    assert "in the fit they move" in line(case.result, outliers=every)
    assert "would move" in line(case.result, outliers=every, method="tukey")
    marker = replace(BLOCK, level="marker", name="M1", pattern="scatter", beyond=200)
    mixed = outliers(range(142, 325), 3e-3) + outliers(range(325, 508), 4e-3)
    (text,) = fault_lines(with_findings(case.result, marker, excluded=mixed))
    assert text.startswith("Marker M1: 366 readings scatter by 3.54 mm (")
    assert "200 of them beyond the noise alone" in text


def test_parameter_is_named_where_the_report_knows_its_name(case: Any) -> None:
    (text,) = fault_lines(with_findings(case.result, BLOCK, named=False))
    assert "move a parameter by 23" in text
    unknown = replace(BLOCK, influence=float("inf"))
    (text,) = fault_lines(with_findings(case.result, unknown))
    assert text.endswith(f"the other readings leave {case.result.determined[0]} undetermined.")


def test_terminal_names_few_and_counts_the_rest(case: Any) -> None:
    single = replace(BLOCK, level="reading", pattern="single", lines=(3,), name="3")
    groups = [replace(BLOCK, level="configuration", name=str(k)) for k in range(MOST_TOLD + 2)]
    summary = summary_lines(with_findings(case.result, *groups, single))
    lines = [text for label, text in summary if label == "Faulty"]
    assert len(lines) == MOST_TOLD + 1
    assert lines[0].startswith("Configuration 0: ")
    assert lines[-1] == "And 2 more."
    assert fault_lines(with_findings(case.result, single)) == []
    assert fault_lines(replace(case.result, faulty_report=None)) == []


def test_page_lists_every_group_beside_the_single_readings(case: Any, no_figures: None) -> None:
    groups = [replace(BLOCK, level="configuration", name=f"<b>{k}\x1b") for k in range(9)]
    page = page_of(with_findings(case.result, *groups, excluded=outliers(range(142, 508))))
    section = page[page.index("<h2>Faulty readings") : page.index("<h2>To repeat")]
    assert section.count("<li>") == 9
    assert "at most 1 %" in section
    assert "and 266 more" in section
    assert "<b>" not in page
    assert "\x1b" not in page


@pytest.mark.parametrize("level", ["block", "marker", "configuration"])
def test_group_without_a_reading_beyond_the_noise(case: Any, level: Any, no_figures: None) -> None:
    result = with_findings(case.result, replace(BLOCK, level=level, beyond=0))
    assert ", none of them beyond the noise alone" in fault_lines(result)[0]
    page = page_of(result)
    assert "No single reading lies beyond" in page


def test_shifted_lines_of_a_real_table_are_told_as_a_block(shifted: Any) -> None:
    (text,) = fault_lines(shifted.result)
    assert text.startswith("Block of lines 11 to 16: 6 readings err in common by 4.1")
