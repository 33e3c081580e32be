"""Terminal output: nothing undetermined looks known, nothing is cut off, names stay names."""

from __future__ import annotations

import re
from typing import Any

import pytest
from rich.console import Console
from support.diagnoses import VERDICTS

from elastocal.report.blocks import ShownTable
from elastocal.report.identification_view import parameter_table, texts, undetermined_table
from elastocal.report.terminal import print_report


def cells(table: ShownTable) -> list[dict[str, str]]:
    """Rows of a table, column header → text."""
    return [dict(zip(table.heads, row, strict=True)) for row in table.rows]


def printed(width: int, *arguments: Any, **how: Any) -> str:
    console = Console(width=width, force_terminal=False)
    with console.capture() as capture:
        print_report(console, *arguments, **how)
    return capture.get()


def test_every_parameter_has_a_row_and_a_number_only_where_determined(case: Any) -> None:
    known = {row["parameter"]: row for row in cells(parameter_table(case.result))}
    others = {row["parameter"]: row for row in cells(undetermined_table(case.result))}
    assert set(known) | set(others) == set(case.result.model.names)
    for e in case.result.estimates:
        assert (e.name in known) == e.identifiable != (e.name in others)
        if e.identifiable:
            assert float(known[e.name]["value"]) == pytest.approx(float(texts(e, None)[0]))
            assert float(known[e.name]["± 95 %"]) > 0
        else:
            assert others[e.name]["why"].startswith(("held", "only as", "fixed"))


@pytest.mark.parametrize("width", [40, 60, 79, 80, 120, 200])
def test_no_number_is_cut_off_at_any_width(case: Any, width: int) -> None:
    text = printed(width, case.result, truth=case.truth)
    assert max(map(len, text.splitlines())) <= width
    beginning = text[: text.index("Readings")]
    assert "…" not in beginning
    joined = "".join(beginning.split())
    for e in case.result.estimates:
        if e.identifiable and width >= 60:
            assert texts(e, None)[0] in joined
    for e in case.result.estimates if width >= 60 else ():
        assert e.name in text or not e.identifiable  # nothing breaks inside a name


def test_names_are_not_markup_and_not_terminal_commands(hostile: Any) -> None:
    text = printed(160, hostile.result, truth=hostile.truth)
    assert "\x1b" not in text
    assert "[red]$x^2$" in text
    assert "<script>alert(1)</script>" in text


def test_digits_go_with_the_uncertainty(case: Any) -> None:
    """The last digit of a value is that of its half width, of which one or two are told."""
    found = re.findall(r"^ ?joint\d\.\S+ +(-?[\d.]+) +([\d.]+) +m?", str(case.result), re.MULTILINE)
    assert found
    for value, half in found:
        assert len(value.partition(".")[2]) == len(half.partition(".")[2])
        assert len(half.replace(".", "").lstrip("0")) <= 2


@pytest.mark.parametrize("name", VERDICTS)
def test_a_diagnosis_fits_and_obeys_no_control_character(name: str) -> None:
    text = printed(60, VERDICTS[name])
    assert max(map(len, text.splitlines())) <= 60
    assert "\x1b" not in text
    words = " ".join(text.split())
    for part in ("Verdict:", "Error budget", "rank 1 to 8 of 10", "Noise:", "Next:"):
        assert part in words
