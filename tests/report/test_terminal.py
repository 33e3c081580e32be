"""What is printed: nothing undetermined looks known, nothing is cut off, names stay names, and no
sentence says more than is known."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console
from support.diagnoses import MANY, VERDICTS

from elastocal.report.blocks import ShownTable, probability
from elastocal.report.diagnosis_view import place_table
from elastocal.report.identification_view import texts
from elastocal.report.renderers import print_report


def printed(width: int, *arguments: Any, **how: Any) -> str:
    console = Console(width=width, force_terminal=False, highlight=False)
    with console.capture() as capture:
        print_report(console, *arguments, **how)
    text = capture.get()
    told = [line.rstrip() for line in text.splitlines() if line[:1] != " "]  # but rows of tables
    assert width < 60 or max(map(cell_len, told)) <= width
    assert "\x1b" not in text
    return text


def cells(table: ShownTable) -> list[dict[str, str]]:
    return [dict(zip(table.heads, row, strict=True)) for row in table.rows]


@pytest.mark.parametrize("width", [30, 60])
def test_no_number_is_cut_off_at_any_width(case: Any, width: int) -> None:
    text = printed(width, case.result, truth=case.truth)
    beginning = text[: text.index("Readings")]
    assert "…" not in beginning
    joined = "".join(beginning.split())
    for e in filter(lambda e: e.identifiable, case.result.estimates):
        assert all(told in joined for told in texts(e, None)[:2]) and e.name in text


def test_names_are_not_markup_and_not_terminal_commands(hostile: Any) -> None:
    text = printed(160, hostile.result, truth=hostile.truth)
    assert "[red]$x^2$" in text and "<script>alert(1)</script>" in text


@pytest.mark.parametrize("width", [60, 140])
def test_every_key_figure_of_a_plan_is_told_within_the_width(plan: Any, width: int) -> None:
    told = " ".join(printed(width, plan).split())
    c = plan.certificate
    for part in (
        f"ρ₀ = {1e6 * plan.everywhere.test_poses:.4g} µm",
        f"{1e6 * plan.everywhere.elsewhere:.4g} µm rms over the joint ranges",
        f"certified on the pool: efficiency {c.efficiency_pool:.4f}",
        f"estimated on the continuum: efficiency {c.efficiency_continuum:.4f}",
        f"{plan.candidates.feasible} feasible of {plan.candidates.tried} tried",
        "No feasible pose shows joint1.compliance",
        f"{len(plan.execution.stops)} stops",
        *(p.name for p in plan.predicted),
    ):
        assert part in told
    for q in np.degrees(plan.q).ravel():
        assert f"{q:.2f}" in told or (width == 60 and f"{q:.1f}" in told)


@pytest.mark.parametrize("name", VERDICTS)
def test_a_diagnosis_fits_and_tells_no_raw_names(name: str) -> None:
    text = printed(60, VERDICTS[name])
    words = " ".join(text.split())
    for part in ("Verdict:", "Error budget", "rank 1 to 8 of 10", "Noise:", "Next:"):
        assert part in words
    assert not re.search(r"\b(joint|link)[0-9](?!\.)|gear_", words)


@given(st.floats(0, 1))
def test_a_probability_is_never_told_as_certain(p):
    text = probability(p)
    assert text not in ("0.00", "1.00")
    assert abs(float(text.strip("<> ")) - p) <= 0.0101


def test_an_effect_that_two_findings_share_a_place_with_stands_below_one_of_them_only():
    both = replace(MANY, groups=(MANY.groups[0], replace(MANY.groups[0], name="other")))
    kept = [c for c in MANY.components if c.family == "angle"]
    assert len(place_table(both).rows) == len(kept)
