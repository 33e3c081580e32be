"""Terminal output: nothing undetermined looks known, nothing is cut off, names stay names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from elastocal.report.identification_view import (
    HALF_LENGTH,
    MIDDLE,
    bar_from_nominal,
    parameter_rows,
    texts,
)
from elastocal.report.terminal import parameter_table, print_result


def cells(table: Table) -> list[dict[str, str]]:
    """Rows of a table, column header → text."""
    columns = {str(c.header): [str(cell) for cell in c.cells] for c in table.columns}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def printed(width: int, *arguments: Any, **how: Any) -> str:
    console = Console(width=width, force_terminal=False)
    with console.capture() as capture:
        print_result(console, *arguments, **how)
    return capture.get()


def test_every_parameter_has_a_row_and_a_number_only_where_determined(case: Any) -> None:
    rows = cells(parameter_table(case.result))
    assert [row["parameter"] for row in rows] == list(case.result.model.names)
    for row, e in zip(rows, case.result.estimates, strict=True):
        if e.identifiable:
            assert float(row["value"]) == pytest.approx(float(texts(e, None)[0]))
            assert float(row["± 95 %"]) > 0
            assert row["note"] == ""
        else:
            assert (row["value"], row["± 95 %"]) == ("–", "–")
            assert row["note"].startswith(("held", "only as", "fixed"))


@pytest.mark.parametrize("width", [40, 60, 79, 80, 120, 200])
def test_no_number_is_cut_off_at_any_width(case: Any, width: int) -> None:
    text = printed(width, case.result, case.truth)
    assert max(map(len, text.splitlines())) <= width
    beginning = text[: text.index("Readings")]
    assert "…" not in beginning
    joined = "".join(beginning.split())
    for e in case.result.estimates:
        if e.identifiable and width >= 60:
            assert texts(e, None)[0] in joined
    for e in case.result.estimates if width >= 60 else ():
        assert e.name in text or not e.identifiable  # nothing breaks inside a name


def test_held_values_are_never_printed(case: Any) -> None:
    """Rows of undetermined parameters hold a dash; their held values appear nowhere as estimates.

    The first member of a combination has a held value that is the combination's value, so only
    rows of the parameter table are looked at.
    """
    for row, e in zip(cells(parameter_table(case.result)), case.result.estimates, strict=True):
        if not e.identifiable:
            assert not any(ch.isdigit() for ch in row["value"] + row["± 95 %"])


def test_names_are_not_markup_and_not_terminal_commands(hostile: Any) -> None:
    text = printed(160, hostile.result, hostile.truth)
    assert "\x1b" not in text
    assert "[red]$x^2$" in text
    assert "<script>alert(1)</script>" in text


def test_bars_reach_where_the_interval_does(case: Any) -> None:
    known = next(e for e in case.result.estimates if e.identifiable)
    one_sided = replace(known, value=1.0, ci95=(1.0, 3.0))

    def bar(e: Any, true: float) -> Any:
        result = replace(case.result, estimates=(e,), combinations=())
        (row,) = parameter_rows(result, {e.name: true})
        return row.bar

    found = bar(one_sided, 1.0)
    assert found.low == found.value == MIDDLE
    assert found.high == pytest.approx(MIDDLE + 2 * HALF_LENGTH / 2.5)
    found = bar(replace(one_sided, ci95=(-np.inf, 3.0)), 1.0)
    assert found.low == MIDDLE - HALF_LENGTH < found.value < found.high < MIDDLE + HALF_LENGTH
    assert bar(replace(one_sided, ci95=(-np.inf, np.inf)), 1.0) is None
    found = bar_from_nominal(1.0, (1.0, 3.0), 2.0)
    assert found is not None
    reach = pytest.approx(HALF_LENGTH / 1.05, abs=0.06)
    assert MIDDLE - found.low == reach
    assert found.high - MIDDLE == reach
