"""The diagnosis report: complete, self-contained, harmless."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from support.cells import kr270_cell, kr270_chain
from support.diagnoses import EXPLAINED, HOSTILE, VERDICTS
from support.pages import Page

from elastocal.cell.arm_description import EffectChoice
from elastocal.diagnosis.baseline import Baseline
from elastocal.errors import InputError
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.report.figures import effect_shapes
from elastocal.report.page import page_of, write_page
from elastocal.simulation import simulate


@pytest.fixture(scope="module")
def model() -> Model:
    return Model.assembled(kr270_chain(), kr270_cell(("base_frame",)))


@pytest.fixture(scope="module")
def pages(model: Model) -> dict[str, str]:
    told = {"command": f"elastocal diagnose {HOSTILE}", "inputs": {HOSTILE: "0" * 64}, "seed": 7}
    return {
        name: page_of(replace(d, model=model, data=HOSTILE), **told) for name, d in VERDICTS.items()
    }


@pytest.mark.parametrize("name", VERDICTS)
def test_names_from_files_are_text_and_nothing_comes_from_elsewhere(name, pages):
    text = pages[name]
    page = Page(text)
    page.check_harmless(text)
    assert "<script>alert(1)</script>" in page.text


@pytest.mark.parametrize("name", VERDICTS)
def test_figures_are_well_formed_and_follow_the_page_colours(name, pages):
    figures = re.findall(r"<svg.*?</svg>", pages[name], re.DOTALL)
    shown = VERDICTS[name]
    assert len(figures) == 1 + bool(shown.curves)
    for figure in figures:
        ElementTree.fromstring(figure)
        assert "aria-label" in figure
        assert "#0102" not in figure
    ids = re.findall(r'\bid="([^"]*)"', pages[name])
    assert len(ids) == len(set(ids))


def test_a_found_effect_stands_over_its_driver_with_what_was_read():
    """An eccentricity of joint 2 over its angle, and readings within their noise of it."""
    cell = kr270_cell(("base_frame", "joint_offset"))
    model, rng = Model.assembled(kr270_chain(), cell), np.random.default_rng(2)
    found = {p.name: p.value for p in EXPLAINED.effects[0].parameters}
    real = model.with_effects((*cell.model.effects, EffectChoice("gear_eccentricity", "joint2")))
    q = rng.uniform(*np.array(joint_limits(cell, model.chain)), (60, 6))
    x = np.array([found.get(n, v) for n, v in zip(real.names, real.nominal, strict=True)])
    observed = observe(simulate(real, model.table(q), x, rng, False), "position")
    read = observed.value + 1e-5 * rng.normal(size=observed.value.shape)
    B = model.regressor(observed.table, model.nominal, observations=observed).B
    left = read - model.predict(observed.table, model.nominal, observed)
    left = left - B @ np.linalg.lstsq(B, left, rcond=None)[0]
    base = Baseline(model, observed, model.nominal, np.ones(len(model.names)), left, left, None)
    ((_, _, q, seen, explained, _),) = effect_shapes(
        replace(EXPLAINED, calibrated=base, model=model)
    )
    sin, cos = (found[f"joint2.eccentricity_{k}"] for k in ("sin", "cos"))
    expected = sin * np.sin(q) + cos * np.cos(q)
    np.testing.assert_allclose(explained, expected, atol=1e-6)
    assert np.std(seen - explained) < 2e-5 < np.std(explained)


def test_same_diagnosis_same_page(model):
    found = replace(EXPLAINED, model=model)
    assert page_of(found) == page_of(found)


def test_writing_is_whole_or_not_at_all(model, tmp_path):
    found = replace(EXPLAINED, model=model)
    with pytest.raises(InputError, match="no such file"):
        write_page(found, tmp_path / "r.html", inputs=[tmp_path / "missing.csv"])
    with pytest.raises(InputError, match="does not exist"):
        write_page(found, tmp_path / "none" / "r.html")
    assert list(tmp_path.iterdir()) == []
