"""The page: complete, self-contained, harmless."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from support.pages import Page

from elastocal.identification.error_budget import gap_budget, pose_accuracy
from elastocal.model.observations import observe
from elastocal.report import figures, residual_view
from elastocal.report.formatting import length
from elastocal.report.judgement_view import judgement
from elastocal.report.page import page_of, write_page
from elastocal.report.residual_figures import held_out


@pytest.fixture(scope="module")
def page(case: Any) -> str:
    return laid_out(case)


def laid_out(case: Any) -> str:
    """The one page of these tests whose figures' labels do not overlap."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "LAYOUT", "constrained")
        return page_of(
            case.result, command="elastocal identify c.toml d.csv", seed=3, truth=case.truth
        )


def test_every_parameter_is_on_the_page_and_no_number_where_none_is_known(
    page: str, case: Any
) -> None:
    rows = {row[0]: row for row in Page(page).rows if row}
    for e in case.result.estimates:
        row = rows[e.name]
        if e.identifiable:
            assert re.fullmatch(r"−?\d+(\.\d+)?", row[1])
        else:
            assert row[1] == "–"
            assert row[-1].startswith(("held", "only as", "fixed"))


def test_structure(page: str) -> None:
    structure = Page(page)
    structure.check_harmless(page)
    assert page.count("<figure") == page.count("</figure>") == 11
    for heading in (
        "Where the error goes",
        "Parameters",
        "Combinations",
        "What is not determined",
        "Correlations over 0.9",
        "Residuals",
        "Faulty readings",
        "To repeat this",
    ):
        assert heading in structure.text
    assert "elastocal identify c.toml d.csv" in structure.text
    assert "model evaluated by" in structure.named_rows()
    assert "prefers-color-scheme: dark" in page
    assert "@media print" in page


def test_the_page_lists_its_sections_and_says_when_it_was_made(page: str) -> None:
    nav = page[page.index("<nav") : page.index("</nav>")]
    parts = re.findall(r'<a id="(part\d+)"></a><h2>(.*?)</h2>', page)
    assert len(parts) == page.count("<h2>")
    assert all(f'<a href="#{part}">{head}</a>' in nav for part, head in parts)
    assert Page(page).named_rows()["made on"][1] == date.today().isoformat()


def test_errors_before_and_after_are_told_by_mean_spread_and_quantile(page: str, case: Any) -> None:
    budget = gap_budget(case.result)
    rows = {row[0]: row for row in Page(page).rows if len(row) == 6}
    for name, step in (("nominal arm (base and markers by other poses)", budget.steps[0]),
                       ("calibrated", budget.steps[-1])):  # fmt: skip
        e = np.linalg.norm(step.errors, axis=1)
        told = (e.mean(), e.std(), np.quantile(e, 0.95), e.max())
        assert rows[name][1:] == [str(len(e)), *map(length, told)]
        assert step.heldout_rms == pytest.approx(float(np.sqrt(np.mean(e**2))))


def test_the_certificate_is_one_page_of_accuracy_data_and_verdict(
    case: Any, tmp_path: Path
) -> None:
    case.result.certificate(tmp_path / "c.html", inputs={"d.csv": "abc123"})
    text = (tmp_path / "c.html").read_text(encoding="utf-8")
    page = Page(text)
    page.check_harmless(text)
    rows = page.named_rows()
    n = len(np.unique(case.result.observations.place))
    accuracy = pose_accuracy(case.result.observations, gap_budget(case.result).steps[-1].errors)
    assert rows["calibrated"][1:3] == [str(n), length(float(accuracy.mean()))]
    assert rows["d.csv"][1] == "SHA-256abc123" and rows["made on"][1]
    assert "10.0 µm" in rows["Instrument, standard deviations"][1] or "µm" in text
    assert judgement(case.result).headline in page.text and "ISO 9283" in page.text
    assert "<nav" not in text and not page.tags["svg"]


def test_figures_are_well_formed_and_follow_the_page_colours(page: str) -> None:
    figures = re.findall(r"<svg xmlns=.*?</svg>", page, re.DOTALL)
    assert len(figures) == 11
    for figure in figures:
        ElementTree.fromstring(figure)
        assert "var(--ink)" in figure
        assert "#0102" not in figure
        assert "mathdefault" not in figure


def test_names_from_files_are_text(hostile: Any) -> None:
    page = page_of(hostile.result, command="elastocal <b>", inputs={"<i>.csv": "<u>"})
    structure = Page(page)
    structure.check_harmless(page)
    assert not {"b", "i", "u"} & set(structure.tags)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "[red]$x^2$ & " in structure.text
    (view,) = structure.data
    assert not set("<>&") & set(view)
    assert json.loads(view)["poses"][0]["names"][0] == "<script>alert(1)</script>"
    assert "left out" in structure.text.lower()


def test_size_of_a_long_table(case: Any, tmp_path: Path) -> None:
    """40 000 readings: thinned, said so, and below 6 MB."""
    observed = case.result.observations
    times = 40000 // len(observed.lead) + 1
    rows = np.tile(np.arange(len(observed.table)), times)
    long = replace(
        case.result,
        observations=observe(observed.table.take(rows), observed.kind),
        residual=np.tile(case.result.residual, times),
        held_out=np.tile(case.result.held_out, times),
        noise=replace(case.result.noise, kind="none"),
        weights=None,
    )
    write_page(long, tmp_path / "r.html")
    assert (tmp_path / "r.html").stat().st_size < 6e6
    assert "a random choice of 5000 of" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_small_tables_are_drawn_whole(page: str, case: Any) -> None:
    assert "random choice" not in page
    shown = residual_view.residuals_of(case.result).shown
    assert len(shown) == len(case.result.observations.lead)


def test_same_result_same_page_whatever_matplotlib_is_set_to(case: Any, page: str) -> None:
    with mpl.rc_context({"text.usetex": True, "axes.facecolor": "red", "font.size": 30}):
        again = laid_out(case)
    # What evaluated the model so far is another thing the second time.
    engine = re.compile(r"<td class=\"name\">model evaluated by</td><td>.*?</td>")
    assert engine.sub("", again) == engine.sub("", page)


def test_configuration_without_held_out_error(case: Any) -> None:
    errors = case.result.held_out.copy()
    errors[:12] = np.inf  # 2 markers × 2 loads × 3 coordinates
    found = replace(case.result, held_out=errors, heldout_rms=float("inf"))
    assert "</svg>" in held_out(found, residual_view.residuals_of(found))
    page = page_of(found)
    Page(page)
    assert "1 without held-out error" in page
    assert "is not known" in page


def test_other_observations(pose: Any, bare: Any) -> None:
    text = page_of(pose.result, truth=pose.truth)
    Page(text)
    assert "rz in µrad" in text
    text = page_of(bare.result)
    assert "No noise was stated" in text
    (faulty,) = bare.result.outliers
    (row,) = [row for row in Page(text).rows if len(row) == 5 and row[0] == str(faulty.line)]
    assert row[1:3] == [faulty.configuration, faulty.marker]
