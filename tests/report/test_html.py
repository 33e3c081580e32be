"""The page: complete, self-contained, harmless."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from support.pages import Page

from elastocal.identification.error_budget import gap_budget, pose_accuracy
from elastocal.model.observations import observe
from elastocal.report import figures
from elastocal.report.formatting import length
from elastocal.report.judgement_view import judgement
from elastocal.report.page import page_of, write_page


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
    assert rows["d.csv"][1] == "SHA-256 abc123" and rows["made on"][1]
    assert "10.0 µm" in rows["Instrument, standard deviations"][1] or "µm" in text
    assert judgement(case.result).headline in page.text and "ISO 9283" in page.text
    assert not page.tags["svg"]


def test_figures_are_well_formed_and_follow_the_page_colours(page: str) -> None:
    figures = re.findall(r"<svg xmlns=.*?</svg>", page, re.DOTALL)
    assert len(figures) == 5
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


@pytest.mark.long
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
        prior_share={"joint1.offset": 0.1},  # so that nobody asks what a configuration decides
    )
    write_page(long, tmp_path / "r.html")
    assert (tmp_path / "r.html").stat().st_size < 6e6
    assert "a random choice of 5000 of" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_same_result_same_page_whatever_matplotlib_is_set_to(case: Any, page: str) -> None:
    with mpl.rc_context({"text.usetex": True, "axes.facecolor": "red", "font.size": 30}):
        again = laid_out(case)
    # What evaluated the model so far is another thing the second time.
    engine = re.compile(r"<td class=\"name\">model evaluated by</td><td>.*?</td>")
    assert engine.sub("", again) == engine.sub("", page)
