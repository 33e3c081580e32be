"""The certificate: entries, uncertainty, conformity, and the same as XML."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from support.pages import Page

from elastocal.cell import CertificateEntries
from elastocal.identification.scrutiny import gap_budget
from elastocal.messages import InputError
from elastocal.report.smaller_views import Certified, _unit, pose_repeatability

ENTRIES = CertificateEntries(
    number="<b>17</b>", laboratory="Laboratory", country="DE", customer="Customer",
    robot_serial="R-1", tool_serial="T-1", instrument="tracker", instrument_calibration="C-9",
    place="hall", measured_on="2026-03-17", operator="A. B.", procedure="QP-17",
    temperature=20.5, instrument_uncertainty=12e-6, limit=1.0,
)  # fmt: skip
NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}


def stated(result: Any, entries: CertificateEntries = ENTRIES) -> Any:
    model = copy.copy(result.model)
    object.__setattr__(model, "cell", replace(model.cell, certificate=entries))
    return replace(result, model=model)


def written(result: Any, path: Path) -> str:
    result.certificate(path, inputs={"d.csv": "abc"})
    return path.read_text(encoding="utf-8")


def test_without_entries_it_is_a_report_and_a_missing_one_is_named(case: Any, tmp_path: Path):
    assert "<h1>Calibration report of" in written(case.result, tmp_path / "c.html")
    some = written(stated(case.result, replace(ENTRIES, operator=None)), tmp_path / "c.html")
    assert "<h1>Calibration report of" in some
    assert "[certificate] of the cell lacks operator." in some
    whole = written(stated(case.result), tmp_path / "c.html")
    assert "<h1>Calibration certificate of" in whole and "lacks" not in whole
    page = Page(whole)
    page.check_harmless(whole)
    rows = page.named_rows()
    assert rows["number"][1] == "<b>17</b>" and rows["temperature"][1] == "20.5 °C"
    with pytest.raises(InputError, match=r"needs \[certificate\] in the cell with number, lab"):
        case.result.certificate(tmp_path / "c.xml")
    assert not (tmp_path / "c.xml").exists()


def test_a_limit_within_the_guard_band_gives_no_statement(case: Any) -> None:
    own = Certified(case.result, gap_budget(case.result))
    # U of a distance: of the reading alone, whose instrument has no calibration stated.
    assert own.of_deviations == pytest.approx(2 * case.result.uncertainty().instrument)
    for bands, words in ((1.1, "Conforms"), (0.9, "No statement"), (-0.9, "No statement"),
                         (-1.1, "Does not conform")):  # fmt: skip
        assert own.conformity(own.error + bands * own.of_deviations).startswith(words)


def test_repeatability_is_that_of_iso_9283(case: Any) -> None:
    """Four readings of each place, two d apart from the mean and two 3 d: l = d, d, 3 d, 3 d."""
    observed, d = case.result.observations, 5e-6
    rows = np.repeat(np.arange(len(observed.table)), 4)
    four = replace(observed, table=observed.table.take(rows), lead=np.arange(len(rows)))
    away = np.tile([d, -d, 3 * d, -3 * d], len(rows) // 4)[:, None] * [1.0, 0.0, 0.0]
    result = replace(case.result, observations=four, residual=away.ravel())
    lengths = np.array([1, 1, 3, 3]) * d
    expected = lengths.mean() + 3 * lengths.std(ddof=1)
    assert pose_repeatability(result) == pytest.approx(expected)


def test_the_xml_says_the_same_in_the_structure_of_a_dcc(case: Any, tmp_path: Path) -> None:
    result = replace(stated(case.result), heldout_rms=np.inf)
    root = ElementTree.fromstring(written(result, tmp_path / "c.xml"))
    assert root.tag == "{https://ptb.de/dcc}digitalCalibrationCertificate"
    top, order = ([child.tag.rpartition("}")[2] for child in node] for node in (root, root[0]))
    assert top == ["administrativeData", "measurementResults"]
    assert order == ["dccSoftware", "coreData", "items", "calibrationLaboratory", "respPersons",
                     "customer"]  # fmt: skip
    assert root.findtext(".//dcc:uniqueIdentifier", namespaces=NAMES) == "<b>17</b>"
    found = {}
    for one in root.iterfind(".//dcc:result", NAMES):
        name = one.findtext("dcc:name/dcc:content", namespaces=NAMES)
        real = one.find("dcc:data/dcc:quantity/si:real", NAMES)
        if real is None:  # a number that there is not
            assert name == "root mean square position error at poses not fitted"
            continue
        mu = real.find("si:measurementUncertaintyUnivariate/si:expandedMU", NAMES)
        assert name and mu.findtext("si:coverageFactor", namespaces=NAMES) == "2"
        expanded = mu.findtext("si:valueExpandedMU", namespaces=NAMES)
        found[name] = float(real.findtext("si:value", namespaces=NAMES)), float(expanded)
    for e in result.ordinary:
        if e.value is not None:
            assert found[e.name] == pytest.approx((e.value, 2 * e.std), rel=5e-3)
    assert "Conforms" in "".join(root.itertext())
    assert _unit("rad/(N*m)^3") == r"\radian\newton\tothe{-3}\metre\tothe{-3}"
    assert [*map(_unit, ("kg*m", "1/m", "1"))] == [r"\kilogram\metre", r"\metre\tothe{-1}", r"\one"]
