"""Terminal output: nothing undetermined looks known, nothing is cut off, names stay names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from elastocal.identification.findings import standings
from elastocal.identification.result import Combination
from elastocal.report.identification_view import (
    HALF_LENGTH,
    MIDDLE,
    bar_from_nominal,
    combination_truth,
    inside,
    leading_lines,
    parameter_rows,
    shortened,
    summary_lines,
    texts,
)
from elastocal.report.judgement_view import SECTIONS, judgement
from elastocal.report.terminal import FEW, combination_table, parameter_table, print_result
from elastocal.text import listed


def cells(table: Table) -> list[dict[str, str]]:
    """Rows of a table, column header → text."""
    columns = {str(c.header): [str(cell) for cell in c.cells] for c in table.columns}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def printed(width: int, *arguments: Any, **how: Any) -> str:
    console = Console(width=width, force_terminal=False)
    with console.capture() as capture:
        print_result(console, *arguments, **how)
    return capture.get()


def test_case_has_every_kind_of_parameter(case: Any) -> None:
    found = set(standings(case.result).values())
    assert found == {"alone", "combined", "absorbed", "invisible"}


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


def test_undetermined_rows_can_be_left_out(case: Any) -> None:
    rows = cells(parameter_table(case.result, undetermined=False))
    alone = [e.name for e in case.result.estimates if e.identifiable]
    assert [row["parameter"] for row in rows] == alone


def test_truth_column_says_inside_or_outside(case: Any) -> None:
    name = next(e.name for e in case.result.estimates if e.identifiable)
    wrong = case.truth | {name: case.result[name].ci95[1] + 1.0}
    rows = {row["parameter"]: row for row in cells(parameter_table(case.result, wrong))}
    assert rows[name]["in 95 %"] == "outside"
    for e in case.result.estimates:
        if e.name != name:
            expected = inside(case.truth[e.name], e.ci95)
            assert rows[e.name]["in 95 %"] == expected
            assert (expected == "") == (not e.identifiable)


def test_combination_is_compared_as_a_whole(case: Any) -> None:
    rows = cells(combination_table(case.result, case.truth))
    assert len(rows) == len(case.result.combinations) > 0
    for row, c in zip(rows, case.result.combinations, strict=True):
        true = combination_truth(case.result, c, case.truth)
        assert row["in 95 %"] == inside(true, c.ci95) != ""
    first = case.result.combinations[0]
    partly = {k: v for k, v in case.truth.items() if k != list(first.terms)[1]}
    assert cells(combination_table(case.result, partly))[0]["truth"] == "–"


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


def test_what_is_not_determined_is_told_in_one_line_each(case: Any) -> None:
    text = " ".join(printed(200, case.result, details=True).split())
    absorbed = [n for n, s in standings(case.result).items() if s == "absorbed"]
    assert "held at nominal (not visible in these data): joint1.compliance" in text
    few = " ".join(printed(200, case.result).split())
    assert f"nothing to do): {listed(absorbed, FEW)}" in few
    assert set(absorbed) == set(case.result.left.redundant)
    assert f"nothing to do): {', '.join(absorbed)}" in text


def test_the_terminal_begins_with_the_verdict_of_the_page_and_what_to_do(case: Any) -> None:
    judged = judgement(case.result)
    words = " ".join(printed(100, case.result).split())
    assert words.startswith(f"Verdict: {judged.headline} Error (rms): ")
    assert words.index("Next: ") < words.index("Parameters ")
    assert judged.steps
    assert words.count("Next: ") == len(judged.steps)
    assert all(step in words for step in judged.steps)
    assert not any(f"({section})" in words for _, section in SECTIONS.values())


def test_steps_name_the_sections_of_the_page_only_where_there_is_one(case: Any) -> None:
    found = judgement(case.result, sections=True)
    assert any("(What is not determined)" in step for step in found.steps)
    assert len(found.steps) == len(judgement(case.result).steps)


def test_details_are_told_where_they_are_asked_for(case: Any) -> None:
    """All of them on the page; the terminal says how to see them."""
    few, all_of_them = (printed(100, case.result, details=d) for d in (False, True))
    for label in ("Residuals: ", "Intervals: ", "Method: ", "Noise model: "):
        assert label not in few and label in all_of_them
    assert "details=True" in few and "details=True" not in all_of_them


def test_summary_in_words(case: Any) -> None:
    text = told(case.result, case.truth)
    lines = text.splitlines()
    assert "48 position readings in 12 configurations, 2 markers (table)" in text
    assert "weights estimated by restricted likelihood" in text
    assert "Noise model: " in text
    assert f"Degrees of freedom: {case.result.dof}" in lines
    assert "held-out poses" in text
    assert "times the stated noise" in text
    assert text.count("Warning: ") == len(case.result.warnings)
    assert "intervals at 95 % hold the true value" in text


def told(*arguments: Any) -> str:
    lines = leading_lines(arguments[0]) + summary_lines(*arguments)
    return "\n".join(f"{label}: {text}" for label, text in lines)


def test_rotations_and_unstated_noise(pose: Any, bare: Any) -> None:
    assert "rotations" in told(pose.result)
    text = told(bare.result)
    assert "restricted likelihood" in text
    assert "No noise was stated" in text
    assert "Warning: 1 reading" in text


def lopsided(result: Any, ends: list[tuple[float, float]]) -> Any:
    """The result with other intervals, in halves of their width, for its first known parameters."""
    estimates = list(result.estimates)
    alone = [k for k, e in enumerate(estimates) if e.identifiable]
    for k, (below, above) in zip(alone, ends, strict=False):
        e = estimates[k]
        half = e.ci95[1] - e.value
        ci95 = (e.value - below * half, e.value + above * half)
        estimates[k] = replace(e, ci95=ci95)
    return replace(result, estimates=tuple(estimates)), [estimates[k] for k in alone]


@pytest.mark.parametrize("width", [60, 100])
def test_lopsided_intervals_show_both_ends(case: Any, width: int) -> None:
    result, known = lopsided(case.result, [(0, 1), (np.inf, 1), (1.04, 1)])
    rows = {row["parameter"]: row for row in cells(parameter_table(result))}
    assert rows[known[0].name]["95 %"].startswith("[")
    assert rows[known[1].name]["95 %"].startswith("[-∞, ")
    assert rows[known[2].name]["95 %"].startswith("± ")
    low, high = map(float, rows[known[0].name]["95 %"].strip("[]").split(", "))
    assert low == float(rows[known[0].name]["value"]) < high
    text = printed(width, result)
    assert "[-∞" in text
    assert "value ± 95 %" not in text[: text.index("Combinations")]
    assert "inf" not in text[: text.index("Readings")]


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


def test_shortened_expression() -> None:
    terms = {"a": 1.0, "b": -0.012345, "c": 1.0000001, "d": 5.0, "e": -2.5, "f": 1e-3}
    c = Combination(terms, "m", 0.0, 1.0, (-2.0, 2.0))
    assert shortened(c) == "a + c + 5.00·d - 2.50·e + 2 more"
    assert shortened(c, 6) == "a - 0.0123·b + c + 5.00·d - 2.50·e + 0.00100·f"


def test_a_member_held_off_zero_is_told_as_its_deviation() -> None:
    terms = {"x": 1.0, "y": 0.5, "z": -1.0, "u": 2.0}
    c = Combination(terms, "m", 0.0, 1.0, (-2.0, 2.0), {"y": 0.001234567, "z": -3e-7, "u": 0.0})
    assert c.expression == "x + 0.5·(y - 0.00123457) - (z + 3e-07) + 2·u"
    assert shortened(c) == "x + 0.500·(y - 0.001235) - (z + 3e-07) + 2.00·u"
